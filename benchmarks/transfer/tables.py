"""Score tables predicted from one noisy raw, against those of the truth.

Each held-out scene is photographed once; a simulator makes the light of every state from that raw,
and the scorer rates them. The true table is of the scene's own light.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from typing import Any, cast

import numpy as np
from scipy.stats import rankdata, spearmanr

from ae_env.options import EnvOptions
from ae_env.scenes import Scene
from ae_env.scenes.load import SceneNetworks, simulate_source_raw
from ae_env.scenes.scene import Crop
from ae_env.scorers.score_table import ScoreTable, ScoreTables
from agents.cli.console import progress_bars
from agents.evaluation.intervals import difference_interval, score_interval
from agents.evaluation.metrics import group_means
from agents.rollouts import RolloutPlan, make_envs
from benchmarks.harness import FinishedParts, Row
from benchmarks.transfer.worlds import (
    EXP,
    RESOLUTION,
    TableSet,
    TransferPlan,
    has_weights,
    held_out,
    simulator_argument,
    training_set,
)

#: What is measured of a predicted table, each the better the smaller but the first.
MEASURES = ("rank_correlation", "regret", "absolute_error")
#: Of every scene: its measures, milliseconds, and the error that each term makes.
Measured = dict[str, Any]
#: Of the parts of a scorer, by name.
Totals = Callable[[Mapping[str, np.ndarray]], np.ndarray]


def table_rows(plan: TransferPlan, finished: FinishedParts, *, seed: int = 0) -> list[Row]:
    """A row for each crop, source ISO, source exposure and simulator.

    Args:
        plan: The plan.
        finished: Keeps what is measured, so that a run that was stopped continues.
        seed: Of motion and defocus, and of the photographs.
    """
    rows: list[Row] = []
    sets = [(part, crop, iso) for part in plan.tables for crop in part.crops for iso in part.isos]
    with progress_bars() as progress, progress("score tables") as task:
        for number, (part, crop, iso) in enumerate(sets):
            name = f"{part.scorer} {crop} ISO {iso}"
            task(number, len(sets), name)
            measure = partial(_measure, plan, part, crop, iso, seed)
            found = finished.get(f"{name} {part} {training_set(plan)}", measure)
            for ev, measured in zip(part.evs, found, strict=True):
                common = {"scorer": part.scorer, "crop": crop, "iso": iso, "ev": ev}
                rows += [common | row for row in summary(measured)]
        task(1, 1)
    return rows


def _measure(
    plan: TransferPlan, part: TableSet, crop: Crop, iso: int, seed: int
) -> list[list[Measured]]:
    return Predictions(plan, part, crop, seed=seed).at(iso, part.evs)


class Predictions:
    """Held-out scenes with their true tables, and what simulators make of photographs of them.

    Args:
        plan: Names the scenes.
        part: The scorer, how many scenes, and the simulators.
        crop: See `TableSet`.
        seed: Of motion and defocus, and of the photographs.
    """

    def __init__(self, plan: TransferPlan, part: TableSet, crop: Crop, *, seed: int = 0) -> None:
        options = EnvOptions(scorer=part.scorer, resolution=RESOLUTION)
        self.seed, self.scenes = seed, held_out(plan, part.scenes, crop)
        self._tables = ScoreTables(
            options.make_grid(), options.make_camera(), options.make_scorer()
        )
        self._moves = drawn_moves(self.scenes, seed)
        self._true = [self._table(i, scene) for i, scene in enumerate(self.scenes)]
        self._simulators: dict[str, SceneNetworks | None] = {}
        for name in filter(has_weights, part.simulators):
            given = simulator_argument(name)
            self._simulators[name] = None if given is None else SceneNetworks(given, cache=False)

    def _table(self, index: int, scene: Scene) -> ScoreTable:
        return self._tables.table(scene, **self._moves[index])

    def at(self, iso: float, evs: Sequence[float]) -> list[list[Measured]]:
        """What is measured of every scene and simulator: a list for each source exposure."""
        return [
            [m for i in range(len(self.scenes)) for m in self._measured(i, iso, ev)] for ev in evs
        ]

    def _measured(self, index: int, iso: float, ev: float) -> list[Measured]:
        scene, true = self.scenes[index], self._true[index]
        taken = simulate_source_raw(scene, seed=self.seed, iso=iso, ev=ev)
        saturated = taken.prepared.saturated_share
        found = []
        for name, networks in self._simulators.items():
            began = time.perf_counter()
            table = self._table(index, _simulated(networks, taken))
            row: Measured = {"simulator": name, "group": scene.group, "saturated": saturated}
            row["ms"] = 1000.0 * (time.perf_counter() - began)
            found.append(row | errors(table, true, self._tables.scorer.totals))
        return found


def _simulated(networks: SceneNetworks | None, taken: Scene) -> Scene:
    return taken if networks is None else networks.denoised(taken)


def drawn_moves(scenes: Sequence[Scene], seed: int) -> list[dict[str, Any]]:
    """Motion and defocus of an episode on each scene, as the environment draws them."""
    options = {"scenes": list(scenes), "resolution": RESOLUTION, "scorer": "sharpness"}
    with closing(make_envs(options, num_envs=min(64, len(scenes)), frames=1)) as envs:
        base: Any = envs.unwrapped
        return [
            base.episode(int(i)).moves
            for batch in RolloutPlan.of_each_scene(scenes, count=1, seed=seed).batches(envs)
            for i in np.flatnonzero(batch.valid)
        ]


def errors(table: ScoreTable, true: ScoreTable, totals: Totals) -> Measured:
    """Measures of a predicted table, over the states that the scene allows.

    Args:
        table: Predicted.
        true: Of the scene's own light.
        totals: Scores (S,) from those of the scorer's parts.

    Returns:
        ``rank_correlation``: Spearman's; ``regret``: what the state that looks best loses in the
        true table; ``absolute_error``: mean over the states; ``terms``: how much of it there is if
        only that part of the scorer is the predicted one.
    """
    allowed = np.ones(len(true.mean), bool) if true.allowed is None else true.allowed
    right = totals(true.parts)
    terms = {
        name: float(np.abs(totals({**true.parts, name: part}) - right)[allowed].mean())
        for name, part in table.parts.items()
    }
    return {
        "rank_correlation": _spearman(table.mean[allowed], true.mean[allowed]),
        "regret": float(true.mean[true.oracle] - true.mean[table.oracle]),
        "absolute_error": float(np.abs(table.mean - true.mean)[allowed].mean()),
        "terms": terms,
    }


def _spearman(first: np.ndarray, second: np.ndarray) -> float:
    """Spearman's correlation; 0 where all states of one table score alike, which tells nothing."""
    if np.ptp(rankdata(first)) == 0.0 or np.ptp(rankdata(second)) == 0.0:
        return 0.0
    return float(cast(Any, spearmanr(first, second)).statistic)


# -- over scenes ----------------------------------------------------------------------------------


def summary(measured: Sequence[Measured]) -> list[Row]:
    """A row for each simulator: means over source groups, and paired differences to EXP."""
    names = list(dict.fromkeys(m["simulator"] for m in measured))
    by_name = {name: [m for m in measured if m["simulator"] == name] for name in names}
    return [_summary(name, by_name) for name in names]


def _summary(name: str, by_name: Mapping[str, Sequence[Measured]]) -> Row:
    own, exp = by_name[name], by_name.get(EXP)
    groups = np.array([m["group"] for m in own])
    row: Row = {"simulator": name, "num_scenes": len(own), "num_groups": len(set(groups))}
    for measure in MEASURES:
        row |= _mean_and_gain(measure, own, None if name == EXP else exp, groups)
    row["terms"] = {
        term: _mean(lambda m, t=term: m["terms"][t], own, groups) for term in own[0]["terms"]
    }
    row["worst_term"] = max(row["terms"], key=row["terms"].__getitem__)
    row["saturated"] = _mean(lambda m: m["saturated"], own, groups)
    return row | {"ms": float(np.median([m["ms"] for m in own]))}


def _mean_and_gain(
    measure: str, own: Sequence[Measured], exp: Sequence[Measured] | None, groups: np.ndarray
) -> Row:
    values = group_means(np.array([m[measure] for m in own]), groups)
    alike = np.ones(len(values))
    mean = score_interval(values, alike)
    row: Row = {measure: mean.value, f"{measure}_ci95": mean.pair}
    if exp is not None:
        other = group_means(np.array([m[measure] for m in exp]), groups)
        difference = difference_interval(values, other, alike)
        row |= {f"{measure}_to_exp": difference.value, f"{measure}_to_exp_ci95": difference.pair}
    return row


def _mean(of: Callable[..., float], own: Sequence[Measured], groups: np.ndarray) -> float:
    return float(group_means(np.array([of(m) for m in own]), groups).mean())
