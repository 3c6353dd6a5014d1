"""The paper's table: every method on pairs of captures that no training saw.

Sources and targets are photographed by the reference camera: the body that was trained on, and one
of another camera. An estimate is what a method makes of the source before the output's noise is
added; it is compared with the noisy target, as the paper does, and with the target's noise-free
mean. Everything is clipped to [-pedestal, 1] first.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from skimage.metrics import structural_similarity
from torch import Tensor, nn

from benchmarks.simulator.cases import GROUPS, PARTITION, Case, drawn, pairs_of, photographed
from benchmarks.simulator.models import Models
from benchmarks.simulator.pairs_report import section as section
from benchmarks.simulator.scenes import FULL, QUICK, Progress, clipped, held_out_scenes, psnr
from simulator import CameraSimulator, get_camera
from simulator.reference.reference_camera import BodyError, ReferenceCamera
from simulator.training.data import draw_sequences, settings_parameters

#: Camera and the seed of its body: the one trained on, and one that no training saw.
CAMERAS = {"nikon_z6": 1, "canon_70d": 7}
#: Pairs by mix: "all" is the paper's, any two captures of a sequence; the others are drawn from the
#: scenes that have depth, because few pairs of the first open the aperture of something defocused.
PAIRS = {"all": 300, "opening": 100, "f/11 to f/4": 60}
QUICK_PAIRS = {"all": 6, "opening": 2, "f/11 to f/4": 2}
#: Groups of the mixes that only open the aperture.
_OPENING = ("aperture opens", "opens, blur >= 1.5 px", "opens, blur < 1.5 px")


def measure(
    models: Models, *, seed: int, quick: bool, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """One row per camera, mix of pairs, group of pairs and method.

    Args:
        models: What is measured.
        seed: Of settings, pairs, crops and noise.
        quick: A few small pairs.
        progress: Called with the camera and the share that is done.
    """
    counts = QUICK_PAIRS if quick else PAIRS
    crop = (QUICK if quick else FULL)[2]
    rows: list[dict[str, Any]] = []
    for number, (camera, body) in enumerate(CAMERAS.items()):
        profile = get_camera(camera)
        reference = ReferenceCamera(profile, body=BodyError.draw(profile, body))
        sequences = draw_sequences(held_out_scenes(camera, quick=quick), profile, seed)
        for index, (mix, count) in enumerate(counts.items()):
            pairs = drawn(pairs_of(mix, sequences, reference), count, [seed, number, index])
            scored = []
            for done, case in enumerate(photographed(pairs, sequences, reference, crop, seed)):
                if progress is not None:
                    share = (index + done / count) / len(counts)
                    progress(f"{camera}, {mix}", (number + share) / len(CAMERAS))
                scored.append((case, _scores(case, models)))
            rows += _rows(scored, camera=camera, mix=mix)
    return rows


# -- methods --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Method:
    """A stage of a preset, with or without learnt w and b; or a baseline; or the ceiling."""

    name: str
    preset: str = ""
    body_correction: bool = False


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a method made of a source, (4, H, W), and in what time [ms]."""

    image: Tensor
    milliseconds: float | None


class _Stopwatch:
    """Milliseconds from the start of a simulator's exposure module to the end of each module."""

    def __init__(self, simulator: CameraSimulator) -> None:
        assert simulator.noise is not None
        assert simulator.aperture is not None
        modules = {"EXP": simulator.exposure, "NS": simulator.noise, "Full": simulator.aperture}
        self.milliseconds: dict[str, float] = {}
        self._handles = [
            module.register_forward_hook(lambda *_, name=name: self._stop(name))
            for name, module in modules.items()
        ]
        self._handles.append(simulator.exposure.register_forward_pre_hook(self._start))

    def _start(self, *_: Any) -> None:
        self._began = time.perf_counter()

    def _stop(self, name: str) -> None:
        self.milliseconds[name] = 1e3 * (time.perf_counter() - self._began)

    def remove(self) -> None:
        for handle in self._handles:
            handle.remove()


def _estimates(case: Case, models: Models) -> Iterator[tuple[Method, Estimate]]:
    """Every method's estimate of the target, and the ceiling."""
    simulators = [
        ("compact", models.compact_body, True),
        ("compact", models.compact, False),
        ("paper", models.paper_body, True),
    ]
    for name, network in (("PC", models.pc), ("DL", models.dl)):
        if network is not None:
            yield Method(name), _baseline(case, network)
    for preset, simulator, corrected in simulators:
        if simulator is None:
            continue
        watch = _Stopwatch(simulator)
        stages = simulator.stages(case.source, case.target.settings)
        watch.remove()
        for name, image in (
            ("EXP", stages.exposed),
            ("NS", stages.denoised),
            ("Full", stages.opened),
        ):
            yield Method(name, preset, corrected), Estimate(image, watch.milliseconds[name])
    yield Method("ceiling"), Estimate(case.target.mean, None)


@torch.no_grad()
def _baseline(case: Case, network: nn.Module) -> Estimate:
    settings = case.source.settings, case.target.settings
    parameters = [value for s in settings for value in settings_parameters(s)]
    began = time.perf_counter()
    image = network(case.source.data[None], torch.tensor([parameters]))[0]
    return Estimate(image, 1e3 * (time.perf_counter() - began))


# -- scores ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Score:
    """PSNR [dB] and SSIM against the noisy target and against its mean; time [ms]."""

    noisy_db: float
    noisy_ssim: float
    mean_db: float
    mean_ssim: float
    milliseconds: float | None


def _scores(case: Case, models: Models) -> dict[Method, Score]:
    camera = case.source.camera
    sample, mean = case.target.sample, case.target.mean
    scores = {}
    for method, estimate in _estimates(case, models):
        image = clipped(estimate.image, camera)
        scores[method] = Score(
            psnr(image, sample),
            _ssim(image, sample),
            psnr(image, mean),
            _ssim(image, mean),
            estimate.milliseconds,
        )
    return scores


def _ssim(image: Tensor, target: Tensor) -> float:
    value = structural_similarity(image.numpy(), target.numpy(), channel_axis=0, data_range=1.0)
    return float(value)


def _rows(
    scored: list[tuple[Case, dict[Method, Score]]], *, camera: str, mix: str
) -> Iterator[dict[str, Any]]:
    groups = {**GROUPS, **PARTITION} if mix == "all" else {name: GROUPS[name] for name in _OPENING}
    for group, belongs in groups.items():
        chosen = [(case, scores) for case, scores in scored if belongs(case)]
        if not chosen:
            continue
        subjects = [case.scene.group for case, _ in chosen]
        for method in chosen[0][1]:
            own = [scores[method] for _, scores in chosen]
            row = {
                "part": "pairs",
                "camera": camera,
                "mix": mix,
                "group": group,
                "method": method.name,
                "preset": method.preset,
                "body_correction": method.body_correction,
                "pairs": len(chosen),
                "source_groups": len(set(subjects)),
                "size": chosen[0][0].target.mean.shape[-1],
            }
            for field in ("noisy_db", "noisy_ssim", "mean_db", "mean_ssim"):
                row[field] = float(np.mean([getattr(score, field) for score in own]))
            for field in ("noisy_db", "mean_db"):
                for name, other in _compared(method).items():
                    pairs = ((getattr(s[m], field) for m in (method, other)) for _, s in chosen)
                    gains = np.array([own - others for own, others in pairs])
                    row[f"{name}_{field}"] = float(gains.mean())
                    row[f"{name}_{field}_error"] = _standard_error(gains, subjects)
            times = [score.milliseconds for score in own if score.milliseconds is not None]
            row["milliseconds"] = float(np.median(times)) if times else None
            yield row


def _compared(method: Method) -> dict[str, Method]:
    """What a method's gain is over: the exposure alone, and the stage before."""
    preset = method.preset or "compact"
    exposed = Method("EXP", preset, method.body_correction or not method.preset)
    before = {"NS": "EXP", "Full": "NS"}.get(method.name)
    compared = {"over_exp": exposed}
    if before is not None:
        compared["over_stage_before"] = Method(before, preset, method.body_correction)
    return compared


def _standard_error(values: np.ndarray, subjects: list[str]) -> float | None:
    """Standard error of the mean, the pairs of a source group taken as one draw."""
    names = sorted(set(subjects))
    if len(names) < 2:
        return None
    index = np.array([names.index(subject) for subject in subjects])
    sums = np.bincount(index, values - values.mean())
    factor = len(names) / (len(names) - 1)
    return float(math.sqrt(factor * (sums**2).sum()) / len(values))
