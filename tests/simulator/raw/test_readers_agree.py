"""Readers agree on DNGs drawn over makers, layouts, levels, orientations and places of exposure.

What is right is drawn, and written by the DNG specification, with no code under test. (exiftool
12.57 and dcraw 9.28 said the same of these files.)
"""

import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rawpy
import tifffile

from simulator import NoiseLevelFunction, read_raw
from simulator.raw.read import read_settings

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
    nlf, path = NoiseLevelFunction((1e-4,) * 4, (1e-6,) * 4), tmp_path / "a.dng"
    for seed in range(FILES):
        file = draw(seed, path)
        time = TIMES[file.time] if file.make in MARKING else file.time[0] / file.time[1]
        known = {"exposure_time": pytest.approx(time), "f_number": file.number / 10}
        assert read_settings(path) == known | ({"iso": file.iso} if file.iso else {}), seed
        raw = read_raw(path, nlf=nlf, settings={} if file.iso else {"iso": 100})  # one alone
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
