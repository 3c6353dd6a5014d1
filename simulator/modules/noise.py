"""Noise module: removes the source's noise, so that the target's can be put in its place."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor, nn

from simulator.blur import box_mean
from simulator.modules.compact_denoiser import CompactDenoiser
from simulator.modules.unet import UNet

Preset = Literal["compact", "paper"]
#: Side of the window that smooths the signal which the noise level is read from.
_SMOOTHING = 5


def check_preset(preset: str) -> None:
    """Raises a `ValueError` unless `preset` is known."""
    if preset not in get_args(Preset):
        raise ValueError(f"`preset` (={preset!r}) must be one of {list(get_args(Preset))}")


class NoiseModule(nn.Module):
    """Denoises an exposed raw whose noise level function is known.

    Args:
        preset: ``"compact"``: a small bias-free network with a standard-deviation map, which
            commutes with exposure; ``"paper"``: the U-Net of Brooks et al. 2019 with a noise-level
            map, as the paper uses it (section 3.2).
    """

    def __init__(self, preset: Preset = "compact") -> None:
        super().__init__()
        check_preset(preset)
        self.preset = preset
        self.network: nn.Module = CompactDenoiser() if preset == "compact" else UNet()

    def forward(self, exposed: Tensor, shot: Tensor, read: Tensor) -> Tensor:
        """The raw with little noise; one without noise (shot = read = 0) as it is.

        Args:
            exposed: (B, 4, H, W) raw on the scale of the target.
            shot: (B, 4) slope of its noise variance on that scale.
            read: (B, 4) noise variance at zero signal.

        Returns:
            (B, 4, H, W) float32.
        """
        if self.preset == "paper":
            level = variance_map(exposed, shot, read).sqrt()
            result = exposed + self.network(torch.cat([exposed, level], dim=1)).float()
        else:
            deviation = variance_map(smoothed(exposed), shot, read).sqrt()
            result = self.network(exposed, deviation).float()
        noisy = ((shot > 0) | (read > 0)).any(dim=1)
        return torch.where(noisy[:, None, None, None], result, exposed.float())


def variance_map(signal: Tensor, shot: Tensor, read: Tensor) -> Tensor:
    """Noise variance ``read + shot * max(signal, 0)`` of each pixel, (B, 4, H, W) float32."""
    slope, offset = (v.float()[:, :, None, None] for v in (shot, read))
    return signal.float().clamp(min=0.0) * slope + offset


def smoothed(image: Tensor) -> Tensor:
    """Mean over 5 x 5 pixels, borders repeated: a noise level read from single noisy pixels would
    be too low exactly where noise made them dark."""
    return box_mean(image, _SMOOTHING)
