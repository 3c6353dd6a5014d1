"""AE-Bench: a fixed plan with the hash of its scenes, and the table that others add to."""

from __future__ import annotations

import csv
import datetime
import io
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from agents.evaluation import metrics
from agents.evaluation.evaluation_plan import EvaluationPlan, digest
from agents.evaluation.intervals import Rank
from agents.policy import split_class, split_options
from agents.report.markdown import escape, markdown_table
from agents.report.result_table import Results
from simulator.utils.files import write_atomically
from simulator.utils.results import machine, versions

if TYPE_CHECKING:
    from torch import Tensor

    from ae_env.scenes import Scene

logger = logging.getLogger(__name__)

#: The scenes' light is hashed as means of so many blocks a side, to so many EV: a scene that was
#: made otherwise is noticed, the last bit of another processor's arithmetic is not.
BLOCKS, STEP_EV = 4, 0.1
#: Raised when an episode or its score is made otherwise. 2: depth and motion of each pixel, terms
#: that are measured on the capture.
RULES = 2
#: Kinds of policies whose names have a file's or folder's path behind the colon.
_WITH_FILES = ("ppo", "regression", "recorded")
COLUMNS = (
    *("policy", "author", "date", "normalised_score", "ci95_low", "ci95_high", "static"),
    *("hard", "regret", "ev_within_third", "frames_to_converge", "converged", "clipped_high"),
    *("clipped_low", "ms_alone", "cpu", "training_seeds", "version", "hash"),
)
#: Metrics of a row that are means over all conditions.
_MEANS = COLUMNS[8:14]
_PAGE = """\
# {name}

<!-- written by `ae-env evaluate --append`; the numbers are in the CSV file -->

{scenes} bundled scenes that nothing was trained on, conditions {conditions}; starts {starts}; \
{frames} frames; scorer `{scorer}`. Score: normalised score over all conditions, each with the \
same weight; 0 is a random policy, 1 an oracle that is told the best state of the last frame's \
light in every frame. What the columns mean: [evaluation.md](evaluation.md). Times are those of \
each row's own machine (`cpu` in the CSV file).

Add your own policy with one command:

    ae-env evaluate --preset ae_bench_v1 --policy my.py:Mine \\
        --append {table} --author "Your name"

Its row replaces the one of the same policy and author, where there is one, and no other. Send it \
as a pull request with the two files that the command changes, `{table}` and `{page}`, and, if it \
may be public, the policy's file.

The plan, its scenes and the rules of the environment have the hash `{hash}`, which every row \
carries; a run under another one is refused.

{rows}
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


def bench_hash(plan: EvaluationPlan, scenes: Sequence[Scene]) -> str:
    """sha256 of the plan, of its scenes, and of `RULES`."""
    return digest(RULES, plan.protocol(), [scene_signature(scene) for scene in scenes])


def check_hash(plan: EvaluationPlan, scenes: Sequence[Scene]) -> None:
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


def check_append(
    table: Path, plan: EvaluationPlan, policies: Sequence[str], *, author: str
) -> None:
    """Checks that rows of `policies` can be added to a table, before they are measured.

    Args:
        table: CSV with `COLUMNS`, or a file to be made.
        plan: The benchmark.
        policies: Those that get a row.
        author: Who made them.

    Raises:
        ValueError: If `table` is no benchmark's table or has rows of another hash, no policy gets
            a row, two would get the same one, or a row without an author would be replaced.
    """
    rows = _rows_of_hash(table, plan)
    if page_of(table) == table:
        raise ValueError(f"`append` (={str(table)!r}) must be a CSV file, such as mine.csv")
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
        if not author.strip() and (name, "") in rows:
            raise ValueError(
                f"`author` (={author!r}) must be given: {table} has a row of {name!r} without an "
                "author, which may be another's"
            )


def append_results(
    table: Path, plan: EvaluationPlan, results: Results, ranking: Sequence[Rank], *, author: str
) -> dict[str, Path]:
    """Adds a row per policy to a benchmark's table, and writes its page again.

    A row of the same policy and author is replaced, which is logged; rows of other authors stay.

    Args:
        table: CSV with `COLUMNS`; made where missing.
        plan: The benchmark.
        results: By condition.
        ranking: Over all conditions.
        author: Who made the policies.

    Returns:
        The files by name.

    Raises:
        ValueError: If the table has other columns, or rows of another hash.
    """
    rows, author = _rows_of_hash(table, plan), author.strip()
    for one in ranking:
        row = _row(plan, results, one, author)
        key = row["policy"], author
        if key in rows:
            logger.warning("%s: replaced the row of %r by %r", table, *key)
        rows[key] = row
    ordered = sorted(rows.values(), key=lambda row: -float(row["normalised_score"]))
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(ordered)
    page = page_of(table)
    return {
        table.name: write_atomically(table, text.getvalue()),
        page.name: write_atomically(page, table_page(plan, ordered, table)),
    }


def _rows_of_hash(table: Path, plan: EvaluationPlan) -> dict[tuple[str, str], dict[str, str]]:
    """Rows of a table by policy and author; an error where one has another hash."""
    rows = {(row["policy"], row["author"]): row for row in read_table(table)}
    for (name, _), row in rows.items():
        if row["hash"] != plan.hash:
            raise ValueError(
                f"{table}: policy {name!r} was measured under the hash {row['hash']}, this run "
                f"under {plan.hash}: they do not compare"
            )
    return rows


def read_table(table: Path) -> list[dict[str, str]]:
    """Rows of a benchmark's table; none where there is no file.

    Raises:
        ValueError: If it cannot be read, or its columns are not `COLUMNS`.
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
    return list(reader)


def page_of(table: Path) -> Path:
    """The page of a table: ``docs/ae-bench/v1.csv`` has ``docs/ae-bench.md``.

    >>> page_of(Path("docs/ae-bench/v1.csv")).as_posix(), page_of(Path("mine.csv")).as_posix()
    ('docs/ae-bench.md', 'mine.md')
    """
    folder = table.parent
    return (folder if folder.name == "ae-bench" else table).with_suffix(".md")


def _row(plan: EvaluationPlan, results: Results, one: Rank, author: str) -> dict[str, str]:
    name, static = one.policy, results[plan.static_condition]
    track = static.tracks[name]

    def mean(key: str) -> float:
        """Over all conditions, source groups with the same weight."""
        values = [
            metrics.group_means(r.episode_metrics(name)[key], r.groups)[0].mean()
            for r in results.values()
        ]
        return float(np.mean(values))

    def score(part: str) -> float:
        gains, span = static.group_gains(name, part)
        return float(gains.mean(axis=0).sum() / span.sum())

    low, high = one.score.pair or (None, None)
    numbers = {
        "normalised_score": one.score.value,
        "ci95_low": low,
        "ci95_high": high,
        "static": score("all"),
        "hard": score("hard") if static.hard.any() else None,
        **{key: mean(key) for key in _MEANS},
        "ms_alone": track.ms_alone,
    }
    return {
        "policy": row_name(name),
        "author": author,
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        **{key: "" if value is None else f"{value:.4f}" for key, value in numbers.items()},
        "cpu": str(machine()["cpu"]),
        "training_seeds": str(len(track.states)),
        "version": versions().get("ae-env", ""),
        "hash": plan.hash or "",
    }


def table_page(plan: EvaluationPlan, rows: Sequence[Mapping[str, str]], table: Path) -> str:
    """The page of a benchmark's table as Markdown."""

    def shown(path: Path) -> str:  # a full path is of one machine only
        return path.name if path.is_absolute() else path.as_posix()

    head = [
        *("policy", "score", "95 % interval", "static", "static, hard", "regret"),
        *("within 1/3 EV", "frames to converge", "converged", "white", "ms alone", "seeds"),
        *("author", "date", "version"),
    ]
    body = [
        [
            escape(row["policy"]),
            row["normalised_score"],
            f"{row['ci95_low']} to {row['ci95_high']}" if row["ci95_low"] else "-",
            *(row[key] for key in ("static", "hard", "regret")),
            f"{float(row['ev_within_third']):.0%}",
            f"{float(row['frames_to_converge']):.1f}",
            f"{float(row['converged']):.0%}",
            f"{float(row['clipped_high']):.2%}",
            *(row["ms_alone"] or "-", row["training_seeds"]),
            *(escape(row[key]) for key in ("author", "date", "version")),
        ]
        for row in rows
    ]
    return _PAGE.format(
        name=plan.name,
        scenes=len(plan.scene_ids),
        conditions=", ".join(f"`{name}`" for name in plan.all_conditions),
        starts=", ".join(plan.starts),
        frames=plan.frames,
        scorer=plan.environment.get("scorer", "balanced"),
        table=shown(table),
        page=shown(page_of(table)),
        hash=plan.hash,
        rows=markdown_table(head, body),
    )
