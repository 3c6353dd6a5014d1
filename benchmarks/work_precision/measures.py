"""What is measured of captures: error of the mean, variance of the noise, time; and the front."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from benchmarks.simulator.scenes import clipped, psnr
from simulator import CameraProfile, NoiseLevelFunction
from simulator.noise.noise_level_function import noise_variance

Result = TypeVar("Result")

#: Pixels whose mean is this many deviations from either clip show all of their noise.
_CLEAR = 4.0
#: Levels of the signal, each with as many pixels, and the fewest pixels of one.
_LEVELS, _FEWEST = 8, 200
#: PSNRs that differ by less are the same [dB].
_SAME_DB = 0.01


@dataclass(frozen=True)
class MeanError:
    """How far a capture's expected value is from the reference camera's.

    Args:
        psnr_db: Against sensor white.
        relative_rmse: RMS error over RMS signal.
    """

    psnr_db: float
    relative_rmse: float

    @classmethod
    def of(cls, expected: Tensor, mean: Tensor, camera: CameraProfile) -> MeanError:
        """Of `expected` (4, H, W), clipped as captures are, against `mean`."""
        image = clipped(expected, camera).double()
        truth = mean.double()
        scale = truth.square().mean().sqrt().clamp(min=1e-12)
        rmse = (image - truth).square().mean().sqrt()
        return cls(psnr(image, truth), float(rmse / scale))


def noise_ratios(
    captures: tuple[Tensor, Tensor], mean: Tensor, nlf: NoiseLevelFunction, camera: CameraProfile
) -> list[float]:
    """Variance of the noise over the noise level function's, at every level of the signal.

    Args:
        captures: (4, H, W) each, of the same scene at the same settings, from sources of their own
            and with noise of their own: all noise in them is independent.
        mean: (4, H, W) the truth, from which the levels are taken.
        nlf: What the variance should be.
        camera: Says where captures clip.

    Returns:
        One number per level with enough pixels; of pixels that are clear of both clips.
    """
    wanted = noise_variance(mean, nlf)
    margin = _CLEAR * wanted.sqrt()
    black = torch.tensor(camera.pedestal).to(mean)[:, None, None]
    clear = (mean + margin < 1.0) & (mean - margin > -black)
    first, second = captures
    found = 0.5 * (first - second).double().square()[clear]
    wanted = wanted[clear].double()
    levels = wanted.argsort().tensor_split(_LEVELS)
    return [float(found[at].mean() / wanted[at].mean()) for at in levels if len(at) >= _FEWEST]


def capture_square(
    captures: tuple[Tensor, Tensor],
    mean: Tensor,
    nlf: NoiseLevelFunction,
    ratios: Sequence[float],
) -> float:
    """Squared distance of a method's captures from the reference camera's, without bias.

    ``mean(((dm)^2 + (ds)^2) / s^2)``, as `benchmarks.work_precision.bound` has it: the product of
    two captures' differences from the truth is on average the square of the mean's.

    Args:
        captures: As `noise_ratios` takes them.
        mean: (4, H, W) the truth.
        nlf: Of the target.
        ratios: What `noise_ratios` found.
    """
    first, second = ((capture - mean).double() for capture in captures)
    moved = float((first * second / noise_variance(mean, nlf)).mean())
    spread = [(ratio**0.5 - 1.0) ** 2 for ratio in ratios]
    return moved + (float(np.mean(spread)) if spread else 0.0)


def timed(function: Callable[..., Result], *args: Any, **options: Any) -> tuple[Result, float]:
    """What `function` returns with these arguments, and how long that took [ms]."""
    began = time.perf_counter()
    result = function(*args, **options)
    return result, 1e3 * (time.perf_counter() - began)


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Median and quartiles."""
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    return float(middle), float(low), float(high)


def pareto_front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Which of (milliseconds, PSNR [dB]) no other beats in both.

    One that is faster and, to a hundredth of a decibel, as good beats another.

    >>> pareto_front([(1.0, 30.0), (2.0, 35.0), (3.0, 34.0), (4.0, 35.004)])
    [True, True, False, False]
    """

    def beaten(index: int) -> bool:
        own_ms, own_db = points[index]
        for other, (ms, db) in enumerate(points):
            if other != index and ms <= own_ms and db >= own_db - _SAME_DB:
                same = ms == own_ms and abs(db - own_db) <= _SAME_DB
                if not same or other < index:
                    return True
        return False

    return [not beaten(i) for i in range(len(points))]
