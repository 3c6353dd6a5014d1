"""The page of the transfer benchmark, from the result files of its two halves."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.harness import Cell, Row, cell, filled_page, origin, pivot, sections, table
from simulator.utils.files import write_atomically

TITLE = "Transfer: trained on the simulator, judged in the truth"
#: Result file of each half.
FILES = {"agents": "transfer.json", "tables": "transfer_tables.json"}
#: Largest drop that is asked for.
MOST_DROP = 0.015


def write_page(out: Path) -> Path:
    """Writes ``transfer.md`` of those result files that are in `out`."""
    found = dict.fromkeys((*FILES, *(f"{part}-origin" for part in FILES), "verdicts"), "")
    for part, name in FILES.items():
        if (out / name).is_file():
            content = json.loads((out / name).read_text(encoding="utf-8"))
            found[f"{part}-origin"] = origin(content["meta"])
            found |= (agent_tables if part == "agents" else score_tables)(content["rows"])
    shown = {name: text or "Not measured in this run." for name, text in found.items()}
    return write_atomically(out / "transfer.md", filled_page("transfer", TITLE, shown))


# -- agents ---------------------------------------------------------------------------------------


def agent_tables(rows: Sequence[Row]) -> dict[str, str]:
    """Whether what was asked for holds, and a table for each agent."""
    columns: dict[str, Cell] = {
        "trained in": "`{world}`",
        "normalised score": lambda r: with_ends(r, "normalised_score", "ci95", sign=""),
        "drop against `truth`": lambda r: with_ends(r, "drop"),
        "more than in `EXP`": lambda r: with_ends(r, "more_than_exp"),
        "within 1/3 EV": "{ev_within_third:.0%}",
        "minutes to train": "{minutes:.1f}",
    }
    asked: dict[str, Cell] = {
        "agent": "{agent}",
        "trained in": "`{world}`",
        "asked": "{asked}",
        "measured": "{measured}",
        "met": lambda r: "**yes**" if r["met"] else "**no**",
    }
    blocks = sections(rows, "{agent}", lambda own: table(own, columns))
    return {"verdicts": table(verdicts(rows), asked), "agents": "\n\n".join(blocks)}


def verdicts(rows: Sequence[Row]) -> Iterator[Row]:
    """What was asked for, and whether it holds, for each agent."""
    for row in (row for row in rows if row["simulator"] == "compact"):
        if not row["high_iso"]:
            answer = {"asked": f"drop below {MOST_DROP}", "met": row["drop"] < MOST_DROP}
            yield row | answer | {"measured": with_ends(row, "drop")}
        elif row.get("more_than_exp") is not None:
            ends = row["more_than_exp_ci95"]
            answer = {"asked": "drop smaller than EXP's beyond the interval"}
            answer |= {"met": ends is not None and ends[0] > 0.0}
            yield row | answer | {"measured": with_ends(row, "more_than_exp")}


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


# -- score tables ---------------------------------------------------------------------------------

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


def score_tables(rows: Sequence[Row]) -> dict[str, str]:
    """Tables of each scorer and crop."""
    blocks = sections(rows, lambda r: f"`{r['scorer']}`, frames {_CROPS[r['crop']]}", _of_set)
    return {"tables": "\n\n".join(blocks)}


def _of_set(rows: list[Row]) -> str:
    frame = pd.DataFrame(rows)
    # Of an even number of settings the upper of the two in the middle.
    times = frame.groupby("simulator", sort=False)["ms"].quantile(0.5, interpolation="higher")
    shown = [{"name": name, "ms": ms} for name, ms in times.items()]
    blocks = [
        f"{rows[0]['num_scenes']} scenes in {rows[0]['num_groups']} source groups.",
        table(shown, {"simulator": "`{name}`", "ms per table": "{ms:.1f}"}),
    ]
    line: tuple[str, Cell] = "source", _source
    for heading, content in _MEASURES.items():
        own = [row for row in rows if cell(row, content)]  # EXP has no difference to itself
        shown_by = pivot(own, line=line, columns="`{simulator}`", contents={"": content})
        blocks += [f"{heading}, by ISO and exposure of the source:", shown_by]
    if len(rows[0]["terms"]) > 1:
        columns: dict[str, Any] = {"source": _source, "simulator": "`{simulator}`"}
        columns["saturated"] = "{saturated:.1%}"
        columns |= {name: f"{{terms[{name}]:.4f}}" for name in rows[0]["terms"]}
        columns["worst term"] = "{worst_term}"
        isos, evs = (frame[name].agg(["min", "max"]).tolist() for name in ("iso", "ev"))
        ends = [r for r in rows if r["iso"] in isos and r["ev"] in (*evs, 0)]
        blocks += ["*Where the error enters*:", table(ends, columns)]
    return "\n\n".join(blocks)


def _stars(row: Row, name: str) -> str | None:
    """A difference with a star where its interval leaves out zero."""
    if row.get(name) is None:
        return None
    ends = row.get(f"{name}_ci95")
    return f"{row[name]:+.4f}" + "*" * (ends is not None and (ends[0] > 0.0 or ends[1] < 0.0))


def _source(row: Row) -> str:
    return f"ISO {row['iso']}, {row['ev']:+d} EV"
