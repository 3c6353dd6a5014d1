"""Packed raws, DNG files that come back, and blind estimates of noise that was put in."""

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rawpy
import skimage.data
import tifffile
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from simulator import CameraSettings, NoiseLevelFunction, RawImage, estimate_nlf, read_raw
from simulator.camera import BayerPattern, CameraProfile, get_camera, list_cameras
from simulator.raw.dng import DEFAULT_COLOUR_MATRIX, write_dng
from simulator.raw.image import pack_mosaic, unpack_mosaic
from tests.strategies import cameras, log_uniform, mosaics, settings_within

SETTINGS = CameraSettings(100, 1 / 64, 4.0)
BLACK = (64.0, 60.25, 59.5, 63.0)  # R, G1, G2, B


def camera(cfa: str = "RGGB", black: tuple[float, ...] | float = BLACK) -> CameraProfile:
    return CameraProfile("bench", cfa, black, 4095, 12)


@given(mosaics(cameras()), st.booleans(), st.booleans())
def test_packing_and_unpacking_invert(mosaic, odd, as_float):
    profile, numbers = mosaic
    given_numbers = np.pad(numbers, ((0, odd), (0, odd))).astype(float if as_float else np.uint16)
    packed = pack_mosaic(given_numbers, profile)
    assert packed.shape == (4, numbers.shape[0] // 2, numbers.shape[1] // 2)
    np.testing.assert_array_equal(unpack_mosaic(packed, profile), numbers)
    raw = RawImage.from_mosaic(given_numbers, SETTINGS, profile)
    np.testing.assert_array_equal(raw.to_mosaic(), numbers)
    first = len(numbers) // 4  # a part of the rows
    np.testing.assert_array_equal(unpack_mosaic(packed, profile, first), numbers[2 * first :])
    for plane, letter in enumerate("RGGB"):  # each plane is where the camera says
        row, column = profile.cfa.offsets[plane]
        assert profile.cfa.value[2 * row + column] == letter
        wanted = (numbers[row::2, column::2] - profile.black_level[plane]) / profile.span[plane]
        np.testing.assert_array_equal(packed[plane].numpy(), wanted.astype(np.float32))


def test_unpack_clips_to_the_sensor_and_rounds():
    data = torch.tensor([-9.0, 9.0, 0.4 / 4031, 0.6 / 4031]).reshape(4, 1, 1)
    numbers = unpack_mosaic(data, camera(black=64))
    assert numbers.tolist() == [[0, 4095], [64, 65]]
    for shape in ((4,), (1, 8), (2, 2, 2)):
        with pytest.raises(ValueError, match="`mosaic`"):
            pack_mosaic(np.zeros(shape, np.uint16), camera())
    usual = {"data": torch.zeros(4, 2, 2), "settings": SETTINGS, "camera": camera()}
    bad = {"camera": ["nikon_z6"], "settings": [(100, 0.01)], "nlf": [(1e-4, 1e-6)]}
    bad |= {"box_factor": [0, 1.5], "white_balance": [(1.0, 1.0), (1.0, 0.0, 1.0)]}
    beyond_float32 = torch.full((4, 2, 2), 1e300, dtype=torch.float64)
    bad["data"] = [*map(torch.zeros, [(3, 4, 4), (4, 4), (4, 0, 4)]), beyond_float32]
    for name, value in ((name, value) for name, values in bad.items() for value in values):
        with pytest.raises(ValueError, match=f"`{name}`"):
            RawImage(**(usual | {name: value}))


def test_noise_is_the_files_own_before_the_cameras():
    z6, data = get_camera("nikon_z6"), torch.zeros(4, 2, 2)
    assert RawImage(data, SETTINGS, z6).noise.shot[1] == pytest.approx(7.47234302281224e-06)
    own = NoiseLevelFunction((1e-3,) * 4, (1e-6,) * 4)
    assert RawImage(data, SETTINGS, z6, nlf=own).noise == own
    assert RawImage(data.double(), SETTINGS, z6).data.dtype == torch.float32
    averaged = RawImage(data, SETTINGS, z6, nlf=own, box_factor=4)
    assert averaged.noise.shot == pytest.approx((1e-3 / 16,) * 4)
    assert averaged.noise.read == pytest.approx((1e-6 / 16,) * 4)
    with pytest.raises(ValueError, match="no noise calibration"):
        _ = RawImage(data, SETTINGS, camera()).noise


@pytest.mark.parametrize("rows", [1, 127, 300])
def test_saturated_pixels_of_frames_in_shares(rows):
    """Each plane has a limit of its own; NumPy marks the same pixels."""
    limits = [1 - 0.5 / (4095 - black) for black in BLACK]
    levels = np.random.default_rng(6).uniform(0.9995, 1.0001, (4, 9, rows)).astype(np.float32)
    data = levels.transpose(0, 2, 1)  # not in the order of memory
    expected = np.any(data >= np.array(limits, np.float32)[:, None, None], axis=0)
    assert 0 < expected.mean() < 1
    raw = RawImage(torch.from_numpy(data), SETTINGS, camera())
    np.testing.assert_array_equal(raw.saturated, expected)


NLF = NoiseLevelFunction((1.5e-4, 2e-4, 2e-4, 2.5e-4), (1e-6, 2e-6, 2e-6, 3e-6))


def make_raw(camera: CameraProfile | None = None, **changes: Any) -> RawImage:
    profile = camera or CameraProfile("bench_camera", BayerPattern.RGGB, (512.0,) * 4, 15000, 14)
    options = {"nlf": NLF, "white_balance": (2.1, 1.0, 1.6), **changes}
    settings = options.pop("settings", CameraSettings(iso=800, exposure_time=1 / 60, f_number=4.0))
    numbers = np.random.default_rng(3).integers(0, 15001, (40, 56))
    return RawImage.from_mosaic(numbers, settings, profile, **options)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.dng"


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
def test_writing_and_reading_invert(tmp_path, mosaic, settings, white_balance, box_factor):
    (camera, numbers), target = mosaic, tmp_path / "a.dng"
    nlf = camera.nlf(settings.iso)
    assume(max(*nlf.shot, *nlf.read) <= 1.0)  # more is taken for damage
    known = {"white_balance": white_balance, "box_factor": box_factor}
    raw = RawImage.from_mosaic(numbers, settings, camera, **known)
    write_dng(target, raw)
    back = read_raw(target)
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


def test_noise_beyond_the_range_colour_matrix_and_camera_survive(path):
    nlf = NoiseLevelFunction((3.0, 4.0, 4.0, 5.0), (30.0, 40.0, 40.0, 50.0))
    write_dng(path, make_raw(nlf=nlf, settings=CameraSettings(409_600, 4.0, 1.0)))
    back = read_raw(path)
    assert (back.noise.shot, back.noise.read) == (nlf.shot, nlf.read)
    write_dng(path, make_raw(nlf=None))
    with tifffile.TiffFile(path) as tiff:  # nothing is known of its noise
        assert "NoiseProfile" not in tiff.pages.first.tags
    matrix = ((1.0, -0.25, 0.0), (-0.5, 1.5, 0.125), (0.0, -0.25, 0.75))
    z6 = replace(get_camera("nikon_z6"), colour_matrix=matrix, colour_matrix_source="measured")
    write_dng(path, make_raw(z6, nlf=None))
    back = read_raw(path)
    assert (back.camera.name, back.camera.colour_matrix_source) == ("nikon_z6", "measured")
    assert back.camera.colour_matrix == matrix  # not LibRaw's own for this camera
    assert back.camera.nlf(100) == z6.nlf(100)


def test_tags_as_tifffile_reads_them(path):
    known = {"datetime": "2024-02-03T04:05:06", "flip": 6}
    raw = make_raw(metadata=known)
    write_dng(path, raw)
    with tifffile.TiffFile(path) as tiff:
        page = tiff.pages.first
        tags = {tag.name: tag.value for tag in page.tags}
        assert len(page.dataoffsets) == 1
    expected = {"Compression": 1, "PhotometricInterpretation": 32803, "Orientation": 6}
    expected |= {"DateTime": "2024:02:03 04:05:06", "CFAPattern": b"\0\1\1\2"}
    expected |= {"DNGVersion": b"\1\4\0\0", "DNGBackwardVersion": b"\1\1\0\0"}
    expected |= {"BlackLevel": 512, "WhiteLevel": 15000, "CalibrationIlluminant1": 21}
    expected |= {"NoiseProfile": (1.5e-4, 1e-6, 2e-4, 2e-6, 2.5e-4, 3e-6)}
    assert {name: tags[name] for name in expected} == expected
    matrix = np.array(tags["ColorMatrix1"], float).reshape(3, 3, 2)
    np.testing.assert_allclose(matrix[..., 0] / matrix[..., 1], DEFAULT_COLOUR_MATRIX, rtol=1e-9)
    neutral = np.array(tags["AsShotNeutral"], float).reshape(3, 2)
    np.testing.assert_allclose(neutral[:, 0] / neutral[:, 1], [1 / 2.1, 1, 1 / 1.6], rtol=1e-9)
    exif = tags["ExifTag"]
    assert (exif["ExposureTime"], exif["FNumber"]) == ((1, 60), (4, 1))
    assert exif["ISOSpeedRatings"] == exif["RecommendedExposureIndex"] == 800
    assert exif["DateTimeOriginal"] == "2024:02:03 04:05:06"
    back = read_raw(path)
    assert known.items() <= back.metadata.items()
    assert back.camera.colour_matrix is None  # the file's is the neutral default
    with rawpy.imread(str(path)) as libraw:
        np.testing.assert_array_equal(libraw.raw_image_visible, raw.to_mosaic())
    content = path.read_bytes().replace(*(np.array([1, n], "<u4").tobytes() for n in (60, 30)))
    path.write_bytes(content)  # what another program edits wins
    assert read_raw(path).settings.exposure_time == pytest.approx(1 / 30)


def test_any_size_and_order_of_memory(path):
    """Rows are written a few at a time."""
    mosaic = np.random.default_rng(0).integers(0, 4096, (1300, 10), dtype=np.uint16)
    raw = RawImage.from_mosaic(mosaic, CameraSettings(100, 1, 4), make_raw().camera, nlf=NLF)
    write_dng(path, replace(raw, data=raw.data.permute(2, 0, 1).contiguous().permute(1, 2, 0)))
    np.testing.assert_array_equal(tifffile.imread(path), mosaic)


def test_bad_arguments_leave_what_is_there(tmp_path, path):
    write_dng(path, make_raw())
    before = path.read_bytes()
    for target, raw, name in ((tmp_path / "a.tif", make_raw(), "path"), (path, None, "raw")):
        with pytest.raises(ValueError, match=f"`{name}`"):
            write_dng(target, raw)
    assert path.read_bytes() == before


LEVELS = (0.02, 0.1, 0.18, 0.5)


def ramp() -> np.ndarray:
    course = np.linspace(0.0, 1.0, 384) ** 2
    return np.stack([np.broadcast_to(0.002 + k * course, (256, 384)) for k in (0.6, 0.9, 0.9, 0.5)])


def patches() -> np.ndarray:
    row = np.repeat([0.01, 0.05, 0.2, 0.5], 50)
    return np.broadcast_to(row, (4, 200, 200))


def photograph(name: str) -> np.ndarray:
    linear = (getattr(skimage.data, name)() / 255.0) ** 2.2
    return np.moveaxis(linear * [0.5, 1.0, 0.65], -1, 0)[[0, 1, 1, 2]]


def soft(name: str) -> np.ndarray:
    return gaussian_filter(photograph(name), (0, 1, 1))


def with_noise(light: np.ndarray, nlf: NoiseLevelFunction) -> np.ndarray:
    """Gaussian noise of the NLF's variance, clipped with a pedestal and quantised to 14 bits."""
    rng = np.random.default_rng(1)
    shot, read = (np.array(v)[:, None, None] for v in (nlf.shot, nlf.read))
    noisy = light + np.sqrt(shot * light + read) * rng.standard_normal(light.shape)
    return np.round(np.clip(noisy, -0.065, 1.0) * 15000) / 15000


def worst_ratio(estimate: NoiseLevelFunction, truth: NoiseLevelFunction) -> tuple[float, float]:
    """Lowest and highest variance, estimated over true, over `LEVELS`, plane-averaged truth."""
    shot, read = np.mean(truth.shot), np.mean(truth.read)
    ratios = [(estimate.read[0] + estimate.shot[0] * x) / (read + shot * x) for x in LEVELS]
    return min(ratios), max(ratios)


@pytest.mark.parametrize(
    ("light", "camera", "iso", "least", "most"),
    [
        (ramp(), "nikon_z6", 12800, 0.88, 1.12),
        (ramp(), "canon_70d", 100, 0.88, 1.12),
        (patches(), "nikon_z6", 12800, 0.88, 1.12),
        (patches(), "canon_70d", 100, 0.88, 1.12),
        (np.tile(ramp(), (1, 6, 4)), "canon_70d", 800, 0.9, 1.1),  # so large that it is sampled
        # No level is smooth, and the bound is the docs'.
        (photograph("astronaut")[:, ::2, ::2], "canon_70d", 800, 0.9, 3.0),
        *((soft("astronaut"), "canon_70d", iso, 0.80, 1.25) for iso in (100, 6400)),
        *((soft("coffee"), "canon_70d", iso, 0.80, 1.25) for iso in (100, 6400)),
    ],
)
def test_noise_that_was_put_in_is_found(light, camera, iso, least, most):
    nlf = get_camera(camera).nlf(iso)
    low, high = worst_ratio(estimate_nlf(with_noise(light, nlf)), nlf)
    assert least < low <= high < most


def test_clipped_halves_dark_frames_and_grey_cards():
    nlf = get_camera("canon_70d").nlf(1600)
    sides = np.full((4, 256, 200), 1.2), np.zeros((4, 256, 90))
    noisy = with_noise(np.concatenate([ramp(), *sides], axis=2), nlf)
    for clipped in (noisy, np.maximum(noisy, 0.0)):  # with a pedestal, and without one
        low, high = worst_ratio(estimate_nlf(clipped), nlf)
        assert 0.85 < low <= high < 1.15
    rng = np.random.default_rng(6)
    noise = rng.standard_normal((4, 128, 128))
    dark = estimate_nlf(1e-3 * noise)
    assert dark.read[0] + 1e-3 * dark.shot[0] == pytest.approx(1e-6, rel=0.15)
    card = estimate_nlf(0.3 + 1e-2 * noise)
    assert card.read == (0.0,) * 4
    assert 0.3 * card.shot[0] == pytest.approx(1e-4, rel=0.1)


@pytest.mark.parametrize("data", [np.random.default_rng(0).random((4, 8, 8)), np.ones((4, 64, 64))])
def test_what_tells_no_noise(data):
    with pytest.raises(ValueError, match="`data`"):
        estimate_nlf(data)


@pytest.mark.real_data
def test_real_raws_of_one_camera_agree(data_dir):
    """Shot noise is the camera's, whatever the subject; a chart's patches are the reference."""
    folder = data_dir / "canon_crw_cc0"
    raws = {n: read_raw(folder / f"CRW_{n}.CRW") for n in ("0101", "0118")}
    shots = [raw.noise.shot[1] for raw in raws.values()]
    assert max(shots) / min(shots) < 1.15
    nlf = raws["0101"].noise
    # Neutral patches of the ColorChecker, a quadratic surface taken out, variance by least squares.
    y, x = np.mgrid[-1:1:24j, -1:1:24j]
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1).reshape(-1, 6)
    ratios = []
    for left, plane in itertools.product((165, 320, 475), range(4)):
        patch = raws["0101"].data[plane, 610:634, left : left + 24].double().numpy()
        _, (squares,), *_ = np.linalg.lstsq(design, patch.ravel(), rcond=None)
        variance = squares / (patch.size - 6)
        ratios.append(variance / (nlf.read[plane] + nlf.shot[plane] * patch.mean()))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)
