"""A scene's light after a noise module, worked out when it is first needed."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch

from simulator.capture.light_statistics import LightStatistics
from simulator.capture.residual import Residual
from simulator.raw.image import check_packed


class Denoised:
    """Light with its noise removed by a noise module.

    A network is the most expensive step there is, and many transitions need none: it runs when
    `light` is first read, and only then.

    Args:
        light: (4, H, W) float32, or a function that works it out.
        name: Of the network.
        residual: What it gets wrong; None where that was not measured.
        operations: Arithmetic operations that it takes, all pixels together.
        seconds: Estimates how long that takes on this machine.
        everywhere: Whether the noise is also removed where a positive tolerance needs no network.
    """

    def __init__(
        self,
        light: torch.Tensor | Callable[[], torch.Tensor],
        *,
        name: str = "network",
        residual: Residual | None = None,
        operations: int = 0,
        seconds: Callable[[], float] = float,
        everywhere: bool = True,
    ) -> None:
        if isinstance(light, torch.Tensor):
            light = check_packed("denoised", light)
        self._light, self.everywhere = light, everywhere
        self.name, self.residual, self.operations = name, residual, operations
        self.seconds = seconds
        self._lock = threading.RLock()

    def __reduce__(self) -> tuple[Callable[..., Denoised], tuple[Any, ...]]:
        return _restored, (self.light, self.name, self.residual, self.operations, self.everywhere)

    @property
    def light(self) -> torch.Tensor:
        """(4, H, W) at the exposure of the source."""
        with self._lock:
            if not isinstance(self._light, torch.Tensor):
                self._light = self._light()
            return self._light

    @property
    def shape(self) -> torch.Size | None:
        """Shape of `light`, where it is known already."""
        return self._light.shape if isinstance(self._light, torch.Tensor) else None

    @cached_property
    def statistics(self) -> LightStatistics:
        """Statistics of `light`."""
        return LightStatistics(self.light)

    def to(self, device: torch.device) -> Denoised:
        """The same on `device`; itself where it is there already."""
        light = self._light
        if isinstance(light, torch.Tensor) and light.device == device:
            return self
        return Denoised(
            lambda: self.light.to(device),
            name=self.name,
            residual=self.residual,
            operations=self.operations,
            seconds=self.seconds,
            everywhere=self.everywhere,
        )


def _restored(
    light: torch.Tensor, name: str, residual: Residual | None, operations: int, everywhere: bool
) -> Denoised:
    return Denoised(
        light, name=name, residual=residual, operations=operations, everywhere=everywhere
    )
