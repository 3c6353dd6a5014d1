"""Blurred light of many captures, in memory that is used again.

`BlurredFrames` makes the light behind lens and motion: of the scenes of a batch, and of all states
of one scene (`simulator.capture.blurred_light.BlurredLight`). `Layout` says what is out of focus.
"""

from __future__ import annotations

import ctypes
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numba
import numpy as np
import torch
import torch.nn.functional as F

from simulator.optics.discs import (
    DIAMETERS,
    LIGHT_LIMIT,
    WIDE_PX,
    blend_rows,
    disc_radius,
    disc_taps,
    mark_levels,
    wide_disc,
)
from simulator.optics.motion import blur_apart, blur_planes, move_rows, streak_share, taps_of
from simulator.utils.checks import check_number, check_type
from simulator.utils.compute import addresses, as_pointer, kernel, parallel_ranges

#: Addresses of arrays of a layout, 0 for none: (H, W) float32 diameters relative to the largest;
#: float32 diameters that pixels have, and how many these are; and of a subject that moves, (H, W)
#: float32 mask, and int32 pixels behind it.
LAYOUT = tuple((n, "uintp") for n in ("diameter", "sorts", "num_sorts", "mask", "behind"))
#: The blurs of a capture.
BLUR = np.dtype(
    [
        ("defocus_px", "f8"),  # diameter of the largest disc [pixel]
        ("motion_px", "f8"),  # how far the image moves at most [pixel]
        ("streaks", "?"),
        # The background's path, see `simulator.optics.motion.Path`; and how the subject drifts.
        *((n, "f8") for n in ("extent", "direction", "turn", "drift_x", "drift_y")),
        *LAYOUT,
        ("vignetting", "uintp"),  # address of the (H, W) float32 share of light left; 0 for all
    ]
)
#: Samples of memory that are made at once, and of a frame whose planes are shared out.
_SLAB, _LARGE = 2**20, 2**16
#: Levels that `Layout.shares` counts defocus in.
_LEVELS = 255
#: A bit more than half of a level.
_HALF_STEP = np.float32(0.51 / _LEVELS)
_KNOTS = (np.array(DIAMETERS) ** 2).astype(np.float32)
_MOST = np.float32(LIGHT_LIMIT)  # of its type, lest kernels compile twice
_jit = functools.partial(kernel, fastmath={"contract"})
#: A kind of blur of K frames: a kernel, the scenes (K,), the cost of each, and what it is given.
Pass = tuple[Any, np.ndarray, np.ndarray, tuple[np.ndarray, ...]]


@dataclass(frozen=True, eq=False)
class Layout:
    """Where a scene is out of focus, and where its subject is."""

    #: (H, W) float32 in [0, 1], circle of confusion relative to that of a scene's `defocus`; 0 is
    #: the plane of focus.
    defocus: torch.Tensor
    #: (H, W) bool, the subject's pixels, which may move apart from the rest, or None.
    subject: torch.Tensor | None = None

    def __post_init__(self) -> None:
        found, mask = self.defocus, self.subject
        check_type("defocus", found, torch.Tensor)
        check_type("subject", mask, torch.Tensor, None)
        if found.ndim != 2 or not bool(((found >= 0.0) & (found <= 1.0)).all()):
            raise ValueError(f"`defocus` (shape {tuple(found.shape)}) must be (H, W) in [0, 1]")
        object.__setattr__(self, "defocus", found.detach().float().cpu().contiguous())
        if mask is None:
            return
        if mask.dtype != torch.bool or mask.shape != found.shape:
            raise ValueError(
                f"`subject` ({mask.dtype}, shape {tuple(mask.shape)}) must be bool of the shape of "
                f"`defocus`, {tuple(found.shape)}"
            )
        count = int(mask.count_nonzero())
        known = mask.cpu().contiguous() if 0 < count < mask.numel() else None
        object.__setattr__(self, "subject", known)

    @classmethod
    def from_depth(cls, depth: torch.Tensor, distance: float, *, in_focus: float) -> Layout:
        """The layout of a scene whose depth is known; the subject is what is in focus.

        The circle of confusion goes with the difference of the inverse distances.

        Args:
            depth: (H, W) distance [m], above 0.
            distance: At which the lens is focused [m].
            in_focus: Largest relative circle of confusion of the subject.
        """
        if not isinstance(depth, torch.Tensor) or not bool((depth > 0.0).all()):
            raise ValueError("`depth` must be a torch tensor with every value above 0 and not NaN")
        if not 0.0 < distance < math.inf:
            raise ValueError(f"`distance` (={distance}) must be above 0 and finite")
        check_number("in_focus", in_focus, 0.0, 1.0)
        apart = (1.0 / depth.double() - 1.0 / distance).abs()
        relative = (apart / apart.max().clamp(min=1e-12)).float()
        return cls(relative, relative <= in_focus)

    def averaged(self, factor: int) -> Layout:
        """Means over `factor` x `factor` pixels; the subject is where it has most of them."""

        def mean(values: torch.Tensor) -> torch.Tensor:
            return F.avg_pool2d(values[None].double(), factor)[0]

        subject = None if self.subject is None else mean(self.subject) > 0.5
        return Layout(mean(self.defocus).float().clamp(max=1.0), subject)

    def cut(self, rows: slice, columns: slice) -> Layout:
        """A window of it."""
        subject = None if self.subject is None else self.subject[rows, columns]
        return Layout(self.defocus[rows, columns], subject)

    @cached_property
    def shares(self) -> np.ndarray:
        """(3, K) the pixels, counted by defocus (in steps of 1/255) and subject, in K sorts.

        Their circle of confusion relative to the largest, whether they are the subject's, and
        their share of all pixels.
        """
        levels = (self.defocus * _LEVELS).round().int().numpy()
        if self.subject is not None:
            levels = levels + (_LEVELS + 1) * self.subject.numpy()
        sorts, counts = np.unique(levels, return_counts=True)
        subject = sorts > _LEVELS
        defocus = (sorts - (_LEVELS + 1) * subject) / _LEVELS
        return np.stack([defocus, subject, counts / levels.size])

    @cached_property
    def behind(self) -> torch.Tensor:
        """(H, W) int64, the pixel of the background nearest to each, counted row by row."""
        from scipy.ndimage import distance_transform_edt  # not above: it takes long

        assert self.subject is not None
        rows, columns = distance_transform_edt(
            self.subject.numpy(), return_distances=False, return_indices=True
        )
        return torch.from_numpy(rows.astype(np.int64) * self.subject.shape[1] + columns)

    @cached_property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays that kernels find by their addresses: they never move, as tensors may.

        (H, W) float32 `defocus`, and (K,) that of `shares`; of a subject also its (H, W) float32
        mask, and int32 `behind`.
        """
        found = [self.defocus.numpy().copy(), self.shares[0].astype(np.float32)]
        if self.subject is not None:
            found += [self.subject.numpy().astype(np.float32)]
            found += [self.behind.numpy().astype(np.int32)]
        return tuple(found)


class FramesAt(Sequence[torch.Tensor]):
    """Contiguous float32 frames of one shape, known by their `addresses` (B,)."""

    def __init__(self, addresses: np.ndarray, shape: tuple[int, ...]) -> None:
        self.addresses, self.shape = addresses, (len(addresses), *shape)

    def __len__(self) -> int:
        return len(self.addresses)

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        return torch.from_numpy(frame_at(int(self.addresses[index]), self.shape[1:]))


def frame_at(address: int, shape: tuple[int, ...]) -> np.ndarray:
    """The contiguous float32 frame at an address."""
    memory = ctypes.c_float * math.prod(shape)
    return np.ndarray(shape, np.float32, memoryview(memory.from_address(address)))


class BlurredFrames:
    """Blurred light of a batch's scenes, in memory that is used again.

    The light behind the lens is cached for each of `num_apertures`, and the discs that it is
    blended of; where all memory together exceeds `most_bytes`, only the latest light. Frames are
    (4, H, W), as the lights are that `places` is given. Each is known by its place, here the
    address of its memory; 0 is none.
    """

    def __init__(self, num_scenes: int, num_apertures: int, most_bytes: int) -> None:
        self._most_bytes, self._shape = most_bytes, tuple[int, ...]()
        # Places that each scene holds: behind the lens at each aperture, behind each disc, in
        # motion, and of its layout where that is a frame, too.
        self._held = np.zeros((num_scenes, num_apertures + len(DIAMETERS) + 2), np.uintp)
        self._lens, self._levels = self._held[:, :num_apertures], self._held[:, num_apertures:-2]
        self._moved, self._layouts = self._held[:, -2], self._held[:, -1]
        # The light, and the diameter of the disc, that they were made of.
        self._source, self._diameter = np.zeros_like(self._lens), np.zeros(self._lens.shape)
        self._levels_source = np.zeros(num_scenes, np.uintp)
        self._slabs, self._free = list[torch.Tensor](), np.empty(0, np.uintp)
        self._bytes = 0  # of all memory
        self._passes = list[Pass]()  # that are still to run

    @property
    def is_full(self) -> bool:
        """Whether the memory exceeds its limit."""
        return self._bytes > self._most_bytes

    def places(self, lights: Sequence[torch.Tensor]) -> np.ndarray:
        """(B,) places of lights (4, H, W) of scenes, contiguous float32."""
        self._shape = tuple(lights[0].shape)
        return addresses(lights)

    def at(self, places: np.ndarray) -> Sequence[torch.Tensor]:
        """The frames at `places` (B,)."""
        return FramesAt(places, self._shape)

    def kept(self, places: np.ndarray) -> list[torch.Tensor]:
        """The frames at `places` (B,) of this memory, which stays as long as any of them."""
        frames = {frame.data_ptr(): frame for slab in self._slabs for frame in slab}
        return [frames[place] for place in places.tolist()]

    def _take(self, count: int) -> np.ndarray:
        """Places of memory for `count` frames."""
        if (lacking := count - len(self._free)) > 0:
            self._give_back(self._more(lacking))
        taken, self._free = self._free[:count], self._free[count:]
        return taken

    def _give_back(self, places: np.ndarray) -> None:
        self._free = np.concatenate([self._free, places[places > 0]])

    def _more(self, count: int) -> np.ndarray:
        """Places of new memory for `count` frames or more."""
        spare = min(_SLAB, self._most_bytes // 4) // math.prod(self._shape)
        size = max(count, spare), *self._shape
        slab = torch.empty(size, dtype=torch.float32, device="cpu")  # whatever torch's defaults are
        self._slabs.append(slab)
        self._bytes += slab.nbytes
        return (slab.data_ptr() + np.arange(len(slab)) * slab[0].nbytes).astype(np.uintp)

    def release(self, indices: np.ndarray) -> None:
        """Frees the memory of the scenes `indices`."""
        self._give_back(self._held[np.unique(indices)])
        self._held[indices] = 0

    def _free_others(self, indices: np.ndarray, slots: np.ndarray) -> None:
        """Frees all of the scenes `indices` but the light at the apertures `slots`, and in motion.

        Their layouts stay, too.
        """
        others = self._held[indices]
        others[np.arange(len(indices)), slots] = others[:, -2:] = 0
        self._held[indices] -= others
        self._give_back(others)

    def make(
        self, indices: np.ndarray, slots: np.ndarray, blurs: np.ndarray, source: np.ndarray
    ) -> np.ndarray:
        """(K,) places of the light of scenes `indices` behind their blurs.

        `slots` (K,) are their apertures, `blurs` `BLUR`; `source` are the places of the light
        (4, H, W) that they start from. Each stays until its scene blurs another. No two have the
        scene in common; in new memory, where nothing moves, no two the scene and the aperture.
        """
        if self.is_full:
            self._free_others(indices, slots)
        self._passes.clear()
        behind_lens = blurs["defocus_px"] > 0.0
        known = (self._lens[indices, slots] > 0) & (self._source[indices, slots] == source)
        known &= self._diameter[indices, slots] == blurs["defocus_px"]
        new = behind_lens & ~known
        if new.any():
            self._focus(indices[new], slots[new], blurs[new], source[new])
        light = np.where(behind_lens, self._lens[indices, slots], source)
        # What changes by motion, or by the lens, has memory of its own.
        for name, write in ("motion_px", self._move), ("vignetting", self._darken):
            if (own := blurs[name] > 0).any():
                some, source = indices[own], light[own]
                lacking = some[self._moved[some] == 0]
                self._moved[lacking] = self._take(len(lacking))
                light[own] = self._moved[some]
                write(some, blurs[own], source, light[own])
        _run(self._passes, self._shape)
        return light

    def _focus(
        self, indices: np.ndarray, slots: np.ndarray, blurs: np.ndarray, source: np.ndarray
    ) -> None:
        """Makes the light behind the lens, of scenes that are out of focus; see `make`."""
        lacking = self._lens[indices, slots] == 0
        self._lens[indices[lacking], slots[lacking]] = self._take(int(lacking.sum()))
        self._source[indices, slots] = source
        self._diameter[indices, slots] = blurs["defocus_px"]
        to, blends = self._lens[indices, slots], blurs["diameter"] > 0
        if blends.any():
            own = indices[blends], blurs[blends]
            self._blend(*own, self._made_levels(*own, source[blends]), to[blends])
        one = ~blends  # disc everywhere
        self._blur(indices[one], blurs["defocus_px"][one], source[one], to[one])

    def _made_levels(
        self, indices: np.ndarray, blurs: np.ndarray, source: np.ndarray
    ) -> np.ndarray:
        """(K, 13) places of the light of scenes behind the discs that their blend needs."""
        stale = np.flatnonzero(np.bincount(indices[self._levels_source[indices] != source]))
        self._give_back(self._levels[stale])
        self._levels[stale] = 0
        self._levels_source[indices] = source
        needed = np.zeros((len(indices), len(DIAMETERS)), bool)
        mark_needed(blurs, _KNOTS, needed)
        frame, level = np.nonzero(needed & (self._levels[indices] == 0))
        keys, numbers = indices[frame] * len(DIAMETERS) + level, np.arange(len(frame))
        maker = np.empty(self._levels.size, np.intp)
        maker[keys] = numbers  # of frames with the same disc one makes it
        frame, level = (column[maker[keys] == numbers] for column in (frame, level))
        self._levels[indices[frame], level] = made = self._take(len(frame))
        self._blur(indices[frame], np.array(DIAMETERS)[level], source[frame], made)
        levels = self._levels[indices]  # those without a share are read, too, times 0
        return np.where(levels == 0, source[:, None], levels)

    # Each writes frames of scenes to the places `to` (K,): behind one disc, behind discs of the
    # pixels' own, moved, and darkened. Costs are about microseconds at 128 x 128.
    def _blur(
        self, indices: np.ndarray, diameters: np.ndarray, source: np.ndarray, to: np.ndarray
    ) -> None:
        radii = np.zeros(len(diameters))
        for i, diameter in enumerate(diameters.tolist()):
            if diameter > WIDE_PX:
                light, out = (frame_at(int(at[i]), self._shape) for at in (source, to))
                wide_disc(light, diameter, LIGHT_LIMIT, out)
            else:
                radii[i] = _radius(diameter)
        own = radii > 0.0
        cost = 85.0 + 13.0 * radii[own] ** 2
        self._add(blur_discs, indices[own], cost, source[own], to[own], radii[own])

    def _blend(
        self, indices: np.ndarray, blurs: np.ndarray, levels: np.ndarray, to: np.ndarray
    ) -> None:
        self._add(blend_discs, indices, np.full(len(to), 200.0), to, blurs, levels)

    def _move(
        self, indices: np.ndarray, blurs: np.ndarray, source: np.ndarray, to: np.ndarray
    ) -> None:
        # Sums of taps take as long as these are many; with a subject there are more.
        taps = 95.0 + 9.0 * np.minimum(blurs["motion_px"], sum(self._shape[1:]))
        taps *= np.where(blurs["mask"] > 0, 1.6, 1.0)
        for task, own in (move_along_rows, blurs["streaks"]), (move_along_paths, ~blurs["streaks"]):
            self._add(task, indices[own], taps[own], source[own], to[own], blurs[own])

    def _darken(
        self, indices: np.ndarray, blurs: np.ndarray, source: np.ndarray, to: np.ndarray
    ) -> None:
        left = np.ascontiguousarray(blurs["vignetting"])
        self._add(darken, indices, np.full(len(to), 20.0), source, to, left)

    def _add(self, task: Any, scenes: np.ndarray, cost: np.ndarray, *columns: np.ndarray) -> None:
        if len(scenes):
            self._passes.append((task, scenes, cost, columns))


_radius = functools.lru_cache(maxsize=4096)(disc_radius)


def _run(passes: Sequence[Pass], shape: tuple[int, ...]) -> None:
    """Runs passes, in order, on frames of `shape`, on all threads, which share the cost.

    A thread has all passes of a scene. Where scenes are few, threads share each pass instead, and
    of few large frames planes, or rows where there are more threads.
    """
    if not passes:
        return
    threads, parts = torch.get_num_threads(), 1
    owner = np.concatenate([p[1] for p in passes])
    cost = np.bincount(owner, np.concatenate([p[2] for p in passes]))
    different = np.flatnonzero(cost)
    if len(different) < 2 * threads:
        if len(passes) > 1:
            for one in passes:
                _run([one], shape)
            return
        owner = different = np.arange(count := len(owner))
        cost = passes[0][2]
        if count < 2 * threads and math.prod(shape) >= _LARGE:
            parts = shape[0] * min(1 + (threads - 1) // (count * shape[0]), shape[1])
        threads = min(threads, count * parts)
    order = different[np.argsort(-cost[different], kind="stable")]
    # Dealt out in turns, there and back: each thread has costly scenes and cheap ones.
    turn = np.arange(len(order)) % (2 * threads)
    order = order[np.argsort(np.minimum(turn, 2 * threads - 1 - turn), kind="stable")]
    costs, place = np.repeat(cost[order], parts), np.empty(len(cost), np.int64)
    place[order] = np.arange(len(order))
    # A unit belongs to the thread in whose share of the cost its middle is.
    share = ((costs.cumsum() - 0.5 * costs) * (threads / costs.sum())).reshape(-1, parts)
    work = []
    for task, scenes, _, columns in passes:
        at, owner = owner[: len(scenes)], owner[len(scenes) :]
        own = np.argsort(place[at], kind="stable")
        ends = np.searchsorted(share[place[at[own]]].ravel(), np.arange(threads + 1)).tolist()
        work.append((task, ends, (own, parts, *shape, *columns)))

    def do(first: int, last: int) -> None:
        for thread in range(first, last):
            for task, ends, fixed in work:
                if ends[thread] < ends[thread + 1]:
                    task(ends[thread], ends[thread + 1], *fixed)

    parallel_ranges(do, threads)


@_jit()
def _array_at(address, shape):  # type: ignore[no-untyped-def]
    return numba.carray(as_pointer(address), shape)  # type: ignore[attr-defined, call-arg]


@_jit()
def mark_needed(blurs, knots, needed):  # type: ignore[no-untyped-def]
    """Marks the discs, other than none, that the blend of each frame needs."""
    for i in range(len(blurs)):
        blur = blurs[i]
        if blur.diameter:
            sorts = _array_at(blur.sorts, (blur.num_sorts,))
            mark_levels(sorts, np.float32(blur.defocus_px), _HALF_STEP, knots, needed[i])
        needed[i, 0] = False


# Passes do units `first` to `last`: a unit is one of `parts` equal shares of the rows of all planes
# (P, H, W) of a frame, ``order[unit // parts]``, which is read and written at addresses (K,). There
# is one for each kind of blur: what compiles slowly and is not needed is not compiled.
@_jit()
def _share(unit, parts, rows):  # type: ignore[no-untyped-def]
    """The first row of a unit, and the first behind it."""
    return unit % parts * rows // parts, (unit % parts + 1) * rows // parts


@_jit()
def blur_discs(  # type: ignore[no-untyped-def]
    first, last, order, parts, planes, height, width, source, to, radii
):
    """Light behind one disc each."""
    shape = planes * height, width
    for unit in range(first, last):
        i, rows = order[unit // parts], _share(unit, parts, shape[0])
        image, out = _array_at(source[i], shape), _array_at(to[i], shape)
        blur_planes(rows[0], rows[1], image, height, disc_taps(radii[i]), _MOST, out)


@_jit()
def blend_discs(  # type: ignore[no-untyped-def]
    first, last, order, parts, planes, height, width, to, blurs, levels
):
    """Light behind a disc of its own for each pixel, from `levels` (K, 13)."""
    samples, count = planes * height * width, max(planes // parts, 1)
    for unit in range(first, last):
        i, rows = order[unit // parts], _share(unit, parts, planes * height)
        diameter = _array_at(blurs[i].diameter, (height, width))
        scale = np.float32(blurs[i].defocus_px)
        top, plane = rows[0] % height, rows[0] // height
        out = _array_at(to[i], (planes, height, width))[plane : plane + count]
        bottom, begin = top + (rows[1] - rows[0]) // count, plane * height * width
        blend_rows(top, bottom, diameter, scale, _KNOTS, levels[i], begin, samples, out)


@_jit()
def move_along_rows(  # type: ignore[no-untyped-def]
    first, last, order, parts, planes, height, width, light, to, blurs
):
    """Light that moves along the rows."""
    shape = planes * height, width
    for unit in range(first, last):
        i, rows = order[unit // parts], _share(unit, parts, shape[0])
        n, share = streak_share(blurs[i].motion_px)
        image, out = _array_at(light[i], shape), _array_at(to[i], shape)
        move_rows(rows[0], rows[1], image, n, share, _MOST, out)


@_jit()
def darken(  # type: ignore[no-untyped-def]
    first, last, order, parts, planes, height, width, light, to, vignetting
):
    """Light through a lens with vignetting."""
    shape = planes * height, width
    for unit in range(first, last):
        i, rows = order[unit // parts], _share(unit, parts, shape[0])
        image, out = _array_at(light[i], shape), _array_at(to[i], shape)
        left = _array_at(vignetting[i], (height, width))
        for y in range(rows[0], rows[1]):
            for x in range(width):
                out[y, x] = image[y, x] * left[y % height, x]


@_jit()
def move_along_paths(  # type: ignore[no-untyped-def]
    first, last, order, parts, planes, height, width, light, to, blurs
):
    """Light that moves along a path, and a subject that moves along its own."""
    still, shape = 0.0, (planes * height, width)
    for unit in range(first, last):
        i, rows = order[unit // parts], _share(unit, parts, shape[0])
        blur, image, out = blurs[i], _array_at(light[i], shape), _array_at(to[i], shape)
        path = blur.extent, blur.direction, blur.turn
        taps = taps_of(path[0], path[1], path[2], still, still, height, width)
        if not blur.mask:
            blur_planes(rows[0], rows[1], image, height, taps, _MOST, out)
        elif rows[0] % height == 0:  # whoever has the first rows of a plane does all of it
            drift = blur.drift_x, blur.drift_y
            own = taps_of(path[0], path[1], path[2], drift[0], drift[1], height, width)
            mask = _array_at(blur.mask, (height, width))
            behind = _array_at(blur.behind, (height, width)).view(np.int32)
            begin, end = rows[0], (rows[1] + height - 1) // height * height
            blur_apart(image[begin:end], mask, behind, taps, own, _MOST, out[begin:end])
