"""Blind choices between two frames of a scene: pairs to choose from, the file of choices, the fit.

`ae-env judge` says how pairs are drawn; docs/scorers.md, what the fit means.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, ValidationError
from scipy.optimize import minimize
from scipy.special import expit

from ae_env.grid import ExposureGrid
from ae_env.scenes import Scene, load_scenes
from ae_env.scorers.registry import describe_scorers, make_scorer
from ae_env.scorers.score_table import TIE, ScoreTables
from ae_env.scorers.terms import CompositeScorer
from agents.evaluation.evaluation_plan import digest
from agents.evaluation.intervals import LEVEL, MIN_GROUPS, group_weights, score_interval
from agents.evaluation.metrics import group_means
from agents.policy import Floats, Ints
from agents.report.evaluation import to_markdown
from simulator import __version__, get_camera
from simulator.utils.config_file import Configuration, one_line
from simulator.utils.files import result_meta, write_atomically, write_results

Progress = Callable[[float, float], None]
#: Camera that takes the frames, as the environment's default, and its states.
CAMERA, GRID = "nikon_z6", ExposureGrid.default()
#: EV100 of the states in whole stops: nominal times are not quite powers of two.
STOPS = np.round(GRID.ev100).astype(int)
#: Scorers near whose best states the frames are: two of the incident light, one of the picture.
JUDGED = ("balanced", "fidelity", "well_exposedness")
#: Frames of a contested pair differ by this much at most [EV].
MOST_EV = 3
#: Standard deviation of the normal prior of each strength: it bounds that of an exposure that was
#: always or never chosen, and makes the strengths sum to 0.
PRIOR = 3.0
#: Resamples of source groups for the strengths, each of which is fitted again.
RESAMPLES = 1000
#: What the left frame wins by a choice.
_WON = {"left": 1.0, "equal": 0.5, "right": 0.0}


class Choice(Configuration):
    """A pair of frames of one scene, everything that makes them again, and what was chosen."""

    pair: int
    scenes: str
    split: str
    resolution: int
    camera: str = CAMERA
    scene_id: str
    group: str
    content: str  # `Scene.content`
    noise_seed: int
    left: int = Field(ge=0, lt=len(GRID))  # state of the default grid
    left_settings: str
    right: int = Field(ge=0, lt=len(GRID))
    right_settings: str
    plan: str = ""
    judge: str = ""
    choice: Literal["left", "right", "equal"] | None = None
    seconds: float = Field(0.0, ge=0.0, lt=1e9)
    version: str = ""


def judged_scenes(scenes: str, split: Any, resolution: int) -> dict[str, Scene]:
    """The scenes by id; of recorded grids the light that their captures tell together."""
    found = load_scenes(scenes, split, camera=get_camera(CAMERA), resolution=resolution)
    return {scene.scene_id: replace(scene, recorded=None, allowed=None) for scene in found}


def state_scores(scene: Scene, scorers: Sequence[str]) -> Floats:
    """Expected scores (K, S) of a scene at rest under K scorers, at 64 pixels a side."""
    together = CompositeScorer({name: make_scorer(name) for name in scorers})
    small = scene.resized(min(64, *scene.light.shape[1:]))
    table = ScoreTables(GRID, scene.camera, together).table(small)
    return np.stack([table.parts[name] for name in scorers])


def contested_pairs(scores: Floats) -> list[tuple[int, int]]:
    """Pairs of steps of a ladder that are worth a choice, from scores (K, L) of K scorers.

    Both steps lie within a stop of the best of some scorer. Of these: those on whose order the
    scorers differ, at most `MOST_EV` apart; else such of any distance; else all.
    """
    near = np.unique(scores.argmax(axis=1)[:, None] + [-1, 0, 1])
    pairs = list(combinations(near[(near >= 0) & (near < scores.shape[1])].tolist(), 2))
    gains = [scores[:, first] - scores[:, second] for first, second in pairs]
    differ = [bool((gain > TIE).any() and (gain < -TIE).any()) for gain in gains]
    contested = [pair for pair, own in zip(pairs, differ, strict=True) if own]
    return [pair for pair in contested if pair[1] - pair[0] <= MOST_EV] or contested or pairs


def draw_pairs(
    library: Mapping[str, Scene], count: int, seed: int, progress: Progress, **source: Any
) -> list[Choice]:
    """Pairs of scenes from all source groups in turn; `source` says where the scenes are from.

    Of each whole stop only the state of the lowest ISO is shown. The order of the groups, the scene
    of a group, the pair and its sides are drawn; a pair comes again after the others of its scene.
    """
    order = np.lexsort(([state.iso for state in GRID], STOPS))
    ladder = order[np.unique(STOPS[order], return_index=True)[1]]  # the brightest first
    rng, groups, offered = np.random.default_rng(seed), dict[str, list[str]](), dict[str, Any]()
    for scene in library.values():
        groups.setdefault(scene.group, []).append(scene.scene_id)
    turns, drawn = rng.permutation(sorted(groups)), list[Choice]()
    for number in range(count):
        progress(number, count)
        scene = library[rng.choice(groups[turns[number % len(turns)]])]
        if not offered.get(scene.scene_id):
            pairs = contested_pairs(state_scores(scene, JUDGED)[:, ladder])
            offered[scene.scene_id] = rng.permutation(pairs).tolist()
        left, right = ladder[rng.permutation(offered[scene.scene_id].pop())].tolist()
        fields = {"scene_id": scene.scene_id, "group": scene.group, "content": scene.content}
        fields |= {"left_settings": str(GRID[left]), "right_settings": str(GRID[right])}
        states = {"pair": number, "noise_seed": seed, "left": left, "right": right}
        drawn.append(Choice(**states, **fields, **source))
    return drawn


def read_choices(path: Path) -> list[Choice]:
    """The choices in a file, of one judge on one plan; a `ValueError` names the line at fault."""
    line, found = 1, list[Choice]()
    try:
        table = csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"), newline=""))
        if table.fieldnames != list(Choice.model_fields):
            raise ValueError("the columns must be those that `ae-env judge` writes")
        for line, row in enumerate(table, 2):
            own = Choice.model_validate({str(key): value for key, value in row.items()})
            found.append(own)
            if (own.pair, own.plan, own.judge) != (line - 2, found[0].plan, found[0].judge):
                raise ValueError("pairs must follow each other, of one plan and one judge")
    except (ValueError, csv.Error) as error:
        text = one_line(error) if isinstance(error, ValidationError) else error
        raise ValueError(f"`choices` (={str(path)!r}), line {line}: {text}") from error
    return found


class Judging:
    """One judge's choices on a plan, in a file that every choice writes anew, whole or not at all.

    A file that is there already is gone on with; a `ValueError` if it is of other pairs or judges.
    """

    def __init__(self, pairs: Sequence[Choice], path: Path, judge: str) -> None:
        fields = {"plan": digest([pair.model_dump() for pair in pairs]), "judge": judge}
        self.pairs, self._path = [pair.model_copy(update=fields) for pair in pairs], path
        self.choices = read_choices(path) if path.exists() else []
        for i, own in enumerate(self.choices):
            new = {"choice": None, "seconds": 0.0, "version": ""}
            if self.pairs[i : i + 1] != [own.model_copy(update=new)]:
                rule = f"has choices of other pairs, or not of {judge!r}: give another file"
                raise ValueError(f"`out` (={str(path)!r}), line {i + 2}: {rule}")

    @property
    def next_pair(self) -> Choice | None:
        """The first pair that is not chosen from yet; None when all are."""
        return next(iter(self.pairs[len(self.choices) :]), None)

    def choose(self, pair: Choice | None, choice: str, seconds: float) -> None:
        """Keeps the choice from `pair`, unless that is no longer the next one."""
        if pair is not None and pair is self.next_pair:
            new = {"choice": choice, "seconds": round(seconds, 2), "version": __version__}
            self._keep([*self.choices, pair.model_copy(update=new)])

    def undo(self) -> None:
        """Takes the last choice back, if there is one."""
        self._keep(self.choices[:-1])

    def _keep(self, choices: list[Choice]) -> None:
        text = io.StringIO(newline="")
        table = csv.DictWriter(text, list(Choice.model_fields), lineterminator="\n")
        table.writeheader()
        table.writerows(choice.model_dump() for choice in choices)
        write_atomically(self._path, text.getvalue())
        self.choices = choices


# -- what the choices tell ------------------------------------------------------------------------


def bradley_terry(items: Ints, won: Floats, weights: Floats, count: int) -> Floats:
    """Most probable strengths (count,) under a prior of `PRIOR`: log odds, which sum to 0.

    Args:
        items: (N, 2), the two items of each choice.
        won: (N,) what the first won: 1, 0, or 0.5 of a tie.
        weights: (N,) how often each choice counts.
    """
    first, second = items.T

    def loss(strengths: Floats) -> tuple[float, Floats]:
        gain = strengths[first] - strengths[second]
        cost, slope = weights @ (np.logaddexp(0.0, gain) - won * gain), expit(gain) - won
        slopes = np.bincount(first, weights * slope, count)
        slopes = slopes - np.bincount(second, weights * slope, count) + strengths / PRIOR**2
        return float(cost + strengths @ strengths / (2 * PRIOR**2)), slopes

    found: Floats = minimize(loss, np.zeros(count), jac=True, method="L-BFGS-B").x
    return found


def exposure_rows(choices: Sequence[Choice], ev100: Floats) -> list[dict[str, Any]]:
    """A row for each exposure, in whole stops from the right one `ev100` (N,): its strength."""
    states = np.array([(choice.left, choice.right) for choice in choices])
    stops = np.floor(ev100[:, None] - STOPS[states] + 0.5).astype(int)  # brighter is more
    names, items = np.unique(stops, return_inverse=True)
    items, won = items.reshape(stops.shape), np.array([_WON[str(c.choice)] for c in choices])
    groups, group = np.unique([choice.group for choice in choices], return_inverse=True)
    strengths = bradley_terry(items, won, np.ones(len(won)), len(names))
    ends: list[Any] = [None] * len(names)
    if len(groups) >= MIN_GROUPS:
        drawn = group_weights(len(groups), RESAMPLES, 0)[:, group]
        found = [bradley_terry(items, won, weights, len(names)) for weights in drawn]
        ends = np.quantile(found, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0).T.tolist()
    rows = []
    for i, stop in enumerate(names):
        own = (items == i).any(axis=1)
        row = {"kind": "exposure", "name": f"{stop:+d} EV", "value": strengths[i], "ci95": ends[i]}
        rows.append({**row, "choices": own.sum(), "num_groups": len(np.unique(group[own]))})
    return rows


def scorer_rows(choices: Sequence[Choice], scores: Mapping[str, Floats]) -> list[dict[str, Any]]:
    """A row for each scorer, the best first: the share of choices that it agrees with.

    `scores` are (N, 2), of the left and the right frame. Pairs judged equal are left out; two
    frames that a scorer rates alike are half an agreement.
    """
    won = np.array([_WON[str(choice.choice)] for choice in choices])
    decided, rows = won != 0.5, list[dict[str, Any]]()
    groups = np.array([choice.group for choice in choices])[decided]
    if not len(groups):
        raise ValueError("`choices` must have a pair that was not judged equal")
    count = np.unique(groups, return_counts=True)[1].astype(float)
    for name, both in scores.items():
        gain = both[decided, 0] - both[decided, 1]
        agreed = 0.5 + np.where(np.abs(gain) > TIE, (won[decided] - 0.5) * np.sign(gain), 0.0)
        found = score_interval(group_means(agreed, groups) * count, count)
        row = {"kind": "scorer", "name": name, "value": found.value, "ci95": found.pair}
        rows.append({**row, "choices": len(groups), "num_groups": found.num_groups})
    return sorted(rows, key=lambda row: -row["value"])


def write_fit(
    files: Sequence[Path], out: Path, command: str, progress: Progress
) -> dict[str, Path]:
    """Write what the choices in `files` tell: ``judging.json`` and ``judging.md``.

    A `ValueError` if a file is damaged or given twice, or a scene is not the one that was judged.
    """
    choices = [choice for path in files for choice in read_choices(path)]
    if len({(c.plan, c.judge, c.pair) for c in choices}) < max(len(choices), 1):
        rule = "must hold choices, and each of them once"
        raise ValueError(f"`choices` (={[str(path) for path in files]}) {rule}")
    loaded = {s: judged_scenes(*s) for s in {(c.scenes, c.split, c.resolution) for c in choices}}
    names = [row.name for row in describe_scorers() if not row.needs and not row.error]
    known, ev100, scores = dict[int, Floats](), list[float](), list[Floats]()
    for number, c in enumerate(choices):
        progress(number, len(choices))
        scene = loaded[c.scenes, c.split, c.resolution].get(c.scene_id)
        settings = str(GRID[c.left]), str(GRID[c.right])
        judged = c.content, c.camera, (c.left_settings, c.right_settings)
        if scene is None or judged != (scene.content, CAMERA, settings):
            rule = "must be as it was judged, but its light or the states differ here"
            raise ValueError(f"scene {c.scene_id!r} of `choices` (of {c.scenes!r}) {rule}")
        if id(scene) not in known:
            known[id(scene)] = state_scores(scene, names)
        ev100.append(scene.ev100)
        scores.append(known[id(scene)][:, [c.left, c.right]])
    exposures = exposure_rows(choices, np.array(ev100))
    scorers = scorer_rows(choices, dict(zip(names, np.stack(scores, axis=1), strict=True)))
    told = {
        "plans": sorted({c.plan for c in choices}),
        "judges": sorted({c.judge for c in choices}),
    }
    equal = sum(choice.choice == "equal" for choice in choices)
    tables = [
        f"{len(choices)} choices of {len(told['judges'])} judges, {equal} of them equal.\n",
        *(_table(exposures, "exposure", "strength", ".2f"), ""),
        _table(scorers, "scorer", "agreement", ".3f"),
    ]
    meta = {**result_meta(command, None), **told, "choices": len(choices), "equal": equal}
    return {
        "results": write_results(out / "judging.json", [*exposures, *scorers], meta),
        "tables": write_atomically(out / "judging.md", "\n".join(tables) + "\n"),
    }


def _table(rows: Sequence[Mapping[str, Any]], what: str, value: str, form: str) -> str:
    columns = {what: "{name}", value: f"{{value:{form}}}", "95 % interval": f"{{ci95:{form}}}"}
    return to_markdown(rows, {**columns, "choices": "{choices}", "source groups": "{num_groups}"})
