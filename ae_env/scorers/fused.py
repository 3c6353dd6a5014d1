"""Fused scoring: the built-in terms with a closed form, of many captures in one pass.

`Highlights`, `Shadows` and `Noise` see nothing of a scene but its light: the functions of its
pixels that they need are computed once, and each capture is one pass of a fused kernel over them.
The environment and its score tables use it, in static and in changing light. The torch versions
(`ae_env.scorers.terms`) are the reference and hold the constants; both agree within 1e-6.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ae_env.scenes.scene import Scene
from ae_env.scorers.composite import CompositeScorer
from ae_env.scorers.protocol import Captures
from ae_env.scorers.terms import Banding, Brightness, Highlights, Noise, Shadows, Sharpness
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.utils.cache import LruCache
from simulator.utils.jit import kernel
from simulator.utils.threads import in_shares

#: Memory for the functions of scenes' pixels [byte].
_BYTES = 2**27
#: Pixels times exposures from which another thread is worth waking.
_WORTH_A_THREAD = 2**17
#: Column of `fused_means` for each term; and the terms that need none.
_COLUMNS = {Highlights: 0, Shadows: 1, Noise: 2}
_WITHOUT_PIXELS = (Banding, Brightness, Sharpness)


@dataclass(frozen=True, eq=False)
class _Pixels:
    """The inputs of `fused_means` that depend on the scene, (4, H, W) and (H, W)."""

    scene: weakref.ref[Scene]
    light: np.ndarray
    dark: np.ndarray
    bright: np.ndarray


class FusedScores:
    """The parts of a scorer that are made of the built-in closed forms.

    That is those which read the pixels of the light, those which read none, and composites of them.

    Args:
        scorer: The scorer whose parts they are.

    Attributes:
        parts: Those parts by name.
        reads_pixels: Whether one of them is made of the pixels of the light.
    """

    def __init__(self, scorer: CompositeScorer) -> None:
        self.parts = {name: part for name, part in scorer.parts.items() if _is_known(part)}
        self.reads_pixels = any(_has_pixels(part) for part in self.parts.values())
        self._pixels: LruCache[_Pixels] = LruCache(_BYTES)

    def scores(self, captures: Captures, means: np.ndarray) -> dict[str, np.ndarray]:
        """Scores (B,) float64 by part.

        Args:
            captures: The captures; `Captures.scene_light` is not looked at.
            means: Result of `means` for them, whatever their blur.
        """
        return {name: _score(part, means, captures) for name, part in self.parts.items()}

    def means(
        self, scenes: Sequence[Scene], captures: Captures, *, keep: bool = True
    ) -> np.ndarray:
        """Means over the pixels that the parts need, (B, 3) float64; (0, 3) unless `reads_pixels`.

        Args:
            scenes: Scene of each of the B captures; captures of one follow each other.
            captures: The captures; `Captures.scene_light` is not looked at.
            keep: Whether to cache the functions of the scenes' pixels, for other light.
        """
        if not self.reads_pixels:
            return np.empty((0, 3))
        ratios = captures.ratio.numpy()
        rows = None if captures.row_gain is None else captures.row_gain.numpy()
        # Frames without bands go without `gains`, so that rounding does not depend on the batch.
        banded = np.zeros(len(scenes), bool) if rows is None else (rows != 1.0).any(axis=1)
        kinds = list(zip(map(id, scenes), banded.tolist(), strict=True))
        begins = [i for i, kind in enumerate(kinds) if i == 0 or kind != kinds[i - 1]]
        means = np.empty((len(scenes), 3))
        for first, last in pairwise([*begins, len(scenes)]):
            part = slice(first, last)
            gains = rows[part] if rows is not None and banded[first] else None
            pixels = self._cached_pixels(scenes[first], keep)
            means[part] = _pixel_means(pixels, ratios[part], captures.nlf[part], gains)
        return means

    def _cached_pixels(self, scene: Scene, keep: bool) -> _Pixels:
        known = self._pixels.get(id(scene))
        if known is not None and known.scene() is scene:  # an id may be given out again
            return known
        light = np.ascontiguousarray(scene.clean_light.numpy())
        stops = np.log2(np.maximum(light, 2.0**-40).astype(np.float64))
        with np.errstate(over="ignore"):
            dark = np.exp((stops + Shadows.depth) / Shadows.width).astype(np.float32)
        bright = np.exp(stops.max(axis=0) / Highlights.width)
        known = _Pixels(weakref.ref(scene), light, dark, bright)
        if keep:
            self._pixels.put(id(scene), known, light.nbytes + dark.nbytes + bright.nbytes)
        return known


def _pixel_means(
    pixels: _Pixels,
    ratios: np.ndarray,
    noises: Sequence[NoiseLevelFunction],
    row_gain: np.ndarray | None,
) -> np.ndarray:
    """Result of `fused_means`, (S, 3), for one scene."""
    rows = 1 if row_gain is None else pixels.light.shape[1]
    gains = ratios[:, None] if row_gain is None else ratios[:, None] * row_gain  # (S, R)
    with np.errstate(over="ignore", under="ignore"):
        stops = np.log2(gains)
        fixed = (
            pixels.light.reshape(4, rows, -1),
            pixels.dark.reshape(4, rows, -1),
            pixels.bright.reshape(rows, -1),
            gains.astype(np.float32),
            np.exp(stops / (2.0 * Shadows.width)).astype(np.float32),
            np.exp(stops / Highlights.width),
            np.array([n.shot for n in noises], np.float32),
            np.array([n.read for n in noises], np.float32),
            np.float32(Noise.half_snr**1.5),
        )
    means = np.empty((len(ratios), 3))
    least = max(1, _WORTH_A_THREAD // pixels.light.size)
    in_shares(lambda a, b: fused_means(a, b, *fixed, means), len(ratios), least=least)
    return means


def _is_known(part: Any) -> bool:
    """Whether the kernel computes exactly what `part` does; a subclass may do something else."""
    if isinstance(part, CompositeScorer):
        known = type(part).__module__.startswith("ae_env.")
        return known and all(map(_is_known, part.parts.values()))
    # An instance with constants of its own is not known either.
    return type(part) in (*_COLUMNS, *_WITHOUT_PIXELS) and not vars(part)


def _has_pixels(part: Any) -> bool:
    if isinstance(part, CompositeScorer):
        return any(map(_has_pixels, part.parts.values()))
    return type(part) in _COLUMNS


def _score(part: Any, means: np.ndarray, captures: Captures) -> np.ndarray:
    if isinstance(part, CompositeScorer):
        scores = {name: _score(inner, means, captures) for name, inner in part.parts.items()}
        return part.totals(scores)
    column = _COLUMNS.get(type(part))
    if column is None:
        return np.asarray(part(None, captures).numpy())
    values = means[:, column]
    return np.asarray(np.clip(values if column == 2 else np.exp(-values / part.scale), 0.0, 1.0))


# -- the kernel -----------------------------------------------------------------------------------
# Light that is exposed longer is multiplied, and so are the exponentials under the sigmoids. Those
# of the scene are computed once, so that no exposure needs a transcendental function of a pixel.
#
# The constants of `ae_env.scorers.terms` are arguments: numba's cache on disk would not notice a
# change in another module.

#: Pixels that are added up in float32 before their sum is in float64.
_BLOCK = 256
_ZERO, _ONE, _TINY = np.float32(0), np.float32(1), np.float32(1e-30)

_FAST = {"nsz", "contract", "reassoc"}
_jit = kernel(fastmath=_FAST, boundscheck=False)
#: Inlined into the caller: a called function would add up its sums in another order in the process
#: that compiles it than in those that load the compiled code.
_inline = kernel(fastmath=_FAST, boundscheck=False, inline="always")


@_inline
def _dark(values, root):  # type: ignore[no-untyped-def]
    """Sum of ``1 / (1 + value root^2)``; the square alone could leave float32's range."""
    total = _ZERO
    for i in range(len(values)):
        total += _ONE / (_ONE + (values[i] * root) * root)
    return total


@_inline
def _bright(values, factor):  # type: ignore[no-untyped-def]
    """Sum of ``1 - 1 / (1 + value factor)``."""
    total = 0.0
    for i in range(len(values)):
        total += 1.0 - 1.0 / (1.0 + values[i] * factor)
    return total


@_inline
def _clean(light, ratio, shot, read, half):  # type: ignore[no-untyped-def]
    """Sum of ``s / (s + half)``, s = SNR^1.5."""
    total = _ZERO
    for i in range(len(light)):
        x = light[i] * ratio
        x = x if x > _ZERO else _ZERO
        variance = x * shot + read
        variance = variance if variance > _TINY else _TINY
        x = x if x < _ONE else _ONE
        root = np.sqrt(x * x / variance)
        power = root * np.sqrt(root)
        total += power / (power + half)
    return total


@_jit
def fused_means(  # type: ignore[no-untyped-def]
    first, last, light, dark, bright, ratio, dark_root, bright_factor, shot, read, half, means
):
    """Means for the exposures `first` to `last` of S, of light in R rows that each have a gain.

    Args:
        first: First exposure.
        last: One past the last.
        light: (4, R, C) float32.
        dark: (4, R, C) float32, ``exp((log2 x + depth) / width)`` of the light x.
        bright: (R, C) float64, ``exp(log2 x / width)`` of the brightest plane.
        ratio: (S, R) float32, what the light is multiplied by.
        dark_root: (S, R) float32, root of what `dark` is multiplied by.
        bright_factor: (S, R) float64, what `bright` is multiplied by.
        shot: (S, 4) float32 of the camera.
        read: (S, 4) float32.
        half: float32, SNR^1.5 at which `noise` is a half.
        means: (S, 3) float64 to write to: shares of blown and of blocked pixels, and `noise`.
    """
    planes, rows, columns = light.shape
    for state in range(first, last):
        blown = blocked = clean = 0.0
        for row in range(rows):
            for start in range(0, columns, _BLOCK):
                end = min(start + _BLOCK, columns)
                blown += _bright(bright[row, start:end], bright_factor[state, row])
                for plane in range(planes):
                    part = dark[plane, row, start:end]
                    blocked += _dark(part, dark_root[state, row])
                    by_light, by_itself = shot[state, plane], read[state, plane]
                    signal = light[plane, row, start:end]
                    clean += _clean(signal, ratio[state, row], by_light, by_itself, half)
        count = rows * columns
        means[state, 0] = blown / count
        means[state, 1] = blocked / (4 * count)
        means[state, 2] = clean / (4 * count)
