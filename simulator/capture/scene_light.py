"""The blurred light of one scene of a batch: what must be blurred, and where it goes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch

from simulator.capture.exposure import LIGHT_LIMIT, Exposure
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.scene_blur import SceneBlur, moved
from simulator.optics.blur_kernels import Blur
from simulator.optics.blur_kernels import streak as motion_streak


class SceneLight:
    """The blurred light of one scene, in memory that is used again.

    Unlike `simulator.capture.blurred_light.BlurredLight`, which serves sweeps, it only says what
    must be blurred, so that many scenes are blurred side by side. The latest light is cached,
    because an agent that has settled repeats its state.

    Args:
        prepared: The scene in its own light.
        free: Images that may be written to; they are put back here.
        cache: Whether the defocused light of every f-number is cached.
    """

    def __init__(self, prepared: PreparedScene, free: list[torch.Tensor], cache: bool) -> None:
        self.prepared, self._free, self._cache = prepared, free, cache
        self._defocused: dict[tuple[Any, ...], torch.Tensor] = {}  # by aperture
        self._blurred: tuple[tuple[Any, ...], torch.Tensor] | None = None  # by all blur
        self._streak: torch.Tensor | None = None
        self._scene_blur = SceneBlur()

    def blurred(self, exposure: Exposure) -> tuple[torch.Tensor, Blur | Callable[[], None] | None]:
        """The light (4, H, W) with the blur of `exposure`, valid until the next call.

        Returns:
            The light, and the blur (`simulator.optics.blur_kernels.blur_many`) or the function that
            fills it; None where that was done before.
        """
        if self._blurred is not None and self._blurred[0] == exposure.blur:
            return self._blurred[1], None
        light = self._defocused.get(exposure.lens_blur)
        source = defocused = streak = None
        if light is None:
            light = source = self.prepared.source_light(exposure).contiguous()
            if exposure.defocus_px:
                if not self._cache:
                    self._drop_defocused()
                light = defocused = self._defocused[exposure.lens_blur] = self._take(light)
        if exposure.motion_px:
            source = light if source is None else source
            if self._streak is None:
                self._streak = self._take(light)
            light = streak = self._streak
        self._blurred = (exposure.blur, light)
        if defocused is None and streak is None:
            return light, None
        assert source is not None
        if exposure.is_uniform:
            return light, Blur(source, exposure.defocus_px, defocused, exposure.motion_px, streak)
        return light, partial(self._fill, exposure, source, defocused, streak)

    def _fill(
        self,
        exposure: Exposure,
        source: torch.Tensor,
        defocused: torch.Tensor | None,
        streak: torch.Tensor | None,
    ) -> None:
        """Blurs `source` into `defocused` by the lens and into `streak` by motion, where given."""
        if defocused is not None:
            source = self._scene_blur.defocused(source, exposure, defocused)
            if not self._cache:
                self._scene_blur.forget()
        if streak is not None:
            if exposure.path is None:
                motion_streak(source, exposure.motion_px, streak, limit=LIGHT_LIMIT)
            else:
                moved(source, exposure, streak)

    def _take(self, like: torch.Tensor) -> torch.Tensor:
        return self._free.pop() if self._free else torch.empty(like.shape)

    def give_back(self) -> None:
        """Puts all memory back; the light must not be used afterwards."""
        self._drop_defocused()
        if self._streak is not None:
            self._free.append(self._streak)

    def _drop_defocused(self) -> None:
        self._free.extend(self._defocused.values())
        self._defocused.clear()
        self._scene_blur.forget()
