"""The terms that are measured on the recorded frame, from the histogram of its 8-bit codes.

`Highlights`, `Shadows` and `Noise` are means over the samples of functions of the recorded value:
of a frame, sums over the histogram of its codes (`CodeScores.measured`). Their expectation over the
noise of a light is a mean over the light of smooth functions, which are tabulated once for each
noise (`CodeScores.expected`): exact for the means, and for scores to the first order in their
noise, which a frame of thousands of samples averages. The definitions are those of
`ae_env.scorers.terms`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from ae_env.observation import PEDESTAL, encode_array
from ae_env.scorers.code_kernels import FAR, FINE, expect_codes, expect_means, measure_codes
from ae_env.scorers.composite import CompositeScorer
from ae_env.scorers.protocol import Captures
from ae_env.scorers.terms import (
    Banding,
    Brightness,
    Highlights,
    Noise,
    Shadows,
    Sharpness,
    code_signals,
)
from simulator.camera import CameraProfile
from simulator.capture.sensor import Transitions, record
from simulator.settings import CameraSettings
from simulator.utils.cache import LruCache
from simulator.utils.compute import addresses, parallel_ranges

#: Memory for tabulated expectations [byte].
_BYTES = 2**25
#: Samples times frames from which another thread is worth waking.
_WORTH_A_THREAD = 2**15
#: Column of the means for each term; and the terms that need none.
_COLUMNS = {Highlights: 0, Shadows: 1, Noise: 2}
_WITHOUT_PIXELS = (Banding, Brightness, Sharpness)
_SIGNALS = code_signals()


class CodeScores:
    """Those parts of a scorer that are made of the terms above, composites of them included.

    Args:
        scorer: The scorer whose parts they are.
        camera: The body that takes the captures.
        states: The settings of the S states.
        noise: Whether captures are noisy.

    Attributes:
        parts: Those parts by name.
    """

    def __init__(
        self,
        scorer: CompositeScorer,
        camera: CameraProfile,
        states: Sequence[CameraSettings],
        *,
        noise: bool,
    ) -> None:
        self.parts = {n: p for n, p in scorer.parts.items() if _is_known(p) and _has_pixels(p)}
        #: Whether a part needs `Captures` besides the means.
        self.reads_captures = any(type(part) not in _COLUMNS for part in self.parts.values())
        self.camera, self.noise = camera, noise
        isos = sorted({state.iso for state in states})
        noises = [camera.nlf(iso) for iso in isos]
        self._which = np.array([isos.index(state.iso) for state in states])
        self._shot_read = np.array([[n.shot, n.read] for n in noises])[self._which]  # (S, 2, 4)
        self._shares = self._noise_shares(np.array([[n.shot, n.read] for n in noises]))
        self._dark = Shadows.shares(_SIGNALS).numpy()
        self._edges = _code_edges(camera)
        # Up to light beyond white that even the most noise does not bring back.
        shot, read = (max(max(getattr(n, name)) for n in noises) for name in ("shot", "read"))
        light = 1.0
        for _ in range(100):
            light = 1.0 + FAR * math.sqrt(shot * light + read)
        self._size = int(FINE * (2.0 + 255.0 * math.sqrt(light + PEDESTAL)))
        self._tables: LruCache[np.ndarray] = LruCache(_BYTES)

    def _noise_shares(self, shot_read: np.ndarray, brought: np.ndarray | None = None) -> np.ndarray:
        """(K, 4, 256) float32 `Noise.shares` of each code.

        Args:
            shot_read: (K, 2, 4) noise of a native pixel.
            brought: (K, 2, 4) that the source brings; None for none.
        """
        light = _SIGNALS.double().numpy()
        variance = np.zeros((len(shot_read), 4, 256))
        if self.noise:
            variance = shot_read[:, 0, :, None] * light + shot_read[:, 1, :, None]
            if brought is not None:
                other = brought[:, 0, :, None] * light + brought[:, 1, :, None]
                variance = np.maximum(variance, other)
        shares: np.ndarray = Noise.shares(_SIGNALS, torch.from_numpy(variance).float()).numpy()
        return shares

    def scores(self, captures: Captures | None, means: np.ndarray) -> dict[str, np.ndarray]:
        """Scores (B,) float64 by part.

        Args:
            captures: The captures; None unless `reads_captures`.
            means: (B, 3) result of `measured` or `expected` for them.
        """
        return {name: _score(part, means, captures) for name, part in self.parts.items()}

    def _of_frames(self, states: np.ndarray, brought: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Noise shares (K, 4, 256) and which of them each frame has; see `measured`."""
        noisy = brought.any(axis=(1, 2))
        if not noisy.any():
            return self._shares, self._which[states]
        own = self._noise_shares(self._shot_read[states[noisy]], brought[noisy])
        which = self._which[states]
        which[noisy] = len(self._shares) + np.arange(len(own))
        return np.concatenate([self._shares, own]), which

    def measured(self, codes: np.ndarray, states: np.ndarray, brought: np.ndarray) -> np.ndarray:
        """Means (B, 3) of recorded frames: shares of blown and of blocked samples, and `noise`.

        Args:
            codes: (B, 4, H, W) uint8 of the frames.
            states: (B,) at which they were taken.
            brought: (B, 2, 4) shot and read noise that the sources bring, of a native pixel.
        """
        shares, which = self._of_frames(states, brought)
        flat = codes.reshape(len(codes), 4, -1)
        means = np.empty((len(codes), 3))
        least = max(1, _WORTH_A_THREAD // flat[0].size)
        fixed = (flat, shares, which, self._dark, means)
        parallel_ranges(lambda a, b: measure_codes(a, b, *fixed), len(codes), least=least)
        return means

    def expected(
        self,
        transitions: Transitions,
        states: np.ndarray,
        box_factors: np.ndarray,
        row_gain: np.ndarray | None = None,
    ) -> np.ndarray:
        """Expectation (B, 3) of `measured` over the noise that the transitions add.

        Args:
            transitions: Light and exposures.
            states: (B,) of the frames.
            box_factors: (B,) sensor pixels averaged per side into one of the frame.
            row_gain: (B, H) light of each row relative to the frame's, or None.
        """
        table = transitions.before_rounding(self.camera).averaged_table()
        brought = table[:, 3:] * np.square(box_factors)[:, None, None]
        if not self.noise:
            codes = np.empty((len(table), *transitions.light[0].shape), np.uint8)
            record(transitions, self.camera, row_gain=row_gain, codes=codes)
            return self.measured(codes, states, brought)
        shares, which = self._of_frames(states, brought)
        # What the noise shares depend on, too.
        kinds = np.stack([self._which[states], box_factors], axis=1)
        keys = [table[i, 1:].tobytes() + kinds[i].tobytes() for i in range(len(table))]
        numbers: dict[bytes, int] = {}
        tables: list[np.ndarray] = []
        for i, key in enumerate(keys):
            if key not in numbers:
                numbers[key] = len(tables)
                tables.append(self._tabulated(key, table[i, 1:3], shares[which[i]]))
        height, width = transitions.light[0].shape[-2:]
        rows = np.ones((len(table), 1)) if row_gain is None else row_gain
        fixed = (
            addresses(transitions.light),
            1 if row_gain is None else height,
            height * width if row_gain is None else width,
            table[:, 0].astype(np.float32),
            rows.astype(np.float32),
            self._size,
            np.array([tables[numbers[key]].ctypes.data for key in keys], np.uintp),
        )
        means = np.empty((len(table), 3))
        least = max(1, _WORTH_A_THREAD // (4 * height * width))
        parallel_ranges(lambda a, b: expect_means(a, b, *fixed, means), len(table), least=least)
        return means

    def _tabulated(self, key: bytes, missing: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """(4, 3, G) float32 expectations by light: above the last code, blocked, and `noise`."""
        found = self._tables.get(key)
        if found is None:
            found = np.empty((4, 3, self._size), np.float32)
            for plane in range(4):
                noise = self._edges[plane], *missing[:, plane]
                expect_codes(self._dark, shares[plane], *noise, found[plane])
            self._tables.put(key, found, found.nbytes)
        return found


def _code_edges(camera: CameraProfile) -> np.ndarray:
    """(4, 256) signals from which a plane is recorded as each code or one above.

    A signal is rounded to digital numbers first: halfway below the first number of a code.
    """
    numbers = np.arange(camera.white_level + 1.0)
    edges = np.empty((4, 256))
    for plane, (black, span) in enumerate(zip(camera.black_level, camera.span, strict=True)):
        first = np.searchsorted(encode_array((numbers - black) / span), np.arange(256))
        edges[plane] = (first - 0.5 - black) / span
    return edges


def _is_known(part: Any) -> bool:
    """Whether `part` is exactly what is computed here; a subclass may do something else."""
    if isinstance(part, CompositeScorer):
        known = type(part).__module__.startswith("ae_env.")
        return known and all(map(_is_known, part.parts.values()))
    # An instance with constants of its own is not known either.
    return type(part) in (*_COLUMNS, *_WITHOUT_PIXELS) and not vars(part)


def _has_pixels(part: Any) -> bool:
    if isinstance(part, CompositeScorer):
        return any(map(_has_pixels, part.parts.values()))
    return type(part) in _COLUMNS


def _score(part: Any, means: np.ndarray, captures: Captures | None) -> np.ndarray:
    if isinstance(part, CompositeScorer):
        scores = {name: _score(inner, means, captures) for name, inner in part.parts.items()}
        return part.totals(scores)
    column = _COLUMNS.get(type(part))
    if column is None:
        return np.asarray(part(None, captures).numpy())
    values = means[:, column]
    return np.asarray(np.clip(values if column == 2 else np.exp(-values / part.scale), 0.0, 1.0))
