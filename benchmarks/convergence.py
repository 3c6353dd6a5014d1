"""How many frames after a jump of the light do policies need, on a grid of third stops?

    ae-env bench convergence

Every small bundled test scene is watched for 90 frames, and its light jumps at the 30th. A policy
has settled when its EV100 stays within a third of a stop of where it ends, and is right when it
stays within a third of a stop of a state whose expected score is within 0.01 of the best.
"""

from __future__ import annotations

from contextlib import closing
from typing import Any

import numpy as np

from agents import PolicyContext, evaluate, make_policy
from agents.evaluation.metrics import THIRD_EV
from agents.metering.rpi_agc import ExposureFilter
from agents.policy_names import METERS
from agents.rollouts import make_envs
from benchmarks.harness import Part, Report, Row, benchmark, panels, table

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
    steps = STOPS[1::3] if quick else STOPS
    return [Part(f"{stops:+g}", watch, {"stops": stops, "seed": seed}) for stops in steps]


def watch(stops: float, seed: int) -> dict[str, Any]:
    options: dict[str, Any] = {"scenes": "bundled:small", "split": "test", "resolution": 64}
    options |= {"grid": "third_stop", "lighting": {"kind": "step", "stops": stops, "at": STEP}}
    with closing(make_envs(options, num_envs=1, frames=1)) as envs:
        context = PolicyContext.from_envs(envs)
    policies = {name: make_policy(name, context) for name in POLICIES}
    result = evaluate(policies, options, frames=FRAMES, seed=seed, batch=20)
    rows, curves = [], {}
    for policy in POLICIES:
        evs = result.grid.ev100[result.tracks[policy].states[0]]  # (E, T)
        last = evs[:, -_LAST:].mean(axis=1, keepdims=True)
        curves[policy] = np.median(evs - last, axis=0).tolist()
        follows = np.abs(last[:, 0] - evs[:, STEP - 2] - stops) <= _FOLLOWS_EV
        settled = _since_step(np.abs(evs - last) > THIRD_EV)
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
        rows.append(row | {"final_ev_error": float(error[:, -_LAST:].mean())})
    return {"rows": rows, "curves": curves, "scenes": len(set(result.scene_ids.tolist()))}


def _since_step(outside: np.ndarray) -> np.ndarray:
    """Frames from the step until the last one that is outside, (E,); 0 where none is."""
    after = outside[:, STEP - 1 :]  # the first action is seen in frame 1
    last = after.shape[1] - np.argmax(after[:, ::-1], axis=1)
    return np.where(after.any(axis=1), last, 0)


def _filter_row(stops: float) -> Row:
    """Frames that the AGC's filter takes by itself: to 2 % of its target, to a third of a stop."""
    follow, target = ExposureFilter(1, startup_frames=0), np.full(1, 2.0**-stops)
    follow.update(np.ones(1))
    far = np.array([abs(np.log2(follow.update(target)[0]) + stops) for _ in range(FRAMES)])
    two, third = (int(np.flatnonzero(far > x)[-1]) + 2 for x in (np.log2(1.02), THIRD_EV))
    return {"stops": stops, "published": PUBLISHED_FRAMES.get(stops), "two": two, "third": third}


_COLUMNS = """light [EV] = {stops:+g} | policy = `{policy}` |
frames to settle (median) = {frames_to_settle_median:.0f} | P90 = {frames_to_settle_p90:.0f} |
follows the whole step = {follows:.0%} |
frames to settle where it does = {frames_to_settle_following:.0f} |
right at last = {right_at_last:.0%} |
frames to be right (median) = {frames_to_be_right_median:.0f} |
final EV error = {final_ev_error:.2f}"""
_FILTER = """light [EV] = {stops:+g} | published, to 2 % = {published} | to 2 % = {two} |
to 1/3 EV = {third}"""


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows = [row for result in results.values() for row in result["rows"]]
    filtered = [_filter_row(stops) for stops in STOPS]
    curves = []
    for stops, result in results.items():
        for name, y in result["curves"].items():
            colour = _COLOURS.get(name)  # the others': matplotlib's own, dashed
            curve: Row = {"panel": f"light {stops} EV", "label": name, "y": y}
            curve["style"] = {"ls": "--" if colour is None else "-", "color": colour}
            curves.append(curve | {"x": np.arange(1, FRAMES + 1) - STEP})
    labels: Row = {"xlabel": "frames since the step", "ylabel": "EV100 less the final one (median)"}
    figure = panels(curves, xlim=(-5, 40), **labels)
    for axes in figure.axes:
        axes.axhspan(-THIRD_EV, THIRD_EV, color="0.92")
    tables = {"settling": table(rows, _COLUMNS), "filter": table(filtered, _FILTER)}
    more = {"grid": "third_stop", "frames": FRAMES, "step": STEP, "filter": filtered}
    more["scenes"] = next(iter(results.values()))["scenes"]
    return Report(rows, tables, meta=more, figures={"convergence.png": figure})


run = benchmark("convergence", parts, report)
