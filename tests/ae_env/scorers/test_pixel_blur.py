"""Blur that differs from pixel to pixel: sharpness is the mean over the pixels."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from ae_env.grid import ExposureGrid
from ae_env.scenes import Scene
from ae_env.scorers import make_scorer
from ae_env.scorers.captures import describe_captures, prepare_scene
from ae_env.scorers.score_table import ScoreTables
from ae_env.scorers.terms import Sharpness
from simulator.capture.prepared_scene import Layout
from simulator.optics.motion import Movement
from tests.ae_env.scorer_images import CAMERA, make_scene

SIZE = 40
MOVEMENT = Movement(0.3, 4.0, subject_speed=0.5, subject_direction=2.5)
GRID = ExposureGrid((100, 800), (1 / 100, 1 / 4), (4, 8))


def _scene(name: str = "laid-out") -> Scene:
    rng = np.random.default_rng(1)
    layout = Layout(
        torch.from_numpy(rng.random((SIZE, SIZE)).astype(np.float32)),
        torch.from_numpy(rng.random((SIZE, SIZE)) < 0.4),
    )
    light = np.full((4, SIZE, SIZE), 0.12)
    return make_scene(light, 640.0, scene_id=name, layout=layout)


def _wanted(scene: Scene, speed: float, defocus: float, movement: Movement) -> np.ndarray:
    """Mean sharpness of every state, pixel by pixel and by quadrature of the subject's path."""
    assert scene.layout is not None
    found = []
    for state in GRID:

        def velocity(time: float) -> float:
            angle = movement.direction + movement.turn * time
            own = movement.subject_speed * np.exp(1j * movement.subject_direction)
            return abs(speed * np.exp(1j * angle) + own)

        subject = scene.layout.subject
        path = quad(velocity, 0.0, state.exposure_time)[0]
        motion = np.full((SIZE, SIZE), speed * state.exposure_time)
        motion[subject] = path
        disc = scene.layout.defocus.numpy() * defocus * 4.0 / state.effective_f_number / 64.0
        found.append((1.0 / (1.0 + 64.0**2 * (motion**2 + disc**2))).mean())
    return np.array(found)


@pytest.mark.parametrize("defocus", [0.0, 6.0])
@pytest.mark.parametrize("movement", [MOVEMENT, Movement(1.0, -3.0)])
def test_sharpness_is_the_mean_over_the_pixels(defocus: float, movement: Movement) -> None:
    tables = ScoreTables(GRID, CAMERA, make_scorer("balanced"))
    table = tables.table(_scene(), speed=0.2, defocus=defocus, movement=movement)
    wanted = _wanted(_scene(), 0.2, defocus, movement)
    np.testing.assert_allclose(table.parts["sharpness"], wanted, rtol=2e-3)


def test_captures_of_several_scenes_are_those_of_each() -> None:
    plain = replace(_scene("plain"), layout=None)
    scenes, states = [_scene(), plain, _scene()], list(GRID)[-3:]
    captures = describe_captures(
        scenes,
        states,
        CAMERA,
        speed=np.array([0.2, 0.1, 0.0]),
        defocus=np.array([3.0, 3.0, 0.0]),
        movements=[MOVEMENT, MOVEMENT, replace(MOVEMENT, subject_speed=0.0)],
        gain=np.ones(3),
    )
    found = Sharpness()(None, captures).numpy()
    alone = 1.0 / (1.0 + (captures.blur_px[1] * 64.0 / SIZE) ** 2)
    wanted = [_wanted(_scene(), 0.2, 3.0, MOVEMENT)[-3], float(alone), 1.0]
    np.testing.assert_allclose(found, wanted, rtol=2e-3)
    assert captures.blur_px[2] == 0.0


def test_the_extent_is_the_root_mean_square() -> None:
    scene = _scene()
    assert scene.layout is not None
    tables = ScoreTables(GRID, CAMERA, make_scorer("balanced"))
    prepared = prepare_scene(scene, CAMERA, defocus=5.0)
    captures = tables.term_scores.captures.describe(scene, prepared)
    wanted = 5.0 * SIZE / 64.0 * float(scene.layout.defocus.double().square().mean().sqrt())
    assert captures.blur_px[0] == pytest.approx(wanted, rel=2e-3)


def test_sharpness_knows_that_discs_end_where_the_frame_has_them_end() -> None:
    # 64 of 256 packed pixels at f/4; the bank's largest disc has 32.
    layout = Layout(torch.ones(256, 256))
    scene = make_scene(np.full((4, 256, 256), 0.12), 640.0, scene_id="large", layout=layout)
    tables = ScoreTables(GRID, CAMERA, make_scorer("balanced"))
    sharp = tables.table(scene, defocus=16.0).parts["sharpness"]
    np.testing.assert_allclose(sharp, 1.0 / (1.0 + (32.0 / 256.0 * 64.0) ** 2), rtol=1e-2)


@pytest.mark.parametrize("layout", [True, False])
@pytest.mark.parametrize("movement", [MOVEMENT, Movement(1.0, -3.0)])
def test_sharpness_of_all_states_at_once_is_that_of_each_capture(
    layout: bool, movement: Movement
) -> None:
    """To the bit: rewards must not depend on how many states were scored together."""
    scene = _scene() if layout else replace(_scene(), layout=None)
    tables = ScoreTables(GRID, CAMERA, make_scorer("balanced"))
    moves: Any = {"speed": 0.2, "defocus": 6.0, "movement": movement}
    prepared = prepare_scene(scene, CAMERA, **moves)
    found = tables.term_scores.closed_form_terms(scene, prepared, "blur")
    for index, state in enumerate(GRID):
        numbers = {"speed": np.array([0.2]), "defocus": np.array([6.0]), "gain": np.ones(1)}
        capture = describe_captures([scene], [state], CAMERA, movements=[movement], **numbers)
        assert Sharpness()(None, capture).item() == found["sharpness"][index]
