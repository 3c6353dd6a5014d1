"""AE-Bench: a fixed plan with the hash of its scenes, and the table that others add to."""

from __future__ import annotations

import csv
import datetime
import io
import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ae_env.scenes.polyhaven import list_assets
from agents.evaluation import metrics
from agents.evaluation.bracket_plan import BracketPlan, BracketResult, load_bench_plan
from agents.evaluation.evaluation_plan import EvaluationPlan, digest
from agents.evaluation.intervals import Rank
from agents.policy_names import split_class, split_options
from agents.report.markdown import escape, markdown_table
from agents.report.result_table import Results
from simulator.utils.files import write_atomically
from simulator.utils.results import machine, versions

if TYPE_CHECKING:
    from torch import Tensor

    from ae_env.scenes import Scene

logger = logging.getLogger(__name__)
#: The plan of a task of a benchmark.
BenchPlan = EvaluationPlan | BracketPlan

#: The scenes' light is hashed as means of so many blocks a side, to so many EV: a scene that was
#: made otherwise is noticed, the last bit of another processor's arithmetic is not.
BLOCKS, STEP_EV = 4, 0.1
#: Raised when an episode or its score is made otherwise. 2: depth and motion of each pixel, terms
#: that are measured on the capture.
RULES = 2
#: Kinds of policies whose names have a file's or folder's path behind the colon.
_WITH_FILES = ("ppo", "regression", "bracket", "recorded")
COLUMNS = (
    *("task", "policy", "observation", "author", "date", "score", "ci95_low", "ci95_high"),
    *("procedural", "real", "regret", "ev_within_third", "frames_to_converge", "converged"),
    *("reversals", "jump", "clipped_high", "clipped_low", "log_error", "unseen", "frames"),
    *("ms_alone", "cpu", "training_seeds", "version", "hash"),
)
#: Columns that hold no numbers.
_TEXT = ("task", "policy", "observation", "author", "date", "cpu", "version", "hash")
#: What identifies a row.
_KEY = ("task", "policy", "observation", "author")
#: Metrics of a row that are means over all conditions.
_MEANS = (
    *("regret", "ev_within_third", "frames_to_converge", "converged", "reversals", "jump"),
    *("clipped_high", "clipped_low"),
)
#: The tables of a page: their tasks, what is said of each, and its columns by heading.
_COMMON = {"policy": "policy", "sees": "observation", "score": "score", "95 % interval": "ci95"}
_SCENES = {"procedural": "procedural", "real": "real"}
_LAST = {"ms alone": "ms_alone", "seeds": "training_seeds", "author": "author", "date": "date"}
_FRAMES = {
    "regret": "regret",
    "within 1/3 EV": "ev_within_third",
    "frames to converge": "frames_to_converge",
    "converged": "converged",
    "reversals": "reversals",
    "jump": "jump",
    "white": "clipped_high",
}
_TABLES = {
    "still": (
        "Still: `AutoExposure-v0`",
        "Score: normalised over all conditions, each with the same weight; 0 is a random policy, "
        "1 the best state of every frame in that frame's own light.",
        {**_COMMON, **_SCENES, **_FRAMES, **_LAST},
    ),
    "video": (
        "Video: `AutoExposureVideo-v0`",
        "Score: as above. Nobody reaches 1, as the light to come must be guessed: "
        "`oracle:last_frame`, which is not ranked, knows that of the frame in hand.",
        {**_COMMON, **_SCENES, **_FRAMES, **_LAST},
    ),
    "bracket": (
        "Bracket: `ExposureBracket-v0`",
        "Score: quality of the merged picture, 1 - mean error / 2 EV, over all time budgets.",
        {
            **_COMMON,
            **_SCENES,
            "error [EV]": "log_error",
            "unseen": "unseen",
            "frames": "frames",
            **_LAST,
        },
    ),
}
_PERCENT = ("ev_within_third", "converged", "clipped_high", "unseen")
#: What tells a page that this module wrote.
_MARK = "<!-- written by `ae-env evaluate --append`"
_PAGE = """\
# AE-Bench v2

<!-- written by `ae-env evaluate --append`; the numbers are in the CSV file -->

40 scenes that nothing was trained on: 24 of the procedural generators, and a view of each of the \
16 real places of the test split (`ae-env scenes download` fetches them). Three tasks, each a \
preset of `configs/evaluation`; what the columns mean: [evaluation.md](evaluation.md). Times are \
those of each row's own machine (`cpu` in the CSV file). [AE-Bench v1](ae-bench/v1.md) is \
superseded.

Add your own policy with one command for each task that it is for:

    ae-env evaluate --preset ae_bench_v2_still --policy my.py:Mine \\
        --append {table} --author "Your name"

`_still`, `_video` or `_bracket`; `--observation statistics` shows the policy the statistics of an \
image processor in place of pixels. A row replaces the one of the same task, policy, observation \
and author, where there is one, and no other. Send it as a pull request with the two files that \
the command changes, `{table}` and `{page}`, and, if it may be public, the policy's file.

The plans of all tasks, their scenes and the rules of the environment have the hash `{hash}`, \
which every row carries; a run under another one is refused.

{tables}
"""


def scene_signature(scene: Scene) -> list[Any]:
    """JSON values that identify a scene: names, right exposure, light and defocus in blocks.

    Args:
        scene: At the resolution of the plan.
    """
    means = _blocks(scene.light.double().clamp(min=2.0**-20))
    exposed = np.log2(means) - scene.reference.log2_exposure
    codes = np.rint(exposed / STEP_EV).astype(int)
    ev, layout = round(scene.ev100, 2), scene.layout
    planes = [] if layout is None else [layout.defocus[None]]
    if layout is not None and layout.subject is not None:
        planes.append(layout.mask)
    places = [np.rint(_blocks(plane) / 0.1).astype(int).tolist() for plane in planes]
    return [scene.scene_id, scene.group, scene.kind, bool(scene.hard), ev, codes.tolist(), places]


def _blocks(planes: Tensor) -> NDArray[Any]:
    """Means over blocks of each plane (P, H, W), (P, BLOCKS, BLOCKS)."""
    height, width = (size // BLOCKS * BLOCKS for size in planes.shape[1:])
    shape = (len(planes), BLOCKS, height // BLOCKS, BLOCKS, width // BLOCKS)
    means: NDArray[Any] = planes[:, :height, :width].numpy().reshape(shape).mean(axis=(2, 4))
    return means


def bench_hash(plan: BenchPlan, scenes: Sequence[Scene]) -> str:
    """sha256 of the plan, or of all plans of its suite, of its scenes, and of `RULES`."""
    protocols: Any = plan.protocol()
    if plan.suite:
        protocols = [_shared(load_bench_plan(name)) for name in plan.suite]
    return digest(RULES, protocols, [scene_signature(scene) for scene in scenes])


def _shared(plan: BenchPlan) -> dict[str, Any]:
    """What decides the episodes of a plan of a suite: a policy may choose what it is shown."""
    protocol = plan.protocol()
    shown = {k: v for k, v in protocol["environment"].items() if k != "observation"}
    return {**protocol, "environment": shown}


def check_hash(plan: BenchPlan, scenes: Sequence[Scene]) -> None:
    """Checks that a benchmark is still the one that its hash was written down for.

    Raises:
        ValueError: If it is not.
    """
    if plan.hash is None:
        return
    found = bench_hash(plan, scenes)
    if found != plan.hash:
        raise ValueError(
            f"`hash` of {plan.name!r} is {plan.hash}, but the plan and the light of its scenes "
            f"give {found}: the plan or what makes the scenes has changed, so results would not "
            "compare with the published ones; a changed benchmark needs a new name and hash"
        )


def row_name(policy: str) -> str:
    """A policy's name as the table has it: without the folder of a file of one's own.

    >>> row_name("u/my.py:Mine?gain=2"), row_name("ppo:runs/mine"), row_name("matrix:P")
    ('my.py:Mine?gain=2', 'ppo:mine', 'matrix:P')
    """
    base, _ = split_options(policy)
    options = policy[len(base) :]
    head, tail = split_class(base)
    if head.endswith(".py"):
        return f"{Path(head).name}:{tail}{options}"
    if head in _WITH_FILES and tail:
        return f"{head}:{Path(tail).name}{options}"
    return policy


def check_append(table: Path, plan: BenchPlan, policies: Sequence[str], *, author: str) -> None:
    """Checks that rows of `policies` can be added to a table, before they are measured.

    Args:
        table: CSV with `COLUMNS`, or a file to be made.
        plan: The plan of one of the benchmark's tasks.
        policies: Those that get a row.
        author: Who made them.

    Raises:
        ValueError: If `plan` is of no benchmark that takes rows, `table` is no benchmark's table or
            has rows of another hash, no policy gets a row, two would get the same one, or a row
            without an author would be replaced.
    """
    if plan.task not in _TABLES:
        raise ValueError(
            f"`append` (={str(table)!r}): {plan.name} takes no rows any more, AE-Bench v2 has "
            "superseded it: --preset ae_bench_v2_still"
        )
    rows = _rows_of_hash(table, plan)
    if page_of(table) == table:
        raise ValueError(f"`append` (={str(table)!r}) must be a CSV file, such as mine.csv")
    page = page_of(table)
    if page.is_file() and _MARK not in page.read_text(encoding="utf-8", errors="replace"):
        raise ValueError(
            f"`append` (={str(table)!r}) would replace {page}, which is not a benchmark's page: "
            "give the table another name"
        )
    if not policies:
        raise ValueError(
            f"`append` (={str(table)!r}): none of the policies gets a row, since privileged "
            "policies, such as 'oracle', are not ranked"
        )
    seen: dict[str, str] = {}
    for policy in policies:
        name = row_name(policy)
        if name in seen:
            raise ValueError(
                f"`policy` (={policy!r}) and {seen[name]!r} would have the same row {name!r} of "
                f"{table}: rename a file"
            )
        seen[name] = policy
        if not author.strip() and (plan.task, name, plan.observation, "") in rows:
            raise ValueError(
                f"`author` (={author!r}) must be given: {table} has a row of {name!r} without an "
                "author, which may be another's"
            )


def append_rows(
    table: Path, plan: BenchPlan, found: Sequence[Mapping[str, Any]], *, author: str
) -> dict[str, Path]:
    """Adds rows to a benchmark's table, and writes its page again.

    A row of the same task, policy, observation and author is replaced, which is logged; others
    stay.

    Args:
        table: CSV with `COLUMNS`; made where missing.
        plan: The plan of the task.
        found: ``policy`` and the numbers of each row, see `result_rows` and `COLUMNS`.
        author: Who made the policies.

    Returns:
        The files by name.

    Raises:
        ValueError: If the table has other columns, or rows of another hash.
    """
    rows = _rows_of_hash(table, plan)
    for one in found:
        row = _written(one) | {
            "task": plan.task,
            "policy": row_name(one["policy"]),
            "observation": plan.observation,
            "author": author.strip(),
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
            "cpu": str(machine()["cpu"]),
            "version": versions().get("ae-env", ""),
            "hash": plan.hash or "",
        }
        key = tuple(row[name] for name in _KEY)
        if key in rows:
            logger.warning("%s: replaced the row of %r by %r", table, row["policy"], row["author"])
        rows[key] = row
    tasks = list(_TABLES)
    ordered = sorted(rows.values(), key=lambda r: (tasks.index(r["task"]), -float(r["score"])))
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(ordered)
    page = page_of(table)
    return {
        table.name: write_atomically(table, text.getvalue()),
        page.name: write_atomically(page, table_page(plan, ordered, table)),
    }


def _written(row: Mapping[str, Any]) -> dict[str, str]:
    """A row's numbers as the table has them; what there is none of stays empty."""
    numbers = {key: row.get(key) for key in COLUMNS}
    return {
        key: "" if value is None else str(value) if isinstance(value, int) else f"{value:.4f}"
        for key, value in numbers.items()
        if not isinstance(value, str)
    }


def _rows_of_hash(table: Path, plan: BenchPlan) -> dict[tuple[str, ...], dict[str, str]]:
    """Rows of a table by `_KEY`; an error where one has another hash."""
    rows = {tuple(row[name] for name in _KEY): row for row in read_table(table)}
    for key, row in rows.items():
        if row["hash"] != plan.hash:
            raise ValueError(
                f"{table}: policy {key[1]!r} was measured under the hash {row['hash']}, this run "
                f"under {plan.hash}: they do not compare"
            )
    return rows


def read_table(table: Path) -> list[dict[str, str]]:
    """Rows of a benchmark's table; none where there is no file.

    Raises:
        ValueError: If it cannot be read, its columns are not `COLUMNS`, or a cell is no number.
    """
    if not table.is_file():
        return []
    try:
        text = table.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{table} cannot be read as a table: {error}") from error
    reader = csv.DictReader(io.StringIO(text, newline=""))
    if tuple(reader.fieldnames or ()) != COLUMNS:
        raise ValueError(f"{table}: its columns must be {', '.join(COLUMNS)}")
    rows = list(reader)
    for line, row in enumerate(rows, start=2):
        for name in COLUMNS:
            value = row[name]
            if value is None or (name not in _TEXT and not _is_number(value, name == "score")):
                raise ValueError(f"{table}, line {line}: `{name}` (={value!r}) must be a number")
    return rows


def _is_number(text: str, required: bool) -> bool:
    """Whether a cell holds a finite number, or nothing where nothing is required."""
    try:
        return math.isfinite(float(text)) if text or required else True
    except ValueError:
        return False


def page_of(table: Path) -> Path:
    """The page of a table: ``docs/ae-bench/v1.csv`` has ``docs/ae-bench.md``.

    >>> page_of(Path("docs/ae-bench/v1.csv")).as_posix(), page_of(Path("mine.csv")).as_posix()
    ('docs/ae-bench.md', 'mine.md')
    """
    folder = table.parent
    return (folder if folder.name == "ae-bench" else table).with_suffix(".md")


def result_rows(
    plan: EvaluationPlan, results: Results, ranking: Sequence[Rank]
) -> list[dict[str, Any]]:
    """The rows of policies of a plan of conditions: means over all of them.

    Args:
        plan: The plan.
        results: By condition.
        ranking: Over all conditions.
    """
    return [_row(plan, results, one) for one in ranking]


def _row(plan: EvaluationPlan, results: Results, one: Rank) -> dict[str, Any]:
    name = one.policy
    track = results[plan.static_condition].tracks[name]

    def mean(key: str) -> float:
        """Over all conditions, source groups with the same weight."""
        values = [
            metrics.group_means(r.episode_metrics(name)[key], r.groups)[0].mean()
            for r in results.values()
        ]
        return float(np.mean(values))

    def score(real: bool) -> float | None:
        """Over the groups that are real places, or over the others."""
        found = []
        for result in results.values():
            chosen = is_real(result.groups) == real
            if not chosen.any():
                return None
            gains = (result.episode_metrics(name)["score"] - result.random)[:, chosen]
            span, groups = (result.oracle - result.random)[chosen], result.groups[chosen]
            gained = metrics.group_means(gains, groups)[0].mean(axis=0).sum()
            found.append(gained / metrics.group_means(span, groups)[0].sum())
        return float(np.mean(found))

    low, high = one.score.pair or (None, None)
    return {
        "policy": name,
        "score": one.score.value,
        "ci95_low": low,
        "ci95_high": high,
        "procedural": score(real=False),
        "real": score(real=True),
        **{key: mean(key) for key in _MEANS},
        "ms_alone": track.ms_alone,
        "training_seeds": len(track.states),
    }


def bracket_rows(results: Sequence[BracketResult]) -> list[dict[str, Any]]:
    """The rows of policies of a plan of brackets: means over all budgets."""
    rows = []
    for result in results:
        real, interval = is_real(result.groups), result.score()
        low, high = interval.pair or (None, None)
        rows.append(
            {
                "policy": result.policy,
                "score": interval.value,
                "ci95_low": low,
                "ci95_high": high,
                "procedural": None if real.all() else result.mean("quality", ~real),
                "real": result.mean("quality", real) if real.any() else None,
                **{key: result.mean(key) for key in ("log_error", "unseen", "frames")},
                "ms_alone": 1000.0 * result.mean("seconds"),
                "training_seeds": len(result.values["quality"]),
            }
        )
    return rows


def is_real(groups: NDArray[Any]) -> NDArray[np.bool_]:
    """Which of the source groups are real places."""
    return np.isin(groups, [asset.place for asset in list_assets()])


def table_page(plan: BenchPlan, rows: Sequence[Mapping[str, str]], table: Path) -> str:
    """The page of a benchmark's table as Markdown."""

    def shown(path: Path) -> str:  # a full path is of one machine only
        return path.name if path.is_absolute() else path.as_posix()

    blocks = []
    for task, (title, text, columns) in _TABLES.items():
        own = [row for row in rows if row["task"] == task]
        if own:
            body = [[_cell(row, key) for key in columns.values()] for row in own]
            blocks.append(f"## {title}\n\n{text}\n\n{markdown_table(list(columns), body)}")
    return _PAGE.format(
        table=shown(table), page=shown(page_of(table)), hash=plan.hash, tables="\n\n".join(blocks)
    )


def _cell(row: Mapping[str, str], key: str) -> str:
    if key == "ci95":
        return f"{row['ci95_low']} to {row['ci95_high']}" if row["ci95_low"] else "-"
    if not row[key]:
        return "-"
    return f"{float(row[key]):.2%}" if key in _PERCENT else escape(row[key])
