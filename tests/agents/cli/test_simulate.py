"""One raw in: simulate, sweep, refocus and hdr."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps

from agents.report.plots import upright_picture
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera, read_raw, write_dng
from simulator.networks.weights import build_modules, save_modules


def test_a_raw_at_other_settings(ae_env, raw: RawImage, dng: Path, tmp_path: Path) -> None:
    out = tmp_path / "new folder" / "out [1].dng"
    arguments = ("--iso", 1600, "--shutter", "1/250", "--aperture", 8, "--seed", 3)
    code, text, _ = ae_env("simulate", dng, *arguments, "-o", out, "--png", tmp_path / "a.png")
    assert code == 0
    assert f"wrote DNG: {out}" in text
    assert "nikon_z6" in text
    back = read_raw(out)
    assert back.settings == CameraSettings(1600, 1 / 250, 8)
    assert back.data.shape == raw.data.shape
    # Light goes with ISO * time / N^2 (marked f-numbers are rounded: 5.6 stands for 4 sqrt 2).
    ratio = (1600 / 400) * (64 / 250) * (32 / 64)
    means = back.data.mean(dim=(1, 2)) / raw.data.mean(dim=(1, 2))
    np.testing.assert_allclose(means.numpy(), ratio, rtol=0.01)
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.size == (240, 200)
    ae_env("simulate", dng, *arguments, "-o", out)
    assert read_raw(out).data.equal(back.data)
    ae_env("simulate", dng, *arguments[:-1], 4, "-o", out)
    assert not read_raw(out).data.equal(back.data)
    before = dng.read_bytes()
    code, _, error = ae_env("simulate", dng, *arguments, "-o", dng)
    assert (code, "`out`" in error, dng.read_bytes()) == (2, True, before)


@pytest.mark.parametrize(
    ("flip", "orientation"),
    [(1, 2), (2, 4), (3, 3), (4, 5), (5, 8), (6, 6), (7, 7)],  # LibRaw's code and that of EXIF
)
def test_a_picture_is_turned_as_exif_says_and_its_pixels_are_square(flip, orientation) -> None:
    metadata = {"flip": flip, "pixel_aspect": 2.0}
    settings, camera = CameraSettings(100, 1 / 64, 8), get_camera("nikon_z6")
    raw = RawImage(np.zeros((4, 20, 30), np.float32), settings, camera, metadata=metadata)
    bright = np.repeat([255, 0], 20).astype(np.uint8)[:, None]  # the upper half
    wanted = Image.fromarray(bright.repeat(120, axis=1))
    wanted.getexif()[0x0112] = orientation
    found = upright_picture(raw, torch.from_numpy(bright.repeat(60, axis=1)).expand(3, -1, -1))
    assert np.array_equal(np.asarray(found)[..., 0], np.asarray(ImageOps.exif_transpose(wanted)))


def test_settings_of_a_source_that_has_none(ae_env, tmp_path: Path) -> None:
    settings, metadata = CameraSettings(100, 1 / 64, 8), {"flip": 6, "pixel_aspect": 2.0}
    data = np.full((4, 20, 30), 0.25, np.float32)
    raw = RawImage(data, settings, get_camera("nikon_z6"), metadata=metadata)
    write_dng(tmp_path / "a.dng", raw)
    command = ("simulate", tmp_path / "a.dng", "--weights", "none", "--png", "a.png")
    command += ("--iso", 100, "--shutter", "1/64", "--aperture")
    given = ("--source-iso", 400, "--source-shutter", "1/64")
    code, text, _ = ae_env(*command, "f/8", *given, "--source-aperture", 8)
    assert (code, "source ISO 400, 1/64 s, f/8" in text) == (0, True)
    assert read_raw("out.dng").data.mean() == pytest.approx(0.25 / 4, rel=0.02)  # at ISO 400 it was
    with Image.open("a.png") as picture:
        assert picture.size == (40, 120)
    code, _, error = ae_env(*command, 8, *given)
    assert (code, "--source-aperture, or none" in error) == (2, True)


def test_what_a_raw_hides_is_printed(ae_env, tmp_path: Path) -> None:
    data = np.zeros((4, 40, 40), np.float32)
    data[:, :10] = 1.0
    write_dng(tmp_path / "a.dng", RawImage(data, CameraSettings(100, 1, 8), get_camera("nikon_z6")))
    command = ("simulate", tmp_path / "a.dng", "--weights", "none", "--aperture", 8, "--iso")
    code, text, _ = ae_env(*command, 25600, "--shutter", "1/1024", "-o", tmp_path / "out.dng")
    assert code == 0
    assert "recorded: 0.00% of the samples at black, 0.00% at white" in text
    assert "noise: ISO 25600 is 2.0 stops above the calibration of nikon_z6" in text
    assert "highlights: 25.00% of the source is saturated" in text
    _, text, _ = ae_env(*command, 100, "--shutter", 1, "-o", tmp_path / "out.dng")
    assert "0.00% of the samples at black, 25.00% at white\nwrote" in text


def test_all_states_of_a_raw(ae_env, dng: Path, tmp_path: Path) -> None:
    code, text, _ = ae_env("sweep", dng, "--out", tmp_path / "sweep", "--dngs")
    assert code == 0
    assert "contact sheet" in text
    with Image.open(tmp_path / "sweep" / "contact_sheet.png") as sheet:
        assert min(sheet.size) > 300
    files = sorted((tmp_path / "sweep").glob("*.dng"))
    assert [path.name for path in files] == [f"IMG_1-{i:02d}.dng" for i in range(64)]
    assert read_raw(files[0]).settings == CameraSettings(100, 1 / 1000, 4)
    assert read_raw(files[63]).settings == CameraSettings(6400, 1 / 2, 11)


def test_networks_run_once_for_a_raw(ae_env, raw, tmp_path, monkeypatch):
    write_dng(dng := tmp_path / "IMG_1.dng", replace(raw, data=raw.data[:, :40, :44]))
    modules = build_modules("compact").requires_grad_(False)
    torch.nn.init.normal_(modules["noise"].network.tail.weight, std=0.02)
    modules["aperture"].network.tail.bias.fill_(1.5)
    save_modules(networks := tmp_path / "net.safetensors", modules, "compact", {})
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "kept"))
    options = ("--weights", networks, "--depth", "unknown", "--device", "cpu")
    simulate = ("simulate", dng, "--iso", 100, "--shutter", "1", "--aperture", 8, *options)
    sweep = ("sweep", dng, *options)
    for command in (simulate, sweep):
        assert ae_env(*command, "--no-cache")[0] == 0
    assert not {path.name for path in tmp_path.glob("kept/*")} & {"denoised", "defocus_maps"}
    _, text, _ = ae_env(*simulate, "-o", "first.dng")
    assert "exposure -> noise_reduction (compact) -> noise" in text
    assert ae_env(*sweep, "--out", "first")[0] == 0
    for network in ("denoise", "estimate_defocus"):
        monkeypatch.setattr(CameraSimulator, network, lambda *_: pytest.fail("it ran again"))
    assert ae_env(*simulate, "-o", "second.dng")[0] == 0
    assert ae_env(*sweep, "--out", "second")[0] == 0
    for written in ("{}.dng", "{}/contact_sheet.png"):
        first, second = (Path(written.format(run)) for run in ("first", "second"))
        assert first.read_bytes() == second.read_bytes()


def test_refocus_with_a_depth_map(ae_env, raw: RawImage, dng: Path) -> None:
    depth = np.full(raw.data.shape[-2:], 9.0, np.float32)
    depth[:, :60] = 2.0

    def refocused(source: str | Path, depth: np.ndarray, focus: object, *more: str) -> RawImage:
        np.save("depth.npy", depth)
        given = ("--depth", "depth.npy", "--focal-length", 50, "--focus", focus, *more)
        given = ("--aperture", 1.4, *given, "--weights", "none", "-o", "new/out.dng")
        code, text, error = ae_env("refocus", source, *given)
        assert (code, "depth given" in text) == (0, True), error
        return read_raw("new/out.dng")

    back = refocused(dng, depth, 2.0, "--png", "out.png")
    assert back.settings.f_number == 1.4
    assert not back.data[..., 60:].equal(read_raw(dng).data[..., 60:])
    with Image.open("out.png") as picture:
        assert picture.size == (240, 200)
    assert refocused(dng, depth, "5,5").data.equal(back.data)  # the pixel lies at 2 m
    # The map is upright as the picture.
    depth[40:, :60] = 9.0
    turned = replace(raw, metadata={"flip": 6}), np.rot90(depth, -1)  # a quarter, clockwise
    backs = []
    for held, shown in ((raw, depth), turned):
        write_dng("held.dng", held)
        row, column = np.argwhere(shown == 2.0)[-1]
        backs.append(refocused("held.dng", shown, f"{column},{row}").data)
    assert backs[0].equal(backs[1])


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
