"""The page of results, every figure in it taken from the rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks.isolated import CORES
from benchmarks.markdown import table
from benchmarks.throughput.full_frame import STAGES
from benchmarks.throughput.noise_statistics import NAMES
from benchmarks.throughput.steps import DIGITAL_KERNEL, KERNEL
from benchmarks.throughput.targets import CASE, NUM_ENVS, SIZE, STEPS_PER_SECOND, step_row


def markdown(rows: list[dict[str, Any]], meta: dict[str, Any]) -> str:
    """The page, from the rows of `steps` and what `meta` holds of the other parts."""
    machine = meta["machine"]
    parts = [
        "# Throughput",
        f"`{meta['command']}`, {meta['date'][:10]}, seed {meta['seed']}, {machine['cpu']}, "
        f"{machine['cores']} cores. Frames are packed raws of four planes, companded to uint8; the "
        f"scenes are `{meta['scenes']}`.",
        "![Growth of time and memory, and steps per second](throughput.png)",
        "## Findings",
        *_findings(rows, meta),
        "## Targets",
        _targets(meta["targets"]),
        "## Steps",
        *_steps(rows),
        "## Noise: the bank beside exact normals",
        *_noise(meta["noise"]),
        "## Growth of cost",
        *_growth(meta),
        "## Full frame",
        *_full_frame(meta["full_frame"]),
        "## Where the time of a step goes",
        *_profile(meta["profile"]),
        "## GPU",
        *_gpu(meta["gpu"]),
    ]
    return "\n\n".join(parts) + "\n"


# -- findings -------------------------------------------------------------------------------------


def _findings(rows: list[dict[str, Any]], meta: dict[str, Any]) -> list[str]:
    lines = []
    own, limit = step_row(rows), step_row(rows, KERNEL["bank"])
    if own is not None and limit is not None:
        enough = own["steps_per_second"] >= STEPS_PER_SECOND
        lines.append(
            f"{NUM_ENVS} environments at {SIZE} x {SIZE} on {own['threads']} threads take "
            f"{own['steps_per_second']:,.0f} steps a second on cached scenes, "
            f"{'above' if enough else 'below'} the {STEPS_PER_SECOND:,.0f} aimed at, and "
            f"{1 / own['ratio_to_kernel']:.2f} times the time of the bare kernel "
            f"({limit['steps_per_second']:,.0f} frames a second)."
        )
        digital = step_row(rows, DIGITAL_KERNEL)
        if digital is not None:
            times = digital["steps_per_second"] / own["steps_per_second"]
            lines.append(
                "A bare kernel that also rounds to whole digital numbers, as a camera and the "
                f"environment do, makes {digital['steps_per_second']:,.0f} frames a second: "
                f"{times:.2f} times as many."
            )
        lines += _comparisons(rows, own)
    worst = max(
        (
            (fit[0], s["name"], "memory" if name == "mib" else "time")
            for s in meta["growth"]
            for name, fit in s["exponents"].items()
            if fit is not None
        ),
        default=None,
    )
    if worst is not None:
        lines.append(
            f'The steepest growth measured is that of {worst[2]} in "{worst[1]}", with exponent '
            f"{worst[0]:.2f}."
        )
    frames = [row for row in meta["full_frame"] if row["file"] == "synthetic"]
    for row in frames:
        times = row["seconds"] / (row["limits"]["unpack"] + row["limits"]["write"])
        first = row["first"] / row["limits"]["first"]
        lines.append(
            f"{row['megapixels']:.1f} megapixels, {row['case']}: {row['seconds']:.2f} s and "
            f"{row['peak_mib']:,.0f} MiB at most; {times:.1f} times LibRaw's unpacking and the "
            f"writing, {row['seconds'] / row['limits']['develop']:.1f} times LibRaw's development; "
            f"a process' first frame {row['first']:.2f} s, {first:.1f} times LibRaw's first."
        )
    missed = [target for target in meta["targets"] if not target["met"]]
    lines.append(
        f"{len(meta['targets']) - len(missed)} of {len(meta['targets'])} targets are met"
        + ("." if not missed else "; missed: " + "; ".join(t["what"] for t in missed) + ".")
    )
    return ["\n".join(f"- {line}" for line in lines)]


def _comparisons(rows: list[dict[str, Any]], own: dict[str, Any]) -> list[str]:
    """Sentences about the other cases, as times of the speed of `own`."""
    speed, lines = own["steps_per_second"], []
    said = {
        "vector env, motion and defocus": "with motion and defocus drawn for every episode",
        f"{CASE}, live scoring": "with a scorer that looks at every frame",
        f"{CASE}, exact noise": "with exact noise",
    }
    for case, words in said.items():
        row = step_row(rows, case)
        if row is not None:
            value = row["steps_per_second"]
            lines.append(
                f"{words[0].upper()}{words[1:]}: {value:,.0f} ({value / speed:.2f} times)."
            )
    for row in rows:
        same = row["size"] == SIZE and row["threads"] == own["threads"]
        if same and row["case"].startswith("copies"):
            lines.append(
                f"{row['num_envs']} {row['case'].replace(', cached scene', '')}: "
                f"{row['steps_per_second']:,.0f}; the batched environment is "
                f"{speed / row['steps_per_second']:.1f} times as fast."
            )
    single = step_row(rows, "one environment, cached scene", num_envs=1)
    if single is not None:
        lines.append(f"One environment alone: {single['steps_per_second']:,.0f}.")
    errors = [row["error_codes"] for row in rows if row["error_codes"] is not None]
    lines.append(
        f"Batched and alone differ by at most {max(errors)} codes in every case that was compared."
    )
    return lines


def _targets(targets: list[dict[str, Any]]) -> str:
    body = []
    for target in targets:
        sign = "at least" if target["at_least"] else "at most"
        figures = (_figure(target["measured"]), f"{sign} {_figure(target['limit'])}")
        body.append((target["what"], *figures, "yes" if target["met"] else "**no**"))
    return table(("target", "measured", "wanted", "met"), body)


# -- parts ----------------------------------------------------------------------------------------


def _steps(rows: list[dict[str, Any]]) -> list[str]:
    lines = [
        "*Fused kernel*: multiply, noise, clip and compand in one loop over arrays that are there "
        "already, with the same number of threads; ratios compare with the one of the same kind "
        "of noise. *Lookup*: copying observations that were worked out beforehand. Actions are "
        "random unless held. Cases take turns, round after round: median, spread as the distance "
        "between the quartiles. The error is the largest difference of a code between an episode "
        "in the batch and the same episode alone. *Cached scene*: neither motion nor defocus.",
    ]
    for size, threads in sorted({(r["size"], r["threads"]) for r in rows}, reverse=True):
        body = []
        for row in rows:
            if (row["size"], row["threads"]) != (size, threads):
                continue
            error = "" if row["error_codes"] is None else str(row["error_codes"])
            memory = "" if row["memory_mib"] is None else f" ({row['memory_mib']:,.0f} MiB)"
            cells = [f"{row['case']}{memory}", str(row["num_envs"])]
            cells += [f"{row['steps_per_second']:,.0f}", f"{row['ratio_to_kernel']:.2f}"]
            body.append([*cells, f"{row['ratio_to_lookup']:.3f}", f"{row['spread']:.0%}", error])
        head = ("envs", "steps/s", "of kernel", "of lookup", "spread", "error [codes]")
        title = f"{size} x {size}, {threads} thread{'s' * (threads > 1)}"
        lines += [f"### {title}", table(("case", *head), body)]
    return lines


def _noise(noise: dict[str, dict[str, float]]) -> list[str]:
    body = [
        (title, *(f"{noise[kind][name]:.5f}" for kind in ("bank", "exact")))
        for name, title in NAMES.items()
    ]
    return [
        f"Frames of an even grey scene from the environment, {noise['bank']['samples']:,.0f} "
        "samples each, less the known mean, over the known standard deviation. Exact normals show "
        "what chance alone gives.",
        table(("statistic", "bank", "exact"), body),
    ]


def _growth(meta: dict[str, Any]) -> list[str]:
    lines = [
        "Each point in a process of its own. Memory is the peak above what the process held with "
        "all libraries loaded. Exponents: least squares on logarithms over the upper two decades, "
        "with the standard error.",
        table(
            ("curve", "against", "time", "memory", "preparation"),
            [
                [s["name"], s["against"], *(_exponent(s["exponents"].get(k)) for k in _QUANTITIES)]
                for s in meta["growth"]
            ],
        ),
    ]
    for against in dict.fromkeys(s["against"] for s in meta["growth"]):
        own = [s for s in meta["growth"] if s["against"] == against]
        head = [against]
        for series in own:
            for key in series["exponents"]:
                head.append(f"{series['name']}: {_QUANTITIES[key]}")
        body = []
        for i, point in enumerate(own[0]["points"]):
            cells = [f"{point['x']:,.0f}"]
            for series in own:
                values = series["points"][i]
                cells += [
                    f"{values[key]:.1f}" if key == "mib" else f"{values[key] * 1e3:.2f}"
                    for key in series["exponents"]
                ]
            body.append(cells)
        lines += [f"### Against {against}", table(head, body)]
    body = [
        [
            f"{row['height']} x {row['width']}",
            row["noise"],
            f"{row['seconds'] * 1e6:.0f}",
            f"{row['limit'] * 1e6:.0f}",
            f"{row['ratio']:.2f} ± {row['spread'] / 2:.2f}",
        ]
        for row in meta["marginal"]
    ]
    head = ["frame", "noise", "one more state [µs]", "its scale, noise, clip [µs]", "ratio"]
    return [*lines, "### One more state of a sweep, one thread", table(head, body)]


#: Headings of the quantities of a point.
_QUANTITIES = {"seconds": "time [ms]", "mib": "memory [MiB]", "preparation": "preparation [ms]"}


def _exponent(fit: Sequence[float] | None) -> str:
    return "" if fit is None else f"{fit[0]:.2f} ± {fit[1]:.2f}"


def _full_frame(rows: list[dict[str, Any]]) -> list[str]:
    body = []
    for row in rows:
        file = row["name"] or "synthetic DNG"
        stages = [f"{row['stages'][name]['seconds']:.2f}" for name in STAGES]
        peak = max(row["stages"], key=lambda name: row["stages"][name]["peak_mib"])
        limits = [f"{row['limits'][name]:.3f}" for name in ("unpack", "write", "first", "develop")]
        body.append(
            [
                f"{row['case']}, {file}, {row['megapixels']:.1f} MP",
                f"{row['seconds']:.2f}",
                f"{row['first']:.2f}",
                f"{row['peak_mib']:,.0f}",
                *stages,
                peak,
                *limits,
            ]
        )
    head = [
        "case",
        "all [s]",
        "first frame [s]",
        "peak [MiB]",
        *(f"{name} [s]" for name in STAGES),
        "peak in",
    ]
    head += ["LibRaw: unpack [s]", "write [s]", "both, first [s]", "develop [s]"]
    modules = "; ".join(f"{r['case']}: {', '.join(r['modules'])}" for r in rows if not r["name"])
    return [
        f"A raw file through `read_raw`, `simulate` and `write_dng`, {CORES} threads, every run in "
        "a process of its own, libraries, kernels and networks loaded. The process' first frame is "
        "given its memory by the system; later ones, and the stages, use it again (the full model "
        "ran once). Peak memory is that of the whole process. Beside it LibRaw, later files and "
        "the first: unpacking, writing as many bytes; and its own development of the file. The "
        "synthetic DNG is not compressed, which leaves LibRaw little to do.",
        table(head, body),
        f"Modules of the plan: {modules}.",
    ]


def _profile(profile: dict[str, list[dict[str, Any]]]) -> list[str]:
    lines = [
        "64 environments, 128 x 128, random actions, one thread, sampled every millisecond. Work "
        "of other libraries counts for the function that calls them.",
    ]
    for name, rows in profile.items():
        body = [(r["function"], f"{r['share']:.0%}", f"{r['microseconds']:.1f}") for r in rows]
        lines += [f"### {name.capitalize()}", table(("function", "share", "per step [µs]"), body)]
    return lines


def _gpu(gpu: dict[str, Any]) -> list[str]:
    if gpu["name"] is None:
        return ["No GPU was there when this was measured."]
    body = [
        (
            f"{row['height']} x {row['width']}",
            row["noise"],
            f"{row['seconds'] * 1e6:.1f}",
            f"{row['share_of_bandwidth']:.0%}",
        )
        for row in gpu["rows"]
    ]
    return [
        f"{gpu['name']}, {gpu['bytes_per_second'] / 1e9:,.0f} GB/s measured by copying. The limit "
        "is the time to read the light and to write the frame.",
        table(("frame", "noise", "one state of a sweep [µs]", "share of the limit"), body),
    ]


def _figure(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.2f}"
