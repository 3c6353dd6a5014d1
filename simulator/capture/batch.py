"""What is kept between the frames of episodes: their plans, and the light that they blurred."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from simulator.capture.exposure import Exposure
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.record import record_batch
from simulator.noise.generator import sweep_keys
from simulator.optics.blur_kernels import Blur
from simulator.settings import CameraSettings


# Frames whose rows have light of their own: the bands of flickering light.
#
# The light of each row multiplies the blurred light before there is noise, so that the noise is that
# of the banded signal. (Motion runs along the rows, and defocus is complete before a row is read.)
# Noise that the source itself brings is multiplied with its light: its variance by the square of the
# row's, r^2. What the kernels take away for it has the variance times r: exact for shot noise, whose
# variance they work out from the banded signal, and off by r (1 - r) of the source's read noise.
def in_bands(light: torch.Tensor, row_gain: np.ndarray) -> torch.Tensor:
    """`light` (4, H, W) with the rows' own, (H,); new memory, contiguous."""
    return (light * _column(row_gain)).contiguous()


def remaining_in_bands(
    remaining: torch.Tensor | None, row_gain: np.ndarray, width: int
) -> torch.Tensor:
    """`Exposure.remaining` (H, `width`) of a noisy source in the bands of `row_gain` (H,)."""
    share = _column(row_gain).expand(-1, width)
    return (share if remaining is None else share * remaining).contiguous()


def expected_in_bands(
    prepared_scenes: Sequence[PreparedScene],
    states: Sequence[CameraSettings],
    row_gain: np.ndarray | None,
) -> torch.Tensor:
    """Noise-free light (S, 4, H, W) at each state, not clipped; arguments of `expose_in_bands`."""
    light = torch.stack([x.expected(s) for x, s in zip(prepared_scenes, states, strict=True)])
    if row_gain is None:
        return light
    return light * torch.from_numpy(row_gain).float()[:, None, :, None]


def expose_in_bands(
    prepared_scenes: Sequence[PreparedScene],
    states: Sequence[CameraSettings],
    row_gain: np.ndarray | None,
    *,
    seed: int,
) -> torch.Tensor:
    """A sweep in which each state has light of its own, with the noise of `PreparedScene.expose`.

    Args:
        prepared_scenes: The scene in the light of each state, S long; they share their `PreparedScene.blurred_light`.
        states: S settings.
        row_gain: (S, H) light of each row relative to that; None where all rows have the same.
        seed: See `PreparedScene.capture`.

    Returns:
        (S, 4, H, W) float32 in [-pedestal, 1].
    """
    exposures = [x.exposure(s) for x, s in zip(prepared_scenes, states, strict=True)]
    lights = [x.blurred_light.blurred(e) for x, e in zip(prepared_scenes, exposures, strict=True)]
    if row_gain is not None:
        width = lights[0].shape[-1]
        exposures = [
            e
            if e.source.is_zero
            else replace(e, remaining=remaining_in_bands(e.remaining, g, width))
            for e, g in zip(exposures, row_gain, strict=True)
        ]
        lights = [in_bands(x, g) for x, g in zip(lights, row_gain, strict=True)]
    out = torch.empty((len(lights), *lights[0].shape))
    keys = sweep_keys(seed, states)
    record_batch(lights, exposures, prepared_scenes[0].camera, keys, "exact", out=out)
    return out


def _column(row_gain: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(row_gain).float()[:, None]


class Plans:
    """Captures that were planned: all that a frame depends on but for its noise, as columns.

    Row ``slot * num_states + state`` is that of a state of a slot (`Episodes.slot`). A row takes
    some 40 bytes from the start, the rest of its memory when it is used. A pickled copy is empty.

    Args:
        num_slots: Number of slots.
        num_states: Number of exposure states.

    Attributes:
        gain: Of the light that the row was planned for; NaN where it was not planned.
        table: (5, 4) float32 each, as `simulator.capture.kernels.record_frames` takes exposures.
        excess: As in `info`; NaN where it takes the blurred light to tell, and that is not made.
        modules: Names of the steps, joined by ``"+"``.
        light: (4, H, W) what is exposed; where it is blurred, until the place blurs another.
        remaining: `Exposure.remaining` of that light; None for all.
        blurs: Whether the light must be blurred; else it is the scene's own.
        exposure: What happens to light that must be blurred; else None.
    """

    def __init__(self, num_slots: int, num_states: int) -> None:
        rows = num_slots * num_states
        self.num_slots, self.num_states = num_slots, num_states
        self.gain = np.full(rows, np.nan)
        self.table = np.zeros((rows, 5, 4), np.float32)
        self.excess = np.zeros(rows)
        self.blurs = np.zeros(rows, bool)
        self.modules, self.light, self.remaining, self.exposure = np.empty((4, rows), object)

    def forget(self, slot: int) -> None:
        """Makes every state of `slot` unknown."""
        rows = slice(slot * self.num_states, (slot + 1) * self.num_states)
        self.gain[rows] = np.nan
        self.light[rows] = self.remaining[rows] = self.exposure[rows] = None

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.num_slots, self.num_states)


class Buffers:
    """Images to write to that are used again: new memory costs more than what is written to it.

    A pickled copy is empty.

    Args:
        shape: Of each image.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.shape = shape
        self._free: list[torch.Tensor] = []

    def take(self) -> torch.Tensor:
        """A float32 image with any content."""
        try:
            return self._free.pop()  # atomic: threads share the list
        except IndexError:
            return torch.empty(self.shape)

    def give_back(self, image: torch.Tensor) -> None:
        """Lets `image` be taken again."""
        self._free.append(image)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.shape,)


class LightCache:
    """The light that the episode at one place has blurred. A pickled copy has none.

    The latest one is kept, because an agent that has settled repeats it.

    Args:
        buffers: Where images are taken from.
        keep: Whether the defocused light of every f-number is kept while an episode lasts.

    Attributes:
        prepared: What the camera sees of the scene in its own light; None until it is asked for.
    """

    def __init__(self, buffers: Buffers, keep: bool) -> None:
        self.buffers, self.keep = buffers, keep
        self.prepared: PreparedScene | None = None
        self._defocused: dict[tuple[Any, ...], torch.Tensor] = {}  # by aperture
        self._blurred: tuple[tuple[Any, ...], torch.Tensor] | None = None  # by all blur
        self._streak: torch.Tensor | None = None

    def blurred(self, exposure: Exposure) -> tuple[torch.Tensor, Blur | None]:
        """The light (4, H, W) of `prepared` with the blur of `exposure`, valid until the next call.

        Returns:
            The light, and what must be done (`simulator.optics.blur_kernels.blur_many`) to fill it; None
            where that was done before.
        """
        lens = (exposure.denoised, exposure.opened_to, exposure.defocus_px)
        key = (*lens, exposure.motion_px)
        if self._blurred is not None and self._blurred[0] == key:
            return self._blurred[1], None
        light = self._defocused.get(lens)
        source = defocused = moved = None
        if light is None:
            assert self.prepared is not None
            light = source = self.prepared.source_light(exposure).contiguous()
            if exposure.defocus_px:
                if not self.keep:
                    self._drop_defocused()
                light = defocused = self._defocused[lens] = self.buffers.take()
        if exposure.motion_px:
            source = light if source is None else source
            if self._streak is None:
                self._streak = self.buffers.take()
            light = moved = self._streak
        self._blurred = (key, light)
        if defocused is None and moved is None:
            return light, None
        assert source is not None
        return light, Blur(source, exposure.defocus_px, defocused, exposure.motion_px, moved)

    def _drop_defocused(self) -> None:
        for image in self._defocused.values():
            self.buffers.give_back(image)
        self._defocused.clear()

    def end(self) -> None:
        """Gives everything back, for another episode to begin."""
        self._drop_defocused()
        if self._streak is not None:
            self.buffers.give_back(self._streak)
        self.prepared = self._streak = self._blurred = None

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.buffers, self.keep)
