"""Procedural depth: nearer hides farther, blur as the thin lens has it, sharp where in focus."""

import numpy as np
import pytest
import torch

from ae_env.scenes.bundled import add_layout
from ae_env.scenes.measured_depth import depth_scenes
from simulator.radiance import depth
from simulator.radiance.depth import FOCUSES, DepthDrawing, draw_depth, lens_and_depth
from simulator.radiance.procedural import dead_leaves
from tests.ae_env.scorer_images import CAMERA, make_scene

PITCH = 11.88e-6  # packed pixels of the Nikon Z6


def drawn(seed: int, size: int = 48, focus: str = "middle") -> DepthDrawing:
    return draw_depth(np.random.default_rng(seed), size, focus)


def test_dead_leaves_stay_what_they_are() -> None:
    """A value of the first release: the bundled scenes must not change."""
    picture = dead_leaves(np.random.default_rng(7), 48)
    mean = [0.15036413232802362, 0.16999628065968864, 0.15176365238261902]
    np.testing.assert_allclose(picture.mean(axis=(1, 2), dtype=float), mean, rtol=1e-5)


def test_a_thing_hides_what_is_farther_and_nothing_else() -> None:
    ramp = np.repeat(np.linspace(-4.0, 4.0, 48, dtype=np.float32)[None], 48, axis=0)
    visible = 0
    for seed in range(12):
        blur, surface = ramp.copy(), np.zeros((48, 48), int)
        depth._put_thing(np.random.default_rng(seed), blur, surface, 1, 0.0)
        seen = surface == 1
        assert (blur[seen] < ramp[seen]).all()  # larger is farther
        np.testing.assert_array_equal(blur[~seen], ramp[~seen])
        assert not seen[ramp < -2.0].any()  # no thing is slanted by more than 1.8 pixels
        visible += seen.any()
    assert visible >= 6


def test_depth_gives_the_blur_back_by_the_thin_lens() -> None:
    """c = f^2 / (N (s - f)) |z - s| / z with f = 50 mm and N = 11, by hand."""
    for seed, focus in enumerate(FOCUSES * 2):
        picture = drawn(seed, focus=focus)
        distance, z = lens_and_depth(picture.blur, picture.far, PITCH)
        z = z.astype(float)
        c = 0.05**2 / (11.0 * (distance - 0.05)) * (z - distance) / z / PITCH
        np.testing.assert_allclose(c, picture.blur, atol=2e-4)
        assert 0.5 < z.min() <= z.max() <= 51.0
        assert 1.0 / z.max() == pytest.approx(picture.far, rel=1e-4)


def test_what_is_in_focus() -> None:
    for seed in range(8):
        everything = drawn(seed, focus="everything").blur
        assert np.abs(everything).max() <= 0.3 + 1e-6
        front, back = drawn(seed, focus="front").blur, drawn(seed, focus="back").blur
        # Slants and floating leaves reach at most 1.8 pixels past the level of the thing.
        assert front.min() > -2.0
        assert back.max() < 2.0
        for blur in (front, back):
            assert np.abs(blur).max() <= 7.0


def test_errors_name_the_argument() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"`focus` \(='fron'\).*did you mean 'front'"):
        draw_depth(rng, 32, "fron")
    with pytest.raises(ValueError, match=r"`size` \(=8\)"):
        draw_depth(rng, 8)


def test_draped_pictures_are_laid_out() -> None:
    """Most are focused on the nearest thing, and none without a subject that can be seen."""
    scenes = [make_scene(np.ones((4, 40, 48)), 100.0, scene_id=f"{i}") for i in range(60)]
    layouts = [add_layout(scene).layout for scene in scenes]
    in_focus = 0
    for layout in layouts:
        assert layout is not None
        assert layout.subject is not None
        assert layout.defocus.shape == layout.subject.shape == (40, 48)
        assert float(layout.defocus.max()) > 0.7  # the cut may miss the largest
        in_focus += float(layout.defocus[layout.subject].median()) < 0.2
    assert 0.6 * len(layouts) < in_focus < 0.95 * len(layouts)
    shares = [float(layout.subject.float().mean()) for layout in layouts]
    assert min(shares) > 0.0
    assert 0.05 < np.mean(shares) < 0.5


def test_layouts_depend_on_the_name_alone() -> None:
    """One scene has one layout at every resolution: the finer, averaged."""
    light = np.random.default_rng(0).random((4, 128, 128))
    fine = add_layout(make_scene(light, 100.0, scene_id="a"))
    again = add_layout(make_scene(light * 0.5, 200.0, scene_id="a"))
    other = add_layout(make_scene(light, 100.0, scene_id="b"))
    small = add_layout(make_scene(light[:, :64, :64], 100.0, scene_id="a"))
    resized = fine.resized(64).layout
    assert None not in (fine.layout, again.layout, other.layout, small.layout, resized)
    assert torch.equal(fine.layout.defocus, again.layout.defocus)
    assert not torch.equal(fine.layout.defocus, other.layout.defocus)
    torch.testing.assert_close(resized.defocus, small.layout.defocus)


def test_scenes_with_measured_depth_have_its_layout() -> None:
    front, middle, *_ = depth_scenes(CAMERA)
    for scene in (front, middle):
        assert scene.layout is not None
        assert scene.layout.defocus.shape == scene.light.shape[1:]
        assert scene.layout.subject is not None
        assert scene.resized(64).layout is not None
    assert front.scene_id == "motorcycle-front"
    assert float(front.layout.defocus.max()) > 0.9
