"""Error against run time: every method, the sweep, the plan's predictions, what is left out.

    ae-env bench work-precision

Needs trained weights as ``ae-env bench simulator`` does: ``compact`` comes with the package,
``paper``, ``pc`` and ``dl`` are trained once where ``runs/simulator`` does not hold them. Runs on
two threads. A part that is finished is kept, so that a run that was stopped goes on.
"""

from __future__ import annotations

import functools
import json
import zlib
from pathlib import Path
from typing import Any

import torch

from ae_env.console import console, print_files, progress_bars
from benchmarks.simulator.models import FOLDER, Models, load_models
from benchmarks.simulator.scenes import data_root
from benchmarks.work_precision import bound, compiled, left_out, plots, precision, report, sweep
from simulator.files import write_atomically
from simulator.results import result_meta, write_results

#: In the order in which they run.
PARTS = {
    "precision": precision,
    "sweep": sweep,
    "bound": bound,
    "left_out": left_out,
    "compiled": compiled,
}
#: Of torch; the machine that the targets are stated for has two cores.
THREADS = 2
#: The README's picture; a quick run writes beside its other results instead.
HEADLINE = Path("docs/images/work_precision.png")
#: What the numbers depend on: the code under these, but for the files with these names.
_PRESENTING = ("report", "report_parts", "plots")
_MEASURED = ("simulator", "ae_env/scenes", "benchmarks/simulator", "benchmarks/work_precision")


def run(out: Path, *, seed: int = 0, quick: bool = False) -> None:
    """Measures and writes ``work_precision.json``, ``.md`` and ``.png`` under `out`.

    Args:
        out: Folder of results.
        seed: Of all noise.
        quick: Few scenes and states, and only models that are there already.
    """
    with progress_bars() as progress:
        with progress("models") as task:

            def trained(stage: str, share: float, values: dict[str, float]) -> None:
                task(int(1000 * share), 1000, stage)

            models = load_models(FOLDER, train=not quick, progress=trained)
            task(1, 1)
        threads = torch.get_num_threads()
        torch.set_num_threads(THREADS)
        try:
            rows: list[dict[str, Any]] = []
            for name, part in PARTS.items():
                with progress(name) as task:

                    def said(what: str, share: float, task: Any = task) -> None:
                        task(int(1000 * share), 1000, what)

                    kept = _kept(name, models, seed, quick)
                    if kept.is_file():
                        own = json.loads(kept.read_text(encoding="utf-8"))
                    else:
                        own = part.measure(models, seed=seed, quick=quick, progress=said)
                        write_atomically(kept, json.dumps(own))
                    rows += own
                    task(1, 1)
            meta = result_meta(f"ae-env bench work-precision{' --quick' * quick}", seed)
        finally:
            torch.set_num_threads(threads)
    meta |= {"threads": THREADS, "quick": quick, "real_files": data_root() is not None}
    headline = out / "work_precision_headline.png" if quick else HEADLINE
    files = {
        "numbers": write_results(out / "work_precision.json", rows, meta),
        "report": write_atomically(out / "work_precision.md", report.markdown(rows, meta)),
        "plots": plots.draw_all(out / "work_precision.png", rows),
        "headline": plots.draw_headline(headline, rows),
    }
    print_files(files)
    for line in report.verdicts(rows):
        console.print(line, highlight=False)


def _kept(part: str, models: Models, seed: int, quick: bool) -> Path:
    """Where the rows of a finished part are kept.

    They count for the same code, weights and arguments alone.
    """
    words = [part, seed, quick, _code()]
    words += [card["sha256"] for card in models.cards.values()]
    name = f"work-precision-{part}-{zlib.crc32(json.dumps(words).encode()):08x}.json"
    return FOLDER / "bench" / name


@functools.cache
def _code() -> int:
    """Checksum of the code that is measured, as it was when the run began."""
    root = Path(__file__).resolve().parents[2]
    found = (path for name in _MEASURED for path in (root / name).rglob("*.py"))
    files = sorted(path for path in found if path.stem not in _PRESENTING)
    return functools.reduce(lambda value, path: zlib.crc32(path.read_bytes(), value), files, 0)
