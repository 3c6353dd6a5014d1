"""Sections of the page: the plan's predictions, what is left out, compiled networks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

Row = dict[str, Any]

#: What nothing ever leaves out is not worth a column.
_ALWAYS = ("exposure", "clip_and_quantise")


def bound_section(rows: Sequence[Row]) -> list[str]:
    """How often the plan's prediction bounds the measured difference, by tolerance."""
    if not rows:
        return ["Not measured."]
    scenes = len({row["scene"] for row in rows})
    lines = [
        f"`compact` on {scenes} test scenes of 128 x 128, each photographed several times, at fair "
        "and at other states of the grid, depth unknown. Measured: the distance between the "
        "distributions of the planned capture and of the full run's, given the scene, in units of "
        "the target's noise. *Error* is what the plan predicts for what it left out, which its "
        "tolerance bounds; *difference* is its bound on the distance to the full run, whose "
        "networks err themselves. Pixels that are white in the scene at these settings count as "
        "equal. A violation is a measured distance above the difference by more than two standard "
        "errors of the measurement.",
        "",
        "| tolerance | cases | something left out | predicted error: largest | predicted "
        "difference: median, largest | measured: median, 95 %, largest | measured / predicted: "
        "median | violations |",
        "|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for tolerance in sorted({row["tolerance"] for row in rows}):
        own = [row for row in rows if row["tolerance"] == tolerance]
        predicted = np.array([row["predicted_difference"] for row in own])
        measured = np.array([row["measured"] for row in own])
        used = predicted > 0.01
        shares = measured[used] / predicted[used]
        broken = sum(row["violated"] for row in own)
        cells = [
            f"{tolerance:g}",
            str(len(own)),
            f"{used.mean():.0%}",
            f"{max(row['predicted_error'] for row in own):.3f}",
            f"{np.median(predicted):.3f}, {predicted.max():.3f}",
            f"{np.median(measured):.3f}, {np.quantile(measured, 0.95):.3f}, {measured.max():.3f}",
            f"{np.median(shares):.2f}" if len(shares) else "",
            f"{broken} ({broken / len(own):.1%})",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines + _violations(rows)


def _violations(rows: Sequence[Row]) -> list[str]:
    """The worst of them, so that they can be looked into."""
    broken = [row for row in rows if row["violated"]]
    if not broken:
        return []
    worst = sorted(broken, key=lambda r: r["predicted_difference"] - r["measured"])[:5]
    lines = [
        "",
        "The largest violations:",
        "",
        "| scene | source | state | tolerance | predicted | measured |",
        "|---|---|---|--:|--:|--:|",
    ]
    for row in worst:
        lines.append(
            f"| {row['scene']} | {row['source']} | {row['settings']} | {row['tolerance']:g} | "
            f"{row['predicted_difference']:.3f} | {row['measured']:.3f} |"
        )
    return lines


def left_out_section(rows: Sequence[Row]) -> list[str]:
    """Share of the 64 states in which each module runs, and what leaving it out saves."""
    if not rows:
        return ["Not measured."]
    modules = [m for m in rows[0]["share"] if m not in _ALWAYS]
    first = rows[0]
    lines = [
        f"`compact` at {first['height']} x {first['width']}, tolerance {first['tolerance']:g}, "
        f"{max(row['scenes'] for row in rows)} scenes of each kind at most. Share of the 64 states "
        "in which a module runs; time of the sweep with the rest left out and shared, and of 64 "
        "full runs, of which some are timed; the predicted difference from the full run, mean and "
        "largest over the states.",
        "",
        "| kind | "
        + " | ".join(m.replace("_", " ") for m in modules)
        + " | ms per sweep | full [ms] | times faster | predicted difference |",
        "|---" + "|--:" * (len(modules) + 4) + "|",
    ]
    for row in rows:
        cells = [
            row["kind"],
            *(f"{row['share'][m]:.0%}" for m in modules),
            f"{row['ms_per_sweep']:,.0f}",
            f"{row['full_ms_per_sweep']:,.0f}",
            f"{row['full_ms_per_sweep'] / row['ms_per_sweep']:,.0f}",
            f"{row['predicted_difference_mean']:.3f}, {row['predicted_difference_largest']:.3f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    for module in modules:
        never = [row["kind"] for row in rows if row["share"][module] == 0.0]
        if never:
            lines += ["", f"`{module}` runs in no state of: {', '.join(never)}."]
    return lines


def compiled_section(rows: Sequence[Row]) -> list[str]:
    """Eager against compiled, or why there is nothing to compare."""
    done = [row for row in rows if "skipped" not in row]
    lines = [
        f"Left out{': ' + row['method'] + ', ' + row['dtype'] if row['method'] else ''}: "
        f"{row['skipped']}."
        for row in rows
        if "skipped" in row
    ]
    if not done:
        return lines or ["Not measured."]
    lines += [
        f"One full transition at {done[0]['height']} x {done[0]['width']} with the networks as "
        "they are and behind `torch.compile`, in turns.",
        "",
        "| method | type | eager [ms] | compiled [ms] | ratio | quartiles | first run [s] | "
        "largest difference |",
        "|---|---|--:|--:|--:|--:|--:|--:|",
    ]
    for row in done:
        lines.append(
            f"| {row['method']} | {row['dtype']} | {row['eager_ms_per_state']:.1f} | "
            f"{row['ms_per_state']:.1f} | {row['ratio']:.2f} | {row['ratio_25_percent']:.2f} to "
            f"{row['ratio_75_percent']:.2f} | {row['first_run_seconds']:.0f} | "
            f"{row['largest_difference']:.1e} |"
        )
    paying = [f"`{row['method']}` in {row['dtype']}" for row in done if row["pays"]]
    verdict = f"Compiling pays for {', '.join(paying)}." if paying else "Compiling pays for none."
    return [*lines, "", verdict]
