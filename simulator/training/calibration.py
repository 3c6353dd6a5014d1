"""Measures what a trained noise module gets wrong, for the plan's predictions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from simulator.capture.statistics import BLOCK, Residual, ResidualStatistics, wiener_error
from simulator.networks.noise_module import NoiseModule, variance_map
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.training.crops import DetailCrops

#: Values of `wiener_error` at which errors are tabulated.
_KNOTS = np.array([0.0, 0.003, 0.006, 0.0125, 0.025, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0])
#: Crops that are measured, how large they are, and captures of each.
_CROPS, _SIDE, _CAPTURES = 192, 128, 4


@torch.no_grad()
def calibrate(noise: NoiseModule, crops: DetailCrops) -> Residual:
    """The `Residual` of a noise module on pictures that it was not trained on.

    Several captures of each crop tell what is systematic from what is noise. The first half of the
    crops fills the tables; the second half tells how far single crops are from them.

    Args:
        noise: In evaluation mode.
        crops: Of the validation split.
    """
    half = _CROPS // 2
    blocks = [_measured(noise, crops, index) for index in range(_CROPS)]
    error, bias, left = (
        np.concatenate([getattr(b, name) for b in blocks[:half]])
        for name in ("wiener_error", "bias", "variance")
    )
    bias, left = (np.maximum(_smoothed(error, v), 0.0) for v in (bias, left))
    first = Residual(_KNOTS, bias, left, 1.0)
    ratios = []
    for own in blocks[half:]:
        predicted = own.statistics.error(first, 1.0, own.statistics.nlf, noise=False)
        found = max(float((own.bias + own.variance).mean()), 0.0) ** 0.5
        ratios.append(found / max(predicted, 1e-6))
    return Residual(_KNOTS, bias, left, max(1.0, float(np.quantile(ratios, 0.9))))


class _Measured(NamedTuple):
    """Errors of a network on one crop, in blocks, in units of the noise's variance."""

    wiener_error: np.ndarray
    bias: np.ndarray
    variance: np.ndarray
    statistics: ResidualStatistics


def _measured(noise: NoiseModule, crops: DetailCrops, index: int) -> _Measured:
    batch = crops.captures(index, _CAPTURES, min(_SIDE, crops.largest))
    error = noise(batch.noisy, batch.shot, batch.read).double() - batch.clean.double()
    scale = variance_map(batch.clean, batch.shot, batch.read).double()[0]
    variance = error.var(dim=0)
    bias = error.mean(dim=0).square() - variance / _CAPTURES
    shot, read = (v[0].tolist() for v in (batch.shot, batch.read))
    nlf = NoiseLevelFunction(tuple(shot), tuple(read))
    expected = wiener_error(batch.noisy[0], nlf).double().flatten().numpy()
    squares = [
        F.avg_pool2d((v / scale)[None], BLOCK)[0].mean(dim=0).flatten().numpy()
        for v in (bias, variance)
    ]
    return _Measured(expected, squares[0], squares[1], ResidualStatistics(batch.noisy[0], nlf))


def _smoothed(error: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Means of `values` around each knot, weights falling to 0 at the neighbouring ones."""
    place = np.interp(error, _KNOTS, np.arange(len(_KNOTS)))
    weights = np.maximum(1.0 - np.abs(place[None] - np.arange(len(_KNOTS))[:, None]), 0.0)
    total = weights.sum(axis=1)
    means = (weights @ values) / np.maximum(total, 1e-12)
    known = total > 1.0
    return np.interp(np.arange(len(_KNOTS)), np.flatnonzero(known), means[known])
