"""Scenes of the reference camera: splits, light, depth of real photographs, draped pictures."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from skimage.data import stereo_motorcycle

from simulator import CameraSettings, get_camera
from simulator.radiance.procedural import KINDS
from simulator.reference.reference_camera import DRAPED, ReferenceScene
from simulator.training import scenes as pictured
from simulator.training.crops import DetailPicture
from simulator.training.scenes import reference_scenes
from tests.ae_env.scene_files import write_exr, write_hdr

CAMERA = get_camera("nikon_z6")
SPLITS = ("train", "validation", "test")
WHITE = 100 * 2.5 / (120 * np.pi)  # signal of a white surface at the incident-light exposure


@pytest.fixture(scope="module")
def scenes() -> dict[str, list[ReferenceScene]]:
    numbers = zip(SPLITS, (28, 4, 4), strict=True)
    return {split: reference_scenes(split, CAMERA, number=n, size=48) for split, n in numbers}


def blur(scene: ReferenceScene) -> np.ndarray:
    """Circle of confusion at f/11 [packed pixels of 11.88 um] by the thin-lens formula."""
    f, s, z = scene.lens.focal_length, scene.lens.focus_distance, scene.depth.double().numpy()
    return f * f / (11.0 * (s - f)) * np.abs(z - s) / z / 11.88e-6


def assert_no_group_is_shared(made: dict[str, list]) -> None:
    groups = [{each.group for each in own} for own in made.values()]
    assert all(groups)
    assert sum(map(len, groups)) == len(set().union(*groups))
    names = [getattr(e, "scene_id", None) or e.name for own in made.values() for e in own]
    assert len(set(names)) == len(names)


def test_splits_are_apart_and_scenes_the_same_however_many(scenes):
    assert_no_group_is_shared(scenes)
    fewer = reference_scenes("validation", CAMERA, number=2, size=48)[:2]
    for scene, again in zip(scenes["validation"], fewer, strict=False):
        assert (scene.scene_id, scene.lens) == (again.scene_id, again.lens)
        for field in ("light", "depth"):
            torch.testing.assert_close(getattr(again, field), getattr(scene, field), rtol=0, atol=0)
    with pytest.raises(ValueError, match="`split`"):
        reference_scenes("trian", CAMERA)
    other = reference_scenes("validation", CAMERA, number=1, size=48, seed=1)[0]
    assert other.group != fewer[0].group
    assert not torch.equal(other.light, fewer[0].light)
    train = scenes["train"]
    kinds = [s.kind for s in train]
    assert kinds.count("depth") == 21
    assert set(kinds) == {"depth", "photograph", *KINDS}
    for scene in train:
        assert (scene.light.shape, scene.size) == ((3, 96, 96), (48, 48))
        assert (scene.depth is not None) == (scene.kind == "depth")
        assert 1.0 <= scene.illuminance <= 20_000.0
        # The incident-light exposure, E = 2.5 * 2**EV100, with ISO 12232's 120 for white.
        exposure = 2.0**scene.reference.log2_exposure
        assert scene.illuminance * exposure / 2.5 == pytest.approx(1.0, rel=1e-6)
    surfaces = [s.light[1].median().item() / WHITE for s in train if s.kind == "depth"]
    assert 0.05 < np.median(surfaces) < 0.3  # reflectances of nature


def test_panoramas_are_cut_and_coarse_pictures_left_out(tmp_path, caplog):
    (tmp_path / "hdri_cc0").mkdir()
    row, column = np.mgrid[:256, :512]
    panorama = np.stack([1.0 + column % 128, 1.0 + row, 1.0 + row % 2], axis=2)
    write_exr(tmp_path / "hdri_cc0" / "city.exr", panorama)
    with caplog.at_level(logging.INFO):
        found = reference_scenes("validation", CAMERA, number=0, size=64, data=tmp_path)
        views = [s for s in found if s.kind == "radiance"]
        wide = reference_scenes("validation", CAMERA, number=0, size=128, data=tmp_path)
    assert [s.scene_id for s in views] == ["city-000", "city-090", "city-180", "city-270"]
    assert "city-000: too coarse (128 photosites a side), left out" in caplog.text
    assert all(s.kind == "photograph" for s in wide)
    assert {s.group for s in views} == {"city"}
    for view in views:
        assert (view.depth, view.size, view.light.shape) == (None, (64, 64), (3, 128, 128))
        assert view.reference.log2_exposure == pytest.approx(-np.log2(view.illuminance / 2.5))
    # A quarter of the circle each, its pixels as they are: every one looks the same here.
    assert len({float(v.light.sum()) for v in views}) == 1
    with pytest.raises(FileNotFoundError, match="`data`"):
        reference_scenes("train", CAMERA, number=0, data=tmp_path / "none")


def test_motorcycle_has_the_depth_of_its_calibration() -> None:
    """z = baseline * focal length / (disparity + offset), as scikit-image's documentation says."""
    _, _, disparity = stereo_motorcycle()
    front, middle = pictured.depth_photographs(CAMERA)
    assert (front.scene_id, middle.scene_id) == ("motorcycle-front", "motorcycle-middle")
    assert (front.light.shape, front.size) == ((3, 500, 740), (250, 370))
    assert torch.equal(front.depth, middle.depth)
    depth = 0.193001 * 994.978 / (np.where(np.isfinite(disparity), disparity, np.nan) + 31.086)
    known = np.isfinite(depth[:500, :740])
    np.testing.assert_allclose(front.depth.numpy()[known], depth[:500, :740][known], rtol=1e-5)
    assert 1.8 < front.depth.min() < front.depth.max() < 6.0


@pytest.mark.real_data
def test_real_pictures_become_scenes(data_dir: Path, tmp_path: Path) -> None:
    """One file of each kind."""
    files = "photo_pool/galliumos_galliumos-3_0-architectural.jpg", "hdri_pool/Flowers.exr"
    for name in ("depth_cones", "MANIFEST_POOL.csv", *files, "canon_crw_cc0/CRW_0117.CRW"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).symlink_to(data_dir / name)
    for scene in pictured.depth_photographs(CAMERA, data=tmp_path)[2:]:
        assert (scene.group, scene.size) == ("cones", (187, 225))
        assert 4.5 < np.quantile(blur(scene), 0.97) < 6.3
    made = reference_scenes("validation", CAMERA, number=0, size=128, data=tmp_path)
    assert [s.scene_id for s in made] == ["coffee", "Flowers", Path(files[0]).stem]
    made += pictured.mosaic_scenes("test", tmp_path, size=128)
    assert [(s.scene_id, s.group) for s in made[3:]] == [("CRW_0117", "camera_box")]
    assert all(s.sampled and s.size == (128, 128) for s in made)


def test_drapes_keep_light_and_group_and_have_a_blur_in_range() -> None:
    light = torch.rand(3, 128, 96, generator=torch.Generator().manual_seed(1))
    reference = CameraSettings(100, 1 / 64, 4)
    scene = ReferenceScene("a", "the-group", "indoor", light, reference, illuminance=100.0)
    others = replace(scene, in_focus=False), replace(scene, light=light[[0, 1, 1, 2]])
    drapes = list(pictured.draped_scenes([scene, *others], CAMERA, copies=4))
    assert len({d.scene_id for d in drapes}) == len(drapes) == 4
    assert not torch.equal(drapes[0].depth, drapes[1].depth)
    for copy in drapes:
        assert torch.equal(copy.light, light)
        assert (copy.group, copy.kind, copy.size) == ("the-group", DRAPED, (64, 48))
        assert blur(copy).max() <= 7.0 + 1e-3
        assert blur(copy).min() < 0.35  # something is in focus


def test_softness_is_that_of_edges() -> None:
    """Edges anywhere in a pixel: 2/3 of the square is between neighbours, 5/3 between second ones.

    Private: the whole path would need a picture of every softness.
    """
    rng = np.random.default_rng(0)
    edge = np.repeat(rng.uniform(1.0, 2.0, (256, 64)), 400, axis=1)  # 50 steps to a pixel
    rows = np.stack([np.roll(r, int(rng.integers(400))) for r in edge])
    pixels = rows.reshape(256, -1, 50).mean(axis=2)
    assert pictured._edge_ratio(pixels) == pytest.approx(0.4, abs=0.01)
    assert pictured._edge_ratio(rng.uniform(1.0, 1.1, (256, 256))) == pytest.approx(1.0, abs=0.02)


def by_split(data: Path | None, drawn: int = 0) -> dict[str, list[DetailPicture]]:
    return {s: pictured.detail_pictures(s, data=data, drawn=drawn) for s in SPLITS}


def the_only(folder: Path, name: str) -> DetailPicture:
    (found,) = (p for own in by_split(folder).values() for p in own if p.name == name)
    return found


def test_groups_of_files_stay_together(tmp_path: Path) -> None:
    (tmp_path / "photo_pool").mkdir()
    rows = ["file,licence,group"]
    for i in range(60):
        Image.new("RGB", (12, 10), (i, 2 * i, 99)).save(tmp_path / f"photo_pool/p{i}.png")
        rows.append(f"photo_pool/p{i}.png,CC0,series{i % 20}")
    (tmp_path / "MANIFEST_POOL.csv").write_text("\n".join(rows) + "\n")
    for name in ("bridge", "venice"):
        write_hdr(tmp_path / f"hdri_cc0/{name}.hdr")
    pictures = by_split(tmp_path)
    assert_no_group_is_shared(pictures)
    found = [p for own in pictures.values() for p in own if p.kind == "photograph"]
    assert {p.group for p in found} == {f"series{i}" for i in range(20)}
    assert len({p.group for p in pictures["train"]}) > len({p.group for p in pictures["test"]}) > 1
    assert [p.name for p in pictures["train"] if p.kind == "radiance"] == ["bridge"]
    assert [p.name for p in pictures["test"] if p.kind == "radiance"] == ["venice"]
    # 62, 8 and 30 percent of 2,000 groups, within four standard errors.
    drawn = [pictured.detail_split(f"group{i}") for i in range(2000)]
    for split, share in zip(SPLITS, (0.62, 0.08, 0.30), strict=True):
        error = 4 * (share * (1 - share) / 2000) ** 0.5
        assert drawn.count(split) / 2000 == pytest.approx(share, abs=error)


def test_mosaics_linear_frames_and_maps_by_hand(tmp_path: Path) -> None:
    """Black 10 and white 110; the planes lie at (0, 0), (0, 1), (1, 0), (1, 1)."""
    cv2 = pytest.importorskip("cv2")
    for folder in ("gopro_raw", "intel_tau_small"):
        (tmp_path / folder).mkdir()
    tile = np.array([[20, 30], [40, 60]], np.uint16)
    Image.fromarray(np.tile(tile, (2, 3))).save(tmp_path / "gopro_raw" / "A.png")
    meta = {"black": [10] * 4, "white": 110, "dng_tags": {"NoiseProfile": "(0.002, 0.00003)"}}
    (tmp_path / "gopro_raw" / "meta.json").write_text(json.dumps({"A.png": meta}))
    frame = np.zeros((4, 4, 3), np.uint16)
    frame[..., 2] = 65535  # red, as OpenCV writes it
    cv2.imwrite(str(tmp_path / "intel_tau_small" / "B.png"), frame)
    mosaic, linear = (the_only(tmp_path, name) for name in ("A.png", "B"))
    assert mosaic.light.shape == (4, 2, 3)
    assert mosaic.light[:, 1, 2].tolist() == pytest.approx([0.1, 0.2, 0.3, 0.5])
    assert (mosaic.nlf.shot, mosaic.nlf.read) == ((0.002,) * 4, (0.00003,) * 4)
    assert linear.light[:, 3, 0].tolist() == [1.0, 0.0, 0.0]
    assert linear.nlf.is_zero
    # A map has a median of one, and no lamp outshines it.
    image = np.full((8, 16, 3), 4.0)
    image[0, 0] = 4000.0
    write_hdr(tmp_path / "hdri_pool" / "room.hdr", image=image)
    light = the_only(tmp_path, "room").light
    assert light.shape == (3, 8, 16)
    assert light[:, 0, 0].tolist() == [64.0] * 3
    torch.testing.assert_close(light[:, 1:], torch.ones(3, 7, 16), rtol=0.01, atol=0)


def test_drawn_pictures(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(pictured, "_SIZE", 64)
    drawn = by_split(None, drawn=8)
    assert "AE_ENV_DATA" in caplog.text
    assert_no_group_is_shared(drawn)
    for own in drawn.values():
        assert [p.kind for p in own] == ["leaves"] * 8 + ["chart"] * 8 + ["smooth"] * 8
        for each in own:
            assert (each.light.shape, each.light.dtype) == ((3, 64, 64), torch.float32)
            assert bool(((each.light >= 0) & each.light.isfinite()).all())
    again, other = (pictured.detail_pictures("train", data=None, drawn=8, seed=s) for s in (0, 1))
    for first, same, new in zip(drawn["train"], again, other, strict=True):
        assert torch.equal(first.light, same.light)
        assert not torch.equal(first.light, new.light)
        assert first.group != new.group
