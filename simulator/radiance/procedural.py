"""Seeded procedural scenes: the easy kinds and the five that fool a reflected-light meter.

Every kind returns light on the reflectance scale: 1.0 is what a perfectly white surface sends
under the stated illuminance, which is what an incident-light meter reads where a photographer would
hold it; the docstring of each kind says where that is.

Most are dead leaves: occluding shapes of power-law size, the standard model of natural images.
Sizes distributed as ``r**-3`` make the image scale invariant, with a power spectrum close to
``1 / f**2`` and the edges that Gaussian 1/f noise lacks (Ruderman 1997; Lee, Mumford and Huang
2001; Alvarez, Gousseau and Morel 1999).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.random import Generator

from simulator.radiance.light import temperature_tint
from simulator.utils.checks import check_word
from simulator.utils.compute import kernel

Range = tuple[float, float]

#: Part of every cache key: raise it with any change of the drawings.
GENERATOR_VERSION = 1
#: Packed pixels a side at which procedural scenes are drawn.
NATIVE_SIZE = 256
#: The kinds of the hard part.
HARD_KINDS = ("back_light", "snow", "night", "spot_light", "motion")
#: Median image speed of the kind "motion" [frame heights / s].
MOTION_SPEED = 1.0
#: Number of times that the leaves cover the frame; gaps show the ground.
_COVERAGE = 3.0
#: A square of this half side has about the area of the unit disc.
_SQUARE_HALF_SIDE = 0.886


# -- dead leaves -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class LeafStyle:
    """Appearance of dead leaves."""

    smallest: float = 1.2  # radius [pixels]
    largest: float = 0.35  # radius, fraction of the frame height
    contrast: float = 0.75  # standard deviation of a leaf's natural-log reflectance
    chroma: float = 0.45  # the same of log2 red and blue over green, between palette colours
    texture: float = 0.35  # largest standard deviation of the natural-log texture on a leaf
    mean: float = 0.17  # reflectance of the picture (green)
    palette: int = 5  # number of base colours that leaves share


def fractal_noise(rng: Generator, size: int, slope: float = 1.0) -> np.ndarray:
    """Periodic noise (size, size) float32 of amplitude ``1 / f**slope``, mean 0, deviation 1."""
    white = np.fft.rfft2(rng.standard_normal((size, size), dtype=np.float32))
    fy, fx = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :]
    radius = np.hypot(fy, fx)
    radius[0, 0] = np.inf
    field = np.fft.irfft2(white / radius**slope, s=(size, size))
    return np.asarray((field / field.std()).astype(np.float32))


def dead_leaves(rng: Generator, size: int, style: LeafStyle) -> np.ndarray:
    """Reflectance of dead leaves, (3, size, size) float32 linear sRGB in [0.005, 0.97]."""
    leaves = _draw_leaves(rng, size, style)
    label = paint_leaves(size, *leaves)
    number = len(leaves[0]) + 1  # label 0 is the ground

    tone = rng.normal(0.0, style.contrast, number).astype(np.float32)
    palette = rng.normal(0.0, style.chroma, (style.palette, 2))
    chroma = palette[rng.integers(0, style.palette, number)] + rng.normal(0, 0.12, (number, 2))
    gain = np.exp2(np.stack([chroma[:, 0], np.zeros(number), chroma[:, 1]])).astype(np.float32)

    # A stretch of a fractal field for each leaf, at a strength of its own.
    field = fractal_noise(rng, size, 0.8)
    strength = (style.texture * rng.random(number) ** 2).astype(np.float32)
    shift = rng.integers(0, size * size, number)
    position = np.arange(size * size).reshape(size, size)
    texture = strength[label] * field.ravel()[(position + shift[label]) % (size * size)]
    shading = _shading(rng, size, label, *leaves[:3])
    reflectance = np.exp(tone[label] + texture + shading) * gain[:, label]

    # Bright colours are compressed smoothly towards 0.97 instead of being cut off.
    scaled = reflectance * np.float32(style.mean / reflectance[1].mean())
    for _ in range(3):  # the compression lowers the mean a little: two corrections settle it
        bright = np.maximum(scaled - 0.5, 0.0)
        pressed = np.minimum(scaled, 0.5) + 0.47 * bright / (0.47 + bright)
        scaled *= np.float32(style.mean / pressed[1].mean())
    return np.asarray(np.clip(pressed, 0.005, 0.97).astype(np.float32))


def _draw_leaves(
    rng: Generator, size: int, style: LeafStyle
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
    angle, elongation = rng.uniform(0.0, np.pi, number), np.exp2(rng.uniform(-0.7, 0.7, number))
    return radius, centre_y, centre_x, np.stack([angle, elongation, rng.random(number) < 0.3])


def paint_leaves(
    size: int, radius: np.ndarray, centre_y: np.ndarray, centre_x: np.ndarray, shape: np.ndarray
) -> np.ndarray:
    """(size, size) label of the topmost leaf at each pixel, 0 for the ground.

    `shape` (3, N) holds the orientation, the elongation, and whether it is a box or an ellipse.
    """
    angle, elongation, is_box = shape
    cosine, sine = np.abs(np.cos(angle)), np.abs(np.sin(angle))
    along, across = radius * elongation, radius / elongation  # semi-axes
    boxes = is_box.astype(bool)
    reach_x, reach_y = (
        np.where(boxes, _SQUARE_HALF_SIDE * (width + height), np.hypot(width, height))
        for width, height in ((along * cosine, across * sine), (along * sine, across * cosine))
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
    """Writes the number of each leaf, from 1, over those before it into `label` (H, W) int32.

    `bounds` (4, N) are first and end of rows and of columns, `centre` (2, N) float32 row and
    column, `turned` (4, N) float32 factors of dx and dy along the leaf, and of dy and dx across it.
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


def _shading(
    rng: Generator,
    size: int,
    label: np.ndarray,
    radius: np.ndarray,
    centre_y: np.ndarray,
    centre_x: np.ndarray,
) -> np.ndarray:
    """Natural-log shading: brightness falls off across a leaf in a direction of its own."""
    angle = rng.uniform(0.0, 2.0 * np.pi, len(radius))
    steepness = rng.uniform(0.0, 0.35, len(radius)) / radius
    by_leaf = np.stack([np.sin(angle), np.cos(angle)]) * steepness, np.stack([centre_y, centre_x])
    slope, centre = (np.pad(v, ((0, 0), (1, 0))).astype(np.float32) for v in by_leaf)
    axis = np.arange(size, dtype=np.float32)
    dy = axis[:, None] - centre[0][label]
    dx = axis[None, :] - centre[1][label]
    return np.asarray(slope[0][label] * dy + slope[1][label] * dx)


# -- scenes ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Drawing:
    """A procedural picture and the light it stands in."""

    light: np.ndarray  # (3, H, W) float32, linear sRGB on the reflectance scale
    illuminance: float  # incident light [lux]
    illuminant: tuple[float, float, float]  # its colour, linear sRGB, not yet in `light`


def draw(kind: str, rng: Generator, size: int = NATIVE_SIZE, *, lens: bool = True) -> Drawing:
    """A picture of `kind`, one of `KINDS`, of `size` pixels a side.

    `lens` gives it a lens's softness, a binomial blur over 3 x 3 pixels, edges repeated; without,
    it is for a camera that has a lens of its own.
    """
    check_word("kind", kind, tuple(KINDS))
    drawing = KINDS[kind](rng, size)
    if not lens:
        return drawing
    padded = np.pad(drawing.light, ((0, 0), (1, 1), (1, 1)), mode="edge")
    rows = 0.25 * padded[:, :-2] + 0.5 * padded[:, 1:-1] + 0.25 * padded[:, 2:]
    light = 0.25 * rows[:, :, :-2] + 0.5 * rows[:, :, 1:-1] + 0.25 * rows[:, :, 2:]
    return replace(drawing, light=light)


def day(rng: Generator, size: int) -> Drawing:
    """Dead leaves outdoors, 300 to 100,000 lux, some with cast shadows; metered in the sun."""
    light = dead_leaves(rng, size, _varied_style(rng))
    illuminance = draw_lux(rng, 300.0, 100_000.0)
    if rng.random() < 0.5:
        # The lower the sun's share of the light, the milder its shadows.
        depth = rng.uniform(0.12, 0.5)
        light = light * _shadows(rng, size, share=rng.uniform(0.05, 0.4), depth=depth)
    if rng.random() < 0.5:
        _add_lamps(rng, light, int(rng.integers(1, 9)), radius=(0.003, 0.008), value=(2.0, 60.0))
    return Drawing(light, illuminance, temperature_tint(rng.normal(0.05, 0.12)))


def indoor(rng: Generator, size: int) -> Drawing:
    """Dead leaves in a room, 10 to 2000 lux with fall-off; metered at the middle brightness."""
    style = _varied_style(rng)
    light = dead_leaves(rng, size, style) * _falloff(rng, size, stops=rng.uniform(0.3, 1.5))
    if rng.random() < 0.7:
        _add_lamps(rng, light, int(rng.integers(1, 5)), radius=(0.01, 0.035), value=(5.0, 120.0))
    tint = temperature_tint(rng.uniform(0.1, 1.1))
    return Drawing(light, draw_lux(rng, 10.0, 2000.0), tint)


def motion(rng: Generator, size: int) -> Drawing:
    """Dead leaves, 20 to 20,000 lux; hard because such a scene moves fast, not by its light."""
    style = _varied_style(rng)
    light = dead_leaves(rng, size, style) * _falloff(rng, size, stops=rng.uniform(0.0, 0.8))
    return Drawing(light, draw_lux(rng, 20.0, 20_000.0), temperature_tint(rng.uniform(-0.1, 0.7)))


def snow(rng: Generator, size: int) -> Drawing:
    """Snow under 1500 to 100,000 lux with a few dark things on it; metered on the lit snow."""
    drifts = np.clip(0.84 + 0.045 * fractal_noise(rng, size, 1.5), 0.6, 0.95)
    grain = np.exp(0.02 * fractal_noise(rng, size, 0.3))
    white = np.array([0.985, 1.0, 1.0], np.float32)[:, None, None]
    light = (white * drifts * grain).astype(np.float32)
    things = dead_leaves(rng, size, LeafStyle(mean=0.1, contrast=0.6, texture=0.5))
    light = np.where(_scatter(rng, size, share=rng.uniform(0.02, 0.14)), things, light)
    if rng.random() < 0.45:  # open shade on snow is blue: the sky lights it
        shade = _shadows(rng, size, share=rng.uniform(0.05, 0.2), depth=rng.uniform(0.3, 0.6))
        blue = np.array([0.85, 1.0, 1.25], np.float32)[:, None, None]
        light = light * (shade + (1.0 - shade) * (blue - 1.0) * 0.5).clip(0.2, 1.0)
    _add_lamps(rng, light, number=int(rng.integers(0, 25)), radius=(0.002, 0.003), value=(1.5, 8.0))
    return Drawing(light, draw_lux(rng, 1500.0, 100_000.0), temperature_tint(rng.normal(0.0, 0.1)))


def back_light(rng: Generator, size: int) -> Drawing:
    """A subject before a sky or window 3 to 6 EV brighter, in 20 to 8000 lux; metered at it.

    The incident light is what falls on the side that faces the camera. The background's mean
    luminance lies 3 to 6 EV above that of a grey card in this light.
    """
    room = rng.random() < 0.4
    subject = dead_leaves(rng, size, _varied_style(rng, rng.uniform(0.13, 0.24)))
    background = _windows(rng, size) if room else _sky_above_skyline(rng, size)
    axis = np.linspace(0.0, 1.0, size, dtype=np.float32)
    scale = rng.uniform(0.18, 0.45)
    middle, top = rng.uniform(0.3, 0.7), rng.uniform(0.25, 0.5)
    background &= ~_person(axis[:, None], axis[None, :], top, middle, scale)
    contrast = np.exp2(rng.uniform(3.0, 6.0)) * 0.18
    clouds = np.exp((0.1 if room else 0.2) * fractal_noise(rng, size, 1.4))
    sky = np.exp2(rng.uniform(0.0, 0.35)) if not room else 1.0  # blue over red
    colour = np.array([1.0 / sky, 1.0, sky], np.float32)[:, None, None]
    light = np.where(background, colour * contrast * clouds, subject).astype(np.float32)
    if not room and rng.random() < 0.3:
        _add_lamps(rng, light, number=1, radius=(0.012, 0.02), value=(2000.0, 20_000.0), top=0.3)
    lux = draw_lux(rng, 20.0, 800.0) if room else draw_lux(rng, 300.0, 8000.0)
    return Drawing(light, lux, temperature_tint(rng.normal(0.0, 0.1)))


def night(rng: Generator, size: int) -> Drawing:
    """Lamps in the dark, 1 to 50 lux; metered in the brightest pool of light on the ground.

    Most of the frame has 1 to 8 % of that light. Lamps and neon are 20 to 1000 times white, lit
    windows 1 to 8 times; together they cover a few per cent at most.
    """
    light = dead_leaves(rng, size, _varied_style(rng, rng.uniform(0.1, 0.18)))
    axis = np.linspace(0.0, 1.0, size, dtype=np.float32)
    ambient, number = log_uniform(rng, 0.01, 0.08), int(rng.integers(2, 6))
    lamp_y, lamp_x = rng.uniform(0.08, 0.6, number), rng.uniform(0.05, 0.95, number)
    pools = np.zeros((size, size), np.float32)
    for y, x in zip(lamp_y, lamp_x, strict=True):
        reach, drop = rng.uniform(0.06, 0.16), rng.uniform(0.15, 0.35)
        square = (axis[:, None] - y - drop) ** 2 + (axis[None, :] - x) ** 2
        pools += np.float32(rng.uniform(0.4, 1.0)) / (1.0 + square / reach**2) ** 1.5
    light *= ambient + (1.0 - ambient) * pools / pools.max()
    if rng.random() < 0.6:
        _add_lit_windows(rng, light)
    if rng.random() < 0.5:
        _add_neon(rng, light)
    for y, x in zip(lamp_y, lamp_x, strict=True):
        value = log_uniform(rng, 20.0, 1000.0)
        _add_lamp(light, y, x, rng.uniform(0.004, 0.013), value, _warm(rng))
    return Drawing(light, draw_lux(rng, 1.0, 50.0), temperature_tint(rng.uniform(0.2, 1.0)))


def spot_light(rng: Generator, size: int) -> Drawing:
    """A lit performer on a dark stage, 20 to 2000 lux; metered inside the spot light.

    The beam covers 4 to 15 % of the frame, often off centre; the rest has 1.5 to 6 % of its light.
    """
    axis = np.linspace(0.0, 1.0, size, dtype=np.float32)
    dark = log_uniform(rng, 0.015, 0.06)
    radius = rng.uniform(0.1, 0.2)
    y, x = rng.uniform(0.3, 0.7), rng.uniform(0.2, 0.8)
    distance = np.hypot((axis[:, None] - y) / 1.25, axis[None, :] - x) / radius
    beam = _soft_step(1.0 - distance)
    stage = dead_leaves(rng, size, _varied_style(rng, 0.1))
    performer = dead_leaves(rng, size, LeafStyle(mean=rng.uniform(0.25, 0.42), largest=0.1))
    body = _person(axis[:, None], axis[None, :], y - 0.8 * radius, x, 0.55 * radius)
    light = np.where(body, performer, stage) * (dark + (1.0 - dark) * beam).astype(np.float32)
    if rng.random() < 0.5:
        for _ in range(int(rng.integers(1, 5))):
            value = log_uniform(rng, 5.0, 200.0)
            position = rng.uniform(0.03, 0.2), rng.uniform(0.05, 0.95)
            _add_lamp(light, *position, rng.uniform(0.004, 0.012), value, _neon_colour(rng))
    return Drawing(light, draw_lux(rng, 20.0, 2000.0), temperature_tint(rng.uniform(-0.1, 0.8)))


#: The procedural kinds, the easy ones first.
KINDS: dict[str, Callable[[Generator, int], Drawing]] = {
    "dead_leaves": day,
    "indoor": indoor,
    "back_light": back_light,
    "snow": snow,
    "night": night,
    "spot_light": spot_light,
    "motion": motion,
}


def log_uniform(rng: Generator, low: float, high: float) -> Any:
    """A number whose logarithm is uniform."""
    return np.exp(rng.uniform(np.log(low), np.log(high)))


def draw_lux(rng: Generator, low: float, high: float) -> float:
    """Log-uniform illuminance, to 4 digits."""
    return float(f"{log_uniform(rng, low, high):.4g}")


def _soft_step(values: np.ndarray) -> np.ndarray:
    """A soft step: 0 well below 0, 1 well above."""
    return 1.0 / (1.0 + np.exp(np.clip(-values / 0.06, -60, 60)))


def _varied_style(rng: Generator, mean: float | None = None) -> LeafStyle:
    """Leaves of varied size; the default `mean` is that of nature, 17 % give or take 0.3 EV."""
    if mean is None:
        mean = float(np.clip(0.17 * np.exp(rng.normal(0.0, 0.2)), 0.1, 0.3))
    return LeafStyle(
        smallest=log_uniform(rng, 1.2, 7.0),
        largest=rng.uniform(0.3, 0.7),
        contrast=rng.uniform(0.5, 0.9),
        chroma=rng.uniform(0.2, 0.6),
        texture=rng.uniform(0.2, 0.6),
        mean=mean,
    )


def _shadows(rng: Generator, size: int, share: float, depth: float) -> np.ndarray:
    """Illumination: 1 in the light, `depth` in soft-edged shadows that cover `share`."""
    field = fractal_noise(rng, size, 1.6)
    lit = _soft_step(field - np.quantile(field, share))
    return np.asarray((depth + (1.0 - depth) * lit).astype(np.float32))


def _falloff(rng: Generator, size: int, stops: float) -> np.ndarray:
    """Illumination that falls by about `stops` across the frame, its median 1."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    axis = np.linspace(-0.5, 0.5, size, dtype=np.float32)
    ramp = np.sin(angle) * axis[:, None] + np.cos(angle) * axis[None, :]
    field = stops * ramp + 0.1 * stops * fractal_noise(rng, size, 2.0)
    return np.asarray(np.exp2(field - np.median(field)).astype(np.float32))


def _scatter(rng: Generator, size: int, share: float) -> np.ndarray:
    """(size, size) bool: upright things (trunks, rocks, people) that cover about `share`."""
    axis = np.linspace(0.0, 1.0, size, dtype=np.float32)
    mask = np.zeros((size, size), bool)
    for _ in range(60):
        if mask.mean() >= share:
            break
        y, x = rng.uniform(0.1, 1.0), rng.uniform(0.0, 1.0)
        height, width = rng.uniform(0.03, 0.22), rng.uniform(0.01, 0.05)
        mask |= ((axis[:, None] - y) / height) ** 2 + ((axis[None, :] - x) / width) ** 2 < 1.0
    return mask


def _person(y: np.ndarray, x: np.ndarray, top: float, middle: float, scale: float) -> np.ndarray:
    """Head, shoulders and body of a figure `scale` wide whose head is centred at (top, middle)."""
    head = ((y - top) / (0.42 * scale)) ** 2 + ((x - middle) / (0.33 * scale)) ** 2 < 1.0
    across = np.abs(x - middle) / (0.75 * scale)
    down = (y - top - 0.4 * scale) / (0.35 * scale)
    return head | ((across < 1.0) & (down > across**3))


def _sky_above_skyline(rng: Generator, size: int) -> np.ndarray:
    """(size, size) bool, True in the sky over an uneven horizon in the lower part of the frame."""
    ridge = np.cumsum(rng.standard_normal(size))
    ridge = (ridge - np.linspace(ridge[0], ridge[-1], size)) / (np.abs(ridge).max() + 1e-6)
    skyline = rng.uniform(0.3, 0.65) + rng.uniform(0.02, 0.1) * ridge
    return np.asarray(np.linspace(0.0, 1.0, size)[:, None] < skyline[None, :])


def _windows(rng: Generator, size: int) -> np.ndarray:
    """(size, size) bool, True in the panes of one window or two."""
    axis = np.linspace(0.0, 1.0, size)
    mask = np.zeros((size, size), bool)
    number = int(rng.integers(1, 3))
    for i in range(number):
        middle = (i + 0.5) / number + rng.uniform(-0.05, 0.05)
        half, panes = rng.uniform(0.22, 0.36) / number, int(rng.integers(1, 4))
        top, bottom = rng.uniform(0.02, 0.15), rng.uniform(0.55, 0.8)
        across = (axis - middle + half) / (2 * half)
        columns = (across > 0) & (across < 1) & (np.mod(across * panes, 1.0) > 0.06)
        down = (axis - top) / (bottom - top)
        rows = (down > 0) & (down < 1) & (np.mod(down * 2, 1.0) > 0.04)
        mask |= rows[:, None] & columns[None, :]
    return mask


def _add_lamp(
    light: np.ndarray, y: float, x: float, radius: float, value: float, colour: np.ndarray
) -> None:
    """Add a disc of `value` with a soft edge and a faint veil of glare, in place.

    The veil has the order of what lenses scatter (ISO 9358 veiling glare of about 1 %).
    """
    size = light.shape[-1]
    axis = np.linspace(0.0, 1.0, size, dtype=np.float32)
    distance = np.hypot(axis[:, None] - y, axis[None, :] - x) / radius
    core = np.clip((1.0 - distance) * radius * size + 0.5, 0.0, 1.0)
    veil = 0.003 / np.maximum(distance, 1.0) ** 2
    light += colour[:, None, None] * np.float32(value) * (core + veil).astype(np.float32)


def _add_lamps(
    rng: Generator, light: np.ndarray, number: int, radius: Range, value: Range, top: float = 1.0
) -> None:
    """Add `number` near-white lamps or glints at random places above `top`, in place."""
    for _ in range(number):
        y, x = rng.uniform(0.02, 0.98) * top, rng.uniform(0.02, 0.98)
        strength = log_uniform(rng, *value)
        _add_lamp(light, y, x, rng.uniform(*radius), strength, np.ones(3, np.float32))


def _warm(rng: Generator) -> np.ndarray:
    """Colour of a lamp relative to the light it casts elsewhere."""
    return np.array([rng.uniform(0.9, 1.4), 1.0, rng.uniform(0.5, 1.1)], np.float32)


def _neon_colour(rng: Generator) -> np.ndarray:
    colour = np.array([0.08, 0.08, 0.08])
    colour[rng.integers(0, 3)] = 1.0
    return np.asarray(np.maximum(colour, rng.uniform(0.0, 0.6, 3)).astype(np.float32))


def _add_lit_windows(rng: Generator, light: np.ndarray) -> None:
    """Set a grid of small rectangles, some of them lit to 1 to 8 times white, in place."""
    size = light.shape[-1]
    pitch, left, right = int(rng.integers(10, 18)), *np.sort(rng.integers(0, size, 2))
    for row in range(int(rng.integers(0, size // 3)), size // 2, pitch):
        for column in range(int(left), int(right), pitch):
            if rng.random() < 0.15:
                value = log_uniform(rng, 1.0, 8.0) * _warm(rng)
                side = pitch // 3
                light[:, row : row + side, column : column + side] = value[:, None, None]


def _add_neon(rng: Generator, light: np.ndarray) -> None:
    """Add one to three thin coloured tubes, 20 to 80 times white, in place."""
    axis = np.linspace(0.0, 1.0, light.shape[-1], dtype=np.float32)
    for _ in range(int(rng.integers(1, 4))):
        y, x = rng.uniform(0.1, 0.5), rng.uniform(0.2, 0.8)
        radius, stretch = rng.uniform(0.02, 0.06), rng.uniform(0.6, 2.0)
        ring = np.hypot((axis[:, None] - y) * stretch, axis[None, :] - x)
        tube = np.exp(-(((ring - radius) / 0.0025) ** 2))
        value = log_uniform(rng, 20.0, 80.0)
        light += (_neon_colour(rng)[:, None, None] * np.float32(value) * tube).astype(np.float32)
