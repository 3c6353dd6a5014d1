from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rawpy
import tifffile
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from simulator import (
    CameraProfile,
    CameraSettings,
    NoiseLevelFunction,
    RawImage,
    get_camera,
    list_cameras,
    read_raw,
    write_dng,
)
from simulator.camera import BayerPattern
from simulator.raw.dng import DEFAULT_COLOUR_MATRIX
from tests.strategies import cameras, log_uniform, mosaics, settings_within

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


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize("black", [(500.0, 510.0, 520.0, 530.0), (64.25,) * 4])
def test_libraw_sees_the_same_mosaic(path, cfa, black):
    raw = make_raw(CameraProfile("bench_camera", cfa, black, 15000, 14))
    write_dng(path, raw)
    back = read_raw(path)
    assert torch.equal(back.data, raw.data)
    assert (back.camera.name, back.camera.black_level) == ("bench_camera", black)
    assert back.camera.colour_matrix is None  # the file's is the neutral default
    assert (back.noise.shot, back.noise.read) == (NLF.shot, NLF.read)
    with rawpy.imread(str(path)) as libraw:
        np.testing.assert_array_equal(libraw.raw_image_visible, raw.to_mosaic())
        assert "".join("RGBG"[i] for i in libraw.raw_pattern.ravel()) == cfa


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


def test_noise_of_box_averages_and_beyond_the_whole_range(path):
    raw = make_raw(box_factor=4)
    write_dng(path, raw)
    with tifffile.TiffFile(path) as tiff:
        assert tiff.pages.first.tags["NoiseProfile"].value[0] == pytest.approx(1.5e-4 / 16)
    assert read_raw(path).noise.shot == pytest.approx(raw.noise.shot)
    write_dng(path, make_raw(nlf=None))
    with tifffile.TiffFile(path) as tiff:  # nothing is known of its noise
        assert "NoiseProfile" not in tiff.pages.first.tags
    nlf = NoiseLevelFunction((3.0, 4.0, 4.0, 5.0), (30.0, 40.0, 40.0, 50.0))
    write_dng(path, make_raw(nlf=nlf, settings=CameraSettings(409_600, 4.0, 1.0)))
    back = read_raw(path)
    assert (back.noise.shot, back.noise.read) == (nlf.shot, nlf.read)


@pytest.mark.parametrize(
    "values",
    [(100, 1 / 60, 2.8), (126.0, 2 ** (-38 / 3), 2**1.5), (409600, 3e-5, 0.95), (1e5, 1e-6, 5.6)],
)
def test_libraw_reads_the_settings(path, values):
    settings = CameraSettings(*values)
    write_dng(path, make_raw(settings=settings))
    assert read_raw(path).settings == settings
    with rawpy.imread(str(path)) as libraw:
        known = libraw.other
    assert known.shutter_speed == pytest.approx(settings.exposure_time, rel=1e-6)
    assert known.aperture == pytest.approx(settings.f_number, rel=1e-6)
    # EXIF has 16 bits for the ISO speed; LibRaw does not look further.
    assert known.iso_speed == pytest.approx(min(settings.iso, 65535), abs=0.5)


def test_exif_edited_by_others_wins(path):
    write_dng(path, make_raw())
    old, new = (np.array([1, n], "<u4").tobytes() for n in (60, 30))
    content = path.read_bytes()
    assert content.count(old) == 1
    path.write_bytes(content.replace(old, new))
    assert read_raw(path).settings.exposure_time == pytest.approx(1 / 30)


def test_colour_matrix_and_camera_survive(path):
    matrix = ((1.0, -0.25, 0.0), (-0.5, 1.5, 0.125), (0.0, -0.25, 0.75))
    z6 = replace(get_camera("nikon_z6"), colour_matrix=matrix, colour_matrix_source="measured")
    write_dng(path, make_raw(z6, nlf=None))
    back = read_raw(path)
    assert (back.camera.name, back.camera.colour_matrix_source) == ("nikon_z6", "measured")
    assert back.camera.colour_matrix == matrix  # not LibRaw's own for this camera
    assert back.noise.shot[1:3] == pytest.approx(z6.nlf(800).shot[1:3])
    assert back.camera.nlf(100) == z6.nlf(100)


def test_tags_as_tifffile_reads_them(path):
    known = {"datetime": "2024-02-03T04:05:06", "flip": 6}
    raw = make_raw(metadata=known)
    write_dng(path, raw)
    with tifffile.TiffFile(path) as tiff:
        page = tiff.pages.first
        tags = {tag.name: tag.value for tag in page.tags}
        np.testing.assert_array_equal(page.asarray(), raw.to_mosaic())
        assert len(page.dataoffsets) == 1
    expected = {
        "Compression": 1,
        "PhotometricInterpretation": 32803,
        "Orientation": 6,
        "DateTime": "2024:02:03 04:05:06",
        "CFAPattern": b"\0\1\1\2",
        "DNGVersion": b"\1\4\0\0",
        "DNGBackwardVersion": b"\1\1\0\0",
        "BlackLevel": 512,
        "WhiteLevel": 15000,
        "CalibrationIlluminant1": 21,
        "NoiseProfile": (1.5e-4, 1e-6, 2e-4, 2e-6, 2.5e-4, 3e-6),
    }
    assert {name: tags[name] for name in expected} == expected
    matrix = np.array(tags["ColorMatrix1"], float).reshape(3, 3, 2)
    np.testing.assert_allclose(matrix[..., 0] / matrix[..., 1], DEFAULT_COLOUR_MATRIX, rtol=1e-9)
    neutral = np.array(tags["AsShotNeutral"], float).reshape(3, 2)
    np.testing.assert_allclose(neutral[:, 0] / neutral[:, 1], [1 / 2.1, 1, 1 / 1.6], rtol=1e-9)
    exif = tags["ExifTag"]
    assert (exif["ExposureTime"], exif["FNumber"]) == ((1, 60), (4, 1))
    assert exif["ISOSpeedRatings"] == exif["RecommendedExposureIndex"] == 800
    assert exif["DateTimeOriginal"] == "2024:02:03 04:05:06"
    assert known.items() <= read_raw(path).metadata.items()


def test_developed_level_is_right(path):
    """A grey card of 0.18 after white balance comes out of LibRaw's sRGB as 118 of 255."""
    raw = make_raw(CameraProfile("bench_camera", BayerPattern.GBRG, (512.0,) * 4, 15000, 14))
    grey = torch.tensor([0.18 / 2.1, 0.18, 0.18, 0.18 / 1.6])[:, None, None].expand(4, 40, 40)
    write_dng(path, replace(raw, data=grey))
    as_ours = {"use_camera_wb": True, "no_auto_bright": True, "gamma": (2.4, 12.92)}
    with rawpy.imread(str(path)) as libraw:
        picture = libraw.postprocess(**as_ours, adjust_maximum_thr=0.0)
    np.testing.assert_allclose(picture.reshape(-1, 3).mean(0), [118, 118, 118], atol=1.5)


def test_any_size_and_order_of_memory(path):
    """Rows are written a few at a time."""
    mosaic = np.random.default_rng(0).integers(0, 4096, (1300, 10), dtype=np.uint16)
    raw = RawImage.from_mosaic(mosaic, CameraSettings(100, 1, 4), make_raw().camera, nlf=NLF)
    turned = replace(raw, data=raw.data.permute(2, 0, 1).contiguous().permute(1, 2, 0))
    for each in (raw, turned):
        write_dng(path, each)
        np.testing.assert_array_equal(tifffile.imread(path), mosaic)


def test_bad_arguments_leave_what_is_there(tmp_path, path):
    write_dng(path, make_raw())
    before = path.read_bytes()
    for target, raw, name in ((tmp_path / "a.tif", make_raw(), "path"), (path, None, "raw")):
        with pytest.raises(ValueError, match=f"`{name}`"):
            write_dng(target, raw)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.dng"]
