"""The aperture module: it opens and never closes, leaves what is in focus, and obeys the lens."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import scipy.ndimage
import torch
from torch import Tensor

from simulator.networks.aperture_module import (
    BLUR_FACTOR,
    DEAD_ZONE,
    LARGEST,
    ApertureModule,
    AperturePreset,
    DefocusMap,
    added_blur,
    band_features,
    dead_zone,
    is_defocused,
    to_diameter,
    usable_defocus,
)
from simulator.optics.discs import disc_blur
from simulator.optics.thin_lens import Lens


def picture(*size: int) -> Tensor:
    values = np.random.default_rng(0).random((2, 4, *size), dtype=np.float32)
    return torch.from_numpy(values) * 5.0


def module(preset: AperturePreset = "compact") -> ApertureModule:
    torch.manual_seed(1)
    made = ApertureModule(preset).eval().requires_grad_(False)
    if preset == "paper":
        made.network.tail.weight.mul_(10)
    return made


def with_map(diameter: float) -> ApertureModule:
    """A module that finds the same circle of confusion everywhere, before the dead zone."""
    made = module()
    made.network.tail.weight.zero_()
    made.network.tail.bias.fill_(np.log(diameter + 0.3))
    return made


F4, F8, F11 = (torch.full((2,), f) for f in (4.0, 8.0, 8 * 2**0.5))


@pytest.mark.parametrize("preset", ["compact", "paper"])
def test_only_the_images_that_open_change(preset: AperturePreset) -> None:
    image = picture(16, 19)
    made = with_map(4.0) if preset == "compact" else module("paper")
    for target in (F8, 2 * F8):
        assert torch.equal(made(image, torch.full_like(image, 0.01), F8, target), image)
    output = made(image, torch.zeros_like(image), F8, torch.tensor([4.0, 16.0]))
    assert not torch.allclose(output[0], image[0], atol=1e-3)
    assert torch.equal(output[1], image[1])


def test_dead_zone_by_hand() -> None:
    diameter = torch.tensor([0.0, 0.3, 0.5, 1.3, 5.0])
    expected = [0.0, 0.0, 0.0, 1.2, np.sqrt(25 - 0.25)]  # 5, 12, 13 over ten
    assert dead_zone(diameter, 0.5).tolist() == pytest.approx(expected, abs=1e-6)
    assert float(dead_zone(torch.tensor(DEAD_ZONE))) == 0.0


def test_a_known_map_is_blurred_by_what_the_wider_aperture_adds() -> None:
    """3 px at f/8, less the dead zone z: 9 - z^2 squared, times a factor squared; f/4 adds 2^2 - 1
        times that. A point
    becomes a spot of second moment d^2 / 16 per axis."""
    image = torch.zeros(2, 4, 41, 41)
    image[..., 20, 20] = 1.0
    output = with_map(3.0)(image, torch.zeros_like(image), F8, F4).double().numpy()
    squared = BLUR_FACTOR**2 * (9 - DEAD_ZONE**2) * 3
    offsets = np.arange(41) - 20
    moments = (output.sum(-1) * offsets**2).sum(-1)
    np.testing.assert_allclose(output.sum((-2, -1)), 1.0, atol=1e-5)
    np.testing.assert_allclose(moments, squared / 16, rtol=5e-3)


def test_the_paper_preset_commutes_with_exposure() -> None:
    """Its input is divided, its residual multiplied by one scalar."""
    image, made = picture(16, 16), module("paper")
    expected = made(image, torch.zeros_like(image), F11, F4)
    assert (expected - image).abs().mean() > 1e-2
    for factor in (2.0**-10, 2.0**10):
        result = made(image * factor, torch.zeros_like(image), F11, F4)
        torch.testing.assert_close(result, expected * factor, rtol=1e-4, atol=1e-4 * factor)


@pytest.mark.parametrize(("source", "target"), [(11.0, 4.0), (8.0, 5.6), (16.0, 4.0)])
def test_added_blur_is_the_thin_lens(source: float, target: float) -> None:
    """Squared diameters add: blur at the source and what is added make the blur at the target."""
    lens = Lens(focal_length=0.05, focus_distance=2.0)
    depth = np.array([0.7, 1.5, 2.0, 5.0, np.inf])
    at_source, at_target = (
        np.abs(lens.circle_of_confusion(depth, f)) / 11.8e-6 for f in (source, target)
    )
    added = added_blur(torch.from_numpy(at_source), source, target).numpy()
    np.testing.assert_allclose(np.hypot(at_source, added), at_target, rtol=1e-6, atol=1e-12)
    for same_or_closed in (source, 2 * source):
        assert not added_blur(torch.from_numpy(at_source), source, same_or_closed).any()


def test_a_picture_in_focus_is_not_touched_by_a_stray_estimate() -> None:
    """A twentieth of the detail must be blurred: 4 % of the pixels do not count, 50 % do."""
    generator = torch.Generator().manual_seed(0)
    image = 0.5 + 0.1 * torch.rand(2, 4, 50, 50, generator=generator)
    diameter = torch.full((2, 50, 50), 0.3)
    diameter[0, :2] = 6.0  # 4 %
    diameter[1, :25] = 6.0
    assert is_defocused(diameter, image).tolist() == [0.0, 1.0]
    trusted = usable_defocus(diameter, image)
    assert float(trusted[0].max()) == 0.0
    assert float(trusted[1].max()) == pytest.approx(BLUR_FACTOR * (6.0**2 - DEAD_ZONE**2) ** 0.5)


@pytest.mark.parametrize("spread", [0.2, 1.0, 3.0])
def test_defocus_is_judged_at_the_weighted_quantile(spread: float) -> None:
    """Against NumPy's sort of all pixels, weights from SciPy's windows."""
    random = np.random.default_rng(3)
    image = torch.from_numpy(random.uniform(0.2, 1.0, (3, 4, 30, 37)).astype(np.float32))
    image[:, :, :, :20] = 0.5 + 0.05 * (image[:, :, :, :20] - 0.5)
    centre = np.array([1.6, 1.9, 2.3]).reshape(3, 1, 1) - spread
    diameter = (centre + spread * random.random((3, 30, 37))).clip(0).astype(np.float32)
    expected = []
    for picture, values in zip(image.double().numpy(), diameter, strict=True):
        grey = picture.mean(axis=0)
        mean = scipy.ndimage.uniform_filter(grey, 9, mode="nearest")
        square = scipy.ndimage.uniform_filter((grey - mean) ** 2, 9, mode="nearest")
        weight = np.minimum(square / mean**2, 0.05).ravel()
        order = np.argsort(values.ravel())
        share = np.cumsum(weight[order]) / weight.sum()
        level = values.ravel()[order][np.searchsorted(share, 0.95)]
        expected.append(float(np.clip((level - 1.7) / (2.2 - 1.7), 0, 1)))
    found = is_defocused(torch.from_numpy(diameter), image)
    np.testing.assert_allclose(found.numpy(), expected, atol=0.01)


# The map of the circle of confusion


def test_exposure_does_not_matter() -> None:
    torch.manual_seed(3)
    network = DefocusMap(width=8).eval().requires_grad_(False)
    network.tail.weight.mul_(20.0)  # random, yet far from constant
    image = 0.1 + torch.rand(2, 4, 24, 30)
    deviation = torch.full_like(image, 0.01)
    expected = network(image, deviation)
    assert float(expected.std()) > 0.05
    for factor in (2.0**-6, 8.0, 1024.0):  # only the tiny constant floor rounds differently
        result = network(factor * image, factor * deviation)
        torch.testing.assert_close(result, expected, atol=1e-4, rtol=0)


def test_diameters_are_in_range_and_invert_the_logarithm() -> None:
    diameters = torch.tensor([0.0, 0.5, 3.0, 11.9])
    torch.testing.assert_close(to_diameter(torch.log(diameters + 0.3)), diameters)
    extremes = to_diameter(torch.tensor([-1e4, 1e4, 88.0]))
    assert extremes.tolist() == [0.0, LARGEST, LARGEST]


def test_the_noise_of_four_planes_averages() -> None:
    """The floor is the variance of their mean: a quarter of one plane's, measured."""
    field = torch.from_numpy(np.random.default_rng(2).normal(0, 0.01, (1, 4, 200, 200))).float()
    deviation = torch.full_like(field, 0.01)
    noise_plane = band_features(field, deviation)[:, 8]
    # Bands 0 - 1.5 - 3 - 5.5 - 10 px of white noise: their energies, from the kernels' own pixels.
    kernel = torch.zeros(41, 41)
    kernel[20, 20] = 1.0
    discs = [disc_blur(kernel, d) for d in (0.0, 1.5, 3.0, 5.5, 10.0)]
    energy = sum(float((a - b).square().sum()) for a, b in itertools.pairwise(discs))
    expected = 1.0 + 0.3 * math.log(1 / (1 + energy))
    assert float(noise_plane[..., 20:-20, 20:-20].mean()) == pytest.approx(expected, abs=0.01)
