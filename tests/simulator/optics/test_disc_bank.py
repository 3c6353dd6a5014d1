"""Blends of a bank of discs: against one disc, and the CPU's kernels against torch."""

import numpy as np
import pytest
import torch

from simulator.optics.blur import disc_blur, disc_kernel
from simulator.optics.disc_bank import DIAMETERS, DiscBank, blend, needed, remaining_variance

BETWEEN = [0.35, 0.85, 1.2, 1.7, 2.4, 3.3, 5.0, 6.5, 9.7, 14.0, 19.0, 27.0]
KNOTS = np.array(DIAMETERS) ** 2


def blurred(image: torch.Tensor, diameter: float) -> torch.Tensor:
    return DiscBank(image).blurred(torch.full(image.shape[-2:], diameter))


def uniform(*size: int, high: float = 1.0, seed: int = 0) -> torch.Tensor:
    values = np.random.default_rng(seed).uniform(0.0, high, size)
    return torch.from_numpy(values).float()


def through_torch(image: torch.Tensor, diameter: torch.Tensor) -> torch.Tensor:
    """What training uses: gradients flow through it."""
    return DiscBank(image).blurred(diameter.clone().requires_grad_()).detach()


@pytest.mark.parametrize("diameter", [*DIAMETERS, 100.0])
def test_at_its_diameters_and_beyond_them_it_is_the_disc_blur(diameter):
    image = uniform(2, 24, 31)
    expected = disc_blur(image, min(diameter, DIAMETERS[-1]))
    torch.testing.assert_close(blurred(image, diameter), expected, atol=2e-6, rtol=0)


@pytest.mark.parametrize("diameter", [*BETWEEN, 0.0, 11.3, 100.0])
def test_between_its_diameters_energy_and_second_moment_are_a_discs(diameter):
    """d^2 / 16 per axis: the moment of a uniform disc of diameter d."""
    point = torch.zeros(81, 81)
    point[40, 40] = 1.0
    spread = blurred(point, diameter).double().numpy()
    offsets, moment = np.arange(81) - 40, min(diameter, DIAMETERS[-1]) ** 2 / 16
    assert spread.sum() == pytest.approx(1.0, abs=1e-5)
    assert spread.min() > -1e-7
    for marginal in (spread.sum(0), spread.sum(1)):
        assert marginal @ offsets**2 == pytest.approx(moment, rel=2e-3, abs=2e-4)
        assert marginal @ offsets == pytest.approx(0.0, abs=1e-5)
    # Of white noise the sum of squared weights is left.
    left = float(remaining_variance(torch.tensor(diameter)))
    assert left == pytest.approx((spread**2).sum(), rel=1e-4)


def test_gradient_is_finite_everywhere_and_right():
    image = uniform(1, 16, 16).requires_grad_()
    values = torch.tensor([0.0, 1e-9, 0.7, 1.3, 4.0, 32.0, 50.0])
    diameter = values.repeat(16, 3)[:, :16].clone().requires_grad_()
    DiscBank(image).blurred(diameter).square().sum().backward()
    assert diameter.grad is not None
    assert image.grad is None
    assert bool(diameter.grad.isfinite().all())
    assert bool((diameter.grad[:, 0] == 0).all())  # d(diameter^2) is 0 there
    with torch.no_grad():
        assert not DiscBank(image).blurred(diameter).requires_grad

    exact = torch.full((6, 6), 1.27, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(DiscBank(uniform(6, 6).double()).blurred, exact, eps=1e-5)


@pytest.mark.parametrize("size", [(1, 1), (1, 300), (40, 1), (130, 131), (9, 257)])
@pytest.mark.parametrize("high", [0.3, 3.0, 40.0])
def test_it_is_the_blend_of_whole_frames(size, high):
    image, diameter = uniform(4, *size, high=2.0), uniform(*size, high=high, seed=1)
    diameter.view(-1)[::7] = 0.0
    found = DiscBank(image).blurred(diameter)
    torch.testing.assert_close(found, through_torch(image, diameter), rtol=1e-6, atol=1e-6)


def test_only_the_discs_in_use_are_computed():
    image, diameter = uniform(4, 40, 600), torch.full((40, 600), 0.3)
    diameter[20:] = 9.0
    assert needed(diameter) == [0, 1, *(DIAMETERS.index(d) for d in (8.0, 11.3))]
    bank = DiscBank(image)
    found = bank.blurred(diameter)
    assert sorted(bank._levels) == needed(diameter)
    torch.testing.assert_close(found, through_torch(image, diameter), rtol=1e-6, atol=1e-6)


def test_interpolation_is_linear_in_the_squared_diameter():
    """Images that are constants, by NumPy's own interpolation."""
    images = {i: torch.full((2, 3, 200), float(i * i)) for i in range(len(DIAMETERS))}
    diameter = uniform(3, 200, high=35.0)
    expected = np.interp(diameter.double().numpy() ** 2, KNOTS, [float(i * i) for i in images])
    found = blend(images, diameter)
    np.testing.assert_allclose(found.numpy(), np.stack([expected] * 2), rtol=1e-5, atol=1e-5)


def test_remaining_variance_is_that_of_each_pixels_kernel():
    """Of the blend of two discs by NumPy, in frames of any shape."""
    diameter = uniform(70, 30, high=35.0)
    found = remaining_variance(diameter)
    assert torch.equal(remaining_variance(diameter.double()[None])[0].float(), found)
    for y, x in np.ndindex(7, 3):
        squared = min(float(diameter[10 * y, 10 * x]) ** 2, KNOTS[-1])
        index = min(int(np.searchsorted(KNOTS, squared, side="right")), len(KNOTS) - 1)
        share = (squared - KNOTS[index - 1]) / (KNOTS[index] - KNOTS[index - 1])
        small, large = (disc_kernel(d) for d in DIAMETERS[index - 1 : index + 1])
        small = np.pad(small, (len(large) - len(small)) // 2)
        wanted = (((1 - share) * small + share * large) ** 2).sum()
        assert float(found[10 * y, 10 * x]) == pytest.approx(wanted, rel=2e-5)
