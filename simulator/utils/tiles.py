"""Large frames through a network in tiles: the same pixels in bounded memory.

Where a network is needed for some pixels only, the tiles shrink to those: the frame is halved again
and again, and a half without such a pixel costs nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import EllipsisType

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from simulator.utils.compute import release_memory

#: Side of a tile without its halo [pixel]: larger tiles waste less on halos and take more memory.
TILE = 768
#: Side of the cells in which pixels count as needed or varying, a multiple of 4 [pixel].
_CELL = 16

_Index = tuple[EllipsisType, slice, slice]


@dataclass(frozen=True)
class Tile:
    """A rectangle of a frame, and the halo that a network must see around it [pixel].

    `bottom` and `right` are after the last row and column, `height` and `width` are the frame's.
    """

    top: int
    bottom: int
    left: int
    right: int
    height: int
    width: int
    halo: int

    @property
    def _sides(self) -> tuple[tuple[int, int, int], ...]:
        return (self.top, self.bottom, self.height), (self.left, self.right, self.width)

    @property
    def inner(self) -> _Index:
        """Index of the rectangle in the frame."""
        rows, columns = (slice(first, last) for first, last, _ in self._sides)
        return ..., rows, columns

    @property
    def outer(self) -> _Index:
        """Index of the rectangle and its halo in the frame."""
        rows, columns = (
            slice(max(first - self.halo, 0), min(last + self.halo, size))
            for first, last, size in self._sides
        )
        return ..., rows, columns

    @property
    def core(self) -> _Index:
        """Index of the rectangle in the part that `outer` cuts out."""
        rows, columns = (
            slice(min(first, self.halo), min(first, self.halo) + last - first)
            for first, last, _ in self._sides
        )
        return ..., rows, columns

    @property
    def area(self) -> int:
        """Pixels including the halo: the cost of the tile."""
        _, rows, columns = self.outer
        return int((rows.stop - rows.start) * (columns.stop - columns.start))


def make_tiles(
    height: int, width: int, *, halo: int, tile: int = TILE, needed: Tensor | None = None
) -> list[Tile]:
    """Tiles that cover a frame, or its `needed` pixels (H, W), at little cost.

    `halo` and `tile`, the largest side, are multiples of 4 [pixel]; a frame that is no larger than
    one tile and a halo is one tile.
    """
    if height <= tile + halo and width <= tile + halo:
        tile = 4 * ((max(height, width) + 3) // 4)
    tiles = []
    for top in range(0, height, tile):
        for left in range(0, width, tile):
            bottom, right = min(top + tile, height), min(left + tile, width)
            whole = Tile(top, bottom, left, right, height, width, halo)
            tiles += [whole] if needed is None else _shrunk(whole, needed)
    return tiles


def _shrunk(tile: Tile, needed: Tensor) -> list[Tile]:
    """The cheapest halving of `tile` that covers its needed pixels."""
    part = needed[tile.inner][None].float()
    cells = F.max_pool2d(part, _CELL, ceil_mode=True)[0].bool().cpu().numpy()

    def made(rows: tuple[int, int], columns: tuple[int, int]) -> Tile:
        return replace(
            tile,
            top=tile.top + _CELL * rows[0],
            bottom=min(tile.top + _CELL * rows[1], tile.bottom),
            left=tile.left + _CELL * columns[0],
            right=min(tile.left + _CELL * columns[1], tile.right),
        )

    def cover(row: int, column: int, cells: np.ndarray) -> list[Tile]:
        rows, columns = (np.flatnonzero(cells.any(axis)) for axis in (1, 0))
        if len(rows) == 0:
            return []
        cells = cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        row, column = row + int(rows[0]), column + int(columns[0])
        whole = made((row, row + cells.shape[0]), (column, column + cells.shape[1]))
        axis = int(cells.shape[1] > cells.shape[0])
        half = cells.shape[axis] // 2
        if half == 0 or cells.all():
            return [whole]
        first, second = np.split(cells, [half], axis)
        next_row, next_column = (row, column + half) if axis else (row + half, column)
        parts = cover(row, column, first) + cover(next_row, next_column, second)
        return parts if sum(p.area for p in parts) < whole.area else [whole]

    return cover(0, 0, cells)


def varying(image: Tensor, margin: int = 0) -> Tensor:
    """(H, W) bool: where `image` (C, H, W) is not constant, in cells of 16 x 16 pixels.

    Constant parts carry neither noise nor detail. `margin`, a multiple of 16, is how many pixels
    around varying cells also count.
    """
    height, width = image.shape[-2:]
    high = F.max_pool2d(image, _CELL, ceil_mode=True)
    low = -F.max_pool2d(-image, _CELL, ceil_mode=True)
    cells = (high > low).any(dim=0, keepdim=True).float()
    if height % _CELL == width % _CELL == 1:  # a cell of one pixel cannot show that it varies
        cells[..., -1, -1] = 1.0
    reach = margin // _CELL
    cells = F.max_pool2d(cells, 2 * reach + 1, stride=1, padding=reach)[0].bool()
    cells = cells.repeat_interleave(_CELL, 0).repeat_interleave(_CELL, 1)
    return cells[:height, :width]


def in_tiles(
    function: Callable[..., Tensor],
    *images: Tensor,
    halo: int,
    tile: int = TILE,
    needed: Tensor | None = None,
    fallback: Tensor | None = None,
) -> Tensor:
    """Apply `function` to `images` tile by tile, where it is needed.

    It maps images (B, C, h, w) of one size to one (B, D, h, w) or (B, h, w); an output pixel may
    depend on input pixels at most `halo` away and on position only modulo 4. `needed` (H, W) are
    the pixels that need the function, by default all; `fallback` has the values of all others.
    """
    height, width = images[0].shape[-2:]
    tiles = make_tiles(height, width, halo=halo, tile=tile, needed=needed)
    if needed is not None and bool(needed.all()):
        needed = None
    if needed is None and len(tiles) == 1:
        return function(*images)
    output = None if needed is None or fallback is None else fallback.clone()
    for each in tiles:
        part = function(*(image[each.outer] for image in images))[each.core]
        if output is None:
            output = part.new_empty((*part.shape[:-2], height, width))
        if needed is not None:
            part = torch.where(needed[each.inner], part, output[each.inner])
        output[each.inner] = part
    release_memory(height * width)
    assert output is not None
    return output
