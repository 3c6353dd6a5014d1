"""The light of frames: bands of flicker in captures, scores and tables."""

from typing import Any

import numpy as np
import pytest

from ae_env.scenes import Scene
from ae_env.scorers import make_scorer
from ae_env.scorers.captures import describe_captures
from simulator.capture.sensor import clip_and_quantise
from simulator.optics.flicker_integral import MainsLamp, PulsedLamp
from simulator.reference.camera import ReferenceCamera, ReferenceScene
from tests.ae_env.environments import make_env, make_envs
from tests.ae_env.scorer_images import CAMERA, make_scene

LED = {"kind": "flicker", "frequency": 250.0, "duty": 0.3, "frame_rate": 24.0}


def _scene() -> Scene:
    light = 0.05 + 0.3 * np.random.default_rng(0).random((4, 40, 40), np.float32)
    return make_scene(light, 640.0, scene_id="grey", box_factor=4)


def _env(**arguments: Any) -> Any:
    given = {"scenes": [_scene()], "resolution": 40, "motion": "none", "depth": "far"}
    return make_env(**{**given, **arguments}).unwrapped


@pytest.mark.parametrize(
    ("lighting", "make_lamp"),
    [
        ({"kind": "flicker", "depth": 1.0}, lambda phase: MainsLamp(100.0, 1.0, phase)),
        (LED, lambda phase: PulsedLamp(250.0, 0.3, phase)),
    ],
)
def test_frames_are_those_of_the_reference_camera(lighting: Any, make_lamp: Any) -> None:
    env, scene = _env(lighting=lighting, noise=False, observation="linear"), _scene()
    reference = ReferenceCamera(CAMERA, box_factor=4)
    native = scene.light.repeat_interleave(4, 1).repeat_interleave(4, 2)
    before = ReferenceScene("grey", "grey", "test", native, scene.reference)
    env.reset(seed=4)
    rate = lighting.get("frame_rate", 30.0)
    for frame, state in enumerate((0, 17, 22, 37, 50, 63), start=1):
        observation, *_ = env.step(state)
        lamp = make_lamp(env.episode().phase)
        wanted = reference.capture(before, env.grid[state], 0, lamp=lamp, start=frame / rate).mean
        step = 1.0 / min(CAMERA.span)  # the mean is not rounded to digital numbers
        np.testing.assert_allclose(observation["raw"], wanted, atol=0.51 * step)


@pytest.mark.parametrize("scorer", ["balanced", {"balanced": 0.7, "banding": 0.3}])
def test_scores_of_all_states_have_their_own_exposures_light(scorer: Any) -> None:
    env = _env(
        lighting=LED, scorer=scorer, with_oracle=True, motion=0.05, depth=0.5, noise=False,
        reward="expected",
    )  # fmt: skip
    env.reset(seed=0)
    _, reward, _, _, info = env.step(18)
    lamp, scene = PulsedLamp(250.0, 0.3, env.episode().phase), _scene()
    q = env.expected_scores()
    for state in (0, 9, 18, 30, 63):
        settings = env.grid[state]
        rows = lamp.row_light(1 / 24, settings.exposure_time, 40, CAMERA.row_time, 8)
        blur = {"speed": np.array([0.05]), "defocus": np.array([0.5])}
        gains = {"gain": np.array([rows.mean()]), "row_gain": rows[None] / rows.mean()}
        captures = describe_captures([scene], [settings], CAMERA, **blur, **gains, noisy=False)
        images = clip_and_quantise(captures.light, CAMERA).clamp(0.0, 1.0)
        wanted = float(make_scorer(scorer)(images, captures))
        assert q[state] == pytest.approx(wanted, abs=2e-3)  # rows at the edge of a code
    assert reward == pytest.approx(q[18], abs=1e-9)
    assert info["regret"] == pytest.approx(q.max() - q[18], abs=1e-6)


def test_steady_rows_among_banded_ones_are_as_in_steady_light() -> None:
    """1/50 s beside 1/1000 s, in one batch."""
    grid = {"isos": [100, 400], "exposure_times": [0.001, 0.02], "f_numbers": [4, 8]}
    arguments = {"scenes": [_scene()], "resolution": 40, "grid": grid}
    envs, plain = (make_envs(2, lighting=light, **arguments) for light in ("flicker", "static"))
    for made in (envs, plain):
        made.reset(seed=3)
    first, second = envs.step(np.array([0, 2])), plain.step(np.array([0, 2]))
    np.testing.assert_array_equal(first[0]["raw"][1], second[0]["raw"][1])
    assert (first[0]["raw"][0] != second[0]["raw"][0]).mean() > 0.3
    assert first[1][1] == pytest.approx(second[1][1], abs=1e-6)
