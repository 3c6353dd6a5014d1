"""Procedural scenes with depth: textured surfaces that occlude each other, seen by a real lens.

A scene is a background and a few things in front of it: boards, bushes, foliage. Each is a plane
in space (inverse depth is linear in the picture then) or lies at one depth, and is covered with
dead leaves of its own. Wherever several cover a pixel, the nearest is seen.

Depth is drawn as the signed circle of confusion at f/11, because that is what decides how much
such a scene can teach about defocus, and then converted to metres for a lens of 50 mm.
"""

import math
import zlib
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.random import Generator

from simulator.capture.blurred_frames import Layout
from simulator.radiance import procedural
from simulator.radiance.light import temperature_tint
from simulator.utils.checks import check_integer, check_word

#: The lens that procedural scenes are drawn for [m], and the f-number of the stated blur.
FOCAL_LENGTH = 0.05
F_NUMBER = 11.0
#: Largest circle of confusion at that f-number [packed pixels].
LARGEST_BLUR = 7.0
#: The same where everything is in focus.
LARGEST_BLUR_IN_FOCUS = 0.3
#: Kinds of focus: on everything, the nearest thing, the background, or something between.
FOCUSES = ("everything", "front", "back", "middle")
#: Range that the largest blur of a picture with defocus is drawn from [packed pixels].
_LARGEST_RANGE = (1.0, 7.0)
#: Focus of the layouts that pictures are draped over: mostly on the nearest thing.
_LAYOUT_FOCUSES, _LAYOUT_SHARES = ("front", "middle", "back"), (0.8, 0.1, 0.1)
#: Side at which they are drawn [pixel], and the least share of the frame that a subject has.
_LAYOUT_SIDE, _LEAST_SUBJECT = 128, 0.02
#: Sides of things relative to that of the frame: of pictures, and of layouts.
_SIDES, _LAYOUT_SIDES = (0.25, 0.75), (0.4, 1.0)


@dataclass(frozen=True)
class DepthDrawing:
    """A procedural picture, the light it stands in, and how it lies before the lens.

    `blur` (H, W) float32 is the signed circle of confusion at `F_NUMBER` [packed pixels], above 0
    behind the plane of focus and at most `LARGEST_BLUR`; `far` the inverse distance [1/m] where it
    is largest.
    """

    drawing: procedural.Drawing
    blur: np.ndarray
    far: float


def draw_depth(rng: Generator, size: int, focus: str = "middle") -> DepthDrawing:
    """A picture with depth, `size` packed pixels a side, focused on one of `FOCUSES`."""
    check_word("focus", focus, FOCUSES)
    check_integer("size", size, 16, more=" packed pixels")
    levels = _levels(rng, int(rng.integers(1, 6)), focus)
    picture = _leaves(rng, size)
    blur = _background(rng, size, levels[0], levels[0] - levels[-1])
    surface = np.zeros((size, size), np.int32)
    for number, level in enumerate(levels[1:], start=1):
        place, inside, seen, tone = _put_thing(rng, blur, surface, number, level)
        leaves = np.clip(_leaves(rng, len(tone)) * tone, 0.003, 0.97)
        picture[:, *place][:, seen] = leaves[:, *inside][:, seen]
    blur = np.clip(blur, -LARGEST_BLUR, LARGEST_BLUR)
    if focus == "everything":
        blur *= LARGEST_BLUR_IN_FOCUS * rng.uniform(0.0, 1.0) / max(float(np.abs(blur).max()), 1e-6)
    if rng.random() < 1.0 / 3.0:
        _add_highlights(rng, picture, surface)
    light = _soften(picture, rng.uniform(0.05, 0.09))
    lux = procedural.draw_lux(rng, 1.0, 20_000.0)
    drawing = procedural.Drawing(light, lux, temperature_tint(rng.uniform(-0.1, 1.0)))
    far = math.exp(rng.uniform(math.log(0.02), math.log(1.0)))
    return DepthDrawing(drawing, blur.astype(np.float32), far)


def draw_layout(name: str, height: int, width: int) -> Layout:
    """The layout of a picture of so many packed pixels over procedural depth; `name` decides it.

    The subject is the nearest thing. Focus is on it in eight of ten layouts, else behind it.
    """
    rng = np.random.default_rng([zlib.crc32(f"layout {name}".encode()), 0])
    focus = str(rng.choice(_LAYOUT_FOCUSES, p=_LAYOUT_SHARES))
    share = 0.0
    while share < _LEAST_SUBJECT:  # else the nearest thing is hidden, or outside the frame
        levels = _levels(rng, int(rng.integers(1, 4)), focus)
        levels *= LARGEST_BLUR / np.abs(levels).max()  # only what is relative to it matters
        blur = _background(rng, _LAYOUT_SIDE, levels[0], levels[0] - levels[-1])
        surface = np.zeros(blur.shape, np.int32)  # the thing that each pixel shows, 0: none
        for number, level in enumerate(levels[1:], start=1):
            _put_thing(rng, blur, surface, number, level, _LAYOUT_SIDES)
        subject = surface == len(levels) - 1
        share = subject.mean()
    diameter, side = np.abs(blur), max(height, width)
    maps = torch.from_numpy(np.stack([diameter / diameter.max(), subject.astype(np.float32)]))[None]
    sized = F.interpolate(maps, (side, side), mode="area")[0, :, :height, :width]
    return Layout(sized[0].clamp(max=1.0), sized[1] > 0.5)


def lens_and_depth(blur: np.ndarray, far: float, pixel_pitch: float) -> tuple[float, np.ndarray]:
    """Focus distance [m] and depth (H, W) float32 [m] at which a scene has `blur`.

    Solves the thin-lens relation ``c = f**2 / (N (s - f)) * (z - s) / z`` (c signed, on the sensor)
    for the focus distance s and the depths z, at `FOCAL_LENGTH` and `F_NUMBER`; `blur` and `far`
    are those of a `DepthDrawing`, `pixel_pitch` is that of packed pixels [m].
    """
    # With inverse distances D = 1/z, F = 1/s: c = f^2 / N * (F - D) / (1 - f F).
    scale = FOCAL_LENGTH**2 / (F_NUMBER * pixel_pitch)
    largest = float(blur.max())
    focus = (largest + scale * far) / (scale + FOCAL_LENGTH * largest)
    inverse = focus - blur.astype(np.float64) * (1.0 - FOCAL_LENGTH * focus) / scale
    return 1.0 / focus, (1.0 / inverse).astype(np.float32)


def _levels(rng: Generator, things: int, focus: str) -> np.ndarray:
    """Signed blur of the background and then of each thing, from far to near; one of them is 0."""
    sizes = rng.uniform(*_LARGEST_RANGE) * rng.uniform(0.2, 1.0, things)
    sign = {"front": 1.0, "back": -1.0}.get(focus)
    signs = rng.choice([-1.0, 1.0], things) if sign is None else np.full(things, sign)
    if sign is None and things > 1:
        signs[:2] = (-1.0, 1.0)  # something before the plane of focus and something behind it
    return np.sort(np.append(sizes * signs, 0.0))[::-1]


def _plane(rng: Generator, side: int, level: float, slant: float) -> np.ndarray:
    """(side, side) blur of a plane through `level` at its middle that rises by up to `slant`."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    axis = np.linspace(-0.5, 0.5, side, dtype=np.float32)
    rise = rng.uniform(0.0, slant)
    plane = level + rise * (np.sin(angle) * axis[:, None] + np.cos(angle) * axis[None, :])
    return np.asarray(plane.astype(np.float32))


def _background(rng: Generator, size: int, level: float, span: float) -> np.ndarray:
    """(size, size) blur of the background: a wall, frontal or slanted, or the ground.

    The ground comes nearer towards the lower edge, by at most the `span` of all levels.
    """
    choice = rng.random()
    if choice < 0.35:
        return np.full((size, size), level, np.float32)
    if choice < 0.7:
        return _plane(rng, size, level, 2.0)
    nearer = rng.uniform(0.4, 1.0) * span * np.linspace(0.0, 1.0, size, dtype=np.float32)
    return np.repeat((level - nearer)[:, None], size, axis=1)


def _put_thing(
    rng: Generator,
    blur: np.ndarray,
    surface: np.ndarray,
    number: int,
    level: float,
    sides: procedural.Range = _SIDES,
) -> tuple[tuple[slice, ...], tuple[slice, ...], np.ndarray, np.ndarray]:
    """Adds one thing: its place in the frame and in itself, where it is seen, its tone."""
    size = blur.shape[0]
    side = int(rng.uniform(*sides) * size)
    top, left = (int(rng.integers(-side // 3, size - 2 * side // 3)) for _ in range(2))
    kind = rng.random()
    if kind < 0.3:
        mask, depth, tone = _foliage(rng, side, level)
    else:
        mask = _bush(rng, side) if kind < 0.6 else _board(rng, side)
        depth = _plane(rng, side, level, 0.0 if rng.random() < 0.4 else 2.5)
        tone = np.ones((side, side), np.float32)
    bounds = [(at, max(at, 0), min(at + side, size)) for at in (top, left)]
    place = tuple(slice(first, last) for _, first, last in bounds)
    inside = tuple(slice(first - at, last - at) for at, first, last in bounds)
    seen = mask[inside] & (depth[inside] < blur[place])
    blur[place][seen] = depth[inside][seen]
    surface[place][seen] = number
    return place, inside, seen, tone


def _board(rng: Generator, side: int) -> np.ndarray:
    """(side, side) bool: an ellipse or a rectangle at an angle."""
    angle, elongation = rng.uniform(0, np.pi), 2.0 ** rng.uniform(-0.6, 0.6)
    shape = np.array([[angle], [elongation], [rng.random() < 0.5]])
    radius, middle = np.array([rng.uniform(0.28, 0.4) * side]), np.array([0.5 * side])
    return procedural.paint_leaves(side, radius, middle, middle, shape) > 0


def _bush(rng: Generator, side: int) -> np.ndarray:
    """(side, side) bool: a blob with a fractal outline."""
    axis = np.linspace(-1.0, 1.0, side, dtype=np.float32)
    distance = np.hypot(axis[:, None], axis[None, :])
    ragged = rng.uniform(0.05, 0.25) * procedural.fractal_noise(rng, side, rng.uniform(1.2, 1.8))
    return (distance + ragged < rng.uniform(0.6, 0.85)) & (distance < 0.97)


def _foliage(rng: Generator, side: int, level: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mask, blur and tone of leaves that float at depths of their own, the nearer in front."""
    number = int(rng.integers(8, 50))
    radius = side * np.exp(rng.uniform(np.log(0.03), np.log(0.16), number))
    angle, elongation = rng.uniform(0.0, np.pi, number), np.exp2(rng.uniform(-1.2, 1.2, number))
    shape = np.stack([angle, elongation, rng.random(number) < 0.2])
    centre_y, centre_x = rng.uniform(0.2, 0.8, (2, number)) * side
    label = procedural.paint_leaves(side, radius, centre_y, centre_x, shape)
    spread = rng.uniform(0.0, 1.5)
    depth = np.sort(level + rng.uniform(-spread, spread, number))[::-1]  # painted from far to near
    depth = np.concatenate([[np.inf], depth]).astype(np.float32)
    tone = np.exp(rng.normal(0.0, 0.5, number + 1)).astype(np.float32)
    return label > 0, depth[label], tone[label]


def _leaves(rng: Generator, size: int) -> np.ndarray:
    """(3, size, size) reflectance: dead leaves, most with texture at all scales, some nearly bare.

    The exponent of the additional texture varies, so that smoothness alone does not tell that
    something is out of focus.
    """
    style = procedural.LeafStyle(
        smallest=float(procedural.log_uniform(rng, 1.5, 12.0)),
        largest=rng.uniform(0.2, 0.5),
        contrast=rng.uniform(0.3, 0.9),
        chroma=rng.uniform(0.1, 0.5),
        texture=rng.uniform(0.2, 1.3),
        mean=float(np.clip(0.17 * np.exp(rng.normal(0.0, 0.5)), 0.05, 0.45)),
    )
    light = procedural.dead_leaves(rng, size, style)
    strength = rng.uniform(0.0, 0.6) if rng.random() < 0.8 else 0.0
    noise = procedural.fractal_noise(rng, size, rng.uniform(0.6, 1.3))
    grain = np.exp(np.float32(strength) * noise)
    return np.asarray(np.clip(light * grain, 0.003, 0.97).astype(np.float32))


def _add_highlights(rng: Generator, light: np.ndarray, surface: np.ndarray) -> None:
    """Adds small discs of 5 to 100 times white to `light`, each on one thing only, at its depth."""
    size = surface.shape[0]
    for _ in range(int(rng.integers(3, 30))):
        radius, value = rng.uniform(0.5, 3.0), math.exp(rng.uniform(math.log(5.0), math.log(100.0)))
        y, x = rng.uniform(4.0, size - 5.0, 2)
        colour = np.exp2(rng.normal(0.0, 0.3, 3)) * [1.0, 0.0, 1.0] + [0.0, 1.0, 0.0]
        row, column = round(y), round(x)
        window = (slice(row - 4, row + 5), slice(column - 4, column + 5))
        if np.ptp(surface[window]):
            continue  # across an edge half of it would be at the wrong depth
        offset = np.arange(-4, 5, dtype=np.float32)
        distance = np.hypot(offset[:, None] + row - y, offset[None, :] + column - x)
        cover = np.clip(radius + 0.5 - distance, 0.0, 1.0) * min(1.0, 2.0 * radius)
        light[:, window[0], window[1]] += (value * colour[:, None, None] * cover).astype(np.float32)


def _soften(light: np.ndarray, weight: float) -> np.ndarray:
    """The softness of a good lens in focus: the kernel (w, 1 - 2 w, w) along both axes.

    It varies a little from scene to scene, so that no fixed softness means "in focus".
    """
    padded = np.pad(light, ((0, 0), (1, 1), (1, 1)), mode="edge")
    rows = weight * (padded[:, :-2] + padded[:, 2:]) + (1.0 - 2.0 * weight) * padded[:, 1:-1]
    both = weight * (rows[..., :-2] + rows[..., 2:]) + (1.0 - 2.0 * weight) * rows[..., 1:-1]
    return np.asarray(both.astype(np.float32))
