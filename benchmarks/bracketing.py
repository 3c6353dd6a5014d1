"""Which frames to take for a merged picture: fixed steps, Hasinoff's schedule, a planner.

Every policy takes the same episodes of `ExposureBracket-v0` on scenes that nothing was fitted or
trained on. The last row knows what no camera does: the light of the scene and the speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from agents.evaluation.intervals import difference_interval
from benchmarks.harness import Benchmark, Part, Report, Row, table
from simulator.utils.files import data_folder as data_root

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
    from agents.bracketing.policies import BINS, Planner, bin_of

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
    """What `policy` reaches: means of each source group."""
    import gymnasium as gym

    import ae_env  # noqa: F401  (registers the environment)
    from agents.bracketing.policies import run_brackets
    from agents.policy import PolicyContext
    from agents.policy_names import make_policy

    make = partial(
        gym.make_vec,
        "ae_env/ExposureBracket-v0",
        num_envs=32,
        scenes=scenes,
        budget=budget,
        autoreset_mode="DISABLED",
    )
    found: dict[str, list[list[float]]] = {name: [] for name in NAMES}
    fitted = {}
    with closing(make(split="test")) as envs:
        context = PolicyContext.from_envs(envs)
        one = known_light(context, envs) if policy == "known" else make_policy(policy, context)
        if policy == BASELINE:
            with closing(make(split="train")) as train:
                one.fit(train, seed)
            fitted = {"headroom": one.headroom, "longest": one.longest}
        result = run_brackets(one, envs, count=EPISODES, seed=seed, most=most)
        groups = sorted(set(result["group"].tolist()))
        for key in NAMES:
            found[key].append([float(result[key][result["group"] == g].mean()) for g in groups])
    return {"scenes": scenes, "budget": budget, "policy": policy, "groups": groups} | found | fitted


def parts(seed: int, quick: bool) -> list[Part]:
    """One part for each set of scenes, budget and policy."""
    sets = SETS if data_root() is not None else SETS[:1]
    most = QUICK_SCENES if quick else None
    return [
        Part(
            f"{scenes}, {budget} s, {policy}",
            measure,
            {"scenes": scenes, "budget": budget, "policy": policy, "seed": seed, "most": most},
            threads=1,
        )
        for scenes, budget, policy in product(sets, BUDGETS, POLICIES)
    ]


def rows_of(results: dict[str, Any]) -> list[Row]:
    """A row for each part: means, intervals, and the difference to `BASELINE`."""
    rows = []
    for result in results.values():
        base = next(
            r["quality"]
            for r in results.values()
            if r["policy"] == BASELINE and all(r[k] == result[k] for k in ("scenes", "budget"))
        )
        quality, span = np.array(result["quality"]), np.ones(len(result["groups"]))
        interval = difference_interval(quality, np.zeros_like(quality[:1]), span)
        difference = difference_interval(quality, np.array(base), span)
        row = {name: result[name] for name in ("scenes", "budget", "policy")}
        row |= {name: float(np.mean(result[name])) for name in NAMES}
        row |= {name: result[name] for name in ("headroom", "longest") if name in result}
        row |= {"ci95": interval.pair, "num_groups": len(span), "ms": 1e3 * row.pop("seconds")}
        if result["policy"] != BASELINE:
            low, high = difference.pair or (None, None)
            row |= {"to_baseline": difference.value, "to_low": low, "to_high": high}
        rows.append(row | {"each": np.sort(1.0 - quality.mean(axis=0)).tolist()})
    return rows


def distributions(rows: Sequence[Row]) -> Figure:
    """Share of the source groups whose loss of quality is below a value."""
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    cases = sorted({(row["scenes"], row["budget"]) for row in rows}, reverse=True)
    shown = [case for case in cases if case[1] == BUDGETS[-1]]
    for axis, (scenes, budget) in zip(
        np.atleast_1d(figure.subplots(1, len(shown), sharey=True)), shown, strict=True
    ):
        for row in rows:
            if (row["scenes"], row["budget"]) == (scenes, budget):
                share = (np.arange(len(row["each"])) + 1.0) / len(row["each"])
                style = {"c": "k", "ls": ":"} if row["policy"] == "known" else {}
                axis.step(row["each"], share, label=POLICIES[row["policy"]], **style)
        axis.set_title(f"{scenes}, {budget:g} s", fontsize=9)
        axis.set(xscale="log", xlabel="1 - quality (left is better)")
    axis.set_ylabel("")
    figure.axes[0].set_ylabel("share of the source groups")
    figure.legend(loc="outside right upper", fontsize=8)
    return figure


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """The report, of the rows of all parts."""
    rows = rows_of(results)
    each = [{name: value for name, value in row.items() if name != "each"} for row in rows]
    return Report(each, tables_of(rows), figures={"bracketing.png": distributions(rows)})


def tables_of(rows: Sequence[Row]) -> dict[str, str]:
    """A table for each set of scenes and budget, and one of what was fitted to each."""
    columns: dict[str, Any] = {
        "policy": lambda row: POLICIES[row["policy"]],
        "quality": "{quality:.4f}",
        "95 % interval": "{ci95[0]:.4f} to {ci95[1]:.4f}",
        "minus Hasinoff": "{to_baseline:+.4f} ({to_low:+.4f} to {to_high:+.4f})",
        "error [EV]": "{log_error:.4f}",
        "unseen": "{unseen:.2%}",
        "frames": "{frames:.2f}",
        "ms per decision": "{ms:.2f}",
    }
    fitted_columns = {
        "scenes": "{scenes}, {budget:g} s",
        "looks above white by": "{headroom:g} EV",
        "longest exposure": "{longest:.3g} s",
    }
    tables = {"fitted": table((row for row in rows if "headroom" in row), fitted_columns)}
    for scenes, budget in product(SETS, BUDGETS):
        own = [row for row in rows if (row["scenes"], row["budget"]) == (scenes, budget)]
        tables[f"{scenes}-{1e3 * budget:.0f}ms"] = table(own, columns)
    return tables


BENCHMARK = Benchmark(
    name="bracketing",
    title="Frames for a merged picture",
    parts=parts,
    report=report,
    code=("ae_env", "agents/bracketing", "benchmarks/bracketing"),
)
run = BENCHMARK.run
