"""DNG files that were written: the same numbers back, through LibRaw, tifffile and exiftool."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rawpy
import tifffile
import torch

from simulator import CameraSettings, NoiseLevelFunction, RawImage, get_camera, read_raw, write_dng
from simulator.camera import BayerPattern, CameraProfile
from simulator.raw.dng import DEFAULT_COLOUR_MATRIX
from simulator.raw.metadata import as_rational

NLF = NoiseLevelFunction((1.5e-4, 2e-4, 2e-4, 2.5e-4), (1e-6, 2e-6, 2e-6, 3e-6))


def make_raw(
    *,
    cfa: str = "RGGB",
    black: tuple[float, float, float, float] = (512.0,) * 4,
    settings: CameraSettings | None = None,
    box_factor: int = 1,
    camera: CameraProfile | None = None,
) -> RawImage:
    profile = camera or CameraProfile("bench_camera", BayerPattern(cfa), black, 15000, 14)
    numbers = np.random.default_rng(3).integers(0, 15001, (40, 56))
    settings = settings or CameraSettings(iso=800, exposure_time=1 / 60, f_number=4.0)
    return RawImage.from_mosaic(
        numbers,
        settings,
        profile,
        nlf=NLF,
        white_balance=(2.1, 1.0, 1.6),
        box_factor=box_factor,
    )


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize("black", [(512.0,) * 4, (500.0, 510.0, 520.0, 530.0), (64.25,) * 4])
def test_round_trip(tmp_path: Path, cfa: str, black: tuple[float, float, float, float]) -> None:
    raw = make_raw(cfa=cfa, black=black)
    write_dng(tmp_path / "a.dng", raw)
    back = read_raw(tmp_path / "a.dng")
    assert torch.equal(back.data, raw.data)
    np.testing.assert_array_equal(back.to_mosaic(), raw.to_mosaic())
    assert back.settings == raw.settings
    assert back.camera.cfa is raw.camera.cfa
    assert back.camera.black_level == raw.camera.black_level
    assert back.camera.white_level == raw.camera.white_level
    assert back.camera.name == "bench_camera"
    assert back.camera.colour_matrix is None  # the file's is the neutral default
    assert back.white_balance == pytest.approx(raw.white_balance, rel=1e-6)
    assert back.noise.shot == NLF.shot
    assert back.noise.read == NLF.read
    # LibRaw itself sees the same mosaic.
    with rawpy.imread(str(tmp_path / "a.dng")) as libraw:
        np.testing.assert_array_equal(libraw.raw_image_visible, raw.to_mosaic())
        letters = "".join("RGBG"[i] for i in libraw.raw_pattern.ravel())
    assert letters == cfa


@pytest.mark.parametrize(
    "settings",
    [
        CameraSettings(100, 1 / 60, 2.8),
        CameraSettings(125.99210498948732, 2 ** (-38 / 3), 2**1.5),
        CameraSettings(50, 30.3, 22),
        CameraSettings(409600, 1 / 32000, 0.95),
        CameraSettings(102400, 1e-6, 5.6),
    ],
)
def test_settings_come_back_exactly(tmp_path: Path, settings: CameraSettings) -> None:
    write_dng(tmp_path / "a.dng", make_raw(settings=settings))
    assert read_raw(tmp_path / "a.dng").settings == settings
    with rawpy.imread(str(tmp_path / "a.dng")) as libraw:
        assert libraw.other.shutter_speed == pytest.approx(settings.exposure_time, rel=1e-6)
        assert libraw.other.aperture == pytest.approx(settings.f_number, rel=1e-6)
        # EXIF has 16 bits for the ISO speed; LibRaw does not look further.
        assert libraw.other.iso_speed == pytest.approx(min(settings.iso, 65535), abs=0.5)


def test_exif_edited_by_others_wins(tmp_path: Path) -> None:
    path = tmp_path / "a.dng"
    write_dng(path, make_raw())
    content = path.read_bytes()
    with tifffile.TiffFile(path) as tiff:
        exposure = next(t for t in tiff.pages[0].tags.values() if t.code == 34665)
        offset = exposure.value["ExposureTime"]
    assert offset == (1, 60)
    edited = content.replace(np.array([1, 60], "<u4").tobytes(), np.array([1, 30], "<u4").tobytes())
    path.write_bytes(edited)
    assert read_raw(path).settings.exposure_time == pytest.approx(1 / 30)


def test_tags(tmp_path: Path) -> None:
    raw = replace(make_raw(), metadata={"datetime": "2024-02-03T04:05:06", "flip": 6})
    write_dng(tmp_path / "a.dng", raw)
    with tifffile.TiffFile(tmp_path / "a.dng") as tiff:
        page = tiff.pages[0]
        tags = {t.code: t.value for t in page.tags.values()}
        np.testing.assert_array_equal(page.asarray(), raw.to_mosaic())
        assert len(page.dataoffsets) == 1
    assert tags[259] == 1  # uncompressed
    assert tags[262] == 32803
    assert tags[274] == 6
    assert tags[306] == "2024:02:03 04:05:06"
    assert bytes(tags[33422]) == b"\0\1\1\2"
    assert bytes(tags[50706]) == b"\1\4\0\0"
    assert bytes(tags[50707]) == b"\1\1\0\0"
    assert (tags[50714], tags[50717], tags[50778]) == (512, 15000, 21)
    matrix = np.array(tags[50721], float).reshape(3, 3, 2)
    np.testing.assert_allclose(matrix[..., 0] / matrix[..., 1], DEFAULT_COLOUR_MATRIX, rtol=1e-9)
    neutral = np.array(tags[50728], float).reshape(3, 2)
    np.testing.assert_allclose(neutral[:, 0] / neutral[:, 1], [1 / 2.1, 1, 1 / 1.6], rtol=1e-9)
    assert tags[51041] == (1.5e-4, 1e-6, 2e-4, 2e-6, 2.5e-4, 3e-6)
    exif = tags[34665]
    assert exif["ExposureTime"] == (1, 60)
    assert exif["FNumber"] == (4, 1)
    assert exif["ISOSpeedRatings"] == 800
    assert exif["DateTimeOriginal"] == "2024:02:03 04:05:06"
    assert read_raw(tmp_path / "a.dng").metadata["datetime"] == "2024-02-03T04:05:06"
    assert read_raw(tmp_path / "a.dng").metadata["flip"] == 6


def test_colour_matrix_and_camera_survive(tmp_path: Path) -> None:
    matrix = ((1.0, -0.25, 0.0), (-0.5, 1.5, 0.125), (0.0, -0.25, 0.75))
    z6 = replace(get_camera("nikon_z6"), colour_matrix=matrix, colour_matrix_source="measured")
    raw = replace(make_raw(camera=z6), nlf=None)
    write_dng(tmp_path / "a.dng", raw)
    # LibRaw has its own matrix for this camera: the file's must win.
    assert read_raw(tmp_path / "a.dng").camera.colour_matrix == z6.colour_matrix
    back = read_raw(tmp_path / "a.dng")
    assert back.camera.name == "nikon_z6"
    assert back.camera.colour_matrix == z6.colour_matrix
    assert back.camera.colour_matrix_source == z6.colour_matrix_source
    assert back.noise.shot[1:3] == pytest.approx(z6.nlf(800).shot[1:3])
    assert back.camera.nlf(100) == z6.nlf(100)


def test_box_averaged_raw_states_its_own_noise(tmp_path: Path) -> None:
    raw = make_raw(box_factor=4)
    write_dng(tmp_path / "a.dng", raw)
    with tifffile.TiffFile(tmp_path / "a.dng") as tiff:
        stated = next(t.value for t in tiff.pages[0].tags.values() if t.code == 51041)
    assert stated[0] == pytest.approx(1.5e-4 / 16)
    back = read_raw(tmp_path / "a.dng")
    assert back.box_factor == 4
    assert back.noise.shot == pytest.approx(raw.noise.shot)


def test_values_outside_the_sensor_are_clipped(tmp_path: Path) -> None:
    raw = make_raw()
    raw = replace(raw, data=torch.linspace(-1, 2, raw.data.numel()).reshape(raw.data.shape))
    write_dng(tmp_path / "a.dng", raw)
    numbers = tifffile.imread(tmp_path / "a.dng")
    assert (numbers.min(), numbers.max()) == (0, 15000)


def test_developed_level_is_right(tmp_path: Path) -> None:
    """A grey card of 0.18 after white balance comes out of LibRaw's sRGB as 118 of 255."""
    camera = CameraProfile("bench_camera", BayerPattern.GBRG, (512.0,) * 4, 15000, 14)
    gains = (2.0, 1.0, 1.5)
    grey = torch.tensor([0.18 / 2.0, 0.18, 0.18, 0.18 / 1.5])[:, None, None].expand(4, 40, 40)
    settings = CameraSettings(100, 0.01, 4)
    write_dng(tmp_path / "a.dng", RawImage(grey, settings, camera, NLF, white_balance=gains))
    with rawpy.imread(str(tmp_path / "a.dng")) as libraw:
        picture = libraw.postprocess(
            use_camera_wb=True, no_auto_bright=True, adjust_maximum_thr=0.0, gamma=(2.4, 12.92)
        )
    np.testing.assert_allclose(picture.reshape(-1, 3).mean(0), [118, 118, 118], atol=1.5)


def test_bad_calls(tmp_path: Path) -> None:
    raw = make_raw()
    with pytest.raises(ValueError, match=r"`path`.*'\.dng'"):
        write_dng(tmp_path / "a.tif", raw)
    with pytest.raises(ValueError, match="`raw`"):
        write_dng(tmp_path / "a.dng", raw.data)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_only_the_file_is_left_behind(tmp_path: Path) -> None:
    write_dng(tmp_path / "new" / "a.DNG", make_raw())
    write_dng(tmp_path / "new" / "a.DNG", make_raw(cfa="GBRG"))
    assert [p.name for p in tmp_path.rglob("*")] == ["new", "a.DNG"]
    assert read_raw(tmp_path / "new" / "a.DNG").camera.cfa is BayerPattern.GBRG


def test_no_noise_profile_without_noise_knowledge(tmp_path: Path) -> None:
    write_dng(tmp_path / "a.dng", replace(make_raw(), nlf=None))
    with tifffile.TiffFile(tmp_path / "a.dng") as tiff:
        assert 51041 not in [t.code for t in tiff.pages[0].tags.values()]


@pytest.mark.parametrize("value", [1 / 60, 0.0001, 2.8, 1 / 3, 2**0.5, 30.0, 1e-6, 4e9])
def test_rationals(value: float) -> None:
    numerator, denominator = as_rational(value)
    assert max(numerator, denominator) < 2**32
    assert numerator / denominator == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize("value", [-1.0, 1e12])
def test_rationals_out_of_range(value: float) -> None:
    with pytest.raises(ValueError, match="32-bit rational"):
        as_rational(value)


@pytest.mark.real_data
def test_real_raw_round_trip(data_dir: Path, tmp_path: Path) -> None:
    raw = read_raw(data_dir / "canon_crw_cc0" / "CRW_0117.CRW")
    write_dng(tmp_path / "a.dng", raw)
    back = read_raw(tmp_path / "a.dng")
    assert torch.equal(back.data, raw.data)
    assert back.settings == raw.settings
    assert back.noise.shot == raw.noise.shot
    assert back.camera.colour_matrix == raw.camera.colour_matrix


@pytest.mark.skipif(shutil.which("exiftool") is None, reason="exiftool is not installed")
def test_exiftool_reads_it_without_a_warning(tmp_path: Path) -> None:
    write_dng(tmp_path / "a.dng", make_raw())
    command = ["exiftool", "-json", "-n", "-a", "-warning", "-error", "-validate", "-all"]
    text = subprocess.run(
        [*command, str(tmp_path / "a.dng")], capture_output=True, check=True, text=True
    ).stdout
    tags = json.loads(text)[0]
    assert "Warning" not in tags
    assert "Error" not in tags
    assert tags["FileType"] == "DNG"
    assert tags["ExposureTime"] == pytest.approx(1 / 60)
    assert (tags["ISO"], tags["FNumber"]) == (800, 4)
    assert (tags["BlackLevel"], tags["WhiteLevel"]) == (512, 15000)
    assert tags["CFAPattern2"] == "0 1 1 2"


@pytest.mark.parametrize("size", [(1, 1), (3, 8), (8, 3), (12, 12), (16, 16), (17, 20), (64, 24)])
@pytest.mark.parametrize("name", ["nikon_z6", "canon_70d"])
def test_any_size_comes_back_number_for_number(tmp_path, name, size):
    """LibRaw misreads narrow frames that say Nikon, and takes tiny ones for no raw at all."""
    camera = get_camera(name)
    numbers = np.random.default_rng(0).integers(0, int(camera.white_level), np.multiply(size, 2))
    settings = CameraSettings(400, 0.01, 8)
    raw = RawImage.from_mosaic(numbers.astype(np.uint16), settings, camera)
    write_dng(tmp_path / "small.dng", raw)
    back = read_raw(tmp_path / "small.dng")
    np.testing.assert_array_equal(back.to_mosaic(), numbers)
    assert back.settings == settings


def test_a_frame_larger_than_what_is_written_at_a_time(tmp_path: Path) -> None:
    mosaic = np.random.default_rng(0).integers(0, 4096, (1300, 10), dtype=np.uint16)
    profile = CameraProfile("bench", "RGGB", 64, 4095, 12)  # type: ignore[arg-type]
    write_dng(tmp_path / "a.dng", RawImage.from_mosaic(mosaic, CameraSettings(100, 1, 4), profile))
    back = read_raw(tmp_path / "a.dng", nlf=NoiseLevelFunction.zero())
    np.testing.assert_array_equal(back.to_mosaic(), mosaic)


def test_data_in_any_order_of_memory_gives_the_same_file(tmp_path: Path) -> None:
    plain = make_raw()
    turned = replace(plain, data=plain.data.permute(2, 0, 1).contiguous().permute(1, 2, 0))
    assert not turned.data.is_contiguous()
    for name, raw in (("plain", plain), ("turned", turned)):
        write_dng(tmp_path / f"{name}.dng", raw)
    assert (tmp_path / "turned.dng").read_bytes() == (tmp_path / "plain.dng").read_bytes()


def test_noise_beyond_the_whole_range_comes_back(tmp_path: Path) -> None:
    nlf = NoiseLevelFunction((3.0, 4.0, 4.0, 5.0), (30.0, 40.0, 40.0, 50.0))  # ISO 409600, exposed
    settings = CameraSettings(409_600, 4.0, 1.0)
    write_dng(
        tmp_path / "noise.dng",
        RawImage(torch.ones(4, 8, 8), settings, camera=get_camera("nikon_z6"), nlf=nlf),
    )
    back = read_raw(tmp_path / "noise.dng")
    assert (back.noise.shot, back.noise.read) == (nlf.shot, nlf.read)
