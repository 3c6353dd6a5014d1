"""Thin-lens defocus against geometry: similar triangles, areas of discs, rays through an aperture.

Nothing here uses the layers that the code under test works with: expected pictures are sums over
points of the aperture, each of which sees two planes through its own pinhole.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch

from simulator.optics.thin_lens import Lens, defocus


@pytest.mark.parametrize("focus", [0.5, 2.0, 30.0])
@pytest.mark.parametrize("depth", [0.3, 1.0, 2.0, 500.0])
def test_circle_of_confusion_follows_from_similar_triangles(focus, depth):
    # The cone from the aperture (diameter f / N) converges at v, the sensor stands at v_focus.
    v, v_focus = (1.0 / (1.0 / 0.05 - 1.0 / distance) for distance in (depth, focus))
    expected = (0.05 / 2.8) * (v_focus - v) / v
    found = Lens(0.05, focus).circle_of_confusion(depth, 2.8)
    assert found == pytest.approx(expected, rel=1e-12, abs=1e-18)


def test_circle_of_confusion_of_far_points():
    # Focused at infinity: f^2 / (N z). Focused at s, a point at infinity: f^2 / (N (s - f)).
    assert Lens(0.05, math.inf).circle_of_confusion(10.0, 4.0) == pytest.approx(-0.0025 / 40)
    assert Lens(0.05, math.inf).circle_of_confusion(math.inf, 4.0) == 0.0
    assert Lens(0.05, 2.05).circle_of_confusion(math.inf, 4.0) == pytest.approx(0.0025 / 8)


@pytest.mark.parametrize(
    ("values", "name"),
    [((bad, math.inf), "focal_length") for bad in (0.0, math.inf, math.nan)]
    + [((0.05, bad), "focus_distance") for bad in (0.05, -1.0, math.nan)],
)
def test_lens_refuses(values, name):
    with pytest.raises(ValueError, match=f"`{name}`.*must be"):
        Lens(*values)


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("diameter", [0.4, 1.0, 2.7, 6.3, 14.0])
def test_point_source_becomes_its_disc(diameter, sign):
    lamp = torch.zeros(1, 41, 41, dtype=torch.float64)
    lamp[0, 20, 20] = 1.0
    spread = defocus(lamp, torch.full((41, 41), sign * diameter, dtype=torch.float64))[0].numpy()
    assert spread.sum() == pytest.approx(1.0, abs=1e-9)
    offset = np.arange(41) - 20
    for marginal in (spread.sum(0), spread.sum(1)):  # of a uniform disc: d^2 / 16
        assert marginal @ offset**2 == pytest.approx(diameter**2 / 16, rel=0.01)
    radius = np.hypot(offset[:, None], offset[None, :])
    assert np.abs(spread[radius > diameter / 2 + 1]).max() < 1e-12
    if diameter > 4:
        inside = spread[radius < diameter / 2 - 1]
        np.testing.assert_allclose(inside, 4 / (math.pi * diameter**2), rtol=0.05)


def test_blur_too_small_to_see_leaves_every_bit():
    light = torch.rand(4, 9, 13, generator=torch.Generator().manual_seed(0))
    ripple = 0.1 * torch.rand(9, 13, generator=torch.Generator().manual_seed(1))
    assert torch.equal(defocus(light, ripple - 0.05), light)


@pytest.mark.parametrize("case", ["step", "ramp", "through_focus", "stairs", "noise", "islands"])
def test_equal_light_shows_no_seam(case):
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[:48, :40]
    diameter = {
        "step": np.where(columns < 20, -7.0, 5.0),
        "ramp": 1.0 + columns * 0.2,
        "through_focus": (columns - 20) * 0.3,
        "stairs": (columns // 8) * 3.0 - 6.0,
        "noise": rng.uniform(-8.0, 8.0, (48, 40)),
        "islands": np.where((rows // 6 + columns // 6) % 2 == 0, 0.0, 9.0),
    }[case]
    level = torch.tensor([0.2, 3.0])[:, None, None].expand(2, 48, 40)
    found = defocus(level, torch.from_numpy(diameter))
    torch.testing.assert_close(found, level.contiguous(), rtol=2e-6, atol=0.0)


@pytest.mark.parametrize("row", range(20, 44, 3))
def test_lamp_on_a_receding_floor_keeps_its_energy(row):
    # The floor rises through many layers of blur; none of them stands in the way of its neighbour.
    diameter = torch.linspace(10, 2, 64, dtype=torch.float64)[:, None].expand(64, 48)
    floor = torch.full((1, 64, 48), 0.2, dtype=torch.float64)
    lit = floor.clone()
    lit[0, row, 24] += 100.0
    gained = float((defocus(lit, diameter) - defocus(floor, diameter)).sum())
    assert gained == pytest.approx(100.0, rel=0.05)


def test_sharp_foreground_is_untouched_by_a_bright_blurred_background():
    near = np.broadcast_to(np.arange(60) < 30, (40, 60))
    low, high = np.where(near, 0.01, 50.0), np.where(near, 0.1, 900.0)
    drawn = np.random.default_rng(0).uniform(low, high, (4, 40, 60))
    light = torch.from_numpy(drawn.astype(np.float32))
    found = defocus(light, torch.from_numpy(np.where(near, 0.0, 13.0)))
    assert torch.equal(found[:, :, :30], light[:, :, :30])
    assert float(found[:, :, 30:].min()) > 50.0  # nor does the dark foreground spill over


def test_what_a_blurred_foreground_hides_is_continued():
    # Stripes across the edge go on behind the foreground, and show through its blurred border. The
    # sides of the focus are exchanged here: a sign error would swap this test and the one before.
    rows, columns = np.mgrid[:40, :60]
    stripes = 1.0 + (rows // 4 % 2)
    light = torch.from_numpy(np.where(columns < 30, 0.0, stripes))[None]
    found = defocus(light, torch.from_numpy(np.where(columns < 30, -10.0, 0.0)))[0].numpy()
    # Share of a disc of 10 pixels beyond a chord between columns 29 and 30.
    x = np.clip((np.arange(60) - 29.5) / 5, -1, 1)
    beyond = 1 - (np.arccos(x) - x * np.sqrt(1 - x * x)) / math.pi
    np.testing.assert_allclose(found[8:32], (beyond * stripes)[8:32], atol=0.01)


Texture = Callable[[np.ndarray, np.ndarray], np.ndarray]


def light_of_planes(hides: np.ndarray, near: Sequence, far: Sequence) -> np.ndarray:
    """Each plane's texture at its own rows and columns."""
    nearer = 0.5 + 0.3 * np.sin(near[0] * 0.9) * np.cos(near[1] * 0.7)
    farther = 3.0 + 1.5 * np.sin(far[0] * 0.25 + 1.0) + 0.5 * np.cos(far[1] * 0.25)
    return np.where(hides, nearer, farther)


def through_an_aperture(shape: Texture, near_blur: float, far_blur: float) -> np.ndarray:
    """What the sensor gets of two planes: a mean over aperture points and points of a pixel."""
    grid = (np.arange(20) + 0.5) / 10 - 1
    aperture = [(a, b) for a in grid for b in grid if a * a + b * b < 1]
    rows, columns = np.mgrid[:56, :72].astype(float)
    total = np.zeros(rows.shape)
    for number, (a, b) in enumerate(aperture):
        y, x = rows + (number * 0.618) % 1 - 0.5, columns + (number * 0.755) % 1 - 0.5
        near, far = ((y - blur / 2 * a, x - blur / 2 * b) for blur in (near_blur, far_blur))
        hides = shape(np.rint(near[0]), np.rint(near[1]))  # the edge of a mask of whole pixels
        total += light_of_planes(hides, near, far)
    return total / len(aperture)


SHAPES: dict[str, Texture] = {
    "half": lambda rows, columns: columns < 36,
    "pole": lambda rows, columns: abs(columns - 36) < 3,
    "disc": lambda rows, columns: (columns - 36) ** 2 + (rows - 28) ** 2 < 13**2,
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("blurs", [(0, 8), (-8, 0), (4, 10), (-10, -4), (-8, 8), (-8, 4)])
def test_two_planes_against_rays(shape, blurs):
    # What is hidden is not in the picture: it can be right only as far as the texture is smooth.
    rows, columns = np.mgrid[:56, :72]
    mask = SHAPES[shape](rows, columns)
    picture = light_of_planes(mask, (rows, columns), (rows, columns))
    diameter = torch.from_numpy(np.where(mask, *map(float, blurs)))
    found = defocus(torch.from_numpy(picture)[None], diameter)[0].numpy()
    expected = through_an_aperture(SHAPES[shape], *blurs)
    errors = ((image - expected)[10:-10, 10:-10] for image in (found, picture))
    error, change = map(np.linalg.norm, errors)
    assert error < 0.15 * change
