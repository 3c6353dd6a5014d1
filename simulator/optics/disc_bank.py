"""Defocus that varies from pixel to pixel, as a blend of a few uniform disc blurs.

Blurring once with every disc of a bank and interpolating between neighbours, per pixel and in the
*squared* diameter (second moments add, so that is where blur is linear), makes any map of blur
diameters and any f-number for the cost of a gather.

This module imports numba.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping

import numba
import numpy as np
import torch
from scipy.signal import fftconvolve
from torch import Tensor

from simulator.optics.blur import Blur, blur_many, disc_blur, disc_kernel
from simulator.optics.motion_path import Taps
from simulator.raw.image import new_frame
from simulator.utils.compute import addresses, as_pointer, kernel, parallel_ranges

#: Diameters of the bank [pixel]: each doubles the blurred area, the step at which a blend of two
#: discs is within 2 % of the disc between them.
DIAMETERS = (0.0, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.3, 16.0, 22.6, 32.0)

_KNOTS = np.array(DIAMETERS) ** 2

#: How far the largest disc reaches, as a multiple of 4 [pixel].
HALO = 20


def added_blur(diameter: Tensor, f_source: Tensor | float, f_target: Tensor | float) -> Tensor:
    """Diameter of the disc that turns the blur at `f_source` into that at `f_target` [pixel].

    The circle of confusion grows with 1 / N and squared diameters add: the difference of squares,
    ``c^2 ((N_1 / N_2)^2 - 1)``, 0 where the aperture closes.
    """
    ratio = torch.as_tensor(f_source) / torch.as_tensor(f_target)
    return diameter * (ratio.square() - 1.0).clamp(min=0.0).sqrt().to(diameter)


class DiscBank:
    """An image behind every disc of the bank; each blur is computed when it is first needed.

    Args:
        image: (..., H, W) linear light. No gradient flows into it.
    """

    def __init__(self, image: Tensor) -> None:
        self._levels = {0: image.detach()}

    def level(self, index: int) -> Tensor:
        """The image behind disc `index` of `DIAMETERS`."""
        if index not in self._levels:
            self._levels[index] = disc_blur(self._levels[0], DIAMETERS[index])
        return self._levels[index]

    def blurred(self, diameter: Tensor, out: Tensor | None = None) -> Tensor:
        """The image blurred by `diameter`, differentiable in it.

        Args:
            diameter: (..., H, W) blur diameter of each pixel [pixel], >= 0, broadcast against the
                image; beyond the largest disc of the bank it stays there.
            out: Contiguous float32 tensor like the image to write to, instead of a new one, where
                image and diameters are on the CPU.
        """
        image, frame = self._levels[0], _frame_of(diameter)
        if frame is not None and frame.shape == image.shape[-2:] and _has_kernels(image):
            indices = needed(frame)
            light = image.contiguous()
            made = {i: torch.empty_like(light) for i in indices if i not in self._levels}
            # Several levels side by side wake the other threads once.
            blur_many([Blur(light, DIAMETERS[index], level) for index, level in made.items()])
            self._levels |= made
            return blend({index: self._levels[index] for index in indices}, frame, out)
        return self._blended(diameter.square().clamp(max=DIAMETERS[-1] ** 2))

    def _blended(self, squared: Tensor) -> Tensor:
        """`blurred` on any device, by squared diameter."""
        total: Tensor | None = None
        for index, weight in _weights(squared):
            term = self.level(index) * weight
            total = term if total is None else total + term
        assert total is not None
        return total


def remaining_variance(diameter: Tensor, taps: Taps | None = None) -> Tensor:
    """Share of white noise's variance that `DiscBank.blurred` leaves, per pixel of `diameter`.

    The sum of squared weights of the blended kernel,
    ``(1 - t)^2 E_aa + 2 t (1 - t) E_ab + t^2 E_bb`` between discs a and b.

    Args:
        diameter: (..., H, W) blur diameter of each pixel [pixel].
        taps: Of a motion behind the discs; None for none.
    """
    products = _kernel_products() if taps is None else _moved_products(taps, diameter)
    ends = np.stack([products.diagonal()[:-1], products.diagonal(1), products.diagonal()[1:]], 1)
    frame = diameter.detach().float().cpu().reshape(-1, *diameter.shape[-1:] or (1,))
    out = torch.empty(frame.shape)
    fixed = (frame.contiguous().numpy(), _KNOTS.astype(np.float32), ends.astype(np.float32))
    parallel_ranges(
        lambda first, last: _evaluate(first, last, *fixed, out.numpy()),
        len(frame),
        least=1 + _WORTH_A_THREAD // frame.shape[1],
    )
    return out.reshape(diameter.shape).to(diameter)


def _has_kernels(image: Tensor) -> bool:
    return image.device.type == "cpu" and image.dtype == torch.float32


def _frame_of(diameter: Tensor) -> Tensor | None:
    """The diameters as one frame (H, W) that the kernels take; None if they are not.

    Nothing is learnt through the kernels: a gradient takes the other way.
    """
    learns = diameter.requires_grad and torch.is_grad_enabled()
    if learns or not _has_kernels(diameter) or diameter.ndim < 2 or diameter.numel() == 0:
        return None
    frame = diameter.detach()
    if frame.numel() != frame.shape[-2] * frame.shape[-1]:
        return None
    return frame.reshape(frame.shape[-2:])


def _weights(squared: Tensor) -> Iterator[tuple[int, Tensor]]:
    """(index, weight) of every disc that some pixel needs: hat functions of squared diameter."""
    knots = _KNOTS.tolist()
    low, high = (float(v) for v in torch.aminmax(squared.detach()))
    for index, knot in enumerate(knots):
        before = knots[index - 1] if index else -1.0
        after = knots[index + 1] if index + 1 < len(knots) else knot + 1.0
        if before < high and low < after and not (high <= before or low >= after):
            rising = (squared - before) / (knot - before)
            falling = (after - squared) / (after - knot)
            yield index, torch.minimum(rising, falling).clamp(min=0.0)


@functools.cache
def _kernel_products() -> np.ndarray:
    """(K, K) sums of products of the weights of each disc and itself or its successor."""
    kernels = [disc_kernel(d) for d in DIAMETERS]
    products = np.zeros((len(kernels), len(kernels)))
    for i, disc in enumerate(kernels):
        products[i, i] = (disc**2).sum()
        if i + 1 < len(kernels):
            larger = kernels[i + 1]
            margin = (larger.shape[0] - disc.shape[0]) // 2
            inner = larger[margin : margin + disc.shape[0], margin : margin + disc.shape[0]]
            products[i, i + 1] = (disc * inner).sum()
    return products


@functools.cache
def _correlations() -> np.ndarray:
    """(K, 2, R, R) correlations of a disc with itself and its successor; the middle is no shift."""
    kernels = [disc_kernel(d) for d in DIAMETERS]
    size = 2 * kernels[-1].shape[0] - 1
    found = np.zeros((len(kernels), 2, size, size))
    for i, disc in enumerate(kernels):
        for j, other in enumerate(kernels[i : i + 2]):
            # Discs are symmetric: their convolution is their correlation.
            both = fftconvolve(disc, other)
            margin = (size - len(both)) // 2
            inner = slice(margin, margin + len(both))
            found[i, j, inner, inner] = both
    return found


def _moved_products(taps: Taps, diameter: Tensor) -> np.ndarray:
    """`_kernel_products` of discs behind which there is a motion, up to the largest `diameter`."""
    largest = float(diameter.max())
    count = min(int(np.searchsorted(DIAMETERS, largest)) + 1, len(DIAMETERS))
    products = np.zeros((len(DIAMETERS), len(DIAMETERS)))
    weights = taps.weights.astype(np.float64)
    _sum_products(_correlations()[:count], taps.rows, taps.columns, weights, products)
    return products


# -- kernels of the blends on the CPU ---------------------------------------------------------
#
# Each pixel looks up the two images around its squared diameter and interpolates between them: no
# weight is ever stored for a whole frame, and no image is read where it has none.

#: Pixels from which another thread is worth waking.
_WORTH_A_THREAD = 2**12
#: Pixels of a row that are blended together.
_GROUP = 128
_ONE = np.float32(1)
_jit = functools.partial(kernel, fastmath={"contract", "nnan", "nsz"})


@_jit()
def _square(diameter, largest, out):  # type: ignore[no-untyped-def]
    for x in range(len(out)):
        squared = diameter[x] * diameter[x]
        out[x] = squared if squared < largest else largest


@_jit()
def _extremes(values):  # type: ignore[no-untyped-def]
    low = high = values[0]
    for x in range(len(values)):
        low = values[x] if values[x] < low else low
        high = values[x] if values[x] > high else high
    return low, high


@_jit()
def _below(knots, value):  # type: ignore[no-untyped-def]
    """The last interval between `knots` that begins at `value` or before."""
    index = 0
    while index < len(knots) - 2 and knots[index + 1] <= value:
        index += 1
    return index


@_jit()
def _place(squared, knots, index, share):  # type: ignore[no-untyped-def]
    """In which interval between `knots` each value is, and how far in it from 0 to 1."""
    index[:] = 0
    for knot in knots[1:-1]:
        for x in range(len(index)):
            index[x] += np.int32(squared[x] >= knot)
    for x in range(len(index)):
        low, high = knots[index[x]], knots[index[x] + 1]
        share[x] = (squared[x] - low) / (high - low)


@_jit()
def _blend(first, last, diameter, knots, images, samples, out):  # type: ignore[no-untyped-def]
    """Rows from `first` to `last`; `images` are the addresses of (P, H, W)."""
    planes, height, width = out.shape
    squares, shares = np.empty(_GROUP, np.float32), np.empty(_GROUP, np.float32)
    indexes = np.empty(_GROUP, np.int32)
    for y in range(first, last):
        for start in range(0, width, _GROUP):
            end = min(start + _GROUP, width)
            size = end - start
            squared, index, share = squares[:size], indexes[:size], shares[:size]
            _square(diameter[y, start:end], knots[-1], squared)
            _place(squared, knots, index, share)
            for plane in range(planes):
                target = out[plane, y, start:end]
                offset = (plane * height + y) * width + start
                for x in range(size):
                    pointer = as_pointer(images[index[x]])  # type: ignore[call-arg, var-annotated]
                    one = numba.carray(pointer, (samples,))
                    other = numba.carray(as_pointer(images[index[x] + 1]), (samples,))
                    least = (_ONE - share[x]) * one[np.uint64(offset + x)]
                    target[x] = least + share[x] * other[np.uint64(offset + x)]


@_jit()
def _mark(diameter, knots, used):  # type: ignore[no-untyped-def]
    """Marks the images around the diameters of each group of pixels."""
    width = diameter.shape[1]
    squares = np.empty(_GROUP, np.float32)
    for y in range(len(diameter)):
        for start in range(0, width, _GROUP):
            end = min(start + _GROUP, width)
            squared = squares[: end - start]
            _square(diameter[y, start:end], knots[-1], squared)
            low, high = _extremes(squared)
            stop = _below(knots, high)
            used[_below(knots, low) + (low == knots[-1]) : stop + 1] = True
            used[stop + 1] |= high > knots[stop]


@_jit()
def _evaluate(first, last, diameter, knots, ends, out):  # type: ignore[no-untyped-def]
    """Quadratic pieces between `knots`: `ends` (K - 1, 3) are their products."""
    for y in range(first, last):
        for x in range(diameter.shape[1]):
            squared = min(diameter[y, x] * diameter[y, x], knots[-1])
            index = _below(knots, squared)
            share = (squared - knots[index]) / (knots[index + 1] - knots[index])
            rest = _ONE - share
            both = rest * ends[index, 1] + rest * ends[index, 1] + share * ends[index, 2]
            out[y, x] = rest * rest * ends[index, 0] + share * both


@_jit()
def _sum_products(correlations, rows, columns, weights, products):  # type: ignore[no-untyped-def]
    """Sums of correlations over all pairs of taps, by their products of weights."""
    count, _, size, _ = correlations.shape
    middle = size // 2
    for k in range(len(weights)):
        for n in range(len(weights)):
            y, x = rows[k] - rows[n] + middle, columns[k] - columns[n] + middle
            if 0 <= y < size and 0 <= x < size:
                for i in range(count):
                    both = weights[k] * weights[n]
                    products[i, i] += both * correlations[i, 0, y, x]
                    if i + 1 < len(products):
                        products[i, i + 1] += both * correlations[i, 1, y, x]


def needed(diameter: Tensor) -> list[int]:
    """Indexes of the images that a blend by `diameter` (H, W) reads, ascending."""
    used = np.zeros(len(_KNOTS), np.bool_)
    _mark(diameter.contiguous().numpy(), _KNOTS.astype(np.float32), used)
    return [int(index) for index in np.flatnonzero(used)]


def blend(images: Mapping[int, Tensor], diameter: Tensor, out: Tensor | None = None) -> Tensor:
    """Interpolates between images in the squared diameter; see `DiscBank.blurred`.

    Args:
        images: (..., H, W) float32 on the CPU, by index, as many as are `needed`.
        diameter: (H, W) float32 [pixel].
        out: See `DiscBank.blurred`.
    """
    whole = {index: image.contiguous() for index, image in images.items()}
    anything = next(iter(whole.values()))  # images without a share are read too, times 0
    table = addresses([whole.get(index, anything) for index in range(len(_KNOTS))])
    out = new_frame(anything) if out is None else out
    fixed = (diameter.contiguous().numpy(), _KNOTS.astype(np.float32), table, out.numel())
    result = out.numpy().reshape(-1, *out.shape[-2:])
    parallel_ranges(
        lambda first, last: _blend(first, last, *fixed, result),
        out.shape[-2],
        least=1 + _WORTH_A_THREAD // out.shape[-1],
    )
    return out
