"""The blend of blurred images on the CPU against the one of whole frames in torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from simulator.optics.disc_bank import (
    DIAMETERS,
    DiscBank,
    blend,
    needed,
    piecewise,
    remaining_variance,
)

KNOTS = np.array(DIAMETERS) ** 2


def uniform(*size: int, high: float, seed: int = 0) -> torch.Tensor:
    values = np.random.default_rng(seed).uniform(0.0, high, size)
    return torch.from_numpy(values).float()


def through_torch(image: torch.Tensor, diameter: torch.Tensor) -> torch.Tensor:
    """What training uses: gradients flow through it."""
    return DiscBank(image).blurred(diameter.clone().requires_grad_()).detach()


@pytest.mark.parametrize("size", [(1, 1), (1, 300), (40, 1), (130, 131), (9, 257)])
@pytest.mark.parametrize("high", [0.3, 3.0, 40.0])
def test_it_is_the_blend_of_whole_frames(size: tuple[int, int], high: float) -> None:
    image, diameter = uniform(4, *size, high=2.0), uniform(*size, high=high, seed=1)
    diameter.view(-1)[::7] = 0.0
    found = DiscBank(image).blurred(diameter)
    torch.testing.assert_close(found, through_torch(image, diameter), rtol=1e-6, atol=1e-6)


def test_a_gap_between_the_diameters_is_not_computed() -> None:
    image, diameter = uniform(4, 40, 600, high=1.0), torch.full((40, 600), 0.3)
    diameter[20:] = 9.0
    assert needed(diameter, KNOTS) == [0, 1, *(DIAMETERS.index(d) for d in (8.0, 11.3))]
    bank = DiscBank(image)
    found = bank.blurred(diameter)
    assert sorted(bank._levels) == needed(diameter, KNOTS)
    torch.testing.assert_close(found, through_torch(image, diameter), rtol=1e-6, atol=1e-6)


def test_pixels_at_a_knot_need_one_image_alone() -> None:
    for index, diameter in enumerate(DIAMETERS):
        knots = np.float32(DIAMETERS) * np.float32(DIAMETERS)
        assert needed(torch.full((2, 300), diameter), knots) == [index]


def test_layouts_and_batches_of_one() -> None:
    image, diameter = uniform(1, 4, 30, 50, high=1.0), uniform(50, 30, high=9.0, seed=2).T
    strided = image.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)
    expected = through_torch(image, diameter[None, None])
    for given in (diameter, diameter[None, None]):
        for light in (image, strided):
            found = DiscBank(light).blurred(given)
            assert found.shape == image.shape
            torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)


def test_interpolation_is_linear_in_the_squared_diameter() -> None:
    """Images that are constants, by NumPy's own interpolation."""
    images = {i: torch.full((2, 3, 200), float(i * i)) for i in range(len(DIAMETERS))}
    diameter = uniform(3, 200, high=35.0)
    expected = np.interp(diameter.double().numpy() ** 2, KNOTS, [float(i * i) for i in images])
    found = blend(images, diameter, KNOTS)
    np.testing.assert_allclose(found.numpy(), np.stack([expected] * 2), rtol=1e-5, atol=1e-5)


def test_remaining_variance_is_that_of_torch() -> None:
    diameter = uniform(70, 130, high=35.0)
    found = remaining_variance(diameter)
    expected = remaining_variance(diameter.double())  # no kernel takes float64
    torch.testing.assert_close(found, expected.float(), rtol=2e-5, atol=1e-6)
    assert found.shape == diameter.shape
    assert float(piecewise(torch.zeros(1, 1), KNOTS, np.eye(len(KNOTS)))) == 1.0


def test_gradients_take_the_other_way() -> None:
    diameter = uniform(6, 6, high=4.0).requires_grad_()
    assert DiscBank(uniform(4, 6, 6, high=1.0)).blurred(diameter).requires_grad
    assert remaining_variance(diameter).requires_grad
    with torch.no_grad():
        assert not DiscBank(uniform(4, 6, 6, high=1.0)).blurred(diameter).requires_grad
