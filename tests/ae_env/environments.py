"""Small environments, one and many, and the comparison of what they show."""

import functools

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

ID = "ae_env/AutoExposure-v0"
SMALL = {"scenes": "bundled:small", "resolution": 36}


def make_env(task=ID, **arguments):
    return gym.make(f"ae_env:{task}", **{**SMALL, **arguments})


def make_envs(num_envs=3, task=ID, **arguments):
    return gym.make_vec(f"ae_env:{task}", num_envs=num_envs, **{**SMALL, **arguments})


def rollout(seed, **arguments):
    """Eight steps of an episode, and the beginning of the next."""
    env = make_env(**arguments)
    frames = [env.reset(seed=seed)]
    frames += [env.step(int(a)) for a in np.random.default_rng(0).integers(64, size=8)]
    return [*frames, env.reset()]


def assert_equal(first, second, where="", **tolerance):
    """Equal values in equal shapes, whatever the order of the keys."""
    assert type(first) is type(second), where
    if torch.is_tensor(first):
        first, second = first.numpy(), second.numpy()
    if isinstance(first, dict):
        assert set(first) == set(second), f"{where}: {set(first) ^ set(second)}"
        for key in first:
            assert_equal(first[key], second[key], f"{where}.{key}", **tolerance)
    elif isinstance(first, tuple | list) or getattr(first, "dtype", None) == np.dtype("O"):
        assert len(first) == len(second), where
        for i, (a, b) in enumerate(zip(first, second, strict=True)):
            assert_equal(a, b, f"{where}[{i}]", **tolerance)
    elif isinstance(first, np.ndarray):
        limits = {"rtol": 0.0} | (tolerance if first.dtype == np.float64 else {})
        np.testing.assert_allclose(first, second, err_msg=where, strict=True, **limits)
    else:
        assert first == second, where


def named(envs, results):
    """What `envs` returned, with names in its info as single environments have them."""
    tables = {"scene_id": envs.unwrapped.scene_ids, "modules": envs.unwrapped.module_names}

    def names(info):
        info = {k: names(v) if isinstance(v, dict) else v for k, v in info.items()}
        for key, table in tables.items():
            if key in info:
                known = zip(info[key], info[f"_{key}"], strict=True)
                info[key] = np.array([table[i] if shown else None for i, shown in known], object)
        return info

    return (*results[:-1], names(results[-1]))


def check_parity(seed, steps, mode="SAME_STEP", **arguments):
    """The native vector environment shows what single ones show, out of step with each other."""
    # Torch rounds exponentials of the last of a batch differently.
    same = functools.partial(assert_equal, rtol=1e-15 * bool({"lighting", "task"} & {*arguments}))
    make = functools.partial(make_env, **arguments)
    envs = make_envs(autoreset_mode=mode, **arguments)
    reference = SyncVectorEnv([make] * 3, autoreset_mode=AutoresetMode[mode], copy=True)
    assert envs.metadata["autoreset_mode"] == AutoresetMode[mode]
    same(named(envs, envs.reset(seed=seed)), reference.reset(seed=seed), "reset")
    rng, states = np.random.default_rng(seed), envs.single_action_space.n
    finished = np.zeros(3, dtype=bool)
    for step in range(steps):
        mask = finished if mode == "DISABLED" else np.zeros(3, dtype=bool)
        mask |= [False, step == 1, False]  # from here on the episodes end at different steps
        if mask.any():
            options = {"reset_mask": mask, "state": 1}
            mine, theirs = (e.reset(options=dict(options)) for e in (envs, reference))
            same(named(envs, mine), theirs, "again")
        actions = rng.integers(states, size=3)
        mine, theirs = envs.step(actions), reference.step(actions)
        same(named(envs, mine), theirs, f"step {step}")
        finished = mine[2] | mine[3]
