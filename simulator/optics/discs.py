"""Defocus: uniform discs, and a bank of them that blends a blur for each pixel.

Discs are energy-preserving and, as streaks are (`simulator.optics.motion`), matched in second
moment: that of a continuous disc is its diameter squared / 16 per axis. On the CPU a disc is a sum
of weighted shifts, as a path is.

A bank blurs once with every disc of a few diameters and interpolates between neighbours, per pixel
and in the *squared* diameter (second moments add, so that is where blur is linear): any map of blur
diameters and any f-number for the cost of a gather.
"""

import functools
import math
import operator
import sys
from collections.abc import Iterator

import numba
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from simulator.optics.motion import Taps, grid_taps, has_kernels, path_blur, streak
from simulator.raw.image import new_frame
from simulator.utils.checks import check_number
from simulator.utils.compute import addresses, as_pointer, kernel, parallel_ranges

#: Light beyond this many times the reference's white is clipped before it is blurred: it is white
#: at every exposure, and sums of larger numbers would no longer resolve the shadows.
LIGHT_LIMIT = 1e9
#: Rows per pixel in the numerical integration of a disc's coverage.
_SUBROWS = 32
#: Kernels up to this wide are applied as a sum of shifts on the CPU, to a single image.
_DIRECT_TAPS = 41
#: Discs wider than this are cheaper in the Fourier domain than as a sum, in a batch [pixel].
WIDE_PX = 40.0
#: Diameters of the bank [pixel]: each doubles the blurred area, the step at which a blend of two
#: discs is within 2 % of the disc between them.
DIAMETERS = (0.0, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.3, 16.0, 22.6, 32.0)
#: Their squares, between which kernels interpolate.
KNOTS = np.square(DIAMETERS).astype(np.float32)
#: How far the largest disc reaches, and by how much tiles overlap for it [pixel].
DISC_REACH, HALO = 16, 20
#: Pixels from which another thread is worth waking for a blend, and pixels blended together.
_WORTH_A_THREAD, _BLENDED = 2**12, 256
_ONE = np.float32(1)
_jit = functools.partial(kernel, fastmath={"contract"})
_blend_jit = functools.partial(kernel, fastmath={"contract", "nnan", "nsz"})


# -- shapes -----------------------------------------------------------------------------------


@_jit()  # every new diameter asks for it
def coverage(radius):  # type: ignore[no-untyped-def]
    """Area of a disc of `radius` in each pixel, (K, K) float64, K odd, sums to 1."""
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
    total = 0.0
    for i in range(reach + 1):
        for j in range(reach + 1):
            both = area[i, j] + area[j, i]  # the quadrature treats rows and columns alike
            total += (2.0 if i else 1.0) * (2.0 if j else 1.0) * both
    disc = np.empty((2 * reach + 1, 2 * reach + 1))
    for y in range(-reach, reach + 1):
        for x in range(-reach, reach + 1):
            i, j = abs(y), abs(x)
            disc[reach + y, reach + x] = (area[i, j] + area[j, i]) / total
    return disc


@functools.cache
def radius_table() -> tuple[np.ndarray, np.ndarray]:
    """Second moments per axis of covered discs, and their radii: the inverse is interpolated."""
    radii = np.concatenate([[0.5], 0.5 + np.geomspace(1e-4, 7.5, 700)])
    profiles = [coverage(radius).sum(0) for radius in radii]
    moments = np.array([(p * (np.arange(len(p)) - len(p) // 2) ** 2).sum() for p in profiles])
    return np.maximum.accumulate(moments), radii


@kernel()
def disc_radius(diameter_px, moments, radii):  # type: ignore[no-untyped-def]
    """Radius of the disc whose coverage has the second moment of one of `diameter_px`.

    At most 0.5 where the diameter is too small to blur anything. The others are `radius_table`.
    """
    target = diameter_px * diameter_px / 16.0
    if target < 1e-6:
        return 0.5
    if target >= moments[-1]:
        return 2.0 * math.sqrt(target - 1.0 / 12.0)
    i = np.searchsorted(moments, target, side="right") - 1
    slope = (radii[i + 1] - radii[i]) / (moments[i + 1] - moments[i])
    return slope * (target - moments[i]) + radii[i]


@functools.lru_cache(maxsize=64)
def disc_kernel(diameter_px: float) -> np.ndarray:
    """Weights (K, K), K odd, of a uniform disc of `diameter_px` pixels.

    >>> kernel = disc_kernel(3.0)
    >>> round(float((kernel.sum(0) * [1, 0, 1]).sum()), 2)  # 3**2 / 16
    0.56
    """
    diameter = check_number("diameter_px", diameter_px, 0.0, sys.float_info.max)
    return np.asarray(coverage(disc_radius(diameter, *radius_table())))


@_jit()
def kernel_energy(motion_px, defocus_px, moments, radii):  # type: ignore[no-untyped-def]
    """Sum of squared weights of a streak and a disc: the share of white noise's variance left.

    The others are `radius_table`.
    """
    disc = coverage(disc_radius(defocus_px, moments, radii))
    radius, end = streak(motion_px, math.inf)
    energy = 0.0
    for shift in range(len(disc)):  # correlations of both with themselves, along the rows
        whole = 2.0 * radius - 1.0
        ends = end * end * (2.0 * (shift == 0) + (shift == 2 * radius))
        streaks = max(whole - shift, 0.0) + ends + 2.0 * end * (0 < shift <= whole)
        if streaks == 0.0:
            break
        products = 0.0
        for y in range(len(disc)):
            for x in range(len(disc) - shift):
                products += disc[y, x] * disc[y, x + shift]
        energy += (2.0 if shift else 1.0) * streaks * products
    return energy / (2.0 * radius - 1.0 + 2.0 * end) ** 2


# -- uniform discs ----------------------------------------------------------------------------


def disc_blur(light: Tensor, diameter_px: float) -> Tensor:
    """Defocus of linear `light` (..., H, W) by a uniform disc of `diameter_px` >= 0 pixels."""
    weights = disc_kernel(diameter_px)
    taps, reach = len(weights), len(weights) // 2
    if not reach:
        return light
    if taps <= _DIRECT_TAPS and has_kernels(light):
        return path_blur(light, Taps(*grid_taps(weights, -reach, -reach)))
    disc = torch.from_numpy(weights).to(light.device)
    # float64: a lamp a thousand times above white must not leave ringing in the shadows.
    planes = light.reshape(-1, 1, *light.shape[-2:])
    padded = F.pad(planes, (reach,) * 4, mode="replicate").double()
    size = padded.shape[-2:]
    spectrum = torch.fft.rfft2(padded) * torch.fft.rfft2(disc, s=size)
    blurred = torch.fft.irfft2(spectrum, s=size)[..., taps - 1 :, taps - 1 :]
    return blurred.to(light.dtype).reshape(light.shape)


def wide_disc(light: np.ndarray, diameter_px: float, out: np.ndarray) -> None:
    """`disc_blur` (P, H, W) by numpy, whose transforms are safe in a forked process; clipped."""
    weights = disc_kernel(diameter_px)
    radius = len(weights) // 2
    for plane, result in zip(light, out, strict=True):  # all at once, large ones fill the memory
        clipped = np.clip(plane, -LIGHT_LIMIT, LIGHT_LIMIT).astype(np.float64)
        padded = np.pad(clipped, radius, mode="edge")
        spectrum = np.fft.rfft2(padded) * np.fft.rfft2(weights, s=padded.shape)
        result[...] = np.fft.irfft2(spectrum, s=padded.shape)[2 * radius :, 2 * radius :]


@_jit()
def disc_taps(radius):  # type: ignore[no-untyped-def]
    """Rows, columns and weights of the `Taps` of a disc."""
    disc = coverage(radius)
    reach = len(disc) // 2
    return grid_taps(disc, -reach, -reach)


# -- a bank of discs --------------------------------------------------------------------------


def added_blur(diameter: Tensor, f_source: Tensor | float, f_target: Tensor | float) -> Tensor:
    """Diameter of the disc that turns the blur at `f_source` into that at `f_target` [pixel].

    The circle of confusion grows with 1 / N and squared diameters add: the difference of squares,
    ``c^2 ((N_1 / N_2)^2 - 1)``, 0 where the aperture closes.
    """
    ratio = torch.as_tensor(f_source) / torch.as_tensor(f_target)
    return diameter * (ratio.square() - 1.0).clamp(min=0.0).sqrt().to(diameter)


class DiscBank:
    """An image behind every disc of the bank; each blur is computed when it is first needed.

    The image is (..., H, W) linear light. No gradient flows into it.
    """

    def __init__(self, image: Tensor) -> None:
        self._levels = {0: image.detach()}

    def level(self, index: int) -> Tensor:
        """The image behind disc `index` of `DIAMETERS`."""
        if index not in self._levels:
            self._levels[index] = disc_blur(self._levels[0], DIAMETERS[index])
        return self._levels[index]

    def blurred(self, diameter: Tensor) -> Tensor:
        """The image blurred by `diameter` (..., H, W) of each pixel [pixel], differentiable in it.

        It is >= 0, broadcast against the image; beyond the largest disc of the bank it stays there.
        """
        image = self._levels[0]
        size, own = image.shape[-2:], diameter if torch.is_grad_enabled() else diameter.detach()
        one = diameter.shape[-2:] == size and diameter.numel() == size.numel()  # for all planes
        if one and has_kernels(image) and has_kernels(own):
            return self._blended(own.reshape(size))
        weights = _weights(diameter.square().clamp(max=DIAMETERS[-1] ** 2))
        return functools.reduce(operator.add, (self.level(i) * weight for i, weight in weights))

    def _blended(self, diameter: Tensor) -> Tensor:
        """`blurred` by kernels, by `diameter` (H, W)."""
        diameters, used = diameter.contiguous().numpy(), np.zeros(len(KNOTS), np.bool_)
        mark_levels(diameters.reshape(-1), _ONE, np.float32(0), KNOTS, used)
        light = self._levels[0].contiguous()
        # Levels without a share are read too, times 0: any image does.
        levels = [self.level(i).contiguous() if used[i] else light for i in range(len(KNOTS))]
        out = new_frame(light)
        fixed = (diameters, _ONE, KNOTS, addresses(levels), 0, out.numel())
        result, (height, width) = out.numpy().reshape(-1, *out.shape[-2:]), out.shape[-2:]
        least = 1 + _WORTH_A_THREAD // width
        parallel_ranges(lambda a, b: blend_rows(a, b, *fixed, result), height, least=least)
        return out


def _weights(squared: Tensor) -> Iterator[tuple[int, Tensor]]:
    """(index, weight) of every disc that some pixel needs: hat functions of squared diameter."""
    knots = [-1.0, *np.square(DIAMETERS).tolist(), DIAMETERS[-1] ** 2 + 1.0]
    low, high = (float(v) for v in torch.aminmax(squared.detach()))
    for index, (before, knot, after) in enumerate(zip(knots, knots[1:], knots[2:], strict=False)):
        if before < high and low < after:
            rising = (squared - before) / (knot - before)
            falling = (after - squared) / (after - knot)
            yield index, torch.minimum(rising, falling).clamp(min=0.0)


def remaining_variance(diameter: Tensor, taps: Taps | None = None) -> Tensor:
    """Share of white noise's variance that `DiscBank.blurred` leaves, per pixel of `diameter`.

    The sum of squared weights of the blended kernel,
    ``(1 - t)^2 E_aa + 2 t (1 - t) E_ab + t^2 E_bb`` between discs a and b.

    `taps` are those of a motion behind the discs; `diameter` is (..., H, W) [pixel].
    """
    correlations = disc_correlations()
    products = correlations[..., correlations.shape[-1] // 2, correlations.shape[-1] // 2]
    if taps is not None:
        count = min(int(np.searchsorted(DIAMETERS, float(diameter.max()))) + 1, len(DIAMETERS))
        products, weights = np.zeros_like(products), taps.weights.astype(np.float64)
        _sum_products(correlations[:count], taps.rows, taps.columns, weights, products)
    ends = np.column_stack([products[:-1], products[1:, 0]]).astype(np.float32)
    flat = diameter.detach().float().cpu().reshape(-1)
    out = new_frame(flat)
    fixed = flat.numpy(), KNOTS, ends, out.numpy()
    parallel_ranges(lambda a, b: _evaluate(a, b, *fixed), len(flat), least=_WORTH_A_THREAD)
    return out.reshape(diameter.shape).to(diameter)


@_blend_jit()
def path_energy(taps, diameter, correlations):  # type: ignore[no-untyped-def]
    """`remaining_variance` of one `diameter`, and of `Taps` behind it."""
    squared = min(diameter * diameter, np.float64(KNOTS[-1]))
    index, products = _below(KNOTS, squared), np.zeros((2, 2))
    weights = taps[2].astype(np.float64)
    _sum_products(correlations[index : index + 2], taps[0], taps[1], weights, products)
    share = (squared - KNOTS[index]) / (KNOTS[index + 1] - KNOTS[index])
    both = 2.0 * (1.0 - share) * products[0, 1] + share * products[1, 0]
    return (1.0 - share) ** 2 * products[0, 0] + share * both


@functools.cache
def disc_correlations() -> np.ndarray:
    """(K, 2, R, R) correlations of a disc with itself and with the next; the middle is no shift."""
    discs = [disc_kernel(diameter) for diameter in DIAMETERS]
    size = 2 * len(discs[-1]) - 1
    spectra = np.fft.rfft2([np.pad(disc, (size - len(disc)) // 2) for disc in discs])
    pairs = np.stack([spectra, np.roll(spectra, -1, axis=0)], 1) * spectra[:, None].conj()
    return np.fft.fftshift(np.fft.irfft2(pairs, s=(size, size)), axes=(2, 3))


# Each pixel is interpolated between the two images around its squared diameter: no weight is ever
# stored for a whole frame, and no run of pixels reads an image of which it has no share.
@_blend_jit()
def _square(diameter, scale, largest, out):  # type: ignore[no-untyped-def]
    """Squared diameters of a run of pixels; the least and the most of them."""
    least = most = min((diameter[0] * scale) * (diameter[0] * scale), largest)
    for x in range(len(out)):
        squared = (diameter[x] * scale) * (diameter[x] * scale)
        squared = squared if squared < largest else largest
        out[x] = squared
        least, most = min(least, squared), max(most, squared)
    return least, most


@_blend_jit()
def _below(knots, value):  # type: ignore[no-untyped-def]
    """The last interval between `knots` that begins at `value` or before."""
    index = 0
    while index < len(knots) - 2 and knots[index + 1] <= value:
        index += 1
    return index


@_blend_jit()
def blend_rows(  # type: ignore[no-untyped-def]
    first, last, diameter, scale, knots, images, begin, samples, out
):
    """Rows of `DiscBank.blurred` from `first` to `last`, by `scale` times `diameter` (H, W).

    `images` are the addresses of the image behind the disc at each of `knots`, of so many
    `samples`; `out` (P, H, W) is what begins at the sample `begin` of them.
    """
    planes, height, width = out.shape
    squares, weights = np.empty(_BLENDED, np.float32), np.empty(_BLENDED, np.float32)
    flat, results = diameter.reshape(-1), out.reshape(planes, height * width)
    for start in range(first * width, last * width, _BLENDED):
        end = min(start + _BLENDED, last * width)
        squared, weight = squares[: end - start], weights[: end - start]
        least, most = _square(flat[start:end], scale, knots[-1], squared)
        lowest, highest = _below(knots, least), _below(knots, most) + 1
        for level in range(lowest, highest + 1):
            image = numba.carray(as_pointer(images[level]), (samples,))  # type: ignore[attr-defined, call-arg]
            _weigh(squared, knots, level, weight)
            for plane in range(planes):
                offset = begin + plane * height * width
                part, target = image[offset + start : offset + end], results[plane, start:end]
                if level > lowest:
                    for x in range(len(target)):
                        target[x] += weight[x] * part[x]
                else:
                    for x in range(len(target)):
                        target[x] = weight[x] * part[x]


@_blend_jit()
def _weigh(squared, knots, level, out):  # type: ignore[no-untyped-def]
    """Weight of the image at one of `knots` for each pixel: a hat function."""
    knot = knots[level]
    before = knots[level - 1] if level else np.float32(-1)
    after = knots[level + 1] if level + 1 < len(knots) else knot + _ONE
    up, down = _ONE / (knot - before), _ONE / (after - knot)
    for x in range(len(out)):
        rising, falling = (squared[x] - before) * up, (after - squared[x]) * down
        least = rising if rising < falling else falling
        out[x] = least if least > np.float32(0) else np.float32(0)


@_blend_jit()
def mark_levels(diameter, scale, spread, knots, used):  # type: ignore[no-untyped-def]
    """Marks the images that `scale` times some `diameter` (N,), +- `spread`, has a share of."""
    for x in range(len(diameter)):
        least = max(diameter[x] - spread, np.float32(0)) * scale
        index = _below(knots, min(least * least, knots[-1]))
        used[index] |= least * least < knots[index + 1]
        most = (diameter[x] + spread) * scale
        last = _below(knots, min(most * most, knots[-1]))
        used[last] |= most * most < knots[last + 1]
        used[index + 1 : last + 1] = True
        used[last + 1] |= most * most > knots[last]


@_blend_jit()
def _evaluate(first, last, diameter, knots, ends, out):  # type: ignore[no-untyped-def]
    """Quadratic pieces between `knots`: `ends` (K - 1, 3) are their products."""
    for x in range(first, last):
        squared = min(diameter[x] * diameter[x], knots[-1])
        index = _below(knots, squared)
        share = (squared - knots[index]) / (knots[index + 1] - knots[index])
        rest = _ONE - share
        both = rest * ends[index, 1] + rest * ends[index, 1] + share * ends[index, 2]
        out[x] = rest * rest * ends[index, 0] + share * both


@_blend_jit()
def _sum_products(correlations, rows, columns, weights, products):  # type: ignore[no-untyped-def]
    """Sums (K, 2) of correlations over all pairs of taps, by their products of weights."""
    middle = correlations.shape[2] // 2
    for k in range(len(weights)):
        for n in range(k + 1):  # correlations are even: each pair counts twice
            y, x = rows[k] - rows[n] + middle, columns[k] - columns[n] + middle
            if 0 <= y <= 2 * middle and 0 <= x <= 2 * middle:
                weight = weights[k] * weights[n] * (1.0 if n == k else 2.0)
                for i in range(len(correlations)):
                    for j in range(2):
                        products[i, j] += weight * correlations[i, j, y, x]
