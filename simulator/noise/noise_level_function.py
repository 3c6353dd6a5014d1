"""Sensor noise: what must be added so that a raw carries the noise of other settings."""

from __future__ import annotations

import numpy as np
import torch

from simulator.camera import NoiseLevelFunction


def noise_generator(seed: int, *key: int | float) -> torch.Generator:
    """A generator that depends on `seed` and on every number of `key`, and on nothing else.

    Args:
        seed: Integer >= 0.
        key: What the noise shall differ by: the step of an episode, the settings of a capture.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"`seed` (={seed!r}) must be an integer >= 0")
    words = [int(seed), *(int(np.float64(k).view(np.uint64)) for k in key)]
    state = np.random.SeedSequence(words).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))


def nlf_tensors(
    nlf: NoiseLevelFunction, device: torch.device | str = "cpu"
) -> tuple[torch.Tensor, torch.Tensor]:
    """(shot, read), each (4, 1, 1) float32: variances reach 5e-9, so never a narrower dtype."""
    shot = torch.tensor(nlf.shot, dtype=torch.float32, device=device)[:, None, None]
    read = torch.tensor(nlf.read, dtype=torch.float32, device=device)[:, None, None]
    return shot, read


def noise_variance(signal: torch.Tensor, nlf: NoiseLevelFunction) -> torch.Tensor:
    """Variance ``read + shot * max(signal, 0)`` of each pixel, (..., 4, H, W) float32."""
    shot, read = nlf_tensors(nlf, signal.device)
    return signal.float().clamp(min=0.0) * shot + read


def top_up_variance(
    signal: torch.Tensor,
    source: NoiseLevelFunction,
    target: NoiseLevelFunction,
    remaining: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Variance to add so that a pixel with `source` noise carries `target` noise.

    Args:
        signal: (..., 4, H, W), on the target's scale.
        source: Noise already in `signal` on that scale (`NoiseLevelFunction.exposed`).
        target: Noise that the capture should have.
        remaining: (H, W) share of the source's variance that a blur has left; None for all of it.

    Returns:
        ``(missing, excess)``, both >= 0: ``missing`` is to be added; ``excess`` is how much the
        source is noisier than the target, where only denoising would help.
    """
    shot = tuple(t - s for t, s in zip(target.shot, source.shot, strict=True))
    read = tuple(t - s for t, s in zip(target.read, source.read, strict=True))
    slope = torch.tensor(shot, dtype=torch.float32, device=signal.device)[:, None, None]
    offset = torch.tensor(read, dtype=torch.float32, device=signal.device)[:, None, None]
    difference = signal.float().clamp(min=0.0) * slope + offset
    if remaining is not None:
        difference += (1.0 - remaining) * noise_variance(signal, source)
    return difference.clamp(min=0.0), (-difference).clamp_(min=0.0)
