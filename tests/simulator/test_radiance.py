"""Radiance maps: what a file says beside its pixels is followed, or refused by name."""

from itertools import product

import numpy as np
import pytest

from agents.applications.refocus import read_depth
from simulator.radiance import reading
from simulator.radiance.reading import read_radiance

OpenEXR = pytest.importorskip("OpenEXR")

IMAGE = np.random.default_rng(0).uniform(0.1, 2.0, (6, 10, 3)).astype(np.float32)
GREY = np.full((6, 10), 0.25, np.float32)
DISTANCE = np.full((6, 10), 3.0, np.float32)


def channels(image=IMAGE, layer=""):
    return {f"{layer}{c}": np.ascontiguousarray(image[..., i]) for i, c in enumerate("RGB")}


def part(name, planes, **header):
    return OpenEXR.Part({"name": name, "type": OpenEXR.scanlineimage, **header}, planes)


def write(path, *parts):
    OpenEXR.File([*parts]).write(str(path))
    return path


def assert_image(found, image=IMAGE, **tolerance):
    np.testing.assert_allclose(found, image.transpose(2, 0, 1), **tolerance)


def test_the_part_and_layer_with_the_colours_is_the_picture(tmp_path):
    path, occlusion = tmp_path / "a.exr", part("occlusion", {"Y": GREY})
    depth = part("depth", {"Z": DISTANCE})
    assert_image(read_radiance(write(path, occlusion, part("beauty", channels()), depth)))
    assert (read_depth(path) == 3.0).all()
    normals = part("normals", channels(1.0 + IMAGE))
    write(path, normals, part("beauty", channels()))
    with pytest.raises(ValueError, match=r"a.exr.*'normals', 'beauty'"):
        read_radiance(path)
    assert_image(read_radiance(path, layer="beauty"))
    with pytest.raises(ValueError, match="called 'albedo'"):
        read_radiance(path, layer="albedo")
    with pytest.raises(ValueError, match="`depth`"):  # red is no distance
        read_depth(write(path, part("beauty", channels())))
    # Blender's names, small letters, and layers beside R, G, B.
    normals = {f"ViewLayer.Normal.{name}": GREY for name in "XYZ"}
    blender = channels(layer="ViewLayer.Combined.") | {"ViewLayer.Depth.Z": DISTANCE} | normals
    assert_image(read_radiance(write(path, part("a", blender))))
    assert all((read_depth(path, layer=n) == 3.0).all() for n in (None, "ViewLayer.Depth"))
    small = {name.lower(): plane for name, plane in channels().items()}
    assert_image(read_radiance(write(path, part("a", small))))
    small = {name.lower(): plane for name, plane in channels(IMAGE + 1).items()}
    assert_image(read_radiance(write(path, part("a", channels() | small))))
    for planes in (normals, dict.fromkeys("UV", GREY), dict.fromkeys(("Y", "RY", "BY"), GREY)):
        with pytest.raises(ValueError, match="must have"):  # neither light nor depth
            read_depth(write(path, part("n", planes), part("beauty", channels())))
        with pytest.raises(ValueError, match=r"must have|states primaries"):
            read_radiance(write(path, part("n", planes, chromaticities=(float("nan"),) * 8)))
    assert_image(read_radiance(write(path, part("a", channels() | channels(IMAGE + 1, "left.")))))
    (deep := np.empty((6, 10), object)).fill(np.ones(2, np.float32))
    kind = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    with pytest.raises(ValueError, match="deep, which is not read"):
        read_radiance(write(path, part("a", dict.fromkeys("RGB", deep), **kind)))


def test_colours_are_converted_by_the_chromaticities_of_the_file(tmp_path):
    """XYZ by the matrix of IEC 61966-2-1; the same in Radiance's two ways to say it."""
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    xyz = (IMAGE @ np.transpose(to_xyz)).astype(np.float32)
    primaries = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
    path = write(tmp_path / "a.exr", part("a", channels(xyz), chromaticities=primaries))
    assert_image(read_radiance(path), rtol=2e-3, atol=2e-3)
    pixels, xyz[0, 0] = rgbe(xyz), np.inf  # the sun
    path = write(tmp_path / "b.exr", part("a", channels(xyz), chromaticities=primaries))
    assert read_radiance(path)[:, 0, 0].min() > 0.5 * np.delete(xyz, 0, axis=0).max()
    for head in ("FORMAT=32-bit_rle_xyze", "PRIMARIES=1 0 0 1 0 0 .333333 .333333"):
        (tmp_path / "a.hdr").write_bytes(f"#?RADIANCE\n{head}\n\n-Y 6 +X 10\n".encode() + pixels)
        assert_image(read_radiance(tmp_path / "a.hdr"), atol=0.06)  # 8 bits of mantissa


def test_luminance_and_chroma(tmp_path):
    """R = (RY + 1) Y, B = (BY + 1) Y, and Y = 0.2126 R + 0.7152 G + 0.0722 B (OpenEXR, BT.709)."""
    rise, luminance = np.add.outer(np.arange(6.0), np.arange(10.0)), IMAGE[..., 1].copy()
    red, blue = (rise / 50.0).astype(np.float32), (rise / -40.0).astype(np.float32)
    path = write(tmp_path / "a.exr", part("a", {"Y": luminance, "RY": red, "BY": blue}))
    r, b = (1 + red) * luminance, (1 + blue) * luminance
    expected = np.dstack([r, (luminance - 0.2126 * r - 0.0722 * b) / 0.7152, b])
    assert_image(read_radiance(path), expected, rtol=1e-3)
    # OpenEXR writes no channels of fewer pixels from Python.
    found = reading._interpolated(red[::2, ::2], (6, 10))
    np.testing.assert_allclose(found[:5, :9], red[:5, :9], rtol=1e-5)


def rgbe(image):
    """Pixels (H, W, 3) as Radiance stores them, without run lengths."""
    exponents = np.ceil(np.log2(image.max(axis=2) * 1.001))
    mantissas = image / np.exp2(exponents)[..., None] * 256
    return np.dstack([mantissas, exponents + 128]).astype(np.uint8).tobytes()


def test_windows_aspect_and_environment_maps(tmp_path):
    path, shown = tmp_path / "a.exr", (np.array([0, 0], np.int32), np.array([11, 7], np.int32))
    data = np.array([3, 2], np.int32), np.array([12, 7], np.int32)  # one column is beyond
    write(path, part("a", channels(), dataWindow=data, displayWindow=shown))
    expected = np.zeros((8, 12, 3), np.float32)
    expected[2:, 3:] = IMAGE[:, :9]
    assert_image(read_radiance(path), expected)
    for header, words in (
        ({"envmap": OpenEXR.ENVMAP_CUBE}, "cube map"),
        ({"pixelAspectRatio": 2.0}, "not square"),
    ):
        with pytest.raises(ValueError, match=words):
            read_radiance(write(path, part("a", channels(), **header)))
    assert_image(read_radiance(write(path, part("a", channels(), envmap=OpenEXR.ENVMAP_LATLONG))))


def test_radiance_files_of_every_orientation_and_header(tmp_path):
    path = tmp_path / "a.hdr"
    for first, second, swapped in product("-+", "-+", (False, True)):
        y, x = (second, first) if swapped else (first, second)
        lying = IMAGE[:: 1 if y == "-" else -1, :: 1 if x == "+" else -1]
        stored = lying.swapaxes(0, 1) if swapped else lying
        size = f"{first}X 10 {second}Y 6" if swapped else f"{first}Y 6 {second}X 10"
        head = f"#?RADIANCE\n# by hand\nEXPOSURE=2\nFORMAT=32-bit_rle_rgbe\n\n{size}\n"
        path.write_bytes(head.encode() + rgbe(stored))
        assert_image(read_radiance(path), atol=0.02)
    # No FORMAT; CRLF; primaries that some programs write.
    zeros = f"#?RADIANCE\nPIXASPECT=.999998\nPRIMARIES={' 0' * 8}\n\n-Y 6 +X 10\n"
    for head in ("#?RGBE\n\n-Y 6 +X 10\n", "#?RADIANCE\r\n\r\n-Y 6 +X 10\r\n", zeros):
        path.write_bytes(head.encode() + rgbe(IMAGE))
        assert_image(read_radiance(path), atol=0.02)
    head = b"#?RADIANCE\nCOLORCORR=4 1 1\nCOLORCORR=.5 1 1\n\n-Y 6 +X 10\n"
    path.write_bytes(head + rgbe(IMAGE * (2, 1, 1)))  # red times 4 and times 0.5
    assert_image(read_radiance(path), atol=0.02)
    for head, words in (
        ("#?RADIANCE\nCOLORCORR=2 1\n\n-Y 6 +X 10\n", "COLORCORR"),
        ("#?RADIANCE\nFORMAT=32-bit_rle_luv\n\n-Y 6 +X 10\n", "32-bit_rle_luv"),
        ("#?RADIANCE\nPIXASPECT=2.0\n\n-Y 6 +X 10\n", "not square"),
        ("#?RADIANCE\nPRIMARIES=1 2 3\n\n-Y 6 +X 10\n", "PRIMARIES"),
        ("#?RADIANCE\n\n-Y 6 +Y 10\n", "no resolution"),
    ):
        path.write_bytes(head.encode() + rgbe(IMAGE))
        with pytest.raises(ValueError, match=f"a.hdr.*{words}"):
            read_radiance(path)
