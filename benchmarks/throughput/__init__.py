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

from pathlib import Path

from benchmarks.harness import Benchmark, Part
from benchmarks.isolated import CORES
from benchmarks.throughput import cold_start, full_frame, growth, resets
from benchmarks.throughput.paired import measure_paired
from benchmarks.throughput.report import report
from benchmarks.throughput.steps import measure_steps

#: Threads and frame sizes of the steps.
STEPS = ((CORES, 128), (CORES, 64), (1, 128))


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
    found += [*resets.parts(seed, quick), *cold_start.parts(quick)]
    return [*found, *growth.parts(quick), *full_frame.parts(quick)]


BENCHMARK = Benchmark(
    name="throughput",
    title="Throughput",
    parts=parts,
    report=report,
    code=("simulator", "ae_env", "benchmarks/throughput"),
)
run = BENCHMARK.run
