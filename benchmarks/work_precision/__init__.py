"""Error against run time: every method, the plan's predictions, what is left out.

    ae-env bench work-precision

Needs trained weights as ``ae-env bench simulator`` does: ``compact`` comes with the package,
``paper``, ``pc`` and ``dl`` are trained once where ``runs/simulator`` does not hold them.
"""

from __future__ import annotations

from dataclasses import replace

from benchmarks.fidelity.models import checksums, train_missing
from benchmarks.harness import Benchmark, Part
from benchmarks.work_precision import plans, precision
from benchmarks.work_precision.methods import FAMILY
from benchmarks.work_precision.report import report
from benchmarks.work_precision.trials import SIZES

#: Processes among which the scenes of the plan's predictions are shared out: of the validation
#: split, which the plan's constants were calibrated on, and of the test split.
_SHARES = {"validation": 4, "test": 8}


def parts(seed: int, quick: bool) -> list[Part]:
    if not quick:
        train_missing()
    common = {"seed": seed, "quick": quick}
    found = [
        Part(f"precision {size[0]}", precision.measure, {"size": size, **common}) for size in SIZES
    ]
    for split, shares in _SHARES.items():
        for share in range(1 if quick else shares):
            arguments = {"split": split, "share": share, "shares": shares, **common}
            found.append(Part(f"bound {split} {share}", plans.bound, arguments))
    found += [Part(kind, plans.left_out, {"kind": kind, **common}) for kind in plans.KINDS]
    own, every = checksums(*FAMILY), checksums()
    return [
        replace(part, depends=every if part.task is precision.measure else own) for part in found
    ]


BENCHMARK = Benchmark(
    name="work-precision",
    title="Error against run time",
    parts=parts,
    report=report,
    code=("simulator", "ae_env/scenes", "benchmarks/work_precision", "benchmarks/harness"),
    file="work_precision",
)
run = BENCHMARK.run
