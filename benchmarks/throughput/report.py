"""The page of results and its picture, every figure taken from the rows."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from benchmarks.harness import Report, Row, bullets, cell, pivot, sections, table
from benchmarks.isolated import CORES
from benchmarks.throughput import cold_start, full_frame, growth
from benchmarks.throughput.paired import COLUMNS
from benchmarks.throughput.steps import KERNEL, LOOKUP, SCENES

#: Frame size and case that the targets for steps are about.
SIZE, CASE, NUM_ENVS = 128, "vector env, cached scene", 64
STEPS_PER_SECOND, TIMES_KERNEL, RATIO_TO_BEFORE = 5000.0, 1.5, 0.97
RESET_IN_STEPS, COLD_START_SECONDS = 3.0, 10.0
FULL_FRAME_MIB, TIMES_LIBRAW = 2048.0, 2.0
#: An exponent counts as linear up to here, if two standard errors lead down to 1.
_LINEAR = 1.1
#: Headings of the quantities of a point.
_QUANTITIES = {"seconds": "time", "mib": "memory"}


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """The report, of the results by name of the part."""
    steps = [row for name, own in results.items() if name.startswith("steps ") for row in own]
    paired = [row for name, own in results.items() if name.startswith("paired ") for row in own]
    resets, cold = results.get("resets", []), results.get("cold start", [])
    curves, frames = growth.curves(results), full_frame.rows(results)
    targets = list(_targets(steps, resets, cold, paired, curves, frames))
    more = {
        "scenes": SCENES,
        "resets": resets,
        "cold_start": cold,
        "growth": curves,
        "full_frame": frames,
        "targets": targets,
    }
    page = [
        f"Frames are packed raws of four planes, companded to uint8; the scenes are `{SCENES}`.",
        "![Steps per second](throughput.png)",
        "## Findings",
        bullets(_findings(steps, targets)),
        "## Targets",
        table(targets, _TARGET_COLUMNS),
        *_paired(paired),
        "## Steps",
        "*Fused kernel*: multiply, noise, clip and compand in one loop over arrays that are there "
        "already, with the same number of threads; ratios compare with the one of the same kind "
        "of noise. *Lookup*: copying observations that were computed beforehand. Actions are "
        "random unless held. Cases take turns, round after round: median, spread as the distance "
        "between the quartiles. The error is the largest difference of a value between an episode "
        "in the batch and the same episode alone. *Cached scene*: neither motion nor defocus.",
        *sections(steps, _step_title, lambda own: table(own, _STEP_COLUMNS)),
        "## Resets",
        "Whole episodes of 8 steps with random actions, in motion and out of focus, 64 x 64, one "
        "thread, the default scenes, each seen before; medians.",
        table(resets, _RESET_COLUMNS),
        "## The first episode",
        f"`gymnasium.make` of the default environment, its first reset and its first step, in a "
        f"process of its own with {CORES} threads, whose caches of compiled code and of scenes are "
        f"empty, or hold what such a process has left; then {cold_start.EPISODES} more episodes. "
        "Medians. Processor time is that of the process up to its first step, without the second "
        "one that compiles beside it.",
        table(cold, _COLD_COLUMNS),
        "## Growth of cost",
        "Each point in a process of its own. Memory is the peak above what the process held with "
        "all libraries loaded. Exponents: least squares on logarithms over the upper two decades, "
        "with the standard error.",
        table(curves, _CURVE_COLUMNS),
        *sections(_points(curves), "Against {against}", _point_table),
        "## Full frame",
        f"A raw file through `read_raw`, `simulate` and `write_dng`, {CORES} threads, every run in "
        "a process of its own, libraries, kernels and networks loaded. The process's first frame "
        "is given its memory by the system; later ones use it again (the full model ran once). "
        "Peak memory is that of the whole process. Beside it LibRaw: unpacking, writing as many "
        "bytes, both for the first time, and its own development of the file. The synthetic DNG "
        "is not compressed, which leaves LibRaw little to do.",
        table(frames, _FRAME_COLUMNS),
    ]
    return Report([*steps, *paired], page, more, {"throughput.png": _draw(steps)})


# -- tables ---------------------------------------------------------------------------------------

_TARGET_COLUMNS: dict[str, Any] = {
    "target": "{target}",
    "measured": "{measured:.4g}",
    "wanted": lambda row: f"at {'least' if row['at_least'] else 'most'} {row['limit']:g}",
    "met": lambda row: "yes" if row["met"] else "**no**",
}
_STEP_COLUMNS: dict[str, Any] = {
    "case": "{case}",
    "envs": "{num_envs}",
    "steps/s": "{steps_per_second:,.0f}",
    "of kernel": "{ratio_to_kernel:.2f}",
    "of lookup": "{ratio_to_lookup:.3f}",
    "spread": "{spread:.0%}",
    "error": "{error_codes:g}",
}
_RESET_COLUMNS: dict[str, Any] = {
    "case": "{case}",
    "envs": "{num_envs}",
    "reset [ms]": "{reset_ms:.2f}",
    "step [ms]": "{step_ms:.2f}",
    "reset in steps": "{ratio:.2f}",
    "of the means": "{ratio_of_means:.2f}",
    "spread": "{spread:.0%}",
}
_COLD_COLUMNS: dict[str, Any] = {
    "case": "{case}",
    "in all [s]": "{total_s:.2f}",
    **{f"{name} [s]": f"{{{name}_s:.2f}}" for name in cold_start.TIMES[:-1]},
    "processor time [s]": "{cpu_s:.2f}",
    "more episodes [s]": "{episodes_s:.2f}",
    "spread": "{spread:.0%}",
}
_CURVE_COLUMNS: dict[str, Any] = {
    "curve": "{name}",
    "against": "{against}",
    **{
        title: f"{{exponents[{key}][0]:.2f}} ± {{exponents[{key}][1]:.2f}}"
        for key, title in _QUANTITIES.items()
    },
}
_FRAME_COLUMNS: dict[str, Any] = {
    "case": "{case}, {file}, {megapixels:.1f} MP",
    "all [s]": "{seconds:.2f}",
    "first [s]": "{first:.2f}",
    "peak [MiB]": "{peak_mib:,.0f}",
    **{f"{stage} [s]": f"{{stages[{stage}]:.2f}}" for stage in full_frame.STAGES},
    **{f"LibRaw: {k} [s]": f"{{libraw[{k}]:.3f}}" for k in ("unpack", "write", "first", "develop")},
    "modules": lambda row: ", ".join(row["modules"]),
}


def _step_title(row: Row) -> str:
    return f"{row['size']} x {row['size']}, {row['threads']} thread{'s' * (row['threads'] > 1)}"


def _points(curves: list[Row]) -> list[Row]:
    return [
        {"against": curve["against"], "name": curve["name"]} | point
        for curve in curves
        for point in curve["points"]
    ]


def _point_table(points: list[Row]) -> str:
    shown: dict[str, Any] = {
        "time [ms]": lambda row: f"{row['seconds'] * 1e3:.2f}",
        "memory [MiB]": "{mib:.1f}",
    }
    line = points[0]["against"], "{x:,.0f}"
    return pivot(points, line=line, columns="{name}", contents=shown)


def _paired(rows: list[Row]) -> list[str]:
    if not rows:
        return []
    return [
        "## Before and now",
        "This checkout and another one in turns on this machine: steps of 64 environments at "
        "64 x 64 per second, and sweeps of 64 states per second. Ratio: speed now over speed "
        "before, the median over all rounds; above 1 is faster. Frames of the same seeds are "
        "compared: codes of uint8, or shares of white.",
        table(rows, COLUMNS),
    ]


# -- targets and findings -------------------------------------------------------------------------


def _target(target: str, measured: float, limit: float, *, at_least: bool = False) -> Row:
    met = measured >= limit if at_least else measured <= limit
    row = {"target": target, "measured": measured, "limit": limit}
    return row | {"at_least": at_least, "met": met}


def _step(rows: list[Row], case: str = CASE, num_envs: int = NUM_ENVS) -> Row | None:
    """The row of `case` at the targets' size on all threads."""
    wanted = {"case": case, "num_envs": num_envs, "size": SIZE, "threads": CORES}
    return next((row for row in rows if wanted.items() <= row.items()), None)


def _targets(
    steps: list[Row],
    resets: list[Row],
    cold: list[Row],
    paired: list[Row],
    curves: list[Row],
    frames: list[Row],
) -> Any:
    row = _step(steps)
    if row is not None:
        where = f"{NUM_ENVS} environments at {SIZE} x {SIZE}, cached scene, {CORES} threads"
        speed, times = row["steps_per_second"], 1.0 / row["ratio_to_kernel"]
        yield _target(f"steps per second, {where}", speed, STEPS_PER_SECOND, at_least=True)
        yield _target(f"time over that of the fused kernel, {where}", times, TIMES_KERNEL)
    for row in resets:
        yield _target(f"reset in steps, {cell(row, '{case}')}", row["ratio"], RESET_IN_STEPS)
    for row in cold[:1]:
        what = f"first make, reset and step [s], {row['case']}"
        yield _target(what, row["total_s"], COLD_START_SECONDS)
    for row in paired:
        what = f"speed over that of before: {row['case']}, threads: {row['threads']}"
        yield _target(what, row["ratio_to_before"], RATIO_TO_BEFORE, at_least=True)
    for curve in curves:
        for quantity, fit in curve["exponents"].items():
            if curve["against"] == "pixels" and fit is not None:
                what = f"exponent of {_QUANTITIES[quantity]} against pixels, {curve['name']}"
                target = _target(what, fit[0], _LINEAR)
                target["met"] &= fit[0] - 2.0 * fit[1] <= 1.0
                yield target
    for row in frames:
        where = cell(row, "{case}, {megapixels:.1f} megapixels ({file})")
        yield _target(f"peak memory [MiB], {where}", row["peak_mib"], FULL_FRAME_MIB)
        if not row["networks"]:
            limit = row["libraw"]["unpack"] + row["libraw"]["write"]
            what = f"time over LibRaw's unpacking and writing, {where}"
            yield _target(what, row["seconds"] / limit, TIMES_LIBRAW)


def _findings(steps: list[Row], targets: list[Row]) -> list[str]:
    own, lines = _step(steps), []
    if own is not None:
        lines.append(
            cell(own, "{num_envs} environments, {case}: {steps_per_second:,.0f} steps per second, ")
            + cell(own, "{ratio_to_kernel:.2f} of the fused kernel's speed.")
        )
        for row in steps:
            if row["case"].startswith("copies") and row["size"] == SIZE:
                times = own["steps_per_second"] / row["steps_per_second"]
                lines.append(f"That is {times:.1f} times as fast as {row['case']}.")
    errors = [row["error_codes"] for row in steps if row["error_codes"] is not None]
    lines.append(f"Batched and alone differ by at most {max(errors):g} in every case compared.")
    met = sum(target["met"] for target in targets)
    return [*lines, f"{met} of {len(targets)} targets are met."]


# -- picture --------------------------------------------------------------------------------------


def _draw(steps: list[Row]) -> Figure:
    figure = Figure(figsize=(10.0, 5.0), dpi=80, layout="constrained")
    axis = figure.subplots()
    own = [r for r in steps if r["size"] == SIZE and r["threads"] == CORES and r["case"] != LOOKUP]
    own.sort(key=lambda row: row["steps_per_second"])
    axis.barh(
        [f"{row['case']} ({row['num_envs']})" for row in own],
        [row["steps_per_second"] for row in own],
        color=["0.6" if row["case"] in KERNEL.values() else "tab:blue" for row in own],
    )
    axis.axvline(STEPS_PER_SECOND, color="tab:red", ls="--", lw=1.2, label="target")
    axis.set(xscale="log", xlabel=f"steps per second, {SIZE} x {SIZE}, {CORES} threads")
    axis.tick_params(axis="y", labelsize=8)
    axis.grid(axis="x", alpha=0.3)
    axis.legend(fontsize=8, loc="lower right")
    return figure
