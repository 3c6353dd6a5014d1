"""Dead leaves: occluding shapes of power-law size, the standard model of natural images.

Sizes distributed as ``r**-3`` make the image scale invariant, with a power spectrum close to
``1 / f**2`` and the edges that Gaussian 1/f noise lacks (Ruderman 1997; Lee, Mumford and Huang
2001; Alvarez, Gousseau and Morel 1999).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulator.utils.compute import kernel

#: Number of times that the leaves cover the frame; gaps show the ground.
_COVERAGE = 3.0
#: A square of this half side has about the area of the unit disc.
_SQUARE_HALF_SIDE = 0.886


@dataclass(frozen=True)
class LeafStyle:
    """Appearance of dead leaves.

    Args:
        smallest: Smallest radius [pixels].
        largest: Largest radius, fraction of the frame height.
        contrast: Standard deviation of a leaf's natural-log reflectance.
        chroma: Standard deviation of the log2 of red and of blue over green, between palette
            colours.
        texture: Largest standard deviation of the natural-log texture on a leaf.
        mean: Mean reflectance of the picture (green).
        palette: Number of base colours that leaves share.
    """

    smallest: float = 1.2
    largest: float = 0.35
    contrast: float = 0.75
    chroma: float = 0.45
    texture: float = 0.35
    mean: float = 0.17
    palette: int = 5


def fractal_noise(rng: np.random.Generator, size: int, slope: float = 1.0) -> np.ndarray:
    """Periodic noise (size, size) float32 of amplitude ``1 / f**slope``, mean 0, deviation 1."""
    white = np.fft.rfft2(rng.standard_normal((size, size), dtype=np.float32))
    fy, fx = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :]
    radius = np.hypot(fy, fx)
    radius[0, 0] = np.inf
    field = np.fft.irfft2(white / radius**slope, s=(size, size))
    return np.asarray((field / field.std()).astype(np.float32))


def dead_leaves(rng: np.random.Generator, size: int, style: LeafStyle | None = None) -> np.ndarray:
    """Reflectance of a dead-leaves picture.

    Args:
        rng: Source of all randomness.
        size: Height and width [pixels].
        style: Appearance of the leaves.

    Returns:
        (3, size, size) float32 reflectance in linear sRGB, in [0.005, 0.97].
    """
    style = LeafStyle() if style is None else style
    radius, centre_y, centre_x, shape = _draw_leaves(rng, size, style)
    label = paint_leaves(size, radius, centre_y, centre_x, shape)
    number = len(radius) + 1  # label 0 is the ground

    tone = rng.normal(0.0, style.contrast, number).astype(np.float32)
    palette = rng.normal(0.0, style.chroma, (style.palette, 2))
    chroma = palette[rng.integers(0, style.palette, number)] + rng.normal(0, 0.12, (number, 2))
    gain = np.exp2(np.stack([chroma[:, 0], np.zeros(number), chroma[:, 1]])).astype(np.float32)

    texture = _texture(rng, size, label, number, style)
    shading = _shading(rng, size, label, radius, centre_y, centre_x)
    luminance = np.exp(tone[label] + texture + shading)
    reflectance = luminance * gain[:, label]
    return scale_to_mean(reflectance, style.mean)


def scale_to_mean(reflectance: np.ndarray, mean: float) -> np.ndarray:
    """`reflectance` (3, H, W) scaled so that green has `mean`, kept inside [0.005, 0.97].

    Bright colours are compressed smoothly towards 0.97 instead of being cut off.
    """
    scaled = reflectance * np.float32(mean / reflectance[1].mean())
    for _ in range(3):  # the compression lowers the mean a little: two corrections settle it
        bright = np.maximum(scaled - 0.5, 0.0)
        pressed = np.minimum(scaled, 0.5) + 0.47 * bright / (0.47 + bright)
        scaled *= np.float32(mean / pressed[1].mean())
    return np.asarray(np.clip(pressed, 0.005, 0.97).astype(np.float32))


def _draw_leaves(
    rng: np.random.Generator, size: int, style: LeafStyle
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Radii from the density r**-3, centres over the frame and a margin around it, shapes."""
    low, high = style.smallest, max(style.largest * size, 2.0 * style.smallest)
    ratio = 1.0 - (low / high) ** 2
    mean_area = np.pi * 2.0 * low**2 * np.log(high / low) / ratio
    margin = 0.4 * high
    number = int(_COVERAGE * (size + 2 * margin) ** 2 / mean_area)
    radius = low / np.sqrt(1.0 - ratio * rng.random(number))
    centre_y = rng.uniform(-margin, size + margin, number)
    centre_x = rng.uniform(-margin, size + margin, number)
    shape = np.stack(
        [
            rng.uniform(0.0, np.pi, number),  # orientation
            np.exp2(rng.uniform(-0.7, 0.7, number)),  # elongation
            rng.random(number) < 0.3,  # boxes among the ellipses
        ]
    )
    return radius, centre_y, centre_x, shape


def paint_leaves(
    size: int,
    radius: np.ndarray,
    centre_y: np.ndarray,
    centre_x: np.ndarray,
    shape: np.ndarray,
) -> np.ndarray:
    """(size, size) label of the topmost leaf at each pixel, 0 for the ground."""
    angle, elongation, is_box = shape
    cosine, sine = np.abs(np.cos(angle)), np.abs(np.sin(angle))
    along, across = radius * elongation, radius / elongation  # semi-axes
    boxes = is_box.astype(bool)
    reach_x, reach_y = (
        np.where(
            boxes, _SQUARE_HALF_SIDE * (along * a + across * b), np.hypot(along * a, across * b)
        )
        for a, b in ((cosine, sine), (sine, cosine))
    )
    top = np.clip(np.ceil(centre_y - reach_y), 0, size).astype(np.int32)
    bottom = np.clip(np.floor(centre_y + reach_y) + 1, 0, size).astype(np.int32)
    left = np.clip(np.ceil(centre_x - reach_x), 0, size).astype(np.int32)
    width = np.clip(np.floor(centre_x + reach_x) + 1, 0, size).astype(np.int32) - left
    bottom, width = np.maximum(bottom, top), np.maximum(width, 0)
    scale = np.stack([np.cos(angle), np.sin(angle)]) / radius
    turned = np.stack([*(scale / elongation), *(scale * elongation)]).astype(np.float32)
    centre = np.stack([centre_y, centre_x]).astype(np.float32)
    label = np.zeros((size, size), np.int32)
    _paint(label, np.stack([top, bottom, left, left + width]), centre, turned, boxes)
    return label


@kernel(boundscheck=False)
def _paint(label, bounds, centre, turned, boxes):  # type: ignore[no-untyped-def]
    """Writes the number of each leaf, from 1, over those before it.

    Args:
        label: (H, W) int32, changed in place.
        bounds: (4, N) first row, end of the rows, first column, end of the columns.
        centre: (2, N) float32 row and column.
        turned: (4, N) float32 factors of dx and dy along the leaf, and of dy and dx across it.
        boxes: (N,) whether it is a box.
    """
    for leaf in range(len(boxes)):
        u_x, u_y, v_y, v_x = turned[0, leaf], turned[1, leaf], turned[2, leaf], turned[3, leaf]
        for y in range(bounds[0, leaf], bounds[1, leaf]):
            dy = np.float64(y) - centre[0, leaf]
            for x in range(bounds[2, leaf], bounds[3, leaf]):
                dx = np.float64(x) - centre[1, leaf]
                u = dx * u_x + dy * u_y
                v = dy * v_y - dx * v_x
                if boxes[leaf]:
                    inside = max(abs(u), abs(v)) < _SQUARE_HALF_SIDE
                else:
                    inside = u * u + v * v < 1.0
                if inside:
                    label[y, x] = leaf + 1


def _texture(
    rng: np.random.Generator, size: int, label: np.ndarray, number: int, style: LeafStyle
) -> np.ndarray:
    """Natural-log texture: a stretch of a fractal field for each leaf, at a strength of its own."""
    field = fractal_noise(rng, size, 0.8)
    strength = (style.texture * rng.random(number) ** 2).astype(np.float32)
    shift = rng.integers(0, size * size, number)
    position = np.arange(size * size).reshape(size, size)
    return np.asarray(strength[label] * field.ravel()[(position + shift[label]) % (size * size)])


def _shading(
    rng: np.random.Generator,
    size: int,
    label: np.ndarray,
    radius: np.ndarray,
    centre_y: np.ndarray,
    centre_x: np.ndarray,
) -> np.ndarray:
    """Natural-log shading: brightness falls off across a leaf in a direction of its own."""
    angle = rng.uniform(0.0, 2.0 * np.pi, len(radius))
    steepness = rng.uniform(0.0, 0.35, len(radius)) / radius
    slope = np.zeros((2, len(radius) + 1), np.float32)
    slope[:, 1:] = np.stack([np.sin(angle), np.cos(angle)]) * steepness
    centre = np.zeros((2, len(radius) + 1), np.float32)
    centre[:, 1:] = np.stack([centre_y, centre_x])
    axis = np.arange(size, dtype=np.float32)
    dy = axis[:, None] - centre[0][label]
    dx = axis[None, :] - centre[1][label]
    return np.asarray(slope[0][label] * dy + slope[1][label] * dx)
