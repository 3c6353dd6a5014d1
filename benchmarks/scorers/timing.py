"""Milliseconds per batch of 64."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch

from ae_env.options import EnvOptions
from ae_env.scorers import Captures, CompositeScorer
from ae_env.scorers.captures import describe_captures
from ae_env.scorers.score_table import prepare_scene
from benchmarks.markdown import table
from simulator import develop

#: Captures of a batch, and their packed size [pixel].
BATCH, SIZES = 64, (128, 256)
#: A row that is no scorer: what each of those that look at sRGB costs besides.
DEVELOP = "(developing to sRGB)"


def rows(scorers: Mapping[str, CompositeScorer], repeats: int) -> list[dict[str, Any]]:
    """A row per scorer and size: median and spread of the milliseconds per batch.

    Developing is not in the scorers' rows but has one of its own.
    """
    return [row for size in SIZES for row in _rows(scorers, size, repeats)]


def _rows(
    scorers: Mapping[str, CompositeScorer], size: int, repeats: int
) -> Iterator[dict[str, Any]]:
    images, captures = _batch(size)

    def developed() -> torch.Tensor:
        return develop(images, captures.white_balance, captures.colour_matrices[0])

    srgb = developed()

    def score(scorer: CompositeScorer) -> None:
        for part in scorer.parts.values():
            part(srgb if part.domain == "srgb" else images, captures)

    yield _row(DEVELOP, size, developed, repeats)
    for name, scorer in scorers.items():
        yield _row(name, size, partial(score, scorer), repeats)


def _batch(size: int) -> tuple[torch.Tensor, Captures]:
    """A scene in 64 noisy captures, from dark to bright."""
    options = EnvOptions(scenes="bundled:small", split="test", resolution=size)
    scene, camera = options.load_scenes()[0], options.make_camera()
    states = list(options.make_grid().states)
    zeros = np.zeros(len(states))
    captures = describe_captures(
        [scene] * len(states), states, camera, speed=zeros, defocus=zeros, gain=zeros + 1.0
    )
    return prepare_scene(scene, camera).expose(states, seed=0).clamp_(0.0, 1.0), captures


def _row(name: str, size: int, task: Callable[[], Any], repeats: int) -> dict[str, Any]:
    task()
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        task()
        seconds.append(time.perf_counter() - begin)
    spread = max(seconds) - min(seconds)
    return {
        "scorer": name,
        "size": size,
        "batch": BATCH,
        "ms": 1e3 * statistics.median(seconds),
        "ms_range": 1e3 * spread,
    }


def section(rows: Sequence[Mapping[str, Any]], machine: Mapping[str, Any]) -> str:
    """The part of the page that shows `rows`."""
    known = {(row["scorer"], row["size"]): row for row in rows}
    names = dict.fromkeys(row["scorer"] for row in rows)
    body = [
        [
            name if name == DEVELOP else f"`{name}`",
            *(f"{known[name, s]['ms']:.1f} ± {known[name, s]['ms_range'] / 2:.1f}" for s in SIZES),
        ]
        for name in names
    ]
    head = ["scorer", *(f"{size} x {size} [ms]" for size in SIZES)]
    text = (
        f"Milliseconds per batch of {BATCH} captures, median and half the range, on "
        f"{machine['threads']} threads. Scorers of sRGB need developing besides, once for all of "
        "them. Those with a closed form on noise-free light are worked out once per scene and "
        "state in an environment whose light is static, not per frame."
    )
    return f"{text}\n\n{table(head, body)}"
