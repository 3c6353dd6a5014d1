"""Row-by-row blur against the definitions in `simulator.optics.blur`, and brute force."""

import math

import numpy as np
import pytest
import torch
from scipy import ndimage

from simulator.optics import blur_kernels
from simulator.optics.blur import disc_blur, motion_blur
from simulator.optics.blur_kernels import Blur, blur_many, disc, streak
from simulator.optics.shapes import coverage, disc_kernel, motion_kernel

SHAPES = [(1, 1, 1), (1, 1, 5), (4, 5, 1), (37, 53), (2, 3, 4, 6, 24), (4, 128, 128)]
EXTENTS = [0.02, 0.3, 1.0, 2.0, 2.9, 5.0, 8.0, 17.0, 31.0, 52.0, 130.0, 260.0, 5000.0]
DIAMETERS = [0.1, 0.5, 1.0, 2.0, 3.3, 5.0, 8.0, 12.0, 20.0]


def lamp(*shape: int) -> torch.Tensor:
    """Random light with a lamp 500 times as bright."""
    light = torch.rand(shape, generator=torch.Generator().manual_seed(0)) + 0.01
    light.view(-1)[light.numel() // 2] = 500.0
    return light


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("blur", "plain", "extent"),
    [(streak, motion_blur, e) for e in EXTENTS] + [(disc, disc_blur, d) for d in DIAMETERS],
)
def test_blurs_are_those_in_float64(blur, plain, extent, shape):
    light = lamp(*shape)
    found, wanted = blur(light, extent).numpy(), plain(light.double(), extent).numpy()
    np.testing.assert_allclose(found, wanted, rtol=2e-6 if blur is streak else 5e-6)


@pytest.mark.parametrize(("blur", "extent"), [(streak, 9.0), (disc, 4.0)])
def test_threads_outputs_and_views_change_nothing(blur, extent):
    light = lamp(4, 301, 257)
    alone = blur(light, extent, threads=1)
    out = torch.empty(4, 301, 257)
    assert blur(light, extent, out) is out
    view = torch.stack([light, light], dim=-1)[..., 0]  # not contiguous
    others = [blur(light, extent, threads=threads) for threads in (2, 3)]
    for other in (*others, out, blur(view, extent)):
        assert torch.equal(other, alone)


@pytest.mark.parametrize(("blur", "plain"), [(streak, motion_blur), (disc, disc_blur)])
def test_no_extent_leaves_the_light_as_it_is(blur, plain):
    light = lamp(4, 8, 8)
    assert blur(light, 0.0) is light
    assert plain(light, 0.0) is light
    assert torch.equal(blur(light, 0.0, torch.empty(4, 8, 8)), light)
    assert torch.equal(plain(light, 3.0), blur(light, 3.0))  # what blurs on the CPU


@pytest.mark.parametrize("extent", [3.0, 9.0, 200.0])
def test_light_beyond_the_limit_is_clipped_first(extent):
    light = lamp(4, 16, 24)
    light[0, 3, 4], light[1, 5, 6] = 1e30, -1e30
    limited = light.clamp(-1e9, 1e9).double()
    for blur, plain in [(streak, motion_blur)] + [(disc, disc_blur)] * (extent < 100):
        found = blur(light, extent, limit=1e9).numpy()
        np.testing.assert_allclose(found, plain(limited, extent), rtol=2e-6, atol=300)


@pytest.mark.parametrize("radius", [0.3, 0.5, 0.6, 1.0, 2.49, 2.5, 7.3])
def test_coverage_is_that_of_many_rows_and_columns(radius):
    reach, rows = max(math.ceil(radius - 0.5), 0), 32
    edges = np.arange(-reach, reach + 2) - 0.5
    y = (np.arange((2 * reach + 1) * rows) + 0.5) / rows - reach - 0.5
    chord = np.sqrt(np.maximum(radius**2 - y**2, 0.0))[:, None]
    area = np.diff(np.clip(edges, -chord, chord), axis=1).reshape(2 * reach + 1, rows, -1).sum(1)
    area += area.T
    wanted = (area / area.sum())[reach:, reach:]
    np.testing.assert_allclose(coverage(radius), wanted, atol=1e-14)


@pytest.mark.parametrize("threads", [1, 3])
def test_many_images_are_scipys_correlation(threads):
    extents = [(0.0, 5.0), (3.3, 0.0), (8.0, 17.0), (1e-4, 1e-7), (2.0, 90.0), (0.7, 0.4)]
    blurs = []
    for extent in extents:
        outputs = [torch.empty(4, 21, 40) if each else None for each in extent]
        blurs.append(Blur(torch.rand(4, 21, 40), extent[0], outputs[0], extent[1], outputs[1]))
    blur_many(blurs, threads=threads)
    for light, diameter, defocused, extent, moved in blurs:
        weights = disc_kernel(diameter)[None]
        wanted = ndimage.correlate(light.double().numpy(), weights, mode="nearest")
        if defocused is not None:
            np.testing.assert_allclose(defocused, wanted, rtol=5e-6)
        wanted = ndimage.correlate1d(wanted, motion_kernel(extent), mode="nearest")
        if moved is not None:
            np.testing.assert_allclose(moved, wanted, rtol=1e-5)
    blur_many([])


@pytest.mark.parametrize("extent", [0.0, 5.0])
def test_wide_discs_in_the_fourier_domain_are_those_of_the_sum(monkeypatch, extent):
    light, narrow = torch.rand(4, 64, 48), torch.empty(4, 64, 48)
    light[:, 20, 20], results = 1e6, []
    for widest in (blur_kernels._WIDE_PX, 1e9):
        monkeypatch.setattr(blur_kernels, "_WIDE_PX", widest)
        defocused, moved = torch.empty_like(light), torch.empty_like(light)
        wide = Blur(light, 48.0, defocused, extent, moved if extent else None)
        blur_many([wide, Blur(light, 3.0, narrow)], limit=1e3)
        results.append([defocused, narrow.clone()] + [moved] * bool(extent))
    for fourier, direct in zip(*results, strict=True):
        torch.testing.assert_close(fourier, direct, rtol=1e-4, atol=1e-5)


def test_a_streak_is_the_same_compiled_and_loaded(compiled_and_loaded):
    """A sum of two products may be fused either way, and was: each process chose its own."""
    code = (
        "import torch; from simulator.optics.blur_kernels import _moved, streak\n"
        "light = torch.rand(1, 9, 100, generator=torch.Generator().manual_seed(0))\n"
        "blurred = [streak(light, extent) for extent in (1.3, 5.5, 11.2)]\n"
        "print(*_moved.stats.cache_hits.values(), torch.stack(blurred).numpy().tobytes().hex())\n"
    )
    (compiled,), (hits, loaded) = compiled_and_loaded(code)
    assert (hits, loaded) == ("1", compiled)
