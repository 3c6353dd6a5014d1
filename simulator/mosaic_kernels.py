"""A Bayer mosaic to planes and back, in one pass; CPU only, for `simulator.raw_image`."""

from __future__ import annotations

import numpy as np

from simulator.jit import kernel


@kernel()
def pack_rows(mosaic, offsets, black, span, first, last, planes):  # type: ignore[no-untyped-def]
    """Rows `first` to `last` of the planes (4, H, W) float32: ``(mosaic - black) / span``.

    Args:
        mosaic: (2H, 2W) digital numbers.
        offsets: (4, 2) row and column of each plane in the tile.
        black: (4,) float64.
        span: (4,) float64, from black to white.
        first: Row of the planes.
        last: Row of the planes.
        planes: Written to.
    """
    for y in range(first, last):
        for plane in range(4):
            row, column = mosaic[2 * y + offsets[plane, 0]], offsets[plane, 1]
            level, scale = black[plane], span[plane]
            out = planes[plane, y]
            for x in range(len(out)):
                out[x] = np.float32((np.float64(row[2 * x + column]) - level) / scale)


@kernel()
def unpack_rows(planes, offsets, black, span, white, first, last, mosaic):  # type: ignore[no-untyped-def]
    """The inverse of `pack_rows`, rounded and clipped to [0, white]; in float32, as captures are.

    Args:
        planes: (4, H, W) float32.
        offsets: (4, 2) row and column of each plane in the tile.
        black: (4,) float32.
        span: (4,) float32.
        white: Largest number, float32.
        first: Row of the planes.
        last: Row of the planes.
        mosaic: (2H, 2W) uint16, written to.
    """
    zero = np.float32(0)
    for y in range(first, last):
        for plane in range(4):
            row, column = mosaic[2 * y + offsets[plane, 0]], offsets[plane, 1]
            level, scale = black[plane], span[plane]
            numbers = planes[plane, y]
            for x in range(len(numbers)):
                value = np.rint(numbers[x] * scale + level)
                value = value if value > zero else zero
                row[2 * x + column] = np.uint16(np.int32(value if value < white else white))
