"""The lights of one scene: as recorded, denoised, with the aperture opened, and blurred."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch

from simulator.capture.denoised import Denoised
from simulator.capture.exposure import Exposure
from simulator.capture.light_statistics import LightStatistics
from simulator.capture.residual import ResidualStatistics
from simulator.capture.scene_blur import SceneBlur, moved
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.utils.cache import LruCache

#: Memory that the cached blurred light of one scene may take [byte].
CACHE_BYTES = 512 * 2**20


class ApertureBlur(Protocol):
    """Opens the aperture of one scene's light; results are cached, as f-numbers are few.

    `simulator.capture.aperture_blur` has the two that there are.
    """

    f_number: float
    """Effective f-number at which the light was recorded."""

    needs_denoised: bool
    """Whether it works on the noise-reduced light only."""

    everywhere: bool
    """Whether it opens also where a positive tolerance needs no network."""

    @property
    def mean_square_diameter(self) -> float:
        """Mean square of the circle of confusion in the light itself [pixel^2]; 0 if unknown."""

    def extent(self, f_number: float) -> float:
        """Largest diameter of the blur that opening to `f_number` adds [pixel]."""

    def opened(self, f_number: float, denoised: Denoised | None) -> torch.Tensor:
        """Light (4, H, W) at the wider aperture, at unchanged exposure.

        Args:
            f_number: Effective f-number wanted, smaller than the source's.
            denoised: The noise-reduced light that is opened; None for the light as recorded.
        """

    def remaining_variance(self, f_number: float) -> torch.Tensor | None:
        """(H, W) share of the recorded noise's variance that the blur leaves; None for all."""


class BlurredLight:
    """Blurs a scene's light, each blur when it is first asked for, and caches the latest.

    Blur and exposure are linear: one light per f-number, and one per f-number and length of the
    streak, serve every ISO.

    Args:
        light: (4, H, W) as recorded.
        denoised: The same with little noise, by each network.
        nlf: Noise of `light`.
        aperture_blur: Blur that wider apertures add, or None.
        statistics: Statistics of `light`, where they are at hand.
        cache_bytes: Memory of the cache; the light that was used longest ago goes first.
    """

    def __init__(
        self,
        light: torch.Tensor,
        denoised: tuple[Denoised, ...],
        nlf: NoiseLevelFunction,
        aperture_blur: ApertureBlur | None,
        statistics: LightStatistics | None = None,
        cache_bytes: int = CACHE_BYTES,
    ) -> None:
        self.light, self.denoised, self.aperture_blur = light, denoised, aperture_blur
        self.statistics = LightStatistics(light) if statistics is None else statistics
        self.residuals = ResidualStatistics(light, nlf)
        self._added: dict[float, float] = {}
        self._cache: LruCache[torch.Tensor] = LruCache(cache_bytes)
        self._scene_blur = SceneBlur()

    def copy(self, cache_bytes: int) -> BlurredLight:
        """One of the same light with an empty cache of its own."""
        nlf, statistics = self.residuals.nlf, self.statistics
        copied = BlurredLight(
            self.light, self.denoised, nlf, self.aperture_blur, statistics, cache_bytes
        )
        copied.residuals = self.residuals
        return copied

    def is_of(
        self,
        light: torch.Tensor,
        denoised: tuple[Denoised, ...],
        nlf: NoiseLevelFunction,
        aperture_blur: ApertureBlur | None,
    ) -> bool:
        """Whether it was made for exactly these objects."""
        return (
            self.light is light
            and self.denoised == denoised
            and self.residuals.nlf == nlf
            and self.aperture_blur is aperture_blur
        )

    def added_blur(self, f_number: float) -> float:
        """Largest diameter of the blur that opening to `f_number` adds [pixel]; 0 for none."""
        if self.aperture_blur is None or f_number >= self.aperture_blur.f_number:
            return 0.0
        if f_number not in self._added:
            self._added[f_number] = self.aperture_blur.extent(f_number)
        return self._added[f_number]

    def remaining_variance(self, f_number: float, energy: float) -> torch.Tensor | None:
        """(H, W) `Exposure.remaining_variance` where other blurs left a share `energy`."""
        if self.aperture_blur is None:
            return None
        key = ("remaining_variance", f_number, energy)
        left = self._cache.get(key)
        if left is None:
            share = self.aperture_blur.remaining_variance(f_number)
            if share is None:
                return None
            left = (share / energy).clamp(max=1.0)
            self._cache.put(key, left, left.nbytes)
        return left

    def source(self, exposure: Exposure) -> torch.Tensor:
        """The light (4, H, W) that `exposure` starts from: as recorded, denoised or opened."""
        if exposure.opened_to is not None and self.aperture_blur is not None:
            return self.aperture_blur.opened(exposure.opened_to, exposure.denoised)
        return self.light if exposure.denoised is None else exposure.denoised.light

    def blurred(self, exposure: Exposure) -> torch.Tensor:
        """The light (4, H, W) with every blur of `exposure`, not exposed yet; not to be changed."""
        if exposure.motion_px:
            return self._cached(exposure.blur, lambda: moved(self._defocused(exposure), exposure))
        return self._defocused(exposure) if exposure.defocus_px else self.source(exposure)

    def _defocused(self, exposure: Exposure) -> torch.Tensor:
        def make() -> torch.Tensor:
            return self._scene_blur.defocused(self.source(exposure), exposure)

        return self._cached(exposure.lens_blur, make) if exposure.defocus_px else make()

    def _cached(self, key: tuple[object, ...], make: Callable[[], torch.Tensor]) -> torch.Tensor:
        light = self._cache.get(key)
        if light is None:
            light = make()
            self._cache.put(key, light, light.nbytes)
        return light
