"""AE-Bench: a fixed plan with the hash of its scenes, and the table that others add to."""

import datetime
import io
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from filelock import FileLock
from numpy.typing import NDArray
from torch import Tensor

from ae_env.scenes import Scene
from agents import policy_names
from agents.evaluation.evaluation_plan import EvaluationPlan, digest, load_plan, plan_scenes
from agents.evaluation.intervals import score_interval
from agents.evaluation.metrics import group_means
from agents.evaluation.result import Results, overall_gains, static_condition
from agents.report.evaluation import escape, fill
from simulator.utils.files import machine, read_table, sibling, versions, write_atomically

logger = logging.getLogger(__name__)

#: The scenes' light is hashed as means of so many blocks a side, to so many EV: a scene that was
#: made otherwise is noticed, the last bit of another processor's arithmetic is not.
BLOCKS, STEP_EV = 4, 0.1
#: Raised when an episode or its score is made otherwise. 2: depth and motion of each pixel, terms
#: that are measured on the capture. 3: the right exposure is what a dome reads, within bounds.
RULES = 3
#: Columns with a value over all conditions or budgets, and the ends of its 95 % interval beside it.
_MEASURED = (
    *("score", "hard", "rest", "regret", "ev_within_third", "frames_to_converge", "converged"),
    *("reversals", "jump", "clipped_high", "clipped_low", "log_error", "unseen", "frames"),
)
COLUMNS = (
    *("task", "policy", "observation", "author", "date"),
    *(f"{name}{end}" for name in _MEASURED for end in ("", "_low", "_high")),
    *("ms_alone", "cpu", "trained_on", "frames_seen", "training_seeds", "version", "hash"),
)
#: Tables that take no more rows, by a column that they alone have.
_OLDER = {"normalised_score": "v1", "real": "v2", "ci95_low": "v3 without intervals"}
#: Columns that hold no numbers.
_TEXT = ("task", "policy", "observation", "author", "date", "cpu", "trained_on", "version", "hash")
#: What identifies a row.
_KEY = ["task", "policy", "observation", "author"]
#: Metrics of a row that are means over places, by the measure of the plan.
_MEANS = {"score": _MEASURED[3:11], "quality": (*_MEASURED[11:], "seconds")}
#: In the order of the page.
_TASKS = ("video", "still", "unknown", "bracket")
#: What tells a page that this module wrote.
_MARK = "<!-- written by `ae-env evaluate --append`"


def scene_signature(scene: Scene) -> list[Any]:
    """JSON values of a scene at the plan's resolution: names, light and defocus in blocks."""
    means = _blocks(scene.light.double().clamp(min=2.0**-20))
    exposed = np.log2(means) - scene.reference.log2_exposure
    codes = np.rint(exposed / STEP_EV).astype(int)
    planes = [] if scene.layout is None else [scene.layout.defocus[None]]
    if scene.layout is not None and scene.layout.subject is not None:
        planes.append(scene.layout.subject[None].float())
    places = [np.rint(_blocks(plane) / 0.1).astype(int).tolist() for plane in planes]
    names = [scene.scene_id, scene.group, scene.kind, bool(scene.hard), round(scene.ev100, 2)]
    return [*names, codes.tolist(), places]


def _blocks(planes: Tensor) -> NDArray[Any]:
    """Means over blocks of each plane (P, H, W), (P, BLOCKS, BLOCKS)."""
    height, width = (size // BLOCKS * BLOCKS for size in planes.shape[1:])
    shape = (len(planes), BLOCKS, height // BLOCKS, BLOCKS, width // BLOCKS)
    return planes[:, :height, :width].numpy().reshape(shape).mean(axis=(2, 4))


def bench_hash(plan: EvaluationPlan, scenes: Sequence[Scene]) -> str:
    """sha256 of the plan, or of all plans of its suite, of scenes, and of `RULES`.

    `scenes` are those of the plan, or of the first one of its suite.
    """
    protocols: Any = plan.protocol()
    if plan.suite:
        protocols = [load_plan(name).protocol() for name in plan.suite]
        for protocol in protocols:  # a policy may choose what it is shown
            protocol["environment"].pop("observation", None)
    return digest(RULES, protocols, [scene_signature(scene) for scene in scenes])


def check_hash(plan: EvaluationPlan, scenes: Sequence[Scene]) -> None:
    """Raises a `ValueError` if a benchmark is not the one that its hash was written down for.

    `scenes` are those of the plan.
    """
    if plan.hash is None:
        return
    first = load_plan(plan.suite[0]) if plan.suite else plan
    if first.environment.get("scenes") != plan.environment.get("scenes"):
        scenes = plan_scenes(first)
    if (found := bench_hash(plan, scenes)) != plan.hash:
        raise ValueError(
            f"`hash` of {plan.name!r} is {plan.hash}, but the plan and the light of its scenes "
            f"give {found}: results would not compare with the published ones; a changed "
            "benchmark needs a new name and hash"
        )


def row_name(policy: str) -> str:
    """A policy's name as the table has it: without the folder of a file of one's own.

    >>> row_name("u/my.py:Mine?gain=2"), row_name("ppo:runs/mine"), row_name("matrix:P")
    ('my.py:Mine?gain=2', 'ppo:mine', 'matrix:P')
    """
    base, _ = policy_names.split_options(policy)
    options = policy[len(base) :]
    head, tail = policy_names.split_class(base)
    if head.endswith(".py"):
        return f"{Path(head).name}:{tail}{options}"
    if head in policy_names.WITH_FILE and tail:
        return f"{head}:{Path(tail).name}{options}"
    return policy


def check_append(
    table: Path, plan: EvaluationPlan, policies: Sequence[str], *, author: str
) -> None:
    """Checks that rows of `policies` can be added to a table, before they are measured.

    A `ValueError` if `plan` is of no benchmark that takes rows, `table` is no benchmark's table or
    has rows of another hash, no policy gets a row, two would get the same one, or a row without an
    author would be replaced.
    """
    table = _followed(table)
    if plan.task not in _TASKS:
        raise _refusal(table, f"takes no rows of {plan.name}, which is no task of AE-Bench")
    rows, page = _read_own(table, plan), table.with_suffix(".md")
    if table.suffix.lower() != ".csv":
        raise _refusal(table, "must be a CSV file, such as mine.csv")
    if page.is_file() and _MARK not in page.read_text(encoding="utf-8", errors="replace"):
        raise _refusal(table, f"would replace {page}, which is not a benchmark's page")
    if not policies:
        raise _refusal(table, "gets no row: privileged policies, such as 'oracle', are not ranked")
    seen: dict[str, str] = {}
    for policy in policies:
        name = row_name(policy)
        if name in seen:
            raise ValueError(
                f"`policy` (={policy!r}) and {seen[name]!r} would have the same row {name!r} of "
                f"{table}: rename a file"
            )
        seen[name] = policy
        _check_author(table, (plan.task, name, plan.observation), author, rows)


def _followed(table: Path) -> Path:
    """The file that a link names: it has one lock, and the link stays."""
    return table.resolve() if table.is_symlink() else table


def _check_author(table: Path, row: tuple[str, ...], author: str, known: pd.DataFrame) -> None:
    if not author.strip() and (*row, "") in known[_KEY].apply(tuple, axis=1).tolist():
        raise ValueError(
            f"`author` (={author!r}) must be given: {table} has a row of {row[1]!r} without an "
            "author, which may be another's"
        )


def _refusal(table: Path, text: str) -> ValueError:
    return ValueError(f"`append` (={str(table)!r}) {text}")


def training_of(policy: str, plan: EvaluationPlan) -> tuple[str, int | None]:
    """Scenes that a built-in policy learnt from, and frames that it saw; ("", None) for none."""
    base, _ = policy_names.split_options(policy_names.training_seeds(policy)[0])
    head, _, file = base.partition(":")
    if head in policy_names.LEARNT_AGENTS and (card := sibling(Path(file), ".json")).is_file():
        training = json.loads(card.read_text(encoding="utf-8"))["training"]
        own = training["training"]
        return training["environment"]["scenes"], own.get("frames", own.get("total_timesteps"))
    if base == "best_fixed" or file.startswith("tuned"):
        return str(plan.environment["scenes"]), None
    return "", None


def append_rows(
    table: Path,
    plan: EvaluationPlan,
    rows: pd.DataFrame,
    *,
    author: str,
    trained_on: str = "",
    frames_seen: int | None = None,
) -> dict[str, Path]:
    """Adds rows of `bench_rows` to a benchmark's table, and writes its page again: files by name.

    `trained_on` and `frames_seen` are of policies that are not built in.
    A row of the same task, policy, observation and author is replaced, and logged. The table is
    made where missing, refused with rows of another hash. Another process that appends waits.
    """
    if not author.strip():
        logger.warning("%s: rows without an author are never replaced: give --author", table)
    training = [training_of(policy, plan) for policy in rows.policy]
    found = rows.assign(
        trained_on=[scenes or trained_on for scenes, _ in training],
        frames_seen=[str(seen or frames_seen or "") for _, seen in training],
        task=plan.task,
        policy=rows.policy.map(row_name),
        observation=plan.observation,
        author=author.strip(),
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
        cpu=str(machine()["cpu"]),
        version=versions().get("ae-env", ""),
        hash=plan.hash or "",
    )
    # Through text, so that a table says the same whether its rows are new or read from the file.
    text = found.reindex(columns=COLUMNS).to_csv(index=False, float_format="%.4f")
    table = _followed(table)
    table.parent.mkdir(parents=True, exist_ok=True)
    new = pd.read_csv(io.StringIO(text), dtype=str, keep_default_na=False)
    page = table.with_suffix(".md")
    with FileLock(table.with_name(f".{table.name}.lock")):
        known = _read_own(table, plan)
        for name in new.policy:  # whoever began at the same time may have added it meanwhile
            _check_author(table, (plan.task, name, plan.observation), author, known)
        for row in known.merge(new[_KEY], on=_KEY).itertuples():
            logger.warning("%s: replaced the row of %r by %r", table, row.policy, row.author)
        both = pd.concat([known, new]).drop_duplicates(_KEY, keep="last")
        order, value = both.task.map(_TASKS.index), -both.score.astype(float)
        both = both.assign(order=order, value=value).sort_values(["order", "value"], kind="stable")
        both = both[list(COLUMNS)]
        return {
            table.name: write_atomically(table, both.to_csv(index=False, lineterminator="\n")),
            page.name: write_atomically(page, table_page(plan, both)),
        }


def _read_own(table: Path, plan: EvaluationPlan) -> pd.DataFrame:
    """Rows of a table; an error where one has another hash."""
    rows = read_rows(table)
    if others := set(rows.hash) - {plan.hash}:
        raise ValueError(
            f"{table} has rows that were measured under the hash {', '.join(others)}, this run "
            f"under {plan.hash}: they do not compare"
        )
    return rows


def read_rows(table: Path) -> pd.DataFrame:
    """Rows of a benchmark's table, checked, all cells as texts; none where there is no file."""
    if not table.is_file():
        return pd.DataFrame(columns=COLUMNS, dtype=str)
    rows = read_table(table)
    if version := next((own for name, own in _OLDER.items() if name in rows), None):
        rule = f"is a table of AE-Bench {version}, which takes no rows: give docs/ae-bench/v3.csv"
        raise _refusal(table, f"{rule}, or a new file")
    if wrong := [name for name in (*COLUMNS, *rows) if (name in COLUMNS) != (name in rows)]:
        rule = f"must be a table of AE-Bench v3 or a new file: column {wrong[0]!r} is not as there"
        raise _refusal(table, rule)
    for name in (name for name in COLUMNS if name not in _TEXT):
        numbers = pd.to_numeric(rows[name], errors="coerce")
        wrong = ~np.isfinite(numbers) & ((rows[name] != "") | (name == "score"))
        if wrong.any():
            line = int(wrong.argmax())
            given = f"`{name}` (={rows[name][line]!r})"
            raise ValueError(f"{table}, line {line + 2}: {given} must be a number")
    for line, task in enumerate(rows.task):
        if task not in _TASKS:
            rule = f"`task` (={task!r}) must be one of {', '.join(_TASKS)}"
            raise ValueError(f"{table}, line {line + 2}: {rule}")
    return rows


def bench_rows(results: Results, ranking: pd.DataFrame) -> pd.DataFrame:
    """The rows of the policies that are ranked: means over all conditions or budgets.

    All columns are resampled as the score is: the places, and the training seeds.
    """
    first, rows = results[static_condition(results)], []
    for policy in ranking.policy:
        found = {
            name: score_interval(*overall_gains(results, policy, part))
            for name, part in zip(("score", "hard", "rest"), first.parts, strict=False)
        }
        for key in _MEANS[first.measure]:
            values = [
                group_means(r.episode_metrics(policy)[key], r.groups) for r in results.values()
            ]
            mean = np.mean(values, axis=0)  # (K, G)
            found[key] = score_interval(mean, np.ones(mean.shape[1]))
        track = first.tracks[policy]
        alone = 1000.0 * found["seconds"].value if "seconds" in found else track.ms_alone
        row = {"policy": policy, "ms_alone": alone, "training_seeds": track.num_seeds}
        for name, own in found.items():
            row |= {name: own.value, f"{name}_low": own.low, f"{name}_high": own.high}
        rows.append(row)
    return pd.DataFrame(rows)


def table_page(plan: EvaluationPlan, rows: pd.DataFrame) -> str:
    """The page of a benchmark's table as Markdown."""
    numbers = rows.assign(
        **{name: pd.to_numeric(rows[name]) for name in COLUMNS if name not in _TEXT}
    )
    by_task = {str(task): own for task, own in numbers.groupby("task")}
    return fill("ae_bench.md", hash=plan.hash, tasks=by_task, named=_named)


def _named(row: Mapping[str, Any]) -> str:
    """A policy's name, and its observation unless that is the default."""
    seen = "" if row["observation"] == "uint8" else f" ({row['observation']})"
    return escape(row["policy"]) + escape(seen)
