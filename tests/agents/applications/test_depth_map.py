import numpy as np
import pytest
from PIL import Image

from agents.applications.refocus import read_depth

MAP = np.array([[500, 1000, 0], [2000, 4000, 65535]], np.uint16)


def test_millimetres_of_a_png_with_a_hole(tmp_path) -> None:
    Image.fromarray(MAP).save(tmp_path / "depth.png")
    depth = read_depth(tmp_path / "depth.png")
    assert depth.shape == (2, 3)
    np.testing.assert_allclose(depth[:, :2], [[0.5, 1.0], [2.0, 4.0]])
    assert depth[0, 2] in (1.0, 65.535)  # that of a neighbour
    np.testing.assert_allclose(read_depth(tmp_path / "depth.png", scale=0.01)[0, 0], 5.0)


def test_disparity_is_inverse_distance(tmp_path) -> None:
    np.save(tmp_path / "disparity.npy", np.array([[0.0, 2.0], [4.0, np.nan]], np.float32))
    depth = read_depth(tmp_path / "disparity.npy", kind="disparity", scale=0.25)
    assert depth[0, 0] == np.inf
    np.testing.assert_allclose([depth[0, 1], depth[1, 0]], [2.0, 1.0])
    assert depth[1, 1] in (1.0, 2.0)


def test_an_exr(tmp_path) -> None:
    openexr = pytest.importorskip("OpenEXR")
    values = np.array([[1.5, 2.5]], np.float32)
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    openexr.File(header, {"Z": values}).write(str(tmp_path / "z.exr"))
    np.testing.assert_array_equal(read_depth(tmp_path / "z.exr"), values)


def test_bad_files(tmp_path) -> None:
    Image.new("RGB", (4, 4)).save(tmp_path / "colour.png")
    Image.new("L", (4, 4)).save(tmp_path / "empty.png")
    Image.new("L", (4, 4), 9).save(tmp_path / "photo.jpg")
    (tmp_path / "text.npy").write_text("no array")
    (tmp_path / "text.exr").write_text("no picture")
    np.save(tmp_path / "pickle.npy", np.array([print], object), allow_pickle=True)
    np.save(tmp_path / "three.npy", np.ones((2, 2, 2)))
    for name, rule in (
        ("colour.png", "one channel"),
        ("empty.png", "a number above 0"),
        ("photo.jpg", "must end in"),
        ("missing.png", "no such file"),
        ("text.npy", "cannot be read"),
        ("text.exr", "cannot be read"),
        ("pickle.npy", "cannot be read"),
        ("three.npy", r"one map \(H, W\)"),
    ):
        with pytest.raises(ValueError, match=rf"{name}.*{rule}"):
            read_depth(tmp_path / name)
    Image.fromarray(MAP).save(tmp_path / "depth.png")
    for arguments, rule in (
        ({"kind": "metres"}, "`kind`"),
        ({"kind": "disparity"}, "`scale` .=None. must be given"),
        ({"scale": 0.0}, "`scale` .=0.0. must be finite and > 0"),
    ):
        with pytest.raises(ValueError, match=rule):
            read_depth(tmp_path / "depth.png", **arguments)
