"""The light of a scene behind the apertures and shutter times that were asked for."""

from __future__ import annotations

from collections.abc import Callable

import torch

from simulator.capture.aperture_blur import ApertureBlur
from simulator.capture.denoised import Denoised
from simulator.capture.exposure import Exposure
from simulator.capture.record import defocused_light
from simulator.optics.blur import motion_blur
from simulator.utils.cache import LruCache

#: Memory that the blurred light of one scene may take [byte].
KEPT_BYTES = 512 * 2**20


class BlurredLight:
    """Blurs a scene's light, each blur when it is first asked for, and keeps the latest.

    Blur and exposure are linear: one light per f-number, and one per f-number and length of the
    streak, serve every ISO.

    Args:
        light: (4, H, W) as recorded.
        denoised: The same with little noise, or None.
        opening: Blur that wider apertures add, or None.
        kept_bytes: Memory for what is kept; the light that was used longest ago goes first.
    """

    def __init__(
        self,
        light: torch.Tensor,
        denoised: Denoised | None,
        aperture_blur: ApertureBlur | None,
        kept_bytes: int = KEPT_BYTES,
    ) -> None:
        self.light, self.denoised, self.aperture_blur = light, denoised, aperture_blur
        self._added: dict[float, float] = {}
        self._kept: LruCache[torch.Tensor] = LruCache(kept_bytes)

    def is_of(
        self, light: torch.Tensor, denoised: Denoised | None, aperture_blur: ApertureBlur | None
    ) -> bool:
        """Whether it was made for these very objects."""
        return (
            self.light is light
            and self.denoised is denoised
            and self.aperture_blur is aperture_blur
        )

    def added_blur(self, f_number: float) -> float:
        """Largest diameter of the blur that opening to `f_number` adds [pixel]; 0 for none."""
        if self.aperture_blur is None or f_number >= self.aperture_blur.f_number:
            return 0.0
        if f_number not in self._added:
            self._added[f_number] = self.aperture_blur.extent(f_number)
        return self._added[f_number]

    def remaining(self, f_number: float, energy: float) -> torch.Tensor | None:
        """(H, W) `Exposure.remaining` where other blurs left `energy` of the noise's variance."""
        if self.aperture_blur is None:
            return None
        key = ("remaining", f_number, energy)
        left = self._kept.get(key)
        if left is None:
            share = self.aperture_blur.remaining(f_number)
            if share is None:
                return None
            left = (share / energy).clamp(max=1.0)
            self._kept.put(key, left, left.nbytes)
        return left

    def source(self, exposure: Exposure) -> torch.Tensor:
        """The light (4, H, W) that `exposure` starts from: as recorded, denoised or opened."""
        if exposure.opened_to is not None and self.aperture_blur is not None:
            return self.aperture_blur.opened(exposure.opened_to, denoised=exposure.denoised)
        return self.denoised.light if exposure.denoised and self.denoised else self.light

    def blurred(self, exposure: Exposure) -> torch.Tensor:
        """The light (4, H, W) with every blur of `exposure`, not exposed yet; not to be changed."""
        if exposure.motion_px:
            return self._kept_light(
                blur_key(exposure),
                lambda: motion_blur(self._defocused(exposure), exposure.motion_px),
            )
        return self._defocused(exposure) if exposure.defocus_px else self.source(exposure)

    def _defocused(self, exposure: Exposure) -> torch.Tensor:
        if not exposure.defocus_px:
            return defocused_light(self.source(exposure), 0.0)  # limited, as blur needs it
        return self._kept_light(
            blur_key(exposure)[:-1],
            lambda: defocused_light(self.source(exposure), exposure.defocus_px),
        )

    def _kept_light(
        self, key: tuple[object, ...], make: Callable[[], torch.Tensor]
    ) -> torch.Tensor:
        light = self._kept.get(key)
        if light is None:
            light = make()
            self._kept.put(key, light, light.nbytes)
        return light


def blur_key(exposure: Exposure) -> tuple[object, ...]:
    """What the light on the sensor depends on, besides the exposure ratio."""
    return (exposure.denoised, exposure.opened_to, exposure.defocus_px, exposure.motion_px)
