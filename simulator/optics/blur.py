"""Motion and defocus blur of linear light, energy-preserving and matched in second moment.

A kernel that merely averages the pixels it covers does nothing below one pixel of extent. The
streak and the disc here are widened so that their second moment is that of the continuous streak
(extent squared / 12) or disc (diameter squared / 16 per axis): small blurs are then right, too.

Both work on *unclipped* light, so that a lamp ten times above white smears into a streak that is
still white: clipping comes later, once (see `simulator.capture.sensor`). Borders are replicated.

On the CPU, blurs run row by row in compiled kernels; a row and what is summed of it stay in the
first-level cache. A streak is a box of equal weights with a share of one more pixel at each end.
The box is put together from sums over 1, 2, 4, 8, ... pixels, each the sum of two of the former: a
streak of n pixels takes about 2 log2(n) additions, and no running sum that would lose the shadows
beside a lamp. A disc is a sum over shifts; its symmetry saves three of four products.
"""

from __future__ import annotations

import bisect
import functools
import math
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numba
import numpy as np
import torch
import torch.nn.functional as F

from simulator.utils.checks import check_number
from simulator.utils.compute import addresses, as_pointer, kernel, parallel_ranges, thread_count

#: Rows per pixel in the numerical integration of a disc's coverage.
_SUBROWS = 32
#: Streaks longer than this [pixel] are not written out: they leave next to no noise in any case.
_LONGEST_KERNEL = 4096.0
#: Kernels wider than this are applied in the Fourier domain; and where the kernel for the CPU does
#: the sum of a single image.
_FFT_TAPS, _DIRECT_TAPS = 11, 25
#: Discs wider than this are cheaper in the Fourier domain than as a sum, in a batch [pixel].
_WIDE_PX = 40.0
#: Samples from which another thread is worth waking.
_WORTH_A_THREAD = 2**16
#: Samples that are summed together: they stay in the first-level cache.
_GROUP = 2048
_jit = functools.partial(kernel, fastmath={"contract"})


# -- shapes -----------------------------------------------------------------------------------


@_jit()  # every new diameter asks for it
def coverage(radius):  # type: ignore[no-untyped-def]
    """Area of a disc of `radius` in the pixels of a quadrant, (r + 1, r + 1) float64.

    Over all four quadrants it sums to 1.
    """
    reach = max(math.ceil(radius - 0.5), 0)
    area = np.zeros((reach + 1, reach + 1))
    for i in range(reach + 1):
        for k in range(_SUBROWS):
            y = (k + 0.5) / _SUBROWS + i - 0.5
            chord = math.sqrt(max(radius**2 - y**2, 0.0))
            area[i, 0] += 2.0 * min(chord, 0.5)
            for j in range(1, reach + 1):
                area[i, j] += min(chord, j + 0.5) - min(chord, j - 0.5)
    # Loops: numpy's operations on whole arrays compile three times as long.
    out = np.empty_like(area)
    first = lower = inner = 0.0
    for i in range(reach + 1):
        for j in range(reach + 1):
            out[i, j] = area[i, j] + area[j, i]  # the quadrature treats rows and columns alike
            if i:
                lower += out[i, j]
                if j:
                    inner += out[i, j]
            elif j:
                first += out[i, j]
    total = out[0, 0] + 2.0 * (first + lower + inner)
    for i in range(reach + 1):
        for j in range(reach + 1):
            out[i, j] /= total
    return out


@functools.lru_cache(maxsize=64)
def motion_kernel(extent_px: float) -> np.ndarray:
    """Weights (K,), K odd, of a uniform streak of `extent_px` pixels.

    The streak covers ``2 n + 1`` pixels whole and a share e of one more at each end. Its second
    moment, ``(n (n + 1) (2 n + 1) / 3 + 2 e (n + 1)^2) / (2 n + 1 + 2 e)``, is solved for n and e.

    >>> motion_kernel(2.0).round(3).tolist()
    [0.167, 0.667, 0.167]
    """
    n, end = streak_share(extent_px)
    if not n and not end:
        return np.ones(1)
    weights = np.ones(2 * n + 3)
    weights[0] = weights[-1] = end
    return weights / (2 * n + 1 + 2.0 * end)


def streak_share(extent_px: float) -> tuple[int, float]:
    """Pixels n that a streak covers whole on either side, and its share e of one more.

    Both 0 where the extent is too small to blur anything.
    """
    extent = check_number("extent_px", extent_px, 0.0, sys.float_info.max)
    target = extent * extent / 12.0
    if target < 1e-12:
        return 0, 0.0
    n = int((math.sqrt(1.0 + extent * extent) - 1.0) / 2.0)  # the moment is n (n + 1) / 3 at e = 0
    end = (target - n * (n + 1) / 3.0) * (2 * n + 1) / (2.0 * ((n + 1) ** 2 - target))
    return n, max(end, 0.0)


def _disc_coverage(radius: float) -> np.ndarray:
    """Area of a disc of `radius` in each pixel, (K, K), K odd, sums to 1."""
    rows = coverage(radius)
    rows = np.concatenate([rows[:0:-1], rows])
    return np.concatenate([rows[:, :0:-1], rows], axis=1)


@functools.cache
def _radius_table() -> tuple[list[float], list[float]]:
    """Second moments per axis of covered discs, and their radii: the inverse is interpolated."""
    radii = np.concatenate([[0.5], 0.5 + np.geomspace(1e-4, 7.5, 700)])
    profiles = [_disc_coverage(radius).sum(0) for radius in radii]
    moments = np.array([(p * (np.arange(len(p)) - len(p) // 2) ** 2).sum() for p in profiles])
    return np.maximum.accumulate(moments).tolist(), radii.tolist()


def disc_radius(diameter_px: float) -> float:
    """Radius of the disc whose coverage has the second moment of one of `diameter_px`.

    At most 0.5 where the diameter is too small to blur anything.
    """
    diameter = check_number("diameter_px", diameter_px, 0.0, sys.float_info.max)
    target = diameter * diameter / 16.0
    if target < 1e-6:
        return 0.5
    moments, radii = _radius_table()
    if target >= moments[-1]:
        return 2.0 * math.sqrt(target - 1.0 / 12.0)
    i = bisect.bisect_right(moments, target)
    share = (target - moments[i - 1]) / (moments[i] - moments[i - 1])
    return radii[i - 1] + share * (radii[i] - radii[i - 1])


@functools.lru_cache(maxsize=64)
def disc_kernel(diameter_px: float) -> np.ndarray:
    """Weights (K, K), K odd, of a uniform disc of `diameter_px` pixels.

    >>> kernel = disc_kernel(3.0)
    >>> round(float((kernel.sum(0) * [1, 0, 1]).sum()), 2)  # 3**2 / 16
    0.56
    """
    return _disc_coverage(disc_radius(diameter_px))


@functools.lru_cache(maxsize=4096)
def kernel_energy(motion_px: float, defocus_px: float) -> float:
    """Sum of squared weights of both blurs together: the share of white noise's variance left."""
    disc = disc_kernel(defocus_px)
    if motion_px > _LONGEST_KERNEL:  # as if it were much longer than the disc is wide
        n, end = streak_share(motion_px)
        total = 2 * n + 1 + 2.0 * end
        return float((disc.sum(axis=1) ** 2).sum()) * (2 * n + 1 + 2.0 * end**2) / total**2
    streak = motion_kernel(motion_px)
    if disc.shape[0] == 1:
        return float((streak**2).sum())
    both = np.apply_along_axis(np.convolve, 1, disc, streak)
    return float((both**2).sum())


# -- one image --------------------------------------------------------------------------------


def motion_blur(
    light: torch.Tensor,
    extent_px: float,
    out: torch.Tensor | None = None,
    *,
    limit: float = math.inf,
) -> torch.Tensor:
    """Uniform motion along the rows during the exposure.

    Args:
        light: (..., H, W) linear light.
        extent_px: Distance that the image moves, in pixels, >= 0.
        out: Contiguous float32 tensor on the CPU to write to, instead of a new one.
        limit: Light beyond it, on either side of 0, is clipped before it is blurred; float32 on the
            CPU only.

    Returns:
        (..., H, W), the same dtype. The cost of long streaks hardly depends on the extent.
    """
    n, end = streak_share(extent_px)
    if not n and not end:
        return light if out is None else out.copy_(light)
    if _has_kernels(light):
        most = np.float32(limit)
        return _by_rows(light, out, lambda a, b, rows, to: _moved(a, b, rows, n, end, most, to))
    width, radius = light.shape[-1], n + 1
    covered = 2 * n + 1 + 2.0 * end
    full, edge = 1.0 / covered, end / covered
    if radius >= width:  # the whole row and both borders: counted, as padding might not fit
        column = torch.arange(width, device=light.device)
        left, right = radius - 1 - column + edge / full, column + radius - width + edge / full
        rows = light.double()
        total = rows.sum(-1, keepdim=True) + rows[..., :1] * left + rows[..., -1:] * right
        return (total * full).to(light.dtype)
    padded = F.pad(light.reshape(-1, 1, width), (radius, radius), mode="replicate")
    sums = F.pad(padded.double().cumsum(-1), (1, 0))
    inner = sums[..., 2 * radius : 2 * radius + width] - sums[..., 1 : 1 + width]
    ends = padded[..., :width] + padded[..., 2 * radius :]
    return (inner * full + ends.double() * edge).to(light.dtype).reshape(light.shape)


def disc_blur(light: torch.Tensor, diameter_px: float) -> torch.Tensor:
    """Defocus by a uniform disc.

    Args:
        light: (..., H, W) linear light.
        diameter_px: Diameter of the circle of confusion, in pixels, >= 0.

    Returns:
        (..., H, W), the same dtype.
    """
    weights = disc_kernel(diameter_px)
    taps = weights.shape[0]
    if taps == 1:
        return light
    height, width = light.shape[-2:]
    if taps <= _DIRECT_TAPS and _has_kernels(light):
        quadrant, reach = _quadrant(disc_radius(diameter_px))
        most = np.float32(math.inf)
        return _by_rows(
            light,
            None,
            lambda a, b, rows, out: _disc(a, b, height, rows, quadrant, reach, most, out),
            cost=len(quadrant) ** 2,
        )
    radius = taps // 2
    padded = F.pad(light.reshape(-1, 1, height, width), (radius,) * 4, mode="replicate")
    disc = torch.from_numpy(weights).to(light.device)
    if taps <= _FFT_TAPS:
        return F.conv2d(padded, disc[None, None].to(light.dtype)).reshape(light.shape)
    # float64: a lamp a thousand times above white must not leave ringing in the shadows.
    size = [height + 2 * radius, width + 2 * radius]
    spectrum = torch.fft.rfft2(padded.double()) * torch.fft.rfft2(disc, s=size)
    blurred = torch.fft.irfft2(spectrum, s=size)[..., 2 * radius :, 2 * radius :]
    return blurred.to(light.dtype).reshape(light.shape)


def _has_kernels(light: torch.Tensor) -> bool:
    return light.device.type == "cpu" and light.dtype == torch.float32 and not light.requires_grad


def _by_rows(
    light: torch.Tensor,
    out: torch.Tensor | None,
    task: Callable[[int, int, np.ndarray, np.ndarray], None],
    cost: int = 1,
) -> torch.Tensor:
    """`task` on shares of the rows of `light`; `cost` is that of a sample."""
    out = torch.empty(light.shape) if out is None else out
    width = light.shape[-1]
    rows, result = light.contiguous().reshape(-1, width).numpy(), out.reshape(-1, width).numpy()
    parallel_ranges(
        lambda first, last: task(first, last, rows, result),
        len(rows),
        least=1 + _WORTH_A_THREAD // (cost * width),
    )
    return out


def box_mean(x: torch.Tensor, window: int) -> torch.Tensor:
    """Mean over `window` x `window` pixels, borders repeated.

    Sums over 1, 2, 4, 8 ... pixels are doubled from one another: a few additions of whole images
    where pooling would read every pixel `window` times.

    Args:
        x: (B, C, H, W).
        window: Odd side of the window [pixel].

    Returns:
        (B, C, H, W).
    """
    height, width = x.shape[-2:]
    padded = F.pad(x, (window // 2,) * 4, mode="replicate")
    rows = _running_sum(padded, window, -2, height)
    return _running_sum(rows, window, -1, width) / (window * window)


def _running_sum(x: torch.Tensor, window: int, axis: int, size: int) -> torch.Tensor:
    """Sums of `window` neighbours along `axis`, the first `size` of them."""
    total: torch.Tensor | None = None
    done, span = 0, 1
    while True:
        if window & span:
            part = x.narrow(axis, done, size)
            total = part if total is None else total + part
            done += span
        if 2 * span > window:
            assert total is not None
            return total
        length = x.shape[axis] - span
        x = x.narrow(axis, 0, length) + x.narrow(axis, span, length)
        span *= 2


# -- many images ------------------------------------------------------------------------------


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


def blur_many(blurs: Sequence[Blur], *, limit: float = math.inf) -> None:
    """Blurs images of one shape: as `disc_blur` and `motion_blur`, but each image on one thread.

    Args:
        blurs: The images and their blurs; (P, H, W) each where a disc is wide.
        limit: See `motion_blur`.
    """
    blurs = _without_wide_discs(blurs, limit)
    if not blurs:
        return
    # The costliest first, and dealt out in turn: every thread gets about as much to do.
    shares = min(thread_count(), len(blurs))
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

    parallel_ranges(run, len(blurs))


def _without_wide_discs(blurs: Sequence[Blur], limit: float) -> Sequence[Blur]:
    """The blurs that are left once the discs that are wide are done."""
    wide = [b for b in blurs if b.defocused is not None and b.diameter_px > _WIDE_PX]
    if not wide:
        return blurs

    def run(first: int, last: int) -> None:
        for blur in wide[first:last]:
            _wide_disc(blur, limit)

    parallel_ranges(run, len(wide))
    left = [b for b in blurs if b.defocused is None or b.diameter_px <= _WIDE_PX]
    moved = [b for b in wide if b.moved is not None]
    return left + [Blur(b.defocused, extent_px=b.extent_px, moved=b.moved) for b in moved]  # type: ignore[arg-type]


def _wide_disc(blur: Blur, limit: float) -> None:
    """`disc_blur` by numpy, whose transforms are safe in a forked process."""
    assert blur.defocused is not None
    weights = disc_kernel(blur.diameter_px)
    radius = len(weights) // 2
    light = np.clip(blur.light.numpy(), -limit, limit).astype(np.float64)
    padded = np.pad(light, ((0, 0), (radius, radius), (radius, radius)), mode="edge")
    size = padded.shape[-2:]
    spectrum = np.fft.rfft2(padded) * np.fft.rfft2(weights, s=size)
    blurred = np.fft.irfft2(spectrum, s=size)
    blur.defocused.numpy()[...] = blurred[:, 2 * radius :, 2 * radius :]


# -- kernels for the CPU ----------------------------------------------------------------------


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
