"""How noisy a capture is: from its noise level function, and estimated from its picture."""

from __future__ import annotations

import math

import torch
from torch.nn.functional import pad

from ae_env.scorers.luma import check_luma, luma_of
from ae_env.scorers.protocol import Captures, DependsOn, Domain


def immerkaer_response(luma: torch.Tensor) -> torch.Tensor:
    """|I * N| (B, H, W), N = [1 -2 1; -2 4 -2; 1 -2 1], borders repeated; in units of `luma`.

    Flat areas, straight slopes and edges along rows or columns give 0.
    """
    padded = pad(luma[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    across = (padded[:, :, :-2] + padded[:, :, 2:]).sub_(padded[:, :, 1:-1], alpha=2.0)
    return (across[:, :-2] + across[:, 2:]).sub_(across[:, 1:-1], alpha=2.0).abs_()


def immerkaer_sigma(luma: torch.Tensor) -> torch.Tensor:
    """Standard deviation of the noise [grey levels of 255], estimated from one picture.

    ``sqrt(pi / 2) / (6 (W - 2) (H - 2))`` times the sum of `immerkaer_response` over the pixels
    that have all eight neighbours; 0 where there are none. Fine texture is read as noise.

    Args:
        luma: (B, H, W) in [0, 1].

    Returns:
        (B,) float64.

    Source: J. Immerkaer, "Fast noise variance estimation", Computer Vision and Image Understanding
    64(2), 1996.
    """
    if min(check_luma(luma).shape[1:]) < 3:
        return luma.new_zeros(len(luma), dtype=torch.float64)
    inner = immerkaer_response(luma)[:, 1:-1, 1:-1].mean(dim=(1, 2), dtype=torch.float64)
    return inner * (255.0 * math.sqrt(0.5 * math.pi) / 6.0)


class SignalToNoise:
    """Signal-to-noise ratio of native pixels by the noise level function, in dB.

    Mean over pixels and planes of ``10 log10(min(x, 1)^2 / (shot x + read))``, each held to 0 to
    50 dB, over 50 dB; x is the noise-free signal before blur and clip. The noise is that of the
    sensor's own pixels, not of the box-averaged frame. 50 dB is about what a full-frame sensor
    reaches at white at ISO 100 (Nikon Z6: 51.3 dB).
    """

    domain: Domain = "raw"
    depends_on: DependsOn = "light"
    ceiling_db = 50.0

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        shot = torch.tensor([n.shot for n in captures.nlf])[:, :, None, None]
        read = torch.tensor([n.read for n in captures.nlf])[:, :, None, None]
        light = captures.light.clamp(min=0.0)
        variance = (light * shot.to(light)).add_(read.to(light)).clamp_(min=1e-30)
        power = light.clamp_(max=1.0).square_().div_(variance)
        decibels = power.clamp_(min=1.0).log10_().mul_(10.0).clamp_(max=self.ceiling_db)
        return decibels.mean(dim=(1, 2, 3), dtype=torch.float64) / self.ceiling_db


class BlindNoise:
    """Noise estimated from the developed picture alone (Immerkaer 1996): less is better.

    ``1 / (1 + sigma / 10)``, sigma from `immerkaer_sigma` of the luma in grey levels of 255: 0.5
    where it is 10. Fine texture lowers it, too, and blur and clipping raise it.
    """

    domain: Domain = "srgb"
    half = 10.0

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        return 1.0 / (1.0 + immerkaer_sigma(luma_of(images)) / self.half)
