"""Cameras of Raspberry Pi's tuning files and of darktable's noise profiles, both written here."""

import json
import math

import numpy as np
import pytest
import rawpy

from simulator import CameraSettings, CameraSimulator, NoiseLevelFunction, RawImage, write_dng
from simulator.camera import CameraProfile, get_camera
from simulator.camera_files import DARKTABLE_VARIABLE
from simulator.raw.develop import srgb_from_camera

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
