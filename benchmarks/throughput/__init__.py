"""Steps per second against what the machine could do, and how cost grows.

    ae-env bench throughput

Parts: environment steps beside a fused kernel, copies of the environment; resets beside steps; the
first episode after installation; sweeps beside the paper's networks; growth of time and memory with
pixels; a 24-megapixel raw through the simulator beside LibRaw. The real files that ``AE_ENV_DATA``
names are used where they are.
"""

from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from benchmarks.harness import Part, Report, Row, benchmark, pivot, sections, table
from benchmarks.throughput import frames
from benchmarks.throughput.steps import measure_cold_start, measure_resets, measure_steps
from benchmarks.throughput.sweeps import sweep_parts

#: Frame sizes of the steps; the first is drawn.
SIZES = (64, 128)


def parts(seed: int, quick: bool) -> list[Part]:
    sizes = SIZES[:1] if quick else SIZES
    found = [Part(f"steps {size}", measure_steps, {"size": size}) for size in sizes]
    found += [Part("resets", measure_resets, threads=1), Part("cold start", measure_cold_start)]
    return [*found, *sweep_parts(quick), *frames.growth_parts(quick), *frames.frame_parts(quick)]


_STEPS = """case = {case} | envs = {num_envs} | steps/s = {steps_per_second:,.0f} |
of kernel = {ratio_to_kernel:.2f} | of one thread = {of_one_thread:.2f} | spread = {spread:.0%}"""
_RESETS = """case = {case} | envs = {num_envs} | reset [ms] = {reset_ms:.2f} |
step [ms] = {step_ms:.2f} | reset in steps = {ratio:.2f} | of the means = {ratio_of_means:.2f} |
spread = {spread:.0%}"""
_COLD = """case = {case} | in all [s] = {total_s:.2f} | import [s] = {import_s:.2f} |
make [s] = {make_s:.2f} | reset [s] = {reset_s:.2f} | step [s] = {step_s:.2f} |
processor time [s] = {cpu_s:.2f} | more episodes [s] = {episodes_s:.2f} | spread = {spread:.0%}"""
_SWEEPS = """size = {size} | scene = {kind} | source = {source} | sweep [ms] = {ms:,.0f} |
paper's networks [ms] = {paper_ms:,.0f} | times = {times:.0f}"""
_CURVES = """curve = {curve} | time = {exponents[seconds][0]:.2f} ± {exponents[seconds][1]:.2f} |
memory = {exponents[mib][0]:.2f} ± {exponents[mib][1]:.2f}"""
_FRAMES = """case = {case}, {file}, {megapixels:.1f} MP | all [s] = {seconds:.2f} |
first [s] = {first:.2f} | peak [MiB] = {peak_mib:,.0f} | read [s] = {stages[read]:.2f} |
prepare [s] = {stages[prepare]:.2f} | simulate [s] = {stages[simulate]:.2f} |
write [s] = {stages[write]:.2f} | LibRaw: unpack [s] = {libraw[unpack]:.3f} |
LibRaw: write [s] = {libraw[write]:.3f} | LibRaw: first [s] = {libraw[first]:.3f} |
LibRaw: develop [s] = {libraw[develop]:.3f} | modules = {modules}"""


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    def of(kind: str) -> list[Row]:
        found = (own for name, own in results.items() if name.partition("|")[0].startswith(kind))
        return [row for own in found for row in (own if isinstance(own, list) else [own])]

    steps, growth = of("steps"), of("growth")
    more = {"resets": of("resets"), "cold_start": of("cold"), "growth": frames.curves(growth)}
    libraw = {row["file"]: row for row in of("libraw")}
    more["sweeps"] = of("sweep")
    more["full_frame"] = [row | {"libraw": libraw[row["file"]]} for row in of("frame")]
    for row in steps:
        row["title"] = f"{row['size']} x {row['size']}, {row['threads']} thread"
        row["title"] += "s" * (row["threads"] > 1)
    contents = "time [ms] = {ms:.2f} | memory [MiB] = {mib:.1f}"
    by_x = pivot(growth, "pixels = {x:,.0f}", "{curve}", contents)
    tables = {
        "steps": sections(steps, "{title}", lambda own: table(own, _STEPS)),
        "resets": table(more["resets"], _RESETS),
        "first-episode": table(more["cold_start"], _COLD),
        "sweeps": table(more["sweeps"], _SWEEPS),
        "growth": f"{table(more['growth'], _CURVES)}\n\n{by_x}",
        "frames": table(more["full_frame"], _FRAMES),
    }
    return Report(steps, tables, meta=more, figures={"throughput.png": _drawn(steps)})


def _drawn(steps: list[Row]) -> Figure:
    """Steps per second against the number of environments, beside the fused kernel."""
    frame = pd.DataFrame(steps)
    frame = frame[frame["size"] == frame["size"].iloc[0]]
    kinds = frame["case"].str.removeprefix("vector env, ").str.removeprefix("one environment, ")
    shown = kinds.isin(["fused kernel, noise bank", "cached scene", "motion and defocus"])
    figure = Figure(figsize=(8.0, 4.5), dpi=100, layout="constrained")
    axis = figure.subplots()
    for (threads, kind), own in frame[shown].groupby(["threads", kinds], sort=False):
        own = own.sort_values("num_envs").set_index("num_envs")["steps_per_second"]
        label, style = f"{kind}, threads: {threads}", "o-" if threads > 1 else "o--"
        if len(own) > 1:
            own.plot(ax=axis, loglog=True, style=style, label=label)
        else:
            axis.axhline(own.iloc[0], color="grey", linestyle=style[1:], label=label)
    axis.set(xlabel="environments side by side", ylabel="frames per second")
    axis.legend()
    return figure


run = benchmark("throughput", parts, report)
