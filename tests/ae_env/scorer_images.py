"""Pictures and captures that the tests of the scorers share."""

import numpy as np
import torch

from ae_env.grid import ExposureGrid
from ae_env.scenes import Scene, reference_settings
from ae_env.scorers.captures import SceneCaptures
from simulator import get_camera, incident_ev100

CAMERA = get_camera("nikon_z6")
GRID = ExposureGrid.default()


def random_pictures(count: int = 5, height: int = 23, width: int = 17, seed: int = 0):
    """(B, C, H, W) in [0, 1], C = 4: noise over a smooth slope, each at a brightness of its own."""
    rng = np.random.default_rng(seed)
    slope = np.linspace(0.1, 0.9, width) * np.linspace(0.5, 1.0, height)[:, None]
    frames = slope * np.geomspace(0.3, 1.5, count)[:, None, None, None]
    frames = frames + 0.08 * rng.normal(size=(count, 4, height, width))
    return torch.from_numpy(frames.clip(0.0, 1.0).astype(np.float32))


def make_scene(light, illuminance=1000.0, **fields):
    """`light` (4, H, W) as the incident-light exposure records it."""
    return Scene.from_array(
        torch.from_numpy(light.astype(np.float32)),
        reference_settings(incident_ev100(illuminance or 1000.0)),
        CAMERA,
        illuminance=illuminance,
        **{"scene_id": "test", **fields},
    )


def random_scene(**fields):
    light = 0.12 * np.exp(np.random.default_rng(0).normal(0.0, 1.2, (4, 40, 40)))
    return make_scene(light, **fields)


def make_captures(scenes, states, speed=0.0, defocus=0.0, gain=1.0, row_gain=None):
    """One capture of each state, all of one scene or each of its own."""
    ones = np.ones(len(states))
    scenes = [scenes] * len(states) if isinstance(scenes, Scene) else scenes
    blur = {"speed": speed * ones, "defocus": defocus * ones}
    return SceneCaptures(CAMERA, states).of(scenes, **blur, gain=gain * ones, row_gain=row_gain)


def captures_of(light, states):
    """Captures of `light` (4, H, W), which is what ISO 100, f/4, 1/64 s records."""
    return make_captures(make_scene(light, 2560.0), states)


def mean_signal(images, captures):
    return images.mean(dim=(1, 2, 3))


class Own:
    """A scorer that is a function of its images and captures."""

    def __init__(self, function=mean_signal, domain="raw", depends_on="image") -> None:
        self.function, self.domain, self.depends_on = function, domain, depends_on

    def __call__(self, images, captures):
        return self.function(images, captures)
