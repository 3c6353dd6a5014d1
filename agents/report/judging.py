"""Blind choices between two frames of a scene: the pairs, the file of choices, what they tell."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import minimize
from scipy.special import expit

from ae_env.grid import ExposureGrid
from ae_env.scenes import Scene, load_scenes
from ae_env.scorers.registry import describe_scorers, make_scorer
from ae_env.scorers.score_table import TIE, ScoreTables
from agents.evaluation.evaluation_plan import digest
from agents.evaluation.intervals import LEVEL, MIN_GROUPS, group_weights, score_interval
from agents.evaluation.metrics import group_means
from agents.policy import Floats, Ints
from agents.report.evaluation import to_markdown
from simulator import __version__, get_camera
from simulator.utils.files import result_meta, write_atomically, write_results

Progress = Callable[[float, float], None]
#: A pair of frames of one scene, with all that makes them again, and what was chosen.
Row = dict[str, Any]
#: Columns of the file: `content` is `Scene.content`, `left` and `right` are states of `GRID`.
COLUMNS = (
    *("pair", "scenes", "split", "resolution", "camera", "scene_id", "group", "content"),
    *("noise_seed", "left", "left_settings", "right", "right_settings", "plan", "judge"),
    *("choice", "seconds", "version"),
)
_INTEGERS = ("pair", "resolution", "noise_seed", "left", "right")
_TYPES = dict.fromkeys(COLUMNS, str) | dict.fromkeys(_INTEGERS, int) | {"seconds": float}
#: Camera that takes the frames, its states, and their EV100 in whole stops.
CAMERA, GRID = "nikon_z6", ExposureGrid.default()
STOPS = np.round(GRID.ev100).astype(int)
#: Scorers near whose best states the frames are: two of the incident light, one of the picture.
JUDGED = ("balanced", "fidelity", "well_exposedness")
#: Largest difference of two frames [EV].
MOST_EV = 3
#: Standard deviation of the strengths' normal prior: an exposure may be always or never chosen.
PRIOR = 3.0
#: Resamples of source groups for the strengths, each of which is fitted again.
RESAMPLES = 1000
#: What the left frame wins by a choice.
WON = {"left": 1.0, "equal": 0.5, "right": 0.0}


def judged_scenes(scenes: str, split: Any, resolution: int) -> dict[str, Scene]:
    """The scenes by id; of recorded grids the light that their captures tell together."""
    found = load_scenes(scenes, split, camera=get_camera(CAMERA), resolution=resolution)
    return {scene.scene_id: replace(scene, recorded=None, allowed=None) for scene in found}


def state_scores(scene: Scene, scorers: Sequence[str]) -> Floats:
    """Expected scores (K, S) of a scene at rest under K scorers, at 64 pixels a side."""
    together = make_scorer(dict.fromkeys(scorers, 1.0))
    small = scene.resized(min(64, *scene.light.shape[1:]))
    return np.stack([*ScoreTables(GRID, scene.camera, together).table(small).parts.values()])


def contested_pairs(scores: Floats) -> list[tuple[int, int]]:
    """Pairs of steps of a ladder that are worth a choice, from scores (K, L) of K scorers.

    Both steps lie within a stop of the best of some scorer, and at most `MOST_EV` apart; where
    there are such pairs, the scorers differ on their order.
    """
    near = np.unique(scores.argmax(axis=1)[:, None] + [-1, 0, 1])
    near = near[(near >= 0) & (near < scores.shape[1])]
    pairs = [(i, j) for i, j in combinations(near.tolist(), 2) if j - i <= MOST_EV]
    differ = [(i, j) for i, j in pairs if np.ptp(np.sign(scores[:, i] - scores[:, j])) == 2]
    return differ or pairs


def draw_pairs(
    library: Mapping[str, Scene], count: int, seed: int, progress: Progress, **source: Any
) -> list[Row]:
    """Pairs of scenes from all source groups in turn; `source` says where the scenes are from.

    Of each whole stop only the state of the lowest ISO is shown. The order of the groups, the scene
    of a group, the pair and its sides are drawn; a pair comes again after the others of its scene.
    """
    order = np.lexsort((np.array([state.iso for state in GRID]), STOPS))
    ladder = order[np.unique(STOPS[order], return_index=True)[1]]  # the brightest first
    rng, groups, offered = np.random.default_rng(seed), dict[str, list[str]](), dict[str, Any]()
    for scene in library.values():
        groups.setdefault(scene.group, []).append(scene.scene_id)
    turns, drawn = rng.permutation(sorted(groups)), list[Row]()
    for number in range(count):
        progress(number, count)
        scene = library[rng.choice(groups[turns[number % len(turns)]])]
        if not offered.get(scene.scene_id):
            pairs = contested_pairs(state_scores(scene, JUDGED)[:, ladder])
            offered[scene.scene_id] = rng.permutation(pairs).tolist()
        left, right = ladder[rng.permutation(offered[scene.scene_id].pop())].tolist()
        row = source | {"pair": number, "camera": CAMERA, "noise_seed": seed}
        row |= {"scene_id": scene.scene_id, "group": scene.group, "content": scene.content}
        row |= {"left": left, "left_settings": _settings(left)}
        drawn.append(row | {"right": right, "right_settings": _settings(right)})
    plan = digest(drawn)
    return [row | {"plan": plan} for row in drawn]


def _settings(state: int) -> str:
    """ISO, exposure time [s] and f-number."""
    own = GRID[state]
    return f"{own.iso} {own.exposure_time} {own.f_number}"


def read_choices(path: Path) -> pd.DataFrame:
    """The choices in a file, of one judge on one plan; a `ValueError` if it is damaged."""
    try:
        found = pd.read_csv(path, dtype=_TYPES, keep_default_na=False)
        plans = found[["plan", "judge"]].drop_duplicates()
        sound = (*found.columns,) == COLUMNS and len(plans) < 2 and set(found.choice) <= WON.keys()
        inside = found[["left", "right"]].isin(range(len(GRID))).all(axis=None)
        if (
            not (sound and inside)
            or found.isna().any(axis=None)
            or [*found.pair] != [*range(len(found))]
        ):
            raise ValueError("its rows are not those of one judge on one plan")
    except (ValueError, KeyError) as error:
        rule = "must be a whole file of `ae-env judge`"
        raise ValueError(f"`choices` (={str(path)!r}) {rule}: {error}") from error
    return found


class Judging:
    """One judge's choices, in a file that every choice writes anew, whole or not at all.

    A file that is there already is gone on with; a `ValueError` if it is of other pairs or judges.
    """

    def __init__(self, pairs: Sequence[Row], path: Path, judge: str) -> None:
        self.pairs, self._path = [row | {"judge": judge} for row in pairs], path
        self.choices = read_choices(path).to_dict("records") if path.exists() else []
        shown = [{key: own[key] for key in self.pairs[0]} for own in self.choices]
        if shown != self.pairs[: len(shown)]:
            rule = f"must have choices of these pairs by {judge!r}, or not be there yet"
            raise ValueError(f"`out` (={str(path)!r}) {rule}")

    def next_pair(self) -> Row | None:
        """The first pair that is not chosen from yet; None when all are."""
        return next(iter(self.pairs[len(self.choices) :]), None)

    def choose(self, pair: Row | None, choice: str, seconds: float) -> None:
        """Keeps the choice from `pair`, unless that is no longer the next one."""
        if pair is not None and pair is self.next_pair():
            own = {"choice": choice, "seconds": round(seconds, 2), "version": __version__}
            self._keep([*self.choices, pair | own])

    def undo(self) -> None:
        """Takes the last choice back, if there is one."""
        self._keep(self.choices[:-1])

    def _keep(self, choices: list[Any]) -> None:
        text = pd.DataFrame(choices, columns=list(COLUMNS)).to_csv(index=False, lineterminator="\n")
        write_atomically(self._path, text)
        self.choices = choices


# -- what the choices tell ------------------------------------------------------------------------


def bradley_terry(items: Ints, won: Floats, weights: Floats, count: int) -> Floats:
    """Most probable strengths (count,) under a prior of `PRIOR`: log odds, which sum to 0.

    Of the two `items` (N, 2) of each choice the first `won` (N,) 1, 0, or 0.5 of a tie; each choice
    counts as often as its `weights` (N,) say.
    """
    first, second = items.T

    def loss(strengths: Floats) -> tuple[float, Floats]:
        gain = strengths[first] - strengths[second]
        cost, slope = (
            weights @ (np.logaddexp(0.0, gain) - won * gain),
            weights * (expit(gain) - won),
        )
        slopes = np.bincount(first, slope, count) - np.bincount(second, slope, count)
        return cost + strengths @ strengths / (2 * PRIOR**2), slopes + strengths / PRIOR**2

    found: Floats = minimize(loss, np.zeros(count), jac=True, method="L-BFGS-B").x
    return found


def exposure_rows(choices: pd.DataFrame, ev100: Floats) -> list[Row]:
    """A row for each exposure, in whole stops from the right one `ev100` (N,): its strength."""
    stops = np.floor(ev100[:, None] - STOPS[choices[["left", "right"]].to_numpy()] + 0.5)
    names, items = np.unique(stops, return_inverse=True)  # brighter is more
    items, won = items.reshape(stops.shape), np.array([WON[own] for own in choices.choice])
    groups, group = np.unique(choices.group, return_inverse=True)
    ends: list[Any] = [None] * len(names)
    if len(groups) >= MIN_GROUPS:
        drawn = group_weights(len(groups), RESAMPLES, 0)[:, group]
        found = [bradley_terry(items, won, weights, len(names)) for weights in drawn]
        ends = np.quantile(found, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0).T.tolist()
    strengths = bradley_terry(items, won, np.ones(len(won)), len(names))
    own = [group[(items == i).any(axis=1)] for i in range(len(names))]
    rows = zip([f"{stop:+.0f} EV" for stop in names], strengths, ends, own, strict=True)
    return [_row("exposure", *row) for row in rows]


def scorer_rows(choices: pd.DataFrame, scores: Mapping[str, Floats]) -> list[Row]:
    """A row for each scorer, the best first: the share of choices that it agrees with.

    `scores` are (N, 2), of the left and the right frame. Pairs judged equal are left out; two
    frames that a scorer rates alike are half an agreement.
    """
    decided = (choices.choice != "equal").to_numpy()
    won, groups = choices.choice.map(WON).to_numpy()[decided], choices.group.to_numpy()[decided]
    if not len(groups):
        raise ValueError("`choices` must have a pair that was not judged equal")
    count, rows = np.unique(groups, return_counts=True)[1].astype(float), list[Row]()
    for name, both in scores.items():
        gain = both[decided, 0] - both[decided, 1]
        agreed = 0.5 + np.where(np.abs(gain) > TIE, (won - 0.5) * np.sign(gain), 0.0)
        found = score_interval(group_means(agreed, groups) * count, count)
        rows.append(_row("scorer", name, found.value, found.pair, groups))
    return sorted(rows, key=lambda row: -row["value"])


def _row(kind: str, name: str, value: float, ci95: Any, groups: Any) -> Row:
    row = {"kind": kind, "name": name, "value": value, "ci95": ci95}
    return {**row, "choices": len(groups), "num_groups": len(np.unique(groups))}


def write_fit(files: Sequence[Path], out: Path, command: str, progress: Progress) -> list[Path]:
    """Write what the choices in `files` tell: ``judging.json`` and ``judging.md``.

    A `ValueError` if a file is damaged or given twice, or a scene is not the one that was judged.
    """
    choices = pd.concat([read_choices(path) for path in files], ignore_index=True)
    if choices.empty or choices.duplicated(["plan", "judge", "pair"]).any():
        rule = "must hold choices, and each of them once"
        raise ValueError(f"`choices` (={[str(path) for path in files]}) {rule}")
    names = [row.name for row in describe_scorers() if not row.needs and not row.error]
    ev100, scores, done = np.zeros(len(choices)), np.zeros((len(names), len(choices), 2)), 0
    source: Any
    for source, shown in choices.groupby(["scenes", "split", "resolution"]):
        scenes = judged_scenes(*source)
        for scene_id, own in shown.groupby("scene_id"):
            progress(done := done + len(own), len(choices))
            scene, sides = scenes.get(str(scene_id)), own[["left", "right"]]
            here = own.assign(camera=CAMERA, content=getattr(scene, "content", ""))
            here[["left_settings", "right_settings"]] = sides.map(_settings)
            if scene is None or not here.equals(own):
                rule = "must be as it was judged, but its light or the states differ here"
                raise ValueError(f"scene {scene_id!r} of `choices` (of {source[0]!r}) {rule}")
            ev100[own.index] = scene.ev100
            scores[:, own.index] = state_scores(scene, names)[:, sides.to_numpy()]
    by_scorer = dict(zip(names, scores, strict=True))
    told = {"strength": exposure_rows(choices, ev100), "agreement": scorer_rows(choices, by_scorer)}
    judges, equal = sorted(set(choices.judge)), int((choices.choice == "equal").sum())
    meta = {"judges": judges, "plans": sorted(set(choices.plan)), "equal": equal}
    text = f"{len(choices)} choices by {', '.join(judges)}, {equal} of them equal.\n"
    for value, rows in told.items():
        columns = {rows[0]["kind"]: "{name}", value: "{value:.3f}", "95 % interval": "{ci95:.3f}"}
        columns |= {"choices": "{choices}", "source groups": "{num_groups}"}
        text += f"\n{to_markdown(rows, columns)}\n"
    rows = [*told["strength"], *told["agreement"]]
    results = write_results(out / "judging.json", rows, result_meta(command, None) | meta)
    return [results, write_atomically(out / "judging.md", text)]
