"""Scenes of the reference camera: splits, light, depth of real photographs, draped pictures."""

import logging
from pathlib import Path

import numpy as np
import pytest
import torch

from ae_env.scenes.reference_scenes import (
    RADIANCE_MAPS,
    depth_photographs,
    draped_scenes,
    reference_scenes,
    sharpened,
)
from simulator import CameraSettings, get_camera
from simulator.reference.reference_camera import DRAPED, ReferenceScene
from tests.ae_env.scene_files import write_exr

CAMERA = get_camera("nikon_z6")
SPLITS = ("train", "validation", "test")
WHITE = 100 * 2.5 / (120 * np.pi)  # signal of a white surface at the incident-light exposure


@pytest.fixture(scope="module")
def scenes() -> dict[str, list[ReferenceScene]]:
    return {split: reference_scenes(split, CAMERA, number=28, size=48) for split in SPLITS}


def blur(scene: ReferenceScene, pitch: float = 11.88e-6) -> np.ndarray:
    """Circle of confusion at f/11 [packed pixels] by the thin-lens formula."""
    f, s, z = scene.lens.focal_length, scene.lens.focus_distance, scene.depth.double().numpy()
    return f * f / (11.0 * (s - f)) * np.abs(z - s) / z / pitch


def test_no_source_is_in_two_splits(scenes: dict[str, list[ReferenceScene]]) -> None:
    groups = [{s.group for s in scenes[split]} for split in SPLITS]
    assert all(groups)
    assert sum(map(len, groups)) == len(set().union(*groups))
    stems = [set(RADIANCE_MAPS[split]) for split in SPLITS]
    assert [len(s) for s in stems] == [4, 2, 7]
    assert len(set().union(*stems)) == 13
    ids = [s.scene_id for split in SPLITS for s in scenes[split]]
    assert len(ids) == len(set(ids))


def test_scenes_are_reproducible_and_more_of_them_keep_the_first(
    scenes: dict[str, list[ReferenceScene]],
) -> None:
    fewer = reference_scenes("test", CAMERA, number=5, size=48)[:5]
    for scene, again in zip(scenes["test"], fewer, strict=False):
        assert (scene.scene_id, scene.lens) == (again.scene_id, again.lens)
        for field in ("light", "depth"):
            torch.testing.assert_close(getattr(again, field), getattr(scene, field), rtol=0, atol=0)
    other = reference_scenes("test", CAMERA, number=1, size=48, seed=1)[0]
    assert other.group != fewer[0].group
    assert not torch.equal(other.light, fewer[0].light)


def test_kinds_and_light(scenes: dict[str, list[ReferenceScene]]) -> None:
    train = scenes["train"]
    kinds = [s.kind for s in train]
    assert kinds.count("depth") == 21
    assert set(kinds) == {
        *("depth", "photograph", "dead_leaves", "indoor", "back_light", "snow", "night"),
        *("spot_light", "motion"),
    }
    for scene in train:
        assert scene.light.shape == (4, 48, 48)
        assert scene.light.dtype == torch.float32
        assert bool((scene.light >= 0).all())
        assert (scene.depth is not None) == (scene.kind == "depth")
        assert 1.0 <= scene.illuminance <= 20_000.0
        # The incident-light exposure, E = 2.5 * 2**EV100, with ISO 12232's 120 for white.
        exposure = 2.0**scene.reference.log2_exposure
        assert scene.illuminance * exposure / 2.5 == pytest.approx(1.0, rel=1e-6)
    surfaces = [s.light[1].median().item() / WHITE for s in train if s.kind == "depth"]
    assert 0.05 < np.median(surfaces) < 0.3  # reflectances of nature


def test_radiance_maps_by_name(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "maps").mkdir()
    panorama = np.full((256, 512, 3), 0.5)
    panorama[:, 192:320] = 4.0  # the quarter ahead
    write_exr(tmp_path / "maps" / "city.exr", panorama)
    write_exr(tmp_path / "maps" / "unknown.exr", panorama)
    with caplog.at_level(logging.WARNING):
        found = reference_scenes("validation", CAMERA, number=0, size=64, radiance=tmp_path)
    assert "no radiance map 'StillLife'" in caplog.text
    views = [s for s in found if s.kind == "radiance"]
    assert [s.scene_id for s in views] == ["city-000", "city-090", "city-180", "city-270"]
    assert {s.group for s in views} == {"city"}
    for view in views:
        assert view.depth is None
        assert view.light.shape == (4, 64, 64)
        assert view.light[1].mean().item() == pytest.approx(0.12, rel=0.01)  # flat in 90 degrees
        assert f"{view.illuminance:g} lux assumed" in view.source
        assert view.reference.log2_exposure == pytest.approx(-np.log2(view.illuminance / 2.5))
    write_exr(tmp_path / "maps" / "StillLife.exr", np.ones((256, 300)))  # no panorama
    found = reference_scenes("validation", CAMERA, number=0, size=64, radiance=tmp_path)
    assert "StillLife" in {s.scene_id for s in found}
    train = reference_scenes("train", CAMERA, number=0, size=64, radiance=tmp_path)
    assert all(s.kind == "photograph" for s in train)
    with pytest.raises(FileNotFoundError, match="`radiance`"):
        reference_scenes("train", CAMERA, number=0, radiance=tmp_path / "none")


def test_motorcycle_has_the_depth_of_its_calibration() -> None:
    """z = baseline * focal length / (disparity + offset), as scikit-image's documentation says."""
    from skimage.data import stereo_motorcycle

    _, _, disparity = stereo_motorcycle()
    front, middle = depth_photographs(CAMERA)
    assert (front.scene_id, middle.scene_id) == ("motorcycle-front", "motorcycle-middle")
    assert front.group == middle.group == "motorcycle"
    assert front.light.shape == (4, 250, 370)
    assert torch.equal(front.depth, middle.depth)
    depth = 0.193001 * 994.978 / (np.where(np.isfinite(disparity), disparity, np.nan) + 31.086)
    four = depth[:500, :740].reshape(250, 2, 370, 2).transpose(0, 2, 1, 3).reshape(250, 370, 4)
    known = np.isfinite(four).all(axis=2)
    ours = front.depth.numpy()[known]
    # One of the four depths, the second farthest: never a mean of two sides of an edge.
    np.testing.assert_allclose(ours, np.sort(four[known], axis=1)[:, 2], rtol=1e-5)
    assert 1.8 < front.depth.min() < front.depth.max() < 6.0
    assert bool((front.light >= 0).all())


@pytest.mark.parametrize(
    ("field", "value"), [("split", "trian"), ("number", -1), ("size", 8), ("seed", -1)]
)
def test_errors_name_the_argument(field: str, value: object) -> None:
    arguments = {"split": "train", "number": 1, "size": 32, "seed": 0} | {field: value}
    with pytest.raises(ValueError, match=f"`{field}` "):
        reference_scenes(arguments.pop("split"), CAMERA, **arguments)


@pytest.mark.real_data
def test_real_cones(data_dir: Path) -> None:
    cones = depth_photographs(CAMERA, data=data_dir)[2:]
    assert [s.scene_id for s in cones] == ["cones-front", "cones-middle"]
    for scene in cones:
        assert scene.light.shape == (4, 187, 225)
        assert scene.depth.shape == (187, 225)
        assert bool(torch.isfinite(scene.depth).all())
        assert 4.5 < np.quantile(blur(scene), 0.97) < 6.3


def picture(size: int = 64) -> ReferenceScene:
    light = torch.rand(4, size, size, generator=torch.Generator().manual_seed(1))
    reference = CameraSettings(100, 1 / 64, 4)
    return ReferenceScene("a", "the-group", "indoor", light, reference, illuminance=100.0)


def test_light_and_group_stay_and_depth_is_new() -> None:
    scene = picture()
    first, second = draped_scenes([scene], CAMERA, copies=2)
    for copy in (first, second):
        assert torch.equal(copy.light, sharpened(scene).light)
        assert (copy.group, copy.kind) == ("the-group", DRAPED)
    assert first.scene_id != second.scene_id
    assert not torch.equal(first.depth, second.depth)  # type: ignore[arg-type]


def test_blur_of_draped_pictures_is_in_range() -> None:
    for scene in draped_scenes([picture(size=128)], CAMERA, copies=6):
        diameter = blur(scene)
        assert diameter.max() <= 7.0 + 1e-3
        assert diameter.min() < 0.35  # something is in focus
