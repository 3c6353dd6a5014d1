"""Trains the detector under one of the augmentations."""

from __future__ import annotations

import functools
import time
import zlib
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file
from torch import Tensor

from ae_env.scorers.measures import srgb_decode
from benchmarks.features.detector import CELL, Detector, sample
from benchmarks.features.pairs import (
    View,
    batches,
    inside,
    mapped,
    sources,
    training_view,
    two_crops,
    warped,
)
from benchmarks.harness import RUNS
from benchmarks.isolated import ROOT
from simulator.augment import ExposureAugmentation, sample_seeds
from simulator.raw.develop import srgb_encode

#: Exposures that plain scaling and ours draw from [EV]; the tests lie within.
STOPS = (-6.0, 4.0)
#: The body whose pictures the detector is for: it lends ours its noise.
CAMERA = "canon_70d"
#: Side of a crop [pixel], pairs of a batch, points of a pair that are described.
SIZE, BATCH, POINTS = 80, 8, 48
STEPS, QUICK_STEPS = 3200, 20
#: Share of the crops that are augmented; the others stay as they are.
AUGMENTED = 0.15
#: Name of the weights that all augmentations start from.
START = "start"
_RATE, _TEMPERATURE, _SAME = 2e-3, 0.1, 6.0
#: Weight of the loss of the descriptors against that of the scores.
_DESCRIBED = 1.0

Augmentation = Callable[[Tensor, list[int]], Tensor]


# -- augmentations --------------------------------------------------------------------------------


def unchanged(pictures: Tensor, seeds: list[int]) -> Tensor:
    return pictures


def jittered(pictures: Tensor, seeds: list[int]) -> Tensor:
    """Gamma from 1/3 to 3 and contrast from 0.5 to 1.5."""
    out = []
    for picture, seed in zip(pictures, seeds, strict=True):
        rng = np.random.default_rng(seed)
        gamma, contrast = 3.0 ** rng.uniform(-1.0, 1.0), rng.uniform(0.5, 1.5)
        changed = picture**gamma
        mean = changed.mean()
        out.append(((changed - mean) * contrast + mean).clamp(0.0, 1.0))
    return torch.stack(out)


def scaled(pictures: Tensor, seeds: list[int]) -> Tensor:
    ratios = [2.0 ** np.random.default_rng(seed).uniform(*STOPS) for seed in seeds]
    linear = srgb_decode(pictures) * torch.tensor(ratios)[:, None, None, None]
    return srgb_encode(linear.clamp(0.0, 1.0))


#: By name: none, jitter, plain scaling, ours with its exposure alone, ours in full.
AUGMENTATIONS: dict[str, Augmentation] = {
    "none": unchanged,
    "jitter": jittered,
    "scaling": scaled,
    "exposure": ExposureAugmentation(CAMERA, STOPS, modules=("exposure",)),
    "full": ExposureAugmentation(CAMERA, STOPS, defocus=(0.0, 0.5), motion=(0.0, 1.0)),
}


# -- training -------------------------------------------------------------------------------------


def weights_file(arm: str, seed: int, steps: int) -> Path:
    """Where the weights of a training lie: a file for each state of the code."""
    files = [ROOT / "simulator/augment.py"]
    files += [ROOT / f"benchmarks/features/{n}.py" for n in ("detector", "pairs", "training")]
    checksum = 0
    for path in files:
        checksum = zlib.crc32(path.read_bytes(), checksum)
    return RUNS.parent / "features" / f"{arm}-{seed}-{steps}-{checksum:08x}.safetensors"


def train(arm: str, seed: int, steps: int, limit: int | None = None) -> tuple[Detector, float]:
    """The detector trained under an augmentation, or that of an earlier run; and its seconds.

    Random weights are trained without augmentation first, once for each seed, and go on under the
    augmentation for as many steps. All arms see the same crops in the same order, and what they
    make of the same few of them. `limit` is for photographs, and for maps; None for all.
    """
    begin, end = weights_file(START, seed, steps), weights_file(arm, seed, steps)
    if not begin.is_file():
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            model = Detector()
        _fit(model, "none", seed, range(steps), _RATE, limit, begin)
    if not end.is_file():
        model = _stored(begin)[0]
        _fit(model, arm, seed, range(steps, 2 * steps), 0.5 * _RATE, limit, end)
    model, seconds = _stored(end)
    return model.eval(), seconds


def _stored(path: Path) -> tuple[Detector, float]:
    model, stored = Detector().to(memory_format=torch.channels_last), load_file(path)
    seconds = float(stored.pop("seconds"))
    model.load_state_dict(stored)
    return model, seconds


def _fit(
    model: Detector, arm: str, seed: int, steps: range, rate: float, limit: int | None, path: Path
) -> None:
    views, begun = _views(limit), time.perf_counter()
    model.to(memory_format=torch.channels_last).train()
    optimiser = torch.optim.AdamW(model.parameters(), lr=rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=max(len(steps), 2))
    chosen = islice(enumerate(batches(len(views), BATCH, seed)), steps.start, steps.stop)
    for step, indices in chosen:
        drawn = (np.random.default_rng([seed, step, j]) for j in range(BATCH))
        batch = [_pair(views[i], rng) for i, rng in zip(indices, drawn, strict=True)]
        pictures = torch.from_numpy(np.stack([p for pair in batch for p in pair[0]]))
        pictures = pictures.permute(0, 3, 1, 2).float() / 255.0
        some = np.random.default_rng([seed, step]).random(len(pictures)) < AUGMENTED
        if some.any():
            seeds = sample_seeds(seed, step, np.flatnonzero(some).tolist())
            pictures[some] = AUGMENTATIONS[arm](pictures[some], seeds)
        loss = _loss(model, (pictures * 255.0).round() / 255.0, batch)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        schedule.step()
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    state = {name: value.contiguous() for name, value in model.state_dict().items()}
    save_file({**state, "seconds": torch.tensor(time.perf_counter() - begun)}, partial)
    partial.replace(path)


@functools.cache
def _views(limit: int | None) -> list[View]:
    return [training_view(source) for source in sources("train", raws=False, limit=limit)]


Pair = tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]


def _pair(view: View, rng: np.random.Generator) -> Pair:
    """Two crops, the corners of each, and points (POINTS, 2) of each that are the same places."""
    homographies = two_crops(rng, *view.picture.shape[:2], SIZE)
    crops = [warped(view.picture, h, SIZE) for h in homographies]
    if rng.random() < 0.5:  # both, mirrored
        mirror = np.array([[-1.0, 0.0, SIZE - 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        homographies = tuple(mirror @ h for h in homographies)
        crops = [np.ascontiguousarray(crop[:, ::-1]) for crop in crops]
    placed = [mapped(view.corners, h) for h in homographies]
    shown = [points[inside(points, SIZE)] for points in placed]
    both = np.flatnonzero(inside(placed[0], SIZE, 2.0) & inside(placed[1], SIZE, 2.0))
    both = rng.permutation(both)[:POINTS]
    first = placed[0][both]
    other = homographies[1] @ np.linalg.inv(homographies[0])
    while len(first) < POINTS:  # places that are no corners fill up
        places = rng.uniform(2.0, SIZE - 3.0, (4 * POINTS, 2))
        places = places[inside(mapped(places, other), SIZE, 2.0)]
        first = np.concatenate([first, places])[:POINTS]
    return crops, shown, [first, mapped(first, other)]


def _loss(model: Detector, pictures: Tensor, batch: list[Pair]) -> Tensor:
    with torch.autocast("cpu", torch.bfloat16):  # half the time
        logits, dense = model(pictures.contiguous(memory_format=torch.channels_last))
    logits, dense = logits.float(), dense.float()
    cells = SIZE // CELL
    labels = torch.full((len(pictures), cells, cells), CELL**2)
    for index, points in enumerate(shown for pair in batch for shown in pair[1]):
        x, y = np.round(points).astype(np.int64).T
        labels[index, y // CELL, x // CELL] = torch.from_numpy((y % CELL) * CELL + x % CELL)
    scored = F.cross_entropy(logits, labels)
    points = [np.stack([pair[2][side] for pair in batch]) for side in (0, 1)]
    first, second = (torch.from_numpy(p.astype(np.float32)) for p in points)
    a, b = sample(dense[0::2], first).flatten(0, 1), sample(dense[1::2], second).flatten(0, 1)
    similar = a @ b.T / _TEMPERATURE
    # Neighbours of a point are no negatives.
    near = torch.cdist(first, first) < _SAME
    near &= ~torch.eye(POINTS, dtype=torch.bool)
    similar = similar.masked_fill(torch.block_diag(*near), -torch.inf)
    target = torch.arange(len(similar))
    described = F.cross_entropy(similar, target) + F.cross_entropy(similar.T, target)
    return scored + _DESCRIBED * 0.5 * described
