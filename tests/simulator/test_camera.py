"""Camera profiles: calibration numbers, interpolation over ISO, and the colour filter array."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from simulator.camera import BayerPattern, CameraProfile, get_camera, list_cameras
from simulator.noise.noise_level_function import NoiseLevelFunction, ReadNoise
from tests.simulator.z6_noise import z6_noise

#: Variance of rounding to the Z6's digital numbers, on the scale where white is 1.
ROUNDING = 1 / 12 / (15520 - 1008) ** 2


@pytest.mark.parametrize(
    ("iso", "base", "stops"),
    [
        *((iso, iso, 0) for iso in (100, 400, 800, 1600, 6400)),
        # The Z6 switches gain at ISO 800, where read noise falls: nothing is interpolated across.
        *((iso, 400, 0) for iso in (600, 799.99)),
        *((25, 100, -2), (50, 100, -1), (12800, 6400, 1), (409600, 6400, 6)),
    ],
)
def test_z6_is_the_table_and_scales_where_it_has_no_neighbours(iso, base, stops):
    """Shot noise scales with the ISO, read noise before it is rounded with its square."""
    nlf, (shot, read) = get_camera("nikon_z6").nlf(iso), z6_noise(base)
    assert nlf.shot == pytest.approx(iso / base * shot, rel=1e-12)
    assert nlf.read == pytest.approx((iso / base) ** 2 * (read - ROUNDING) + ROUNDING, rel=1e-12)
    assert (nlf.extrapolation, nlf.extrapolated) == (stops, stops != 0)


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "entry", "inferred"),
    [
        ("canon_5d4", "CanonEOS5D4", {}),
        ("canon_700d", "CanonEOS700D", {}),
        ("canon_70d", "CanonEOS70D", {}),
        # Its read noise falls at ISO 400, where its second profile is taken.
        ("nikon_d850", "NikonD850", dict.fromkeys((400, 800, 1600, 3200, 6400), "Profile-2")),
        ("sony_a7s2", "SonyA7S2", {}),
    ],
)
def test_elds_cameras_are_its_calibration(data_dir, name, entry, inferred):
    """K = Kmin ISO / 100 DN per electron; ln sigma = slope ln K + bias, in DN of 15583."""
    known = json.loads((data_dir / "noise_eld.json").read_text())["cameras"][entry]
    for stop, iso in enumerate((100, 200, 400, 800, 1600, 3200, 6400)):
        gain, fits = known["Kmin"] * iso / 100, known[inferred.get(iso, "Profile-1")]
        sigma, row = (
            math.exp(fits[key]["slope"] * math.log(gain) + fits[key]["bias"])
            for key in ("g_scale", "R_scale")
        )
        nlf, read_noise = get_camera(name).nlf(iso), get_camera(name).read_noise(iso)
        assert nlf.shot == pytest.approx((gain / 15583,) * 4, rel=1e-5)
        assert nlf.read == pytest.approx(((sigma / 15583) ** 2,) * 4, rel=5e-4)  # the 70D's digits
        assert read_noise.row * sigma == pytest.approx(row, rel=1e-5)
        assert read_noise.shape == pytest.approx(sum(known["G_shape"][2 * stop : 2 * stop + 2]) / 2)


def test_row_noise_between_the_calibrated_isos() -> None:
    """Over log ISO, inside a segment; in the 70D's table at 100 and 200, the D850's at 200."""
    half, low = (
        get_camera("canon_70d").read_noise(100 * math.sqrt(2), 3),
        ReadNoise(0.0459616, 0.14286),
    )
    assert half.box_factor == 3
    assert half.row == pytest.approx((0.0459616 + get_camera("canon_70d").read_noise(200).row) / 2)
    assert half.shape == pytest.approx((0.14286 + 0.11429) / 2)
    assert get_camera("canon_70d").read_noise(50) == low
    d850 = get_camera("nikon_d850")
    assert d850.read_noise(399) == d850.read_noise(200) != d850.read_noise(400)


def test_a_segment_begins_at_its_iso_not_at_its_first_calibration() -> None:
    camera = replace(get_camera("nikon_z6"), segments=(700.0,))
    for iso, base, read in ((699, 400, 5.22487909303224e-08), (750, 800, 2.22569604502207e-08)):
        scaled = (iso / base) ** 2 * (read - ROUNDING) + ROUNDING
        assert camera.nlf(iso).read[1] == pytest.approx(scaled)
    assert camera.nlf(750).shot[1] == pytest.approx(750 / 800 * 6.19623102159152e-05)


@pytest.mark.parametrize("name", list_cameras())
def test_noise_at_every_iso_is_the_nearest_calibrations(name: str) -> None:
    """From ISO 50 to 409600: interpolated by NumPy, scaled beyond, the rounding apart."""
    camera = get_camera(name)
    edges = [0.0, *camera.segments, math.inf]
    rounding = np.repeat([0.0, 1.0], 4) / 12 / camera.span[0] ** 2
    for iso in np.geomspace(50.0, 409_600.0, 60).tolist():
        low, high = max(e for e in edges if e <= iso), min(e for e in edges if e > iso)
        own = [i for i in sorted(camera.nlf_by_iso) if low <= i < high]
        known = np.array([[*n.shot, *n.read] for n in map(camera.nlf, own)])
        logs = [np.interp(math.log(iso), np.log(own), column) for column in np.log(known).T]
        beyond = iso / min(max(iso, own[0]), own[-1])
        wanted = (np.exp(logs) - rounding) * np.repeat([beyond, beyond**2], 4) + rounding
        found = camera.nlf(iso)
        assert [*found.shot, *found.read] == pytest.approx(wanted.tolist(), rel=1e-12)


def test_one_measurement_calibrates_a_camera() -> None:
    measured = NoiseLevelFunction((1e-4,) * 4, (1e-6,) * 4)
    camera = get_camera("nikon_z6").with_nlf(200, measured)
    assert camera.nlf(200) == measured
    assert camera.nlf(800).read == pytest.approx((16e-6 - 15 * ROUNDING,) * 4)
    assert camera.nlf(800).extrapolation == 2
    coarse = profile().with_nlf(200, replace(measured, read=(5e-8,) * 4))  # less than its rounding
    assert coarse.nlf(12800).read == pytest.approx((5e-8,) * 4)


def profile(**fields: object) -> CameraProfile:
    defaults = {"name": "bench", "cfa": "RGGB", "black_level": 64, "white_level": 1023}
    return CameraProfile(**(defaults | {"bit_depth": 10} | fields))


def test_levels_and_full_well() -> None:
    camera = profile(black_level=(64, 60.5, 60, 63))
    assert camera.span == (959, 962.5, 963, 960)
    assert camera.pedestal == pytest.approx((64 / 959, 60.5 / 962.5, 60 / 963, 63 / 960))
    assert profile().black_level == (64.0,) * 4
    assert profile().cfa is BayerPattern.RGGB
    z6 = get_camera("nikon_z6")
    assert z6.span == (15520 - 1008,) * 4
    assert z6.pedestal == pytest.approx((1008 / 14512,) * 4)
    assert z6.full_well == pytest.approx(133_827, abs=1)  # 1 / 7.472343e-6
    assert get_camera("canon_70d").full_well == pytest.approx(15583 / 0.4075, rel=1e-4)
    assert profile().full_well is None


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"cfa": "XTRANS"}, "`cfa`"),
        ({"black_level": (1, 2, 3)}, "`black_level`"),
        ({"black_level": -1}, "`white_level`"),
        ({"black_level": (0, 0, 0, 1023)}, "`white_level`"),
        ({"white_level": 70_000, "bit_depth": 16}, "`white_level`"),
        ({"bit_depth": 0}, "`bit_depth`"),
        ({"bit_depth": 10.5}, "`bit_depth`"),
        ({"white_level": 1022.5}, "`white_level`"),
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
    canons, others = ["canon_5d4", "canon_700d", "canon_70d"], ["nikon_d850", "nikon_z6"]
    assert list_cameras() == [*canons, *others, "sony_a7s2"]
    for near in ("nikon_z7", "nikon_d80", "canon_70", "canon_5d3", "sony_a7"):
        with pytest.raises(ValueError, match=f"did you mean '{near[:-1]}"):
            get_camera(near)
    for wrong in ("qqqq", ["nikon_z6"]):
        with pytest.raises(ValueError, match=r"`camera` .*'canon_5d4', .*'sony_a7s2'"):
            get_camera(wrong)


# -- for any input --------------------------------------------------------------------
