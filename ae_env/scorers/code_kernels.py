"""Kernels of `ae_env.scorers.code_terms`: means of a frame's codes, and their expectations."""

from __future__ import annotations

import math

import numba
import numpy as np
from scipy.special import ndtr

from ae_env.observation import PEDESTAL
from simulator.utils.compute import as_pointer, kernel

#: Expectations are tabulated at this many values between two codes.
FINE = 8
#: Distance at which noise no longer matters, in its standard deviations.
FAR = 4.5
_ZERO, _ONE = np.float32(0), np.float32(1)
#: The normal distribution up to there, and its values in a standard deviation.
_PER_DEVIATION = 128
_NORMAL = ndtr(np.arange(-FAR * _PER_DEVIATION, FAR * _PER_DEVIATION + 1) / _PER_DEVIATION)
_PEDESTAL = np.float32(PEDESTAL)
_SCALE = np.float32(255.0 * FINE / math.sqrt(1.0 + PEDESTAL))
_BLOCK = 256
_jit = kernel(fastmath={"nsz", "contract", "reassoc"}, boundscheck=False)


@_jit
def measure_codes(  # type: ignore[no-untyped-def]
    first, last, codes, shares, which, dark, means
):
    """Means of the frames `first` to `last`.

    Args:
        first: First frame.
        last: One past the last.
        codes: (B, 4, N) uint8.
        shares: (K, 4, 256) float32, what a sample of each code adds to `noise`.
        which: (B,) which of them each frame has.
        dark: (256,) float32, what a sample of each code adds to the share of blocked ones.
        means: (B, 3) float64 to write to.
    """
    size = codes.shape[2]
    # Four histograms: a sample need not wait for that of the sample before.
    counts = np.empty((4, 256), np.int32)
    whole = size // 4 * 4
    for frame in range(first, last):
        blown, planes, blocked, clean = 0, 0, 0.0, 0.0
        for plane in range(4):
            samples = codes[frame, plane]
            counts[:] = 0
            for i in range(0, whole, 4):
                counts[0, samples[i]] += 1
                counts[1, samples[i + 1]] += 1
                counts[2, samples[i + 2]] += 1
                counts[3, samples[i + 3]] += 1
            for i in range(whole, size):
                counts[0, samples[i]] += 1
            for code in range(256):
                count = counts[0, code] + counts[1, code] + counts[2, code] + counts[3, code]
                blocked += count * np.float64(dark[code])
                clean += count * np.float64(shares[which[frame], plane, code])
            white = counts[0, 255] + counts[1, 255] + counts[2, 255] + counts[3, 255]
            blown, planes = blown + white, planes + (white > 0)
        if planes > 1:  # else no pixel was counted twice
            blown = 0
            red, green, other, blue = codes[frame]
            for i in range(size):
                brightest = max(max(red[i], green[i]), max(other[i], blue[i]))
                blown += brightest == 255
        means[frame, 0] = blown / size
        means[frame, 1] = blocked / (4 * size)
        means[frame, 2] = clean / (4 * size)


@_jit
def _normal_above(z):  # type: ignore[no-untyped-def]
    """Share of standard normals above -z, |z| <= `FAR`, within 1e-5."""
    place = (z + FAR) * _PER_DEVIATION
    index = min(int(place), len(_NORMAL) - 2)
    return _NORMAL[index] + (place - index) * (_NORMAL[index + 1] - _NORMAL[index])


@_jit
def expect_codes(dark, clean, edges, shot, read, out):  # type: ignore[no-untyped-def]
    """Expectations of functions of the code that noisy light is recorded as.

    Args:
        dark: (256,) float32 by code, the first function.
        clean: (256,) float32, the second.
        edges: (256,) signals from which each code is recorded, or one above.
        shot: Shot noise that is added.
        read: Read noise that is added.
        out: (3, G) float32 to write to, at `FINE` values of light between two codes: the
            probability of the last code, and both expectations.
    """
    unit, start, last, count = (1.0 + PEDESTAL) / 255.0**2, 0, 0, out.shape[1]
    i = 0
    while True:
        light = unit * (i / FINE) ** 2 - PEDESTAL
        spread = math.sqrt(max(max(light, 0.0) * shot + read, 1e-30))
        lowest, highest = light - FAR * spread, light + FAR * spread
        while start > 0 and edges[start] > lowest:
            start -= 1
        while start < 255 and edges[start + 1] <= lowest:
            start += 1
        code, by_spread = start, 1.0 / spread
        blocked, noise, above = dark[code], clean[code], np.float64(code == 255)
        while code < 255 and edges[code + 1] <= highest:
            code += 1
            above = _normal_above((light - edges[code]) * by_spread)
            blocked += above * (dark[code] - dark[code - 1])
            noise += above * (clean[code] - clean[code - 1])
        out[0, i] = above if code == 255 else 0.0
        out[1, i], out[2, i] = blocked, noise
        for f in range(3):  # a straight line from the last one
            for j in range(last + 1, i):
                share = (j - last) / (i - last)
                out[f, j] = out[f, last] + share * (out[f, i] - out[f, last])
        if i == count - 1:
            return
        # Steps of a quarter of a standard deviation: wide noise leaves nothing fine.
        step = math.sqrt((light + 0.25 * spread + PEDESTAL) / unit) * FINE
        last, i = i, min(max(i + 1, int(step)), count - 1)


@_jit
def _interpolated(table, places, shares):  # type: ignore[no-untyped-def]
    """Sum of a function between `places` and the next ones."""
    total = _ZERO
    for i in range(len(places)):
        low, high = table[places[i]], table[places[i] + 1]
        total += low + shares[i] * (high - low)
    return total


@_jit
def expect_means(  # type: ignore[no-untyped-def]
    first, last, light, rows, columns, ratio, row_gain, grid, tables, means
):
    """Expected means of the frames `first` to `last`.

    Args:
        first: First frame.
        last: One past the last.
        light: (B,) addresses of (4, R, C) float32.
        rows: R; 1 where all rows have the same gain.
        columns: C.
        ratio: (B, 4) float32, what the light is multiplied by.
        row_gain: (B, R) float32.
        grid: G.
        tables: (B,) addresses of (4, 3, G) float32 of `expect_codes`.
        means: (B, 3) float64 to write to.
    """
    kept, shares = np.empty((2, _BLOCK), np.float32)
    places = np.empty(_BLOCK, np.int32)
    size, end_of_grid = rows * columns, np.float32(grid - 1.001)
    for frame in range(first, last):
        pointer = as_pointer(light[frame])  # type: ignore[call-arg, var-annotated]
        signal = numba.carray(pointer, (4, size))
        own = numba.carray(as_pointer(tables[frame]), (4, 3, grid))
        blown = blocked = clean = 0.0
        for row in range(rows):
            gain = row_gain[frame, row]
            for start in range(row * columns, (row + 1) * columns, _BLOCK):
                end = min(start + _BLOCK, (row + 1) * columns)
                number = end - start
                kept[:number] = _ONE
                for plane in range(4):
                    factor, part = ratio[frame, plane] * gain, signal[plane, start:end]
                    brightest = np.int32(0)
                    for i in range(number):
                        x = part[i] * factor + _PEDESTAL
                        place = min(np.sqrt(x if x > _ZERO else _ZERO) * _SCALE, end_of_grid)
                        places[i] = np.int32(place)
                        shares[i] = place - np.float32(places[i])
                        brightest = max(brightest, places[i])
                    table = own[plane]
                    blocked += _interpolated(table[1], places[:number], shares)
                    clean += _interpolated(table[2], places[:number], shares)
                    if table[0, brightest + 1] > _ZERO:
                        for i in range(number):
                            low, high = table[0, places[i]], table[0, places[i] + 1]
                            kept[i] *= _ONE - (low + shares[i] * (high - low))
                left = _ZERO
                for i in range(number):
                    left += kept[i]
                blown += number - left
        means[frame, 0] = blown / size
        means[frame, 1] = blocked / (4 * size)
        means[frame, 2] = clean / (4 * size)
