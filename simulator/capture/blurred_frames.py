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
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
import torch.nn.functional as F

from simulator.optics import discs
from simulator.optics.motion import blur_apart, blur_planes, move_rows, streak, taps_of
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
_DISCS, _KNOTS = np.array(discs.DIAMETERS), discs.KNOTS
_MOST = np.float32(discs.LIGHT_LIMIT)  # of its type, lest kernels compile twice
_jit = functools.partial(kernel, fastmath={"contract"})
#: What is to be done to a frame, and where: one step of its blur.
PASS = np.dtype(
    [
        *((n, "i8") for n in ("kind", "frame", "scene")),  # index into `_TASKS`
        *((n, "uintp") for n in ("source", "to")),  # places
        *((n, "f8") for n in ("diameter", "radius")),  # of the disc; 0 for another kind
        ("cost", "f8"),  # about microseconds at 128 x 128
    ]
)


class Passes(NamedTuple):
    """What is to be done for K frames, in this order: arguments of the tasks."""

    shape: tuple[int, ...]  # of all frames
    passes: np.ndarray  # (J,) `PASS`
    blurs: np.ndarray  # (K,) `BLUR`
    levels: np.ndarray  # (K, 13) places that blends read


#: Kinds of passes, in the order in which a frame has them. A disc is `WIDE` (made in the Fourier
#: domain), `LEVEL` (one of the bank, for all blends of its owner) or `DISC` (that of one frame).
WIDE, LEVEL, DISC, BLEND, ALONG_ROWS, ALONG_PATH, DARKEN = range(7)


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
            found += [self.subject.numpy().astype(np.float32), self.behind.numpy().astype(np.int32)]
        return tuple(found)


class FramesAt(Sequence[torch.Tensor]):
    """Contiguous float32 frames of one shape, known by their `addresses` (B,); 0 is None."""

    def __init__(self, addresses: np.ndarray, shape: tuple[int, ...]) -> None:
        self.addresses, self.shape = addresses, (len(addresses), *shape)

    def __len__(self) -> int:
        return len(self.addresses)

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        address = int(self.addresses[index])
        return torch.from_numpy(frame_at(address, self.shape[1:])) if address else None


def frame_at(address: int, shape: tuple[int, ...]) -> np.ndarray:
    """The contiguous float32 frame at an address."""
    memory = ctypes.c_float * math.prod(shape)
    return np.ndarray(shape, np.float32, memoryview(memory.from_address(address)))


class BlurredFrames:
    """Blurred light of a batch's scenes, in memory that is used again.

    The light behind the lens is cached for each of `num_apertures`, and the discs that it is
    blended of, which several scenes may share; where all memory together exceeds `most_bytes`, only
    the latest light. Frames are (4, H, W), as the lights are that `places` is given. Each is known
    by its place, here the address of its memory; 0 is none.
    """

    def __init__(self, num_scenes: int, num_apertures: int, most_bytes: int) -> None:
        self._most_bytes, self._shape = most_bytes, tuple[int, ...]()
        # Places that each scene holds: behind the lens at each aperture, in motion, and of its
        # layout where that is a frame, too. The light that each was made of, and the disc.
        self._held, self._source = np.zeros((2, num_scenes, num_apertures + 2), np.uintp)
        self._diameter = np.zeros((num_scenes, num_apertures))
        # The same behind each disc of the bank, by the `owners` of `plan`.
        self._discs, self._disc_source = np.zeros((2, 2 * num_scenes, len(_DISCS)), np.uintp)
        self._slabs = list[torch.Tensor]()
        # Places, of which the first are free, and how many: an array, which kernels change at once
        # with what is held, whatever interrupts their caller.
        self._free, self._left = np.empty(0, np.uintp), np.zeros(1, np.int64)
        self._bytes = 0  # of all memory

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
        while (lacking := count - self._left.item()) > 0:
            self._grow(lacking)
        self._left -= count
        left = self._left.item()
        return self._free[left : left + count].copy()

    def _grow(self, count: int) -> None:
        """Makes places for `count` frames or more."""
        made = self._more(count)
        self._free = np.append(self._free, made)  # room for all that there are
        self._give_back(made)

    def _give_back(self, places: np.ndarray) -> None:
        """Makes places free that are not 0."""
        places, left = places[places > 0], self._left.item()
        self._free[left : left + len(places)] = places
        self._left += len(places)

    def _more(self, count: int) -> np.ndarray:
        """Places of new memory for `count` frames or more."""
        room = max(self._most_bytes - self._bytes, 0) // 4
        spare = min(_SLAB, room) // math.prod(self._shape)
        size = max(count, spare), *self._shape
        slab = torch.empty(size, dtype=torch.float32, device="cpu")  # whatever torch's defaults are
        self._slabs.append(slab)
        self._bytes += slab.nbytes
        return (slab.data_ptr() + np.arange(len(slab)) * slab[0].nbytes).astype(np.uintp)

    def release(self, indices: np.ndarray) -> None:
        """Frees the memory of the scenes `indices`."""
        self._release(self._held, indices)
        self._release(self._discs, np.append(indices, indices + len(self._held)))

    def _release(self, held: np.ndarray, rows: np.ndarray) -> None:
        places = held[np.unique(rows)]
        held[rows] = 0  # first: an interrupt may cost memory, but nothing has two owners
        self._give_back(places)

    def _drop_discs(self, lacking: int, owners: np.ndarray) -> bool:
        """Whether discs of others are freed, lest memory for more frames exceed its limit."""
        if self._bytes + lacking * 4 * math.prod(self._shape) <= self._most_bytes:
            return False
        others = np.setdiff1d(np.flatnonzero(self._discs.any(axis=1)), owners)
        self._release(self._discs, others)
        return len(others) > 0

    def forget_discs(self) -> None:
        """Makes every disc again when it is needed next; the memory stays."""
        self._disc_source[:] = 0

    def plan(
        self,
        indices: np.ndarray,
        slots: np.ndarray,
        blurs: np.ndarray,
        source: np.ndarray,
        owners: np.ndarray,
    ) -> tuple[np.ndarray, Passes]:
        """(K,) places of the light of scenes `indices` behind their blurs, and what makes it.

        `slots` (K,) are their apertures, `blurs` `BLUR`; `source` are the places of the light
        (4, H, W) that they start from. Each stays until its scene blurs another. No two have the
        scene in common. Of those with one of the `owners` (K,) in common, discs of the bank are
        made once: they start from the same light. An owner is a scene, whose light it is, or one
        that shares it with no other, counted on behind all scenes. `LEVEL` passes are to be done
        before others are put off.
        """
        if self.is_full:  # light at these apertures, or in motion, and layouts stay
            others = self._held[indices]
            others[np.arange(len(indices)), slots] = others[:, -2:] = 0
            self._held[indices] -= others
            self._give_back(others)
            self._release(self._discs, owners)
        count, done, planned, lacking = len(indices), 0, 0, 0
        light, levels = np.empty(count, np.uintp), np.empty((count, len(discs.DIAMETERS)), np.uintp)
        passes = np.empty(count * (len(discs.DIAMETERS) + 3), PASS)
        held = self._held, self._source, self._diameter, self._discs, self._disc_source
        frames = (
            indices,
            slots,
            blurs,
            source,
            owners,
            float(sum(self._shape[1:])),
            discs.radius_table(),
        )
        while done < count:
            if lacking and not self._drop_discs(lacking, owners):
                self._grow(lacking)
            free, made = (self._free, self._left), (light, levels, passes)
            done, planned, lacking = plan_passes(done, planned, frames, held, free, made)
        return light, Passes(self._shape, passes[:planned], blurs, levels)

    def run(self, planned: Passes) -> None:
        """Does all passes, kind by kind, each on all threads."""
        kinds = planned.passes["kind"]
        for kind in np.unique(kinds).tolist():
            self._run(kind, planned._replace(passes=planned.passes[kinds == kind]))

    def _run(self, kind: int, alike: Passes) -> None:
        threads, (planes, height, width), parts = torch.get_num_threads(), self._shape, 1
        if kind == WIDE:  # several at once would fill the memory
            for one in alike.passes:
                light, out = (frame_at(int(one[name]), self._shape) for name in ("source", "to"))
                discs.wide_disc(light, one["diameter"].item(), out)
            return
        # Of few large frames, threads share planes, or rows where there are more threads.
        if (count := len(alike.passes)) < 2 * threads and planes * height * width >= _LARGE:
            parts = planes * min(1 + (threads - 1) // (count * planes), height)
        task = _TASKS[kind]
        parallel_ranges(lambda first, last: task(first, last, parts, *alike), count * parts)


@_jit()
def _array_at(address, shape):  # type: ignore[no-untyped-def]
    return numba.carray(as_pointer(address), shape)  # type: ignore[attr-defined, call-arg]


@_jit()
def plan_passes(done, planned, frames, memory, spare, made):  # type: ignore[no-untyped-def]
    """Plans the passes of `frames` (K,) from `done` on, behind those that are `planned`.

    See `BlurredFrames.plan` for the frames, and `BlurredFrames` for the `memory`, of which these
    many places are to `spare`. What is `made` are (K,) places of light, (K, 13) of what blends
    read, and `PASS`.

    Returns:
        The frames that are done, the passes, and how many places lack.
    """
    indices, slots, blurs, source, owners, longest, table = frames
    held, sources, diameters, banks, bank_sources = memory
    (free, left), (light, levels, passes) = spare, made
    needed = np.zeros(len(_KNOTS), np.bool_)
    for k in range(done, len(indices)):
        scene, slot, blur, at = indices[k], slots[k], blurs[k], source[k]
        bank, origins = banks[owners[k]], bank_sources[owners[k]]
        diameter, blends, moved = blur.defocus_px, blur.diameter > 0, held.shape[1] - 2
        known = held[scene, slot] > 0 and sources[scene, slot] == at
        known = known and diameters[scene, slot] == diameter
        new = diameter > 0.0 and not known
        changes = blur.motion_px > 0.0 or blur.vignetting > 0
        needed[:] = False
        if new and blends:
            sorts = _array_at(blur.sorts, (blur.num_sorts,))
            discs.mark_levels(sorts, np.float32(diameter), _HALF_STEP, _KNOTS, needed)
            needed[0] = False
        lacking = (new and not held[scene, slot]) + (changes and not held[scene, moved])
        for level in range(len(needed)):
            if bank[level]:
                needed[level] &= origins[level] != at
            else:
                lacking += needed[level]
        if lacking > left[0]:
            return k, planned, lacking - left[0]
        light[k], levels[k, :] = at, at  # levels without a share are read, too, times 0
        if new:
            for level in range(len(needed) if blends else 0):
                if needed[level]:
                    to, origins[level] = _hold(bank, level, free, left), at
                    planned = _add_disc(passes, planned, k, scene, at, to, _DISCS[level], table)
                    passes[planned - 1].kind = LEVEL  # none of the bank is wide
                if bank[level] and origins[level] == at:
                    levels[k, level] = bank[level]
            to = _hold(held[scene], slot, free, left)
            sources[scene, slot], diameters[scene, slot] = at, diameter
            if blends:
                planned = _add(passes, planned, BLEND, k, scene, at, to, 50.0)
            else:
                planned = _add_disc(passes, planned, k, scene, at, to, diameter, table)
        if diameter > 0.0:
            light[k] = held[scene, slot]
        if changes:  # what changes by motion, or by the lens, has memory of its own
            to = _hold(held[scene], moved, free, left)
            if blur.motion_px > 0.0:
                kind = ALONG_ROWS if blur.streaks else ALONG_PATH
                # Sums of taps take as long as these are many; with a subject there are more.
                cost = (95.0 + 9.0 * min(blur.motion_px, longest)) * (1.6 if blur.mask else 1.0)
                planned = _add(passes, planned, kind, k, scene, light[k], to, cost)
                light[k] = to
            if blur.vignetting:
                planned = _add(passes, planned, DARKEN, k, scene, light[k], to, 20.0)
            light[k] = to
    return len(indices), planned, 0


@_jit()
def _hold(held, place, free, left):  # type: ignore[no-untyped-def]
    """Takes a free one for `place`, unless it has one; returns it."""
    if not held[place]:
        left[0] -= 1
        held[place] = free[left[0]]
    return held[place]


@_jit()
def _add(passes, planned, kind, frame, scene, source, to, cost):  # type: ignore[no-untyped-def]
    """Adds a pass; how many there are then."""
    one = passes[planned]
    one.kind, one.frame, one.scene, one.source, one.to = kind, frame, scene, source, to
    one.diameter, one.radius, one.cost = 0.0, 0.0, cost
    return planned + 1


@_jit()
def _add_disc(  # type: ignore[no-untyped-def]
    passes, planned, frame, scene, source, to, diameter, table
):
    """The same of the disc of a diameter."""
    one, radius = passes[planned], discs.disc_radius(diameter, table[0], table[1])
    kind = WIDE if diameter > discs.WIDE_PX else DISC
    planned = _add(passes, planned, kind, frame, scene, source, to, 85.0 + 13.0 * radius**2)
    one.diameter, one.radius = diameter, radius
    return planned


# Tasks do units `first` to `last` of passes (J,): a unit is one of `parts` equal shares of the rows
# of all planes (P, H, W) of a frame. There is one for each kind of pass: what compiles slowly and
# is not needed is not compiled.
@_jit()
def _at(unit, parts, shape, passes):  # type: ignore[no-untyped-def]
    """First row of a unit, the first behind it, and what it reads and writes, (P H, W)."""
    one, rows, width = passes[unit // parts], shape[0] * shape[1], shape[2]
    first, last = unit % parts * rows // parts, (unit % parts + 1) * rows // parts
    return first, last, _array_at(one.source, (rows, width)), _array_at(one.to, (rows, width))


@_jit()
def blur_discs(first, last, parts, shape, passes, blurs, levels):  # type: ignore[no-untyped-def]
    """Light behind one disc each."""
    for unit in range(first, last):
        one = passes[unit // parts]
        top, bottom, light, out = _at(unit, parts, shape, passes)
        blur_planes(top, bottom, light, shape[1], discs.disc_taps(one.radius), _MOST, out)


@_jit()
def blend_discs(first, last, parts, shape, passes, blurs, levels):  # type: ignore[no-untyped-def]
    """Light behind a disc of its own for each pixel, from `levels` (K, 13)."""
    planes, height, width = shape
    count = max(planes // parts, 1)
    for unit in range(first, last):
        one = passes[unit // parts]
        begin, end, light, out = _at(unit, parts, shape, passes)
        blur, own, plane = blurs[one.frame], levels[one.frame], begin // height
        diameter, scale = _array_at(blur.diameter, (height, width)), np.float32(blur.defocus_px)
        top, bottom = begin % height, begin % height + (end - begin) // count
        result, skipped = out.reshape(shape)[plane : plane + count], plane * height * width
        discs.blend_rows(top, bottom, diameter, scale, _KNOTS, own, skipped, light.size, result)


@_jit()
def move_along_rows(first, last, parts, shape, passes, blurs, levels):  # type: ignore[no-untyped-def]
    """Light that moves along the rows."""
    for unit in range(first, last):
        one = passes[unit // parts]
        top, bottom, light, out = _at(unit, parts, shape, passes)
        radius, share = streak(blurs[one.frame].motion_px, shape[2])
        move_rows(top, bottom, light, radius, share, _MOST, out)


@_jit()
def move_along_paths(first, last, parts, shape, passes, blurs, levels):  # type: ignore[no-untyped-def]
    """Light that moves along a path, and a subject that moves along its own."""
    still, size, height = 0.0, shape[1:], shape[1]
    for unit in range(first, last):
        blur = blurs[passes[unit // parts].frame]
        top, bottom, light, out = _at(unit, parts, shape, passes)
        path = blur.extent, blur.direction, blur.turn
        taps = taps_of(*path, still, still, *size)
        if not blur.mask:
            blur_planes(top, bottom, light, height, taps, _MOST, out)
        elif top % height == 0:  # whoever has the first rows of a plane does all of it
            own = taps_of(*path, blur.drift_x, blur.drift_y, *size)
            mask, behind = _array_at(blur.mask, size), _array_at(blur.behind, size).view(np.int32)
            bottom = (bottom + height - 1) // height * height
            blur_apart(light[top:bottom], mask, behind, taps, own, _MOST, out[top:bottom])


@_jit()
def darken(first, last, parts, shape, passes, blurs, levels):  # type: ignore[no-untyped-def]
    """Light through a lens with vignetting; a frame may be darkened in place."""
    for unit in range(first, last):
        one = passes[unit // parts]
        top, bottom, light, out = _at(unit, parts, shape, passes)
        left = _array_at(blurs[one.frame].vignetting, shape[1:])
        for y in range(top, bottom):
            for x in range(shape[2]):
                out[y, x] = light[y, x] * left[y % shape[1], x]


_TASKS: Any = None, blur_discs, blur_discs, blend_discs, move_along_rows, move_along_paths, darken
