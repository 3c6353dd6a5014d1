"""Work against precision: milliseconds per state beside the error of every method.

Every scene is photographed twice; each pair of a scene and a photograph is a round in which all
methods take their turn, in another order each time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from benchmarks.simulator.models import Models
from benchmarks.simulator.scenes import Progress
from benchmarks.work_precision.measures import (
    MeanError,
    capture_square,
    noise_ratios,
    pareto_front,
    quartiles,
    timed,
)
from benchmarks.work_precision.methods import Method, Prepared, all_methods
from benchmarks.work_precision.trials import GRID, SIZES, Size, Trial, trials
from simulator import CameraSettings, RawImage

#: Scenes and, of each, states at which all methods are compared; None for all scenes.
COUNTS: dict[Size, tuple[int | None, int]] = {
    (64, 64): (None, 4),
    (128, 128): (None, 4),
    (256, 256): (None, 3),
    (512, 768): (None, 2),
}
QUICK_COUNTS: dict[Size, tuple[int | None, int]] = {
    (64, 64): (3, 2),
    (128, 128): (3, 2),
    (256, 256): (1, 1),
    (512, 768): (1, 1),
}
#: How long a round takes, by size, for the progress bar only.
_WEIGHTS = {(64, 64): 1.0, (128, 128): 4.0, (256, 256): 16.0, (512, 768): 96.0}
#: Name of the rows of the reference camera itself: what its own noise measures as.
REFERENCE = "reference camera"


def measure(
    models: Models, *, seed: int, quick: bool, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """One row per size and method.

    Args:
        models: What is measured.
        seed: Of all noise.
        quick: Few scenes and states.
        progress: Called with the size and the share that is done.
    """
    every = all_methods(models)
    counts = QUICK_COUNTS if quick else COUNTS
    rounds = {size: len(trials(size, counts[size][0])) for size in SIZES}
    total = sum(_WEIGHTS[size] * (n + 1) for size, n in rounds.items())
    done, rows = 0.0, []
    for size in SIZES:
        number, states = counts[size]
        chosen = trials(size, number)
        name = f"{size[0]} x {size[1]}"
        methods = [m for m in every if m.dtype == "float32"] if quick and size[0] > 128 else every
        if progress is not None:
            progress(f"{name}, warming up", done / total)
        if not quick or size[0] <= 128:
            _warm_up(methods, chosen[0], seed)
        done += _WEIGHTS[size]
        records = _Records(methods)
        for index, trial in enumerate(chosen):
            if progress is not None:
                progress(f"{name}, {trial.scene.scene_id}", done / total)
            _one_trial(records, methods, trial, trial.states(states), seed + 1000 * index, index)
            done += _WEIGHTS[size]
        rows += records.rows(size, len(chosen), states)
    return rows


class _Records:
    """Times and errors by method."""

    def __init__(self, methods: Sequence[Method]) -> None:
        self.methods = {m.key: m for m in methods}
        self.milliseconds: dict[tuple[str, str], list[float]] = {k: [] for k in self.methods}
        self.errors: dict[tuple[str, str], list[MeanError]] = {k: [] for k in self.methods}
        own = [*self.methods, (REFERENCE, "")]
        self.noise: dict[tuple[str, str], list[float]] = {k: [] for k in own}
        self.squares: dict[tuple[str, str], list[float]] = {k: [] for k in own}

    def rows(self, size: Size, scenes: int, states: int) -> list[dict[str, Any]]:
        """One row per method, and one of the reference camera's own noise."""
        rows = [self._row(method, size, scenes, states) for method in self.methods.values()]
        points = [(row["ms_per_state"], row["psnr_db"]) for row in rows]
        for row, best in zip(rows, pareto_front(points), strict=True):
            row["pareto"] = best
        own = self.noise[REFERENCE, ""]
        floors = {
            "noise_variance_floor": float(np.median(own)) if own else None,
            "capture_error_floor": _root_median(self.squares[REFERENCE, ""]),
        }
        return [row | floors for row in rows]

    def _row(self, method: Method, size: Size, scenes: int, states: int) -> dict[str, Any]:
        key = method.key
        middle, low, high = quartiles(self.milliseconds[key])
        levels = [error.psnr_db for error in self.errors[key]]
        noise = self.noise[key]
        return {
            "part": "precision",
            "method": method.name,
            "height": size[0],
            "width": size[1],
            "dtype": method.dtype,
            "tolerance": method.tolerance,
            "mode": method.mode,
            "ms_per_state": middle,
            "ms_per_state_25_percent": low,
            "ms_per_state_75_percent": high,
            "ms_per_sweep": len(GRID) * middle,
            "sweep_timed_whole": method.mode == "shared",
            "timings": len(self.milliseconds[key]),
            "psnr_db": float(np.mean(levels)),
            "psnr_db_10_percent": float(np.quantile(levels, 0.1)),
            "psnr_db_90_percent": float(np.quantile(levels, 0.9)),
            "relative_rmse": float(np.mean([e.relative_rmse for e in self.errors[key]])),
            "noise_variance_error": float(np.median(noise)) if noise else None,
            "noise_variance_error_mean": float(np.mean(noise)) if noise else None,
            "capture_error": _root_median(self.squares[key]),
            "capture_error_90_percent": _root(float(np.quantile(self.squares[key], 0.9))),
            "scenes": scenes,
            "states_per_scene": states,
        }


def _root_median(squares: Sequence[float]) -> float:
    return _root(float(np.median(squares)))


def _root(square: float) -> float:
    return max(0.0, square) ** 0.5


def _one_trial(
    records: _Records,
    methods: Sequence[Method],
    trial: Trial,
    states: Sequence[CameraSettings],
    seed: int,
    turn: int,
) -> None:
    means = {s: trial.mean(s) for s in states}
    camera = trial.camera.camera
    captures: dict[tuple[str, str], list[list[Tensor]]] = {m.key: [] for m in methods}
    for photograph in range(2):
        raw = trial.raw(seed + photograph)
        first = (2 * turn + photograph) * 5 % len(methods)
        for method in (*methods[first:], *methods[:first]):
            own = list(_captured(method, raw, states, seed + photograph, records))
            captures[method.key].append([capture for capture, _ in own])
            records.errors[method.key] += [
                MeanError.of(expected, means[s], camera)
                for (_, expected), s in zip(own, states, strict=True)
            ]
    pairs = {key: list(zip(*own, strict=True)) for key, own in captures.items()}
    pairs[REFERENCE, ""] = [
        (trial.sample(s, seed + 500), trial.sample(s, seed + 501)) for s in states
    ]
    for key, own_pairs in pairs.items():
        for pair, s in zip(own_pairs, states, strict=True):
            nlf = camera.nlf(s.iso)
            ratios = noise_ratios(pair, means[s], nlf, camera)
            records.squares[key].append(capture_square(pair, means[s], nlf, ratios))
            if ratios:
                records.noise[key].append(float(np.abs(np.array(ratios) - 1.0).mean()))


def _captured(
    method: Method, raw: RawImage, states: Sequence[CameraSettings], seed: int, records: _Records
) -> Iterator[tuple[Tensor, Tensor]]:
    """Captures at `states` and what they are without noise; the time goes to `records`."""
    times = records.milliseconds[method.key]
    if method.prepare is not None:
        (prepared, frames), milliseconds = timed(_swept, method, raw, seed)
        times.append(milliseconds / len(GRID))
        for s in states:
            yield frames[GRID.states.index(s)], prepared.expected(s)
        return
    assert method.shoot is not None
    for s in states:
        shot, milliseconds = timed(method.shoot, raw, s, seed)
        times.append(milliseconds)
        yield shot.capture, shot.expected()


def _swept(method: Method, raw: RawImage, seed: int) -> tuple[Prepared, Tensor]:
    assert method.prepare is not None
    prepared = method.prepare(raw)
    return prepared, prepared.expose(GRID, seed=seed)


def _warm_up(methods: Sequence[Method], trial: Trial, seed: int) -> None:
    raw, states = trial.raw(seed), trial.states(1)
    for method in methods:
        for _ in _captured(method, raw, states, seed, _Records([method])):
            pass
