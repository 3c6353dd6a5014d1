"""The page of the transfer benchmark, from the result files of its two halves."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.harness import Cell, Row, bullets, cell, origin, pivot, table
from simulator.utils.files import write_atomically

TITLE = "Transfer: trained on the simulator, judged in the truth"
#: Result file of each half.
FILES = {"agents": "transfer.json", "tables": "transfer_tables.json"}
#: Largest drop that is asked for.
MOST_DROP = 0.015

_WORLD = (
    "A world is what an agent is trained in: the light itself (`truth`), or what is simulated from "
    "one raw of each scene, taken by the reference camera at ISO 100 to 6400 (`-iso1600`: 1600 to "
    "6400) within a stop of the meter. `EXP` changes exposure and noise level only; `compact`, "
    "`large` and `paper` are networks. Everything else is the same."
)


def write_page(out: Path) -> Path:
    """Writes ``transfer.md`` of those result files that are in `out`."""
    blocks = [f"# {TITLE}", _WORLD]
    for part, show in (("agents", agents_section), ("tables", tables_section)):
        path = out / FILES[part]
        if path.is_file():
            content = json.loads(path.read_text(encoding="utf-8"))
            blocks += show(content["rows"], content["meta"])
    return write_atomically(out / "transfer.md", "\n\n".join(blocks) + "\n")


# -- agents ---------------------------------------------------------------------------------------


def agents_section(rows: Sequence[Row], meta: Mapping[str, Any]) -> list[str]:
    """Blocks about the agents."""
    first = rows[0]
    columns: dict[str, Cell] = {
        "trained in": "`{world}`",
        "normalised score": lambda r: with_ends(r, "normalised_score", "ci95", sign=""),
        "drop against `truth`": lambda r: with_ends(r, "drop"),
        "more than in `EXP`": lambda r: with_ends(r, "more_than_exp"),
        "within 1/3 EV": "{ev_within_third:.0%}",
        "minutes to train": "{minutes:.1f}",
    }
    blocks = [
        "## Agents",
        origin(meta),
        f"{first['frames']} frames of training, {first['num_seeds']} training seeds, judged on "
        f"{first['num_scenes']} held-out scenes ({first['num_groups']} source groups) in the "
        f"truth; scorer `{first['scorer']}`, frames {_CROPS[first['crop']]}. In brackets: 95 % "
        "intervals, differences paired over source groups, training seeds drawn too. *More than in "
        "`EXP`*: the score less that of the agent trained in EXP on sources of the same ISO. "
        "*Agents together*: all trainings of a world as if they were seeds of one agent. Minutes "
        "are those of one training with the loading of its scenes and their networks, the median "
        "over the seeds.",
        bullets(verdicts(rows)),
    ]
    for agent in dict.fromkeys(row["agent"] for row in rows):
        own = [row for row in rows if row["agent"] == agent]
        blocks += [f"### {agent}", table(own, columns)]
    return [*blocks, *_left_out(meta)]


def _left_out(meta: Mapping[str, Any]) -> list[str]:
    names = ", ".join(f"`{name}`" for name in meta.get("left_out", ()))
    why = "its weights do not come with the package and were not trained here."
    return [f"Not measured: {names}; {why}"] if names else []


def verdicts(rows: Sequence[Row]) -> list[str]:
    """What was asked for, and whether it holds, for each agent."""
    lines = []
    for row in rows:
        if row["simulator"] != "compact":
            continue
        name, drop = f"{row['agent']} in `{row['world']}`", row["drop"]
        if not row["high_iso"]:
            answer = "yes" if drop < MOST_DROP else "no"
            lines.append(f"{name}: drop below {MOST_DROP}: **{answer}** ({with_ends(row, 'drop')})")
        elif row.get("more_than_exp") is not None:
            ends = row["more_than_exp_ci95"]
            answer = "yes" if ends is not None and ends[0] > 0.0 else "no"
            more = with_ends(row, "more_than_exp")
            lines.append(
                f"{name}: drop smaller than EXP's beyond the interval: **{answer}** ({more})"
            )
    return lines


def with_ends(row: Row, name: str, ends: str = "", *, sign: str = "+") -> str | None:
    """A value with the ends of its interval; None where there is no value.

    >>> with_ends({"drop": 0.01, "drop_ci95": [-0.002, 0.022]}, "drop")
    '+0.010 [-0.002, +0.022]'
    """
    value, pair = row.get(name), row.get(ends or f"{name}_ci95")
    if value is None:
        return None
    text = f"{value:{sign}.3f}"
    return text if pair is None else f"{text} [{pair[0]:{sign}.3f}, {pair[1]:{sign}.3f}]"


# -- tables ---------------------------------------------------------------------------------------


def tables_section(rows: Sequence[Row], meta: Mapping[str, Any]) -> list[str]:
    """Blocks about the score tables."""
    blocks = [
        "## Score tables from one raw",
        origin(meta),
        "Every held-out scene is photographed at every ISO and exposure; the truth is the table of "
        "its own light. *Rank correlation*: Spearman's, of the 64 predicted scores with the true "
        "ones. *Regret*: what the state that looks best loses in the true table. *Error*: mean "
        "absolute error of a score. Means over source groups; intervals are in the JSON file. A "
        "star: the interval leaves out zero. *Where the error enters*: the error if only that part "
        "of the scorer is predicted, and all others are true.",
    ]
    for scorer, crop in dict.fromkeys((row["scorer"], row["crop"]) for row in rows):
        own = [row for row in rows if (row["scorer"], row["crop"]) == (scorer, crop)]
        blocks += [
            f"### `{scorer}`, frames {_CROPS[crop]}",
            f"{own[0]['num_scenes']} scenes in {own[0]['num_groups']} source groups.",
            _times(own),
        ]
        for heading, content in _MEASURES.items():
            blocks += [f"{heading}, by ISO and exposure of the source:", _pivot(own, content)]
        if len(own[0]["terms"]) > 1:
            blocks += ["*Where the error enters*:", _terms(own)]
    return [*blocks, *_left_out(meta)]


_CROPS = {
    "box": "averaged to 64 x 64 pixels",
    "native": "of 64 x 64 native pixels, with all of their noise",
}
_MEASURES: dict[str, Cell] = {
    "Rank correlation": "{rank_correlation:.4f}",
    "Regret": "{regret:.4f}",
    "Error": "{absolute_error:.4f}",
    "Regret less that of EXP": lambda r: _stars(r, "regret_to_exp"),
    "Error less that of EXP": lambda r: _stars(r, "absolute_error_to_exp"),
}


def _stars(row: Row, name: str) -> str | None:
    """A difference with a star where its interval leaves out zero."""
    if row.get(name) is None:
        return None
    ends = row.get(f"{name}_ci95")
    return f"{row[name]:+.4f}" + "*" * (ends is not None and (ends[0] > 0.0 or ends[1] < 0.0))


def _pivot(rows: Sequence[Row], content: Cell) -> str:
    shown = [row for row in rows if cell(row, content)]  # EXP has no difference to itself
    line: tuple[str, Cell] = ("source", _source)
    return pivot(shown, line=line, columns="`{simulator}`", contents={"": content})


def _source(row: Row) -> str:
    return f"ISO {row['iso']}, {row['ev']:+d} EV"


def _terms(rows: Sequence[Row]) -> str:
    """Error that each term makes, of every simulator, at the ends of the source's exposure."""
    columns: dict[str, Cell] = {
        "source": _source,
        "simulator": "`{simulator}`",
        "saturated": "{saturated:.1%}",
    }
    columns |= {name: f"{{terms[{name}]:.4f}}" for name in rows[0]["terms"]}
    columns["worst term"] = "{worst_term}"
    isos, evs = ({row[name] for row in rows} for name in ("iso", "ev"))
    ends = [r for r in rows if r["iso"] in _ends(isos) and r["ev"] in {*_ends(evs), 0}]
    return table(ends, columns)


def _ends(values: set[int]) -> set[int]:
    return {min(values), max(values)}


def _times(rows: Sequence[Row]) -> str:
    by_name: dict[str, list[float]] = {}
    for row in rows:
        by_name.setdefault(row["simulator"], []).append(row["ms"])
    medians = [{"name": n, "ms": sorted(own)[len(own) // 2]} for n, own in by_name.items()]
    return table(medians, {"simulator": "`{name}`", "ms per table": "{ms:.1f}"})
