"""A sweep: one preparation and 64 exposures against 64 full runs, on the same scenes in one run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.simulator.models import Models
from benchmarks.simulator.scenes import Progress
from benchmarks.work_precision.measures import MeanError, quartiles, timed
from benchmarks.work_precision.methods import (
    DEFAULT,
    Method,
    full,
    planned,
    simulator,
)
from benchmarks.work_precision.trials import GRID, Size, Trial, trials
from simulator import CameraSettings, RawImage

#: Scenes by size, and how often a shared sweep of each is timed.
SCENES: dict[Size, int] = {(128, 128): 4, (512, 768): 1}
REPEATS: dict[Size, int] = {(128, 128): 5, (512, 768): 3}
#: States of a full run by size in a quick run, out of which the 64 are extrapolated.
QUICK_STATES: dict[Size, int] = {(128, 128): 6, (512, 768): 1}
#: Which of the trials, by size: those with both defocus and noise come first.
_ORDER: dict[Size, tuple[int, ...]] = {(128, 128): (4, 0, 1, 2), (512, 768): (2,)}
#: Least factor that a sweep is to be faster by, and by how much its PSNR may be lower [dB].
TARGETS = {"paper full": (200.0, 0.3), "compact full": (20.0, 0.1)}


def measure(
    models: Models, *, seed: int, quick: bool, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """One row per size, scene and method.

    Args:
        models: What is measured.
        seed: Of all noise.
        quick: A few states of the full runs, of one scene.
        progress: Called with the method and the share that is done.
    """
    methods = list(_methods(models))
    jobs = [(size, t) for size in SCENES for t in _trials(size, 1 if quick else SCENES[size])]
    rows = []
    for number, (size, trial) in enumerate(jobs):
        raw = trial.raw(seed)
        states = trial.states(QUICK_STATES[size]) if quick else GRID.states
        times: dict[str, list[float]] = {m.name: [] for m in methods}
        errors: dict[str, list[MeanError]] = {}
        shared = [m for m in methods if m.prepare is not None]
        _warm_up(methods, raw)
        # Full runs hold one capture at a time, in memory that they use again; so do sweeps.
        frames = torch.zeros(len(GRID), *raw.data.shape)
        for method in methods:
            if progress is not None:
                share = methods.index(method) / len(methods)
                what = f"{size[0]} x {size[1]}, {trial.scene.scene_id}, {method.name}"
                progress(what, (number + share) / len(jobs))
            if method.shoot is not None:
                errors[method.name] = list(
                    _full_sweep(method, trial, raw, states, seed, times[method.name])
                )
                # In between, so that both kinds see the machine in the same mood.
                _time_shared(shared, raw, seed, frames, times)
        for _ in range(1 if quick else REPEATS[size]):
            _time_shared(shared, raw, seed, frames, times)
        for method in shared:
            assert method.prepare is not None
            prepared = method.prepare(raw)
            errors[method.name] = [
                MeanError.of(prepared.expected(s), trial.mean(s), trial.camera.camera)
                for s in states
            ]
        rows += [
            _row(method, trial, states, times[method.name], errors[method.name])
            for method in methods
        ]
    return rows


def _methods(models: Models) -> Iterator[Method]:
    compact = simulator(models, "compact")
    for tolerance in (0.0, DEFAULT):
        yield planned(compact, tolerance)
        yield planned(compact, tolerance, bank=True)
    yield full("compact", compact)
    if models.paper is not None:
        yield full("paper", simulator(models, "paper"))


def _trials(size: Size, number: int) -> Sequence[Trial]:
    known = trials(size)
    return [known[i] for i in _ORDER[size][:number] if i < len(known)]


def _full_sweep(
    method: Method,
    trial: Trial,
    raw: RawImage,
    states: Sequence[CameraSettings],
    seed: int,
    times: list[float],
) -> Iterator[MeanError]:
    """Errors at `states`; the time of each goes to `times` as that of a sweep of them."""
    assert method.shoot is not None
    for s in states:
        shot, milliseconds = timed(method.shoot, raw, s, seed)
        times.append(milliseconds)
        yield MeanError.of(shot.expected(), trial.mean(s), trial.camera.camera)


def _time_shared(
    methods: Sequence[Method],
    raw: RawImage,
    seed: int,
    frames: Tensor,
    times: dict[str, list[float]],
) -> None:
    for method in methods:
        _, milliseconds = timed(_swept, method, raw, seed, frames)
        times[method.name].append(milliseconds)


def _swept(method: Method, raw: RawImage, seed: int, frames: Tensor) -> Tensor:
    assert method.prepare is not None
    return method.prepare(raw).expose(GRID, seed=seed, out=frames)


def _warm_up(methods: Sequence[Method], raw: RawImage) -> None:
    for method in methods:
        if method.prepare is not None:
            method.prepare(raw).expose([GRID[0]])
        elif method.shoot is not None:
            method.shoot(raw, GRID[0], 0)


def _row(
    method: Method,
    trial: Trial,
    states: Sequence[CameraSettings],
    times: list[float],
    errors: list[MeanError],
) -> dict[str, Any]:
    fair = set(trial.states())
    inside = [e.psnr_db for e, s in zip(errors, states, strict=True) if s in fair]
    whole = method.mode == "transition" and len(states) == len(GRID)
    middle, low, high = quartiles(times)
    per_state = middle / len(GRID) if method.mode == "shared" else float(np.mean(times))
    return {
        "part": "sweep",
        "method": method.name,
        "height": trial.size[0],
        "width": trial.size[1],
        "dtype": method.dtype,
        "tolerance": method.tolerance,
        "mode": method.mode,
        "scene": trial.scene.scene_id,
        "source_iso": trial.source.iso,
        "ms_per_state": per_state,
        "ms_per_sweep": per_state * len(GRID),
        "ms_25_percent": low,
        "ms_75_percent": high,
        "timings": len(times),
        "sweep_timed_whole": whole or method.mode == "shared",
        "psnr_db": float(np.mean([e.psnr_db for e in errors])),
        "psnr_db_fair": float(np.mean(inside)) if inside else None,
        "relative_rmse": float(np.mean([e.relative_rmse for e in errors])),
        "states": len(states),
    }
