"""The sweep on a GPU, beside what its memory could carry."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import torch

from benchmarks.throughput.growth import clean_prepared, many_states
from simulator.capture.prepared_scene import PreparedScene
from simulator.noise.generator import Noise

SIZES = ((128, 128), (512, 768), (2000, 3000))
#: Bytes that a state must move: the light is read and the frame written, float32.
_BYTES_PER_SAMPLE = 8


def measure_gpu(quick: bool) -> dict[str, Any]:
    """Seconds per state on the GPU with the share of its memory bandwidth; no rows without one."""
    if not torch.cuda.is_available():
        return {"name": None, "rows": []}
    bandwidth, states = _copy_bandwidth(), many_states(16)
    rows = []
    for height, width in SIZES[:2] if quick else SIZES:
        prepared = clean_prepared(height, width)
        prepared = replace(prepared, light=prepared.light.cuda())
        for noise in get_args(Noise):

            def sweep(prepared: PreparedScene = prepared, noise: Noise = noise) -> None:
                for _ in prepared.stream(states, noise=noise):
                    pass

            seconds = _timed(sweep) / len(states)
            least = prepared.light.numel() * _BYTES_PER_SAMPLE / bandwidth
            rows.append(
                {
                    "height": height,
                    "width": width,
                    "noise": noise,
                    "seconds": seconds,
                    "share_of_bandwidth": least / seconds,
                }
            )
    name = torch.cuda.get_device_name()
    return {"name": name, "bytes_per_second": bandwidth, "rows": rows}


def _copy_bandwidth() -> float:
    source = torch.empty(2**28, dtype=torch.float32, device="cuda")
    target = torch.empty_like(source)
    return 2 * source.nbytes / _timed(lambda: target.copy_(source))


def _timed(call: Callable[[], Any]) -> float:
    """Median seconds of a call, the GPU's own work included."""
    seconds = []
    for i in range(8):
        torch.cuda.synchronize()
        start = time.perf_counter()
        call()
        torch.cuda.synchronize()
        if i:
            seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)
