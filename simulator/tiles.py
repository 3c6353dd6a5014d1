"""Large frames through a network in tiles, exact to the last pixel, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

#: Side of a tile without its halo [pixel].
TILE = 512


def in_tiles(
    function: Callable[..., Tensor], *images: Tensor, halo: int, tile: int = TILE
) -> Tensor:
    """`function` of `images`, tile by tile.

    Args:
        function: Maps images (B, C, h, w) to one (B, D, h, w) or (B, h, w); an output pixel may
            depend on input pixels at most `halo` away and on position only modulo 4.
        *images: (B, C, H, W), all of one size.
        halo: Multiple of 4 [pixel].
        tile: Side of a tile, a multiple of 4 [pixel].

    Returns:
        What `function` gives on the whole images.

    Raises:
        ValueError: If `halo` or `tile` is no multiple of 4.
    """
    if halo % 4 or tile % 4 or tile < 4:
        raise ValueError(f"`halo` (={halo}) and `tile` (={tile}) must be multiples of 4")
    height, width = images[0].shape[-2:]
    if height <= tile + halo and width <= tile + halo:
        return function(*images)
    output: Tensor | None = None
    for top in range(0, height, tile):
        for left in range(0, width, tile):
            bottom, right = min(top + tile, height), min(left + tile, width)
            first_row, first_column = max(top - halo, 0), max(left - halo, 0)
            rows = slice(first_row, min(bottom + halo, height))
            columns = slice(first_column, min(right + halo, width))
            part = function(*(image[..., rows, columns] for image in images))
            if output is None:
                shape = (*part.shape[:-2], height, width)
                output = torch.empty(shape, dtype=part.dtype, device=part.device)
            output[..., top:bottom, left:right] = part[
                ...,
                top - first_row : bottom - first_row,
                left - first_column : right - first_column,
            ]
    assert output is not None
    return output
