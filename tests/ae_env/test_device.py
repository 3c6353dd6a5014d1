"""Environments whose frames torch makes on a device: here the CPU's, against the compiled loops.

With the same seed both have the same noise; only the order of float32 arithmetic differs.
"""

import pathlib
import subprocess
import sys

import numpy as np
import pytest
import torch
from gymnasium.wrappers.vector import ArrayConversion

from simulator.capture.blurred_frames import BLUR
from simulator.capture.device_frames import moved_sums, tap_columns
from simulator.optics.motion import Path, path_blur, path_taps
from tests.ae_env.environments import SMALL, make_env, make_envs

SAME = {"autoreset_mode": "SAME_STEP"}


def pair(num_envs=3, **arguments):
    return [make_envs(num_envs, device=device, **arguments) for device in (None, "cpu")]


def assert_close(loops, torchs, reward=1e-4) -> None:
    """At most one code, and that where rounding is close; rewards as near as one blown pixel."""
    (first, *rest), (second, *others) = loops, torchs
    for name, values in second.items():
        assert isinstance(values, torch.Tensor)
        apart = np.abs(values.double().numpy() - first[name])
        assert values.numpy().dtype == first[name].dtype
        assert apart.max() <= (name == "raw")
        assert (apart > 0).mean() < 1e-3
    if len(rest) == 4:
        assert [v.dtype for v in others[:3]] == [torch.float32, torch.bool, torch.bool]
        np.testing.assert_allclose(others[0].numpy(), rest[0], rtol=0, atol=reward)
        for flags, wanted in zip(others[1:3], rest[1:3], strict=True):
            np.testing.assert_array_equal(flags.numpy(), wanted)
    own, wanted = others[-1], rest[-1]
    assert own.keys() == wanted.keys()
    for name in ("state", "modules", "clipped_low", "excess_noise", "predicted_error"):
        np.testing.assert_allclose(own[name], wanted[name], rtol=1e-4, atol=2e-4)


@pytest.mark.parametrize("lighting", ["static", "flicker"])
def test_frames_are_those_of_the_loops_at_every_state(lighting: str) -> None:
    """20 scenes in 64 states each, in motion, with subjects that move, and out of focus."""
    both = pair(64, lighting=lighting, scenes="bundled", split="test")
    scenes = both[0].unwrapped.scene_ids[:: len(both[0].unwrapped.scene_ids) // 20][:20]
    for seed, scene in enumerate(scenes):
        options = {"scene": scene, "state": list(range(64))}
        assert_close(*(envs.reset(seed=100 * seed, options=options) for envs in both))
        assert_close(*(envs.step(np.arange(64)) for envs in both))


@pytest.mark.parametrize(
    "arguments",
    [
        {"source": "raw", "costs": {"flicker": 1.0}},  # denoised; a blur averages its noise
        {"source": "raw", "noise": "sensor", "camera": "sony_a7s2", "reward": "expected"},
        {"observation": "dn", "noise": "exact", "lighting": "sine", "scorer": "shin"},
        {"observation": "statistics", "motion": 0.5, "depth": 3.0, "scenes": "bundled:snow"},
    ],
)
def test_every_option_has_the_same_episodes(arguments, monkeypatch) -> None:
    both = pair(**SAME, max_episode_steps=3, **arguments)
    rng = np.random.default_rng(0)
    assert_close(*(envs.reset(seed=3) for envs in both), reward=1e-3)
    full = "simulator.capture.device_frames.DeviceFrames.is_full"
    for step in range(7):
        monkeypatch.setattr(full, step > 3)  # then less is cached
        actions = rng.integers(64, size=3)
        results = [envs.step(actions) for envs in both]
        assert_close(*results, reward=1e-3)
        loops, torchs = (result[-1].get("final_obs", [None] * 3) for result in results)
        for first, second in zip(loops, torchs, strict=True):
            assert (first is None) == (second is None) == (step % 3 != 2)
            for name in first or ():
                apart = np.abs(second[name].double().numpy() - first[name])
                assert apart.max() <= (name == "raw")


def test_paths_are_those_of_the_loops_on_threads_too() -> None:
    paths = np.random.default_rng(0).uniform((0, 0, -1, -5, -5), (9, 6, 1, 5, 5), (300, 5))
    blurs = np.zeros(300, BLUR)
    for name, values in zip(Path._fields, paths.T, strict=True):
        blurs[name] = values
    torch.set_num_threads(2)
    counts, *taps = tap_columns(blurs, True, 30, 40)
    parts = [np.split(values, counts.cumsum()[:-1]) for values in taps]
    for path, *found in zip(paths, *parts, strict=True):
        for own, wanted in zip(found, path_taps(Path(*path), 30, 40), strict=True):
            np.testing.assert_array_equal(own, wanted)
    images = torch.from_numpy(np.random.default_rng(1).random((9, 2, 30, 40), np.float32))
    some = counts[:9], *(values[: counts[:9].sum()] for values in taps)
    for samples in (2**30, 2**16, 2**13, 1):  # all at once, some frames, some rows, one
        sums = moved_sums(images, samples, some)
        for path, image, found in zip(paths[:9], images, sums, strict=True):
            torch.testing.assert_close(found, path_blur(image, path_taps(Path(*path), 30, 40)))


@pytest.mark.parametrize("device", [None, "cpu"])
def test_torchs_default_dtype_changes_nothing(device) -> None:
    found = []
    for dtype in (torch.float32, torch.bfloat16):
        torch.set_default_dtype(dtype)
        try:
            envs = make_envs(8, device=device, costs={"flicker": 1.0})
            envs.reset(seed=1)
            found.append(envs.step(8 * np.arange(8)))
        finally:
            torch.set_default_dtype(torch.float32)
    for name, values in found[0][4].items():
        np.testing.assert_array_equal(np.asarray(found[1][4][name]), np.asarray(values), name)


def test_on_another_device() -> None:
    """In a process of its own: from then on torch knows the stand-in for a device."""
    checks = pathlib.Path(__file__).parents[1] / "on_other_device.py"
    command = [sys.executable, "-m", "pytest", "-q", "-n0", str(checks)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:]


def test_actions_may_be_tensors_and_a_wrapper_gives_arrays() -> None:
    envs = make_envs(device="cpu", render_mode="rgb_array", **SAME)
    first = envs.reset(seed=0)[0]
    shown = envs.step(torch.tensor([3, 9, 63]))
    assert envs.render()[0].dtype == np.uint8
    with torch.inference_mode():  # as rollouts of some trainers are
        given = {"autoreset_mode": "DISABLED", "max_episode_steps": 1, "observation": "dn"}
        masked = make_envs(device="cpu", **given)
        masked.reset(seed=0)
    done = masked.step(np.array([0, 1, 2]))[3]
    masked.reset(options={"reset_mask": done & torch.tensor([True, False, True])})
    info = {name: values for name, values in shown[4].items() if name[0] != "_"}
    assert envs.unwrapped.info_of(info, 1)["state"] == 9
    assert shown[0]["raw"].data_ptr() != first["raw"].data_ptr()
    converted = ArrayConversion(make_envs(device="cpu", **SAME), env_xp=torch, target_xp=np)
    converted.reset(seed=0)
    observation, reward, *_ = converted.step(np.array([3, 9, 63]))
    assert isinstance(reward, np.ndarray)
    np.testing.assert_array_equal(observation["raw"], shown[0]["raw"].numpy())


@pytest.mark.parametrize(
    ("make", "arguments", "named"),
    [
        *(
            (make_envs, {"device": name}, "device")
            for name in ("gpu9", "mps", "meta", "privateuseone")
        ),
        (make_env, {"device": "cpu"}, "make_vec"),
        (make_envs, {"task": "ae_env/ExposureBracket-v0", "device": "cpu"}, "device"),
    ],
)
def test_what_has_no_device_says_so(make, arguments, named) -> None:
    with pytest.raises((ValueError, TypeError), match=named):
        make(**{**SMALL, **arguments})
