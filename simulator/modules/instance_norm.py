"""Instance normalisation whose scale and shift differ per sample, safe on flat and tiny maps."""

from __future__ import annotations

import torch
from torch import Tensor

#: A map that deviates less than this (relative to its mean where that exceeds one) is flat.
FLAT = 1e-5


def instance_norm(x: Tensor, scale: Tensor, shift: Tensor, eps: float = 1e-5) -> Tensor:
    """``scale * (x - mean(x)) / sqrt(var(x) + eps) + shift``, over the pixels of each map.

    A flat map, and so every 1 x 1 map, becomes exactly `shift`. Convolutions leave deviations of
    1e-7 in a flat image; each normalisation would multiply them by up to ``1 / sqrt(eps)`` = 300,
    and after three layers they would be the image. Deviations below `FLAT` are that rounding.

    Args:
        x: (B, C, H, W), any H, W >= 1.
        scale: (B, C), of each sample and channel.
        shift: (B, C).
        eps: Added to the variance, which is the biased one, > 0.

    Returns:
        (B, C, H, W), the dtype of `x`; statistics are at least float32.

    >>> flat = torch.full((1, 1, 3, 3), 0.1)
    >>> instance_norm(flat, torch.ones(1, 1), torch.full((1, 1), 0.25)).unique().item()
    0.25
    """
    wide = torch.promote_types(x.dtype, torch.float32)
    mean = x.mean(dim=(2, 3), keepdim=True, dtype=wide)
    centred = x - mean
    variance = centred.square().mean(dim=(2, 3), keepdim=True)
    varies = variance > FLAT**2 * (1.0 + mean.square())
    gain = scale.to(wide)[:, :, None, None] * torch.rsqrt(variance + eps) * varies
    return torch.addcmul(shift.to(wide)[:, :, None, None], centred, gain).to(x.dtype)
