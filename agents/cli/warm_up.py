"""``ae-env warm-up``: what a first run would wait for, done beforehand."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path
from typing import Any

from agents.cli.console import console, progress_bars

#: Environments whose first frames need the compiled code of all environments between them.
_CASES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("AutoExposure-v0", {}),
    ("AutoExposure-v0", {"observation": "statistics"}),
    ("AutoExposure-v0", {"observation": "linear", "lighting": "flicker"}),
    ("AutoExposure-v0", {"observation": "dn", "noise": "exact"}),
    ("AutoExposure-v0", {"noise": "sensor", "camera": "canon_5d4", "scenes": "bundled:small"}),
    ("AutoExposure-v0", {"split": "test", "source": "raw"}),
    ("AutoExposureVideo-v0", {}),
    ("ExposureBracket-v0", {}),
)


def warm_up() -> None:
    """Compile the simulator and draw the bundled scenes, as a container's build would.

    Both are kept: the code beside the sources or in NUMBA_CACHE_DIR, the scenes in AE_ENV_CACHE.
    So that all processors of a cluster have code, run it on one of each model.

    Example: `ae-env warm-up`
    """
    logging.getLogger("simulator.utils.jit").setLevel(logging.ERROR)  # it proposes this command
    with progress_bars() as progress, progress("warming up") as task:
        for done, (name, arguments) in enumerate(_CASES):
            task(done, len(_CASES) + 1, ", ".join([name, *map(str, arguments.values())]))
            _play(name, arguments)
        task(len(_CASES), len(_CASES) + 1, "raw files and the viewer")
        _use_rest()
        task(len(_CASES) + 1, len(_CASES) + 1)
    console.print("try next: ae-env quickstart")


def _play(name: str, arguments: dict[str, Any]) -> None:
    """Draws the scenes of an environment and plays some steps."""
    import gymnasium as gym
    import numpy as np

    envs = gym.make_vec(f"ae_env:ae_env/{name}", num_envs=16, **arguments)
    list(envs.unwrapped.scenes)  # type: ignore[attr-defined]  # draws every one
    envs.reset(seed=0)
    for _ in range(4):
        envs.step(np.arange(16))
    envs.close()


def _use_rest() -> None:
    """Does what those environments do not: raw files, the viewer, blur along rows, painting."""
    import numpy as np
    import torch

    from agents.cli.show import DEFAULT_SCENES
    from agents.viewer.library import find_scenes
    from agents.viewer.viewed_scene import View, ViewedScene
    from simulator import CameraSimulator, RawImage, estimate_nlf, read_raw
    from simulator.optics.blur import disc_blur, motion_blur
    from simulator.optics.blur_kernels import Blur, blur_many
    from simulator.radiance.procedural import draw

    library = find_scenes(DEFAULT_SCENES)
    viewed = ViewedScene(library.open(library.first), CameraSimulator(device="cpu"))
    view = View(viewed.best(), speed=5.0, defocus=4.0)
    viewed.readout(view, viewed.picture(view).capture)
    with tempfile.TemporaryDirectory() as folder:
        raw = read_raw(viewed.write_dng(Path(folder, "any.dng"), view))
    estimate_nlf(raw.data)
    numbers = raw.to_mosaic().astype(np.float64)  # files hold integers
    light = RawImage.from_mosaic(numbers, raw.settings, raw.camera).data
    disc_blur(motion_blur(light, 2.5), 2.5)
    blur_many([Blur(light, extent_px=2.5, moved=torch.empty_like(light))])
    draw("dead_leaves", np.random.default_rng(0))  # the scenes may all have been in the cache
