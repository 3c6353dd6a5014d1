"""Exported agents against those in torch, and a camera that is driven by one."""

import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from ae_env.observation import encode_observation, encode_settings
from ae_env.scenes import load_scenes
from agents import PolicyContext, make_policy
from agents.learning.regression import observation_tensors
from agents.onboard.controller import Controller, ExposureState
from agents.onboard.export import export_agent
from simulator.camera import get_camera

ROOT = Path(__file__).parents[3]


def make_envs(num_envs: int, **arguments: Any) -> gym.vector.VectorEnv:
    given = {"scenes": "bundled:small", "split": "test", "max_episode_steps": None, **arguments}
    return gym.make_vec("ae_env:ae_env/AutoExposure-v0", num_envs=num_envs, **given)


@pytest.fixture(scope="module")
def context() -> PolicyContext:
    return PolicyContext.from_envs(make_envs(1))


@pytest.fixture(scope="module", params=["regression", "ppo"])
def exported(request: pytest.FixtureRequest, context: PolicyContext, tmp_path_factory: Any) -> Any:
    policy = make_policy(request.param, context)
    return policy, export_agent(policy, tmp_path_factory.mktemp("onnx") / "agent.onnx")


def test_decisions_of_whole_episodes_are_those_of_torch(exported: Any) -> None:
    """In light that jumps, so that the memory is kept and forgotten; a batch is not frozen."""
    policy, file = exported
    for num_envs in (1, 5):
        envs = make_envs(num_envs, lighting={"kind": "step", "stops": 4, "at": 4})
        controller = Controller(file, num_envs)
        policy.reset(num_envs)
        shown, _ = envs.reset(seed=1)
        for _ in range(9):
            actions = policy.act(shown)
            assert controller.act(**shown).tolist() == actions.tolist()
            shown, *_ = envs.step(actions)


def test_numbers_are_those_of_torch(exported: Any) -> None:
    policy, file = exported
    rng = np.random.default_rng(0)
    for count in (1, 2, 9):
        shown = {
            "raw": rng.integers(256, size=(count, 4, 64, 64), dtype=np.uint8),
            "settings": rng.uniform(-1, 1, (count, 3)).astype(np.float32),
            "sensors": rng.uniform(-1, 1, (count, 2)).astype(np.float32),
        }
        found = Controller(file, count)._session.run(None, shown)
        with torch.inference_mode():
            if policy.kind == "ppo":
                tensors, _ = policy.network.obs_to_tensor(shown)
                wanted = policy.network.get_distribution(tensors).distribution.logits.numpy()
                wanted = wanted - wanted.max(axis=1, keepdims=True)  # torch has normalised its own
                found = [found[0] - found[0].max(axis=1, keepdims=True)]
            else:
                scores, log_variance = policy.network(*observation_tensors(shown))
                wanted = scores.numpy()
                np.testing.assert_allclose(np.log(found[1]), -log_variance.numpy(), atol=1e-4)
                reading = policy._meter(shown)
                np.testing.assert_allclose(found[2], reading.ev100, atol=1e-4)
        np.testing.assert_allclose(found[0], wanted, atol=1e-4)


def test_it_needs_no_torch(exported: Any) -> None:
    code = (
        f"import sys; sys.path.insert(0, {str(ROOT)!r}); import numpy as np;"
        "from agents.onboard.controller import Controller;"
        f"c = Controller({str(exported[1])!r});"
        "print(c.decide(np.full((4, 96, 128), 0.9), c.states[40]));"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_frames_and_settings_are_encoded_as_the_environment_does(exported: Any) -> None:
    controller = Controller(exported[1])
    planes = np.random.default_rng(0).uniform(-0.01, 1.0, (4, 64, 64)).astype(np.float32)
    wanted = encode_observation(torch.from_numpy(planes)).numpy()
    difference = controller.encode_frame(planes).astype(int) - wanted
    assert np.abs(difference).max() <= 1  # float64 here, float32 there
    assert (difference != 0).mean() < 1e-3
    blocks = controller.encode_frame(np.repeat(np.repeat(planes, 3, axis=1), 2, axis=2))
    np.testing.assert_array_equal(blocks, controller.encode_frame(planes))
    state = ExposureState(400.0, 1 / 64, 4.0)
    expected = encode_settings(np.array([4.0, 6.0, 7.0]))  # Av, Tv, and Sv: 3.125 * 2**7 = 400
    np.testing.assert_allclose(controller.encode_settings(state), expected, atol=1e-7)


def test_a_camera_with_delays_and_dropped_frames_is_exposed(exported: Any) -> None:
    """After each jump of 5 EV it settles, at the aperture that it has, where little is clipped."""
    loop, simulated = (
        SimpleNamespace(**runpy.run_path(str(ROOT / "examples" / f"{name}.py")))
        for name in ("picamera2_ae", "simulated_camera")
    )
    body = get_camera("nikon_z6")
    scenes = load_scenes("bundled:small", "test", camera=body, resolution=64)
    scene = next(scene for scene in scenes if scene.kind == "indoor")
    gains = [2.0 ** (5 * (i >= 20) - 5 * (i >= 40)) for i in range(60)]
    camera = simulated.SimulatedCamera(
        scene, body, 4.0, delay=2, gains=gains, dropped=(5, 6, 21, 43)
    )
    taken, asked, signal = [], [], []
    make = camera.photograph

    def seen(frame: int, given: dict[str, float]) -> Any:
        request = make(frame, given)
        numbers = request.make_array("raw").astype(float) - body.black_level[0]
        signal.append(numbers.mean() / (body.white_level - body.black_level[0]))
        return request

    camera.photograph = seen
    levels = {"black": body.black_level[0], "white": body.white_level}
    for now, wanted in loop.run(camera, Controller(exported[1]), 56, 4.0, **levels):
        taken.append(now)
        asked.append(wanted)
    assert {state.f_number for state in asked} == {4.0}
    assert all(state.exposure_time < 0.6 for state in taken)
    assert len({round(1e6 * state.exposure_time) for state in taken}) > 1
    for last in (17, 36, 55):  # frames that came through, at the end of each light
        assert 0.02 < signal[last] < 0.7
        assert abs(np.log2(taken[last].exposure_time / taken[last - 3].exposure_time)) < 0.1


def test_what_cannot_be_exported_or_loaded_is_named(
    exported: Any, context: PolicyContext, tmp_path: Path
) -> None:
    file = tmp_path / "x.onnx"
    for name in ("matrix:P", "regression?foresight=trend"):
        with pytest.raises(ValueError, match="`policy`"):
            export_agent(make_policy(name, context), file)
    with pytest.raises(ValueError, match="`out`"):
        export_agent(make_policy("ppo", context), tmp_path / "x")
    assert not file.exists()
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"no model")
    for path in (broken, file):
        with pytest.raises(ValueError, match="`path`"):
            Controller(path)
    controller = Controller(exported[1])
    frame = np.zeros((1, 4, 64, 64), np.uint8)
    with pytest.raises(ValueError, match="`sensors`"):
        controller.act(frame, np.zeros((1, 3)))
    with pytest.raises(ValueError, match="`raw`"):
        controller.act(np.zeros((2, 4, 64, 64)), np.zeros((1, 3)), np.zeros((1, 2)))
    with pytest.raises(ValueError, match="`planes`"):
        controller.decide(np.zeros((4, 8, 8)), controller.states[0])
