"""`ae-env score-tables` on Ray beside one process: raws per second, and what starting costs."""

import os
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any

import torch

from agents.score_shards import ShardPlan
from agents.score_shards import run as make_shards
from benchmarks.harness import Part, Report, Row, benchmark, table
from simulator import CameraSettings, RawImage, get_camera, write_dng

#: Raws, their height and width [packed pixel], and how many of them are a shard.
FILES, SIZE, PER_SHARD = 512, (512, 768), 8


def measure(on: str, workers: int, seed: int, quick: bool) -> Row:
    files = 16 if quick else FILES
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["AE_ENV_CACHE"] = str(Path(folder, "cache"))  # nobody uses another's results
        raws, out = Path(folder, "raws"), Path(folder, "out")
        raws.mkdir()
        out.mkdir()
        noise, camera = torch.Generator().manual_seed(seed), get_camera("nikon_z6")
        for i in range(files):
            light = torch.rand(4, *SIZE, generator=noise) * 2.0 ** -(i % 8)
            write_dng(raws / f"{i}.dng", RawImage(light, CameraSettings(400, 1 / 64, 4), camera))
        plan = ShardPlan.of(str(raws), out, per_shard=PER_SHARD)
        begun = perf_counter()
        made = make_shards(plan, on, lambda *_: None, workers)
        seconds = perf_counter() - begun
    busy = sum(float(one["seconds"]) for one in made)
    return {"on": on, "workers": workers, "files": files, "seconds": seconds, "busy": busy}


def parts(seed: int, quick: bool) -> list[Part]:
    cases = (("local", 1), ("ray", 1), ("ray", 2))
    return [Part(f"{on}-{n}", measure, {"on": on, "workers": n}) for on, n in cases]


_COLUMNS = """on = {on}, workers: {workers} | raws = {files} | time [s] = {seconds:.1f} |
raws / s = {rate:.1f} | times one process = {speedup:.2f} |
of it no shard was made [s] = {overhead:.1f} |
core hours for a million raws = {core_hours:.1f}"""


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows: list[Row] = list(results.values())
    for row in rows:
        row["rate"] = row["files"] / row["seconds"]
        row["speedup"] = rows[0]["seconds"] / row["seconds"]
        row["overhead"] = row["seconds"] - row["busy"] / row["workers"]
        row["core_hours"] = 1e6 * row["busy"] / row["files"] / 3600
    return Report(rows, {"runs": table(rows, _COLUMNS)})


run = benchmark("cluster", parts, report)
