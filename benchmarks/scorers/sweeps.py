"""What scorers like best: the exposure, at fixed gain, and the gain, at fixed exposure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ae_env.scenes import Scene
from ae_env.scorers import CompositeScorer
from ae_env.scorers.captures import describe_captures
from ae_env.scorers.score_table import prepare_scene
from benchmarks.markdown import table
from simulator import CameraProfile
from simulator.settings import CameraSettings

#: Exposures of the sweep, in EV above that of the incident light: half stops.
OFFSETS = np.arange(-6.0, 4.01, 0.5)
#: Stops that the gain rises by, at fixed brightness.
STOPS = 6
F_NUMBER = 5.6
#: Scores nearer than this are equal.
_EQUAL = 1e-9


def best_ev_rows(
    scorers: Mapping[str, CompositeScorer],
    scenes: Sequence[Scene],
    camera: CameraProfile,
    seed: int,
) -> list[dict[str, Any]]:
    """A row per scorer: in how many stops above incident light each scene scores best."""
    best: dict[str, dict[str, float | None]] = {name: {} for name in scorers}
    for i, scene in enumerate(scenes):
        states = [_state(scene, 100.0, offset) for offset in OFFSETS]
        for name, scores in _scores(scorers, scene, states, camera, seed + i).items():
            best[name][scene.scene_id] = _best(scores)
    return [_best_row(name, own) for name, own in best.items()]


def _best(scores: np.ndarray) -> float | None:
    """The best exposure, of equal ones that nearest to the incident light's; None of all equal."""
    if np.ptp(scores) < _EQUAL:
        return None
    best = OFFSETS[scores >= scores.max() - _EQUAL]
    return float(best[np.argmin(np.abs(best))])


def _best_row(name: str, by_scene: dict[str, float | None]) -> dict[str, Any]:
    known = [value for value in by_scene.values() if value is not None]
    return {
        "scorer": name,
        "median": float(np.median(known)) if known else None,
        "lowest": min(known, default=None),
        "highest": max(known, default=None),
        "by_scene": by_scene,
    }


def gain_rows(
    scorers: Mapping[str, CompositeScorer],
    scenes: Sequence[Scene],
    camera: CameraProfile,
    seed: int,
) -> list[dict[str, Any]]:
    """A row per scorer: its change as the gain rises by 6 stops and the time falls by as many.

    Each pixel carries the noise of one pixel of the sensor, whatever the scene was averaged from.
    """
    changes: dict[str, list[tuple[float, float]]] = {name: [] for name in scorers}
    for i, scene in enumerate(scenes):
        native = replace(scene, box_factor=1)
        states = [_state(scene, 100.0, 0.0), _state(scene, 100.0 * 2.0**STOPS, 0.0)]
        for name, scores in _scores(scorers, native, states, camera, seed + i).items():
            changes[name].append((float(scores[0]), float(scores[1])))
    return [_gain_row(name, np.array(pairs)) for name, pairs in changes.items()]


def _gain_row(name: str, pairs: np.ndarray) -> dict[str, Any]:
    change = pairs[:, 1] - pairs[:, 0]
    return {
        "scorer": name,
        "low_gain": float(pairs[:, 0].mean()),
        "high_gain": float(pairs[:, 1].mean()),
        "change": float(change.mean()),
        "change_sd": float(change.std()),
        "rises": float((change > 1e-9).mean()),
        "num_scenes": len(pairs),
    }


def _state(scene: Scene, iso: float, offset: float) -> CameraSettings:
    """Settings `offset` stops above the incident light's exposure, at this gain."""
    at_one_second = CameraSettings(iso, 1.0, F_NUMBER)
    time = 2.0 ** (-at_one_second.log2_exposure - scene.ev100 + offset)
    return CameraSettings(iso, time, F_NUMBER)


def _scores(
    scorers: Mapping[str, CompositeScorer],
    scene: Scene,
    states: list[CameraSettings],
    camera: CameraProfile,
    seed: int,
) -> dict[str, np.ndarray]:
    """(S,) of each scorer, on noisy captures without blur."""
    zeros = np.zeros(len(states))
    captures = describe_captures(
        [scene] * len(states), states, camera, speed=zeros, defocus=zeros, gain=zeros + 1.0
    )
    images = prepare_scene(scene, camera).expose(states, seed=seed).clamp_(0.0, 1.0)
    return {name: scorer(images, captures).numpy() for name, scorer in scorers.items()}


def gain_section(rows: Sequence[Mapping[str, Any]]) -> str:
    """The part of the page that shows what `gain_rows` gives."""
    body = [
        [
            f"`{row['scorer']}`",
            f"{row['low_gain']:.3f}",
            f"{row['high_gain']:.3f}",
            f"{row['change']:+.3f} ± {row['change_sd']:.3f}",
            f"{row['rises']:.0%}",
        ]
        for row in sorted(rows, key=lambda row: -row["change"])
    ]
    head = ["scorer", "ISO 100", "ISO 6400", "change", "scenes in which it rises"]
    text = (
        f"The reward-hacking table. The gain rises by {STOPS} stops and the exposure time falls by "
        "as many: the picture is as bright as before and has only more noise. A scorer that rises "
        "takes noise for detail, contrast or information, and an agent that is rewarded by it "
        "learns to raise the ISO: pair it with `noise` or `snr`. Means over "
        f"{rows[0]['num_scenes']} small bundled test scenes, exposed for their incident light, "
        "without blur; each pixel has the noise of one pixel of the sensor."
    )
    return f"{text}\n\n{table(head, body)}"


def best_ev_section(rows: Sequence[Mapping[str, Any]]) -> str:
    """The part of the page that shows what `best_ev_rows` gives."""
    scenes = list(rows[0]["by_scene"])
    known = [row for row in rows if row["median"] is not None]
    body = [
        [
            f"`{row['scorer']}`",
            f"{row['median']:+.1f}",
            f"{row['lowest']:+.1f} to {row['highest']:+.1f}",
            " ".join("=" if v is None else f"{v:+g}" for v in row["by_scene"].values()),
        ]
        for row in sorted(known, key=lambda row: row["median"])
    ]
    same = ", ".join(f"`{row['scorer']}`" for row in rows if row["median"] is None)
    head = ["scorer", "median [EV]", "range", "scene by scene"]
    text = (
        f"The exposure, of a sweep from {OFFSETS[0]:+g} to {OFFSETS[-1]:+g} EV around the incident "
        f"light in half stops at ISO 100 and f/{F_NUMBER:g}, at which each scene scores best; "
        "noisy captures without blur. A scorer whose best exposure is at an end of the sweep "
        f"cannot stand alone. To {same} all exposures are equal without blur and flicker. Scenes, "
        "in this order: " + ", ".join(f"`{s}`" for s in scenes) + "."
    )
    return f"{text}\n\n{table(head, body)}"
