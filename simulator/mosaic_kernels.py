"""A Bayer mosaic to planes and back, in one pass; CPU only, for `simulator.raw_image`.

The two planes of a mosaic row are taken together: their columns alternate, and only whole rows are
vectorised by the compiler.
"""

from __future__ import annotations

import numpy as np

from simulator.jit import kernel


@kernel()
def _split(row, left_black, left_span, right_black, right_span, left, right):  # type: ignore[no-untyped-def]
    for x in range(len(left)):
        left[x] = np.float32((np.float64(row[2 * x]) - left_black) / left_span)
        right[x] = np.float32((np.float64(row[2 * x + 1]) - right_black) / right_span)


@kernel()
def pack_rows(mosaic, tile, black, span, first, planes):  # type: ignore[no-untyped-def]
    """Rows of the planes (4, H, W) float32 from `first` on: ``(mosaic - black) / span``.

    Args:
        mosaic: (2R, 2W or more) digital numbers of those rows.
        tile: (2, 2) plane at each place of the colour filter array.
        black: (4,) float64.
        span: (4,) float64, from black to white.
        first: Row of the planes.
        planes: Written to.
    """
    for y in range(len(mosaic) // 2):
        for row in range(2):
            p, q = tile[row]
            left, right = planes[p, first + y], planes[q, first + y]
            _split(mosaic[2 * y + row], black[p], span[p], black[q], span[q], left, right)


@kernel()
def _weave(left, left_black, left_span, right, right_black, right_span, white, row):  # type: ignore[no-untyped-def]
    zero = np.float32(0)
    for x in range(len(left)):
        a = np.rint(left[x] * left_span + left_black)
        b = np.rint(right[x] * right_span + right_black)
        a, b = a if a > zero else zero, b if b > zero else zero
        row[2 * x] = np.uint16(np.int32(a if a < white else white))
        row[2 * x + 1] = np.uint16(np.int32(b if b < white else white))


@kernel()
def unpack_rows(planes, tile, black, span, white, first, last, mosaic):  # type: ignore[no-untyped-def]
    """The inverse of `pack_rows`, rounded and clipped to [0, white]; in float32, as captures are.

    Args:
        planes: (4, H, W) float32.
        tile: (2, 2) plane at each place of the colour filter array.
        black: (4,) float32.
        span: (4,) float32.
        white: Largest number, float32.
        first: Row of the planes.
        last: Row of the planes.
        mosaic: (2 (last - first), 2W) uint16, written to.
    """
    for y in range(first, last):
        for row in range(2):
            p, q = tile[row]
            left, right, out = planes[p, y], planes[q, y], mosaic[2 * (y - first) + row]
            _weave(left, black[p], span[p], right, black[q], span[q], white, out)


@kernel()
def mark_saturated(planes, limits, first, last, marks):  # type: ignore[no-untyped-def]
    """Rows `first` to `last` of `marks`: whether some plane reaches its limit.

    Args:
        planes: (4, H, W) float32.
        limits: (4,) float32.
        first: Row of the planes.
        last: Row of the planes.
        marks: (H, W) bool, written to.
    """
    r, g1, g2, b = limits
    for y in range(first, last):
        row = marks[y]
        for x in range(len(row)):
            upper = (planes[0, y, x] >= r) | (planes[1, y, x] >= g1)
            row[x] = upper | (planes[2, y, x] >= g2) | (planes[3, y, x] >= b)
