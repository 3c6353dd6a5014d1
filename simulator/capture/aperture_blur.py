"""The blur that a wider aperture adds to a photograph whose depth is not known."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import torch
from torch import Tensor

from simulator.capture.denoised import Denoised
from simulator.capture.exposure import LIGHT_LIMIT
from simulator.optics.disc_bank import HALO, DiscBank, added_blur, remaining_variance
from simulator.utils.cache import LruCache
from simulator.utils.tiles import TILE, Tile, make_tiles

#: Memory that the cached opened light of one scene may take [byte].
CACHE_BYTES = 256 * 2**20


class MapApertureBlur:
    """Blurs by the estimated circle of confusion of each pixel (preset ``"compact"``).

    Only the parts of the frame that are out of focus are blurred, tile by tile; the rest is copied.

    Args:
        light: (4, H, W) as recorded.
        diameter: (H, W) circle of confusion at `f_number` [pixel of `light`], or a function that
            estimates it, called when an aperture first opens.
        f_number: Effective f-number of the light.
        everywhere: See `simulator.capture.blurred_light.ApertureBlur`.
    """

    needs_denoised = False

    def __init__(
        self,
        light: Tensor,
        diameter: Tensor | Callable[[], Tensor],
        f_number: float,
        *,
        everywhere: bool = True,
    ) -> None:
        self.f_number, self._diameter, self.everywhere = f_number, diameter, everywhere
        self._recorded = light
        self._banks: dict[tuple[Tile, Denoised | None], DiscBank] = {}
        self._cache: LruCache[Tensor] = LruCache(CACHE_BYTES)

    @cached_property
    def diameter(self) -> Tensor:
        """(H, W) circle of confusion at the light's own f-number [pixel]."""
        return self._diameter if isinstance(self._diameter, Tensor) else self._diameter()

    def extent(self, f_number: float) -> float:
        """See `ApertureBlur`."""
        if f_number >= self.f_number:
            return 0.0
        return float(added_blur(self._largest, self.f_number, f_number))

    def opened(self, f_number: float, denoised: Denoised | None) -> Tensor:
        """See `ApertureBlur`."""
        key = (f_number, denoised)
        result = self._cache.get(key)
        if result is None:
            light = self._recorded if denoised is None else denoised.light
            result = self._blurred(light, denoised, f_number)
            self._cache.put(key, result, result.nbytes)
        return result

    def remaining_variance(self, f_number: float) -> Tensor:
        """See `ApertureBlur`."""
        return remaining_variance(added_blur(self.diameter, self.f_number, f_number))

    @cached_property
    def mean_square_diameter(self) -> float:
        """See `ApertureBlur`."""
        return float(self.diameter.square().mean())

    @cached_property
    def _largest(self) -> Tensor:
        return self.diameter.max()

    @cached_property
    def _tiles(self) -> list[Tile]:
        """The parts of the frame that are out of focus."""
        return make_tiles(*self.diameter.shape, halo=HALO, needed=self.diameter > 0)

    def _blurred(self, light: Tensor, denoised: Denoised | None, f_number: float) -> Tensor:
        def blurred(tile: Tile) -> Tensor:
            added = added_blur(self.diameter[tile.outer], self.f_number, f_number)
            return self._bank(light, denoised, tile).blurred(added)[tile.core]

        tiles = self._tiles
        if len(tiles) == 1 and light[tiles[0].inner].shape == light.shape:
            return blurred(tiles[0])
        result = light.clamp(-LIGHT_LIMIT, LIGHT_LIMIT)
        for tile in tiles:
            result[tile.inner] = blurred(tile)
        return result

    def _bank(self, light: Tensor, denoised: Denoised | None, tile: Tile) -> DiscBank:
        """The discs of a tile, cached on small frames: close f-numbers share most of them."""
        bank = self._banks.get((tile, denoised))
        if bank is None:
            # Beyond the limit sums would no longer resolve the shadows.
            bank = DiscBank(light[tile.outer].clamp(-LIGHT_LIMIT, LIGHT_LIMIT))
            if self.diameter.numel() <= TILE**2:
                self._banks[tile, denoised] = bank
        return bank


class NetworkApertureBlur:
    """Runs the paper's attention U-Net for every f-number (presets ``"paper"``, ``"ncs"``).

    Args:
        denoised: Light (4, H, W) with little noise.
        module: The trained network, called as `ApertureModule` is.
        f_number: Effective f-number of the light.
    """

    needs_denoised = True
    everywhere = True
    mean_square_diameter = 0.0  # its network gives none

    def __init__(
        self,
        denoised: Denoised,
        module: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor],
        f_number: float,
    ) -> None:
        self.f_number, self._denoised, self._module = f_number, denoised, module
        self._cache: LruCache[Tensor] = LruCache(CACHE_BYTES)

    def extent(self, f_number: float) -> float:
        """Unknown before the network ran: taken as large wherever the aperture opens."""
        return float("inf") if f_number < self.f_number else 0.0

    @torch.no_grad()
    def opened(self, f_number: float, denoised: Denoised | None = None) -> Tensor:
        """See `ApertureBlur`."""
        result = self._cache.get(f_number)
        if result is None:
            image = self._denoised.light[None]
            f_numbers = (torch.tensor([n], device=image.device) for n in (self.f_number, f_number))
            result = self._module(image, torch.zeros_like(image), *f_numbers)[0]
            self._cache.put(f_number, result, result.nbytes)
        return result

    def remaining_variance(self, f_number: float) -> None:
        """None: the recorded noise is gone, there is nothing to account for."""
