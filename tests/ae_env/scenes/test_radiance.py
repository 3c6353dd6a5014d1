"""Radiance maps: reading, cleaning, perspective views, lying files."""

import logging
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from ae_env.scenes import load_scenes
from ae_env.scenes.folder import radiance_scenes
from ae_env.scenes.scene import SceneRequest
from simulator import get_camera
from simulator.radiance.maps import assumed_ev100, perspective, read_radiance
from tests.ae_env.scene_files import write_exr

CAMERA = get_camera("nikon_z6")
HDR_HEAD = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n"


def directions(height: int) -> np.ndarray:
    """Panorama whose colour is the viewing direction: right, up, ahead, each as (n + 1) / 2."""
    latitude = np.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]
    longitude = np.pi * ((np.arange(2 * height) + 0.5) / height - 1.0)[None, :]
    ray = [np.cos(latitude) * np.sin(longitude), np.sin(latitude) + 0 * longitude]
    ray.append(np.cos(latitude) * np.cos(longitude))
    return ((np.stack(ray) + 1.0) / 2.0).astype(np.float32)


@pytest.mark.parametrize(("azimuth", "size"), [(0.0, 32), (90.0, 200), (180.0, 32), (270.0, 200)])
def test_perspective_is_a_pin_hole(azimuth: float, size: int) -> None:
    view = 2.0 * perspective(directions(256), azimuth, size, 60.0) - 1.0
    view /= np.linalg.norm(view, axis=0)
    axis = np.tan(np.radians(30.0)) * ((np.arange(size) + 0.5) / size * 2.0 - 1.0)
    right, up = np.meshgrid(axis, -axis)
    turn = np.radians(azimuth)
    ahead = np.cos(turn) - right * np.sin(turn)
    ray = np.stack([right * np.cos(turn) + np.sin(turn), up, ahead])
    ray /= np.linalg.norm(ray, axis=0)
    assert np.abs(view - ray).max() < 2e-3


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
    request = SceneRequest("all", CAMERA, 32)
    scenes = list(radiance_scenes(tmp_path / "p.exr", request, name="p", group="p"))
    assert [s.scene_id for s in scenes] == ["p-000", "p-090", "p-180", "p-270"]
    assert {s.group for s in scenes} == {"p"}
    ev = [s.ev100 for s in scenes]
    assert ev[0] - ev[1] == pytest.approx(2.0, abs=0.05)
    assert np.mean(ev) == pytest.approx(assumed_ev100("p"), abs=0.05)
    assert all(s.illuminance is None and s.noise_free and s.box_factor == 8 for s in scenes)


def test_maps_are_sampled_where_they_have_the_photosites(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Rows of one pixel, green and dark in turn: G1, beside red, differs from G2."""
    still = np.ones((520, 520, 3), np.float32)
    still[::2] = 0.2
    write_exr(tmp_path / "fine.exr", still)
    write_exr(tmp_path / "coarse.exr", still[:200, :200])
    panorama = np.ones((256, 512, 3), np.float32)  # 94 photosites in 60 degrees
    write_exr(tmp_path / "wide.exr", panorama)
    caplog.set_level(logging.INFO)
    for name, crop, resolution, sampled, k in (
        *(("fine", "box", 64, True, 4), ("fine", "native", 64, True, 1)),
        *(("coarse", "box", 64, False, 3), ("coarse", "native", 64, True, 1)),
        *(("coarse", "native", 128, False, 1), ("wide", "native", 48, False, 1)),
        *(("wide", "native", 40, True, 1), ("wide", "box", 40, False, 6)),
    ):
        caplog.clear()
        request = SceneRequest("all", CAMERA, resolution, crop)
        scene, *_ = radiance_scenes(tmp_path / f"{name}.exr", request, name=name, group=name)
        assert (scene.sampled, scene.box_factor) == (sampled, k)
        assert scene.light.shape == (4, resolution, resolution)
        assert ("planes share their places" in caplog.text) != sampled
        assert torch.equal(scene.light[1], scene.light[2]) == (not sampled or name == "wide")
        if name == "fine":  # a lens of half a photosite leaves 0.57 of such a contrast
            ratio = float(scene.light[1].mean() / scene.light[2].mean())
            assert max(ratio, 1 / ratio) == pytest.approx(
                (0.6 + 0.4 * 0.57) / (0.6 - 0.228), rel=0.01
            )


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.png", b"", "must end in"),
        ("a.hdr", b"", "complete"),
        ("a.hdr", b"#?RADIANCE\n", "complete"),
        *(
            ("a.hdr", HDR_HEAD + size + b"\n" + 16 * 32 * b"\x80\x80\x80\x80", words)
            for size, words in (
                (b"-Y 60000 +X 60000", "claims 60000 x 60000 pixels, where at most 268435456"),
                (b"-Y 8000 +X 8000", "claims 8000 x 8000 pixels in .*, where at most 8192 a byte"),
                (b"-Y 99999999999 +X 4", "claims 99999999999 x 4"),
                (b"-Y 17 +X 32", "complete"),
                (b"-Y 0 +X 0", "complete"),
                (b"", "complete"),
            )
        ),
        ("a.exr", b"not an EXR file", ""),
    ],
)
def test_errors_name_the_file(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    pytest.importorskip("cv2")
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{name}.*{words}"):
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


def test_lying_and_cut_exr_files(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, np.random.default_rng(0).random((32, 64)))
    whole = path.read_bytes()
    window = whole.index(b"dataWindow\0box2i\0") + 21
    for corner, words in (((59_999, 59_999), "60000 x 60000"), ((19_999, 12_999), "8192 a byte")):
        content = bytearray(whole)
        struct.pack_into("<2i", content, window + 8, *corner)
        path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"a\.exr' claims .*{words}"):
            read_radiance(path)
    for size in (0, 4, 100, 400, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError, match="must be a complete OpenEXR file"):
            read_radiance(path)
    write_exr(path, np.zeros((4, 4)))
    with pytest.raises(ValueError, match=r"a\.exr.*some light"):
        read_radiance(path)
    with pytest.raises(FileNotFoundError, match=r"none\.exr"):
        read_radiance(tmp_path / "none.exr")
    for bad in (None, 3, b"a.exr"):
        with pytest.raises(ValueError, match="must be a file's name"):
            read_radiance(bad)  # type: ignore[arg-type]


@pytest.mark.parametrize("scale", [2.0**-100, 2.0**110])
def test_the_scale_of_a_map_does_not_matter(tmp_path: Path, scale: float) -> None:
    """Nothing says how bright a radiance map is: any scale gives the same scene."""
    image = np.random.default_rng(0).uniform(0.1, 4.0, (32, 32)).astype(np.float32)
    scenes = []
    for folder, factor in (("a", 1.0), ("b", scale)):
        (tmp_path / folder).mkdir()
        write_exr(tmp_path / folder / "map.exr", image * factor)
        scenes += load_scenes(tmp_path / folder, "all", camera=CAMERA, resolution=8)
    first, second = scenes
    assert second.ev100 == pytest.approx(first.ev100, abs=1e-6)
    torch.testing.assert_close(second.light, first.light, rtol=1e-5, atol=0.0)
