"""What a second process compiles for the first environment, while that is made.

Run as a program, it runs episodes that need the kernels of `KERNELS`.
"""

from __future__ import annotations

import torch

from simulator.capture.sensor import _record
from simulator.utils import second_process
from simulator.utils.jit import is_cached

#: Kernels of a default environment that the second process compiles, about half of the work: those
#: of the capture, which come last in the first frame, then those of motion.
KERNELS = (
    *(f"simulator.noise.generator.{name}" for name in ("_fold", "_singles")),
    *("simulator.capture.sensor._record", "ae_env.scorers.code_kernels.measure_codes"),
    "ae_env.observation._read_sensors",
    *(f"simulator.optics.motion_path.{name}" for name in ("_length", "_lengths", "_rasterised")),
    *(f"simulator.optics.motion_path.{name}" for name in ("_blur_apart", "_blur_rows")),
)
#: Episodes that move in all ways: the shake alone, the subject alone, and both.
_EPISODES = 12


def compile_beside() -> None:
    """Lets a second process compile `KERNELS`, unless they have been before."""
    if not is_cached(_record):
        second_process.compile_beside(__name__, KERNELS)


def _run() -> None:
    from ae_env.env import AutoExposureEnv
    from ae_env.scenes import Scene
    from simulator.camera import get_camera
    from simulator.capture.layout import Layout
    from simulator.settings import CameraSettings

    second_process.begin()
    torch.set_num_threads(1)
    size = 36
    subject = torch.zeros(size, size, dtype=torch.bool)
    subject[:, size // 2 :] = True
    scene = Scene.from_array(
        torch.rand(4, size, size, generator=torch.Generator().manual_seed(0)),
        CameraSettings(100, 1 / 125, 4.0),
        get_camera("nikon_z6"),
        scene_id="any",
        layout=Layout(torch.zeros(size, size), subject),
    )
    still = AutoExposureEnv(scenes=[scene], resolution=size, motion="none", depth="far")
    still.reset(seed=0)
    moving = AutoExposureEnv(scenes=[scene], resolution=size, depth="far")
    longest = len(moving.grid) - 1
    for seed in range(_EPISODES):
        moving.reset(seed=seed, options={"state": longest})


if __name__ == "__main__":
    _run()
