"""The terms that `balanced` is made of, and `Banding`.

Exposure and blur are known of a capture; `Highlights`, `Shadows` and `Noise` are measured on the
frame that was recorded. Their constants were frozen before any agent was trained.
"""

from __future__ import annotations

import numpy as np
import torch

from ae_env.observation import decode_observation, encode_observation
from ae_env.scorers.captures import Captures, DependsOn, Domain, PixelBlur


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


def code_signals() -> torch.Tensor:
    """(256,) float32 signals of the 8-bit codes; 0 up to the code of black."""
    signals = torch.from_numpy(decode_observation(np.arange(256, dtype=np.uint8)))
    signals[: int(encode_observation(torch.zeros(1))) + 1] = 0.0
    return signals


def recorded_signal(images: torch.Tensor) -> torch.Tensor:
    """Signal of raw `images` (B, 4, H, W) as their 8-bit codes show it, at least 0.

    The terms are functions of these codes, so that what rates a frame is what an agent sees of it.
    """
    return code_signals().to(images.device)[encode_observation(images).long()]


class Highlights:
    """Blown highlights: ``exp(-f / 0.15)``, f the share of pixels with a plane at white.

    At white is the last of the 8-bit codes: 0.996 of sensor white or more.

    Attributes:
        scale: Share at which the score is 1/e, 0.15.
    """

    domain: Domain = "raw"
    scale = 0.15

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        blown = recorded_signal(images).amax(dim=1) >= 1.0
        return torch.exp(-blown.double().mean(dim=(1, 2)) / self.scale)


class Shadows:
    """Blocked shadows: ``exp(-f / 0.20)``, f the mean of ``sigmoid(-(log2(x) + 9) / 0.5)``.

    Attributes:
        scale: Share at which the score is 1/e, 0.20.
        depth: How far below white a sample is half blocked, 9 stops.
        width: Of the sigmoid, 0.5 stop.
    """

    domain: Domain = "raw"
    scale = 0.20
    depth = 9.0
    width = 0.5

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        dark = self.shares(recorded_signal(images))
        return torch.exp(-dark.mean(dim=(1, 2, 3), dtype=torch.float64) / self.scale)

    @classmethod
    def shares(cls, signal: torch.Tensor) -> torch.Tensor:
        """How far samples of a recorded `signal` are blocked, 0 to 1."""
        stops = signal.clamp(min=2.0**-40).log2_()
        return torch.sigmoid((stops + cls.depth).mul_(-1.0 / cls.width))


class Noise:
    """Signal-to-noise ratio of a native sensor pixel: mean of ``s / (s + 18^1.5)``, s = SNR^1.5.

    SNR is ``x / sqrt(variance)`` of the recorded value x. The variance is that of the noise in the
    frame: shot and read noise at the settings, or the source's where that is greater; none where
    the frame has none. It is of the sensor's own pixels, not of the box-averaged frame: otherwise
    ISO would be nearly free.

    Attributes:
        half_snr: SNR at which the score is a half, 18.
    """

    domain: Domain = "raw"
    half_snr = 18.0

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        signal = recorded_signal(images)
        shares = self.shares(signal, captures.noise_variance(signal))
        return shares.mean(dim=(1, 2, 3), dtype=torch.float64)

    @classmethod
    def shares(cls, signal: torch.Tensor, variance: torch.Tensor) -> torch.Tensor:
        """``s / (s + 18^1.5)`` of samples of a recorded `signal`, >= 0, with this noise."""
        power = (signal.square() / variance.clamp(min=1e-30)).pow_(0.75)  # SNR**1.5
        return power / (power + cls.half_snr**1.5)


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
        blur = captures.blur_px if captures.pixel_blur is None else captures.pixel_blur
        return self.of(blur, captures.frame_height)

    @staticmethod
    def of(blur: torch.Tensor | PixelBlur, frame_height: int) -> torch.Tensor:
        """Scores (B,) of extents (B,), or of those of the pixels, in frames so high."""
        scale = 64.0 / frame_height
        if isinstance(blur, PixelBlur):
            return (blur.shares / (1.0 + (blur.levels * scale) ** 2)).sum(dim=1)
        return 1.0 / (1.0 + (blur * scale) ** 2)
