"""Blind choices between two frames of a scene: the pairs, their file, and what it tells."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ae_env.grid import ExposureGrid
from ae_env.scenes import Scene, load_scenes
from ae_env.scorers.registry import describe_scorers, make_scorer
from ae_env.scorers.score_table import TIE, ScoreTables
from agents.evaluation.intervals import ENDS, MIN_GROUPS, group_weights, score_interval
from agents.evaluation.metrics import group_means
from agents.policy import Floats
from agents.report.evaluation import to_markdown
from simulator import __version__, get_camera
from simulator.utils.files import read_table, result_meta, write_atomically, write_results

#: Columns that a choice fills; the others make the pair again.
FILLED = ["choice", "seconds", "version"]
#: Camera that takes the frames, its states, and their EV100 in whole stops.
CAMERA, GRID = "nikon_z6", ExposureGrid.default()
STOPS = np.round(GRID.ev100).astype(int)
#: Scorers near whose best states the frames are: two of the incident light, one of the picture.
JUDGED = ("balanced", "fidelity", "well_exposedness")
#: Largest difference of two frames [EV].
MOST_EV = 3
#: Wins of either of any two exposures before there is a choice: none wins or loses for sure.
PRIOR = 0.1
#: Resamples of source groups for the strengths, and passes of each fit.
RESAMPLES, PASSES = 1000, 200
#: What the left frame wins by a choice.
WON = {"left": 1.0, "equal": 0.5, "right": 0.0}


def judged_scenes(scenes: str, split: Any, resolution: int) -> dict[str, Scene]:
    """The scenes by id; of recorded grids the light that their captures tell together."""
    found = load_scenes(scenes, split, camera=get_camera(CAMERA), resolution=resolution)
    return {scene.scene_id: replace(scene, recorded=None, allowed=None) for scene in found}


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
    library: Mapping[str, Scene], count: int, seed: int, progress: Callable[..., None], **more: Any
) -> pd.DataFrame:
    """Pairs of scenes from all source groups in turn, nothing chosen yet; `more` are columns.

    Of each whole stop only the state of the lowest ISO is shown. The order of the groups, the scene
    of a group, the pair and its sides are drawn; a pair comes again after the others of its scene.
    Each frame is scored by every scorer that needs no file or extra, as expected of it at 64 pixels
    a side.
    """
    order = np.lexsort((np.array([state.iso for state in GRID]), STOPS))
    ladder = order[np.unique(STOPS[order], return_index=True)[1]]  # the brightest first
    names = [row.name for row in describe_scorers() if not row.needs and not row.error]
    together = make_scorer(dict.fromkeys(names, 1.0))
    tables: dict[str, Mapping[str, Floats]] = {}
    rng, groups, offered = np.random.default_rng(seed), dict[str, list[str]](), dict[str, Any]()
    for scene in library.values():
        groups.setdefault(scene.group, []).append(scene.scene_id)
    turns, rows = rng.permutation(sorted(groups)), list[dict[str, Any]]()
    for number in range(count):
        progress(number, count)
        scene = library[rng.choice(groups[turns[number % len(turns)]])]
        if scene.scene_id not in tables:
            small = scene.resized(min(64, *scene.light.shape[1:]))
            tables[scene.scene_id] = ScoreTables(GRID, scene.camera, together).table(small).parts
        table = tables[scene.scene_id]
        if not offered.get(scene.scene_id):
            pairs = contested_pairs(np.stack([table[name] for name in JUDGED])[:, ladder])
            offered[scene.scene_id] = rng.permutation(pairs).tolist()
        sides = ladder[rng.permutation(offered[scene.scene_id].pop())].tolist()
        row = {"pair": number, "seed": seed, **more, "camera": CAMERA, "scene_id": scene.scene_id}
        row |= {"group": scene.group, "content": scene.content, "ev100": scene.ev100}
        for side, state in zip(("left", "right"), sides, strict=True):
            row |= {side: state, f"{side} settings": str(GRID[state])}
            row |= {f"{name}:{side}": f"{values[state]:.6g}" for name, values in table.items()}
        rows.append(row)
    return pd.DataFrame(rows).astype(str)


def read_choices(path: Path) -> pd.DataFrame:
    """One judge's pairs in a file, as texts; a `ValueError` that names what is wrong in it."""
    found, start = read_table(path), f"`choices` (={str(path)!r}) must"
    used = {*FILLED, "judge", "pair", "scene_id", "group", "content", "ev100", "left", "right"}
    used |= {re.sub("left$", "right", name) for name in found.filter(regex=":left$")}
    if not used <= set(found) or not set(found.choice) <= {*WON, ""} or found.judge.nunique() != 1:
        raise ValueError(f"{start} be a whole file of `ae-env judge`")
    numbers = found.filter(regex="^(ev100|left|right)$|:(left|right)$").apply(
        pd.to_numeric, errors="coerce"
    )
    wrong, sides = ~np.isfinite(numbers), numbers[["left", "right"]]
    wrong[["left", "right"]] = ~sides.mask(sides.left == sides.right).isin(range(len(GRID)))
    if (rows := wrong.any(axis=1)).any():
        row, name = rows.idxmax(), wrong.loc[rows.idxmax()].idxmax()
        rule = f"have finite numbers and two states from 0 to {len(GRID) - 1} in each row"
        raise ValueError(f"{start} {rule}; row {row + 2}, {name!r} has {found[name][row]!r}")
    return found


class Judging:
    """One judge's pairs in a file that every choice writes anew, whole or not at all.

    A file that is there is gone on with; else it begins with the pairs that `draw` makes. A
    `ValueError` if it is another judge's, or of a scene that is another one in `library`.
    """

    def __init__(
        self, path: Path, judge: str, library: Mapping[str, Scene], draw: Callable[[], pd.DataFrame]
    ) -> None:
        self.path = path
        if path.exists():
            self.pairs = read_choices(path)
        else:
            self._write(draw().assign(judge=judge, **dict.fromkeys(FILLED, "")))
        known = pd.Series({scene_id: scene.content for scene_id, scene in library.items()})
        same = self.pairs.scene_id.map(known) == self.pairs.content
        if self.pairs.judge[0] != judge or not same.all():
            rule = f"must have pairs of these scenes by {judge!r}, or not be there yet"
            raise ValueError(f"`out` (={str(path)!r}) {rule}")

    @property
    def done(self) -> int:
        """Pairs that are chosen from, and so the number of the next."""
        return int((self.pairs.choice != "").cumprod().sum())

    def choose(self, number: int, choice: str, seconds: float) -> None:
        """Keeps the choice from pair `number`, unless that is no longer the next one."""
        if number == self.done < len(self.pairs):
            self._fill(number, choice, f"{seconds:.2f}", __version__)

    def undo(self) -> None:
        """Takes the last choice back, if there is one."""
        if self.done:
            self._fill(self.done - 1, "", "", "")

    def _fill(self, number: int, *values: str) -> None:
        pairs = self.pairs.copy()
        pairs.loc[number, FILLED] = values
        self._write(pairs)

    def _write(self, pairs: pd.DataFrame) -> None:
        write_atomically(self.path, pairs.to_csv(index=False, lineterminator="\n"))
        self.pairs = pairs


# -- what the choices tell ------------------------------------------------------------------------


def bradley_terry(wins: Floats) -> Floats:
    """Strengths (..., n), log odds of mean 0, from how often each item (..., n, n) beat each other.

    By minorisation and maximisation (Hunter 2004), with `PRIOR` wins of each over each.
    """
    wins = wins + PRIOR * (1.0 - np.eye(wins.shape[-1]))
    games, odds = wins + wins.swapaxes(-1, -2), np.ones(wins.shape[:-1])
    for _ in range(PASSES):
        odds = wins.sum(axis=-1) / (games / (odds[..., None] + odds[..., None, :])).sum(axis=-1)
        odds /= np.exp(np.log(odds).mean(axis=-1, keepdims=True))
    return np.log(odds)


def exposure_rows(choices: pd.DataFrame) -> list[dict[str, Any]]:
    """A row for each exposure, in whole stops from the right one: its strength."""
    shown = STOPS[choices[["left", "right"]].astype(int)]
    stops = np.floor(choices.ev100.astype(float).to_numpy()[:, None] - shown + 0.5)
    names, items = np.unique(stops, return_inverse=True)  # brighter is more
    (left, right), won = items.reshape(stops.shape).T, choices.choice.map(WON).to_numpy()
    groups, group = np.unique(choices.group, return_inverse=True)
    wins, rows = np.zeros((len(groups), len(names), len(names))), list[dict[str, Any]]()
    np.add.at(wins, (group, left, right), won)
    np.add.at(wins, (group, right, left), 1.0 - won)
    drawn = np.tensordot(group_weights(len(groups), RESAMPLES, 0), wins, axes=1)
    ends = np.quantile(bradley_terry(drawn), ENDS, axis=0).T
    for stop, value, pair in zip(names, bradley_terry(wins.sum(0)), ends.tolist(), strict=True):
        own = (stops == stop).any(axis=1)
        rows.append(_row(f"{stop:+.0f} EV", value, pair, choices.group[own]))
    return rows


def scorer_rows(choices: pd.DataFrame) -> list[dict[str, Any]]:
    """A row for each scorer, the best first: the share of choices that it agrees with.

    Pairs judged equal are left out; two frames that a scorer rates alike are half an agreement.
    """
    decided = choices[choices.choice != "equal"]
    won, groups, rows = decided.choice.map(WON).to_numpy(), decided.group.to_numpy(), []
    count = np.unique(groups, return_counts=True)[1].astype(float)
    for name in choices.filter(like=":left").columns.str.removesuffix(":left"):
        gain = decided[f"{name}:left"].astype(float) - decided[f"{name}:right"].astype(float)
        agreed = 0.5 + np.where(np.abs(gain) > TIE, (won - 0.5) * np.sign(gain), 0.0)
        found = score_interval(group_means(agreed, groups) * count, count)
        rows.append(_row(name, found.value, found.pair, decided.group))
    return sorted(rows, key=lambda row: -row["value"])


def _row(name: str, value: float, ci95: Any, groups: pd.Series[str]) -> dict[str, Any]:
    count = {"choices": len(groups), "num_groups": (seen := groups.nunique())}
    return {"name": name, "value": value, "ci95": ci95 if seen >= MIN_GROUPS else None, **count}


def write_fit(files: Sequence[Path], out: Path, command: str) -> list[Path]:
    """Write what the choices in `files` tell: ``judging.json`` and ``judging.md``.

    A `ValueError` if a file is damaged or given twice, or holds no choice of one of two frames.
    """
    together = pd.concat([read_choices(path) for path in files], ignore_index=True)
    choices, start = together.dropna(axis=1), f"`choices` (={[str(path) for path in files]}) must"
    if choices.duplicated(choices.columns.difference(FILLED)).any():
        raise ValueError(f"{start} have each judge's pair once: is `judge` the same in two files?")
    choices = choices[choices.choice != ""]
    equal = int((choices.choice == "equal").sum())
    if equal == len(choices):
        raise ValueError(f"{start} hold a choice of one of two frames")
    judges, rows = sorted(set(choices.judge)), []
    text = f"{len(choices)} choices by {', '.join(judges)}, {equal} of them equal.\n"
    if absent := ", ".join(together.columns.difference(choices.columns)):
        text += f"\nNot in every file, and so left out: {absent}.\n"
    for kind, value, found in (
        ("exposure", "strength", exposure_rows(choices)),
        ("scorer", "agreement", scorer_rows(choices)),
    ):
        columns = {kind: "{name}", value: "{value:.3f}", "95 % interval": "{ci95:.3f}"}
        columns |= {"choices": "{choices}", "source groups": "{num_groups}"}
        text += f"\n{to_markdown(found, columns)}\n"
        rows += [{"kind": kind, **row} for row in found]
    meta = result_meta(command, None) | {"judges": judges, "equal": equal}
    results = write_results(out / "judging.json", rows, meta)
    return [results, write_atomically(out / "judging.md", text)]
