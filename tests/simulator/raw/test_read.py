import io
import os
import re
import shutil
import struct
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rawpy
import tifffile
import torch
from skimage.io import imsave

from simulator import CameraSettings, NoiseLevelFunction, RawFileError, RawImage, read_raw
from simulator.camera import BayerPattern, CameraProfile, get_camera
from simulator.radiance.reading import read_radiance
from simulator.raw import read as read_module
from simulator.raw.dng import write_dng
from simulator.raw.metadata import camera_identity, is_raw_container, read_directories
from simulator.raw.read import read_settings

SETTINGS = CameraSettings(iso=100, exposure_time=1 / 60, f_number=4.0)
NLF = NoiseLevelFunction((1e-4,) * 4, (1e-6,) * 4)
MOSAIC = np.random.default_rng(0).integers(100, 4000, (64, 96), dtype=np.uint16)
#: XYZ to camera of a Nikon Z 6, any plausible matrix would do.
MATRIX = (0.9943, -0.3269, -0.0839, -0.5323, 1.3269, 0.2259, -0.1198, 0.2083, 0.7557)
CODE = tifffile.TIFF.EXIF_TAGS  # of a tag's name


def fractions(values):
    return tuple(part for v in np.ravel(values) for part in (round(v * 10000), 10000))


def write_sample_dng(path, mosaic=MOSAIC, *, black=(64,), photometric=32803, **changes):
    """A DNG by tifffile, not by the code under test; `changes` are types and values of tags."""
    tags = {"Make": ("s", "Test"), "Model": ("s", "Sensor")}
    tags |= {"UniqueCameraModel": ("s", "Test Sensor"), "DNGVersion": ("B", (1, 4, 0, 0))}
    tags |= {"DNGBackwardVersion": ("B", (1, 1, 0, 0)), "WhiteLevel": ("I", (4095,))}
    tags |= {"ColorMatrix1": ("2i", fractions(MATRIX)), "AsShotNeutral": ("2I", (1, 2, 1, 1, 2, 3))}
    tags |= {"CalibrationIlluminant1": ("H", (21,)), "BlackLevel": ("I", black)}
    tags["BlackLevelRepeatDim"] = "H", (len(black) // 4 + 1,) * 2
    if photometric == 32803:
        tags["CFARepeatPatternDim"], tags["CFAPattern"] = ("H", (2, 2)), ("B", b"\0\1\1\2")
        tags["CFAPlaneColor"], tags["CFALayout"] = ("B", (0, 1, 2)), ("H", (1,))
    extra = []
    for name, (kind, values) in (tags | changes).items():
        count = 0 if kind == "s" else len(values) // (2 if kind.startswith("2") else 1)
        single = kind != "s" and len(values) == 1
        extra.append((CODE[name], kind, count, values[0] if single else values, True))
    plain = {"photometric": photometric, "metadata": None, "software": False}
    tifffile.imwrite(path, mosaic, extratags=extra, **plain)
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A DNG of another program: black 64, white 4095."""
    return write_sample_dng(tmp_path / "a.dng")


@pytest.fixture
def own_dng(tmp_path: Path) -> Path:
    """A DNG of `write_dng`: black 1008, white 15520, 1/60 s."""
    path = tmp_path / "own.dng"
    write_dng(path, RawImage.from_mosaic(MOSAIC, SETTINGS, get_camera("nikon_z6"), nlf=NLF))
    return path


def test_what_libraw_takes_for_something_else(tmp_path):
    """Floating-point black levels, long ISOs, one level for a tile, cameras by their one name."""
    tags = {"BlackLevel": ("2I", (64, 4095)), "WhiteLevel": ("I", (1,)), "Model": ("s", "")}
    tags |= {"PhotographicSensitivity": ("I", (204_800,)), "BlackLevelRepeatDim": ("H", (2, 2))}
    path = write_sample_dng(tmp_path / "a.dng", (MOSAIC / 4095).astype(np.float32), **tags)
    assert read_settings(path) == {"iso": 204_800}
    raw = read_raw(path, settings=SETTINGS, nlf=NLF)
    light = (MOSAIC[::2, ::2] - 64) / (4095 - 64)
    np.testing.assert_allclose(raw.data[0], light, atol=1e-4)  # of 14 bits
    assert (raw.camera.make, raw.camera.model) == ("Test", "Test Sensor")
    tags = dict.fromkeys(("ExposureTime", "FNumber", "FocalLength"), ("2I", (5, 0)))  # not 5 s
    tags |= dict.fromkeys(("AsShotNeutral", "DefaultScale"), ("2I", (2, 0, 1, 1, 1, 1)))
    assert read_settings(write_sample_dng(path, **tags)) == {}
    known = read_raw(path, settings=SETTINGS, nlf=NLF).metadata
    assert not {"focal_length", "pixel_aspect"} & {*known}
    assert known["white_balance_source"] == "daylight"
    path = write_sample_dng(path, CFALayout=("H", (3,)))
    with pytest.raises(RawFileError, match="CFALayout"):
        read_raw(path)


def test_a_raw_without_noise_is_read_and_phones_mark_no_stops(tmp_path, caplog):
    for level, source in ((2000, "blind estimate"), (4095, "assumed: rounding alone")):
        path = write_sample_dng(tmp_path / f"{level}.dng", np.full_like(MOSAIC, level))
        raw = read_raw(path, settings=SETTINGS)
        assert raw.metadata["nlf_source"] == source
        assert raw.noise.read == pytest.approx((1 / 12 / 4031**2,) * 4)
        assert (f"{level}.dng: its noise cannot be told" in caplog.text) == (level == 4095)
    for model, time in (("SM-G998B", 1 / 60), ("Galaxy S24", 1 / 60), ("NX300", 1 / 64)):
        tags = {"Make": ("s", "samsung"), "Model": ("s", model), "ExposureTime": ("2I", (1, 60))}
        stated = read_settings(write_sample_dng(path, **tags))
        assert stated["exposure_time"] == pytest.approx(time)


def test_gain_maps_and_baseline_go_along(tmp_path):
    maps = {f"OpcodeList{i}": ("B", tuple(range(i, i + 40))) for i in (1, 2, 3)}

    def read(**tags):
        path = write_sample_dng(tmp_path / "a.dng", **maps, **tags)
        content = path.read_bytes()
        for name in maps:  # of type UNDEFINED, which tifffile does not write
            old, new = (struct.pack("<HHI", CODE[name], kind, 40) for kind in (1, 7))
            content = content.replace(old, new)
        path.write_bytes(content)
        return read_raw(path, settings=SETTINGS, nlf=NLF)

    # Those of another frame than the visible area are left out.
    assert list(read(ActiveArea=("I", (2, 4, 64, 96))).metadata["opcodes"][1]) == [*maps][1:]
    assert "opcodes" not in read(ActiveArea=("I", (1, 1, 63, 95))).metadata  # LibRaw's is even
    raw = read(BaselineExposure=("2i", (3, 2)))
    write_dng(tmp_path / "b.dng", raw)
    write_dng(tmp_path / "c.dng", replace(raw, data=raw.data[:, 4:, 4:].contiguous()))
    with tifffile.TiffFile(tmp_path / "b.dng") as file:
        tags = file.pages[0].tags
        assert tags["BaselineExposure"].value == (3, 2)
        for name, (_, values) in maps.items():
            assert bytes(tags[name].value) == bytes(values)
    with tifffile.TiffFile(tmp_path / "c.dng") as file:  # positions would be wrong
        assert not set(maps) & {tag.name for tag in file.pages[0].tags}


@pytest.mark.parametrize("rows", [64, 1024, 1025, 2602])
def test_a_rows_own_black_level_may_be_negative(tmp_path, rows):
    deltas = {"BlackLevelDeltaV": ("2i", (-1, 10) * rows)}
    mosaic = np.resize(MOSAIC, (rows, 96))
    path = write_sample_dng(tmp_path / "a.dng", mosaic, black=(0,), **deltas)
    light = (mosaic[: rows // 2 * 2 : 2, ::2] + 0.1) / 4095
    raw = read_raw(path, settings=SETTINGS, nlf=NLF)
    np.testing.assert_allclose(raw.data[0], light, rtol=1e-6)


def test_levels_colour_and_metadata(tmp_path):
    path = write_sample_dng(tmp_path / "a.dng", DefaultScale=("2I", (2, 1, 1, 1)))
    with pytest.raises(ValueError, match=r"`settings`.*iso, exposure_time, f_number"):
        read_raw(path)
    with pytest.raises(ValueError, match="`settings`"):
        read_raw(path, settings={"speed": 64})
    path = path.rename(tmp_path / os.fsdecode(b"\xff.dng"))  # a name that is no UTF-8
    raw = read_raw(str(path), settings=SETTINGS, nlf=NLF)
    assert raw.metadata["pixel_aspect"] == 2.0
    assert raw.settings == SETTINGS  # given settings are not snapped
    known = {"path": "\\udcff.dng", "make": "Test", "model": "Sensor", "nlf_source": "given"}
    assert known.items() <= raw.metadata.items()
    os.truncate(path, 2**36)  # a hole
    with pytest.raises(RawFileError, match=f"more than {2**30} bytes"):
        read_raw(path, settings=SETTINGS)
    camera = raw.camera
    assert (raw.noise, camera.name, camera.bit_depth) == (NLF, "test_sensor", 12)
    np.testing.assert_allclose(np.ravel(camera.colour_matrix), MATRIX, atol=1e-6)
    assert "ColorMatrix of the file" in camera.colour_matrix_source
    # Of two colour matrices that of daylight is taken.
    tags = {"CalibrationIlluminant1": ("H", (17,)), "CalibrationIlluminant2": ("H", (21,))}
    tags["ColorMatrix2"] = "2i", fractions(2 * np.eye(3))
    tags["CameraCalibration2"] = "2i", fractions(np.diag([0.5, 1, 2]))
    raw = read_raw(write_sample_dng(tmp_path / "a.dng", **tags), settings=SETTINGS, nlf=NLF)
    np.testing.assert_allclose(raw.camera.colour_matrix, np.diag([1.0, 2.0, 4.0]))


def assert_on_12_bits(raw, camera):
    """The camera's noise as a share of the converter's range."""
    factor = (sum(camera.span) / 4 / 2**14) / ((4095 - 64) / 2**12)
    wanted = camera.nlf(100)
    assert raw.noise.shot == pytest.approx([factor * v for v in wanted.shot])
    assert raw.noise.read == pytest.approx([factor**2 * v for v in wanted.read])


@pytest.mark.parametrize(
    ("profile", "shot", "read"),
    [
        ((1e-4, 2e-6), (1e-4,) * 4, (2e-6,) * 4),
        ((1e-4, 1e-6, 2e-4, 2e-6, 3e-4, 3e-6), (1e-4, 2e-4, 2e-4, 3e-4), (1e-6, 2e-6, 2e-6, 3e-6)),
        *((pair, None, None) for pair in [(np.nan, 0), (1e300, 0), (-1, 0), (1e-4, -1e300)]),
    ],
)
def test_noise_profile_wins_if_it_can_be_one(tmp_path, caplog, profile, shot, read):
    canon = {"Make": ("s", "Canon"), "Model": ("s", "Canon EOS 70D")}
    path = write_sample_dng(tmp_path / "a.dng", **canon, NoiseProfile=("d", profile))
    raw = read_raw(path, settings=SETTINGS)
    if shot is None:
        assert "NoiseProfile" in caplog.text
        assert_on_12_bits(raw, get_camera("canon_70d"))
        assert raw.metadata["nlf_source"] == "camera calibration (canon_70d)"
    else:
        assert (raw.noise.shot, raw.noise.read) == (pytest.approx(shot), pytest.approx(read))
        assert raw.metadata["nlf_source"] == "DNG NoiseProfile"
    camera = raw.camera
    assert (camera.name, camera.black_level[0], camera.white_level) == ("canon_70d", 64, 4095)


def test_cameras_that_are_given_or_estimated(path, tmp_path):
    named = read_raw(path, settings=SETTINGS, camera="nikon_z6")
    assert_on_12_bits(named, get_camera("nikon_z6"))
    assert named.camera.white_level == 4095
    own = CameraProfile("mine", BayerPattern.RGGB, (50.0,) * 4, 4000, 12).with_nlf(100, NLF)
    raw = read_raw(path, settings=SETTINGS, camera=own)
    assert raw.camera == own
    assert raw.data[0, 0, 0] == pytest.approx((int(MOSAIC[0, 0]) - 50) / 3950)
    for camera in (replace(own, cfa=BayerPattern.GBRG), get_camera("nikon_z6"), "nikon_z", 3):
        with pytest.raises(ValueError, match="`camera`"):
            read_raw(path, settings=SETTINGS, camera=camera)
    raw = read_raw(path, settings=SETTINGS)
    # The estimate calibrates the camera, so that other ISOs have a noise level.
    assert raw.camera.nlf(400).shot[1] == pytest.approx(4 * raw.noise.shot[1])


@pytest.mark.real_data
def test_canon_crw(data_dir, tmp_path):
    path = shutil.copyfile(data_dir / "canon_crw_cc0" / "CRW_0101.CRW", tmp_path / "cut.crw")
    raw = read_raw(path)
    assert (raw.settings.iso, raw.settings.f_number) == (50, pytest.approx(2.80, abs=0.005))
    assert raw.settings.exposure_time == pytest.approx(2 ** (-20 / 3))  # what 1/100 stands for
    camera, known = raw.camera, raw.metadata
    assert (camera.cfa, camera.black_level, camera.white_level) == ("RGGB", (32.0,) * 4, 1023)
    assert (known["make"], known["model"]) == ("Canon", "Canon PowerShot S40")
    assert known["datetime"].startswith("2021-04-08T14:51:12")
    assert camera.colour_matrix[0] == (0.8606, -0.2573, -0.0949)  # dcraw's table
    assert "LibRaw" in camera.colour_matrix_source
    assert raw.data.shape == (4, 860, 1156)
    for size in range(path.stat().st_size - 1, 0, -100 * 1024):
        os.truncate(path, size)
        with pytest.raises(RawFileError, match=r"`path` \(='cut.crw'\).*truncated"):
            read_raw(path)


@pytest.mark.parametrize("given", [None, 3, b"x", ["a.dng"]])
def test_what_is_no_file(given, own_dng, tmp_path):
    for call in (read_raw, lambda path: write_dng(path, read_raw(own_dng))):
        with pytest.raises(ValueError, match="`path`"):
            call(given)
    for path in (tmp_path / "none", tmp_path, Path(os.devnull)):
        with pytest.raises(FileNotFoundError, match="`path`"):
            read_raw(path)
        with pytest.raises(RawFileError, match=r"\) (does not exist|is a folder|is no ordinary)"):
            read_settings(path)
    for target, raw, name in (("a.tif", read_raw(own_dng), "path"), (own_dng, None, "raw")):
        with pytest.raises(ValueError, match=f"`{name}`"):
            write_dng(tmp_path / target, raw)


@pytest.mark.parametrize(
    "content", ["jpg", "png", "tif", b"hello\n" * 99, b"\0\1" * 999, b"", b"II*\0"]
)
def test_files_that_are_no_raw_are_named(tmp_path, content):
    path = tmp_path / "a.dng"
    if isinstance(content, str):
        imsave(tmp_path / f"b.{content}", np.zeros((8, 8, 3), np.uint8), check_contrast=False)
        content = (tmp_path / f"b.{content}").read_bytes()
    path.write_bytes(content)
    with pytest.raises(RawFileError, match=r"`path` \(='a\.dng'\)"):
        read_raw(path, settings=SETTINGS)


def test_arrays_that_are_not_bayer_are_refused(tmp_path):
    path = tmp_path / "a.dng"
    write_sample_dng(path, np.stack([MOSAIC] * 3, axis=-1), photometric=34892)
    with pytest.raises(RawFileError, match="linear DNG"):
        read_raw(path)
    bayer, linear = (struct.pack("<HHII", 262, 3, 1, kind) for kind in (32803, 34892))
    path.write_bytes(write_sample_dng(path).read_bytes().replace(bayer, linear))
    with pytest.raises(RawFileError, match="monochrome"):
        read_raw(path)
    colours = tuple("RGB".index(c) for c in "GBGGRGRGBRGBGBGGRGGRGGBGBGBRGRGRGGBG")
    write_sample_dng(path, CFAPattern=("B", colours), CFARepeatPatternDim=("H", (6, 6)))
    with pytest.raises(RawFileError, match="X-Trans"):
        read_raw(path)


def patch(path, name, form, *values):
    """Overwrites a tag's value; with the form ``count``, how many values it claims to have."""
    content = bytearray(path.read_bytes())
    code = re.escape(struct.pack("<H", CODE[name]))
    entry = re.search(code + rb"[\1-\x0c]\0", content).start()
    kind, count, position = struct.unpack_from("<HII", content, entry + 2)
    short = count * {1: 1, 2: 1, 3: 2, 4: 4, 7: 1}.get(kind, 8) <= 4
    at, form = (entry + 4, "I") if form == "count" else (entry + 8 if short else position, form)
    struct.pack_into(f"<{form}", content, at, *values)
    path.write_bytes(content)


NEUTRAL, EXACT = ("white_balance", (1.0, 1.0, 1.0)), ("settings", SETTINGS)
LARGEST = ("white_level", 65535)


@pytest.mark.parametrize(
    ("name", "form", "values", "changed"),
    [
        ("AsShotNeutral", "6I", (0, 0, 0, 0, 0, 1), NEUTRAL),
        ("ExposureTime", "2I", (1, 0), EXACT),
        ("FNumber", "count", (0,), EXACT),
        ("PhotographicSensitivity", "H", (800,), ("settings", replace(SETTINGS, iso=800))),
        ("Orientation", "H", (99,), ("flip", 0)),
        ("ImageWidth", "I", (0,), "64 x 0 pixels"),
        ("StripOffsets", "count", (2**28,), "at no position"),
        ("StripOffsets", "I", (2**32 - 1,), "truncated"),
        ("CFAPattern", "4B", (9, 1, 1, 2), "CFAPattern"),
        ("BlackLevel", "I", (70_000,), "white level above its black levels"),
        # dcraw takes the first of them, LibRaw 0.
        *(("BlackLevel", "count", (n,), f"has {n} in BlackLevel.*exiftool") for n in (2, 3)),
        # GoPro's, which LibRaw lacks: the file is whole all the same.
        ("Compression", "H", (9,), r"LibRaw lacks its compression, 9 \(VC-5.*convert"),
        # Also in a DNG of another program:
        *(("WhiteLevel", "I", (white,), LARGEST) for white in (0, 65536, 2**32 - 1)),
        ("Sides", "I", (20_000,), "20000 x 20000 pixels.*at most 268435456 are read"),
    ],
)
def test_what_a_dng_lost_falls_back_or_is_named(own_dng, path, caplog, name, form, values, changed):
    files = {"WhiteLevel": (own_dng, path), "Sides": (own_dng, path), "Compression": (path,)}
    for file in files.get(name, (own_dng,)):
        given = {} if file is own_dng else {"settings": SETTINGS, "nlf": NLF}
        for each in ("ImageWidth", "ImageLength") if name == "Sides" else (name,):
            patch(file, each, form, *values)
        if isinstance(changed, str):
            with pytest.raises(RawFileError, match=changed):
                read_raw(file, **given)
            continue
        raw = read_raw(file, **given)
        np.testing.assert_array_equal(raw.to_mosaic(), MOSAIC)
        known = {"white_level": raw.camera.white_level, "settings": raw.settings}
        known |= {"white_balance": raw.white_balance, **raw.metadata}
        assert known.get(changed[0]) == changed[1]
        assert changed != LARGEST or f"white level (={values[0]})" in caplog.text


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, or with up to four pieces lost or overwritten, most of them near the beginning."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(1 + len(data) if rng.random() < 0.3 else 1024))
        lost, new = rng.integers(65, size=2) // rng.choice([1, 64])  # a piece, or a byte
        data[at : at + lost] = rng.bytes(new)
    return bytes(data if rng.random() < 0.8 else data[: rng.integers(1 + len(data))])


@pytest.mark.parametrize("name", ["a.dng", "own.dng"])
def test_damaged_files_are_read_or_refused(path, own_dng, name):
    content, rng, refused = path.with_name(name).read_bytes(), np.random.default_rng(5), 0
    for size in range(len(content) - 1, -1, -512):
        path.write_bytes(content[:size])
        with pytest.raises(RawFileError, match=r"`path` \(='a.dng'"):
            read_raw(path, settings=SETTINGS, nlf=NLF)
    for _ in range(120):
        path.write_bytes(damaged(content, rng))
        try:
            assert bool(torch.isfinite(read_raw(path, settings=SETTINGS, nlf=NLF).data).all())
        except RawFileError:
            refused += 1
    assert 15 < refused < 120


@pytest.mark.filterwarnings("ignore")  # libraries may warn of a file; the program must not stop
def test_damaged_radiance_maps_are_read_or_refused(tmp_path):
    openexr = pytest.importorskip("OpenEXR")
    rng, refused = np.random.default_rng(0), 0
    pixels = rng.integers(100, 140, (16, 32, 4), dtype=np.uint8)
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 32\n"
    (tmp_path / "map.hdr").write_bytes(head + pixels.tobytes())
    channels = {name: rng.random((16, 32), np.float32) for name in "RGB"}
    for kind in (openexr.NO_COMPRESSION, openexr.ZIP_COMPRESSION, openexr.PIZ_COMPRESSION):
        header = {"compression": kind, "type": openexr.scanlineimage}
        openexr.File(header, channels).write(str(tmp_path / f"{kind}.exr"))
    originals = sorted(tmp_path.iterdir())
    for number in range(120):
        original = originals[number % len(originals)]
        path = original.with_stem("damaged")
        path.write_bytes(damaged(original.read_bytes(), np.random.default_rng([7, number])))
        try:
            assert np.isfinite(read_radiance(path)).all()
        except ValueError:
            refused += 1
    assert 30 < refused < 120


def test_white_levels_that_are_wrong_or_beyond_the_bits_of_a_sample(tmp_path, caplog):
    """Its brightest sample is four times that level."""
    camera = CameraProfile("sensor", BayerPattern.RGGB, (64.0,) * 4, 4095, 12)
    given = {"settings": SETTINGS, "nlf": NLF, "camera": camera}
    path = write_sample_dng(tmp_path / "a.dng", WhiteLevel=("I", (1000,)))
    raw = read_raw(path, **given)
    assert raw.camera.white_level == 4095
    np.testing.assert_array_equal(raw.to_mosaic(), MOSAIC)
    wrong = read_raw(path, **given | {"camera": None})
    times = (MOSAIC.max() - 64.0) / (1000 - 64)
    assert float(wrong.data.max()) == pytest.approx(times, rel=1e-6)
    assert f"{times:.3g} times white" in caplog.text
    # Private, as there is no such file to test on: Sony's ARW compress 14 bits to 12.
    tags = {"PhotometricInterpretation": (32803,), "BitsPerSample": (12,)}
    stated = tags | {"WhiteLevel": (15360,)}
    for own, brightest, wanted in ((tags, 900, 15360), (stated, 14000, 15360), (stated, 900, 4095)):
        mosaic, path = np.full((2, 2), brightest, np.uint16), Path("a.arw")
        assert read_module._white_level(path, 15360.0, [512.0] * 4, [own], mosaic) == wanted


def tiff(entries: list[tuple[int, int, int, int]], following: int = 0) -> bytes:
    """A directory at 8 of (tag, type, count, value) entries."""
    head = struct.pack("<2sHIH", b"II", 42, 8, len(entries))
    body = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return head + body + struct.pack("<I", following)


def test_a_panasonic_whose_strip_has_no_position(tmp_path):
    """As the cameras write RW2 and RWL: the pixels' position is in a tag of their own, 0x118."""
    numbers = {2: 280, 3: 120, 4: 0, 5: 0, 6: 120, 7: 280, 9: 1, 0x17: 200, 0x112: 1, 0x1C: 0}
    numbers |= {0x1D: 0, 0x1E: 0, 0x24: 500, 0x25: 263, 0x26: 400}
    entries = [(code, 3, 1, value) for code, value in numbers.items()]
    entries += [(1, 7, 4, 0x30313330), (0x10F, 2, 10, 512), (0x110, 2, 8, 528)]
    long = {0x111: 2**32 - 1, 0x116: 120, 0x117: 0, 0x118: 1024}
    entries += [(code, 4, 1, value) for code, value in long.items()]
    content = tiff(sorted(entries)).replace(b"II*", b"IIU", 1).ljust(512, b"\0")
    content += b"Panasonic".ljust(16, b"\0") + b"DMC-GF1"
    path = tmp_path / "a.rw2"
    path.write_bytes(content.ljust(1024, b"\0") + bytes([85]) * (280 * 120 * 8 // 7 + 0x4000))
    given = {"settings": {"exposure_time": 1 / 125, "f_number": 2.8}}
    raw = read_raw(path, **given)  # its few levels are no clips
    with rawpy.imread(str(path)) as decoded:
        np.testing.assert_array_equal(raw.to_mosaic(), decoded.raw_image_visible.clip(0, 3986))
    assert (raw.settings.iso, raw.camera.name) == (200, "panasonic_dmc-gf1")
    os.truncate(path, 20_000)
    with pytest.raises(RawFileError, match=r"'a.rw2'.*names 19424 bytes beyond.*truncated"):
        read_raw(path, **given)


def test_identities_of_other_containers(tmp_path):
    dng = write_sample_dng(tmp_path / "a.dng").read_bytes()
    raf = b"FUJIFILMCCD-RAW 0201FF159501" + b"X-T1".ljust(32, b"\0") + bytes(99)
    mrw = b"\0MRM" + bytes(4) + b"\0PRD" + bytes(28) + b"\0TTW" + bytes(4) + dng
    cr3 = struct.pack(">I", 24) + b"ftypcrx " + bytes(12) + struct.pack(">I", 9) + b"CMT1" + dng
    names = b"Canon\0PowerShot\0"  # one record follows, then where it is
    record = struct.pack("<HHIII", 1, 0x080A, len(names), 0, len(names))
    ciff = struct.pack("<2sI8s", b"II", 14, b"HEAPCCDR") + names + record
    known = {raf: ("FUJIFILM", "X-T1"), mrw: ("Test", "Sensor"), cr3: ("Test", "Sensor")}
    known |= {ciff: ("Canon", "PowerShot"), b"": ("", ""), bytes(99): ("", "")}
    for content, identity in known.items():
        assert camera_identity(io.BytesIO(content), []) == identity
    kinds = dict.fromkeys((raf, mrw, cr3, b"FOVb"), True)
    for content, is_raw in (kinds | dict.fromkeys((ciff, b"text", b""), False)).items():
        assert is_raw_container(io.BytesIO(content)) is is_raw  # a whole Canon CRW names its camera


def test_structures_that_never_end_are_left_and_a_damaged_tag_costs_no_other():
    # A directory that is its own sub-directory, EXIF directory and successor.
    loop = [(CODE[name], 4, 1, 8) for name in ("SubIFDs", "ExifTag")]
    assert read_directories(io.BytesIO(tiff(loop, following=8))) == []
    # One place very many times, and places that are none.
    many = tiff([(CODE["SubIFDs"], 4, 2**18 - 1, 26)]).ljust(26, b"\0") + b"\x08\0\0\0" * 2**18
    assert read_directories(io.BytesIO(many)) == []
    assert read_directories(io.BytesIO(tiff([(CODE["SubIFDs"], 2, 1, 0x41)]))) == []  # text
    # A chain of very many directories.
    entry = struct.pack("<HHII", CODE["Make"], 2, 4, 0x00414141)
    chain = (struct.pack("<H", 1) + entry + struct.pack("<I", 26 + 18 * i) for i in range(10**5))
    assert len(read_directories(io.BytesIO(tiff([])[:8] + b"".join(chain)))) <= 64
    # A Canon heap of 64 records, each of which is the heap itself.
    heap = struct.pack("<H", 64) + 64 * struct.pack("<HII", 0x2800, 2 + 64 * 10 + 4, 0)
    content = struct.pack("<2sI8s", b"II", 14, b"HEAPCCDR") + heap + struct.pack("<I", 0)
    assert camera_identity(io.BytesIO(content), []) == ("", "")
    no_such_type, beyond_the_end = (CODE["Make"], 99, 1, 0), (CODE["StripOffsets"], 4, 7, 2**31)
    content = tiff([no_such_type, beyond_the_end, (CODE["WhiteLevel"], 4, 1, 4095)])
    for magic, found in ((42, 1), (0x4F52, 1), (0x5352, 1), (0x55, 1), (0, 0)):
        file = io.BytesIO(content[:2] + struct.pack("<H", magic) + content[4:])
        assert read_directories(file) == found * [{"WhiteLevel": (4095,)}]


# -- DNGs drawn over makers, layouts, levels, orientations and places of exposure ------------------

MARKING = ("Canon", "NIKON CORPORATION", "SONY", "Panasonic", "Leica Camera AG", "samsung")
MAKES = (*MARKING, "Google", "RaspberryPi", "Apple")  # these record times, the others stops
#: Times as they are written, and the stops that they mark.
TIMES = {(1, 60): 1 / 64, (10, 600): 1 / 64, (1, 4000): 1 / 4096, (16666667, 10**9): 0.016666667}
FLIPS = {None: 0, 1: 0, 2: 1, 3: 3, 4: 2, 5: 4, 6: 6, 7: 7, 8: 5}  # orientation to LibRaw's code
FILES, EXIF_AT, RAW_AT, DATA_AT = 120, 2**14, 2**15, 2**16


def directory(order: str, tags: dict[str, Any], at: int) -> bytes:
    """A TIFF directory at `at`: fractions and pairs are RATIONAL, uint32 LONG, others SHORT."""
    entries, outside = b"", b""
    for code, name in sorted((tifffile.TIFF.EXIF_TAGS[name], name) for name in tags):
        value = tags[name]
        if isinstance(value, str | bytes):
            data, kind = (value, 1) if isinstance(value, bytes) else (value.encode() + b"\0", 2)
            count = len(data)
        else:
            array = np.array(value)
            if array.dtype.kind == "f":
                array = np.stack([np.rint(1000 * array.ravel()), np.full(array.size, 1000)], -1)
            signed = name.startswith(("Color", "BlackLevelDelta"))
            kind = (10 if signed else 5) if array.ndim == 2 else 4 if array.dtype == "u4" else 3
            count = len(array) if array.ndim == 2 else array.size
            data = array.astype(order + {3: "u2", 4: "u4", 5: "u4", 10: "i4"}[kind]).tobytes()
        place = struct.pack(f"{order}I", at + 6 + 12 * len(tags) + len(outside))
        entries += struct.pack(f"{order}HHI", code, kind, count)
        entries += place if len(data) > 4 else data.ljust(4, b"\0")
        outside += data + bytes(len(data) % 2) if len(data) > 4 else b""
    return struct.pack(f"{order}H", len(tags)) + entries + bytes(4) + outside


def draw(seed: int, path: Path) -> SimpleNamespace:
    """Writes a DNG, and says what is right."""
    rng = np.random.default_rng(seed)

    def pick(*options: Any) -> Any:
        return options[rng.integers(len(options))]

    order, bits, cfa = pick("<", ">"), pick(8, 10, 12, 14, 16), pick("RGGB", "BGGR", "GRBG", "GBRG")
    height, width, *margins = rng.integers([48, 48, 0, 0, 1, 1], [90, 90, 5, 5, 5, 5]).tolist()
    area = top, left, bottom, right = (*margins[:2], height - margins[2], width - margins[3])
    stored, white = rng.integers(0, 2**bits, (height, width)), (2**bits - 1) * pick(15, 16) // 16
    colours = pick((0, 1, 2), (0, 1, 2), (1, 0, 2), (2, 1, 0))
    pattern = {"CFARepeatPatternDim": (2, 2), "CFAPattern": bytes("RGB".index(c) for c in cfa)}
    size = {"ImageLength": height, "ImageWidth": width, "StripByteCounts": height * width * 2}
    plain = {"Compression": 1, "SamplesPerPixel": 1, "BitsPerSample": bits}
    raw = pattern | size | plain | {"ActiveArea": area, "StripOffsets": np.uint32(DATA_AT)}
    raw |= {"PhotometricInterpretation": 32803, "CFAPlaneColor": bytes(colours)}
    values = stored[top:bottom, left:right]
    if bits < 13 and pick(True, False):
        white = 59999
        table = raw["LinearizationTable"] = np.sort([*rng.integers(0, white, 2**bits - 1), white])
        values = table[values]
    raw |= {} if white == 2**bits - 1 else {"WhiteLevel": pick(np.uint16, np.uint32)(white)}
    tile = rng.integers(
        160, 320, pick((1, 1), (1, 2), (2, 1), (2, 2), (2, 2), (3, 3), (4, 4), (6, 2))
    )
    tile = pick(tile / 4, tile / 4, tile // 4)
    raw["BlackLevel"] = tile.ravel()
    if pick(True, False) or tile.shape not in ((1, 1), (2, 2)):  # where writers leave it out
        raw["BlackLevelRepeatDim"] = tile.shape
    level = np.tile(tile, values.shape)[: bottom - top, : right - left]
    for name, shape in (("BlackLevelDeltaV", (-1, 1)), ("BlackLevelDeltaH", (1, -1))):
        if pick(True, False, False):
            raw[name] = rng.integers(-20, 20, values.shape[name.endswith("H")]) / 4
            level = level + raw[name].reshape(shape)
    make, orientation, preview = pick(*MAKES), pick(*FLIPS), pick(None, 2, 32803)
    head = {"Make": make, "Model": "Cam", "DNGVersion": bytes((1, 4, 0, 0))}
    head |= {"ColorMatrix1": np.eye(3), "CalibrationIlluminant1": 21}
    head |= {"AsShotNeutral": pick(1.0, 0.8) * np.take((0.5, 1.0, 0.625), colours)}
    head |= {"ExifTag": np.uint32(EXIF_AT)} | ({"Orientation": orientation} if orientation else {})
    time, number, iso = pick(*TIMES), pick(18, 28, 80), pick(None, 50, 64000, 102400)
    exposure = {"ExposureTime": [time], "FNumber": [(number, 10)]}
    if iso is not None:
        long = {"RecommendedExposureIndex": np.uint32(iso)}
        exposure |= long if iso > 65535 else {"PhotographicSensitivity": iso}
    exif = pick(exposure, {"DateTimeOriginal": "2020:02:02 20:20:20"})
    head |= {} if exif is exposure else exposure
    if preview:  # RGB or another mosaic
        head |= pattern | plain | {"NewSubfileType": 1, "PhotometricInterpretation": preview}
        head |= {"ImageLength": 32, "ImageWidth": 32, "BitsPerSample": 8, "BlackLevel": 1}
        head |= {"StripOffsets": 8, "StripByteCounts": 1024, "SubIFDs": np.uint32(RAW_AT)}
    packed = stored.astype(f"{order}u2").tobytes()
    if bits < 16:
        single = stored[..., None] >> np.arange(bits)[::-1] & 1
        packed = np.packbits(single.reshape(height, -1), axis=1).tobytes()
    content = struct.pack(f"{order}HHI", 0x4949 if order == "<" else 0x4D4D, 42, 8)
    content += directory(order, head if preview else head | raw, 8)
    content = content.ljust(EXIF_AT, b"\0") + directory(order, exif, EXIF_AT)
    content = content.ljust(RAW_AT, b"\0") + directory(order, raw, RAW_AT)
    path.write_bytes(content.ljust(DATA_AT, b"\0") + packed.ljust(height * width * 2, b"\0"))
    return SimpleNamespace(**locals())


def test_read_raw_and_libraw_agree_with_the_specification(tmp_path):
    """What is right is drawn, and written by the DNG specification, with no code under test.

    (exiftool 12.57 and dcraw 9.28 said the same of these files.)
    """
    path = tmp_path / "a.dng"
    for seed in range(FILES):
        file = draw(seed, path)
        time = TIMES[file.time] if file.make in MARKING else file.time[0] / file.time[1]
        known = {"exposure_time": pytest.approx(time), "f_number": file.number / 10}
        assert read_settings(path) == known | ({"iso": file.iso} if file.iso else {}), seed
        raw = read_raw(path, nlf=NLF, settings={} if file.iso else {"iso": 100})  # one alone
        # LibRaw begins an odd visible area one row or column further in.
        row, column = file.top % 2, file.left % 2
        values, level = file.values[row:, column:], file.level[row:, column:]
        assert raw.data.shape[1:] == tuple(n // 2 for n in values.shape)
        tile = np.roll(np.array([*file.cfa]).reshape(2, 2), (-row, -column), (0, 1))
        for plane, letter in enumerate("RGGB"):  # G1 is on red's rows
            places = np.argwhere((tile == letter) & ((tile == "R").any(1) == (plane < 2))[:, None])
            (y, x), (high, wide) = places[0], raw.data.shape[1:]
            own, black = values[y::2, x::2][:high, :wide], level[y::2, x::2][:high, :wide]
            mean, white = black.mean(), file.white  # what is white stays so, and only that is
            left = np.where(own < white, np.minimum(own - black, white - 1 - mean), own - mean)
            expected = left / (white - mean)
            np.testing.assert_allclose(raw.data[plane], expected, atol=1e-6, err_msg=f"{seed}")
            assert raw.camera.black_level[plane] == pytest.approx(black.mean()), seed
        found = raw.camera.cfa, raw.camera.white_level, raw.metadata["flip"], raw.camera.make
        flip = FLIPS[file.orientation]
        assert found == ("".join(tile.ravel()), file.white, flip, file.make), seed
        assert raw.white_balance == pytest.approx((2.0, 1.0, 1.6)), seed
        with rawpy.imread(str(path)) as decoded:
            np.testing.assert_array_equal(decoded.raw_image_visible, values)
            assert decoded.sizes.flip == flip, seed
            assert decoded.white_level == file.white or "WhiteLevel" not in file.raw, seed
