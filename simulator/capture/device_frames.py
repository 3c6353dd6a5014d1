"""`BlurredFrames` by torch operations, on any device: light and what is blurred of it stay there.

What is blurred, and how, is planned in the same columns. All frames (N, 4, H, W) are one tensor;
the place of a frame is its number in it, from 1 on.
"""

import math
import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from simulator.capture.blurred_frames import BlurredFrames, Passes, frame_at
from simulator.optics.discs import DIAMETERS, LIGHT_LIMIT, disc_blur
from simulator.optics.motion import motion_blur, taps_of
from simulator.utils.compute import kernel, parallel_ranges

#: Samples that are read or added to the memory at once, on a GPU and elsewhere, where the cache
#: holds them; frames that are added at once, at least; taps of a frame that a GPU can read
#: together, at least; samples of a frame that is moved along the rows alone; paths that are worth
#: a thread when their taps are made.
_SAMPLES, _FRAMES, _TOGETHER, _ALONE, _PATHS = {"cuda": 2**27, "": 2**20}, 64, 8, 2**20, 64
_KNOTS = torch.tensor(DIAMETERS, dtype=torch.float32).square()


class DeviceFrames(BlurredFrames):
    """See the module."""

    def __init__(
        self, num_scenes: int, num_apertures: int, most_bytes: int, device: torch.device
    ) -> None:
        super().__init__(num_scenes, num_apertures, most_bytes)
        self._frames = torch.empty(0, dtype=torch.float32, device=device)
        self._samples = _SAMPLES.get(device.type, _SAMPLES[""])
        # The lights of scenes by `id`, as long as they exist, and their places.
        self._known: dict[int, tuple[weakref.ref[Tensor], int]] = {}
        self._masks = np.zeros(num_scenes, np.uintp)  # addresses that layouts have theirs from

    def places(self, lights: Sequence[Tensor]) -> np.ndarray:
        """(B,) places of lights (4, H, W) of scenes, which are copied when they are new."""
        self._shape = tuple(lights[0].shape)
        new = {id(light): light for light in lights if self._place_of(light) == 0}
        if new:
            made = self._take(len(new))
            self._put(made, torch.stack(list(new.values())))
            for (key, light), place in zip(new.items(), made.tolist(), strict=True):
                self._known[key] = weakref.ref(light), place
        return np.array([self._known[id(light)][1] for light in lights], np.uintp)

    def _place_of(self, light: Tensor) -> int:
        found = self._known.get(id(light))
        return found[1] if found is not None and found[0]() is light else 0

    def at(self, places: np.ndarray) -> Any:
        """The frames at `places` (B,), a copy (B, 4, H, W)."""
        return self._frames[self._numbers(places)]

    kept = at

    def _numbers(self, places: np.ndarray) -> Tensor:
        return torch.from_numpy(places.astype(np.int64) - 1).to(self._frames.device)

    def _put(self, places: np.ndarray, frames: Tensor) -> None:
        self._frames[self._numbers(places)] = frames.to(self._frames.device)

    def _more(self, count: int) -> np.ndarray:
        # Lights of scenes that are gone come first.
        gone = [key for key, (light, _) in self._known.items() if light() is None]
        self._give_back(np.array([self._known.pop(key)[1] for key in gone], np.uintp))
        lacking, old = count - len(gone), self._frames
        if lacking <= 0:
            return self._free[:0]
        begin = len(old)
        spare = max(begin // 2, min(_FRAMES, self._samples // math.prod(self._shape)))
        room = self._most_bytes // (4 * math.prod(self._shape)) - begin
        spare = min(spare, room) if lacking <= room else spare
        self._frames = old.new_empty(begin + max(lacking, spare), *self._shape)
        self._bytes = self._frames.nbytes
        if begin:
            self._frames[:begin] = old
        return np.arange(begin, len(self._frames), dtype=np.uintp) + np.uintp(1)

    def _parts(self, chosen: np.ndarray, samples: int) -> list[np.ndarray]:
        """`chosen` in parts of frames that need so many `samples` each at once."""
        size = max(1, self._samples // samples)
        return [chosen[i : i + size] for i in range(0, len(chosen), size)]

    # -- passes -------------------------------------------------------------------------------

    def _run(self, kind: int, alike: Passes) -> None:
        tasks = *[self._blur] * 3, self._blend, self._move, self._move, self._darken
        own = alike.passes["frame"]
        tasks[kind](alike.passes, alike.blurs[own], alike.levels[own])

    # Each does passes (K,) for the frames of `blurs` (K,); blends read `levels` (K, 13).
    def _blur(self, passes: np.ndarray, blurs: np.ndarray, levels: np.ndarray) -> None:
        diameters = passes["diameter"]
        for diameter in np.unique(diameters).tolist():
            alike = np.flatnonzero(diameters == diameter)
            for part in self._parts(alike, 4 * math.prod(self._shape)):
                light = self._clamped(passes["source"][part])
                self._put(passes["to"][part], disc_blur(light, diameter))

    def _clamped(self, places: np.ndarray) -> Tensor:
        return self.at(places).clamp_(-LIGHT_LIMIT, LIGHT_LIMIT)

    def _blend(self, passes: np.ndarray, blurs: np.ndarray, levels: np.ndarray) -> None:
        for part in self._parts(np.arange(len(passes)), 2 * math.prod(self._shape)):
            maps = self._layout_frames(passes["scene"][part], blurs[part])
            scale = torch.from_numpy(blurs["defocus_px"][part].astype(np.float32)).to(maps.device)
            knots = _KNOTS.to(maps.device)
            squared = (maps[:, 0].flatten(1) * scale[:, None]).square_()
            squared = squared.clamp_(max=DIAMETERS[-1] ** 2)
            below = torch.searchsorted(knots, squared, right=True).sub_(1).clamp_(0, len(knots) - 2)
            share = (squared - knots[below]) / (knots[below + 1] - knots[below])  # (K, H W)
            numbers = self._numbers(levels[part])
            low, high = (self._pixels(numbers.gather(1, below + i)) for i in range(2))
            blended = torch.lerp(low, high, share[:, None]).reshape(-1, *self._shape)
            self._put(passes["to"][part], blended)

    def _pixels(self, numbers: Tensor) -> Tensor:
        """(K, 4, H W) pixels, each of the frame at `numbers` (K, H W)."""
        planes, size = self._shape[0], numbers.shape[1]
        first = (numbers * planes * size + torch.arange(size, device=numbers.device))[:, None]
        offsets = size * torch.arange(planes, device=numbers.device)[:, None]
        return self._frames.view(-1)[first + offsets]

    def _layout_frames(self, indices: np.ndarray, blurs: np.ndarray) -> Tensor:
        """(K, 4, H, W) diameters, masks, and pixels behind the subjects."""
        layouts = self._held[:, -1]
        stale = (blurs["mask"] > 0) & (self._masks[indices] != blurs["mask"])
        stale |= layouts[indices] == 0
        if stale.any():
            lacking = indices[layouts[indices] == 0]
            layouts[lacking] = self._take(len(lacking))
            own, plane = blurs[stale], self._shape[1:]
            frames = np.zeros((len(own), *self._shape), np.float32)
            for frame, blur in zip(frames, own, strict=True):
                frame[0] = frame_at(blur["diameter"].item(), plane)
                if blur["mask"]:
                    frame[1] = frame_at(blur["mask"].item(), plane)
                    frame[2] = frame_at(blur["behind"].item(), plane).view(np.int32)
            self._put(layouts[indices[stale]], torch.from_numpy(frames))
            self._masks[indices[stale]] = blurs["mask"][stale]
        return self.at(layouts[indices])

    def _move(self, passes: np.ndarray, blurs: np.ndarray, levels: np.ndarray) -> None:
        source, to = passes["source"], passes["to"]
        apart, samples, plane = blurs["mask"] > 0, math.prod(self._shape), self._shape[1:]
        # Large frames one by one: the time of a streak's running sum is the same for all lengths.
        alone = blurs["streaks"] & (samples >= _ALONE)
        for i in np.flatnonzero(alone).tolist():
            light = self._clamped(source[[i]])
            self._put(to[[i]], motion_blur(light, float(blurs["motion_px"][i])))
        for part in self._parts(np.flatnonzero(~apart & ~alone), _TOGETHER * samples):
            taps = tap_columns(blurs[part], False, *plane)
            self._put(to[part], moved_sums(self._clamped(source[part]), self._samples, taps))
        for part in self._parts(np.flatnonzero(apart), 2 * _TOGETHER * samples):
            # See `simulator.optics.motion.blur_apart`.
            light = self._clamped(source[part])
            maps = self._layout_frames(passes["scene"][part], blurs[part])
            mask, behind = maps[:, 1:2], maps[:, 2:3].long().flatten(2)
            back = light.flatten(2).gather(2, behind.expand(-1, light.shape[1], -1)).view_as(light)
            taps, own = (tap_columns(blurs[part], own, *plane) for own in (False, True))
            back = moved_sums(back, self._samples, taps)
            front = moved_sums(torch.cat([light * mask, mask], dim=1), self._samples, own)
            seen = (1.0 - front[:, -1:]).clamp_(min=0.0)
            self._put(to[part], seen * back + front[:, :-1])

    def _darken(self, passes: np.ndarray, blurs: np.ndarray, levels: np.ndarray) -> None:
        source, to = passes["source"], passes["to"]
        for address in np.unique(blurs["vignetting"]).tolist():
            same = blurs["vignetting"] == address
            left = torch.from_numpy(frame_at(address, self._shape[1:])).to(self._frames)
            self._put(to[same], self.at(source[same]) * left)


def tap_columns(
    blurs: np.ndarray, own: bool, height: int, width: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Taps of the paths of `BLUR` (K,), those of the subjects' `own` or of the backgrounds.

    Returns:
        (K,) int64 how many each has; and the taps one behind the other: (T,) int64 rows and
        columns, (T,) float32 weights.
    """
    found: dict[int, tuple[np.ndarray, ...]] = {}
    fixed = own, height, width
    parallel_ranges(
        lambda a, b: found.update({a: _taps(blurs[a:b], *fixed)}), len(blurs), least=_PATHS
    )
    parts = zip(*(found[first] for first in sorted(found)), strict=True)
    counts, rows, columns, weights = map(np.concatenate, parts)
    return counts, rows, columns, weights


@kernel()
def _taps(blurs, own, height, width):  # type: ignore[no-untyped-def]
    """`tap_columns` on one thread."""
    found = []
    for blur in blurs:
        x, y = (blur.drift_x, blur.drift_y) if own else (0.0, 0.0)
        found.append(taps_of(blur.extent, blur.direction, blur.turn, x, y, height, width))
    counts = np.array([len(taps[0]) for taps in found])
    total, end = counts.sum(), 0
    rows, columns = np.empty(total, np.int64), np.empty(total, np.int64)
    weights = np.empty(total, np.float32)
    for taps in found:
        begin, end = end, end + len(taps[0])
        rows[begin:end], columns[begin:end], weights[begin:end] = taps
    return counts, rows, columns, weights


def moved_sums(images: Tensor, samples: int, taps: tuple[np.ndarray, ...]) -> Tensor:
    """Sums of shifts of `images` (K, C, H, W) by the taps of each; the borders are replicated.

    About so many `samples` are looked at at once. The `taps` are those of `tap_columns`.
    """
    (planes, height, width), to, (counts, *values) = images.shape[1:], images.device, taps
    begins, out = counts.cumsum() - counts, torch.empty_like(images)
    down, right, weight = (torch.from_numpy(v).to(to) for v in values)
    y, x = torch.arange(height, device=to)[:, None, None], torch.arange(width, device=to)[:, None]
    for count in np.unique(counts).tolist():
        alike, size = np.flatnonzero(counts == count), max(1, samples // (count * height * width))
        for some in np.split(alike, range(size, len(alike), size)):
            own, at = (torch.from_numpy(v).to(to) for v in (some, begins[some, None]))
            at = (at + torch.arange(count, device=to))[:, None, None]  # (k, 1, 1, taps)
            first = torch.arange(len(some), device=to)[:, None, None, None] * height
            light = images[own].permute(0, 2, 3, 1).reshape(-1, planes)
            band = max(1, samples // (len(some) * count * width))  # rows of a large frame
            for top in range(0, height, band):
                rows = first + (y[top : top + band] + down[at]).clamp_(0, height - 1)
                pixels = rows * width + (x + right[at]).clamp_(0, width - 1)  # (k, rows, W, taps)
                shares = weight[at].expand(pixels.shape).reshape(-1, count)
                # A bag for each pixel: nothing is held for each of its taps but where it looks.
                sums = F.embedding_bag(
                    pixels.view(-1, count), light, mode="sum", per_sample_weights=shares
                ).view(*pixels.shape[:3], planes)
                out[own, :, top : top + band] = sums.permute(0, 3, 1, 2)
    return out
