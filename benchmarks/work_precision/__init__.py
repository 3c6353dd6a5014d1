"""Error against run time: every method, the sweep, the plan's predictions, what is left out.

    ae-env bench work-precision

Needs trained weights as ``ae-env bench simulator`` does: ``compact`` comes with the package,
``paper``, ``pc`` and ``dl`` are trained once where ``runs/simulator`` does not hold them. Runs on
two threads. A part that is finished is kept, so that a run that was stopped goes on.
"""

from __future__ import annotations

from pathlib import Path

from agents.cli.console import console, print_files
from benchmarks.simulator.parts import measure_parts
from benchmarks.simulator.scenes import data_root
from benchmarks.work_precision import bound, compiled, left_out, plots, precision, report, sweep
from simulator.utils.files import write_atomically
from simulator.utils.results import result_meta, write_results

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
#: What the numbers depend on.
MEASURED = ("simulator", "ae_env/scenes", "benchmarks/simulator", "benchmarks/work_precision")


def run(out: Path, *, seed: int = 0, quick: bool = False) -> None:
    """Measures and writes ``work_precision.json``, ``.md`` and ``.png`` under `out`.

    Args:
        out: Folder of results.
        seed: Of all noise.
        quick: Few scenes and states, and only models that are there already.
    """
    _, rows = measure_parts(
        "work-precision", PARTS, seed=seed, quick=quick, threads=THREADS, code=MEASURED
    )
    meta = result_meta(f"ae-env bench work-precision{' --quick' * quick}", seed)
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
