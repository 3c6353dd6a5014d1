"""Score tables predicted from one noisy raw, against those of the truth.

Each held-out scene is photographed once; a simulator makes the light of every state from that raw,
and the scorer rates them. The true table is of the scene's own light.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from typing import Any

import numpy as np
import pandas as pd

from ae_env.options import EnvOptions
from ae_env.scenes import Scene
from ae_env.scenes.load import SceneNetworks, simulate_source_raw
from ae_env.scenes.scene import Crop
from ae_env.scorers.score_table import ScoreTable, ScoreTables
from agents.evaluation.intervals import difference_interval, score_interval
from agents.rollouts import RolloutPlan, make_envs
from benchmarks.harness import Row, cell, correlation, pivot, sections, table
from benchmarks.transfer import agents as worlds

#: What is measured of a predicted table, each the better the smaller but the first.
MEASURES = ("rank_correlation", "regret", "absolute_error")
#: Of every scene: its measures, milliseconds, and the error that each term makes.
Measured = dict[str, Any]
#: Of the parts of a scorer, by name.
Totals = Callable[[Mapping[str, np.ndarray]], np.ndarray]


def measure(number: int, crop: Crop, iso: int, seed: int, quick: bool) -> list[Row]:
    """A row for each source exposure and simulator, of the plan's `number`-th set of tables.

    `seed` is that of motion and defocus, and of the photographs.
    """
    plan = worlds.plan_of(quick)
    part = plan.tables[number]
    options = EnvOptions(scorer=part.scorer, resolution=worlds.RESOLUTION)
    scorer = options.make_scorer()
    tables = ScoreTables(options.make_grid(), options.make_camera(), scorer)
    scenes = worlds.held_out(plan, part.scenes, crop)
    moves = drawn_moves(scenes, seed)
    true = [tables.table(scene, **own) for scene, own in zip(scenes, moves, strict=True)]
    simulators: dict[str, SceneNetworks | None] = {}
    for name in filter(worlds.has_weights, part.simulators):
        given = worlds.simulator_argument(name)
        simulators[name] = None if given is None else SceneNetworks(given, cache=False)
    rows: list[Row] = []
    for ev in part.evs:
        found: list[Measured] = []
        for scene, own, right in zip(scenes, moves, true, strict=True):
            taken = simulate_source_raw(scene, seed=seed, iso=iso, ev=ev)
            for name, networks in simulators.items():
                began = time.perf_counter()
                clean = taken if networks is None else networks.denoised(taken)
                table = tables.table(clean, **own)
                row: Measured = {"ms": 1000.0 * (time.perf_counter() - began)}
                row |= {"simulator": name, "group": scene.group}
                row["saturated"] = taken.prepared.saturated_share
                found.append(row | errors(table, right, scorer.totals))
        common = {"scorer": part.scorer, "crop": crop, "iso": iso, "ev": ev}
        rows += [common | row for row in summary(found)]
    return rows


def drawn_moves(scenes: Sequence[Scene], seed: int) -> list[dict[str, Any]]:
    """Motion and defocus of an episode on each scene, as the environment draws them."""
    options = {"scenes": list(scenes), "resolution": worlds.RESOLUTION, "scorer": "sharpness"}
    with closing(make_envs(options, num_envs=min(64, len(scenes)), frames=1)) as envs:
        base: Any = envs.unwrapped
        return [
            base.episode(int(i)).moves
            for batch in RolloutPlan.of_each_scene(scenes, count=1, seed=seed).batches(envs)
            for i in np.flatnonzero(batch.valid)
        ]


def errors(table: ScoreTable, true: ScoreTable, totals: Totals) -> Measured:
    """Measures of a predicted table, over the states that the scene allows.

    `true` is of the scene's own light; `totals` makes scores (S,) of those of the scorer's parts.
    ``regret`` is what the state that looks best loses in the true table; ``terms`` how much of the
    absolute error there is if only that part of the scorer is the predicted one.
    """
    allowed = np.ones(len(true.mean), bool) if true.allowed is None else true.allowed
    right, row = totals(true.parts), Measured()
    pair = table.mean[allowed], true.mean[allowed]
    row["rank_correlation"] = correlation(*pair)
    row["regret"] = float(true.mean[true.oracle] - true.mean[table.oracle])
    row["absolute_error"] = float(np.abs(pair[0] - pair[1]).mean())
    row["terms"] = {
        name: float(np.abs(totals({**true.parts, name: part}) - right)[allowed].mean())
        for name, part in table.parts.items()
    }
    return row


# -- over scenes ----------------------------------------------------------------------------------


def summary(measured: Sequence[Measured]) -> list[Row]:
    frame, terms = pd.DataFrame(measured), list(measured[0]["terms"])
    for term in terms:
        frame[f"term {term}"] = [m["terms"][term] for m in measured]
    own = [*MEASURES, "saturated", *(f"term {term}" for term in terms)]
    means = frame.groupby(["simulator", "group"])[own].mean()
    rows: list[Row] = []
    for name, scenes in frame.groupby("simulator", sort=False):
        values, alike = means.loc[name], np.ones(scenes["group"].nunique())
        row: Row = {"simulator": name, "num_scenes": len(scenes), "num_groups": len(alike)}
        for measure in MEASURES:
            mean = score_interval(values[measure].to_numpy(), alike)
            row |= {measure: mean.value, f"{measure}_ci95": mean.pair}
            if name != worlds.EXP and worlds.EXP in means.index:
                exp = means.loc[worlds.EXP][measure].to_numpy()
                gain = difference_interval(values[measure].to_numpy(), exp, alike)
                row |= {f"{measure}_to_exp": gain.value, f"{measure}_to_exp_ci95": gain.pair}
        row["terms"] = {term: float(values[f"term {term}"].mean()) for term in terms}
        row["worst_term"] = max(terms, key=row["terms"].__getitem__)
        row["saturated"] = float(values["saturated"].mean())
        rows.append(row | {"ms": float(scenes["ms"].median())})
    return rows


# -- tables ---------------------------------------------------------------------------------------

_CROPS = {
    "box": "averaged to 64 x 64 pixels",
    "native": "of 64 x 64 native pixels, with all of their noise",
}
_HEADINGS = {
    "Rank correlation": "{rank_correlation:.4f}",
    "Regret": "{regret:.4f}",
    "Error": "{absolute_error:.4f}",
    "Regret less that of EXP": "{regret_to_exp:+.4f}{regret_star}",
    "Error less that of EXP": "{absolute_error_to_exp:+.4f}{absolute_error_star}",
}
_SOURCE, _SIMULATOR = "source = ISO {iso}, {ev:+d} EV", "`{simulator}`"


def shown(rows: Sequence[Row]) -> str:
    """Tables of each scorer and crop; a star where an interval leaves out zero."""
    found = []
    for row in rows:
        title = f"`{row['scorer']}`, frames {_CROPS[row['crop']]}"
        stars = {}
        for name in MEASURES[1:]:
            low, high = row.get(f"{name}_to_exp_ci95") or (0.0, 0.0)
            stars[f"{name}_star"] = "*" * (low > 0.0 or high < 0.0)
        found.append(row | {"title": title, **stars})
    return sections(found, "{title:md}", _of_set)


def _of_set(rows: list[Row]) -> str:
    frame = pd.DataFrame(rows)
    # Of an even number of settings the upper of the two in the middle.
    times = frame.groupby("simulator", sort=False)["ms"].quantile(0.5, interpolation="higher")
    blocks = [
        f"{rows[0]['num_scenes']} scenes in {rows[0]['num_groups']} source groups.",
        table(
            times.reset_index().to_dict("records"),
            "simulator = `{simulator}` | ms per table = {ms:.1f}",
        ),
    ]
    for heading, content in _HEADINGS.items():
        own = [row for row in rows if cell(row, content)]  # EXP has no difference to itself
        by_simulator = pivot(own, _SOURCE, _SIMULATOR, content)
        blocks += [f"{heading}, by ISO and exposure of the source:", by_simulator]
    if len(terms := rows[0]["terms"]) > 1:
        columns = f"{_SOURCE} | simulator = {_SIMULATOR} | saturated = {{saturated:.1%}}"
        columns += "".join(f" | {name} = {{terms[{name}]:.4f}}" for name in terms)
        isos, evs = (frame[name].agg(["min", "max"]).tolist() for name in ("iso", "ev"))
        ends = [r for r in rows if r["iso"] in isos and r["ev"] in (*evs, 0)]
        shown = table(ends, columns + " | worst term = {worst_term}")
        blocks += ["*Where the error enters*:", shown]
    return "\n\n".join(blocks)
