"""Radiance maps: reading, cleaning, perspective views."""

import logging
from pathlib import Path

import numpy as np
import pytest

from ae_env.scenes import load_scenes
from ae_env.scenes.radiance import assumed_ev100, perspective, radiance_scenes, read_radiance
from simulator.camera import get_camera

CAMERA = get_camera("nikon_z6")


def directions(height: int) -> np.ndarray:
    """Panorama whose colour is the viewing direction: right, up, ahead, each as (n + 1) / 2."""
    latitude = np.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]
    longitude = np.pi * ((np.arange(2 * height) + 0.5) / height - 1.0)[None, :]
    ray = [np.cos(latitude) * np.sin(longitude), np.sin(latitude) + 0 * longitude]
    ray.append(np.cos(latitude) * np.cos(longitude))
    return ((np.stack(ray) + 1.0) / 2.0).astype(np.float32)


@pytest.mark.parametrize("azimuth", [0.0, 90.0, 180.0, 270.0])
@pytest.mark.parametrize("size", [32, 200])
def test_perspective_is_a_pin_hole(azimuth: float, size: int) -> None:
    view = 2.0 * perspective(directions(256), azimuth, size, 60.0) - 1.0
    view /= np.linalg.norm(view, axis=0)
    axis = np.tan(np.radians(30.0)) * ((np.arange(size) + 0.5) / size * 2.0 - 1.0)
    right, up = np.meshgrid(axis, -axis)
    turn = np.radians(azimuth)
    ray = np.stack(
        [
            right * np.cos(turn) + np.sin(turn),
            up,
            np.cos(turn) - right * np.sin(turn),
        ]
    )
    ray /= np.linalg.norm(ray, axis=0)
    assert np.abs(view - ray).max() < 2e-3


def test_a_small_lamp_keeps_its_energy() -> None:
    panorama = np.zeros((3, 512, 1024), np.float32)
    panorama[:, 256, 512] = 1.0
    fine, coarse = perspective(panorama, 0.0, 512), perspective(panorama, 0.0, 16)
    assert coarse.mean() == pytest.approx(fine.mean(), rel=0.05)


def test_invalid_field_of_view() -> None:
    with pytest.raises(ValueError, match="`field_of_view`"):
        perspective(np.ones((3, 4, 8), np.float32), 0.0, 4, 180.0)


def write_exr(path: Path, image: np.ndarray) -> None:
    openexr = pytest.importorskip("OpenEXR")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    with openexr.File(header, {"RGB": image}) as file:
        file.write(str(path))


def test_exr_is_read_and_cleaned(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    image = np.random.default_rng(0).uniform(0.0, 5.0, (6, 8, 3)).astype(np.float32)
    write_exr(tmp_path / "a.exr", image)
    np.testing.assert_array_equal(read_radiance(tmp_path / "a.exr"), image.transpose(2, 0, 1))
    assert not caplog.records
    image[0, 0], image[1, 1], image[2, 2] = np.nan, -1.0, np.inf
    write_exr(tmp_path / "a.exr", image)
    caplog.set_level(logging.INFO)
    clean = read_radiance(tmp_path / "a.exr")
    assert np.all(clean[:, 0, 0] == 0)
    assert np.all(clean[:, 1, 1] == 0)
    assert np.all(clean[:, 2, 2] == np.nanmax(image[np.isfinite(image)]))
    assert "3 NaN and 3 negative values set to 0, 3 infinite" in caplog.text


def test_hdr_keeps_its_colours(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    image = np.zeros((10, 12, 3), np.float32)
    image[...] = (8.0, 2.0, 0.5)  # red, green, blue
    (tmp_path / "a.HDR").write_bytes(cv2.imencode(".hdr", image[:, :, ::-1])[1].tobytes())
    read = read_radiance(tmp_path / "a.HDR")
    assert read.shape == (3, 10, 12)
    np.testing.assert_allclose(read[:, 0, 0], (8.0, 2.0, 0.5), rtol=0.02)


def test_views_of_a_panorama_share_one_scale(tmp_path: Path) -> None:
    panorama = np.ones((64, 128, 3), np.float32)
    panorama[:, 48:80] = 4.0  # ahead (90 degrees wide) is four times as bright: 2 EV
    write_exr(tmp_path / "p.exr", panorama)
    scenes = list(radiance_scenes(tmp_path / "p.exr", CAMERA, name="p", group="p", resolution=32))
    assert [s.scene_id for s in scenes] == ["p-000", "p-090", "p-180", "p-270"]
    assert {s.group for s in scenes} == {"p"}
    ev = [s.ev100 for s in scenes]
    assert ev[0] - ev[1] == pytest.approx(2.0, abs=0.05)
    assert np.mean(ev) == pytest.approx(assumed_ev100("p"), abs=0.05)
    assert all(s.illuminance is None and s.noise_free and s.box_factor == 8 for s in scenes)


def test_assumed_light_is_spread_over_its_range() -> None:
    values = [assumed_ev100(f"map{i}") for i in range(300)]
    assert 3.0 <= min(values) < 4.0
    assert 13.0 < max(values) <= 14.0
    assert np.mean(values) == pytest.approx(8.5, abs=0.6)


def test_errors_name_the_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.exr"):
        read_radiance(tmp_path / "none.exr")
    (tmp_path / "a.png").write_bytes(b"")
    with pytest.raises(ValueError, match=r"a\.png.*must end in"):
        read_radiance(tmp_path / "a.png")
    pytest.importorskip("cv2")
    for content in (b"", b"#?RADIANCE\n"):
        (tmp_path / "a.hdr").write_bytes(content)
        with pytest.raises(ValueError, match=r"a\.hdr"):
            read_radiance(tmp_path / "a.hdr")
    write_exr(tmp_path / "dark.exr", np.zeros((4, 4, 3), np.float32))
    with pytest.raises(ValueError, match=r"dark\.exr.*some light"):
        read_radiance(tmp_path / "dark.exr")
    (tmp_path / "b.exr").write_bytes(b"not an EXR file")
    with pytest.raises(ValueError, match=r"b\.exr"):
        read_radiance(tmp_path / "b.exr")


def test_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    for module, name in (("cv2", "a.hdr"), ("OpenEXR", "a.exr")):
        monkeypatch.setitem(sys.modules, module, None)
        (tmp_path / name).write_bytes(b"x")
        with pytest.raises(ImportError, match=r"pip install ae-env\[hdr\]"):
            read_radiance(tmp_path / name)


@pytest.mark.real_data
def test_real_maps_load(data_dir: Path) -> None:
    pytest.importorskip("cv2")
    pytest.importorskip("OpenEXR")
    panoramas = load_scenes(data_dir / "hdri_cc0", "test", camera=CAMERA)
    assert len(panoramas) == 44
    assert len({s.group for s in panoramas}) == 11
    pictures = load_scenes(data_dir / "openexr_bsd", "test", camera=CAMERA)
    assert [s.scene_id for s in pictures] == ["Desk", "StillLife"]
    for scene in (*panoramas, *pictures):
        assert scene.light.shape == (4, 64, 64)
        assert scene.light[1].clamp(max=1.0).mean().item() == pytest.approx(0.12, rel=0.15)
        assert 1.0 < scene.ev100 < 15.0
