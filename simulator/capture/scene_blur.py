"""Blur that differs from pixel to pixel, or follows a path: of a scene with a layout, in motion.

Defocus comes first, by each pixel's circle of confusion. Then the background moves along the
camera's path, with what is nearest in place of the subject, and the subject in front of it along
its own: what its smeared mask leaves uncovered shows the background. Uniform light stays uniform.
"""

from __future__ import annotations

import functools

import torch

from simulator.capture.denoised import Denoised
from simulator.capture.exposure import LIGHT_LIMIT, Exposure
from simulator.capture.layout import Layout
from simulator.capture.sensor import defocused_light, exposed_light, sensor_light
from simulator.optics.blur import motion_blur
from simulator.optics.disc_bank import DiscBank, remaining_variance
from simulator.optics.motion_path import Path, Taps, path_blur, path_blur_apart, path_taps
from simulator.utils.tiles import TILE


class SceneBlur:
    """Blurs the light of one scene, and caches what its discs make of it on small frames."""

    def __init__(self) -> None:
        self._banks: dict[tuple[Denoised | None, float | None], DiscBank] = {}

    def forget(self) -> None:
        """Drops the cached discs."""
        self._banks.clear()

    def defocused(
        self, source: torch.Tensor, exposure: Exposure, out: torch.Tensor | None = None
    ) -> torch.Tensor:
        """`source` (4, H, W) behind the lens of `exposure`.

        Args:
            source: Light that the exposure starts from.
            exposure: The exposure.
            out: Contiguous tensor to write to, instead of a new one, where `source` is on the CPU.
        """
        if exposure.layout is None or not exposure.defocus_px:
            blurred = defocused_light(source, exposure.defocus_px)
            return blurred if out is None else out.copy_(blurred)
        key = exposure.denoised, exposure.opened_to
        bank = self._banks.get(key)
        if bank is None:
            bank = DiscBank(source.clamp(-LIGHT_LIMIT, LIGHT_LIMIT))
            if source.shape[-2] * source.shape[-1] <= TILE**2:
                self._banks[key] = bank
        diameter = exposure.layout.defocus.to(source.device) * exposure.defocus_px
        return bank.blurred(diameter, out)


def moved(light: torch.Tensor, exposure: Exposure, out: torch.Tensor | None = None) -> torch.Tensor:
    """`light` (4, H, W), behind the lens already, as it moves in `exposure`.

    Args:
        light: Light; limited to `LIGHT_LIMIT`.
        exposure: An exposure; without a path, the motion is along the rows.
        out: See `SceneBlur.defocused`.
    """
    if exposure.path is None:
        streak = motion_blur(light, exposure.motion_px)
        return streak if out is None else out.copy_(streak)
    height, width = light.shape[-2:]
    taps = path_taps(exposure.path, height, width)
    if exposure.subject_path is None or exposure.layout is None:
        return path_blur(light, taps, out, limit=LIGHT_LIMIT)
    own, layout = path_taps(exposure.subject_path, height, width), exposure.layout
    return path_blur_apart(light, layout.mask, layout.behind, taps, own, out, limit=LIGHT_LIMIT)


def scene_light(source: torch.Tensor, exposure: Exposure) -> torch.Tensor:
    """`sensor_light` of any `exposure`, also one with a layout or a path."""
    if exposure.is_uniform:
        return sensor_light(source, exposure)
    return exposed_light(moved(SceneBlur().defocused(source, exposure), exposure), exposure)


# -- noise of the source ------------------------------------------------------------------------


def remaining_noise(
    exposure: Exposure, height: int, width: int
) -> tuple[float, torch.Tensor | None]:
    """Share of a source's noise variance that the blur of `exposure` leaves.

    Args:
        exposure: An exposure with a path or a layout.
        height, width: Of the frame [pixel].

    Returns:
        That of the whole frame, and (H, W) that of each pixel relative to it; None for 1.
    """
    path = exposure.path
    if path is None and exposure.motion_px:
        path = Path(exposure.motion_px)
    blurs = path, exposure.subject_path, exposure.defocus_px
    if exposure.layout is None:
        return _uniform_energy(path, exposure.defocus_px, height, width), None
    return 1.0, _remaining_noise(exposure.layout, *blurs)


@functools.lru_cache(maxsize=2)  # a plan asks again
def _remaining_noise(
    layout: Layout, path: Path | None, own: Path | None, defocus_px: float
) -> torch.Tensor:
    height, width = layout.defocus.shape
    diameter = layout.defocus * defocus_px
    if path is None:
        return remaining_variance(diameter)
    taps = path_taps(path, height, width)
    left = remaining_variance(diameter, taps)
    if own is None:
        return path_blur(left[None], taps)[0]
    # Taps of pixels that differ leave the mean of what each of these would leave alone.
    taps_own = path_taps(own, height, width)
    left = path_blur(left.flatten()[layout.behind][None], taps)
    subject = path_blur(layout.mask * remaining_variance(diameter, taps_own), taps_own)
    seen = 1.0 - path_blur(layout.mask, taps_own)
    return (seen.square() * left + subject)[0].clamp(max=1.0)


@functools.lru_cache(maxsize=4096)
def _uniform_energy(path: Path | None, defocus_px: float, height: int, width: int) -> float:
    taps: Taps | None = None if path is None else path_taps(path, height, width)
    return float(remaining_variance(torch.full((1, 1), defocus_px), taps))
