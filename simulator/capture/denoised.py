"""A source's light without its noise, worked out when a transition first needs it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cached_property

import torch

from simulator.capture.light_statistics import LightStatistics
from simulator.raw.image import check_packed


class Denoised:
    """Light with its noise removed by a noise module.

    A network is the most expensive step there is, and many transitions do without: nothing runs
    before `light` is read, and then once.

    Args:
        light: (4, H, W) float32, or what works it out.
        everywhere: Whether it is so also where a positive tolerance needs no network.
    """

    def __init__(
        self, light: torch.Tensor | Callable[[], torch.Tensor], *, everywhere: bool = True
    ) -> None:
        if isinstance(light, torch.Tensor):
            light = check_packed("denoised", light)
        self._light, self.everywhere = light, everywhere
        self._lock = threading.RLock()

    def __reduce__(self) -> tuple[Callable[..., Denoised], tuple[torch.Tensor, bool]]:
        return _restored, (self.light, self.everywhere)

    @property
    def light(self) -> torch.Tensor:
        """(4, H, W) at the exposure of the source."""
        with self._lock:
            if not isinstance(self._light, torch.Tensor):
                self._light = self._light()
            return self._light

    @property
    def shape(self) -> torch.Size | None:
        """Of `light`, where it is known already."""
        return self._light.shape if isinstance(self._light, torch.Tensor) else None

    @cached_property
    def statistics(self) -> LightStatistics:
        """Of `light`."""
        return LightStatistics(self.light)

    def to(self, device: torch.device) -> Denoised:
        """The same on `device`; itself where it is there already."""
        light = self._light
        if isinstance(light, torch.Tensor) and light.device == device:
            return self
        return Denoised(lambda: self.light.to(device), everywhere=self.everywhere)


def _restored(light: torch.Tensor, everywhere: bool) -> Denoised:
    return Denoised(light, everywhere=everywhere)
