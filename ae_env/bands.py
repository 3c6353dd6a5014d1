"""Frames whose rows have light of their own: the bands of flickering light.

The light of each row multiplies the blurred light before there is noise, so that the noise is that
of the banded signal. (Motion runs along the rows, and defocus is complete before a row is read.)
Noise that the source itself brings is multiplied with its light: its variance by the square of the
row's, r^2. What the kernels take away for it has the variance times r: exact for shot noise, whose
variance they work out from the banded signal, and off by r (1 - r) of the source's read noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from simulator.capture import record_batch
from simulator.frame_noise import sweep_keys
from simulator.latent import Latent
from simulator.settings import CameraSettings


def in_bands(light: torch.Tensor, row_gain: np.ndarray) -> torch.Tensor:
    """`light` (4, H, W) with the rows' own, (H,); new memory, contiguous."""
    return (light * _column(row_gain)).contiguous()


def remaining_in_bands(
    remaining: torch.Tensor | None, row_gain: np.ndarray, width: int
) -> torch.Tensor:
    """`Exposure.remaining` (H, `width`) of a noisy source in the bands of `row_gain` (H,)."""
    share = _column(row_gain).expand(-1, width)
    return (share if remaining is None else share * remaining).contiguous()


def expected_in_bands(
    latents: Sequence[Latent], states: Sequence[CameraSettings], row_gain: np.ndarray | None
) -> torch.Tensor:
    """Noise-free light (S, 4, H, W) at each state, not clipped; arguments of `expose_in_bands`."""
    light = torch.stack([x.expected(s) for x, s in zip(latents, states, strict=True)])
    if row_gain is None:
        return light
    return light * torch.from_numpy(row_gain).float()[:, None, :, None]


def expose_in_bands(
    latents: Sequence[Latent],
    states: Sequence[CameraSettings],
    row_gain: np.ndarray | None,
    *,
    seed: int,
) -> torch.Tensor:
    """A sweep in which each state has light of its own, with the noise of `Latent.expose`.

    Args:
        latents: The scene in the light of each state, S long; they share their `Latent.optics`.
        states: S settings.
        row_gain: (S, H) light of each row relative to that; None where all rows have the same.
        seed: See `Latent.capture`.

    Returns:
        (S, 4, H, W) float32 in [-pedestal, 1].
    """
    exposures = [x.exposure(s) for x, s in zip(latents, states, strict=True)]
    lights = [x.optics.blurred(e) for x, e in zip(latents, exposures, strict=True)]
    if row_gain is not None:
        width = lights[0].shape[-1]
        exposures = [
            e
            if e.source.is_zero
            else replace(e, remaining=remaining_in_bands(e.remaining, g, width))
            for e, g in zip(exposures, row_gain, strict=True)
        ]
        lights = [in_bands(x, g) for x, g in zip(lights, row_gain, strict=True)]
    out = torch.empty((len(lights), *lights[0].shape))
    keys = sweep_keys(seed, states)
    record_batch(lights, exposures, latents[0].camera, keys, "exact", out=out)
    return out


def _column(row_gain: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(row_gain).float()[:, None]
