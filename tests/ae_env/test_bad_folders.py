"""Folders with bad files in them, and radiance maps that lie."""

from __future__ import annotations

import logging
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.radiance import read_radiance
from simulator import CameraSettings, RawImage, get_camera, write_dng

CAMERA = get_camera("nikon_z6")
HDR_HEAD = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n"


def load(folder: Path, **options: Any) -> list[Scene]:
    resize = options.pop("resize", Scene.resized)
    spec = {"path": folder, **options}
    return load_scenes(spec, "all", camera=CAMERA, resolution=8, resize=resize)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Four raws, ``good1.dng`` to ``good4.dng``."""
    data = torch.rand(4, 16, 16, generator=torch.Generator().manual_seed(0))
    for i in range(1, 5):
        write_dng(tmp_path / f"good{i}.dng", RawImage(data, CameraSettings(100, 0.01, 4), CAMERA))
    return tmp_path


def write_exr(path: Path, image: np.ndarray, compression: str = "ZIP") -> None:
    exr = pytest.importorskip("OpenEXR")
    header = {"compression": getattr(exr, f"{compression}_COMPRESSION")}
    header["type"] = exr.scanlineimage
    exr.File(header, dict.fromkeys("RGB", image.astype(np.float32))).write(str(path))


def ids(scenes: list[Scene]) -> list[str]:
    return [scene.scene_id for scene in scenes]


def test_bad_files_stop_or_are_skipped_with_a_reason(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "ae_env.scenes")
    for i in range(7):
        (folder / f"bad{i}.dng").write_bytes(b"" if i % 2 else b"some words")
    (folder / "good1.hdr").write_bytes(b"")
    with pytest.raises(ValueError, match=r"scene file '.*bad0\.dng': .*text file.*'skip'"):
        load(folder)
    assert f"reading 12 scene files of {folder}" in caplog.text  # before it fails
    scenes = load(folder, on_error="skip")
    assert ids(scenes) == ["good1.dng", "good2", "good3", "good4"]
    (line,) = (r.getMessage() for r in caplog.records if "skipped" in r.getMessage())
    assert "8 of 12 scene files skipped" in line
    assert "bad0.dng" in line
    assert "an empty file" in line
    assert line.endswith("and 3 more)")


def test_nothing_left_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.dng").write_bytes(b"")
    (tmp_path / "b.dng").write_bytes(b"")
    with pytest.raises(ValueError, match=r"all 2 were skipped \(a\.dng: .*empty file"):
        load(tmp_path, on_error="skip")
    with pytest.raises(ValueError, match="empty file") as caught:
        load(tmp_path / "a.dng")
    assert "skip" not in str(caught.value)  # which would not help with one file


@pytest.mark.parametrize("change", ["vanishes", "shrinks"])
def test_a_folder_that_changes_meanwhile(
    folder: Path, caplog: pytest.LogCaptureFixture, change: str
) -> None:
    content = (folder / "good3.dng").read_bytes()

    def resize(scene: Scene, *arguments: Any) -> Scene:
        if scene.scene_id == "good2":
            if change == "vanishes":
                (folder / "good3.dng").unlink()
            else:
                os.truncate(folder / "good3.dng", 900)
        return scene.resized(*arguments)

    with pytest.raises(ValueError, match=r"good3\.dng.*(does not exist|truncated)"):
        load(folder, resize=resize)
    (folder / "good3.dng").write_bytes(content)
    assert ids(load(folder, resize=resize, on_error="skip")) == ["good1", "good2", "good4"]
    assert "1 of 4 scene files skipped (good3.dng: " in caplog.text


def test_a_map_is_skipped_as_a_whole(folder: Path) -> None:
    write_exr(folder / "panorama.exr", np.ones((32, 64)))

    def resize(scene: Scene, *arguments: Any) -> Scene:
        if scene.scene_id == "panorama-180":
            raise ValueError("a bad view")
        return scene.resized(*arguments)

    scenes = load(folder, resize=resize, on_error="skip")
    assert ids(scenes) == ["good1", "good2", "good3", "good4"]


def test_a_black_frame_stops_or_is_skipped(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    settings = CameraSettings(100, 0.01, 4)
    write_dng(folder / "black.dng", RawImage(torch.zeros(4, 64, 64), settings, CAMERA))
    with pytest.raises(ValueError, match=r"scene file '.*black\.dng': `light` is 0 .*'skip'"):
        load(folder)
    assert ids(load(folder, on_error="skip")) == ["good1", "good2", "good3", "good4"]
    assert "1 of 5 scene files skipped (black.dng: `light` is 0" in caplog.text
    assert len(load(folder, illuminance=100.0)) == 5  # then its exposure is known


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"on_error": "skp"}, r"`on_error` \(='skp'\).*'stop', 'skip'; did you mean 'skip'"),
        ({"on_error": None}, "`on_error`"),
        ({"on_eror": "skip"}, "did you mean 'on_error'"),
        ({"illuminance": -1.0}, r"`illuminance` \(=-1.0\)"),
        ({"illuminance": {"good1.dng": float("nan")}}, "`illuminance`"),
        ({"hard": 1}, "`hard`"),
        ({"kind": 3}, "`kind`"),
        ({"median_speed": float("inf")}, "`median_speed`"),
        ({"ev100": "bright"}, "`ev100`"),
    ],
)
def test_options_are_refused_before_anything_is_read(
    options: dict[str, Any], words: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=words):
        load(tmp_path / "is not there", **options)


@pytest.mark.parametrize("content", [b"\xff\xfe\0", b'file,group\n"' + b"x" * 200_000])
def test_groups_that_are_no_table(folder: Path, content: bytes) -> None:
    (folder / "groups.csv").write_bytes(content)
    with pytest.raises(ValueError, match=r"groups\.csv' must be a CSV file in UTF-8"):
        load(folder)


@pytest.mark.parametrize("name", ["x" * 3000, "~nobody-of-that-name/x", "a\0b"])
def test_names_that_no_system_has(name: str) -> None:
    with pytest.raises(ValueError, match="`scenes`"):
        load_scenes(name, camera=CAMERA)


@pytest.mark.parametrize(
    ("size", "words"),
    [
        (b"-Y 60000 +X 60000", "claims 60000 x 60000 pixels, where at most 268435456"),
        (b"-Y 8000 +X 8000", "claims 8000 x 8000 pixels in .* bytes, where at most 8192 a byte"),
        (b"-Y 99999999999 +X 4", "claims 99999999999 x 4"),
        (b"-Y 17 +X 32", "complete"),
        (b"-Y 0 +X 0", "complete"),
        (b"", "complete"),
    ],
)
def test_lying_radiance_files(tmp_path: Path, size: bytes, words: str) -> None:
    pytest.importorskip("cv2")
    path = tmp_path / "a.hdr"
    path.write_bytes(HDR_HEAD + size + b"\n" + 16 * 32 * b"\x80\x80\x80\x80")
    with pytest.raises(ValueError, match=rf"radiance map '.*a\.hdr' .*{words}"):
        read_radiance(path)


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
    for bad in (None, 3, b"a.exr"):
        with pytest.raises(ValueError, match="must be a file's name"):
            read_radiance(bad)  # type: ignore[arg-type]


def test_a_flat_map_that_is_packed_most_densely(tmp_path: Path) -> None:
    path = tmp_path / "flat.exr"
    write_exr(path, np.full((2048, 3072), 0.5), "DWAB")
    assert 2048 * 3072 / path.stat().st_size > 1024
    np.testing.assert_allclose(read_radiance(path)[:, ::64, ::64], 0.5, rtol=1e-2)


@pytest.mark.parametrize("scale", [2.0**-100, 2.0**110])
def test_the_scale_of_a_map_does_not_matter(tmp_path: Path, scale: float) -> None:
    # Nothing says how bright a radiance map is: any scale gives the same scene.
    image = np.random.default_rng(0).uniform(0.1, 4.0, (32, 32))
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    write_exr(tmp_path / "a" / "map.exr", image)
    write_exr(tmp_path / "b" / "map.exr", image.astype(np.float32) * scale)
    (first,), (second,) = load(tmp_path / "a"), load(tmp_path / "b")
    assert second.ev100 == pytest.approx(first.ev100, abs=1e-6)
    torch.testing.assert_close(second.light, first.light, rtol=1e-5, atol=0.0)
