"""The page of results, every figure in it taken from the rows."""

from __future__ import annotations

from typing import Any

from benchmarks.markdown import table

_MARKS = {None: "", True: "yes", False: "**no**"}


def markdown(rows: list[dict[str, Any]], meta: dict[str, Any]) -> str:
    """The page."""
    machine = meta["machine"]
    wrong = [row for row in rows if not row["ok"]]
    declared = [row for row in rows if row["declared"]]
    findings = [
        f"{len(rows)} cases, {len(rows) - len(wrong)} of them right"
        + (f", of which {len(declared)} are limits that are declared." if declared else "."),
        *(f"Defect: {row['group']}, {row['case']}." for row in wrong),
    ]
    parts = [
        "# Stability",
        f"`{meta['command']}`, {meta['date'][:10]}, seed {meta['seed']}, {machine['cpu']}, "
        f"{machine['cores']} cores, GPU: {machine['gpu'] or 'none'}.",
        "![Largest error of each case](stability.png)",
        "## Findings",
        "\n".join(f"- {line}" for line in findings),
        "Errors are the largest, against closed forms, exact fractions, SciPy or the same steps in "
        "float64, unless the case names another reference; *time* is that of the extreme case over "
        "the ordinary one's. A case that cannot be right says how the result is declared.",
    ]
    for group in dict.fromkeys(row["group"] for row in rows):
        own = [row for row in rows if row["group"] == group]
        parts += [f"## {group[0].upper()}{group[1:]}", _table(own)]
    return "\n\n".join(parts) + "\n"


def _table(rows: list[dict[str, Any]]) -> str:
    optional = [name for name in ("monotone", "unbiased") if any(r[name] is not None for r in rows)]
    timed = any(row["time_ratio"] is not None for row in rows)
    noted = any(row["note"] or row["declared"] for row in rows)
    head = ["case", "dtype", "largest error", "allowed", "finite", *optional]
    head += ["time"] * timed + ["right"] + ["note"] * noted
    body = []
    for row in rows:
        cells = [row["case"], row["dtype"], _error(row["max_error"], row["error"])]
        cells += [_error(row["limit"], ""), _MARKS[row["finite"]]]
        cells += [_MARKS[row[name]] for name in optional]
        if timed:
            cells.append("" if row["time_ratio"] is None else f"{row['time_ratio']:.2f}")
        cells.append("yes" if row["ok"] else "**no**")
        if noted:
            declared = f"declared: {row['declared']}" if row["declared"] else ""
            cells.append("; ".join(filter(None, (declared, row["note"]))))
        body.append(cells)
    return table(head, body)


def _error(value: float | None, unit: str) -> str:
    return "" if value is None else f"{value:.3g} {unit}".rstrip()
