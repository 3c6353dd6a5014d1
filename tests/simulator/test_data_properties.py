"""Properties of files, pictures and lamps that hold for any bodies, shapes and settings."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import assume, example, given
from hypothesis import strategies as st

from simulator import CameraSettings, RawImage, get_camera, list_cameras, read_raw, write_dng
from simulator.camera import CameraProfile
from simulator.optics.lamps import Flash, Lamp, MainsLamp, PulsedLamp
from simulator.raw.demosaic import demosaic_malvar
from simulator.raw.develop import develop, render_srgb
from simulator.raw.image import pack_mosaic, unpack_mosaic
from tests.strategies import (
    SEEDS,
    SHAPES,
    Mosaic,
    cameras,
    lights,
    log_uniform,
    mosaics,
    settings_within,
)

# -- mosaics and files ----------------------------------------------------------------------------


@given(mosaics(cameras()), st.booleans(), st.booleans())
def test_packing_and_unpacking_invert(mosaic: Mosaic, odd: bool, as_float: bool) -> None:
    camera, numbers = mosaic
    given_numbers = np.pad(numbers, ((0, odd), (0, odd))).astype(float if as_float else np.uint16)
    packed = pack_mosaic(given_numbers, camera)
    assert packed.shape == (4, numbers.shape[0] // 2, numbers.shape[1] // 2)
    np.testing.assert_array_equal(unpack_mosaic(packed, camera), numbers)
    for plane, letter in enumerate("RGGB"):  # each plane is where the camera says
        row, column = camera.cfa.offsets[plane]
        assert camera.cfa.value[2 * row + column] == letter
        levels = (camera.black_level[plane], camera.span[plane])
        wanted = (numbers[row::2, column::2] - levels[0]) / levels[1]
        np.testing.assert_array_equal(packed[plane].numpy(), wanted.astype(np.float32))


@st.composite
def bodies(draw: st.DrawFn) -> CameraProfile:
    """Any body, or a real one with any order of its colours."""
    body = draw(cameras())
    name = draw(st.sampled_from([None, *list_cameras()]))
    return body if name is None else replace(get_camera(name), cfa=body.cfa)


@given(
    mosaics(bodies()),
    st.one_of(settings_within(), settings_within(iso=(1e-3, 0.5))),  # EXIF says ISO 1 at least
    st.tuples(log_uniform(1 / 64, 64), st.just(1.0), log_uniform(1 / 64, 64)),
    st.integers(1, 16),
)
def test_dng_writing_and_reading_invert(
    tmp_path: Path,
    mosaic: Mosaic,
    settings: CameraSettings,
    white_balance: tuple[float, float, float],
    box_factor: int,
) -> None:
    camera, numbers = mosaic
    nlf = camera.nlf(settings.iso)
    assume(max(*nlf.shot, *nlf.read) <= 1.0)  # more is taken for damage
    raw = RawImage.from_mosaic(
        numbers, settings, camera, white_balance=white_balance, box_factor=box_factor
    )
    write_dng(tmp_path / "a.dng", raw)
    back = read_raw(tmp_path / "a.dng")
    np.testing.assert_array_equal(back.to_mosaic(), numbers)
    assert torch.equal(back.data, raw.data)
    assert (back.settings, back.box_factor) == (settings, box_factor)
    for name in ("cfa", "black_level", "white_level"):
        assert getattr(back.camera, name) == getattr(camera, name)
    assert back.white_balance == pytest.approx(white_balance, rel=1e-6)
    for name in ("shot", "read"):
        red, first, second, blue = getattr(raw.noise, name)
        green = (first + second) / 2  # a file has one pair for both
        assert getattr(back.noise, name) == pytest.approx((red, green, green, blue), rel=1e-12)


# -- development ----------------------------------------------------------------------------------

#: What a mirror image of each order is.
MIRRORED = {"RGGB": "GRBG", "GRBG": "RGGB", "BGGR": "GBRG", "GBRG": "BGGR"}


@given(SHAPES, st.sampled_from(sorted(MIRRORED)), SEEDS)
def test_demosaicing_mirrors_with_the_mosaic(shape: tuple[int, int], cfa: str, seed: int) -> None:
    height, width = (max(2, n) for n in shape)
    packed = torch.rand(2, 4, height, width, generator=torch.Generator().manual_seed(seed)).double()
    rgb = demosaic_malvar(packed, cfa)
    mirrored = demosaic_malvar(packed.flip(3), MIRRORED[cfa])
    torch.testing.assert_close(mirrored.flip(3), rgb, rtol=0, atol=1e-14)
    turned = {"RGGB": "RGGB", "BGGR": "BGGR", "GRBG": "GBRG", "GBRG": "GRBG"}[cfa]
    across = demosaic_malvar(packed[:, [0, 2, 1, 3]].transpose(2, 3), turned)
    torch.testing.assert_close(across.transpose(2, 3), rgb, rtol=0, atol=1e-14)
    assert torch.equal(demosaic_malvar(packed.flip(0), cfa).flip(0), rgb)
    flat = demosaic_malvar(torch.full_like(packed, 0.3), cfa)
    torch.testing.assert_close(flat, torch.full_like(flat, 0.3), rtol=0, atol=1e-14)


@example(torch.zeros(4, 1, 1), (1e-30, 1.0, 1e30), "linear")  # gains further apart than float32
@given(
    lights(),
    st.tuples(*[log_uniform(1e-30, 1e30)] * 3),
    st.sampled_from(["linear", "photographic"]),
)
def test_developing_keeps_to_the_range(
    light: torch.Tensor, white_balance: tuple[float, float, float], tone: str
) -> None:
    camera = get_camera("nikon_z6")
    matrix = camera.colour_matrix
    rgb = develop(light[None], white_balance, matrix, tone=tone)
    assert bool(((rgb >= 0) & (rgb <= 1)).all())
    twice = develop(torch.stack([light.flip(2), light]), white_balance, matrix, tone=tone)
    torch.testing.assert_close(twice[1], rgb[0], rtol=0, atol=1e-6)
    torch.testing.assert_close(twice[0].flip(2), rgb[0], rtol=0, atol=1e-6)
    raw = RawImage(light, CameraSettings(100, 0.01, 4), camera, white_balance=white_balance)
    assert render_srgb(raw, tone=tone).shape == (3, 2 * light.shape[1], 2 * light.shape[2])


# -- lamps ----------------------------------------------------------------------------------------

PHASES = st.floats(0.0, 1.0)
LAMPS = st.one_of(
    st.builds(Lamp),
    st.builds(MainsLamp, log_uniform(1, 1e5), st.floats(0, 1), PHASES),
    st.builds(PulsedLamp, log_uniform(1, 1e5), log_uniform(1e-6, 1), PHASES),
    st.builds(Flash, st.floats(-1, 1), log_uniform(1e-6, 1), log_uniform(1e-6, 10)),
)


@given(LAMPS, st.floats(-10, 10), log_uniform(1e-6, 10), log_uniform(1e-6, 10))
def test_lamps_add_up_over_time(lamp: Lamp, start: float, first: float, second: float) -> None:
    def light(begin: float, time: float) -> float:
        mean = float(lamp.mean_light(begin, time))
        assert math.isfinite(mean)
        assert mean >= 0.0
        return mean * time

    parts = light(start, first) + light(start + first, second)
    whole = light(start, first + second)
    # A moment is known to an ulp of 16 s: so the light at both ends of a part, at its brightest.
    assert parts == pytest.approx(whole, rel=1e-12, abs=8 * 2.0**-48 * _brightest(lamp))


def _brightest(lamp: Lamp) -> float:
    if isinstance(lamp, PulsedLamp):
        return 1.0 / lamp.duty
    return 1.0 + lamp.energy / lamp.decay if isinstance(lamp, Flash) else 2.0


@given(LAMPS, st.floats(-10, 10))
def test_long_exposures_see_the_mean(lamp: Lamp, start: float) -> None:
    bound = 2e-6 * max(1.0, getattr(lamp, "energy", 0.0))
    assert float(lamp.mean_light(start, 1e6)) == pytest.approx(1.0, abs=bound)


@given(log_uniform(1e-3, 1e9), PHASES, st.floats(-1e3, 1e3), log_uniform(1e-9, 1e6))
def test_a_pulse_as_long_as_its_period_is_steady(
    frequency: float, phase: float, start: float, time: float
) -> None:
    lamp = PulsedLamp(frequency, 1.0, phase)
    assert float(lamp.mean_light(start, time)) == pytest.approx(1.0, abs=1e-12)
