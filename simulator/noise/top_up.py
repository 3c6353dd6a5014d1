"""The noise top-up: variance that must be added so that a raw carries the noise of other settings.

A pixel of signal x whose source has the noise (shot1, read1) carries ``a shot1 x + a^2 read1``
after the exposure ratio a (`NoiseLevelFunction.exposed`). To carry the target's noise
(shot2, read2) it lacks the variance

    D(x) = (read2 - a^2 read1) + (shot2 - a shot1) max(x, 0).

Where D is positive, noise of that variance is added, and mean and variance are exact. Where D is
negative the source is noisier than the target: nothing is added, and -D is the excess variance.
A blur averages the source's noise: where it leaves only a share r of the variance, the other share
``(1 - r) (a shot1 max(x, 0) + a^2 read1)`` is missing, too.

The fused kernel for the CPU (`simulator.capture.kernels`) computes the same, from the same table.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from simulator.noise.noise_level_function import NoiseLevelFunction, plane_tensor


def top_up_table(
    sources: Sequence[NoiseLevelFunction], targets: Sequence[NoiseLevelFunction]
) -> np.ndarray:
    """Coefficients of D for B pairs of noises, on the target's scale.

    Returns:
        (B, 4, 4) float64, columns are the planes R, G1, G2, B. The rows: shot and read noise that
        is missing (negative where the source has more); shot and read noise of the source.
    """
    pairs = zip(sources, targets, strict=True)
    rows = [t.shot + t.read + s.shot + s.read for s, t in pairs]  # flat: numpy reads them faster
    table = np.array(rows).reshape(-1, 4, 4)
    table[:, :2] -= table[:, 2:]  # in float64: both may be nearly the same
    return table


def missing_variance(
    signal: torch.Tensor, table: np.ndarray, remaining_variance: torch.Tensor | None = None
) -> torch.Tensor:
    """D(x) of each pixel; negative where the source is noisier.

    Args:
        signal: (..., 4, H, W) on the target's scale, or one plane of it, (..., H, W).
        table: (4, 4), one entry of `top_up_table`, or (4,), its column for that plane.
        remaining_variance: (H, W) share of the source's variance that a blur has left; None for
            all of it.

    Returns:
        float32, of the shape of `signal`.
    """
    shot, read, source_shot, source_read = (
        plane_tensor(row, signal.device) if row.ndim else row.item() for row in table
    )
    bright = signal.float().clamp(min=0.0)
    missing = (bright * shot).add_(read)
    if remaining_variance is not None:
        missing += (1.0 - remaining_variance) * (bright * source_shot + source_read)
    return missing


def top_up_variance(
    signal: torch.Tensor,
    source: NoiseLevelFunction,
    target: NoiseLevelFunction,
    remaining_variance: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Variance to add so that a pixel with `source` noise carries `target` noise.

    Args:
        signal: (..., 4, H, W), on the target's scale.
        source: Noise already in `signal` on that scale (`NoiseLevelFunction.exposed`).
        target: Noise that the capture should have.
        remaining_variance: See `missing_variance`.

    Returns:
        ``(missing, excess)``, both >= 0: ``missing`` is to be added; ``excess`` is how much the
        source is noisier than the target, where only denoising would help.
    """
    (table,) = top_up_table([source], [target])
    difference = missing_variance(signal, table, remaining_variance)
    return difference.clamp(min=0.0), (-difference).clamp_(min=0.0)
