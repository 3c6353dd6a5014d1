"""From the packed planes of a Bayer raw to RGB at every pixel."""

from __future__ import annotations

import torch

from simulator.camera import BayerPattern

RED, GREEN, BLUE = range(3)


def demosaic_half(packed: torch.Tensor) -> torch.Tensor:
    """RGB at half the sensor's resolution: R, the mean of both greens, B of each 2 x 2 tile.

    Args:
        packed: (B, 4, H, W), planes R, G1, G2, B, any range.

    Returns:
        (B, 3, H, W), dtype and device of `packed`.

    Nothing is interpolated, so noise stays white and no artefact can be mistaken for detail; R and
    B lie half a packed pixel apart, which nobody sees at this size.

    >>> demosaic_half(torch.tensor([0.5, 0.2, 0.4, 0.1]).reshape(1, 4, 1, 1)).flatten()
    tensor([0.5000, 0.3000, 0.1000])
    """
    _check(packed)
    rgb = packed.new_empty(packed.shape[0], 3, *packed.shape[2:])
    rgb[:, RED] = packed[:, 0]
    torch.add(packed[:, 1], packed[:, 2], out=rgb[:, GREEN])
    rgb[:, GREEN] *= 0.5
    rgb[:, BLUE] = packed[:, 3]
    return rgb


def demosaic_malvar(packed: torch.Tensor, cfa: BayerPattern | str) -> torch.Tensor:
    """RGB at the sensor's resolution with the linear 5 x 5 filters of Malvar, He and Cutler.

    Args:
        packed: (B, 4, H, W), planes R, G1, G2, B, H, W >= 2, floating point, any range. White
            balance it first: the filters take the planes' detail to be alike.
        cfa: Where in the 2 x 2 tile each plane lies.

    Returns:
        (B, 3, 2H, 2W), dtype and device of `packed`; it may overshoot the input's range at edges.

    Raises:
        ValueError: If the shape, the size or the CFA is not one of those above.

    A missing colour is its bilinear estimate plus a share of the Laplacian of the colour that is
    there: 1/2 for green, 5/8 at greens, 3/4 for red at blue and blue at red. The border is
    mirrored about its last pixel, so every colour stays on its own rows and columns.

    Source: H. S. Malvar, L. He, R. Cutler, "High-quality linear interpolation for demosaicing of
    Bayer-patterned color images", ICASSP 2004, figure 2.
    """
    _check(packed)
    height, width = packed.shape[2:]
    if height < 2 or width < 2:
        raise ValueError(f"`packed` (shape {tuple(packed.shape)}) must be at least 2 x 2")
    if not packed.dtype.is_floating_point:
        raise ValueError(f"`packed` (dtype {packed.dtype}) must be floating point")
    try:
        offsets = BayerPattern(cfa).offsets
    except ValueError:
        known = ", ".join(p.value for p in BayerPattern)
        raise ValueError(f"`cfa` (={cfa!r}) must be one of {known}") from None

    mosaic = packed.new_empty(packed.shape[0], 2 * height, 2 * width)
    for plane, (row, column) in enumerate(offsets):
        mosaic[:, row::2, column::2] = packed[:, plane]
    padded = _mirror(_mirror(mosaic, 1), 2)

    rgb = packed.new_empty(packed.shape[0], 3, 2 * height, 2 * width)
    for plane, (row, column) in enumerate(offsets):
        centre, near_h, near_v, far_h, far_v, diagonal = _neighbours(padded, row, column)
        target = rgb[:, :, row::2, column::2]
        if plane in (0, 3):  # red or blue: green, and the opposite colour from the diagonals
            own, opposite = (RED, BLUE) if plane == 0 else (BLUE, RED)
            far = far_h + far_v
            target[:, own] = centre
            target[:, GREEN] = (4.0 * centre + 2.0 * (near_h + near_v) - far) / 8.0
            target[:, opposite] = (6.0 * centre + 2.0 * diagonal - 1.5 * far) / 8.0
        else:  # green: one colour left and right, the other above and below
            along, across = (RED, BLUE) if plane == 1 else (BLUE, RED)
            base = 5.0 * centre - diagonal
            target[:, GREEN] = centre
            target[:, along] = (base + 4.0 * near_h - far_h + 0.5 * far_v) / 8.0
            target[:, across] = (base + 4.0 * near_v - far_v + 0.5 * far_h) / 8.0
    return rgb


def _neighbours(padded: torch.Tensor, row: int, column: int) -> tuple[torch.Tensor, ...]:
    """Sums over the 5 x 5 neighbourhood of every pixel at (row, column) of its tile.

    Returns the centre; left + right and above + below at distance 1; the same at distance 2; the
    four diagonals. Sums of shifted views, not a convolution: the same bits on every device and in
    every batch, where a GPU's convolution would round to TF32.
    """
    height, width = padded.shape[1] - 4, padded.shape[2] - 4

    def at(down: int, right: int) -> torch.Tensor:
        top, left = 2 + row + down, 2 + column + right
        return padded[:, top : top + height - 1 : 2, left : left + width - 1 : 2]

    return (
        at(0, 0),
        at(0, -1) + at(0, 1),
        at(-1, 0) + at(1, 0),
        at(0, -2) + at(0, 2),
        at(-2, 0) + at(2, 0),
        (at(-1, -1) + at(-1, 1)) + (at(1, -1) + at(1, 1)),
    )


def _mirror(mosaic: torch.Tensor, dim: int) -> torch.Tensor:
    """`mosaic` with two more pixels at both ends of `dim`, mirrored about the last pixel."""
    size = mosaic.shape[dim]
    index = torch.arange(-2, size + 2, device=mosaic.device).abs()
    index = torch.where(index < size, index, 2 * (size - 1) - index)
    return mosaic.index_select(dim, index)


def _check(packed: torch.Tensor) -> None:
    if packed.ndim != 4 or packed.shape[1] != 4:
        raise ValueError(
            f"`packed` (shape {tuple(packed.shape)}) must be (B, 4, H, W), planes R, G1, G2, B"
        )
