"""Reading raw files: CFA orders, levels, margins, metadata, noise, and what is refused."""

from __future__ import annotations

import gc
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import torch
from skimage.io import imsave

from simulator import CameraSettings, NoiseLevelFunction, RawImage, get_camera, read_raw, write_dng
from simulator.camera import BayerPattern, CameraProfile
from simulator.raw.decoding import RawFileError

SETTINGS = CameraSettings(iso=100, exposure_time=1 / 60, f_number=4.0)
NLF = NoiseLevelFunction((1e-4,) * 4, (1e-6,) * 4)
BLACK = (60, 70, 80, 90)  # row by row of the tile


CFA_BYTES = {
    "RGGB": b"\x00\x01\x01\x02",
    "BGGR": b"\x02\x01\x01\x00",
    "GRBG": b"\x01\x00\x02\x01",
    "GBRG": b"\x01\x02\x00\x01",
}
#: XYZ to camera of a Nikon Z 6, any plausible matrix would do.
MATRIX = (0.9943, -0.3269, -0.0839, -0.5323, 1.3269, 0.2259, -0.1198, 0.2083, 0.7557)


def write_sample_dng(
    path: Path,
    mosaic: np.ndarray,
    *,
    cfa: bytes = CFA_BYTES["RGGB"],
    cfa_size: int = 2,
    black: tuple[int, ...] = (64,),
    white: int = 4095,
    active_area: tuple[int, int, int, int] | None = None,
    noise_profile: tuple[float, ...] | None = None,
    make: str = "Test",
    model: str = "Sensor",
    photometric: int = 32803,
    illuminant: int = 21,
    extra: tuple[tuple[Any, ...], ...] = (),
) -> None:
    """A DNG by tifffile, not by the code under test; `black` is row by row of the 2 x 2 tile."""
    tags: list[tuple[Any, ...]] = [
        (271, "s", 0, make, True),
        (272, "s", 0, model, True),
        (50706, "B", 4, (1, 4, 0, 0), True),
        (50707, "B", 4, (1, 1, 0, 0), True),
        (50708, "s", 0, f"{make} {model}", True),
        (50717, "I", 1, white, True),
        (50721, "2i", 9, tuple(n for v in MATRIX for n in (round(v * 10000), 10000)), True),
        (50728, "2I", 3, (1, 2, 1, 1, 2, 3), True),
        (50778, "H", 1, illuminant, True),
        *extra,
    ]
    if photometric == 32803:
        tags += [
            (33421, "H", 2, (cfa_size, cfa_size), True),
            (33422, "B", len(cfa), cfa, True),
            (50710, "B", 3, (0, 1, 2), True),
            (50711, "H", 1, 1, True),
        ]
    if len(black) == 4:
        tags.append((50713, "H", 2, (2, 2), True))
    tags.append((50714, "I", len(black), black if len(black) > 1 else black[0], True))
    if active_area is not None:
        tags.append((50829, "I", 4, active_area, True))
    if noise_profile is not None:
        tags.append((51041, "d", len(noise_profile), noise_profile, True))
    tifffile.imwrite(
        path, mosaic, photometric=photometric, extratags=tags, metadata=None, software=False
    )


@pytest.fixture
def mosaic() -> np.ndarray:
    return np.random.default_rng(0).integers(100, 4000, (64, 96), dtype=np.uint16)


def expected_planes(
    mosaic: np.ndarray, order: str, area: tuple[int, int, int, int]
) -> dict[str, np.ndarray]:
    """Planes by the DNG specification's rule, pixel by pixel from the tile at the area's corner.

    LibRaw begins an odd visible area one row or column further in.
    """
    top, left, bottom, right = area
    rows = np.arange(top + top % 2, bottom)
    columns = np.arange(left + left % 2, right)
    rows, columns = rows[: len(rows) // 2 * 2], columns[: len(columns) // 2 * 2]
    red_row = order.index("R") // 2
    names = np.array(
        [
            letter if letter != "G" else ("G1" if i // 2 == red_row else "G2")
            for i, letter in enumerate(order)
        ]
    )
    tile = 2 * ((rows[:, None] - top) % 2) + (columns[None] - left) % 2
    values = (mosaic[np.ix_(rows, columns)] - np.array(BLACK, float)[tile]) / (
        4095 - np.array(BLACK, float)[tile]
    )
    shape = (len(rows) // 2, len(columns) // 2)
    return {n: values[names[tile] == n].reshape(shape) for n in ("R", "G1", "G2", "B")}


@pytest.mark.parametrize("order", list(CFA_BYTES))
@pytest.mark.parametrize("corner", [(0, 0), (1, 0), (0, 1), (3, 5), (2, 4)])
def test_cfa_orders_black_levels_and_margins(
    tmp_path: Path, mosaic: np.ndarray, order: str, corner: tuple[int, int]
) -> None:
    area = (*corner, 62, 94)
    write_sample_dng(
        tmp_path / "a.dng", mosaic, cfa=CFA_BYTES[order], black=BLACK, active_area=area
    )
    raw = read_raw(tmp_path / "a.dng", settings=SETTINGS, nlf=NLF)
    for plane, name in zip(raw.data.numpy(), ("R", "G1", "G2", "B"), strict=True):
        np.testing.assert_allclose(plane, expected_planes(mosaic, order, area)[name], atol=1e-7)
    by_name = dict(zip(("R", "G1", "G2", "B"), raw.camera.black_level, strict=True))
    green_with_red = {"RGGB": 70, "BGGR": 80, "GRBG": 60, "GBRG": 90}[order]
    assert by_name["G1"] == green_with_red
    assert by_name["R"] == BLACK[order.index("R")]


def test_levels_colour_and_metadata(tmp_path: Path, mosaic: np.ndarray) -> None:
    write_sample_dng(tmp_path / "a.dng", mosaic)
    raw = read_raw(str(tmp_path / "a.dng"), settings=SETTINGS, nlf=NLF)
    assert raw.settings == SETTINGS  # given settings are not snapped
    assert raw.camera.black_level == (64.0,) * 4
    assert raw.camera.white_level == 4095
    assert raw.camera.bit_depth == 12
    assert raw.white_balance == pytest.approx((2.0, 1.0, 1.5))
    assert raw.camera.colour_matrix is not None
    np.testing.assert_allclose(np.ravel(raw.camera.colour_matrix), MATRIX, atol=1e-6)
    assert "ColorMatrix of the file" in raw.camera.colour_matrix_source
    assert raw.camera.name == "test_sensor"
    assert raw.metadata["path"] == "a.dng"
    assert (raw.metadata["make"], raw.metadata["model"]) == ("Test", "Sensor")
    assert raw.metadata["flip"] == 0
    assert raw.metadata["nlf_source"] == "given"
    assert raw.noise == NLF
    np.testing.assert_array_equal(raw.to_mosaic(), mosaic)


def test_rotation_is_reported_not_applied(tmp_path: Path, mosaic: np.ndarray) -> None:
    write_sample_dng(tmp_path / "a.dng", mosaic, extra=((274, "H", 1, 6, True),))
    raw = read_raw(tmp_path / "a.dng", settings=SETTINGS, nlf=NLF)
    assert raw.metadata["flip"] == 6
    assert raw.data.shape == (4, 32, 48)


def test_second_colour_matrix_is_daylight(tmp_path: Path, mosaic: np.ndarray) -> None:
    """A DNG's first matrix is for tungsten light as a rule; CameraCalibration is multiplied in."""
    half = tuple(n for v in np.diag([0.5, 1, 2]).ravel() for n in (round(v * 10), 10))
    double = tuple(n for v in np.eye(3).ravel() for n in (round(v * 2), 1))
    extra = (
        (50722, "2i", 9, double, True),
        (50724, "2i", 9, half, True),
        (50779, "H", 1, 21, True),
    )
    write_sample_dng(tmp_path / "a.dng", mosaic, extra=extra, illuminant=17)
    raw = read_raw(tmp_path / "a.dng", settings=SETTINGS, nlf=NLF)
    np.testing.assert_allclose(raw.camera.colour_matrix, np.diag([1.0, 2.0, 4.0]))


def test_missing_exposure_must_be_given(tmp_path: Path, mosaic: np.ndarray) -> None:
    write_sample_dng(tmp_path / "a.dng", mosaic)
    with pytest.raises(ValueError, match=r"`settings`.*iso, exposure_time, f_number"):
        read_raw(tmp_path / "a.dng")


@pytest.mark.parametrize(
    ("pairs", "shot", "read"),
    [
        ((1e-4, 2e-6), (1e-4,) * 4, (2e-6,) * 4),
        ((1e-4, 1e-6, 2e-4, 2e-6, 3e-4, 3e-6), (1e-4, 2e-4, 2e-4, 3e-4), (1e-6, 2e-6, 2e-6, 3e-6)),
    ],
)
def test_noise_profile_wins(
    tmp_path: Path, mosaic: np.ndarray, pairs: tuple[float, ...], shot: Any, read: Any
) -> None:
    write_sample_dng(
        tmp_path / "a.dng",
        mosaic,
        noise_profile=pairs,
        make="NIKON CORPORATION",
        model="NIKON Z 6",
    )
    raw = read_raw(tmp_path / "a.dng", settings=SETTINGS)
    assert raw.noise.shot == pytest.approx(shot)
    assert raw.noise.read == pytest.approx(read)
    assert raw.metadata["nlf_source"] == "DNG NoiseProfile"
    assert raw.camera.name == "nikon_z6"
    assert raw.camera.nlf(400) == get_camera("nikon_z6").nlf(400)


def test_built_in_camera_keeps_the_levels_of_the_file(tmp_path: Path, mosaic: np.ndarray) -> None:
    write_sample_dng(tmp_path / "a.dng", mosaic, make="Canon", model="Canon EOS 70D")
    raw = read_raw(tmp_path / "a.dng", settings=SETTINGS)
    assert raw.camera.name == "canon_70d"
    assert (raw.camera.black_level[0], raw.camera.white_level) == (64.0, 4095.0)
    assert raw.noise == get_camera("canon_70d").nlf(100)
    assert raw.metadata["nlf_source"] == "camera calibration (canon_70d)"


def test_camera_argument(tmp_path: Path, mosaic: np.ndarray) -> None:
    path = tmp_path / "a.dng"
    write_sample_dng(path, mosaic)
    named = read_raw(path, settings=SETTINGS, camera="nikon_z6")
    assert named.noise == get_camera("nikon_z6").nlf(100)
    assert named.camera.white_level == 4095
    own = CameraProfile("mine", BayerPattern.RGGB, (50.0,) * 4, 4000, 12).with_nlf(100, NLF)
    raw = read_raw(path, settings=SETTINGS, camera=own)
    assert raw.camera == own
    assert raw.data[0, 0, 0] == pytest.approx((int(mosaic[0, 0]) - 50) / 3950)
    with pytest.raises(ValueError, match=r"filter order of 'a\.dng', RGGB"):
        read_raw(path, settings=SETTINGS, camera=replace(own, cfa=BayerPattern.GBRG))
    with pytest.raises(ValueError, match=r"levels of 'a\.dng', white 4095"):
        read_raw(path, settings=SETTINGS, camera=get_camera("nikon_z6"))
    with pytest.raises(ValueError, match="did you mean 'nikon_z6'"):
        read_raw(path, settings=SETTINGS, camera="nikon_z")
    with pytest.raises(ValueError, match="`camera`"):
        read_raw(path, settings=SETTINGS, camera=3)  # type: ignore[arg-type]


def test_unknown_camera_is_estimated_and_declared(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    light = np.broadcast_to(np.linspace(0.02, 0.8, 384), (256, 384))
    noisy = light + np.sqrt(4e-4 * light + 4e-6) * rng.standard_normal(light.shape)
    numbers = np.rint(np.clip(64 + 4031 * noisy, 0, 4095)).astype(np.uint16)
    write_sample_dng(tmp_path / "a.dng", numbers)
    raw = read_raw(tmp_path / "a.dng", settings=SETTINGS)
    assert raw.metadata["nlf_source"] == "blind estimate"
    variance = raw.noise.read[1] + 0.18 * raw.noise.shot[1]
    assert variance == pytest.approx(4e-4 * 0.18 + 4e-6, rel=0.15)
    # The estimate calibrates the camera, so that other ISOs have a noise level.
    assert raw.camera.nlf(400).shot[1] == pytest.approx(4 * raw.noise.shot[1])


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "txt", "bin", "nothing"])
def test_files_that_are_no_raw_say_what_they_are(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    words = {"jpg": "a JPEG", "png": "a PNG", "tif": "TIFF", "txt": "a text file"}
    words |= {"bin": "unknown type", "nothing": "an empty file"}
    picture = np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8)
    if suffix in ("jpg", "png", "tif"):
        imsave(path, picture, check_contrast=False)
    else:
        path.write_bytes({"txt": b"hello\n" * 99, "bin": b"\0\1" * 999, "nothing": b""}[suffix])
    with pytest.raises(RawFileError, match=words[suffix]) as caught:
        read_raw(path, settings=SETTINGS)
    assert f"a.{suffix}" in str(caught.value)
    assert str(tmp_path) not in str(caught.value)


@pytest.mark.parametrize("own", [False, True])
def test_what_was_read_does_not_depend_on_the_file(
    tmp_path: Path, mosaic: np.ndarray, own: bool
) -> None:
    """Neither LibRaw's memory nor the file is looked at once it was read."""
    path = tmp_path / "a.dng"
    write_sample_dng(path, mosaic)
    raw = read_raw(path, settings=SETTINGS, nlf=NLF)
    if own:
        write_dng(path, raw)
        raw = read_raw(path)
    before = raw.data.clone()
    with path.open("r+b") as stream:  # in place, so that a mapping would see it
        stream.write(bytes(path.stat().st_size))
    gc.collect()
    assert torch.equal(raw.data, before)
    expected = (mosaic[::2, ::2].astype(np.float64) - 64) / (4095 - 64)
    np.testing.assert_array_equal(raw.data[0].numpy(), expected.astype(np.float32))


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="does not exist"):
        read_raw(tmp_path / "none.dng")
    with pytest.raises(FileNotFoundError, match="is a folder"):
        read_raw(tmp_path)


def test_linear_dng_is_refused(tmp_path: Path, mosaic: np.ndarray) -> None:
    write_sample_dng(tmp_path / "a.dng", np.stack([mosaic] * 3, axis=-1), photometric=34892)
    with pytest.raises(RawFileError, match="linear DNG"):
        read_raw(tmp_path / "a.dng", settings=SETTINGS)


def test_x_trans_is_refused(tmp_path: Path, mosaic: np.ndarray) -> None:
    tile = "GBGGRG RGRBGB GBGGRG GRGGBG BGBRGR GRGGBG".replace(" ", "")
    cfa = bytes("RGB".index(letter) for letter in tile)
    write_sample_dng(tmp_path / "a.dng", mosaic, cfa=cfa, cfa_size=6)
    with pytest.raises(RawFileError, match="X-Trans"):
        read_raw(tmp_path / "a.dng", settings=SETTINGS)


@pytest.mark.parametrize("share", [0.05, 0.2, 0.5, 0.9, 0.999])
def test_truncated_dng_is_refused(tmp_path: Path, mosaic: np.ndarray, share: float) -> None:
    path = tmp_path / "a.dng"
    write_sample_dng(path, mosaic)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(RawFileError, match="truncated"):
        read_raw(path, settings=SETTINGS, nlf=NLF)


@pytest.mark.real_data
def test_canon_crw(data_dir: Path) -> None:
    raw = read_raw(data_dir / "canon_crw_cc0" / "CRW_0101.CRW")
    assert raw.settings.iso == 50
    assert raw.settings.exposure_time == pytest.approx(2 ** (-20 / 3))  # what 1/100 stands for
    assert raw.settings.f_number == pytest.approx(2.80, abs=0.005)
    assert raw.camera.cfa is BayerPattern.RGGB
    assert raw.camera.black_level == (32.0,) * 4
    assert raw.camera.white_level == 1023
    assert (raw.metadata["make"], raw.metadata["model"]) == ("Canon", "Canon PowerShot S40")
    assert raw.camera.colour_matrix is not None
    assert raw.camera.colour_matrix[0] == (0.8606, -0.2573, -0.0949)  # dcraw's table
    assert "LibRaw" in raw.camera.colour_matrix_source
    assert raw.metadata["datetime"].startswith("2021-04-08T14:51:12")
    assert raw.metadata["nlf_source"] == "blind estimate"
    # The chart's neutral row (white to black) has falling levels in every plane.
    assert raw.data.shape == (4, 860, 1156)
    white, black = raw.data[:, 600:640, 160:200], raw.data[:, 600:640, 950:990]
    assert float(white.mean()) > 10 * float(black.mean())


@pytest.mark.real_data
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.9999])
def test_truncated_crw_is_refused(data_dir: Path, tmp_path: Path, share: float) -> None:
    whole = (data_dir / "canon_crw_cc0" / "CRW_0101.CRW").read_bytes()
    path = tmp_path / "cut.crw"
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(RawFileError, match="truncated"):
        read_raw(path)


@pytest.mark.real_data
def test_headerless_array(data_dir: Path) -> None:
    path = data_dir / "raw_misc_mit" / "DSC_1339_768x512_rggb.raw"
    numbers = np.fromfile(path, "<u2").reshape(512, 768)
    camera = CameraProfile("mine", BayerPattern.RGGB, (600.0,) * 4, 16383, 14)
    raw = RawImage.from_mosaic(numbers, SETTINGS, camera, nlf=NLF)
    assert raw.data.shape == (4, 256, 384)
    np.testing.assert_array_equal(raw.to_mosaic(), numbers)
    with pytest.raises(RawFileError, match=re.escape(path.name) + ".*from_mosaic"):
        read_raw(path, settings=SETTINGS)
