"""Blends of a bank of blurred images on the CPU: twins of those in `simulator.modules.disc_bank`.

Each pixel looks up the two images around its squared diameter and interpolates between them: no
weight is ever stored for a whole frame, and no image is read where it has none.

This module imports numba.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping

import numba
import numpy as np
import torch

from simulator.jit import kernel
from simulator.pointers import addresses, as_pointer
from simulator.raw_image import new_frame
from simulator.threads import in_shares

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
                    one = numba.carray(as_pointer(images[index[x]]), (samples,))  # type: ignore[call-arg]
                    other = numba.carray(as_pointer(images[index[x] + 1]), (samples,))  # type: ignore[call-arg]
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


def needed(diameter: torch.Tensor, knots: np.ndarray) -> list[int]:
    """Indexes of the images that a blend reads, ascending: none far from every pixel's diameter.

    Args:
        diameter: (H, W) float32 on the CPU [pixel].
        knots: (K,) squared diameters of the images, ascending.
    """
    used = np.zeros(len(knots), np.bool_)
    _mark(diameter.contiguous().numpy(), knots.astype(np.float32), used)
    return [int(index) for index in np.flatnonzero(used)]


def blend(
    images: Mapping[int, torch.Tensor], diameter: torch.Tensor, knots: np.ndarray
) -> torch.Tensor:
    """Interpolates between images in the squared diameter; see `DiscBank.blurred`.

    Args:
        images: (..., H, W) float32 on the CPU, by index, as many as are `needed`.
        diameter: (H, W) float32 [pixel].
        knots: (K,) squared diameters of the images, ascending.
    """
    kept = {index: image.contiguous() for index, image in images.items()}
    anything = next(iter(kept.values()))  # what has no share is read, too, times 0
    table = addresses([kept.get(index, anything) for index in range(len(knots))])
    out = new_frame(anything)
    fixed = (diameter.contiguous().numpy(), knots.astype(np.float32), table, out.numel())
    result = out.numpy().reshape(-1, *out.shape[-2:])
    in_shares(
        lambda first, last: _blend(first, last, *fixed, result),
        out.shape[-2],
        least=1 + _WORTH_A_THREAD // out.shape[-1],
    )
    return out


def piecewise(diameter: torch.Tensor, knots: np.ndarray, products: np.ndarray) -> torch.Tensor:
    """Sum of squared weights of blended kernels; see `remaining_variance`.

    Args:
        diameter: (H, W) float32 on the CPU [pixel].
        knots: (K,) squared diameters of the kernels, ascending.
        products: (K, K) sums of products of the weights of each kernel and itself or its successor.

    Returns:
        (H, W) float32.
    """
    ends = np.stack([products.diagonal()[:-1], products.diagonal(1), products.diagonal()[1:]], 1)
    out = torch.empty(diameter.shape)
    fixed = (diameter.contiguous().numpy(), knots.astype(np.float32), ends.astype(np.float32))
    in_shares(
        lambda first, last: _evaluate(first, last, *fixed, out.numpy()),
        len(diameter),
        least=1 + _WORTH_A_THREAD // diameter.shape[1],
    )
    return out
