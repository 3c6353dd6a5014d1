"""Work against precision: milliseconds per state beside the error of every method.

Every scene is photographed twice; each pair of a scene and a photograph is a round in which all
methods take their turn, in another order each time.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.harness import Row, clipped, psnr, quartiles
from benchmarks.isolated import timed
from benchmarks.work_precision.methods import Method, all_methods
from benchmarks.work_precision.trials import GRID, Trial, trials
from simulator import CameraProfile, CameraSettings, NoiseLevelFunction, RawImage
from simulator.noise.noise_level_function import noise_variance

#: States of each scene at which all methods are compared, by height; quick: scenes and states.
STATES, QUICK = {128: 4, 512: 2}, {128: (2, 2), 512: (1, 1)}
#: Name of what the reference camera's own captures measure as.
REFERENCE = "reference camera"
#: Pixels whose mean is this many deviations from either clip show all of their noise.
_CLEAR = 4.0
#: Levels of the signal, each with as many pixels, and the fewest pixels of one.
_LEVELS, _FEWEST = 8, 200
#: PSNRs that differ by less are the same [dB].
_SAME_DB = 0.01


def measure(size: Sequence[int], seed: int, quick: bool) -> list[Row]:
    height, width = size
    chosen, count = trials((height, width)), STATES[height]
    methods = all_methods()
    if quick:
        scenes, count = QUICK[height]
        chosen, methods = chosen[:scenes], methods[: None if height < 512 else 9]
    records: dict[str, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    small = trials((128, 128))[0]
    for method in methods:  # warm-up
        _captured(method, small.raw(seed), small.states(1), seed)
    for index, trial in enumerate(chosen):
        _one_trial(records, methods, trial, trial.states(count), seed + 1000 * index, index)
    floor = _median(records.pop(REFERENCE)["noise"])
    rows: list[Row] = []
    for method in methods:
        own = records[method.key]
        low, middle, high = quartiles(own["ms"])
        row: Row = {"part": "precision", "method": method.name, "height": height, "width": width}
        row |= {"dtype": method.dtype, "tolerance": method.tolerance, "mode": method.mode}
        row |= {"ms_per_state": middle, "ms_spread": (high - low) / 2}
        row |= {"ms_per_sweep": len(GRID) * middle, "psnr_db": float(np.mean(own["psnr"]))}
        for percent in (10, 90):
            row[f"psnr_db_{percent}_percent"] = float(np.quantile(own["psnr"], percent / 100))
        row |= {"relative_rmse": float(np.mean(own["rmse"]))}
        row |= {"noise_variance_error": _median(own["noise"]), "noise_variance_floor": floor}
        rows.append(row | {"scenes": len(chosen), "states_per_scene": count})
    points = [(row["ms_per_state"], row["psnr_db"]) for row in rows]
    for row, best in zip(rows, pareto_front(points), strict=True):
        row["pareto"] = best
    return rows


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if len(values) else None


def _one_trial(
    records: dict[str, dict[str, list[Any]]],
    methods: Sequence[Method],
    trial: Trial,
    states: Sequence[CameraSettings],
    seed: int,
    turn: int,
) -> None:
    means, camera = {s: trial.mean(s) for s in states}, trial.camera.camera
    captures: dict[str, list[list[Tensor]]] = {m.key: [] for m in methods}
    for photograph in range(2):
        raw = trial.raw(seed + photograph)
        first = (2 * turn + photograph) * 5 % len(methods)
        for method in (*methods[first:], *methods[:first]):
            frames, expected, times = _captured(method, raw, states, seed + photograph)
            captures[method.key].append(frames)
            records[method.key]["ms"] += times
            for image, s in zip(expected, states, strict=True):
                for name, value in mean_error(image, means[s], camera).items():
                    records[method.key][name].append(value)
    captures[REFERENCE] = [[trial.sample(s, seed + 500 + i) for s in states] for i in range(2)]
    for key, (one, other) in captures.items():
        for pair, s in zip(zip(one, other, strict=True), states, strict=True):
            ratios = noise_ratios(pair, means[s], camera.nlf(s.iso), camera)
            if ratios:
                records[key]["noise"].append(float(np.abs(np.array(ratios) - 1.0).mean()))


def _captured(
    method: Method, raw: RawImage, states: Sequence[CameraSettings], seed: int
) -> tuple[list[Tensor], list[Tensor], list[float]]:
    """Captures at `states`, the same without noise, and times per state [ms]."""
    found: list[Any] = []
    if method.prepare is not None:
        prepare = method.prepare

        def whole_sweep() -> None:
            found.append(prepare(raw))
            found.append(found[0].expose(GRID, seed=seed))

        times = [1e3 * timed(whole_sweep) / len(GRID)]
        prepared, frames = found
        images = [frames[GRID.states.index(s)] for s in states]
        return images, [prepared.expected(s) for s in states], times
    shoot = method.shoot
    assert shoot is not None
    times = [1e3 * timed(lambda s=s: found.append(shoot(raw, s, seed))) for s in states]  # type: ignore[misc]
    return [capture for capture, _ in found], [light for _, light in found], times


# -- measures -------------------------------------------------------------------------------------


def mean_error(expected: Tensor, mean: Tensor, camera: CameraProfile) -> dict[str, float]:
    """``psnr`` [dB] against white and ``rmse`` over the RMS signal, of an expected value."""
    image, truth = clipped(expected, camera).double(), mean.double()
    rmse = (image - truth).square().mean().sqrt()
    scale = truth.square().mean().sqrt().clamp(min=1e-12)
    return {"psnr": psnr(image, truth), "rmse": float(rmse / scale)}


def noise_ratios(
    captures: tuple[Tensor, Tensor], mean: Tensor, nlf: NoiseLevelFunction, camera: CameraProfile
) -> list[float]:
    """Variance of the noise over the noise level function's, at every level with enough pixels.

    Of pixels that are clear of both clips.
    """
    wanted = noise_variance(mean, nlf)
    margin = _CLEAR * wanted.sqrt()
    black = torch.tensor(camera.pedestal).to(mean)[:, None, None]
    clear = (mean + margin < 1.0) & (mean - margin > -black)
    first, second = captures
    found = 0.5 * (first - second).double().square()[clear]
    wanted = wanted[clear].double()
    levels = wanted.argsort().tensor_split(_LEVELS)
    return [float(found[at].mean() / wanted[at].mean()) for at in levels if len(at) >= _FEWEST]


def pareto_front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Which of (milliseconds, PSNR [dB]) no other beats in both.

    One that is faster and, to a hundredth of a decibel, as good beats another.

    >>> pareto_front([(1.0, 30.0), (2.0, 35.0), (3.0, 34.0), (4.0, 35.004)])
    [True, True, False, False]
    """

    def beaten(own: int) -> bool:
        ms, db = points[own]
        return any(
            other != own and a <= ms and b >= db - _SAME_DB and (a < ms or b > db or other < own)
            for other, (a, b) in enumerate(points)
        )

    return [not beaten(i) for i in range(len(points))]
