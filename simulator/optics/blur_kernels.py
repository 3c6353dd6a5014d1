"""Motion and defocus blur on the CPU, row by row: twins of those in `simulator.optics.blur`.

Same kernels, same borders; a row and what is summed of it stay in the first-level cache.

A streak is a box of equal weights with a share of one more pixel at each end. The box is put
together from sums over 1, 2, 4, 8, ... pixels, each the sum of two of the former: a streak of n
pixels takes about 2 log2(n) additions, and no running sum that would lose the shadows beside a
lamp. A disc is a sum over shifts; its symmetry saves three of four products.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numba
import numpy as np
import torch

from simulator.optics.shapes import coverage, disc_kernel, disc_radius, streak_share
from simulator.utils.compute import addresses, as_pointer, kernel, parallel_ranges, thread_count

#: Samples from which another thread is worth waking.
_WORTH_A_THREAD = 2**16
#: Discs wider than this are cheaper in the Fourier domain than as a sum [pixel].
_WIDE_PX = 40.0
#: Samples that are summed together: they stay in the first-level cache.
_GROUP = 2048
_jit = functools.partial(kernel, fastmath={"contract"})


@_jit()
def _copy(a, out):  # type: ignore[no-untyped-def]
    for x in range(len(out)):
        out[x] = a[x]


@_jit()
def _add(a, b, out):  # type: ignore[no-untyped-def]
    for x in range(len(out)):
        out[x] = a[x] + b[x]


@_jit()
def _add_scaled(a, weight, out):  # type: ignore[no-untyped-def]
    for x in range(len(out)):
        out[x] += weight * a[x]


@_jit()
def _add_product(a, b, weight, out):  # type: ignore[no-untyped-def]
    for x in range(len(out)):
        out[x] += weight * (a[x] + b[x])


@_jit()
def _pad(rows, y, top, bottom, radius, limit, padded):  # type: ignore[no-untyped-def]
    """Rows from `y` on, but of [top, bottom), each with `radius` more pixels at both ends."""
    width = rows.shape[1]
    for i in range(len(padded)):
        source = np.uint64(min(max(y + i, top), bottom - 1))
        for x in range(width):
            value = rows[source, x]
            value = value if value < limit else limit
            padded[i, np.uint64(radius + x)] = value if value > -limit else -limit
        for x in range(radius):
            padded[i, x] = padded[i, radius]
            padded[i, np.uint64(radius + width + x)] = padded[i, radius + width - 1]


@_jit()
def _whole_rows(first, last, rows, radius, edge, full, limit, out):  # type: ignore[no-untyped-def]
    """A streak that covers a whole row and both borders: their pixels are counted."""
    width, share = rows.shape[1], edge / full
    for y in range(first, last):
        total = 0.0
        for x in range(width):
            total += min(max(rows[y, x], -limit), limit)
        begin = min(max(rows[y, 0], -limit), limit)
        end = min(max(rows[y, width - 1], -limit), limit)
        for x in range(width):
            left, right = radius - 1 - x + share, x + radius - width + share
            out[y, x] = np.float32((total + begin * left + end * right) * full)


@_jit()
def _box(current, following, length, out):  # type: ignore[no-untyped-def]
    """Sums over samples 1 to `length` from each one on; overwrites `current`."""
    size, offset, power = len(current), 1, 1
    while power <= length:
        if length & power:
            if length & (power - 1):
                _add(out[: size - offset], current[offset:], out[: size - offset])
            else:
                _copy(current[offset:], out[: size - offset])
            offset += power
        power *= 2
        if power <= length:
            valid = size - power + 1
            _add(current[:valid], current[power // 2 :], following[:valid])
            current, following = following, current


@_jit()
def _streak(first, last, rows, radius, share, full, limit, out):  # type: ignore[no-untyped-def]
    width = rows.shape[1]
    pitch = width + 2 * radius
    many = max(1, _GROUP // pitch)
    padded = np.empty((many, pitch), np.float32)
    box = np.zeros((many, pitch), np.float32)  # rows behind one another: one long vector
    current, following = np.zeros(many * pitch, np.float32), np.zeros(many * pitch, np.float32)
    for y in range(first, last, many):
        _pad(rows, y, y, last, radius, limit, padded)
        _copy(padded.reshape(-1), current)
        _box(current, following, 2 * radius - 1, box.reshape(-1))
        for i in range(min(many, last - y)):
            row = np.uint64(y + i)  # unsigned: no check whether it counts from the end
            for x in range(width):
                ends = padded[i, x] + padded[i, np.uint64(x + 2 * radius)]
                # One product to a sum: of two, the compiler would choose which one it fuses.
                out[row, x] = (box[i, x] + ends * share) * full


@_jit()
def _disc(first, last, height, rows, weights, reach, limit, out):  # type: ignore[no-untyped-def]
    width, radius = rows.shape[1], len(weights) - 1
    pitch = width + 2 * radius
    many = max(1, min(height, _GROUP // pitch))
    padded = np.empty((many + 2 * radius, pitch), np.float32)
    flat = padded.reshape(-1)
    size = many * pitch
    total, both = np.zeros((many, pitch), np.float32), np.zeros(size, np.float32)
    inner = total.reshape(-1)[radius : size - radius]
    y = first
    while y < last:
        top = y // height * height
        count = min(many, last - y, top + height - y)
        _pad(rows, y - radius, top, top + height, radius, limit, padded)
        for i in range(radius + 1):
            above, below = (radius - i) * pitch, (radius + i) * pitch
            if i:
                _add(flat[above : above + size], flat[below:], both)
            else:
                _copy(flat[above:], both)
                inner[:] = np.float32(0)
            _add_scaled(both[radius:], weights[i, 0], inner)
            for j in range(1, reach[i] + 1):
                _add_product(both[radius - j :], both[radius + j :], weights[i, j], inner)
        for i in range(count):
            row = np.uint64(y + i)
            for x in range(width):
                out[row, x] = total[i, np.uint64(radius + x)]
        y += count


@_jit()
def _quadrant(radius):  # type: ignore[no-untyped-def]
    """Weights (r + 1, r + 1) of a disc's quadrant, and the last non-zero one of each row."""
    weights = coverage(radius).astype(np.float32)
    reach = np.zeros(len(weights), np.int64)
    for i in range(len(weights)):
        for j in range(len(weights)):
            if weights[i, j] > 0:
                reach[i] = j
    return weights, reach


@_jit()
def _moved(first, last, rows, n, end, limit, out):  # type: ignore[no-untyped-def]
    """Rows `first` to `last` behind a streak of 2 n + 1 pixels and a share of two more."""
    full = 1.0 / (2 * n + 1 + 2.0 * end)
    if n + 1 >= rows.shape[1]:
        _whole_rows(first, last, rows, n + 1, end * full, full, limit, out)
    else:
        _streak(first, last, rows, n + 1, np.float32(end), np.float32(full), limit, out)


# Two kernels for the two blurs: what compiles slowly and is not needed is not compiled.
@_jit()
def _defocus_some(  # type: ignore[no-untyped-def]
    first, last, planes, height, width, light, defocused, radius, limit
):
    """Images `first` to `last` behind discs; an address of 0 to write to leaves one out."""
    shape = (planes * height, width)
    for i in range(first, last):
        if defocused[i]:
            rows = numba.carray(as_pointer(light[i]), shape)  # type: ignore[attr-defined, call-arg]
            out = numba.carray(as_pointer(defocused[i]), shape)
            weights, reach = _quadrant(radius[i])
            _disc(0, len(rows), height, rows, weights, reach, limit, out)


@_jit()
def _move_some(  # type: ignore[no-untyped-def]
    first, last, planes, height, width, light, defocused, moved, whole, end, limit
):
    """Images `first` to `last` behind streaks, of what is `defocused` where there is that."""
    shape = (planes * height, width)
    for i in range(first, last):
        if moved[i]:
            source = defocused[i] if defocused[i] else light[i]
            rows = numba.carray(as_pointer(source), shape)  # type: ignore[attr-defined, call-arg]
            out = numba.carray(as_pointer(moved[i]), shape)
            _moved(0, len(rows), rows, whole[i], end[i], limit, out)


class Blur(NamedTuple):
    """One image for `blur_many`: a disc, a streak, or one after the other.

    Args:
        light: (..., H, W) contiguous float32 on the CPU.
        diameter_px: Of the disc, in pixels, >= 0.
        defocused: Like `light`; the image behind the disc is written here. None for no disc.
        extent_px: Of the streak, in pixels, >= 0.
        moved: Like `light`; the image behind both is written here. None for no streak.
    """

    light: torch.Tensor
    diameter_px: float = 0.0
    defocused: torch.Tensor | None = None
    extent_px: float = 0.0
    moved: torch.Tensor | None = None


def blur_many(
    blurs: Sequence[Blur], *, limit: float = math.inf, threads: int | None = None
) -> None:
    """Blurs images of one shape: as `disc` and `streak`, but each image on one thread.

    Args:
        blurs: The images and their blurs; (P, H, W) each where a disc is wide.
        limit: See `disc`.
        threads: At most so many; those of torch by default.
    """
    blurs = _without_wide_discs(blurs, limit, threads)
    if not blurs:
        return
    # The costliest first, and dealt out in turn: every thread gets about as much to do.
    shares = min(thread_count() if threads is None else threads, len(blurs))
    ranked = sorted(blurs, key=lambda blur: -blur.diameter_px)
    blurs = [blur for share in range(shares) for blur in ranked[share::shares]]
    light = blurs[0].light
    height, width = light.shape[-2:]
    planes = light.numel() // (height * width)
    lights = addresses([blur.light for blur in blurs])
    defocused = addresses([blur.defocused for blur in blurs])
    moved = addresses([blur.moved for blur in blurs])
    images, most = (planes, height, width, lights, defocused), np.float32(limit)
    if defocused.any():
        radius = np.array([disc_radius(blur.diameter_px) for blur in blurs])
    if moved.any():
        whole, end = np.array([streak_share(blur.extent_px) for blur in blurs]).T.copy()
        streaks = (moved, whole.astype(np.int64), end)

    def run(first: int, last: int) -> None:
        if defocused.any():
            _defocus_some(first, last, *images, radius, most)
        if moved.any():
            _move_some(first, last, *images, *streaks, most)

    parallel_ranges(run, len(blurs), threads=threads)


def _without_wide_discs(blurs: Sequence[Blur], limit: float, threads: int | None) -> Sequence[Blur]:
    """The blurs that are left once the discs that are wide are done."""
    wide = [b for b in blurs if b.defocused is not None and b.diameter_px > _WIDE_PX]
    if not wide:
        return blurs

    def run(first: int, last: int) -> None:
        for blur in wide[first:last]:
            _wide_disc(blur, limit)

    parallel_ranges(run, len(wide), threads=threads)
    left = [b for b in blurs if b.defocused is None or b.diameter_px <= _WIDE_PX]
    moved = [b for b in wide if b.moved is not None]
    return left + [Blur(b.defocused, extent_px=b.extent_px, moved=b.moved) for b in moved]  # type: ignore[arg-type]


def _wide_disc(blur: Blur, limit: float) -> None:
    """`simulator.optics.blur.disc_blur` by numpy, whose transforms are safe in a forked process."""
    assert blur.defocused is not None
    weights = disc_kernel(blur.diameter_px)
    radius = len(weights) // 2
    light = np.clip(blur.light.numpy(), -limit, limit).astype(np.float64)
    padded = np.pad(light, ((0, 0), (radius, radius), (radius, radius)), mode="edge")
    size = padded.shape[-2:]
    spectrum = np.fft.rfft2(padded) * np.fft.rfft2(weights, s=size)
    blurred = np.fft.irfft2(spectrum, s=size)
    blur.defocused.numpy()[...] = blurred[:, 2 * radius :, 2 * radius :]


def streak(
    light: torch.Tensor,
    extent_px: float,
    out: torch.Tensor | None = None,
    *,
    limit: float = math.inf,
    threads: int | None = None,
) -> torch.Tensor:
    """Uniform motion along the rows during the exposure; see `simulator.optics.blur.motion_blur`.

    Args:
        light: (..., H, W) float32 on the CPU.
        extent_px: Distance that the image moves, in pixels, >= 0.
        out: Contiguous tensor like `light` to write to, instead of a new one.
        limit: Light beyond it, on either side of 0, is clipped before it is blurred.
        threads: At most so many; those of torch by default.
    """
    n, end = streak_share(extent_px)
    if not n and not end:
        return _unchanged(light, out)
    out = torch.empty(light.shape) if out is None else out
    rows, result = _rows(light), _rows(out)
    parallel_ranges(
        lambda first, last: _moved(first, last, rows, n, end, np.float32(limit), result),
        len(rows),
        least=1 + _WORTH_A_THREAD // rows.shape[1],
        threads=threads,
    )
    return out


def disc(
    light: torch.Tensor,
    diameter_px: float,
    out: torch.Tensor | None = None,
    *,
    limit: float = math.inf,
    threads: int | None = None,
) -> torch.Tensor:
    """Defocus by a uniform disc; see `simulator.optics.blur.disc_blur`.

    Args:
        light: (..., H, W) float32 on the CPU.
        diameter_px: Diameter of the circle of confusion, in pixels, >= 0.
        out: Contiguous tensor like `light` to write to, instead of a new one.
        limit: Light beyond it, on either side of 0, is clipped before it is blurred.
        threads: At most so many; those of torch by default.
    """
    radius = disc_radius(diameter_px)
    if radius <= 0.5:
        return _unchanged(light, out)
    out = torch.empty(light.shape) if out is None else out
    rows, result = _rows(light), _rows(out)
    weights, reach = _quadrant(radius)
    height, most = light.shape[-2], np.float32(limit)
    parallel_ranges(
        lambda first, last: _disc(first, last, height, rows, weights, reach, most, result),
        len(rows),
        least=1 + _WORTH_A_THREAD // (len(weights) ** 2 * rows.shape[1]),
        threads=threads,
    )
    return out


def _unchanged(light: torch.Tensor, out: torch.Tensor | None) -> torch.Tensor:
    return light if out is None else out.copy_(light)


def _rows(light: torch.Tensor) -> np.ndarray:
    return light.contiguous().reshape(-1, light.shape[-1]).numpy()
