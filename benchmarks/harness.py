"""One way to run a benchmark: parts in processes of their own, rows, a page with tables, plots.

A benchmark is a module or a folder with a `Benchmark`, whose method `run` is what `ae-env bench`
calls. It names its parts (`Part`); each part is a function that returns JSON values and runs in a
fresh Python (`benchmarks.isolated`). A part that is done is kept on disk until the whole run is,
so that a run that was stopped continues. A function of all results then writes the `Report`.
"""

from __future__ import annotations

import io
import json
import math
import re
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from agents.cli.console import print_files, progress_bars
from agents.report.evaluation import Cell, to_markdown
from agents.report.evaluation import cell as markdown_cell
from agents.report.plots import write_palette_png
from benchmarks.isolated import CORES, ROOT, isolated
from simulator import CameraProfile
from simulator.reference.camera import ReferenceScene
from simulator.utils.files import data_folder as data_root
from simulator.utils.files import result_meta, write_atomically, write_results

Row = dict[str, Any]
#: Significant digits of numbers in result files.
DIGITS = 6
#: Folder of what unfinished runs have measured.
RUNS = ROOT / "runs" / "bench"


# -- parts ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Part:
    """One piece of a benchmark, measured in a process of its own.

    Args:
        name: Key of its result.
        task: Function of a module; takes and returns what JSON can hold.
        arguments: Of `task`.
        threads: Threads that torch and the kernels may use.
        fresh_cache: Whether it finds nothing on disk that earlier runs computed.
        timeout: Seconds after which it is stopped.
        depends: Other things that its result depends on, such as checksums of weights.
    """

    name: str
    task: Callable[..., Any]
    arguments: Mapping[str, Any] = field(default_factory=dict)
    threads: int = CORES
    fresh_cache: bool = False
    timeout: float = 4 * 3600.0
    depends: Mapping[str, Any] = field(default_factory=dict)

    def run(self) -> Any:
        """The result of `task`, of a process of its own."""
        options: dict[str, Any] = {"fresh_cache": self.fresh_cache, "timeout": self.timeout}
        return isolated(self.task, num_threads=self.threads, **options, **self.arguments)


class FinishedParts:
    """Results of parts on disk, one file each.

    Args:
        folder: Where they lie.
        words: Values that all of them depend on besides the code.
        code: Files and folders of the checkout whose code they depend on; a result counts for the
            very same code only. Modules named ``report`` present results and do not count.
    """

    def __init__(self, folder: Path, *words: Any, code: Sequence[str] = ()) -> None:
        files: list[Path] = []
        for name in code:
            path = ROOT / name
            files += path.rglob("*.py") if path.is_dir() else [path.with_suffix(".py")]
        checksum = 0
        for path in sorted(file for file in files if file.stem != "report"):
            checksum = zlib.crc32(path.read_bytes(), checksum)
        self._folder, self._words = folder, [checksum, *words]

    def get(self, name: str, measure: Callable[[], Any]) -> Any:
        """The result under `name`: of an earlier run, or what `measure` returns."""
        key = zlib.crc32(json.dumps([*self._words, name]).encode())
        stem = "".join(c if c.isalnum() else "_" for c in name)[:48]
        path = self._folder / f"{stem}-{key:08x}.json"
        try:
            return json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):  # not there, or damaged
            text = json.dumps(measure())
        write_atomically(path, text)
        return json.loads(text)

    def forget(self) -> None:
        """Removes all results, those of earlier code too: the next run measures everything."""
        for path in self._folder.glob("*.json"):
            path.unlink(missing_ok=True)


# -- a benchmark ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Report:
    """Result of a benchmark.

    Args:
        rows: Rows of the result file.
        tables: What stands between the marks ``<!-- NAME -->`` and ``<!-- end -->`` of the page, by
            name: Markdown of `table` and `pivot`. All else on a page is written by hand.
        meta: Entries of the result file besides its origin.
        figures: Pictures by file name beside the page (``"throughput.png"``), or by path.
    """

    rows: Sequence[Row]
    tables: Mapping[str, str] = field(default_factory=dict)
    meta: Mapping[str, Any] = field(default_factory=dict)
    figures: Mapping[str | Path, Figure] = field(default_factory=dict)


@dataclass(frozen=True)
class Benchmark:
    """A measurement whose results are in ``docs/results``.

    Args:
        name: Of its command; files are named after it.
        title: Heading of the page.
        parts: ``parts(seed, quick)``: what is measured, in order.
        report: ``report(results, meta)``: what is written, of the results by name of the part.
        code: Files and folders of the checkout that its results depend on.
        file: Stem of the files, if not `name`.
    """

    name: str
    title: str
    parts: Callable[..., Sequence[Part]]
    report: Callable[[dict[str, Any], dict[str, Any]], Report]
    code: Sequence[str]
    file: str = ""

    def run(self, out: Path, *, seed: int = 0, quick: bool = False, **options: Any) -> None:
        """Measures what no earlier run has, and writes ``.json``, ``.md`` and pictures.

        Args:
            out: Folder of results.
            seed: Of everything random.
            quick: A short version, to see that everything runs.
            options: Further arguments of `parts`.
        """
        words = [seed, quick, {name: str(value) for name, value in options.items()}]
        finished = FinishedParts(RUNS / self.name, *words, code=self.code)
        shown = "".join(
            f" {value}" if name == "folder" else f" --{name} {value}"
            for name, value in options.items()
        )
        command = f"ae-env bench {self.name}{shown}{' --quick' * quick}"
        meta = result_meta(command, seed) | {"quick": quick}
        parts = self.parts(seed, quick, **options)
        results = {}
        with progress_bars() as progress, progress(self.name) as task:
            for number, part in enumerate(parts):
                task(number, len(parts), part.name)
                key = f"{part.name} {part.arguments} {part.depends}"
                results[part.name] = finished.get(key, part.run)
            task(1, 1)
        stem = self.file or self.name
        files = write_report(self.report(results, meta), out, stem, self.title, meta)
        finished.forget()
        print_files(files)


def write_report(
    report: Report, out: Path, stem: str, title: str, meta: Mapping[str, Any]
) -> dict[str, Path]:
    """Writes the files of a report; their paths by what they hold."""
    rows, more = rounded(list(report.rows)), rounded(dict(report.meta))
    files = {"numbers": write_results(out / f"{stem}.json", rows, {**meta, **more})}
    for name, figure in report.figures.items():
        path = name if isinstance(name, Path) else out / name
        files[f"picture {path.stem}"] = write_picture(path, figure)
    if report.tables:
        tables = {"origin": origin(meta), **report.tables}
        files["page"] = write_atomically(
            out / f"{stem}.md", filled_page(stem, title, tables, report.figures)
        )
    return files


def filled_page(
    stem: str, title: str, tables: Mapping[str, str], figures: Iterable[str | Path] = ()
) -> str:
    """The page ``docs/results/STEM.md`` with new tables between its marks.

    Where there is no such page, one of the title, the tables and the figures beside it.

    Raises:
        ValueError: If the page and the benchmark do not name the same tables.
    """
    path = ROOT / "docs" / "results" / f"{stem}.md"
    if path.is_file():
        page = path.read_text(encoding="utf-8")
    else:
        blocks = [f"# {title}", *(f"<!-- {name} -->\n<!-- end -->" for name in tables)]
        page = "\n\n".join([*blocks, *(f"![{name}]({name})" for name in figures)]) + "\n"
    marked = re.findall(r"^<!-- ([\w-]+) -->$", page, re.MULTILINE)
    if sorted(name for name in marked if name != "end") != sorted(tables):
        raise ValueError(f"{path} must have the marks of {sorted(tables)}, not of {marked}")

    def fill(found: re.Match[str]) -> str:
        return f"<!-- {found[1]} -->\n{tables[found[1]].strip()}\n<!-- end -->"

    # A table that was there may hold anything but the end mark.
    return re.sub(r"^<!-- ((?!end)[\w-]+) -->\n.*?^<!-- end -->$", fill, page, flags=re.M | re.S)


def origin(meta: Mapping[str, Any]) -> str:
    """First block of a page: command, commit, date, seed, machine."""
    machine, commit = meta["machine"], meta["commit"] or "unknown"
    commit = commit[:12] + "+changes" * commit.endswith("+changes")
    quick = " **A quick run: its numbers are rough.**" if meta.get("quick") else ""
    return (
        f"`{meta['command']}`, commit {commit}, {meta['date'][:10]}, seed {meta['seed']}, "
        f"{machine['cpu']}, {machine['cores']} cores, GPU: {machine['gpu'] or 'none'}.{quick}"
    )


def rounded(value: Any) -> Any:
    """`value` with numbers of `DIGITS` significant digits; None for numbers that are not finite.

    >>> rounded({"a": [1 / 3, float("nan"), 10**9], "b": True})
    {'a': [0.333333, None, 1000000000], 'b': True}
    """
    if isinstance(value, Mapping):
        return {key: rounded(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(entry) for entry in value]
    if isinstance(value, np.generic | np.ndarray):
        return rounded(value.tolist())
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value


def write_picture(path: Path, figure: Figure) -> Path:
    """Writes a figure: photographs as WebP, plots as PNG with a palette, a third of the bytes."""
    from PIL import Image

    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".webp":
        Image.open(stream).convert("RGB").save(path, quality=80, method=6)
        return path
    return write_palette_png(path, Image.open(stream))


def side_by_side(pictures: Mapping[str, torch.Tensor]) -> Figure:
    """Pictures (3, H, W), uint8 or in [0, 1], of one size, each below its title."""
    height, width = next(iter(pictures.values())).shape[-2:]
    shape = (3.0 * len(pictures), 3.0 * height / width + 0.3)
    figure = Figure(figsize=shape, dpi=110, layout="constrained")
    axes = figure.subplots(1, len(pictures), squeeze=False)[0]
    for axis, (title, picture) in zip(axes, pictures.items(), strict=True):
        axis.imshow(picture.permute(1, 2, 0).numpy())
        axis.set_title(title, fontsize=9)
        axis.axis("off")
    return figure


def data_folder(name: str) -> Path:
    """Sub-folder `name` of the folder of real files.

    Raises:
        FileNotFoundError: If it is not there.
    """
    root = data_root()
    if root is None or not (root / name).is_dir():
        raise FileNotFoundError(
            f"there is no folder {name!r} of real files in {root or 'AE_ENV_DATA'}: set "
            "AE_ENV_DATA to the folder that holds it"
        )
    return root / name


# -- tables ---------------------------------------------------------------------------------------


def cell(row: Row, content: Cell) -> str:
    """Text of a cell; empty where a value of its format is missing or None.

    >>> cell({"ms": 1.25, "error": None}, "{ms:.1f} ms"), cell({"error": None}, "{error:.2f}")
    ('1.2 ms', '')
    """
    return markdown_cell(row, content, missing="")


def table(rows: Iterable[Row], columns: Mapping[str, Cell]) -> str:
    """A Markdown table with a line for each row, see `agents.report.evaluation.to_markdown`.

    `columns` maps headings to content; columns that are empty in every row are left out.
    """
    return to_markdown(rows, columns, missing="")


def pivot(
    rows: Iterable[Row], *, line: tuple[str, Cell], columns: Cell, contents: Mapping[str, Cell]
) -> str:
    """A Markdown table with a line for each value of one thing and columns for those of another.

    Args:
        rows: Rows to show, one of each pair.
        line: Heading of the first column, and name of a row's line.
        columns: Name of a row's column, or group of columns.
        contents: Content of each column of a group by its heading; an empty heading for one alone.
    """
    heading, named = line
    rows, groups = list(rows), dict[str, None]()
    lines: dict[str, dict[str, Row]] = {}
    for row in rows:
        group = cell(row, columns)
        groups[group] = None
        lines.setdefault(cell(row, named), {}).setdefault(group, row)
    shown: dict[str, Cell] = {heading: lambda row: row["line"]}
    for group in groups:
        for name, content in contents.items():
            shown[": ".join(filter(None, (group, name)))] = _of_group(group, content)
    return table(({"line": name, "groups": own} for name, own in lines.items()), shown)


def _of_group(group: str, content: Cell) -> Cell:
    return lambda row: cell(row["groups"][group], content) if group in row["groups"] else ""


def bullets(lines: Iterable[str]) -> str:
    """A Markdown list."""
    return "\n".join(f"- {line}" for line in lines)


def sections(rows: Iterable[Row], title: Cell, show: Callable[[list[Row]], str]) -> list[str]:
    """A heading of the third level and a block for each group of rows with the same title."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(cell(row, title), []).append(row)
    return [block for name, own in groups.items() for block in (f"### {name}", show(own))]


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Lower quartile, median and upper quartile."""
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    return float(low), float(middle), float(high)


#: PSNR of two images that are the same, or nearer than this [dB].
LARGEST_PSNR = 80.0


def psnr(estimate: Tensor, truth: Tensor, peak: float = 1.0) -> float:
    """PSNR over all planes [dB], at most `LARGEST_PSNR`."""
    error = float((estimate.double() - truth.double()).square().mean()) / peak**2
    return LARGEST_PSNR if error <= 0 else min(LARGEST_PSNR, -10.0 * math.log10(error))


def clipped(image: Tensor, camera: CameraProfile) -> Tensor:
    """`image` (..., 4, H, W) within what a capture can show: [-pedestal, 1]."""
    pedestal = torch.tensor(camera.pedestal).to(image)[:, None, None]
    return torch.maximum(image, -pedestal).clamp(max=1.0)


def recorded(signal: Tensor, camera: CameraProfile) -> Tensor:
    """`signal` (..., 4, H, W) in whole digital numbers of the camera, 1 at white."""
    span, black = (torch.tensor(v)[:, None, None] for v in (camera.span, camera.black_level))
    numbers = (signal * span + black).round().clamp(0.0, camera.white_level)
    return (numbers - black) / span


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
