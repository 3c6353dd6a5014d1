"""The interface of a scorer, and `Captures`: the facts about the images that it scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch

from ae_env.scenes.scene import Scene
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.optics.discs import DIAMETERS
from simulator.optics.motion import Movement
from simulator.settings import CameraSettings


class PixelBlur(NamedTuple):
    """Blur of B captures whose pixels differ in it.

    Args:
        levels: (B, K) float64, extents that pixels of a capture have [pixel of the frame].
        shares: (B, K) float64, shares of the pixels that have them; they sum to 1.
    """

    levels: torch.Tensor
    shares: torch.Tensor

    @property
    def rms_px(self) -> torch.Tensor:
        """(B,) root mean square extent over the pixels [pixel of the frame]."""
        return self.levels.square().mul_(self.shares).sum(dim=1).sqrt_()


def layout_blur(
    scene: Scene,
    movement: Movement,
    *,
    speed: float,
    times: np.ndarray,
    discs: np.ndarray,
    own: np.ndarray,
) -> PixelBlur | None:
    """Blur of S captures of a scene with a layout; None where all pixels have the same.

    Args:
        scene: The scene.
        movement: Directions of the image's motion, and the subject's own.
        speed: Image speed [frame heights per second].
        times: (S,) exposure times [s].
        discs: (S,) diameters of the largest disc of defocus [pixel].
        own: (S,) blur that the scene brings itself [pixel].
    """
    layout, height = scene.layout, scene.light.shape[-2]
    if layout is None or not (discs.any() or movement.subject_speed):
        return None
    counted = layout.shares
    own_square = own**2
    rest = ((speed * times * height) ** 2 + own_square)[:, None]
    if movement.subject_speed:
        extent = movement.subject_extent(speed, times) * height
        rest = np.where(counted.subject, (extent**2 + own_square)[:, None], rest)
    levels = np.minimum(np.multiply.outer(discs, counted.defocus), DIAMETERS[-1])  # as in the frame
    levels *= levels
    levels += rest
    np.sqrt(levels, out=levels)  # (S, K)
    shares = torch.from_numpy(counted.share).expand(len(times), -1)
    return PixelBlur(torch.from_numpy(levels), shares)


def stacked(parts: Sequence[PixelBlur | None], blur_px: np.ndarray) -> PixelBlur | None:
    """One of captures of several scenes, from one of each; None where none of them has any.

    Args:
        parts: Of one capture each, B long.
        blur_px: (B,) extent of those that have the same everywhere [pixel of the frame].
    """
    most = max((part.levels.shape[1] for part in parts if part is not None), default=0)
    if not most:
        return None
    levels, shares = torch.zeros(2, len(parts), most, dtype=torch.float64)
    for i, part in enumerate(parts):
        if part is None:
            levels[i, 0], shares[i, 0] = float(blur_px[i]), 1.0
        else:
            count = part.levels.shape[1]
            levels[i, :count], shares[i, :count] = part.levels[0], part.shares[0]
    return PixelBlur(levels, shares)


ColourMatrix = tuple[tuple[float, float, float], ...]
Domain = Literal["raw", "srgb"]
#: Input that decides a score: ``"image"``, the recorded image with its noise; ``"light"``, the
#: noise-free light on the sensor; ``"blur"``, also (or only) the extent of the blur, which changes
#: from episode to episode. The last two have a closed form and need no noise seeds; in static light
#: they are computed once per episode.
DependsOn = Literal["image", "light", "blur"]


@runtime_checkable
class Scorer(Protocol):
    """Rates images between 0 and 1; higher is better.

    A scorer has ``domain``, ``"raw"`` or ``"srgb"``, and may have ``depends_on``, by default
    ``"image"``. Called with images (B, C, H, W) in [0, 1] (C = 4 for raw, 3 for sRGB) and the
    `Captures` they come from, it returns (B,) in [0, 1]. A scorer with ``depends_on`` ``"light"``
    or ``"blur"`` reads the captures only and is called with ``images=None``.
    """

    domain: Domain

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,) of the images."""


def reads_pixels(scorer: Scorer) -> bool:
    """Whether `scorer` looks at images or at the light of a scene; True unless it says otherwise.

    Those with ``reads_pixels = False`` see the settings, the exposure and the blur only.
    """
    return bool(getattr(scorer, "reads_pixels", True))


@dataclass(frozen=True, eq=False)
class Captures:
    """The facts about a batch of B captures besides their pixels.

    Args:
        settings: Settings of each capture, B long.
        scene_ids: Scene of each capture, B long.
        scene_light: (B, 4, H, W) linear light of the scenes at their reference settings.
        ratio: (B,) float64, exposure ratio from that reference to the capture.
        nlf: Noise of a native sensor pixel at the settings, B long.
        proper_ev: (B,) float64, EV100 of the right exposure: that of the incident light, or, where
            it is unknown, the one at which the mean of the recorded green is 0.12.
        blur_px: (B,) float64, extent of motion and defocus blur together [pixel of the frame]; the
            root mean square over the pixels, where they differ.
        white_balance: (B, 3) gains of R, G, B.
        colour_matrices: XYZ (D65) to camera RGB of each scene's light, 3 x 3, B long; None where
            unknown.
        row_gain: (B, H) float64, light of each row relative to the frame's mean, which is in
            `ratio` and `proper_ev`: the bands of flickering light. None where every row of every
            capture has the same.
        source_noise: Noise that the source of each capture brings, of a native pixel, B long; None
            where all come from light without noise.
        noisy: Whether the captures have noise.
        pixel_blur: How many pixels have which extent of blur; None where all have `blur_px`.
    """

    settings: Sequence[CameraSettings]
    scene_ids: Sequence[str]
    scene_light: torch.Tensor
    ratio: torch.Tensor
    nlf: Sequence[NoiseLevelFunction]
    proper_ev: torch.Tensor
    blur_px: torch.Tensor
    white_balance: torch.Tensor
    colour_matrices: Sequence[ColourMatrix | None]
    row_gain: torch.Tensor | None = None
    source_noise: Sequence[NoiseLevelFunction] | None = None
    noisy: bool = True
    pixel_blur: PixelBlur | None = None

    def __len__(self) -> int:
        return len(self.settings)

    @cached_property
    def light(self) -> torch.Tensor:
        """(B, 4, H, W) noise-free signal at the settings, before blur and clip; white is 1."""
        light = self.scene_light * self.ratio.to(self.scene_light.dtype)[:, None, None, None]
        if self.row_gain is None:
            return light
        return light * self.row_gain.to(light.dtype)[:, None, :, None]

    def noise_variance(self, signal: torch.Tensor) -> torch.Tensor:
        """Variance of a native pixel's noise in the captures, at the recorded `signal`.

        The camera's own at the settings, or the source's where it brought more.

        Args:
            signal: (B, 4, ...), at least 0, white is 1.
        """
        variance = torch.zeros_like(signal)
        if not self.noisy:
            return variance
        for noises in (self.nlf, self.source_noise or ()):
            if noises:
                shape = (len(self), 4, *[1] * (signal.ndim - 2))
                shot = torch.tensor([n.shot for n in noises]).reshape(shape).to(signal)
                read = torch.tensor([n.read for n in noises]).reshape(shape).to(signal)
                variance = variance.maximum(signal * shot + read)
        return variance

    @cached_property
    def ev100(self) -> torch.Tensor:
        """(B,) float64, EV100 of the settings, with the effective f-numbers."""
        return torch.tensor([-s.log2_exposure for s in self.settings], dtype=torch.float64)

    @property
    def frame_height(self) -> int:
        """Height of the packed frame [pixel]."""
        return self.scene_light.shape[-2]
