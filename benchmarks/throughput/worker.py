"""One side of a comparison of two checkouts: times what it is asked to, one case after another.

A script that imports nothing of this package: the checkout that it measures is the one that
``PYTHONPATH`` names, and an older one has other modules. It uses the public API alone. Requests
come as lines of JSON on standard input, answers go as lines of JSON to standard output.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

import ae_env
import simulator
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera

ID = "ae_env/AutoExposure-v0"
#: Neither motion nor defocus: every frame is exposed from the scene's own light.
CACHED: dict[str, Any] = {"motion": "none", "depth": "far"}
#: Steps of an episode; cases run whole episodes, so that resets have their share.
_EPISODE = 8
_SINE = {"lighting": "sine"}
#: Name -> number of environments and arguments of the environment.
STEPS: dict[str, tuple[int, dict[str, Any]]] = {
    "steps, cached scene": (64, CACHED),
    "steps, motion and defocus": (64, {}),
    "steps, cached scene, sine lighting": (64, CACHED | _SINE),
    "steps, motion and defocus, sine lighting": (64, _SINE),
    "steps, cached scene, exact noise": (64, {"noise": "exact"} | CACHED),
    "steps, cached scene, linear observation": (64, {"observation": "linear"} | CACHED),
    "steps, motion and defocus, flicker": (64, {"lighting": "flicker"}),
    "steps, one environment, cached scene": (1, CACHED),
    "steps, one environment, motion and defocus": (1, {}),
}
#: Name -> kind of noise of the 64 states of the default grid, of a raw of 128 x 128 packed pixels.
SWEEPS = {f"sweep, 128 x 128, {noise} noise": noise for noise in ("exact", "bank")}
#: What is timed, environment steps or sweeps of one call, and frames that checkouts must agree on.
Case = tuple[Callable[[], Any], int, np.ndarray]


def warm_environments(num_envs: int, make: dict[str, Any], seed: int = 0) -> Any:
    """One environment, or a batch of them, after all that is computed once for a scene."""
    many = num_envs > 1
    envs: Any = gym.make_vec(ID, num_envs=num_envs, **make) if many else gym.make(ID, **make)
    scenes = len(envs.unwrapped.scenes)
    for first in range(0, scenes, num_envs):
        chosen = [(first + i) % scenes for i in range(num_envs)]
        envs.reset(seed=seed, options={"scene": chosen if many else first})
    return envs


def _steps(num_envs: int, options: dict[str, Any]) -> Case:
    """Steps of `num_envs` environments of 64 x 64 with random actions."""
    many = num_envs > 1
    make = {"scenes": "bundled:small", "resolution": 64} | options
    envs = warm_environments(num_envs, make | ({"autoreset_mode": "SAME_STEP"} if many else {}))
    frames, rng = [envs.reset(seed=1)[0]["raw"]], np.random.default_rng(0)
    for action in (0, 21, 42, 63):
        frames.append(envs.step(np.full(num_envs, action) if many else action)[0]["raw"])
    envs.reset(seed=2)

    def episode() -> None:
        if not many:
            envs.reset()
        for _ in range(_EPISODE):
            envs.step(rng.integers(64, size=num_envs if many else None))

    return episode, _EPISODE * num_envs, np.stack(frames)


def _sweep(noise: Any) -> Case:
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 4, 9, 9, generator=generator)
    light = torch.nn.functional.interpolate(coarse, (128, 128), mode="bilinear")[0] * 0.3
    camera, settings = get_camera("nikon_z6"), CameraSettings(400, 1 / 64, 8.0)
    nlf = camera.nlf(settings.iso)
    shot, read = (torch.tensor(values).view(4, 1, 1) for values in (nlf.shot, nlf.read))
    normals = torch.randn(light.shape, generator=generator)
    data = (light + (light * shot + read).sqrt() * normals).clamp(-0.05, 1.0)
    prepared = CameraSimulator(device="cpu").prepare(RawImage(data, settings, camera))
    call = partial(prepared.expose, list(ae_env.ExposureGrid.default()), noise=noise)
    return call, 1, call().numpy()


def _timed(call: Callable[[], Any], frames: int, seconds: float) -> dict[str, float]:
    """Time per frame [s], over `seconds` or a little more."""
    begin, calls = time.perf_counter(), 0
    while (elapsed := time.perf_counter() - begin) < seconds or not calls:
        call()
        calls += 1
    return {"seconds": elapsed / (frames * calls)}


def _answers(folder: Path) -> Iterator[dict[str, Any]]:
    """An answer to every request: which packages run, or how long a case takes."""
    cases: dict[str, Case] = {}
    yield {"simulator": simulator.__file__, "ae_env": ae_env.__file__}
    for line in sys.stdin:
        request = json.loads(line)
        name = request["case"]
        if name not in cases:
            cases[name] = _steps(*STEPS[name]) if name in STEPS else _sweep(SWEEPS[name])
            np.save(folder / "first.npy", cases[name][2])
        yield _timed(*cases[name][:2], request["seconds"])


if __name__ == "__main__":
    torch.set_num_threads(int(sys.argv[1]))
    answers = sys.stdout
    with contextlib.redirect_stdout(sys.stderr):  # nothing else may come between the answers
        for answer in _answers(Path(sys.argv[2])):
            print(json.dumps(answer), file=answers, flush=True)
