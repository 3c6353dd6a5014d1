"""What a wider aperture does to a photograph whose depth is not known."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from simulator.capture import LATENT_LIMIT
from simulator.modules.aperture import ApertureModule, added_blur
from simulator.modules.disc_bank import DiscBank, remaining_variance

#: Blur that opening adds below this diameter [pixel] changes less than a digital number.
NEGLIGIBLE_ADDED_BLUR = 0.05


class Opening(Protocol):
    """Opens the aperture of one scene's light; results are kept, as f-numbers are few."""

    f_number: float
    """Effective f-number at which the light was recorded."""

    needs_denoised: bool
    """Whether it works on the noise-reduced light only."""

    def extent(self, f_number: float) -> float:
        """Largest diameter of the blur that opening to `f_number` adds [pixel]."""

    def opened(self, f_number: float, *, denoised: bool) -> Tensor:
        """Light (4, H, W) at the wider aperture, at unchanged exposure.

        Args:
            f_number: Effective f-number wanted, smaller than the source's.
            denoised: Whether the noise-reduced light is opened, or the light as it was recorded.
        """

    def remaining(self, f_number: float) -> Tensor | None:
        """(H, W) share of the recorded noise's variance that the blur leaves."""


class MapOpening:
    """Blurs by the estimated circle of confusion of each pixel (preset ``"compact"``).

    Args:
        light: (4, H, W) as recorded.
        denoised: (4, H, W) with little noise.
        diameter: (H, W) circle of confusion at `f_number` [pixel of `light`].
        f_number: Effective f-number of the light.
    """

    needs_denoised = False

    def __init__(self, light: Tensor, denoised: Tensor, diameter: Tensor, f_number: float) -> None:
        self.f_number, self.diameter = f_number, diameter
        limit = LATENT_LIMIT  # beyond it sums would no longer resolve the shadows
        self._banks = {
            False: DiscBank(light.clamp(-limit, limit)),
            True: DiscBank(denoised.clamp(-limit, limit)),
        }
        self._kept: dict[tuple[float, bool], Tensor] = {}
        self._largest = float(diameter.max())

    def extent(self, f_number: float) -> float:
        """See `Opening`."""
        return float(added_blur(torch.tensor(self._largest), self.f_number, f_number))

    def opened(self, f_number: float, *, denoised: bool) -> Tensor:
        """See `Opening`."""
        key = (f_number, denoised)
        if key not in self._kept:
            added = added_blur(self.diameter, self.f_number, f_number)
            self._kept[key] = self._banks[denoised].blurred(added)
        return self._kept[key]

    def remaining(self, f_number: float) -> Tensor:
        """See `Opening`."""
        return remaining_variance(added_blur(self.diameter, self.f_number, f_number))


class NetworkOpening:
    """Runs the paper's attention U-Net for every f-number (preset ``"paper"``).

    Args:
        denoised: (4, H, W) with little noise.
        module: The trained network.
        f_number: Effective f-number of the light.
    """

    needs_denoised = True

    def __init__(self, denoised: Tensor, module: ApertureModule, f_number: float) -> None:
        self.f_number, self._denoised, self._module = f_number, denoised, module
        self._kept: dict[float, Tensor] = {}

    def extent(self, f_number: float) -> float:
        """Unknown before the network ran: taken as large wherever the aperture opens."""
        return float("inf") if f_number < self.f_number else 0.0

    @torch.no_grad()
    def opened(self, f_number: float, *, denoised: bool = True) -> Tensor:
        """See `Opening`."""
        if f_number not in self._kept:
            image = self._denoised[None]
            f_numbers = (torch.tensor([n], device=image.device) for n in (self.f_number, f_number))
            self._kept[f_number] = self._module(image, torch.zeros_like(image), *f_numbers)[0]
        return self._kept[f_number]

    def remaining(self, f_number: float) -> None:
        """The recorded noise is gone: there is nothing to account for."""
