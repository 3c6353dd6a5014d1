"""Sums over pixels, and over bins of pixels, for `simulator.light_statistics`; CPU only.

This module imports numba.
"""

from __future__ import annotations

import numpy as np

from simulator.jit import kernel


@kernel()
def _find(values, limits, places):  # type: ignore[no-untyped-def]
    """Number of `limits` that each value reaches; they are a full tree, ascending.

    Values come in any order: a branch would be mispredicted half of the time.
    """
    places[:] = 0
    step = (len(limits) + 1) // 2
    while step:
        for x in range(len(values)):
            reached = values[x] >= limits[places[x] + np.uint32(step - 1)]
            places[x] += np.uint32(step) * np.uint32(reached)
        step //= 2


@kernel()
def accumulate(first, last, light, rows, edges, sums, levels):  # type: ignore[no-untyped-def]
    """Adds each pixel of some rows to the bin of its light.

    Args:
        first, last: Planes that are looked at, `last` exclusive.
        light: (P, H, W) float32; borders are replicated.
        rows: (R,) int64 of the rows.
        edges: (P, B - 1) float32, ascending: from which light on a pixel belongs to the next bin.
        sums: (4, P, B) float64 that are added to: number, light of at least 0, square of the
            Laplacian, square of the second difference along the row.
        levels: (2, P, B) float64: least and most light, at least 0.
    """
    _, height, width = light.shape
    half = 1
    while 2 * half <= edges.shape[1]:
        half *= 2
    limits = np.empty(2 * half - 1, np.float32)
    places = np.empty(width, np.uint32)
    bins = np.empty((2 * half, 6))
    for plane in range(first, last):
        limits[:] = np.inf
        limits[: edges.shape[1]] = edges[plane]
        bins[:] = 0.0  # what is known of a bin lies together
        bins[:, 4] = np.inf
        for y in rows:
            centre = light[plane, y]
            above, below = light[plane, max(y - 1, 0)], light[plane, min(y + 1, height - 1)]
            _find(centre, limits, places)
            for x in range(width):
                value = centre[x]
                found = bins[places[x]]
                twice = 2.0 * np.float64(value)
                left, right = centre[max(x - 1, 0)], centre[min(x + 1, width - 1)]
                along = np.float64(left) + np.float64(right) - twice
                across = np.float64(above[x]) + np.float64(below[x]) - twice
                level = max(np.float64(value), 0.0)
                found[0] += 1.0
                found[1] += level
                found[2] += (along + across) ** 2
                found[3] += along * along
                found[4] = min(found[4], level)
                found[5] = max(found[5], level)
        for place in range(sums.shape[2]):
            for kind in range(4):
                sums[kind, plane, place] += bins[place, kind]
            levels[0, plane, place] = min(levels[0, plane, place], bins[place, 4])
            levels[1, plane, place] = max(levels[1, plane, place], bins[place, 5])


_SUMS = {"reassoc", "nnan", "nsz", "contract"}


@kernel(fastmath=_SUMS, boundscheck=False)
def excess(share, edges, ratio, source, target, floor):  # type: ignore[no-untyped-def]
    """`simulator.light_statistics.LightStatistics.excess` of bins.

    Args:
        share: (P, B) share of all pixels.
        edges: (2, P, B) least and most light.
        ratio: Exposure ratio.
        source: (2, P) shot and read noise of the light.
        target: (2, P) shot and read noise that are wanted.
        floor: Least variance that counts as noise.
    """
    total = 0.0
    for plane in range(share.shape[0]):
        source_shot, source_read = (
            source[0, plane] * ratio * ratio,
            source[1, plane] * ratio * ratio,
        )
        shot, read = target[0, plane] * ratio, target[1, plane]
        for edge in range(2):
            light, shares = edges[edge, plane], share[plane]
            for place in range(len(shares)):
                wanted = read + shot * light[place]
                given = source_read + source_shot * light[place]
                beyond = np.sqrt(given / (wanted if wanted > floor else floor)) - 1.0
                beyond = beyond if beyond > 0.0 else 0.0
                total += shares[place] * beyond * beyond
    return np.sqrt(total / 2.0)


@kernel(fastmath=_SUMS, boundscheck=False)
def curvature(share, light, disc, row, ratio, target, floor):  # type: ignore[no-untyped-def]
    """Root mean squares over bins of second differences in units of a target's noise.

    Args:
        share: (P, B) share of all pixels.
        light: (P, B) level that stands for the bin.
        disc, row: (P, B) mean squares of the Laplacian and of the second difference along a row.
        ratio: Exposure ratio.
        target: (2, P) shot and read noise that are wanted.
        floor: Least variance that counts as noise.
    """
    discs, rows = 0.0, 0.0
    for plane in range(share.shape[0]):
        shot, read = target[0, plane], target[1, plane]
        for place in range(share.shape[1]):
            wanted = read + shot * ratio * light[plane, place]
            wanted = wanted if wanted > floor else floor
            # What the mean moves by, and with it the deviation of shot noise.
            weight = share[plane, place] * (1.0 + shot * shot / wanted) / wanted
            discs += weight * disc[plane, place]
            rows += weight * row[plane, place]
    return np.sqrt(discs), np.sqrt(rows)
