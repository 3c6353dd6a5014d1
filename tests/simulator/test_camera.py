"""Settings against APEX, ISO 12232 and what cameras show; profiles; the right exposure; files."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import rawpy
import scipy.integrate
import scipy.stats
import torch
from hypothesis import given
from hypothesis import strategies as st

import simulator
from simulator import CameraSimulator, PreparedScene, RawImage, sensor_signal, write_dng
from simulator.camera import BayerPattern, CameraProfile, get_camera, list_cameras
from simulator.camera_files import DARKTABLE_VARIABLE
from simulator.noise.noise_level_function import NoiseLevelFunction, ReadNoise
from simulator.radiance import incident_light
from simulator.raw.develop import srgb_from_camera
from simulator.settings import CameraSettings, exposure_ratio, incident_ev100, snap_exposure_time
from tests.simulator.z6_noise import z6_noise
from tests.strategies import settings_within


@pytest.mark.parametrize(
    ("iso", "exposure_time", "f_number", "ev100"),
    [
        (100, 1.0, 1.0, 0.0),  # the definition
        (100, 1 / 128, 16.0, 15.0),  # the sunny-16 rule
        (800, 1 / 250, 4.0, 4.0 + 7.965784 - 3.0),
        (400, 1 / 125, 5.6, 9.93664),  # log2(5.6^2 * 125) - 2, with the marked f-number
    ],
)
def test_apex_values_add_up(iso, exposure_time, f_number, ev100):
    settings = CameraSettings(iso, exposure_time, f_number)
    assert settings.ev100 == pytest.approx(ev100, abs=1e-4)
    assert settings.speed_value == pytest.approx(5.0 + math.log2(iso / 100))  # Sv 5 is ISO 100
    sums = settings.aperture_value + settings.time_value - settings.speed_value + 5.0
    assert settings.ev100 == pytest.approx(sums, abs=1e-6)  # Ev = Av + Tv, less the gain


# The shutter speeds engraved on cameras, retyped: consecutive third stops, 3 s beside 3.2 s.
ENGRAVED = """8000 6400 5000 4000 3200 2500 2000 1600 1250 1000 800 640 500 400 320 250 200 160 125
100 80 60 50 40 30 25 20 15 13 10 8 6 5 4"""
LONG = "0.3 0.4 0.5 0.6 0.8 1 1.3 1.6 2 2.5 3.2 4 5 6 8 10 13 15 20 25 30"
SPEEDS = [1 / int(n) for n in ENGRAVED.split()] + [float(n) for n in LONG.split()]


def test_engraved_speeds_are_consecutive_third_stops() -> None:
    thirds = [3 * math.log2(snap_exposure_time(speed)) for speed in SPEEDS]
    np.testing.assert_allclose(thirds, np.arange(-39, 16), atol=1e-9)
    assert snap_exposure_time(3.0) == snap_exposure_time(3.2)


@pytest.mark.parametrize("speed", [*SPEEDS, 3.0])
def test_speeds_snap_within_3_percent(speed: float) -> None:
    for edge in (1.03, 0.97):
        inside, outside = (speed * (1 + (edge - 1) * share) for share in (0.9999, 1.0001))
        assert snap_exposure_time(inside) == snap_exposure_time(speed)
        assert snap_exposure_time(outside) == outside


@pytest.mark.parametrize(
    ("source", "target", "ratio"),
    [
        ((100, 1 / 64, 4), (100, 1 / 64, 5.6), 0.5),  # not (4 / 5.6)^2 = 0.5102
        ((100, 1 / 64, 2.8), (100, 1 / 64, 11), 2.0**-4),
        ((100, 1 / 1000, 11), (6400, 1 / 2, 4), 500 * 64 * 8),
        # 1e11 of gain, 1e14 of time, 2048^2 of aperture: a finite float32
        ((1e-3, 1e-9, 1024), (1e8, 1e5, 0.5), 1e25 * 2.0**22),
        ((320, 1 / 50, 3.5), (250, 1 / 30, 6.3), (5 / 3) * (25 / 32) * 2.0 ** ((11 - 16) / 3)),
    ],
)
def test_exposure_ratio_closed_form(source, target, ratio):
    first, second = CameraSettings(*source), CameraSettings(*target)
    assert exposure_ratio(first, second) == pytest.approx(ratio, rel=1e-12)
    assert exposure_ratio(second, first) == pytest.approx(1 / ratio, rel=1e-12)


def test_incident_meter() -> None:
    assert incident_ev100(2.5) == 0.0
    assert incident_ev100(1.0) == pytest.approx(-1.3219, abs=1e-4)
    assert incident_ev100(2.5 * 2**15) == 15.0  # full sun
    for illuminance in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="`illuminance`"):
            incident_ev100(illuminance)


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("iso", 1e-3, 1e8), ("exposure_time", 1e-9, 1e5), ("f_number", 0.5, 1024.0)],
)
def test_ranges_include_their_ends(name: str, low: float, high: float) -> None:
    arguments = {"iso": 100.0, "exposure_time": 0.5, "f_number": 4.0}
    for value in (low, high):
        assert getattr(CameraSettings(**arguments | {name: value}), name) == value
    odd = (0, -1, -0.0, math.nan, math.inf, -math.inf, "fast", "100", b"1", None, [])
    for value in (0.999 * low, 1.001 * high, *odd):
        with pytest.raises(ValueError, match=rf"^`{name}` \(=.*\) must be a number in \["):
            CameraSettings(**arguments | {name: value})


@pytest.mark.parametrize(
    ("exposure_time", "text"),
    [
        *[(1 / 64, "1/64 s"), (0.3, "1/3.333 s"), (0.4, "0.4 s"), (0.5, "1/2 s"), (30.0, "30 s")],
    ],
)
def test_format(exposure_time: float, text: str) -> None:
    assert simulator.settings.format_exposure_time(exposure_time) == text
    assert str(CameraSettings(400, exposure_time, 5.6)) == f"ISO 400, {text}, f/5.6"


SETTINGS = settings_within()


@given(SETTINGS)
def test_exact_stops_stand_for_themselves(settings: CameraSettings) -> None:
    recorded = CameraSettings.from_exif(settings.iso, settings.exposure_time, settings.f_number)
    thirds = -3 * recorded.time_value
    assert recorded == settings or thirds == pytest.approx(round(thirds), abs=1e-12)
    assert abs(thirds + 3 * settings.time_value) < 0.5  # never to the next one
    again = CameraSettings.from_exif(recorded.iso, recorded.exposure_time, recorded.f_number)
    assert again == recorded
    exact = replace(settings, f_number=min(max(settings.effective_f_number, 0.5), 1024.0))
    assert exposure_ratio(settings, exact) == 1.0


# -- camera profiles -------------------------------------------------------------------------------

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
    assert nlf.extrapolation == stops


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "entry"),
    [
        *[("canon_5d4", "CanonEOS5D4"), ("canon_700d", "CanonEOS700D")],
        *[("canon_70d", "CanonEOS70D"), ("nikon_d850", "NikonD850"), ("sony_a7s2", "SonyA7S2")],
    ],
)
def test_elds_cameras_are_its_calibration(data_dir, name, entry):
    """K = Kmin ISO / 100 DN per electron; ln sigma = slope ln K + bias, in DN of 15583."""
    known = json.loads((data_dir / "noise_eld.json").read_text())["cameras"][entry]
    for stop, iso in enumerate((100, 200, 400, 800, 1600, 3200, 6400)):
        # The D850's read noise falls at ISO 400, where its second profile is taken.
        profile = 1 + (name == "nikon_d850" and iso >= 400)
        gain, fits = known["Kmin"] * iso / 100, known[f"Profile-{profile}"]
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
    camera = get_camera("canon_70d")
    half = camera.read_noise(100 * math.sqrt(2), 3)
    assert half.box_factor == 3
    assert half.row == pytest.approx((0.0459616 + camera.read_noise(200).row) / 2)
    assert half.shape == pytest.approx((0.14286 + 0.11429) / 2)
    assert camera.read_noise(50) == ReadNoise(0.0459616, 0.14286)
    d850 = get_camera("nikon_d850")
    assert d850.read_noise(399) == d850.read_noise(200) != d850.read_noise(400)


@pytest.mark.parametrize("name", [*list_cameras(), "nikon_z6 from 700"])
def test_noise_at_every_iso_is_the_nearest_calibrations(name: str) -> None:
    """From ISO 50 to 409600: interpolated by NumPy, scaled beyond, the rounding apart.

    A segment begins at its ISO, not at its first calibration."""
    camera = get_camera(name.partition(" ")[0])
    camera = replace(camera, segments=(700.0,)) if "from" in name else camera
    edges = [0.0, *camera.segments, math.inf]
    rounding = np.repeat([0.0, 1.0], 4) / 12 / camera.span[0] ** 2
    for iso in [699.0, 700.0, 750.0, *np.geomspace(50.0, 409_600.0, 60).tolist()]:
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
    assert camera.nlf(np.float32(800)).extrapolation == 2
    coarse = profile().with_nlf(200, replace(measured, read=(5e-8,) * 4))  # less than its rounding
    assert coarse.nlf(12800).read == pytest.approx((5e-8,) * 4)
    for iso in (0, -100, math.nan, math.inf, "100", np.float16("inf"), 10**400):
        with pytest.raises(ValueError, match="`iso`"):
            camera.nlf(iso)
    with pytest.raises(ValueError, match=r"'bench' has no noise calibration.*estimate_nlf"):
        profile().nlf(100)


def profile(**fields: object) -> CameraProfile:
    defaults = {"name": "bench", "cfa": "RGGB", "black_level": 64, "white_level": 1023}
    return CameraProfile(**(defaults | {"bit_depth": 10} | fields))


def test_levels() -> None:
    camera = profile(black_level=(64, 60.5, 60, 63))
    assert camera.span == (959, 962.5, 963, 960)
    assert camera.pedestal == pytest.approx((64 / 959, 60.5 / 962.5, 60 / 963, 63 / 960))
    assert profile().black_level == (64.0,) * 4
    assert profile().cfa is BayerPattern.RGGB


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        *[({"cfa": "XTRANS"}, "`cfa`"), ({"black_level": (1, 2, 3)}, "`black_level`")],
        *[({"bit_depth": depth}, "`bit_depth`") for depth in (0, 10.5)],
        *[({"black_level": black}, "`white_level`") for black in (-1, (0, 0, 0, 1023))],
        *[({"white_level": white, "bit_depth": 16}, "`white_level`") for white in (70_000, 1022.5)],
    ],
)
def test_bad_profiles_are_refused(fields: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        profile(**fields)


def test_unknown_names_propose_the_nearest() -> None:
    canons, others = ["canon_5d4", "canon_700d", "canon_70d"], ["nikon_d850", "nikon_z6"]
    assert list_cameras() == [*canons, *others, "sony_a7s2"]
    for near in ("nikon_z7", "nikon_d80", "canon_70", "canon_5d3", "sony_a7"):
        with pytest.raises(ValueError, match=f"did you mean '{near[:-1]}"):
            get_camera(near)
    for wrong in ("qqqq", ["nikon_z6"]):
        with pytest.raises(ValueError, match=r"`camera` .*'canon_5d4', .*'sony_a7s2'"):
            get_camera(wrong)


@pytest.mark.parametrize("name", list_cameras())
@given(level=st.floats(0.05, 0.5), iso=st.floats(100, 800), stops=st.integers(1, 3))
def test_more_gain_for_less_time_keeps_brightness_and_adds_noise(name, level, iso, stops):
    """As Android's camera tests have it; shot noise doubles with a stop, read noise at most x 4."""
    base = CameraSettings(iso, 1 / 64, 4)
    other = replace(base, iso=iso * 2**stops, exposure_time=base.exposure_time / 2**stops)
    light = torch.full((4, 64, 64), level)
    scene = PreparedScene(light, base, get_camera(name), NoiseLevelFunction.zero())
    simulator = CameraSimulator(device="cpu", cache=None)
    frames = simulator.prepare(scene).expose([base, other], seed=0, noise="exact").double()
    means, variances = frames.mean(dim=(1, 2, 3)), frames.var(dim=(1, 2, 3))
    error = (variances.max() / light.numel()) ** 0.5
    assert (means - level).abs().max() < 5 * error
    assert 2 ** (0.8 * stops) < variances[1] / variances[0] < 2 ** (2 * stops)


def test_public_names_are_all_there_is() -> None:
    assert dir(simulator) == sorted(simulator.__all__)
    for name in simulator.__all__:
        assert getattr(simulator, name).__name__ == name
    with pytest.raises(AttributeError, match="Raw"):
        simulator.Raw  # noqa: B018


# -- the right exposure where the light is known, bounded, or only likely -------------------------


def test_the_signal_is_openusds_exposure_scale_at_a_responsivity_of_5_6():
    # UsdGeomCamera: responsivity * time * (iso / 100) * 2**exposure / fStop**2, in 1 / nit
    scale = 5.0 / 6.0 * (1 / 64) * (400 / 100.0) / 16.0**2
    assert sensor_signal(30.0, CameraSettings(400, 1 / 64, 16.0)) == pytest.approx(30.0 * scale)


def test_known_light_is_moved_to_within_1_5_ev_of_the_average_meter():
    assert [incident_light.bounded(ev, 5.0) for ev in (2.0, 4.0, 6.4, 9.0)] == [3.5, 4.0, 6.4, 6.5]
    assert incident_light.bounded(9.0, None) == 9.0  # a black frame has no reading
    assert incident_light.IncidentLight(9.0, 0.0, 5.0).right_ev100.tolist() == [6.5]


def test_a_dome_at_a_picture_reads_three_halves_of_the_front_and_some_of_the_back():
    """Even half spheres: a dome has 1.5 pi L of the one it faces, 0.5 pi L of the other; and an
    average meter reads 100 lux of even light on white, 100 / pi cd/m^2, as ISO 12232 has it."""
    luminance = 100.0 / math.pi
    metered = math.log2(luminance / (1.2 * 0.12))  # x = L / (1.2 * 2^EV100) = 0.12
    same = incident_light.picture_illuminance(100.0, metered)
    assert same == pytest.approx(2.0 * math.pi * luminance * 250.0 / 340.0, rel=1e-12)
    black = incident_light.picture_illuminance(100.0, -1000.0)
    assert black == pytest.approx(150.0 * 250.0 / 340.0, rel=1e-12)


@pytest.mark.parametrize(("ev100", "spread"), [(4.8, 0.4), (6.0, 1.2), (2.0, 2.5)])
def test_sixteen_likely_values_stand_for_the_bounded_normal_distribution(ev100, spread):
    """The expected brightness term of any state, against an integral."""
    right = incident_light.IncidentLight(ev100, spread, 5.0).right_ev100
    assert len(right) == 16
    assert (abs(right - 5.0) <= 1.5).all()
    for state in (2.0, 4.0, 5.5, 8.0):

        def brightness(ev, state=state):
            error = np.clip(ev, 3.5, 6.5) - state
            return np.exp(1.0 - np.sqrt(1.0 + error**2))

        density = scipy.stats.norm(ev100, spread).pdf
        grid = np.linspace(ev100 - 9 * spread, ev100 + 9 * spread, 20_001)
        expected = scipy.integrate.simpson(brightness(grid) * density(grid), x=grid)
        assert brightness(right).mean() == pytest.approx(expected, abs=5e-3)


def test_the_posterior_knows_where_the_light_is_but_not_left_from_right():
    rows = torch.linspace(-4.0, 1.0, 64)[:, None].expand(64, 64)
    tilted = torch.exp2(rows + torch.linspace(-1.0, 1.0, 64))
    found = incident_light.features(tilted, 7.5)
    assert found == pytest.approx(incident_light.features(tilted.flip(1), 7.5), abs=1e-6)
    middle = -4.0 + 5.0 * np.array([1, 3, 5, 7]) / 8.0  # of the rows of zones
    assert found[:8].reshape(4, 2).mean(axis=1) == pytest.approx(middle, abs=0.05)
    assert found[8:] == pytest.approx([float((tilted > 1.0).double().mean()), 7.5], abs=0.02)
    own = incident_light.IncidentPosterior(weights=(0.0,) * 9 + (0.5,), offset=-4.0, spread=0.7)
    light = own.infer(tilted, 7.0)
    assert (light.ev100, light.spread, light.reflected_ev100) == (6.5, 0.7, 7.0)


# -- cameras of Raspberry Pi's tuning files and of darktable's noise profiles, both written here ---

CCM = [1.8, -0.6, -0.2, -0.3, 1.6, -0.3, 0.1, -0.7, 1.6]


def tuning(path, slope, constant=0, version=2, **black):
    blocks = {
        "rpi.black_level": {"black_level": 4096, **black},
        "rpi.noise": {"reference_constant": constant, "reference_slope": slope},
        "rpi.awb": {"ct_curve": [3000, 0.6, 0.3, 6000, 0.4, 0.6, 7000, 0.3, 0.8]},
        "rpi.ccm": {"ccms": [{"ct": 3000, "ccm": [1, 0, 0] * 3}, {"ct": 6500, "ccm": CCM}]},
    }
    listed = {"version": 2.0, "algorithms": [{key: value} for key, value in blocks.items()]}
    path.write_text(json.dumps(blocks if version == 1 else listed))
    return f"ctt:{path}"


@pytest.mark.parametrize(("version", "bits"), [(1, 12), (2, 10), (2, 16)])
def test_a_tuned_sensor_has_its_full_well(tmp_path, version, bits):
    """Poisson noise of N electrons at white: the variance is the signal / N on the scale of 1."""
    electrons = 8000
    name = tuning(tmp_path / "IMX9.json", math.sqrt((65535 - 4096) / electrons), version=version)
    camera = get_camera(f"{name}?bits={bits}&cfa=BGGR")
    black = 4096 / 2 ** (16 - bits)
    assert (camera.name, camera.make, camera.model) == ("ctt_imx9", "Raspberry Pi", "IMX9")
    assert (camera.black_level, camera.white_level) == ((black,) * 4, 2**bits - 1)
    nlf = camera.nlf(400)  # gain 4
    assert nlf.shot == pytest.approx((4 / electrons,) * 4, rel=2e-3)  # 1023 * 64 is not 65535
    assert nlf.read == pytest.approx((1 / 12 / (2**bits - 1 - black) ** 2,) * 4)  # rounding


def test_a_constant_becomes_the_nearest_straight_line(tmp_path):
    camera = get_camera(tuning(tmp_path / "a.json", 3.0, 20.0, black_level_b=2048) + "?bits=16")
    assert camera.black_level == (4096, 4096, 4096, 2048)
    for plane, black in ((1, 4096), (3, 2048)):
        signal = np.linspace(0.0, 1.0, 100_001)
        variance = ((20.0 + 3.0 * np.sqrt(signal * (65535 - black))) / (65535 - black)) ** 2
        shot, read = np.polyfit(signal, variance, 1)
        assert camera.nlf(100).shot[plane] == pytest.approx(shot, rel=1e-4)
        assert camera.nlf(100).read[plane] == pytest.approx(read, rel=1e-4)


def test_colours_of_a_tuning_file(tmp_path):
    """White in daylight has the curve's ratios at 6500 K, and balanced colours the matrix."""
    matrix = get_camera(tuning(tmp_path / "a.json", 3.0)).colour_matrix
    np.testing.assert_allclose(np.array(matrix) @ (0.9505, 1.0, 1.089), (0.35, 1, 0.7), rtol=2e-4)
    np.testing.assert_allclose(srgb_from_camera(matrix), np.reshape(CCM, (3, 3)), atol=1e-3)


# -- darktable -------------------------------------------------------------------------------------


def noise_profiles(path, *profiles, maker="Canon", model="EOS 70D"):
    rows = [{"iso": i, "a": [9, a, 9], "b": [9, b, 9], **more} for i, a, b, more in profiles]
    makers = [{"maker": maker, "models": [{"model": model, "profiles": rows}]}]
    path.write_text(json.dumps({"version": 0, "noiseprofiles": makers}))
    return path


def as_darktable_measures(path, nlf, colour):
    """Slope and variance at 0 of Haar's HH of the green of a ramp that LibRaw's PPG demosaicked."""
    size, rng = 1024, np.random.default_rng(0)
    camera = CameraProfile("ramp", "RGGB", 4096, 65535, 16, nlf_by_iso={100.0: nlf})
    light = np.tile([[colour[0], 1.0], [1.0, colour[1]]], (size, size))
    light *= np.linspace(0.02, 0.85, 2 * size)
    noisy = light + rng.standard_normal(light.shape) * np.sqrt(nlf.read[1] + nlf.shot[1] * light)
    numbers = np.clip(np.round(4096 + noisy * (65535 - 4096)), 0, 65535).astype(np.uint16)
    write_dng(path, RawImage.from_mosaic(numbers, CameraSettings(100, 1, 4), camera))
    how = {"gamma": (1, 1), "no_auto_bright": True, "output_bps": 16, "user_wb": [1, 1, 1, 1]}
    how |= {"output_color": rawpy.ColorSpace.raw, "adjust_maximum_thr": 0.0}
    with rawpy.imread(str(path)) as raw:
        rgb = raw.postprocess(demosaic_algorithm=rawpy.DemosaicAlgorithm.PPG, **how)
    green = rgb[8:-8, 8:-8, 1] / 65535
    a, b, c, d = (green[i::2, j::2] for i in (0, 1) for j in (0, 1))
    level, detail = (a + b + c + d) / 4, np.abs(a - b - c + d) / 4
    bins = (level * 300).astype(int)
    middle = [np.median(detail[bins == i]) / 0.6745 for i in range(10, 240)]
    return np.polyfit(np.arange(10.5, 240.0) / 300, np.square(middle), 1)


@pytest.mark.parametrize("colour", [(1.0, 1.0), (0.5, 0.7), (0.4, 0.4)])
def test_noise_comes_back_from_what_darktable_measures(tmp_path, colour):
    nlf = NoiseLevelFunction((1e-4,) * 4, (2e-5,) * 4)
    slope, at_0 = as_darktable_measures(tmp_path / "ramp.dng", nlf, colour)
    path = noise_profiles(tmp_path / "own.json", (100, slope, at_0, {}))
    found = get_camera(f"darktable:Canon EOS 70D?file={path}").nlf(100)
    assert found.shot == pytest.approx(nlf.shot, rel=0.06)
    assert found.read == pytest.approx(nlf.read, rel=0.06)


def test_bodies_of_darktable(tmp_path, monkeypatch):
    rows = [(100, 1e-6, -1e-9, {}), (200, 2e-6, 1e-8, {}), (200, 4e-6, 3e-8, {})]
    path = noise_profiles(tmp_path / "n.json", *rows, (400, 1.0, 1.0, {"skip": True}))
    monkeypatch.setenv(DARKTABLE_VARIABLE, str(path))
    own, camera = get_camera("canon_70d"), get_camera("darktable:canon eos 70d")
    for name in ("cfa", "black_level", "white_level", "colour_matrix", "read_noise_by_iso"):
        assert getattr(camera, name) == getattr(own, name)
    assert sorted(camera.nlf_by_iso) == [100, 200]
    assert camera.nlf(200).shot[0] / camera.nlf(100).shot[0] == pytest.approx(3)
    assert camera.nlf(100).read[0] == pytest.approx(1 / 12 / 2**28)  # rounding to 14 bits
    noise_profiles(path, *rows, maker="Maker", model="New 1")
    new = get_camera("darktable:new-1?black=256&white=4095&bits=12&cfa=GBRG")
    assert (new.make, new.model, new.cfa, new.bit_depth) == ("Maker", "New 1", "GBRG", 12)
    assert (new.black_level[0], new.white_level, new.colour_matrix) == (256, 4095, None)
    assert get_camera("darktable:Maker New 1").white_level == 16383
    settings = CameraSettings(200, 0.01, 4)
    frame = RawImage(np.full((4, 8, 8), 0.2, np.float32), settings, new)
    assert CameraSimulator(device="cpu").simulate(frame, settings).camera == new


@pytest.mark.parametrize(
    ("name", "message"),
    [
        *[("ctt:none.json", "none.json"), ("ctt:b.json", "it lacks 'rpi.noise'")],
        *[("ctt:c.json", "must name a tuning file"), ("ctt:d.json", "cannot be used")],
        *[("emva:none.npz", "none.npz"), ("emva:d.json", "d.json is no .npz")],
        *[("emva:e.npz", "it lacks 'dark'"), ("emva:f.npz", r"must be \(exposures, 2, H, W\)")],
        ("ctt:a.json?bits=7", r"`bits` \(=7\) must be an integer in \[8, 16\]"),
        ("ctt:a.json?bit=12", "did you mean 'bits'"),
        ("darktable:Canon EOS 70", "1 bodies, not 'Canon EOS 70'; did you mean 'Canon EOS 70D'"),
        ("darktable:Canon EOS 70D?white=high", "`white`"),
        ("darktable:Canon EOS 70D?file=b.json", "it lacks 'noiseprofiles'"),
        ("dcraw:Canon EOS 70D", "`camera` .* must be one of 'canon_5d4'"),
    ],
)
def test_errors_name_the_camera(tmp_path, monkeypatch, name, message):
    monkeypatch.chdir(tmp_path)
    tuning(tmp_path / "a.json", 3.0)
    for file, text in (("b.json", "{}"), ("c.json", "[1]"), ("d.json", "{")):
        (tmp_path / file).write_text(text)
    arrays = {"dark": np.zeros((3, 8, 8), np.uint8), "bright_exposure_ns": np.arange(3)}
    np.savez(tmp_path / "e.npz", bright=arrays["dark"])
    np.savez(tmp_path / "f.npz", bright=arrays["dark"], **arrays)
    monkeypatch.setenv(DARKTABLE_VARIABLE, str(noise_profiles(tmp_path / "n.json")))
    with pytest.raises(ValueError, match=message):
        get_camera(name)


def test_where_darktable_is_not_installed(monkeypatch):
    monkeypatch.delenv(DARKTABLE_VARIABLE, raising=False)
    monkeypatch.setattr("simulator.camera_files._INSTALLED", ())
    with pytest.raises(ValueError, match=f"set {DARKTABLE_VARIABLE} to its noiseprofiles.json"):
        get_camera("darktable:Canon EOS 70D")
