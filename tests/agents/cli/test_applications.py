from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from simulator import RawImage, read_raw, write_dng


def test_refocus_with_a_depth_map(ae_env, raw: RawImage, dng: Path, tmp_path: Path) -> None:
    depth = np.full(raw.data.shape[-2:], 9.0, np.float32)
    depth[:, :60] = 2.0
    np.save(tmp_path / "depth.npy", depth)
    given = ("--depth", tmp_path / "depth.npy", "--focal-length", 50, "--focus", "2.0")
    given = (*given, "--weights", "none")
    out, png = tmp_path / "new" / "out.dng", tmp_path / "out.png"
    code, text, _ = ae_env("refocus", dng, "--aperture", 1.4, *given, "-o", out, "--png", png)
    assert code == 0
    assert "depth given" in text
    back = read_raw(out)
    assert back.settings.f_number == 1.4
    assert back.settings.exposure_time == pytest.approx(raw.settings.exposure_time / 16, rel=1e-3)
    assert np.array_equal(back.to_mosaic()[:, :120], read_raw(dng).to_mosaic()[:, :120])
    assert not np.array_equal(back.to_mosaic()[:, 120:], read_raw(dng).to_mosaic()[:, 120:])
    with Image.open(png) as picture:
        assert picture.size == (240, 200)
    before = out.read_bytes()
    ae_env("refocus", dng, "--aperture", 1.4, *given[:-4], "--focus", "5,5", *given[-2:], "-o", out)
    assert out.read_bytes() == before  # the pixel lies at 2 m


def test_a_depth_map_is_upright_as_the_picture(ae_env, raw: RawImage, tmp_path: Path) -> None:
    depth = np.full(raw.data.shape[-2:], 9.0, np.float32)
    depth[:40, :60] = 2.0
    backs = []
    for name, held, shown in (
        ("level", raw, depth),
        ("held", replace(raw, metadata={"flip": 6}), np.rot90(depth, -1)),  # a quarter, clockwise
    ):
        write_dng(tmp_path / f"{name}.dng", held)
        np.save(tmp_path / f"{name}.npy", shown)
        row, column = np.argwhere(shown == 2.0)[-1]
        given = ("--depth", tmp_path / f"{name}.npy", "--focus", f"{column},{row}")
        given = (*given, "--focal-length", 50, "--aperture", 1.4, "--weights", "none")
        out = tmp_path / f"{name}-out.dng"
        code, _, error = ae_env("refocus", tmp_path / f"{name}.dng", *given, "-o", out)
        assert code == 0, error
        backs.append(read_raw(out).to_mosaic())
    assert np.array_equal(*backs)


def test_hdr(ae_env, dng: Path, tmp_path: Path) -> None:
    openexr = pytest.importorskip("OpenEXR")
    out, png = tmp_path / "out.exr", tmp_path / "out.png"
    code, text, _ = ae_env("hdr", dng, "-o", out, "--png", png, "--stops", 2, "--weights", "none")
    assert code == 0
    assert "fused 9 simulated pictures, -2 to +2 EV" in text
    with openexr.File(str(out)) as file:
        assert file.channels()["RGB"].pixels.shape == (100, 120, 3)
    with Image.open(png) as picture:
        assert picture.size == (240, 200)


def test_bad_input_writes_nothing(ae_env, raw: RawImage, dng: Path, tmp_path: Path) -> None:
    Image.new("L", (8, 8), 9).save(tmp_path / "small.png")
    Image.new("RGB", (8, 8)).save(tmp_path / "photo.jpg")
    nameless = replace(raw, camera=replace(raw.camera, make="X", model="Y", pixel_pitch_um=None))
    write_dng(tmp_path / "nameless.dng", nameless)
    Image.new("L", (120, 100), 9).save(tmp_path / "depth.png")
    over = ("--depth", tmp_path / "depth.png", "--png", tmp_path / "depth.png")
    np.save(tmp_path / "fits.npy", np.ones((100, 120)))
    fits = ("--depth", tmp_path / "fits.npy", "--focal-length", 3)
    out = tmp_path / "nowhere" / "out.dng"
    depth = ("--depth", tmp_path / "small.png", "--focal-length", 3)
    for arguments, message in (
        ((dng, "--aperture", 8), "`aperture` (=8) must be at most that of the raw, 5.6"),
        ((dng, "--aperture", 1.4, *over), "`png` (="),
        ((dng, "--aperture", 1.4, "--depth-kind", "disparity"), "`depth-kind` (=disparity) is an"),
        ((dng, "--aperture", 1.4, *depth[:2], "--depth-kind", "far"), "`depth-kind` (='far')"),
        ((dng, "--aperture", 1.4, *depth[:2], "--focal-length", -3), "`focal-length` (=-3) must"),
        ((dng, "--aperture", 1.4, *fits, "--focus", "0.001"), "`focus` (=0.001) must be above"),
        ((tmp_path / "nameless.dng", "--aperture", 1.4, *fits), "with `--pixel-pitch`"),
        ((dng, "--aperture", 1.4, *depth), "must be (100, 120) or (200, 240)"),
        ((dng, "--aperture", 1.4, *depth[:2]), "`focal-length` (=None) must be given"),
        ((dng, "--aperture", 1.4, *depth, "--focus", "9,9"), "a pixel X,Y"),
        ((dng, "--aperture", 1.4, *depth, "--focus", "far"), "a pixel X,Y"),
        ((dng, "--aperture", 1.4, "--focus", "2"), "`focus` (=2) is an option of a known"),
        ((dng, "--aperture", 1.4, "--depth", tmp_path / "no.png"), "no such file"),
        ((dng, "--aperture", "wide"), "must be an f-number"),
        ((dng, "--aperture", 1.4, "--weights", "none"), "without networks"),
        ((tmp_path / "photo.jpg", "--aperture", 1.4), "photo.jpg"),
    ):
        code, _, error = ae_env("refocus", *arguments, "-o", out)
        assert code == 2, arguments
        assert message in error
    for arguments, message in (
        ((dng, "--stops", 0), "`stops`"),
        ((dng, "--step", 9), "`step`"),
        ((tmp_path / "photo.jpg",), "photo.jpg"),
    ):
        pytest.importorskip("OpenEXR")
        code, _, error = ae_env("hdr", *arguments, "-o", out.with_suffix(".exr"))
        assert code == 2, arguments
        assert message in error
    assert not out.parent.exists()
