import numpy as np
import pytest
import torch

from ae_env.scenes.reference_scenes import draped_scenes, reference_scenes, sharpened
from simulator import CameraSettings, get_camera
from simulator.reference.reference_camera import DRAPED, ReferenceScene

CAMERA = get_camera("nikon_z6")


def picture(kind: str = "indoor", size: int = 64) -> ReferenceScene:
    generator = torch.Generator().manual_seed(1)
    return ReferenceScene(
        scene_id="a",
        group="the-group",
        kind=kind,
        light=torch.rand(4, size, size, generator=generator),
        reference=CameraSettings(100, 1 / 64, 4),
        illuminance=100.0,
    )


def test_light_and_group_stay_and_depth_is_new() -> None:
    scene = picture()
    first, second = draped_scenes([scene], CAMERA, copies=2)
    for copy in (first, second):
        assert torch.equal(copy.light, sharpened(scene).light)
        assert (copy.group, copy.kind) == ("the-group", DRAPED)
        assert copy.depth is not None
    assert first.scene_id != second.scene_id
    assert not torch.equal(first.depth, second.depth)  # type: ignore[arg-type]


def test_the_same_seed_gives_the_same_depth() -> None:
    once, again = (next(draped_scenes([picture()], CAMERA, seed=3)) for _ in range(2))
    other = next(draped_scenes([picture()], CAMERA, seed=4))
    assert torch.equal(once.depth, again.depth)  # type: ignore[arg-type]
    assert not torch.equal(once.depth, other.depth)  # type: ignore[arg-type]


def test_blur_is_what_the_thin_lens_says() -> None:
    """|1/s - 1/z| f^2 / N / (1 - f / s) over the packed pixel, at most 7 px at f/11."""
    for scene in draped_scenes([picture(size=128)], CAMERA, copies=6):
        assert scene.depth is not None
        f, s = scene.lens.focal_length, scene.lens.focus_distance
        depth = scene.depth.double().numpy()
        blur = np.abs(1 / s - 1 / depth) * f**2 / 11 / (1 - f / s) / (2 * 5.94e-6)
        assert blur.max() <= 7.0 + 1e-3
        assert blur.min() < 0.35  # something is in focus


def test_photographs_and_scenes_with_depth_are_passed_over() -> None:
    scenes = [s for s in reference_scenes("train", CAMERA, number=1, size=32) if s.kind == "depth"]
    assert scenes
    assert not list(draped_scenes([*scenes, picture("photograph")], CAMERA))


def test_sharpened_is_the_mean_of_2_by_2() -> None:
    scene = picture(size=5)
    expected = scene.light.numpy()[:, :4, :4].reshape(4, 2, 2, 2, 2).mean((2, 4))
    assert sharpened(scene).light.numpy() == pytest.approx(expected)
