"""Steps per second against what the machine could do, and how cost grows.

    ae-env bench throughput
    ae-env bench throughput --against ANOTHER_CHECKOUT_OR_COMMIT

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

import pandas as pd
from matplotlib.figure import Figure

from benchmarks.harness import Part, Report, Row, benchmark, cell, pivot, sections, table
from benchmarks.isolated import CORES
from benchmarks.throughput import frames
from benchmarks.throughput.paired import COLUMNS, checkout, measure_paired
from benchmarks.throughput.steps import (
    KERNEL,
    LOOKUP,
    SCENES,
    measure_cold_start,
    measure_resets,
    measure_steps,
)

#: Threads and frame sizes of the steps.
STEPS = ((CORES, 128), (CORES, 64), (1, 128))
#: Frame size and case that the targets for steps are about.
SIZE, CASE, NUM_ENVS = 128, "vector env, cached scene", 64
STEPS_PER_SECOND, TIMES_KERNEL, RATIO_TO_BEFORE = 5000.0, 1.5, 0.97
RESET_IN_STEPS, COLD_START_SECONDS = 3.0, 10.0
FULL_FRAME_MIB, TIMES_LIBRAW = 2048.0, 2.0
#: An exponent counts as linear up to here, if two standard errors lead down to 1.
_LINEAR = 1.1


def parts(seed: int, quick: bool, against: Path | None = None) -> list[Part]:
    found, given = [], {"seed": seed, "quick": quick}
    if against is not None:
        other = str(checkout(against))
        for n in dict.fromkeys((1,) if quick else (1, CORES)):
            arguments = {"against": other, "threads": n, "quick": quick}
            found.append(Part(f"paired {n}", measure_paired, arguments, threads=n))
    for n, size in list(dict.fromkeys(STEPS))[: 1 if quick else None]:
        arguments = {"threads": n, "size": size, **given}
        found.append(Part(f"steps {n} {size}", measure_steps, arguments, threads=n))
    found.append(Part("resets", measure_resets, given, threads=1))
    found.append(Part("cold start", measure_cold_start, {"quick": quick}))
    return [*found, *frames.growth_parts(quick), *frames.frame_parts(quick)]


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    steps = [row for name, own in results.items() if name.startswith("steps ") for row in own]
    paired = [row for name, own in results.items() if name.startswith("paired ") for row in own]
    more: dict[str, Any] = {"scenes": SCENES, "resets": results["resets"]}
    more |= {"cold_start": results["cold start"], "growth": frames.curves(results)}
    more["full_frame"] = frames.frame_rows(results)
    more["targets"] = list(targets(steps, paired, more))
    figures: dict[str | Path, Figure] = {"throughput.png": _draw(steps)}
    return Report([*steps, *paired], tables(steps, paired, more), meta=more, figures=figures)


_TARGETS = "target = {target} | measured = {measured:.4g} | wanted = {wanted} | met = {met}"
_STEPS = """case = {case} | envs = {num_envs} | steps/s = {steps_per_second:,.0f} |
of kernel = {ratio_to_kernel:.2f} | of lookup = {ratio_to_lookup:.3f} | spread = {spread:.0%} |
error = {error_codes:g}"""
_RESETS = """case = {case} | envs = {num_envs} | reset [ms] = {reset_ms:.2f} |
step [ms] = {step_ms:.2f} | reset in steps = {ratio:.2f} | of the means = {ratio_of_means:.2f} |
spread = {spread:.0%}"""
_COLD = """case = {case} | in all [s] = {total_s:.2f} | import [s] = {import_s:.2f} |
make [s] = {make_s:.2f} | reset [s] = {reset_s:.2f} | step [s] = {step_s:.2f} |
processor time [s] = {cpu_s:.2f} | more episodes [s] = {episodes_s:.2f} | spread = {spread:.0%}"""
_CURVES = """curve = {name} | against = {against} |
time = {exponents[seconds][0]:.2f} ± {exponents[seconds][1]:.2f} |
memory = {exponents[mib][0]:.2f} ± {exponents[mib][1]:.2f}"""
_FRAMES = """case = {case}, {file}, {megapixels:.1f} MP | all [s] = {seconds:.2f} |
first [s] = {first:.2f} | peak [MiB] = {peak_mib:,.0f} | read [s] = {stages[read]:.2f} |
prepare [s] = {stages[prepare]:.2f} | simulate [s] = {stages[simulate]:.2f} |
write [s] = {stages[write]:.2f} | LibRaw: unpack [s] = {libraw[unpack]:.3f} |
LibRaw: write [s] = {libraw[write]:.3f} | LibRaw: first [s] = {libraw[first]:.3f} |
LibRaw: develop [s] = {libraw[develop]:.3f} | modules = {names}"""


def tables(steps: list[Row], paired: list[Row], more: dict[str, Any]) -> dict[str, str]:
    points = [
        {"against": curve["against"], "name": curve["name"], "ms": 1e3 * point["seconds"]} | point
        for curve in more["growth"]
        for point in curve["points"]
    ]
    by_x = sections(
        points,
        "Against {against}",
        lambda own: pivot(
            own,
            own[0]["against"] + " = {x:,.0f}",
            "{name}",
            "time [ms] = {ms:.2f} | memory [MiB] = {mib:.1f}",
        ),
    )
    title = "{size} x {size}, {threads} thread{s}"
    steps = [row | {"s": "s" * (row["threads"] > 1)} for row in steps]
    frames = [row | {"names": ", ".join(row["modules"])} for row in more["full_frame"]]
    return {
        "targets": table(more["targets"], _TARGETS),
        "before": table(paired, COLUMNS) if paired else "Not measured in this run.",
        "steps": sections(steps, title, lambda own: table(own, _STEPS)),
        "resets": table(more["resets"], _RESETS),
        "first-episode": table(more["cold_start"], _COLD),
        "growth": f"{table(more['growth'], _CURVES)}\n\n{by_x}",
        "frames": table(frames, _FRAMES),
    }


def targets(steps: list[Row], paired: list[Row], more: dict[str, Any]) -> Iterator[Row]:
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
    for curve in (curve for curve in more["growth"] if curve["against"] == "pixels"):
        for quantity, name in (("seconds", "time"), ("mib", "memory")):
            if (fit := curve["exponents"][quantity]) is not None:
                target = _target(
                    f"exponent of {name} against pixels, {curve['name']}", fit[0], _LINEAR
                )
                yield target | {"met": target["met"] and fit[0] - 2.0 * fit[1] <= 1.0}
    for row in more["full_frame"]:
        where = cell(row, "{case}, {megapixels:.1f} megapixels ({file})")
        yield _target(f"peak memory [MiB], {where}", row["peak_mib"], FULL_FRAME_MIB)
        if not row["networks"]:
            ratio = row["seconds"] / (row["libraw"]["unpack"] + row["libraw"]["write"])
            what = f"time over LibRaw's unpacking and writing, {where}"
            yield _target(what, ratio, TIMES_LIBRAW)


def _target(target: str, measured: float, limit: float, *, at_least: bool = False) -> Row:
    row: Row = {"target": target, "measured": measured, "limit": limit, "at_least": at_least}
    row["wanted"] = f"at {'least' if at_least else 'most'} {limit:g}"
    return row | {"met": measured >= limit if at_least else measured <= limit}


def _draw(steps: list[Row]) -> Figure:
    figure = Figure(figsize=(10.0, 5.0), dpi=80, layout="constrained")
    axis, frame = figure.subplots(), pd.DataFrame(steps)
    frame = frame[(frame["size"] == SIZE) & (frame["threads"] == CORES) & (frame["case"] != LOOKUP)]
    frame = frame.sort_values("steps_per_second")
    labels = frame["case"] + frame["num_envs"].map(" ({})".format)
    colours = ["0.6" if case in KERNEL.values() else "tab:blue" for case in frame["case"]]
    axis.barh(labels, frame["steps_per_second"], color=colours)
    axis.axvline(STEPS_PER_SECOND, color="tab:red", ls="--", label="target")
    axis.set(xscale="log", xlabel=f"steps per second, {SIZE} x {SIZE}, {CORES} threads")
    axis.grid(axis="x", alpha=0.3)
    axis.legend(loc="lower right")
    return figure


run = benchmark("throughput", parts, report)
