"""Opening the aperture of a scene of unknown depth: what it adds, and what it leaves alone."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from simulator.capture.aperture_blur import MapApertureBlur, NetworkApertureBlur
from simulator.capture.denoised import Denoised
from simulator.networks.aperture_module import ApertureModule
from simulator.optics.blur import disc_blur
from simulator.optics.disc_bank import DIAMETERS, HALO, DiscBank, added_blur
from simulator.utils.tiles import make_tiles


def light(seed: int = 0) -> Tensor:
    values = np.random.default_rng(seed).random((4, 24, 24), dtype=np.float32)
    return torch.from_numpy(values)


def aperture_blur(diameter: float = 2.0 / math.sqrt(3)) -> MapApertureBlur:
    """At f/4 the default adds exactly 2 px, a disc of the bank, to a picture at f/8."""
    assert 2.0 in DIAMETERS
    return MapApertureBlur(light(), torch.full((24, 24), diameter), 8.0)


def test_each_light_is_blurred_by_its_own_bank_and_cached() -> None:
    made, kernel = aperture_blur(), torch.zeros(9, 9)
    for denoised in (None, Denoised(light(1)), Denoised(light(2))):
        result = made.opened(4.0, denoised)
        expected = disc_blur(light() if denoised is None else denoised.light, 2.0)
        torch.testing.assert_close(result, expected, atol=1e-5, rtol=0)
        assert made.opened(4.0, denoised) is result
        assert not torch.equal(made.opened(5.6, denoised), result)
    kernel[4, 4] = 1.0
    energy = disc_blur(kernel, 2.0).square().sum()
    remaining = made.remaining_variance(4.0)
    torch.testing.assert_close(remaining, energy.expand(24, 24), rtol=1e-5, atol=0)


def test_a_lamp_of_any_brightness_stays_finite() -> None:
    opened = []
    for lamp in (0.0, 1e30):
        scene = light()
        scene[:, 12, 12] = lamp
        made = MapApertureBlur(scene, torch.full((24, 24), 3.0), 8.0)
        opened.append(made.opened(4.0, None))
    assert bool(opened[1].isfinite().all())
    # A disc's 6 px away nothing of the lamp arrives, and nothing of the shadows is lost.
    torch.testing.assert_close(opened[1][:, 3, 3], opened[0][:, 3, 3])


def test_the_papers_network_runs_once_per_f_number_on_the_denoised_light() -> None:
    torch.manual_seed(0)
    module = ApertureModule("paper").eval().requires_grad_(False)
    module.network.tail.weight.mul_(10)
    made = NetworkApertureBlur(Denoised(light()), module, 8.0)
    assert made.needs_denoised
    assert made.extent(4.0) == math.inf
    assert made.extent(8.0) == made.extent(11.0) == 0.0
    assert made.remaining_variance(4.0) is None
    result = made.opened(4.0)
    assert made.opened(4.0, Denoised(light())) is result
    f_source, f_target = torch.tensor([8.0]), torch.tensor([4.0])
    image = light()[None]
    expected = module(image, torch.zeros_like(image), f_source, f_target)[0]
    assert torch.equal(result, expected)
    assert not torch.equal(result, light())


@pytest.mark.parametrize("size", [(1, 40), (40, 1), (35, 91), (150, 133)])
@pytest.mark.parametrize("tile", [32, 768])
def test_tiles_have_no_seams_and_what_is_in_focus_is_copied(
    size: tuple[int, int], tile: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    generator = torch.Generator().manual_seed(2)
    image = torch.rand(4, *size, generator=generator) * 3
    diameter = 12 * torch.rand(size, generator=generator)
    diameter[: size[0] // 2, : 2 * size[1] // 3] = 0.0
    monkeypatch.setattr(
        "simulator.capture.aperture_blur.make_tiles", functools.partial(make_tiles, tile=tile)
    )
    made = MapApertureBlur(image, diameter, 8.0)
    for f_number in (5.6, 2.8):
        result = made.opened(f_number, None)
        whole = DiscBank(image).blurred(added_blur(diameter, 8.0, f_number))
        torch.testing.assert_close(result, whole, rtol=0, atol=3e-6)
        assert torch.equal(result[:, diameter == 0], image[:, diameter == 0])
        assert not torch.equal(result, image) or min(size) == 1


def test_only_what_is_out_of_focus_is_blurred(monkeypatch: pytest.MonkeyPatch) -> None:
    pixels: list[int] = []

    class Spy(DiscBank):
        def blurred(self, diameter: Tensor) -> Tensor:
            pixels.append(diameter.numel())
            return super().blurred(diameter)

    monkeypatch.setattr("simulator.capture.aperture_blur.DiscBank", Spy)
    image, diameter = torch.rand(4, 300, 400), torch.zeros(300, 400)
    assert torch.equal(MapApertureBlur(image, diameter, 8.0).opened(4.0, None), image)
    assert not pixels
    diameter[-32:, -32:] = 5.0
    MapApertureBlur(image, diameter, 8.0).opened(4.0, None)
    assert (32 + HALO) ** 2 <= sum(pixels) <= (48 + HALO) ** 2  # in cells of 16 pixels


def test_the_map_is_estimated_when_the_aperture_first_opens() -> None:
    calls: list[int] = []

    def estimate() -> Tensor:
        calls.append(1)
        return torch.full((24, 24), 2.0)

    made = MapApertureBlur(light(), estimate, 8.0)
    assert made.extent(8.0) == made.extent(16.0) == 0.0
    assert not calls
    assert made.extent(4.0) == pytest.approx(2 * math.sqrt(3))
    made.opened(4.0, None)
    made.remaining_variance(5.6)
    assert calls == [1]
