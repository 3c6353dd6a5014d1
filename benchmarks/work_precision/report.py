"""The page: tables, and findings in words that are computed from the numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.work_precision.report_parts import (
    Row,
    bound_section,
    compiled_section,
    left_out_section,
)
from benchmarks.work_precision.sweep import TARGETS

#: Names of what is asked in the table of targets.
_SWEEPS = ("compact 0", "compact 0, bank", "compact 0.1", "compact 0.1, bank")


def markdown(rows: Sequence[Row], meta: dict[str, Any]) -> str:
    """The whole page."""
    machine = meta["machine"]
    parts = {
        name: [r for r in rows if r["part"] == name]
        for name in ("precision", "sweep", "bound", "left_out", "compiled")
    }
    quick = (
        " **A quick run: few scenes and states; its numbers are rough.**" if meta["quick"] else ""
    )
    lines = [
        "# Error against run time",
        "",
        f"`{meta['command']}`, {meta['date'][:10]}, seed {meta['seed']}, {machine['cpu']}, "
        f"{meta['threads']} threads.{quick} The truth is the reference camera "
        "(`simulator/reference/reference_camera.py`), here without hidden errors of its body. Scenes are of the "
        "test split: procedural ones with and without depth, photographs, views into radiance "
        "maps, and such views draped over depth; the simulator is not told their depth. Each is "
        "photographed at f/8 with ISO 100 to 6400 and up to 2 EV less than incident light asks "
        "for, and exposed at the 64 states of the default grid.",
        "",
        "![Error against time by size; predictions; modules](work_precision.png)",
        "",
        "## Findings",
        "",
        *verdicts(rows),
    ]
    if not meta["real_files"]:
        lines += ["", "Without the real files (`AE_ENV_DATA`): fewer kinds of scenes."]
    lines += ["", "## Work against precision", "", *_precision_section(parts["precision"])]
    lines += ["", "## The sweep", "", *_sweep_section(parts["sweep"])]
    lines += ["", "## Predicted and measured", "", *bound_section(parts["bound"])]
    lines += ["", "## What is left out", "", *left_out_section(parts["left_out"])]
    lines += ["", "## Compiled networks", "", *compiled_section(parts["compiled"])]
    return "\n".join(lines) + "\n"


# -- findings -------------------------------------------------------------------------------------


def verdicts(rows: Sequence[Row]) -> list[str]:
    """One line per question, answered by the numbers."""
    lines = [*_sweep_verdicts(rows), *_method_verdicts(rows), *_bound_verdict(rows)]
    return [f"- {line}" for line in lines]


def _sweep_verdicts(rows: Sequence[Row]) -> list[str]:
    lines = []
    for name in ("compact 0", "compact 0, bank", "compact 0.1", "compact 0.1, bank"):
        for row in _ratio_rows([r for r in rows if r["part"] == "sweep"]):
            if row["method"] != name:
                continue
            faster, lower = TARGETS[row["against"]]
            verdict = "reached" if row["ratio"] >= faster else "missed"
            error = "reached" if row["psnr_loss_db"] <= lower else "missed"
            lines.append(
                f"Sweep with `{name}` at {row['height']} x {row['width']}: {row['ratio']:,.0f} "
                f"times faster than `{row['against']}` (asked: {faster:g}, {verdict}), PSNR "
                f"{_signed(-row['psnr_loss_db'])} dB (asked: at least {-lower:g}, {error})"
                f"{'' if row['whole'] else '; full run extrapolated'}."
            )
    return lines


def _method_verdicts(rows: Sequence[Row]) -> list[str]:
    lines = []
    precise = [r for r in rows if r["part"] == "precision"]
    for size in _sizes(precise):
        own = [r for r in precise if (r["height"], r["width"]) == size]
        front = sorted((r for r in own if r["pareto"]), key=lambda r: r["ms_per_state"])
        named = ", ".join(f"`{_named(r)}`" for r in front)
        lines.append(f"Pareto front at {size[0]} x {size[1]}, fastest first: {named}.")
        exposed = next(r for r in own if r["method"] == "exposure")
        lines += _single_verdict(own, size)
        losers = [r for r in own if r["psnr_db"] < exposed["psnr_db"] - 0.01]
        if losers:
            worst = ", ".join(
                f"`{_named(r)}` ({_signed(r['psnr_db'] - exposed['psnr_db'])} dB)" for r in losers
            )
            lines.append(f"At that size these lose to exposure alone: {worst}.")
    return lines


def _single_verdict(rows: Sequence[Row], size: tuple[int, int]) -> list[str]:
    """What a plan saves where nothing is shared with other states."""
    single = next((r for r in rows if r["method"] == "compact 0.1, one at a time"), None)
    whole = next((r for r in rows if r["method"] == "compact full"), None)
    if single is None or whole is None:
        return []
    ratio = whole["ms_per_state"] / single["ms_per_state"]
    return [
        f"One transition alone at {size[0]} x {size[1]}, nothing shared: planned with tolerance "
        f"0.1 {_ms(single['ms_per_state'])} ms, everything {_ms(whole['ms_per_state'])} ms "
        f"({ratio:.2f} times)."
    ]


def _bound_verdict(rows: Sequence[Row]) -> list[str]:
    own = [r for r in rows if r["part"] == "bound"]
    if not own:
        return []
    broken = sum(r["violated"] for r in own)
    return [
        f"The plan's predicted difference bounds the measured one in {len(own) - broken:,} of "
        f"{len(own):,} cases (violations: {broken / len(own):.1%})."
    ]


# -- work against precision -----------------------------------------------------------------------


def _precision_section(rows: Sequence[Row]) -> list[str]:
    lines = [
        "All methods get the same photographs and are compared at the same states, those within "
        "3 EV of the right exposure, evenly spread: few, because the slow methods would take hours "
        "for all 64. *Shared* methods do once per photograph what does not depend on the target; "
        "their time per state is that of the preparation and all 64 exposures, over 64. The others "
        "begin anew for every state; their sweep, in brackets, is 64 times the median state. "
        "Methods take turns, in another order every round; ± is half the distance between "
        "quartiles.",
        "",
        "PSNR and relative RMSE are of the expected value, without noise. *Noise*: mean absolute "
        "deviation of the captures' variance from the noise level function, over 8 levels of "
        "signal. *Capture*: distance of the captures' distribution from the reference camera's, "
        "mean and spread together, in units of the target's noise. Of both the median over scenes "
        "and states is given: a clean target asks for more than any method can give, and would "
        "rule the mean. Both have a floor from the finite number of pixels, measured on the "
        "reference camera's own captures. **Bold**: on the Pareto front of time and PSNR.",
    ]
    for size in _sizes(rows):
        own = [r for r in rows if (r["height"], r["width"]) == size]
        first = own[0]
        floors = [f"noise {_percent(first['noise_variance_floor'])}"]
        floors.append(f"capture {first['capture_error_floor']:.2f}")
        lines += [
            "",
            f"### {size[0]} x {size[1]}",
            "",
            f"{_count(first['scenes'], 'scene')}, {_count(first['states_per_scene'], 'state')} of "
            f"each, two photographs. Floors: {', '.join(floors)}.",
            "",
            "| method | type | ms per state | ms per sweep | PSNR [dB] | 10 to 90 % | relative "
            "RMSE | noise | capture |",
            "|---|---|--:|--:|--:|--:|--:|--:|--:|",
        ]
        lines += [_precision_line(row) for row in own]
    return lines


def _precision_line(row: Row) -> str:
    name = f"**{row['method']}**" if row["pareto"] else row["method"]
    spread = (row["ms_per_state_75_percent"] - row["ms_per_state_25_percent"]) / 2
    sweep = f"{row['ms_per_sweep']:,.0f}"
    cells = [
        name,
        row["dtype"],
        f"{_ms(row['ms_per_state'])} ± {_ms(spread)}",
        sweep if row["sweep_timed_whole"] else f"({sweep})",
        f"{row['psnr_db']:.2f}",
        f"{row['psnr_db_10_percent']:.1f} to {row['psnr_db_90_percent']:.1f}",
        f"{row['relative_rmse']:.4f}",
        _percent(row["noise_variance_error"]),
        f"{row['capture_error']:.2f}",
    ]
    return f"| {' | '.join(cells)} |"


# -- sweep ----------------------------------------------------------------------------------------


def _sweep_section(rows: Sequence[Row]) -> list[str]:
    lines = [
        "One preparation and 64 exposures against 64 full runs, the same scenes in the same run, "
        "depth unknown: both networks where they are needed. Nothing is cached: every sweep begins "
        "with the raw. Both write captures to memory that is there. PSNR is of the expected value; "
        "*fair*: over the states within 3 EV of the right exposure alone, as nearly black or white "
        "frames count little. *Bank*: noise looked up in a bank of normals in place of drawn.",
        "",
        "| size | method | scenes | ms per state | ms per sweep | PSNR, 64 states [dB] | PSNR, "
        "fair [dB] |",
        "|---|---|--:|--:|--:|--:|--:|",
    ]
    for size in _sizes(rows):
        of_size = [r for r in rows if (r["height"], r["width"]) == size]
        for method in dict.fromkeys(r["method"] for r in of_size):
            own = [r for r in of_size if r["method"] == method]
            sweep = f"{_mean(own, 'ms_per_sweep'):,.0f}"
            fair = _mean(own, "psnr_db_fair")
            cells = [
                f"{size[0]} x {size[1]}",
                method,
                str(len(own)),
                _ms(_mean(own, "ms_per_state")),
                sweep if own[0]["sweep_timed_whole"] else f"({sweep}, of {own[0]['states']})",
                f"{_mean(own, 'psnr_db'):.2f}",
                "" if np.isnan(fair) else f"{fair:.2f}",
            ]
            lines.append(f"| {' | '.join(cells)} |")
    lines += [
        "",
        "Ratios of the scenes' times (geometric mean, smallest and largest) and what PSNR is lost "
        "over the 64 states and over the fair ones; asked: "
        + "; ".join(
            f"{faster:g} times faster than `{name}` and at most {lower:g} dB lower"
            for name, (faster, lower) in TARGETS.items()
        )
        + ".",
        "",
        "| size | method | against | times faster | smallest to largest | PSNR lost [dB] | fair "
        "states [dB] |",
        "|---|---|---|--:|--:|--:|--:|",
    ]
    for row in _ratio_rows(rows):
        fair = row["psnr_loss_fair_db"]
        lines.append(
            f"| {row['height']} x {row['width']} | {row['method']} | {row['against']} | "
            f"{row['ratio']:,.0f} | {row['smallest']:,.0f} to {row['largest']:,.0f} | "
            f"{row['psnr_loss_db']:.2f} | {'' if fair is None else f'{fair:.2f}'} |"
        )
    return lines


def _ratio_rows(rows: Sequence[Row]) -> list[Row]:
    """Every shared sweep against every full run, by size."""
    found = []
    for size in _sizes(rows):
        by_method: dict[str, dict[str, Row]] = {}
        for row in rows:
            if (row["height"], row["width"]) == size:
                by_method.setdefault(row["method"], {})[row["scene"]] = row
        for method in _SWEEPS:
            for against in TARGETS:
                if method in by_method and against in by_method:
                    pairs = [(by_method[against][s], r) for s, r in by_method[method].items()]
                    found.append(
                        {"height": size[0], "width": size[1], "method": method, "against": against}
                        | _compared(pairs)
                    )
    return found


def _compared(pairs: Sequence[tuple[Row, Row]]) -> Row:
    ratios = [full["ms_per_sweep"] / own["ms_per_sweep"] for full, own in pairs]
    fair = [
        full["psnr_db_fair"] - own["psnr_db_fair"]
        for full, own in pairs
        if own["psnr_db_fair"] is not None
    ]
    return {
        "ratio": float(np.exp(np.mean(np.log(ratios)))),
        "smallest": min(ratios),
        "largest": max(ratios),
        "psnr_loss_db": float(np.mean([full["psnr_db"] - own["psnr_db"] for full, own in pairs])),
        "psnr_loss_fair_db": float(np.mean(fair)) if fair else None,
        "whole": all(full["sweep_timed_whole"] for full, _ in pairs),
    }


# -- words ----------------------------------------------------------------------------------------


def _sizes(rows: Sequence[Row]) -> list[tuple[int, int]]:
    return list(dict.fromkeys((r["height"], r["width"]) for r in rows))


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def _named(row: Row) -> str:
    return row["method"] + (", bfloat16" if row["dtype"] == "bfloat16" else "")


def _mean(rows: Sequence[Row], field: str) -> float:
    values = [r[field] for r in rows if r[field] is not None]
    return float(np.mean(values)) if values else float("nan")


def _ms(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{value:.1%}"


def _signed(value: float) -> str:
    return f"{value + 0.0:+.2f}"
