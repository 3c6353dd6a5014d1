"""How many frames after a jump of the light do policies need, on a grid of third stops?

    ae-env bench convergence

Every small bundled test scene is watched for 90 frames, and its light jumps at the 30th. A policy
has settled when its EV100 stays within a third of a stop of where it ends, and is right when it
stays within a third of a stop of a state whose expected score is within 0.01 of the best.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from agents import PolicyContext, evaluate, make_policy
from agents.evaluation.metrics import THIRD_EV
from agents.evaluation.result import EvaluationResult
from agents.metering.rpi_agc import ExposureFilter
from agents.policy_names import METERS
from agents.rollouts import make_envs
from benchmarks.harness import Benchmark, Part, Report, Row, table

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


def parts(seed: int, quick: bool) -> list[Part]:
    """One part for each step of the light."""
    steps = STOPS[1::3] if quick else STOPS
    return [Part(f"{stops:+g}", watch, {"stops": stops, "seed": seed}) for stops in steps]


def watch(stops: float, seed: int) -> dict[str, Any]:
    """Rows of all policies at one step of the light, and the median curve of each."""
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
    result = evaluate(policies, options, frames=FRAMES, seed=seed, batch=20)
    curves = {name: np.median(_departure(result, name), axis=0).tolist() for name in POLICIES}
    scenes = len(set(result.scene_ids.tolist()))
    return {"rows": list(_rows(result, stops)), "curves": curves, "scenes": scenes}


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


def _filter_rows() -> list[Row]:
    """Frames that the AGC's filter takes by itself: to 2 % of its target, to a third of a stop."""
    rows = []
    for stops in STOPS:
        follow, target = ExposureFilter(1, startup_frames=0), np.full(1, 2.0**-stops)
        follow.update(np.ones(1))
        far = np.array([abs(np.log2(follow.update(target)[0]) + stops) for _ in range(FRAMES)])
        two, third = (int(np.flatnonzero(far > x)[-1]) + 2 for x in (np.log2(1.02), THIRD_EV))
        published = PUBLISHED_FRAMES.get(stops)
        rows.append({"stops": stops, "published": published, "two": two, "third": third})
    return rows


def _rows(result: EvaluationResult, stops: float) -> Iterator[Row]:
    for policy in result.tracks:
        evs = result.grid.ev100[result.tracks[policy].states[0]]
        moved = evs[:, -_LAST:].mean(axis=1) - evs[:, STEP - 2]
        follows = np.abs(moved - stops) <= _FOLLOWS_EV
        settled = _since_step(np.abs(_departure(result, policy)) > THIRD_EV)
        error = result.episode_metrics(policy)["ev_error"][0]
        right = _since_step(error > THIRD_EV)
        known = right <= FRAMES - STEP  # right at last
        row: Row = {"policy": policy, "stops": stops, "num_scenes": len(settled)}
        row |= {"frames_to_settle_median": float(np.median(settled))}
        row |= {"frames_to_settle_p90": float(np.percentile(settled, 90))}
        row |= {"follows": float(follows.mean()), "right_at_last": float(known.mean())}
        where = {"frames_to_settle_following": settled[follows]}
        where["frames_to_be_right_median"] = right[known]
        row |= {name: float(np.median(own)) if len(own) else None for name, own in where.items()}
        yield row | {"final_ev_error": float(error[:, -_LAST:].mean())}


def _draw(results: dict[str, Any]) -> Figure:
    columns = min(3, len(results))
    lines = -(-len(results) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.0 * lines), dpi=90, layout="constrained")
    panels = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for axes, (stops, result) in zip(panels, results.items(), strict=True):
        for name, departure in result["curves"].items():
            frames = np.arange(1, FRAMES + 1) - STEP
            colour = _COLOURS.get(name)  # the others': matplotlib's own, dashed
            style = "--" if colour is None else "-"
            axes.plot(frames, departure, style, color=colour, label=name)
        axes.axhspan(-THIRD_EV, THIRD_EV, color="0.92")
        axes.set(title=f"light {stops} EV", xlabel="frames since the step", xlim=(-5, 40))
    for axes in panels[::columns]:
        axes.set_ylabel("EV100 less the final one (median)", fontsize=8)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=7)
    return figure


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """The report, of the results by step of the light."""
    rows = [row for result in results.values() for row in result["rows"]]
    scenes, filtered = next(iter(results.values()))["scenes"], _filter_rows()
    columns = {
        "light [EV]": "{stops:+g}",
        "policy": "`{policy}`",
        "frames to settle (median)": "{frames_to_settle_median:.0f}",
        "P90": "{frames_to_settle_p90:.0f}",
        "follows the whole step": "{follows:.0%}",
        "frames to settle where it does": "{frames_to_settle_following:.0f}",
        "right at last": "{right_at_last:.0%}",
        "frames to be right (median)": "{frames_to_be_right_median:.0f}",
        "final EV error": "{final_ev_error:.2f}",
    }
    filter_columns = {
        "light [EV]": "{stops:+g}",
        "published, to 2 %": "{published}",
        "to 2 %": "{two}",
        "to 1/3 EV": "{third}",
    }
    tables = {"settling": table(rows, columns), "filter": table(filtered, filter_columns)}
    more = {"grid": "third_stop", "frames": FRAMES, "step": STEP, "scenes": scenes}
    more["filter"] = filtered
    return Report(rows, tables, meta=more, figures={"convergence.png": _draw(results)})


BENCHMARK = Benchmark(
    name="convergence",
    title="Convergence after a jump of the light",
    parts=parts,
    report=report,
    code=("simulator", "ae_env", "agents", "benchmarks/convergence"),
)
run = BENCHMARK.run
