"""A camera, a grid and synthetic frames for the policies' tests."""

import functools

import gymnasium as gym
import matplotlib
import numpy as np
import pytest
import torch

from ae_env.grid import ExposureGrid
from ae_env.observation import encode_observation, encode_sensors, encode_settings
from agents.policy import PolicyContext
from simulator.camera import get_camera
from tests.ae_env.environments import make_envs

SIZE = 64


@pytest.fixture(scope="session")
def context() -> PolicyContext:
    raw = gym.spaces.Box(0, 255, (4, SIZE, SIZE), np.uint8)
    settings, sensors = (gym.spaces.Box(-1, 1, (size,), np.float32) for size in (3, 2))
    space = gym.spaces.Dict({"raw": raw, "settings": settings, "sensors": sensors})
    return PolicyContext(ExposureGrid.default(), get_camera("nikon_z6"), space)


@pytest.fixture(scope="session")
def photograph(context):
    """Frames of scenes (light relative to a grey card at its own EV) taken at grid states."""

    def take(light, scene_ev, states, speed=0.0, defocus=0.1):
        states = np.atleast_1d(states)
        # Independent of the code under test: x = 0.12 * light * 2^(scene EV - state EV).
        gain = 2.0 ** (scene_ev - context.grid.ev100[states])
        signal = 0.12 * gain[:, None, None, None] * np.broadcast_to(light, (4, SIZE, SIZE))
        settings = [context.grid[int(i)] for i in states]
        apex = [(s.aperture_value, s.time_value, s.speed_value) for s in settings]
        sensors = np.full((2, len(states)), [[speed], [defocus]])
        return {
            "raw": encode_observation(torch.from_numpy(signal.astype(np.float32))).numpy(),
            "settings": encode_settings(np.array(apex)),
            "sensors": encode_sensors(*sensors, np.zeros((len(states), 2))),
        }

    return take


@pytest.fixture(autouse=True, scope="session")
def coarse_plots() -> None:
    """Plots of reports have few pixels: what is drawn is the same."""
    matplotlib.rcParams["figure.dpi"] = 40


@pytest.fixture(scope="session")
def make_tiny_envs():
    return functools.partial(make_envs, num_envs=4, autoreset_mode="SAME_STEP")
