"""An evaluation written down: results.json, tables, plots, report.md and report.html."""

from __future__ import annotations

import base64
import html
import os
import re
import string
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd

from agents.evaluation.evaluation_plan import NOT_OF_THE_PROTOCOL, digest
from agents.evaluation.intervals import MIN_GROUPS, RESAMPLES
from agents.evaluation.metrics import THIRD_EV
from agents.evaluation.result import (
    MORE_COLUMNS,
    ROW_COLUMNS,
    EvaluationResult,
    Results,
    as_results,
    best_meter,
    bracket_rows,
    difference_rows,
    group_rows,
    oracle_histogram,
    overall_ranking,
    result_rows,
    scene_rows,
    scores_by_kind,
    static_condition,
    training_seed_rows,
)
from agents.evaluation.stability import Stability, stability_rows
from agents.report import plots
from simulator.settings import format_exposure_time
from simulator.utils.files import result_meta, write_atomically, write_results

#: Content of a cell: a format of the row, such as ``"{ms:.1f} ± {spread:.1f}"``, or a function of
#: it that returns Markdown, or None.
Cell = str | Callable[[Mapping[str, Any]], object]

#: Tables of several conditions: heading, column of the rows, and format.
_BY_CONDITION = (
    ("Normalised score", "normalised_score", ".3f"),
    ("EV error, P95 [EV]", "ev_error_p95", ".1f"),
    ("Frames to converge, from the last change of the light on", "frames_to_converge", ".1f"),
    ("Overshoot [EV]", "overshoot", ".2f"),
    ("Visible jump (mean change of the companded picture)", "jump", ".4f"),
)
#: Source groups in one table on the terminal.
_GROUPS_ABREAST = 4
#: Characters that mean something to Markdown anywhere, and underscores that are not within a word.
_SPECIAL = re.compile(r"[\\`*\[\]<>|&!~$]|(?<![^\W_])_|_(?![^\W_])")


# -- Markdown -------------------------------------------------------------------------------------


class _Format(string.Formatter):
    """Formats of rows: ``{a[b]}`` is an entry of an entry, a pair of numbers is "1 to 2".

    Texts are shown as they are, those of ``{a:md}`` are Markdown.
    """

    def get_field(self, name: str, args: Any, kwargs: Any) -> Any:
        try:
            value, used = super().get_field(name, args, kwargs)
        except (KeyError, IndexError, TypeError):
            value, used = None, name
        if value is None or (isinstance(value, float) and np.isnan(value)):
            raise LookupError(name)
        return value, used

    def format_field(self, value: Any, spec: str) -> Any:
        if isinstance(value, list | tuple):
            return " to ".join(format(one, spec) for one in value)
        if spec == "md":
            return value
        return escape(value) if isinstance(value, str) else format(value, spec)


def to_markdown(
    rows: pd.DataFrame | Iterable[Mapping[str, Any]],
    columns: Mapping[str, Cell],
    missing: str = "-",
) -> str:
    """A Markdown table with a line for each row; columns but the first are aligned to the right.

    Args:
        columns: Content of the cells by heading. Texts of a row are shown as they are, whatever
            they mean to Markdown; the result of a function is Markdown.
        missing: Text of a cell a value of which is missing, None or NaN. Where it is empty, columns
            without any other cell are left out.

    >>> rows = [{"a": "x|y", "b": [1, 2]}, {"a": "z", "b": None}]
    >>> print(to_markdown(rows, {"A": "{a}", "B": "{b:.1f}"}))
    | A    |          B |
    |:-----|-----------:|
    | x\\|y | 1.0 to 2.0 |
    | z    |          - |
    """
    records = rows.to_dict("records") if isinstance(rows, pd.DataFrame) else list(rows)
    cells = {
        heading: [cell(row, content, missing) for row in records]
        for heading, content in columns.items()
    }
    first = next(iter(cells))
    if not missing:
        cells = {heading: own for heading, own in cells.items() if heading == first or any(own)}
    return _aligned(pd.DataFrame(cells))


def cell(row: Mapping[Any, Any], content: Cell, missing: str = "-") -> str:
    """Text of a cell, see `to_markdown`."""
    if callable(content):
        value = content(row)
        return missing if value is None else str(value)
    try:
        return _Format().vformat(content, (), row)
    except LookupError:
        return missing


def _wide(frame: pd.DataFrame, form: str) -> str:
    """A frame of numbers of one kind as Markdown, its index as the first column."""
    texts = frame.map(lambda value: format(value, form)).rename(columns=escape, index=escape)
    return _aligned(texts.rename_axis(columns=None).reset_index())


def _aligned(frame: pd.DataFrame) -> str:
    align = ["left", *["right"] * (frame.shape[1] - 1)] if len(frame) else None
    return str(frame.to_markdown(index=False, disable_numparse=True, colalign=align))


def escape(name: object) -> str:
    r"""A name from outside, as of a file or a policy, so that Markdown shows it as it is.

    >>> escape("centre_weighted:P"), escape("![x](a.png)")
    ('centre_weighted:P', '\\!\\[x\\](a.png)')
    """
    return _SPECIAL.sub(r"\\\g<0>", " ".join(str(name).split()))


def code(text: object) -> str:
    """Text from outside as code within a line; not for tables, whose cells a bar ends.

    >>> print(code("a | b"), code("`x`"))
    `a | b` `` `x` ``
    """
    line = " ".join(str(text).split())
    fence = _fence(line, 1)
    pad = " " if line.startswith("`") or line.endswith("`") else ""
    return f"{fence}{pad}{line}{pad}{fence}"


def code_block(*lines: str) -> str:
    """Lines from outside as a block of code."""
    fence = _fence("\n".join(lines), 3)
    return "\n".join([fence, *(" ".join(line.splitlines()) for line in lines), fence])


def _fence(text: str, least: int) -> str:
    """Backticks, `least` or more, that `text` does not end."""
    return "`" * max(least, max(map(len, re.findall("`+", text)), default=0) + 1)


def html_report(markdown: str, pictures: Mapping[str, Path], title: str) -> str:
    """The page of a report, CommonMark with tables; raw HTML in it is shown as text.

    `pictures`, by their names in `markdown`, are put into the page; others are a caption only.
    """
    from markdown_it import MarkdownIt

    def image(_: Any, tokens: Any, index: int, *__: Any) -> str:
        token = tokens[index]
        file, caption = pictures.get(str(token.attrs["src"])), html.escape(token.content)
        if file is None:
            return caption
        content = base64.b64encode(file.read_bytes()).decode()
        kind = file.suffix.removeprefix(".")
        return f'<img src="data:image/{kind};base64,{content}" alt="{caption}">'

    page = MarkdownIt("commonmark", {"html": False}).enable("table")
    page.add_render_rule("image", image)
    return _templates().get_template("report.html").render(title=title, body=page.render(markdown))


# -- files ----------------------------------------------------------------------------------------


def write_report(
    results: EvaluationResult | Results,
    out: str | os.PathLike[str],
    *,
    command: str,
    source: str | None = None,
    split: str | None = None,
    next_commands: Sequence[str] = (),
    extra_meta: Mapping[str, Any] | None = None,
    resamples: int = RESAMPLES,
) -> dict[str, Path]:
    """Write everything that an evaluation shows into `out`; returns the files by name.

    Those are ``results.json`` and ``report.md``; of frames also ``scenes.csv``, ``metrics.csv``,
    ``report.html`` and pictures: ``scores.png``, ``ev_error.png``, ``cost.png`` where decisions of
    one camera were timed, ``contact_sheet.webp`` and so on where the scenes are known.

    Args:
        results: The return value of `evaluate` or `run_plan`.
        out: Folder, made where missing.
        command: The command line that repeats the evaluation.
        source, split, resamples: See `result_rows`.
        next_commands: Command lines for the reader to try next.
        extra_meta: Further entries of the JSON's ``meta``, such as training seeds.
    """
    folder, results = Path(out), as_results(results)
    result = results[static_condition(results)]
    ranking = overall_ranking(results, resamples=resamples)
    if result.measure == "quality":
        rows = bracket_rows(results, ranking)
        meta = result_meta(command, result.plan.seeds[0]) | {"plan": result.plan.protocol()}
        scenes = repr(result.plan.environment.get("scenes", "bundled"))
        apart = pd.Series(map(_difference, rows.to_best, rows.to_best_ci95))
        compared = rows.assign(best=apart.where(rows.policy != rows.policy[0], "-"))
        text = fill("brackets.md", plan=result.plan, rows=compared, meta=meta, scenes=scenes)
        return {
            "results.json": write_results(folder / "results.json", rows.to_dict("records"), meta),
            "report.md": write_atomically(folder / "report.md", text),
        }
    rows = result_rows(results, source=source, split=split, resamples=resamples)
    meta = _meta(results, ranking, command, resamples) | dict(extra_meta or {})
    ends = pd.DataFrame([pair or (None, None) for pair in rows.ci95])
    table = rows.assign(ci95_low=ends[0], ci95_high=ends[1])
    columns = [name for name in ROW_COLUMNS if name != "ci95"]
    table = table[[*columns, "ci95_low", "ci95_high", *MORE_COLUMNS]]
    contents = rows[list(ROW_COLUMNS)].to_dict("records")
    files = {"results.json": write_results(folder / "results.json", contents, meta)}
    for name, frame in (("scenes.csv", scene_rows(result)), ("metrics.csv", table)):
        text = frame.to_csv(index=False, float_format="%.6g", lineterminator="\n")
        files[name] = write_atomically(folder / name, text)
    order = ranking.policy.tolist()
    order += [name for name in result.tracks if name not in order]
    pictures = _write_pictures(folder, results, rows, ranking, order)
    text = _report(results, rows, meta, order, pictures=pictures, next_commands=next_commands)
    page = html_report(text, pictures, f"Exposure policies compared: {result.plan.name}")
    return {
        **files,
        **pictures,
        "report.md": write_atomically(folder / "report.md", text),
        "report.html": write_atomically(folder / "report.html", page),
    }


def _write_pictures(
    folder: Path, results: Results, rows: pd.DataFrame, ranking: pd.DataFrame, order: Sequence[str]
) -> dict[str, Path]:
    result = results[static_condition(results)]
    if len(results) > 1:
        together = ranking[["policy", "normalised_score", "ci95"]]
        named = {"condition": "all conditions", "num_groups": rows.num_groups.iloc[0]}
        rows = pd.concat([rows, together.assign(**named)])
    pictures = {
        "scores.png": plots.plot_scores(folder / "scores.png", rows, order),
        "ev_error.png": plots.plot_convergence(folder / "ev_error.png", results, order),
    }
    alone = {name: track.ms_alone for name, track in result.tracks.items() if track.ms_alone}
    ranked = ranking[ranking.policy.isin(list(alone))]
    scores = dict(zip(ranked.policy, ranked.normalised_score, strict=True))
    if scores:
        pictures["cost.png"] = plots.plot_cost(folder / "cost.png", alone, scores, order)
    return pictures | plots.path_sheets(folder, results, order)


def _meta(results: Results, ranking: pd.DataFrame, command: str, resamples: int) -> dict[str, Any]:
    result = results[static_condition(results)]
    best, described, differences = best_meter(result), result.plan.describe(), []
    protocol = {k: v for k, v in described.items() if k not in NOT_OF_THE_PROTOCOL}
    if best is not None:
        differences = difference_rows(result, best, resamples=resamples).to_dict("records")
    return {
        **result_meta(command, result.plan.seeds[0]),
        "plan": described | {"sha256": digest(protocol)},
        "episodes": len(result.scene_ids),
        "scenes": len(set(result.scene_ids.tolist())),
        "frames": result.scores.shape[1],
        "ranking": ranking.to_dict("records"),
        "by_kind": scores_by_kind(result),
        "oracle_histogram": oracle_histogram(result),
        "best_meter": best,
        "differences_to_best_meter": differences,
        "training_seeds": training_seed_rows(result).to_dict("records"),
        "ms_alone": {name: track.ms_alone for name, track in result.tracks.items()},
        "other_scorers": result.other_scores,
    }


# -- the report -----------------------------------------------------------------------------------


def _report(
    results: Results, rows: pd.DataFrame, meta: Mapping[str, Any], order: Sequence[str], **more: Any
) -> str:
    static = static_condition(results)
    result = results[static]
    by = rows.replace({"condition": {"all": static}})
    by = by[by.condition.isin(list(results))]  # of each condition as a whole
    scores = {row["policy"]: row["normalised_score"] for row in meta["ranking"]}
    ordered = rows.sort_values("normalised_score", ascending=False, kind="stable")
    costs = by[by.condition == static]
    kinds = {f"{kind} ({own['groups']})": own for kind, own in meta["by_kind"].items()}
    plan, policies = result.plan, pd.Index(result.tracks, name="policy")
    return fill(
        "evaluation.md",
        meta=meta,
        results=results,
        several=len(results) > 1,
        static=static,
        plan=plan,
        row=rows.iloc[0],
        training_seeds=rows.training_seeds.max(),
        ranking=[
            row | {"best": _change(row["to_best"]), "next": _change(row["to_next"])}
            for row in meta["ranking"]
        ],
        parts={part: ordered[ordered.condition == part] for part in result.parts},
        min_groups=MIN_GROUPS,
        groups=group_rows(result),
        conditions=_condition_tables(results, by, order) if len(results) > 1 else [],
        costs=costs.assign(score=costs.policy.map(scores)),
        clipping=_clipping(by, static, policies),
        kinds=pd.DataFrame(kinds).drop(index="groups").rename_axis("policy"),
        other_scorers=pd.DataFrame(meta["other_scorers"], index=policies),
        histogram=_histogram_rows(meta["oracle_histogram"]),
        run=[
            {"condition": name, "lighting": str(one.lighting), "delay": str(one.delay)}
            for name, one in plan.all_conditions.items()
        ],
        **more,
    )


def _condition_tables(
    results: Results, by: pd.DataFrame, order: Sequence[str]
) -> list[tuple[str, pd.DataFrame, str]]:
    """Heading, table and format of each metric: a line per condition, a column per policy."""
    tables = [(title, _pivot(by, key)[list(order)], form) for title, key, form in _BY_CONDITION]
    for title, key, reduce, form in (
        ("Frames until the exposure stays, median", "frames_to_settle", np.median, ".1f"),
        ("Share of episodes that converge", "converged", np.mean, ".0%"),
    ):
        values = {
            name: [reduce(result.episode_metrics(name)[key]) for result in results.values()]
            for name in order
        }
        index = pd.Index(results, name="condition")
        tables.append((title, pd.DataFrame(values, index=index), form))
    return tables


def _pivot(by: pd.DataFrame, key: str) -> pd.DataFrame:
    return by.pivot(index="condition", columns="policy", values=key).loc[by.condition.unique()]


def _clipping(by: pd.DataFrame, static: str, policies: pd.Index[Any]) -> pd.DataFrame:
    table = pd.DataFrame(index=policies)
    for shade, key in (("white", "clipped_high"), ("black", "clipped_low")):
        shares = _pivot(by, key)[policies]
        table[f"{shade}, {static}"] = shares.loc[static].map("{:.2%}".format)
        worst = zip(shares.max(), shares.idxmax(), strict=True)
        table[f"{shade}, worst"] = [f"{share:.2%} ({escape(name)})" for share, name in worst]
    return table


def _change(change: Mapping[str, Any] | None) -> str | None:
    """A paired difference with its simultaneous interval, marked where it leaves out zero."""
    if change is None:
        return None
    mark = " \\*" if change["significant"] else ""
    return _difference(change["difference"], change["simultaneous_ci95"]) + mark


def _difference(value: float, pair: Sequence[float] | None) -> str:
    """A paired difference with its interval, if it has one."""
    return f"{value:+.3f}" + cell({"pair": pair}, " ({pair:+.3f})", "")


def _histogram_rows(histogram: Mapping[str, Mapping[str, float]]) -> list[dict[str, str]]:
    labels: dict[str, Any] = {"iso": "ISO {:g}".format, "f_number": "f/{:g}".format}
    labels["exposure_time"] = format_exposure_time
    rows = []
    for name, own in histogram.items():
        shares = (f"{labels[name](float(value))}: {share:.0%}" for value, share in own.items())
        rows.append({"control": name.replace("_", " "), "share": ", ".join(shares)})
    return rows


def fill(template: str, **values: Any) -> str:
    """A template beside this module, filled in: one empty line between its parts."""
    text = _templates().get_template(template).render(values)
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"


@cache
def _templates() -> jinja2.Environment:
    folder = jinja2.FileSystemLoader(Path(__file__).parent)
    options: dict[str, Any] = {"trim_blocks": True, "keep_trailing_newline": True}
    found = jinja2.Environment(loader=folder, undefined=jinja2.StrictUndefined, **options)
    found.filters |= {"md": escape, "code": code, "table": to_markdown, "wide": _wide}
    found.globals["code_block"] = code_block
    return found


# -- the terminal ---------------------------------------------------------------------------------


def summary(
    results: EvaluationResult | Results, ranking: pd.DataFrame | None = None
) -> list[tuple[str, pd.DataFrame]]:
    """Tables of an evaluation for the terminal: titles, and frames of texts.

    `ranking` is that of `overall_ranking`, computed by default.
    """
    results = as_results(results)
    static = static_condition(results)
    result = results[static]
    ranking = overall_ranking(results) if ranking is None else ranking
    if result.measure == "quality":
        table = ranking[["policy"]].assign(all=ranking.normalised_score.map("{:.4f}".format))
        table["95 % interval"] = [_interval(pair, ".4f") for pair in ranking.ci95]
        for name, one in results.items():
            table[name] = [f"{one.normalised(policy):.4f}" for policy in ranking.policy]
        return [("quality of the merged picture, by time of all frames", table)]
    if len(results) == 1:
        rows = result_rows(result)
        table = rows.pivot(index="policy", columns="condition", values="normalised_score")
        table = table.loc[list(result.tracks), list(result.parts)].map("{:.3f}".format)
        pairs = rows[rows.condition == "all"].set_index("policy").ci95
        table["95 % interval (all)"] = [_interval(pair) for pair in pairs[table.index]]
        table = table.reset_index()
        title = "normalised score: 0 is random, 1 the best state of every frame"
    else:
        table = pd.DataFrame(
            {
                "tier": ["-" if tier is None else str(tier) for tier in ranking.tier],
                "policy": ranking.policy,
                "all conditions": ranking.normalised_score.map("{:.3f}".format),
                "95 % interval": ranking.ci95.map(_interval),
                static: [f"{result.normalised(policy):.3f}" for policy in ranking.policy],
            }
        )
        title = f"normalised score over {len(results)} conditions, and in {static!r}"
    tables = [(title, table)]
    groups = group_rows(result)
    if len(groups) < MIN_GROUPS:
        for first in range(0, len(groups), _GROUPS_ABREAST):
            own = groups.iloc[first : first + _GROUPS_ABREAST].map("{:.3f}".format).T
            own = own.rename_axis("policy").reset_index()
            tables.append(("mean score of every source group", own))
    return tables


def _interval(pair: list[float] | None, form: str = ".3f") -> str:
    return cell({"pair": pair}, f"{{pair:{form}}}", "too few groups")


# -- stability of controllers ---------------------------------------------------------------------

#: Delay at which settling is told [frames]: that of a Raspberry Pi's camera.
SHOWN_DELAY = 2


def write_stability(
    found: Iterable[Stability], out: Path, *, command: str, seed: int
) -> dict[str, Path]:
    """Write ``results.json``, ``report.md`` and a picture of each controller into `out`."""
    pictures, shown, tables = dict[str, Path](), [], []
    meta = result_meta(command, seed) | {"frames_per_second": {}}
    for one in found:
        rows = stability_rows(one)
        picture = re.sub(r"[^\w.=-]+", "_", one.name).strip("_")[-100:]
        picture += f"-{len(pictures)}" * (f"{picture}.png" in pictures) + ".png"
        pictures[picture] = plots.plot_stability(out / picture, one, rows)
        faults = [_fault_row(own) for _, own in rows.groupby("fault", sort=False)]
        own = {"faults": faults, "third": THIRD_EV, "picture": picture}
        shown.append({"name": one.name, **own})
        meta["frames_per_second"][one.name] = one.speed
        tables += rows.astype(object).where(rows.notna(), None).to_dict("records")
    text = fill("stability.md", controllers=shown, meta=meta, shown=SHOWN_DELAY)
    return {
        "results.json": write_results(out / "results.json", tables, meta),
        **pictures,
        "report.md": write_atomically(out / "report.md", text),
    }


def _fault_row(own: pd.DataFrame) -> dict[str, Any]:
    """What all delays of one fault come to; of the first `reach` delays every step settles."""
    at: Any = own.to_dict("records")  # in the order of the delays
    largest = max(at, key=lambda row: row["amplitude"])
    reach = [*(row["settled"] == 1.0 for row in at), False].index(False)
    return {
        **at[SHOWN_DELAY],
        "reach": reach,
        "delays": at[reach - 1]["delay"] if reach else None,
        "gains": [at[delay]["gain_margin"] for delay in (0, SHOWN_DELAY)],
        **{name: largest[name] for name in ("amplitude", "period")},
        **{name: own[name].max() for name in ("error", "pulse")},
        **{name: own[name].mean() for name in ("cycles", "pulses")},
    }
