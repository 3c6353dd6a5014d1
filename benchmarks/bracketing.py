"""Which frames to take for a merged picture: fixed steps, Hasinoff's schedule, a planner.

Every policy takes the same episodes of `ExposureBracket-v0` on scenes that nothing was fitted or
trained on. The last row knows what no camera does: the light of the scene and the speed.
"""

from contextlib import closing
from functools import partial
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from agents.bracketing.policies import BINS, Planner, bin_of, run_brackets
from agents.evaluation.intervals import difference_interval
from agents.policy import PolicyContext
from agents.policy_names import make_policy
from benchmarks.harness import Part, Report, Row, benchmark, table
from simulator.utils.files import data_folder

#: Policies, and what a page calls them.
POLICIES = {
    "bracket:fixed?step=0": "one metered frame",
    "bracket:fixed?step=2": "metered, +2 and -2 EV",
    "bracket:fixed?step=4": "metered, +4 and -4 EV",
    "bracket:hasinoff": "Hasinoff et al. 2010",
    "bracket:planned": "planner, light as the frames show it, no blur",
    "bracket": "planner that knows what blur costs",
    "known": "planner that knows light and speed",
}
#: The policy that the others are compared with.
BASELINE = "bracket:hasinoff"
#: Sets of scenes; the second needs real files.
SETS = ("bundled", "polyhaven")
#: Time of all frames together [s].
BUDGETS = (0.05, 0.3)
#: Episodes of each scene, and scenes of a quick run.
EPISODES, QUICK_SCENES = 4, 24
NAMES = ("quality", "log_error", "unseen", "frames", "seconds")


def known_light(context: Any, envs: Any) -> Any:
    """The planner with the light and the speed of the episodes of `envs`."""
    base = envs.unwrapped

    class Known(Planner):
        def light(self, camera: int) -> NDArray[np.float64]:
            scene = base.scene(camera)
            light = scene.clean_light.flatten().double().numpy()
            place = np.log2(np.maximum(light, 1e-12)) - scene.reference.log2_exposure
            bins = bin_of(place - float(self._reference[camera]))
            return np.bincount(bins, minlength=len(BINS)) / len(light)

        def choose(self, camera: int, time_left: float, speed: float) -> int:
            return super().choose(camera, time_left, base.episode(camera).speed)

    return Known(context)


def measure(scenes: str, budget: float, policy: str, seed: int, most: int | None) -> Row:
    given: Any = {"scenes": scenes, "budget": budget, "autoreset_mode": "DISABLED"}
    make: Any = partial(gym.make_vec, "ae_env:ae_env/ExposureBracket-v0", num_envs=32, **given)
    row: Row = {"scenes": scenes, "budget": budget, "policy": policy}
    with closing(make(split="test")) as envs:
        context = PolicyContext.from_envs(envs)
        one: Any = known_light(context, envs) if policy == "known" else make_policy(policy, context)
        if policy == BASELINE:
            with closing(make(split="train")) as train:
                one.fit(train, seed)
            row |= {"headroom": one.headroom, "longest": one.longest}
        frame = pd.DataFrame(run_brackets(one, envs, count=EPISODES, seed=seed, most=most))
    means = frame.groupby("group")[list(NAMES)].mean()
    return row | {"groups": means.index.tolist()} | {name: [means[name].tolist()] for name in NAMES}


def parts(seed: int, quick: bool) -> list[Part]:
    names, found = ("scenes", "budget", "policy"), []
    for case in product(SETS if data_folder() is not None else SETS[:1], BUDGETS, POLICIES):
        arguments = dict(zip(names, case, strict=True)) | {"most": QUICK_SCENES if quick else None}
        found.append(Part("{}, {} s, {}".format(*case), measure, arguments, threads=1))
    return found


def rows_of(results: dict[str, Any]) -> list[Row]:
    rows, own = [], {(r["scenes"], r["budget"], r["policy"]): r for r in results.values()}
    for (scenes, budget, policy), result in own.items():
        quality, span = np.array(result["quality"]), np.ones(len(result["groups"]))
        row: Row = {"scenes": scenes, "budget": budget, "policy": policy, "name": POLICIES[policy]}
        row |= {name: float(np.mean(result[name])) for name in NAMES}
        row |= {name: result[name] for name in ("headroom", "longest") if name in result}
        interval = difference_interval(quality, np.zeros_like(quality[:1]), span)
        row |= {"ci95": interval.pair, "num_groups": len(span), "ms": 1e3 * row.pop("seconds")}
        if policy != BASELINE:
            base = np.array(own[scenes, budget, BASELINE]["quality"])
            difference = difference_interval(quality, base, span)
            row |= {"to_baseline": difference.value, "to_ci95": difference.pair}
        rows.append(row)
    return rows


_COLUMNS = """policy = {name} | quality = {quality:.4f} | 95 % interval = {ci95:.4f} |
minus Hasinoff = {to_baseline:+.4f} ({to_ci95:+.4f}) | error [EV] = {log_error:.4f} |
unseen = {unseen:.2%} | frames = {frames:.2f} | ms per decision = {ms:.2f}"""
_FITTED = """scenes = {scenes}, {budget:g} s | looks above white by = {headroom:g} EV |
longest exposure = {longest:.3g} s"""


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows = rows_of(results)
    tables = {"fitted": table((row for row in rows if "headroom" in row), _FITTED)}
    for scenes, budget in product(SETS, BUDGETS):
        own = [row for row in rows if (row["scenes"], row["budget"]) == (scenes, budget)]
        tables[f"{scenes}-{1e3 * budget:.0f}ms"] = table(own, _COLUMNS)
    return Report(rows, tables)


run = benchmark("bracketing", parts, report)
