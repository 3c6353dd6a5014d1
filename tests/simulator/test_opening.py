"""Opening the aperture of a scene of unknown depth: what it adds, and what it leaves alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from simulator.blur import disc_blur
from simulator.modules.aperture import ApertureModule
from simulator.modules.disc_bank import DIAMETERS
from simulator.opening import MapOpening, NetworkOpening


def light(seed: int = 0) -> Tensor:
    values = np.random.default_rng(seed).random((4, 24, 24), dtype=np.float32)
    return torch.from_numpy(values)


def opening(diameter: float = 2.0 / math.sqrt(3)) -> MapOpening:
    """At f/4 the default adds exactly 2 px, a disc of the bank, to a picture at f/8."""
    assert 2.0 in DIAMETERS
    return MapOpening(light(0), light(1), torch.full((24, 24), diameter), 8.0)


def test_extent_is_the_largest_added_blur() -> None:
    diameter = torch.zeros(24, 24)
    diameter[3, 5] = 3.0
    made = MapOpening(light(), light(), diameter, 8.0)
    assert made.extent(4.0) == pytest.approx(3 * math.sqrt(2**2 - 1))
    assert made.extent(8.0) == made.extent(11.0) == 0.0


def test_each_light_is_blurred_by_its_own_bank() -> None:
    made = opening()
    for denoised in (False, True):
        result = made.opened(4.0, denoised=denoised)
        expected = disc_blur(light(int(denoised)), 2.0)
        torch.testing.assert_close(result, expected, atol=1e-5, rtol=0)


def test_results_are_kept_by_f_number_and_light() -> None:
    made = opening()
    first = made.opened(4.0, denoised=False)
    assert made.opened(4.0, denoised=False) is first
    assert not torch.equal(made.opened(4.0, denoised=True), first)
    assert not torch.equal(made.opened(5.6, denoised=False), first)


def test_remaining_is_the_energy_of_the_added_blur() -> None:
    kernel = torch.zeros(9, 9)
    kernel[4, 4] = 1.0
    energy = float(disc_blur(kernel, 2.0).square().sum())
    remaining = opening().remaining(4.0)
    assert remaining.shape == (24, 24)
    torch.testing.assert_close(remaining, torch.full((24, 24), energy), rtol=1e-5, atol=0)


def test_a_lamp_of_any_brightness_stays_finite() -> None:
    bright = light()
    bright[:, 12, 12] = 1e30
    made = MapOpening(bright, bright, torch.full((24, 24), 3.0), 8.0)
    result = made.opened(4.0, denoised=False)
    assert bool(result.isfinite().all())
    # A disc's 6 px away nothing of the lamp arrives, and nothing of the shadows is lost.
    torch.testing.assert_close(
        result[:, 3, 3],
        MapOpening(light(), light(), torch.full((24, 24), 3.0), 8.0).opened(4.0, denoised=False)[
            :, 3, 3
        ],
    )


def test_the_papers_network_runs_once_per_f_number_on_the_denoised_light() -> None:
    torch.manual_seed(0)
    module = ApertureModule("paper").eval().requires_grad_(False)
    module.network.tail.weight.mul_(10)
    made = NetworkOpening(light(), module, 8.0)
    assert made.needs_denoised
    assert made.extent(4.0) == math.inf
    assert made.extent(8.0) == made.extent(11.0) == 0.0
    assert made.remaining(4.0) is None
    result = made.opened(4.0)
    assert made.opened(4.0, denoised=True) is result
    f_source, f_target = torch.tensor([8.0]), torch.tensor([4.0])
    image = light()[None]
    expected = module(image, torch.zeros_like(image), f_source, f_target)[0]
    assert torch.equal(result, expected)
    assert not torch.equal(result, light())
