"""Steps per second against what the machine could do, and how cost grows.

    ae-env bench throughput
    ae-env bench throughput --against PATH_OF_ANOTHER_CHECKOUT

Parts: environment steps beside a fused kernel, copies of the environment and a lookup; resets
beside steps; the first episode after installation; growth of time and memory with pixels and
states; a 24-megapixel raw through the simulator beside LibRaw. With another checkout, both are
timed in turns (`benchmarks.throughput.paired`). The real files that ``AE_ENV_DATA`` names are used
where they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.harness import Benchmark, Part, Report, Row, cell, pivot, sections, table
from benchmarks.isolated import CORES
from benchmarks.throughput import cold_start, full_frame, growth, resets
from benchmarks.throughput.paired import COLUMNS, measure_paired
from benchmarks.throughput.steps import KERNEL, LOOKUP, SCENES, measure_steps

#: Threads and frame sizes of the steps.
STEPS = ((CORES, 128), (CORES, 64), (1, 128))
#: Frame size and case that the targets for steps are about.
SIZE, CASE, NUM_ENVS = 128, "vector env, cached scene", 64
STEPS_PER_SECOND, TIMES_KERNEL, RATIO_TO_BEFORE = 5000.0, 1.5, 0.97
RESET_IN_STEPS, COLD_START_SECONDS = 3.0, 10.0
FULL_FRAME_MIB, TIMES_LIBRAW = 2048.0, 2.0
#: An exponent counts as linear up to here, if two standard errors lead down to 1.
_LINEAR = 1.1
#: Headings of the quantities of a point.
_QUANTITIES = {"seconds": "time", "mib": "memory"}


def parts(seed: int, quick: bool, against: Path | None = None) -> list[Part]:
    """Parts to measure; the other checkout comes first."""
    found: list[Part] = []
    if against is not None:
        for threads in dict.fromkeys((1,) if quick else (1, CORES)):
            arguments = {"against": str(against.absolute()), "threads": threads, "quick": quick}
            found.append(Part(f"paired {threads}", measure_paired, arguments, threads=threads))
    for threads, size in list(dict.fromkeys(STEPS))[: 1 if quick else None]:
        arguments = {"threads": threads, "size": size, "seed": seed, "quick": quick}
        found.append(Part(f"steps {threads} {size}", measure_steps, arguments, threads=threads))
    given = {"seed": seed, "quick": quick}
    found.append(Part("resets", resets.measure_resets, given, threads=1))
    found.append(Part("cold start", cold_start.measure_cold_start, {"quick": quick}))
    return [*found, *growth.parts(quick), *full_frame.parts(quick)]


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """The report, of the results by name of the part."""
    steps = [row for name, own in results.items() if name.startswith("steps ") for row in own]
    paired = [row for name, own in results.items() if name.startswith("paired ") for row in own]
    more: dict[str, Any] = {
        "scenes": SCENES,
        "resets": results.get("resets", []),
        "cold_start": results.get("cold start", []),
        "growth": growth.curves(results),
        "full_frame": full_frame.rows(results),
    }
    more["targets"] = list(targets(steps, paired, more))
    figures: dict[str | Path, Figure] = {"throughput.png": _draw(steps)}
    return Report([*steps, *paired], tables(steps, paired, more), meta=more, figures=figures)


def tables(steps: list[Row], paired: list[Row], more: dict[str, Any]) -> dict[str, str]:
    """The tables of the page; `more` holds the other rows by name."""
    points = [
        {"against": curve["against"], "name": curve["name"]} | point
        for curve in more["growth"]
        for point in curve["points"]
    ]
    shown: dict[str, Any] = {
        "time [ms]": lambda row: f"{row['seconds'] * 1e3:.2f}",
        "memory [MiB]": "{mib:.1f}",
    }
    by_size = sections(steps, _step_title, lambda own: table(own, _STEP_COLUMNS))
    by_x = sections(
        points,
        "Against {against}",
        lambda own: pivot(
            own, line=(own[0]["against"], "{x:,.0f}"), columns="{name}", contents=shown
        ),
    )
    return {
        "targets": table(more["targets"], _TARGET_COLUMNS),
        "before": table(paired, COLUMNS) if paired else "Not measured in this run.",
        "steps": "\n\n".join(by_size),
        "resets": table(more["resets"], _RESET_COLUMNS),
        "first-episode": table(more["cold_start"], _COLD_COLUMNS),
        "growth": "\n\n".join([table(more["growth"], _CURVE_COLUMNS), *by_x]),
        "frames": table(more["full_frame"], _FRAME_COLUMNS),
    }


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
_CURVE_COLUMNS: dict[str, Any] = {"curve": "{name}", "against": "{against}"} | {
    title: f"{{exponents[{key}][0]:.2f}} ± {{exponents[{key}][1]:.2f}}"
    for key, title in _QUANTITIES.items()
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


# -- targets --------------------------------------------------------------------------------------


def targets(steps: list[Row], paired: list[Row], more: dict[str, Any]) -> Iterator[Row]:
    """What was asked for, beside what was measured."""
    chosen = {"case": CASE, "num_envs": NUM_ENVS, "size": SIZE, "threads": CORES}
    for row in (row for row in steps if chosen.items() <= row.items()):
        where = f"{NUM_ENVS} environments at {SIZE} x {SIZE}, cached scene, {CORES} threads"
        speed, times = row["steps_per_second"], 1.0 / row["ratio_to_kernel"]
        yield _target(f"steps per second, {where}", speed, STEPS_PER_SECOND, at_least=True)
        yield _target(f"time over that of the fused kernel, {where}", times, TIMES_KERNEL)
    for row in more["resets"]:
        yield _target(f"reset in steps, {row['case']}", row["ratio"], RESET_IN_STEPS)
    for row in more["cold_start"][:1]:
        what = f"first make, reset and step [s], {row['case']}"
        yield _target(what, row["total_s"], COLD_START_SECONDS)
    for row in paired:
        what = f"speed over that of before: {row['case']}, threads: {row['threads']}"
        yield _target(what, row["ratio_to_before"], RATIO_TO_BEFORE, at_least=True)
    for curve in more["growth"]:
        for quantity, fit in curve["exponents"].items():
            if curve["against"] == "pixels" and fit is not None:
                what = f"exponent of {_QUANTITIES[quantity]} against pixels, {curve['name']}"
                target = _target(what, fit[0], _LINEAR)
                target["met"] &= fit[0] - 2.0 * fit[1] <= 1.0
                yield target
    for row in more["full_frame"]:
        where = cell(row, "{case}, {megapixels:.1f} megapixels ({file})")
        yield _target(f"peak memory [MiB], {where}", row["peak_mib"], FULL_FRAME_MIB)
        if not row["networks"]:
            limit = row["libraw"]["unpack"] + row["libraw"]["write"]
            what = f"time over LibRaw's unpacking and writing, {where}"
            yield _target(what, row["seconds"] / limit, TIMES_LIBRAW)


def _target(target: str, measured: float, limit: float, *, at_least: bool = False) -> Row:
    met = measured >= limit if at_least else measured <= limit
    row = {"target": target, "measured": measured, "limit": limit}
    return row | {"at_least": at_least, "met": met}


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


BENCHMARK = Benchmark(
    name="throughput",
    title="Throughput",
    parts=parts,
    report=report,
    code=("simulator", "ae_env", "benchmarks/throughput"),
)
run = BENCHMARK.run
