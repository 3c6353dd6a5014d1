"""One way to run a benchmark: parts in processes of their own, rows, a page with tables, plots.

A benchmark is a module or a folder whose function `run`, which `benchmark` makes, is what
`ae-env bench` calls. Each `Part` runs in a fresh Python (`benchmarks.isolated`), and is kept on
disk until the whole run is done, so that a run that was stopped continues.
"""

import inspect
import json
import math
import os
import re
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.stats import bootstrap, spearmanr
from skimage.metrics import structural_similarity
from torch import Tensor

from agents.cli.console import print_files, progress_bars
from agents.report.evaluation import Cell, to_markdown
from agents.report.evaluation import cell as markdown_cell
from agents.report.plots import write_figure
from benchmarks.isolated import CORES, ROOT
from simulator import CameraProfile
from simulator.reference.reference_camera import ReferenceScene
from simulator.utils.cache import CACHE_VARIABLE, Store, cache_key
from simulator.utils.files import data_folder, result_meta, write_atomically, write_results

Row = dict[str, Any]
#: Content of the cells by heading; or as text: ``"heading = content | heading = content"``.
Columns = str | Mapping[str, Cell]
#: Significant digits of numbers in result files.
DIGITS = 6
#: Folder of what unfinished runs have measured.
RUNS = ROOT / "runs" / "bench"
#: What results depend on: code, and trained networks, those that do not come with the packages too.
_CODE = ("simulator", "ae_env", "agents", "benchmarks", "runs/simulator")


# -- a benchmark ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Part:
    """One piece of a benchmark, measured in a process of its own.

    Args:
        name: Key of its result.
        task: Function of a module; takes and returns what JSON can hold.
        arguments: Of `task`; ``seed`` and ``quick``, if it has them, come from the run.
        threads: Threads that torch and the kernels may use.
        fresh_cache: Whether it finds nothing on disk that earlier runs computed.
    """

    name: str
    task: Callable[..., Any]
    arguments: Mapping[str, Any] = field(default_factory=dict)
    threads: int = CORES
    fresh_cache: bool = False

    def run(self) -> Any:
        """The result of `task`, run by a fresh Python.

        Raises:
            ValueError: If it refuses its arguments; in its own words.
            RuntimeError: If it fails otherwise; with its last words.
        """
        task = f"{self.task.__module__}:{self.task.__qualname__}"
        command = [sys.executable, "-m", "benchmarks.isolated", task, json.dumps(self.arguments)]
        variables = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), str(self.threads))
        with tempfile.TemporaryDirectory() as folder:
            if self.fresh_cache:
                variables[CACHE_VARIABLE] = folder
            options: Any = {"cwd": ROOT, "env": os.environ | variables}
            done = subprocess.run(command, capture_output=True, text=True, check=False, **options)
        if done.returncode:
            words = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
            kind, _, message = words[-1].partition(": ")
            if kind == "ValueError":
                raise ValueError(message)
            raise RuntimeError(f"{task}({self.arguments}): {words[-1]}")
        return json.loads(done.stdout.splitlines()[-1])


@dataclass(frozen=True)
class Report:
    """Result of a benchmark.

    Args:
        rows: Rows of the result file.
        tables: What stands between the marks ``<!-- NAME -->`` and ``<!-- end -->`` of the page, by
            name: Markdown of `table` and `pivot`, empty where a part was not measured. All else on
            a page is written by hand.
        meta: Entries of the result file besides its origin.
        figures: Pictures by file name beside the page (``"throughput.png"``), or by path.
    """

    rows: Sequence[Mapping[Any, Any]]
    tables: Mapping[str, str] = field(default_factory=dict)
    meta: Mapping[str, Any] = field(default_factory=dict)
    figures: Mapping[str | Path, Figure] = field(default_factory=dict)


def benchmark(
    name: str,
    parts: Callable[..., Sequence[Part]],
    report: Callable[[dict[str, Any], dict[str, Any]], Report],
) -> Callable[..., None]:
    """The function that measures what no earlier run has, and writes ``.json``, ``.md``, pictures.

    Args:
        name: Of its command and its files.
        parts: ``parts(seed, quick, **options)``: what is measured, in order.
        report: ``report(results, meta)``: what is written, of the results by name of the part.
    """

    def run(out: Path, *, seed: int = 0, quick: bool = False, **options: Any) -> None:
        words = (f" {f'--{k} ' * (k != 'folder')}{v}" for k, v in options.items())
        command = f"ae-env bench {name}{''.join(words)}{' --quick' * quick}"
        given = {"seed": seed, "quick": quick}
        meta = result_meta(command, seed) | {"quick": quick}
        data = [v for v in options.values() if isinstance(v, Path)]
        store, state = Store(RUNS / name), [command, seed, *_state(data)]
        chosen, results = parts(seed, quick, **options), {}
        with progress_bars() as progress, progress(name) as task:
            for number, part in enumerate(chosen):
                task(number, len(chosen), part.name)
                taken = inspect.signature(part.task).parameters
                own = {name: value for name, value in given.items() if name in taken}
                part = replace(part, arguments=own | dict(part.arguments))
                key = cache_key("parts", [*state, f"{part.name} {part.arguments}"])
                if (found := store.get(key)) is None:
                    found = {"result": json.dumps(part.run())}
                    store.put(key, found)
                results[part.name] = json.loads(found["result"])
            task(1, 1)
        files = write_report(report(results, meta), out, name.replace("-", "_"), meta)
        store.clear()  # the next run measures everything
        print_files(files)

    return run


def _state(data: Iterable[Path]) -> list[Any]:
    """Checksum of the very code and networks; name, size and time of every file of `data`."""
    files, checksum = (path for name in _CODE for path in (ROOT / name).rglob("*")), 0
    for path in sorted(p for p in files if p.suffix in (".py", ".safetensors")):
        checksum = zlib.crc32(path.read_bytes(), checksum)
    given = sorted(file for path in data for file in (path, *path.rglob("*")) if file.is_file())
    return [checksum, *([str(f), f.stat().st_size, f.stat().st_mtime_ns] for f in given)]


def write_report(report: Report, out: Path, stem: str, meta: Mapping[str, Any]) -> dict[str, Path]:
    """Writes the files of a report; their paths by what they hold."""
    rows, more = rounded(list(report.rows)), rounded(dict(report.meta))
    files = {"numbers": write_results(out / f"{stem}.json", rows, {**meta, **more})}
    for name, figure in report.figures.items():
        path = name if isinstance(name, Path) else out / name
        files[f"picture {path.stem}"] = write_figure(path, figure)
    if report.tables:
        tables = {"origin": origin(meta), **report.tables}
        page = filled_page(stem, tables, report.figures)
        files["page"] = write_atomically(out / f"{stem}.md", page)
    return files


def filled_page(stem: str, tables: Mapping[str, str], figures: Iterable[str | Path] = ()) -> str:
    """The page ``docs/results/STEM.md`` with new tables between its marks.

    Where there is no such page, one of the tables and the figures beside it.

    Raises:
        ValueError: If the page and the benchmark do not name the same tables.
    """
    path = ROOT / "docs" / "results" / f"{stem}.md"
    if path.is_file():
        page = path.read_text(encoding="utf-8")
    else:
        blocks = [f"# {stem}", *(f"<!-- {name} -->\n<!-- end -->" for name in tables)]
        page = "\n\n".join([*blocks, *(f"![{name}]({name})" for name in figures)]) + "\n"
    marked = re.findall(r"^<!-- ([\w-]+) -->$", page, re.MULTILINE)
    if sorted(name for name in marked if name != "end") != sorted(tables):
        raise ValueError(f"{path} must have the marks of {sorted(tables)}, not of {marked}")

    def fill(found: re.Match[str]) -> str:
        text = tables[found[1]].strip() or "Not measured in this run."
        return f"<!-- {found[1]} -->\n{text}\n<!-- end -->"

    # A table that was there may hold anything but the end mark.
    return re.sub(r"^<!-- ((?!end)[\w-]+) -->\n.*?^<!-- end -->$", fill, page, flags=re.M | re.S)


def origin(meta: Mapping[str, Any]) -> str:
    """First block of a page: command, commit, date, seed, machine."""
    machine, (commit, _, changed) = meta["machine"], (meta["commit"] or "unknown").partition("+")
    quick = " **A quick run: its numbers are rough.**" if meta.get("quick") else ""
    return (
        f"`{meta['command']}`, commit {commit[:12]}{'+' * bool(changed)}{changed}, "
        f"{meta['date'][:10]}, seed {meta['seed']}, {machine['cpu']}, {machine['cores']} cores, "
        f"GPU: {machine['gpu'] or 'none'}.{quick}"
    )


def rounded(value: Any) -> Any:
    """`value` with numbers of `DIGITS` significant digits; None for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {key: rounded(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(entry) for entry in value]
    if isinstance(value, np.generic | np.ndarray):
        return rounded(value.tolist())
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value


def side_by_side(*lines: Mapping[str, Tensor]) -> Figure:
    """Lines of pictures (3, H, W), uint8 or in [0, 1], of one size, each below its title."""
    height, width = next(iter(lines[0].values())).shape[-2:]
    shape = (3.0 * len(lines[0]), (3.0 * height / width + 0.3) * len(lines))
    figure = Figure(figsize=shape, dpi=110, layout="constrained")
    grid = figure.subplots(len(lines), len(lines[0]), squeeze=False)
    for axes, line in zip(grid, lines, strict=True):
        for axis, (title, picture) in zip(axes, line.items(), strict=True):
            axis.imshow(picture.permute(1, 2, 0).numpy())
            axis.set_title(title, fontsize=9)
            axis.axis("off")
    return figure


def panels(curves: Iterable[Row], width: float = 3.6, **axes: Any) -> Figure:
    """Lines in panels of `width` inches, three in a row; a legend wherever the labels are new.

    Each curve has ``panel``, ``label``, ``x``, ``y`` and perhaps ``style``, of `Axes.plot`. `axes`
    are arguments of `Axes.set`.
    """
    groups: dict[str, list[Row]] = {}
    for curve in curves:
        groups.setdefault(curve["panel"], []).append(curve)
    columns = min(3, len(groups))
    lines = -(-len(groups) // columns)
    figure = Figure(figsize=(width * columns, 3.0 * lines), dpi=90, layout="constrained")
    axes_of = figure.subplots(lines, columns, squeeze=False).flat
    explained = []
    for (title, own), axis in zip(groups.items(), axes_of, strict=False):
        for curve in own:
            axis.plot(curve["x"], curve["y"], label=curve["label"], **curve.get("style", {}))
        axis.set(**{"title": title, **axes})
        axis.grid(alpha=0.3)
        labels = [curve["label"] for curve in own]
        if labels not in explained and set(labels) != {"_"}:
            explained.append(labels)
            axis.legend(fontsize=6)
    for axis in axes_of:
        axis.set_axis_off()
    return figure


def real_files(name: str) -> Path:
    """Sub-folder `name` of the folder of real files.

    Raises:
        FileNotFoundError: If it is not there.
    """
    root = data_folder()
    if root is None or not (root / name).is_dir():
        where = f"{root or 'AE_ENV_DATA'}: set AE_ENV_DATA to the folder that holds it"
        raise FileNotFoundError(f"there is no folder {name!r} of real files in {where}")
    return root / name


# -- tables ---------------------------------------------------------------------------------------


def cell(row: Row, content: Cell) -> str:
    """Text of a cell; empty where a value of its format is missing or None."""
    return markdown_cell(row, content, missing="")


def columns_of(columns: Columns) -> Mapping[str, Cell]:
    """Content by heading.

    >>> columns_of("scene = {scene} | time [ms] = {ms:.1f}"), columns_of("{ms:.1f}")
    ({'scene': '{scene}', 'time [ms]': '{ms:.1f}'}, {'': '{ms:.1f}'})
    """
    if not isinstance(columns, str):
        return columns
    pairs = (column.rpartition(" = ") for column in " ".join(columns.split()).split(" | "))
    return {heading: content for heading, _, content in pairs}


def _words(row: Mapping[Any, Any]) -> Row:
    answers = ("no", "yes")
    return {k: answers[bool(v)] if isinstance(v, bool | np.bool_) else v for k, v in row.items()}


def table(rows: Iterable[Mapping[Any, Any]], columns: Columns) -> str:
    """A Markdown table with a line for each row, see `agents.report.evaluation.to_markdown`.

    Columns that are empty in every row are left out; what is true or false is "yes" or "no".
    """
    shown = list(map(_words, rows))
    return to_markdown(shown, columns_of(columns), missing="") if shown else ""


def pivot(rows: Iterable[Mapping[Any, Any]], line: Columns, group: Cell, contents: Columns) -> str:
    """A Markdown table with a line for each value of one thing and columns for those of another.

    Args:
        rows: Rows to show, one of each pair.
        line: Heading of the first column, and name of a row's line.
        group: Name of a row's column, or group of columns.
        contents: Columns of a group; without a heading for one alone.
    """
    ((heading, named),) = columns_of(line).items()
    shown: dict[str, Cell] = {heading: "{line:md}"}
    lines: dict[str, Row] = {}
    for row in map(_words, rows):
        name, own = cell(row, named), cell(row, group)
        found = lines.setdefault(name, {"line": name})
        for title, content in columns_of(contents).items():
            key = ": ".join(filter(None, (own, title)))
            found.setdefault(key, cell(row, content))
            shown.setdefault(key, lambda line, key=key: line.get(key, ""))  # type: ignore[misc]
    return table(lines.values(), shown)


def sections(rows: Iterable[Row], title: Cell, show: Callable[[list[Row]], str]) -> str:
    """A heading of the third level and a block for each group of rows with the same title."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(cell(row, title), []).append(row)
    return "\n\n".join(f"### {name}\n\n{show(own)}" for name, own in groups.items())


def interval(values: np.ndarray, seed: int = 0) -> list[float]:
    """95 % bootstrap interval of the mean of `values`."""
    found = bootstrap((values,), np.mean, method="percentile", rng=seed).confidence_interval
    return [float(found.low), float(found.high)]


def correlation(first: np.ndarray, second: np.ndarray, measure: Any = spearmanr) -> float:
    """A coefficient of `scipy.stats`, Spearman's; 0 where one of the two does not vary at all."""
    varies = min(np.ptp(first), np.ptp(second)) >= 1e-12
    return float(measure(first, second).statistic) if varies else 0.0


def quartiles(values: Sequence[float] | np.ndarray) -> list[float]:
    """Lower quartile, median and upper quartile."""
    return [float(value) for value in np.quantile(values, (0.25, 0.5, 0.75))]


#: PSNR of two images that are the same, or nearer than this [dB].
LARGEST_PSNR = 80.0


def psnr(estimate: Tensor, truth: Tensor) -> float:
    """PSNR over all planes [dB] where white is 1, at most `LARGEST_PSNR`."""
    error = float((estimate.double() - truth.double()).square().mean())
    return LARGEST_PSNR if error <= 0 else min(LARGEST_PSNR, -10.0 * math.log10(error))


def ssim(image: np.ndarray, truth: np.ndarray, channel_axis: int = 0, **options: Any) -> float:
    """SSIM of images whose white is 1, see `skimage.metrics.structural_similarity`."""
    measure: Any = structural_similarity
    return float(measure(image, truth, channel_axis=channel_axis, data_range=1.0, **options))


def clipped(image: Tensor, camera: CameraProfile) -> Tensor:
    """`image` (..., 4, H, W) within what a capture can show: [-pedestal, 1]."""
    pedestal = torch.tensor(camera.pedestal).to(image)[:, None, None]
    return torch.maximum(image, -pedestal).clamp(max=1.0)


def cropped(scene: ReferenceScene, height: int, width: int) -> ReferenceScene:
    """The middle `height` x `width` packed pixels of a scene, or all of one that is smaller."""
    top, left = (max(0, n - size) // 2 for n, size in zip(scene.size, (height, width), strict=True))
    rows, columns = (
        slice(scene.pitch * first, scene.pitch * (first + n))
        for first, n in ((top, height), (left, width))
    )
    window = (..., rows, columns)
    depth = None if scene.depth is None else scene.depth[window]
    return replace(scene, light=scene.light[window].contiguous(), depth=depth)
