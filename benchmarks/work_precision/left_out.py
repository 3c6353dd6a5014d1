"""Which modules a scene needs: the share of the 64 states that run each, by kind of scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.simulator.models import Models
from benchmarks.simulator.scenes import Progress, data_root
from benchmarks.work_precision.measures import quartiles, timed
from benchmarks.work_precision.methods import DEFAULT, simulator
from benchmarks.work_precision.trials import GRID, Trial, source_settings, test_trials
from simulator import CameraSimulator, NoiseLevelFunction, RawImage, read_raw
from simulator.capture.prepared_scene import PreparedScene
from simulator.reference.reference_camera import DRAPED

#: Height and width of every scene, how many there are of a kind, and runs of each sweep.
SIZE, SCENES, REPEATS = 128, 3, 5
#: States of a full run that are timed of each scene, evenly spread.
FULL_STATES = 8
#: Ends of real raws' names.
_RAW_SUFFIXES = (".dng", ".crw", ".cr2", ".nef", ".arw")
#: Highest ISO of a raw that counts as clean.
_CLEAN_ISO = 200.0
#: Blur of the close-up that is known to the simulator, at f/4 [pixel], and speed of what moves
#: [frame heights per second].
_DISC, _SPEED = 4.0, 0.125
#: Circle of confusion of the source in what counts as a close-up [pixel].
_BLURRED = 2.5


@dataclass(frozen=True, eq=False)
class Example:
    """One scene of a kind: the source, and what the simulator is told about it."""

    source: RawImage | PreparedScene
    told: dict[str, Any] = field(default_factory=dict)


def measure(
    models: Models, *, seed: int, quick: bool, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """One row per kind of scene.

    Args:
        models: Of which ``compact`` is measured.
        seed: Of all noise.
        quick: One scene of each kind, timed once.
        progress: Called with the kind and the share that is done.
    """
    own = simulator(models, "compact")
    rows = []
    for number, (kind, make) in enumerate(KINDS.items()):
        if progress is not None:
            progress(kind, number / len(KINDS))
        examples = list(make(seed))[: 1 if quick else SCENES]
        rows.append(_row(own, kind, examples, 1 if quick else REPEATS))
    return rows


def _row(own: CameraSimulator, kind: str, examples: list[Example], repeats: int) -> dict[str, Any]:
    names: dict[str, int] = {}
    predicted, times, every = [], [], []
    for example in examples:
        prepared = own.prepare(example.source, tolerance=DEFAULT, **example.told)
        for settings in GRID:
            plan = prepared.plan(settings)
            for step in plan.steps:
                names[step.name] = names.get(step.name, 0) + int(step.runs)
            predicted.append(float(plan.predicted_difference))
        some = [GRID[(i * len(GRID) // FULL_STATES + i) % len(GRID)] for i in range(FULL_STATES)]
        for _ in range(repeats):
            _, milliseconds = timed(_sweep, own, example)
            times.append(milliseconds)
            _, milliseconds = timed(_full, own, example, some)
            every.append(milliseconds / len(some) * len(GRID))
    total = len(examples) * len(GRID)
    middle, low, high = quartiles(times)
    full, full_low, full_high = quartiles(every)
    return {
        "part": "left_out",
        "kind": kind,
        "scenes": len(examples),
        "height": SIZE,
        "width": SIZE,
        "tolerance": DEFAULT,
        "share": {name: count / total for name, count in names.items()},
        "predicted_difference_mean": float(np.mean(predicted)),
        "predicted_difference_largest": float(np.max(predicted)),
        "ms_per_sweep": middle,
        "ms_25_percent": low,
        "ms_75_percent": high,
        "full_ms_per_sweep": full,
        "full_ms_25_percent": full_low,
        "full_ms_75_percent": full_high,
    }


def _sweep(own: CameraSimulator, example: Example) -> None:
    own.prepare(example.source, tolerance=DEFAULT, **example.told).expose(GRID)


def _full(own: CameraSimulator, example: Example, states: Iterable[Any]) -> None:
    for settings in states:
        own.simulate(example.source, settings, tolerance=None, **example.told)


# -- kinds of scenes ------------------------------------------------------------------------------


def _of_kind(*kinds: str) -> list[Trial]:
    """Trials of some kinds; of all without depth where there are none."""
    known = test_trials(quick=False)
    found = [t for t in known if t.scene.kind in kinds]
    return found or [t for t in known if t.scene.depth is None]


def _retaken(trial: Trial, iso: float, error: float) -> Trial:
    return replace(trial, source=source_settings(trial.scene, iso, error))


def _radiance(seed: int) -> Iterable[Example]:
    for trial in _of_kind("radiance"):
        light = PreparedScene(
            light=trial.scene.light,
            reference=trial.scene.reference,
            camera=trial.camera.camera,
            nlf=NoiseLevelFunction.zero(),
        )
        yield Example(light, {"depth": "unknown"})


def _clean(seed: int) -> Iterable[Example]:
    files = _real_files()
    for path in files:
        raw = read_raw(path)
        if raw.settings.iso <= _CLEAN_ISO and min(raw.data.shape[1:]) >= SIZE:
            yield Example(_middle(raw), {"depth": "unknown"})
    for trial in _of_kind("photograph") if not files else ():
        yield Example(_retaken(trial, 100, 0.0).raw(seed), {"depth": "unknown"})


def _real_files() -> list[Path]:
    root = data_root()
    if root is None:
        return []
    found = (p for p in root.rglob("*") if p.suffix.lower() in _RAW_SUFFIXES)
    return sorted(found, key=lambda p: (p.suffix, p.name))


def _middle(raw: RawImage) -> RawImage:
    top, left = ((n - SIZE) // 2 for n in raw.data.shape[1:])
    window = (..., slice(top, top + SIZE), slice(left, left + SIZE))
    return replace(raw, data=raw.data[window].contiguous())


def _noisy(seed: int) -> Iterable[Example]:
    for trial in _of_kind("photograph", "dead_leaves", "indoor"):
        yield Example(_retaken(trial, 6400, -2.0).raw(seed), {"depth": "unknown"})


def _flat(seed: int) -> Iterable[Example]:
    for trial in _of_kind("dead_leaves", "indoor", "radiance"):
        yield Example(_retaken(trial, 400, 0.0).raw(seed), {"depth": "far"})


def _close_known(seed: int) -> Iterable[Example]:
    for trial in _of_kind("dead_leaves", "indoor", "photograph"):
        yield Example(_retaken(trial, 400, 0.0).raw(seed), {"defocus": _DISC})


def _close_unknown(seed: int) -> Iterable[Example]:
    for trial in reversed(_of_kind(DRAPED, "depth")):
        extent = float(trial.camera.blur_diameter(trial.scene, trial.source.f_number).max())
        if extent > _BLURRED:
            yield Example(_retaken(trial, 400, 0.0).raw(seed), {"depth": "unknown"})


def _moving(seed: int) -> Iterable[Example]:
    for trial in _of_kind("dead_leaves", "indoor", "photograph"):
        yield Example(_retaken(trial, 400, 0.0).raw(seed), {"image_speed": _SPEED})


#: How the examples of each kind are made.
KINDS: dict[str, Callable[[int], Iterable[Example]]] = {
    "radiance map": _radiance,
    "clean raw": _clean,
    "noisy raw": _noisy,
    "flat scene": _flat,
    "close-up, disc known": _close_known,
    "close-up, depth unknown": _close_unknown,
    "moving scene": _moving,
}
