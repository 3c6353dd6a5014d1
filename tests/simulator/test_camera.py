"""Camera profiles: calibration numbers, interpolation over ISO, and the colour filter array."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError, replace
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from simulator.camera import BayerPattern, CameraProfile, get_camera, list_cameras
from simulator.noise.noise_level_function import NoiseLevelFunction
from tests.simulator.z6_noise import z6_noise
from tests.strategies import log_uniform


@pytest.mark.parametrize(
    ("iso", "base", "extrapolated"),
    [
        *((iso, iso, False) for iso in (100, 400, 800, 1600, 6400)),
        # The Z6 switches gain at ISO 800, where read noise falls: nothing is interpolated across.
        *((iso, 400, False) for iso in (600, 799.99)),
        *((iso, 100, True) for iso in (25, 50)),
        *((iso, 6400, True) for iso in (12800, 409600)),
    ],
)
def test_z6_is_the_table_and_scales_where_it_has_no_neighbours(
    iso: float, base: int, extrapolated: bool
) -> None:
    """Shot noise scales with the ISO, read noise with its square."""
    nlf, (shot, read) = get_camera("nikon_z6").nlf(iso), z6_noise(base)
    assert nlf.shot == pytest.approx(iso / base * shot, rel=1e-12)
    assert nlf.read == pytest.approx((iso / base) ** 2 * read, rel=1e-12)
    assert nlf.extrapolated is extrapolated


@pytest.mark.parametrize("iso", [100, 200, 400, 800, 1600, 3200, 6400])
def test_70d_is_the_eld_calibration(iso: int) -> None:
    """K = 0.4075 ISO / 100 DN per electron, ln sigma = 0.5681 ln K + 1.9983 DN, to their digits."""
    gain = 0.4075 * iso / 100
    sigma = math.exp(0.5681 * math.log(gain) + 1.9983)
    nlf = get_camera("canon_70d").nlf(iso)
    assert nlf.shot == pytest.approx((gain / 15583,) * 4, rel=1e-4)
    assert nlf.read == pytest.approx(((sigma / 15583) ** 2,) * 4, rel=5e-4)


def test_interpolation_is_log_log_inside_a_segment() -> None:
    """282.84 lies half-way between ISO 200 and 400: each value is their geometric mean."""
    nlf = get_camera("nikon_z6").nlf(200 * math.sqrt(2))
    assert nlf.shot[1] == pytest.approx(2.1815e-05, rel=1e-4)  # sqrt(1.53704e-5 * 3.09621e-5)
    assert nlf.read[1] == pytest.approx(3.4856e-08, rel=1e-4)  # sqrt(2.32535e-8 * 5.22488e-8)
    assert not nlf.extrapolated
    # Two thirds of the way from 800 to 1000 in log ISO.
    nlf = get_camera("nikon_z6").nlf(800 ** (1 / 3) * 1000 ** (2 / 3))
    red = 6.47394522011139e-05 ** (1 / 3) * 8.31208514534218e-05 ** (2 / 3)
    assert nlf.shot[0] == pytest.approx(red, rel=1e-9)


def test_a_segment_begins_at_its_iso_not_at_its_first_calibration() -> None:
    camera = replace(get_camera("nikon_z6"), segments=(700.0,))
    assert camera.nlf(699).read[1] == pytest.approx((699 / 400) ** 2 * 5.22487909303224e-08)
    assert camera.nlf(750).read[1] == pytest.approx((750 / 800) ** 2 * 2.22569604502207e-08)
    assert camera.nlf(750).shot[1] == pytest.approx(750 / 800 * 6.19623102159152e-05)


def test_one_measurement_calibrates_a_camera() -> None:
    measured = NoiseLevelFunction((1e-4,) * 4, (1e-6,) * 4)
    camera = get_camera("nikon_z6").with_nlf(200, measured)
    assert camera.nlf(200) == measured
    assert camera.nlf(800).read == pytest.approx((16e-6,) * 4)
    assert camera.nlf(800).extrapolated


@pytest.mark.parametrize(
    ("pattern", "offsets"),
    [
        ("RGGB", ((0, 0), (0, 1), (1, 0), (1, 1))),
        ("BGGR", ((1, 1), (1, 0), (0, 1), (0, 0))),
        ("GRBG", ((0, 1), (0, 0), (1, 1), (1, 0))),
        ("GBRG", ((1, 0), (1, 1), (0, 0), (0, 1))),
    ],
)
def test_cfa_offsets(pattern: str, offsets: tuple[tuple[int, int], ...]) -> None:
    """R, G1 on red's row, G2 on blue's row, B."""
    assert BayerPattern(pattern).offsets == offsets


def profile(**fields: object) -> CameraProfile:
    defaults = {"name": "bench", "cfa": "RGGB", "black_level": 64, "white_level": 1023}
    return CameraProfile(**(defaults | {"bit_depth": 10} | fields))  # type: ignore[arg-type]


def test_levels() -> None:
    camera = profile(black_level=(64, 60.5, 60, 63))
    assert camera.span == (959, 962.5, 963, 960)
    assert camera.pedestal == pytest.approx((64 / 959, 60.5 / 962.5, 60 / 963, 63 / 960))
    assert profile().black_level == (64.0,) * 4
    assert profile().cfa is BayerPattern.RGGB
    z6 = get_camera("nikon_z6")
    assert z6.span == (15520 - 1008,) * 4
    assert z6.pedestal == pytest.approx((1008 / 14512,) * 4)


def test_full_well() -> None:
    assert get_camera("nikon_z6").full_well == pytest.approx(133_827, abs=1)  # 1 / 7.472343e-6
    assert get_camera("canon_70d").full_well == pytest.approx(15583 / 0.4075, rel=1e-4)
    assert profile().full_well is None


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"cfa": "XTRANS"}, r"`cfa` \(='XTRANS'\) must be one of RGGB, BGGR, GRBG, GBRG"),
        ({"black_level": (1, 2, 3)}, "`black_level`"),
        ({"black_level": -1}, "`white_level`"),
        ({"black_level": (0, 0, 0, 1023)}, "`white_level`"),
        ({"white_level": 70_000, "bit_depth": 16}, "must fit in 16 bits"),
        ({"white_level": math.nan}, "`white_level`"),
        ({"black_level": math.nan}, "`white_level`"),
        ({"bit_depth": 0}, "`bit_depth`"),
        ({"bit_depth": 17}, "`bit_depth`"),
        ({"bit_depth": 10.5}, "`bit_depth`"),
        ({"white_level": 1022.5}, "must be a whole number"),
    ],
)
def test_bad_profiles_are_refused(fields: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        profile(**fields)


@pytest.mark.parametrize("iso", [0, -100, math.nan, math.inf, "100"])
def test_bad_iso(iso: Any) -> None:
    with pytest.raises(ValueError, match="`iso`"):
        get_camera("nikon_z6").nlf(iso)
    with pytest.raises(ValueError, match=r"'bench' has no noise calibration.*estimate_nlf"):
        profile().nlf(100)


def test_unknown_names_propose_the_nearest() -> None:
    assert list_cameras() == ["canon_70d", "nikon_z6"]
    with pytest.raises(ValueError, match="did you mean 'nikon_z6'"):
        get_camera("nikon_z7")
    for wrong in ("qqqq", ["nikon_z6"]):
        with pytest.raises(ValueError, match=r"must be one of \['canon_70d', 'nikon_z6'\]"):
            get_camera(wrong)  # type: ignore[arg-type]


def test_profiles_are_hashable_values() -> None:
    camera = get_camera("nikon_z6")
    assert hash(camera) == hash(replace(camera))
    assert camera == replace(camera)
    assert camera != replace(camera, white_level=16383)
    with pytest.raises(FrozenInstanceError):
        camera.name = "other"  # type: ignore[misc]


# -- for any input --------------------------------------------------------------------


@given(st.sampled_from(["nikon_z6", "canon_70d"]), log_uniform(1e-3, 1e8), log_uniform(1, 4))
def test_noise_grows_with_iso_within_a_conversion_gain(name: str, iso: float, more: float) -> None:
    camera = get_camera(name)
    higher = iso * more
    assume(not any(iso < start <= higher for start in camera.segments))
    nlf, noisier = camera.nlf(iso), camera.nlf(higher)
    assert nlf.extrapolated == (not min(camera.nlf_by_iso) <= iso <= max(camera.nlf_by_iso))
    for low, high in zip((*nlf.shot, *nlf.read), (*noisier.shot, *noisier.read), strict=True):
        assert 0.0 < low <= high * (1 + 1e-12)
    assert nlf.exposed(more).scaled(1 / 4).shot == pytest.approx([s * more / 4 for s in nlf.shot])
