"""How many frames after a jump of the light do policies need, on a grid of third stops?

    ae-env bench convergence

Every small bundled test scene is watched for 90 frames, and its light jumps at the 30th. A policy
has settled when its EV100 stays within a third of a stop of where it ends, and is right when it
stays within a third of a stop of a state whose expected score is within 0.01 of the best.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from agents import PolicyContext, evaluate, make_policy
from agents.episodes import make_envs
from agents.evaluation.metrics import THIRD_EV
from agents.evaluation.result import EvaluationResult
from agents.metering.rpi_agc import ExposureFilter
from agents.policy import METERS
from benchmarks.markdown import table
from simulator.utils.files import write_atomically
from simulator.utils.results import result_meta, write_results

#: Policies that are watched.
POLICIES = ("rpi_agc", *(f"{meter}:P" for meter in METERS), "regression", "ppo")
#: Frames until the published filter of the Raspberry Pi's AGC is within 2 % of its target.
PUBLISHED_FRAMES = {-4.0: 11, 4.0: 24, 6.0: 30}
STOPS = (-6.0, -4.0, -2.0, 2.0, 4.0, 6.0)
FRAMES, STEP = 90, 30
#: Frames at the end whose mean is where a policy ends.
_LAST = 12
_COLOURS = {"rpi_agc": "black", "regression": "tab:red", "ppo": "tab:blue"}
#: A policy follows a step whose exposure ends this near to where the light went [EV].
_FOLLOWS_EV = 0.5


def run(out: Path, seed: int = 0, quick: bool = False) -> None:
    """Measures and writes ``convergence.json``, ``.md`` and ``.png`` under `out`."""
    rows: list[dict[str, Any]] = []
    curves: dict[float, dict[str, np.ndarray]] = {}
    for stops in track(STOPS[1::3] if quick else STOPS, "steps of the light"):
        result = _watched(stops, seed)
        curves[stops] = {name: _departure(result, name) for name in POLICIES}
        rows += _rows(result, stops)
    meta = result_meta(f"ae-env bench convergence{' --quick' * quick}", seed)
    meta |= {"grid": "third_stop", "frames": FRAMES, "step": STEP}
    meta |= {"scenes": len(set(result.scene_ids.tolist())), "filter": _filter_rows()}
    write_results(out / "convergence.json", rows, meta)
    write_atomically(out / "convergence.png", _plot(curves))
    write_atomically(out / "convergence.md", _markdown(rows, meta))


def _watched(stops: float, seed: int) -> EvaluationResult:
    options: dict[str, Any] = {
        "scenes": "bundled:small",
        "split": "test",
        "resolution": 64,
        "grid": "third_stop",
        "lighting": {"kind": "step", "stops": stops, "at": STEP},
    }
    envs = make_envs(options, num_envs=1, frames=1)
    context = PolicyContext.from_envs(envs)
    envs.close()
    policies = {name: make_policy(name, context) for name in POLICIES}
    return evaluate(policies, options, frames=FRAMES, seed=seed, batch=20)


def _departure(result: EvaluationResult, policy: str) -> np.ndarray:
    """(E, T) EV100 of every frame less that of where the episode ends."""
    evs = result.grid.ev100[result.tracks[policy].states[0]]
    departure: np.ndarray = evs - evs[:, -_LAST:].mean(axis=1, keepdims=True)
    return departure


def _since_step(outside: np.ndarray) -> np.ndarray:
    """Frames from the step until the last one that is outside, (E,); 0 where none is."""
    after = outside[:, STEP - 1 :]  # the first action is seen in frame 1
    last = after.shape[1] - np.argmax(after[:, ::-1], axis=1)
    return np.where(after.any(axis=1), last, 0)


def _filter_rows() -> list[dict[str, Any]]:
    """Frames that the AGC's filter takes by itself: to 2 % of its target, to a third of a stop."""
    rows = []
    for stops in STOPS:
        follow, distances = ExposureFilter(1, startup_frames=0), []
        follow.update(np.ones(1))
        for _ in range(FRAMES):
            distances.append(abs(np.log2(follow.update(np.full(1, 2.0**-stops))[0]) + stops))
        far = np.array(distances)
        near = {"2 %": np.log2(1.02), "1/3 EV": THIRD_EV}
        frames = {name: int(np.flatnonzero(far > limit)[-1]) + 2 for name, limit in near.items()}
        rows.append({"stops": stops, "published": PUBLISHED_FRAMES.get(stops), "frames": frames})
    return rows


def _rows(result: EvaluationResult, stops: float) -> Iterator[dict[str, Any]]:
    for policy in result.tracks:
        evs = result.grid.ev100[result.tracks[policy].states[0]]
        moved = evs[:, -_LAST:].mean(axis=1) - evs[:, STEP - 2]
        follows = np.abs(moved - stops) <= _FOLLOWS_EV
        settled = _since_step(np.abs(_departure(result, policy)) > THIRD_EV)
        error = result.episode_metrics(policy)["ev_error"][0]
        right = _since_step(error > THIRD_EV)
        known = right <= FRAMES - STEP  # right at last
        yield {
            "policy": policy,
            "stops": stops,
            "frames_to_settle_median": float(np.median(settled)),
            "frames_to_settle_p90": float(np.percentile(settled, 90)),
            "follows": float(follows.mean()),
            "frames_to_settle_following": (
                float(np.median(settled[follows])) if follows.any() else None
            ),
            "right_at_last": float(known.mean()),
            "frames_to_be_right_median": float(np.median(right[known])) if known.any() else None,
            "final_ev_error": float(error[:, -_LAST:].mean()),
            "num_scenes": len(settled),
        }


def _plot(curves: dict[float, dict[str, np.ndarray]]) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(3, len(curves))
    lines = -(-len(curves) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.0 * lines), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for axes, (stops, by_policy) in zip(panels, curves.items(), strict=True):
        for name, departure in by_policy.items():
            frames = np.arange(1, FRAMES + 1) - STEP
            colour = _COLOURS.get(name)  # the others': matplotlib's own, dashed
            style = "--" if colour is None else "-"
            axes.plot(frames, np.median(departure, axis=0), style, color=colour, label=name)
        axes.axhspan(-THIRD_EV, THIRD_EV, color="0.92")
        axes.set(title=f"light {stops:+g} EV", xlabel="frames since the step", xlim=(-5, 40))
    for axes in panels[::columns]:
        axes.set_ylabel("EV100 less the final one (median)", fontsize=8)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=7)
    buffer = io.BytesIO()
    canvas.print_png(buffer)
    return buffer.getvalue()


def _markdown(rows: list[dict[str, Any]], meta: dict[str, Any]) -> str:
    body = [
        [
            f"{row['stops']:+g}",
            f"`{row['policy']}`",
            f"{row['frames_to_settle_median']:.0f}",
            f"{row['frames_to_settle_p90']:.0f}",
            f"{row['follows']:.0%}",
            _cell(row["frames_to_settle_following"]),
            f"{row['right_at_last']:.0%}",
            _cell(row["frames_to_be_right_median"]),
            f"{row['final_ev_error']:.2f}",
        ]
        for row in rows
    ]
    filtered = [
        [f"{own['stops']:+g}", str(own["published"] or "-"), *map(str, own["frames"].values())]
        for own in meta["filter"]
    ]
    head = ["light [EV]", "policy", "frames to settle (median)", "P90", "follows the whole step"]
    head += ["frames to settle where it does", "right at last", "frames to be right (median)"]
    head += ["final EV error"]
    return "\n".join(
        [
            "# Convergence after a jump of the light",
            "",
            f"`{meta['command']}`, {meta['date'][:10]}. {meta['scenes']} small bundled test "
            f"scenes with motion and defocus as in an episode, a grid of third stops (2128 "
            f"states), {FRAMES} frames, the light jumps at frame {STEP}. *Settled*: EV100 stays "
            "within a third of a stop of its mean over the last 12 frames. *Right*: it stays "
            "within a third of a stop of a state whose expected score is within 0.01 of the best; "
            "its frames are those of the scenes in which the policy is right at last. *Follows the "
            f"whole step*: where it ends is within {_FOLLOWS_EV:g} EV of where the light went; in "
            "the other scenes it meets the end of the grid or of its ladder, or bright and dark "
            "parts of the scene count otherwise. Times per decision are in the [evaluation]"
            "(evaluation/report.md).",
            "",
            "![EV100 over time](convergence.png)",
            "",
            table(head, body),
            "",
            "## What the filter of the Raspberry Pi's AGC implies",
            "",
            "Frames that the filter takes by itself, without a camera: speed 0.2, its square root "
            "within 20 % of the target. `rpi_agc` above is to be compared with the frames to a "
            "third of a stop.",
            "",
            table(["light [EV]", "published, to 2 %", "to 2 %", "to 1/3 EV"], filtered),
            "",
        ]
    )


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}"
