"""The built-in scorers that have a closed form on the noise-free light.

The constants of the five that `balanced` is made of were frozen before any agent was trained.

These are the definitions. The environment evaluates `Highlights`, `Shadows` and `Noise` by a fused
kernel that reads their constants from here (`ae_env.scorers.fused`) and agrees within 1e-6.
"""

from __future__ import annotations

import torch

from ae_env.scorers.protocol import Captures, DependsOn, Domain


class Brightness:
    """Exposure against the incident light: snow stays white and night stays dark.

    ``exp(-(sqrt(1 + e^2) - 1))`` with e the stops of over-exposure: EV of the incident light minus
    EV of the settings. Where the light is unknown, e is against a mean of 0.12 of white. In
    flickering light, the mean over the rows, each with its own e.
    """

    domain: Domain = "raw"
    depends_on: DependsOn = "light"
    reads_pixels = False

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        error = captures.proper_ev - captures.ev100
        if captures.row_gain is None:
            return torch.exp(1.0 - torch.sqrt(1.0 + error**2))
        error = error[:, None] + captures.row_gain.log2()  # (B, H)
        return torch.exp(1.0 - torch.sqrt(1.0 + error**2)).mean(dim=1)


class Banding:
    """Bands of flickering light on a rolling shutter: ``1 / (1 + (s / s0)^2)``.

    s is the standard deviation over the rows of log2 of their light [stops]; s0 is 0.1 stop, that
    of a sinusoidal band of +-10 % of the light. 1 where all rows have the same light.
    """

    domain: Domain = "raw"
    depends_on: DependsOn = "light"
    reads_pixels = False
    scale = 0.1

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        if captures.row_gain is None:
            return torch.ones(len(captures), dtype=torch.float64)
        stops = captures.row_gain.clamp(min=2.0**-64).log2()  # dark between pulses
        spread = stops.std(dim=1, correction=0)
        return 1.0 / (1.0 + (spread / self.scale) ** 2)


class Highlights:
    """Blown highlights: ``exp(-f / 0.15)``.

    f is the mean over the pixels of the largest ``sigmoid(log2(x) / 0.12)`` of its planes: the
    share of the frame at or above sensor white.

    Attributes:
        scale: Share at which the score is 1/e, 0.15.
        width: Of the sigmoid, 0.12 stop.
    """

    domain: Domain = "raw"
    depends_on: DependsOn = "light"
    scale = 0.15
    width = 0.12

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        brightest = captures.log2_light.amax(dim=1)  # (B, H, W); the sigmoid is monotone
        fraction = torch.sigmoid(brightest / self.width).mean(dim=(1, 2), dtype=torch.float64)
        return torch.exp(-fraction / self.scale)


class Shadows:
    """Blocked shadows: ``exp(-f / 0.20)``, f the mean of ``sigmoid(-(log2(x) + 9) / 0.5)``.

    Attributes:
        scale: Share at which the score is 1/e, 0.20.
        depth: How far below white a pixel is half blocked, 9 stops.
        width: Of the sigmoid, 0.5 stop.
    """

    domain: Domain = "raw"
    depends_on: DependsOn = "light"
    scale = 0.20
    depth = 9.0
    width = 0.5

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        dark = torch.sigmoid((captures.log2_light + self.depth).mul_(-1.0 / self.width))
        return torch.exp(-dark.mean(dim=(1, 2, 3), dtype=torch.float64) / self.scale)


class Noise:
    """Signal-to-noise ratio of a native sensor pixel: mean of ``s / (s + 18^1.5)``, s = SNR^1.5.

    SNR is ``min(x, 1) / sqrt(shot x + read)``. The NLF is that of the sensor's own pixels, not of
    the box-averaged frame: otherwise ISO would be nearly free.

    Attributes:
        half_snr: SNR at which the score is a half, 18.
    """

    domain: Domain = "raw"
    depends_on: DependsOn = "light"
    half_snr = 18.0

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        shot = torch.tensor([n.shot for n in captures.nlf])[:, :, None, None]
        read = torch.tensor([n.read for n in captures.nlf])[:, :, None, None]
        light = captures.light.clamp(min=0.0)
        variance = (light * shot.to(light)).add_(read.to(light)).clamp_(min=1e-30)
        power = (light.clamp_(max=1.0).square_() / variance).pow_(0.75)  # SNR**1.5
        share: torch.Tensor = power / (power + self.half_snr**1.5)
        return share.mean(dim=(1, 2, 3), dtype=torch.float64)


class Sharpness:
    """Motion and defocus blur: mean over the pixels of ``1 / (1 + (b / b0)^2)``.

    b is the extent of both blurs of a pixel together in pixels of the frame, b0 a 64th of its
    height.
    """

    domain: Domain = "raw"
    depends_on: DependsOn = "blur"
    reads_pixels = False

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        scale, blur = 64.0 / captures.frame_height, captures.pixel_blur
        if blur is None:
            return 1.0 / (1.0 + (captures.blur_px * scale) ** 2)
        return (blur.shares / (1.0 + (blur.levels * scale) ** 2)).sum(dim=1)
