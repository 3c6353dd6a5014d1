"""Whether compiling the networks pays: eager and compiled in turns, one full transition each."""

from __future__ import annotations

import os
import shutil
from typing import Any

import torch

from benchmarks.simulator.models import Models
from benchmarks.simulator.scenes import Progress
from benchmarks.work_precision.measures import quartiles, timed
from benchmarks.work_precision.methods import Dtype, simulator
from benchmarks.work_precision.trials import trials
from simulator import CameraSettings, CameraSimulator
from simulator.networks.aperture_module import DefocusMap

#: Height and width, and rounds.
SIZE, ROUNDS = 128, 15
#: From this ratio on, compiling counts as paying.
PAYS = 1.1
_SETTINGS = CameraSettings(100, 1 / 15, 4)


def measure(
    models: Models, *, seed: int, quick: bool, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """One row per preset and type; one row with the reason where nothing could be compiled.

    Args:
        models: What is measured.
        seed: Of the source's noise.
        quick: Leaves it out, as compiling takes minutes.
        progress: Called with the preset and the share that is done.
    """
    if quick:
        return [_skipped("the quick run leaves it out: compiling takes minutes")]
    compiler = os.environ.get("CXX", "g++")
    if shutil.which(compiler) is None:
        return [_skipped(f"there is no C++ compiler ({compiler})")]
    cases: list[tuple[str, Dtype]] = [("compact", "float32"), ("compact", "bfloat16")]
    if models.paper is not None:
        cases += [("paper", "float32"), ("paper", "bfloat16")]
    rows = []
    for number, (preset, dtype) in enumerate(cases):
        if progress is not None:
            progress(f"{preset}, {dtype}", number / len(cases))
        try:
            rows.append(_row(models, preset, dtype, seed))
        except Exception as error:  # the compiler's own; a measurement of it must not end the run
            rows.append(_skipped(f"{type(error).__name__}: {str(error).splitlines()[0][:200]}"))
            rows[-1] |= {"method": f"{preset} full", "dtype": dtype}
    return rows


def _skipped(reason: str) -> dict[str, Any]:
    return {"part": "compiled", "method": "", "skipped": reason}


def _row(models: Models, preset: str, dtype: Dtype, seed: int) -> dict[str, Any]:
    eager = simulator(models, preset, dtype)
    compiled = _compiled(simulator(models, preset, dtype))
    raw = trials((SIZE, SIZE))[0].raw(seed)
    runs = {"eager": eager, "compiled": compiled}
    _, first = timed(compiled.stages, raw, _SETTINGS)
    images = {name: run.stages(raw, _SETTINGS).light for name, run in runs.items()}
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(ROUNDS):
        for name, run in runs.items():
            times[name].append(timed(run.stages, raw, _SETTINGS)[1])
    ratio, low, high = quartiles(
        [a / b for a, b in zip(times["eager"], times["compiled"], strict=True)]
    )
    return {
        "part": "compiled",
        "method": f"{preset} full",
        "height": SIZE,
        "width": SIZE,
        "dtype": dtype,
        "eager_ms_per_state": quartiles(times["eager"])[0],
        "ms_per_state": quartiles(times["compiled"])[0],
        "ratio": ratio,
        "ratio_25_percent": low,
        "ratio_75_percent": high,
        "pays": ratio >= PAYS,
        "first_run_seconds": first / 1e3,
        "largest_difference": float((images["eager"] - images["compiled"]).abs().max()),
    }


def _compiled(own: CameraSimulator) -> CameraSimulator:
    """`own` with its networks compiled for one size."""
    torch.compiler.reset()
    assert own.noise is not None
    assert own.aperture is not None
    for module in (own.noise, own.aperture):
        # The kernels that the map's features come from are compiled already, by numba: inside
        # torch's tracing they fail.
        network = module.network
        parts = [network]
        if isinstance(network, DefocusMap):
            parts = [network.head, *network.blocks, network.tail]
        for part in parts:
            part.compile(dynamic=False)
    return own
