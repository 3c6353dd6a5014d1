"""What a few frames of a scene are worth together, before they are taken.

A schedule is up to K states, in any order. Its error in a light L follows from the noise of the
merged frames in closed form up to one integral, so all schedules that fit into the time are rated
at once.
"""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from ae_env.episodes.bracket import FRAME_GAP
from ae_env.grid import ExposureGrid
from ae_env.merging import SATURATED, WORST_EV
from simulator.camera import CameraProfile

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: Centres of the bins of log2 luminance, relative to the EV100 of the viewfinder's frame.
BINS = np.arange(-16.0, 16.0, 0.5)
#: Quantiles of the noise that an error is averaged over.
_QUANTILES = 11
_NORMALS = ndtri((np.arange(_QUANTILES) + 0.5) / _QUANTILES)
#: Time by which a schedule may exceed what is left: rounding [s].
_SLACK = 1e-9


def bin_of(place: Floats) -> Ints:
    """Index of the bin of each log2 luminance, relative to the reference of `BINS`."""
    return np.clip(np.rint((place - BINS[0]) / (BINS[1] - BINS[0])), 0, len(BINS) - 1).astype(int)


class Schedules:
    """All schedules of a grid, and what they are worth.

    Luminance is in units of that which makes an exposure at EV100 0 white.

    Args:
        grid: The states.
        camera: The body, whose noise is known.
        budget: Time of all frames together [s].
        max_frames: Frames of a schedule at most.
        box_factor: Photosites averaged a side into one pixel.

    Attributes:
        states: (M, K) int64, the states of each, -1 for none; the first is no frame at all.
        counts: (M, S) how often each has each state.
        frames: (M,) how many frames each has.
        longest: (M,) its longest exposure [s].
    """

    def __init__(
        self,
        grid: ExposureGrid,
        camera: CameraProfile,
        budget: float,
        max_frames: int,
        box_factor: int,
    ) -> None:
        self.grid, self.budget, self.max_frames = grid, budget, max_frames
        exposures = np.array([s.exposure_time for s in grid])
        found = [(-1,) * max_frames]
        for count in range(1, max_frames + 1):
            for chosen in itertools.combinations_with_replacement(range(len(grid)), count):
                if exposures[list(chosen)].sum() + FRAME_GAP * (count - 1) <= budget + _SLACK:
                    found.append((*chosen, *(-1,) * (max_frames - count)))
        self.states = np.array(found)
        self.counts = np.stack([(self.states == s).sum(axis=1) for s in range(len(grid))], axis=1)
        self.frames = (self.states >= 0).sum(axis=1)
        self.longest = np.where(self.counts > 0, exposures, 0.0).max(axis=1)
        nlfs = [camera.nlf(s.iso).scaled(1.0 / box_factor**2) for s in grid]
        self.shot = np.array([np.mean(n.shot) for n in nlfs])
        self.read = np.array([np.mean(n.read) for n in nlfs])
        self._weights = lru_cache(maxsize=64)(self._weights_of)
        self._noise = lru_cache(maxsize=256)(self._noise_of)

    def precision(self, reference: float) -> tuple[Floats, Floats]:
        """Inverse variance of the merged luminance, and each frame's share of it.

        Args:
            reference: EV100 that `BINS` are relative to.

        Returns:
            (M, L), and (M, K, L).
        """
        return self._weights(float(reference))

    def _weights_of(self, reference: float) -> tuple[Floats, Floats]:
        luminance = np.exp2(BINS + reference)
        gain = np.exp2(-self.grid.ev100)[:, None]
        signal = gain * luminance
        variance = self.shot[:, None] * signal + self.read[:, None]
        weight = np.where(signal < SATURATED, gain**2 / variance, 0.0)  # (S, L)
        weight = np.concatenate([weight, np.zeros((1, len(BINS)))])  # of no frame
        each = weight[self.states]  # (M, K, L); -1 is the last
        total = each.sum(axis=1)
        share = each / np.maximum(total, 1e-300)[:, None]
        return total, share.astype(np.float32)

    def noise_error(self, reference: float, floor: float) -> Floats:
        """(M, L) expected error of merged samples [EV]; `WORST_EV` where all frames are white.

        Args:
            reference: EV100 that `BINS` are relative to.
            floor: log2 of the luminance below which errors count less; to the nearest stop.
        """
        return self._noise(float(reference), round(floor))

    def _noise_of(self, reference: float, floor: int) -> Floats:
        total, _ = self.precision(reference)
        luminance, dark = np.exp2(BINS + reference), 2.0**floor
        deviation = 1.0 / np.sqrt(np.maximum(total, 1e-300))
        error = np.zeros_like(total)
        for normal in _NORMALS:
            seen = np.maximum(luminance + normal * deviation, 0.0)
            ratio = np.abs(np.log2((seen + dark) / (luminance + dark)))
            error += np.minimum(ratio, WORST_EV) / _QUANTILES
        return np.where(total > 0.0, error, WORST_EV).astype(np.float32)

    def errors(self, reference: float, floor: float, light: Floats, blur: Floats) -> Floats:
        """(M,) expected error of each schedule over all samples [EV].

        Args:
            reference: EV100 that `BINS` are relative to.
            floor: See `noise_error`.
            light: (L,) share of the samples in each of `BINS`.
            blur: (S,) error that the blur of each state makes [EV].
        """
        noise = self.noise_error(reference, floor)
        if not blur.any():
            return noise @ light.astype(np.float32)
        _, share = self.precision(reference)
        own = np.append(blur, 0.0).astype(np.float32)[self.states]  # (M, K)
        merged = (share * own[:, :, None]).sum(axis=1)
        both = np.where(noise < WORST_EV, np.hypot(noise, merged), noise)
        return np.minimum(both, WORST_EV) @ light.astype(np.float32)

    def completions(self, taken: Ints, time_left: float) -> NDArray[np.bool_]:
        """(M,) bool: schedules that hold the frames `taken` so far and fit into the time left.

        Args:
            taken: States of the frames so far.
            time_left: Time left [s].
        """
        counts = np.bincount(taken, minlength=len(self.grid)) if len(taken) else 0
        more = self.frames - len(taken)
        exposures = np.array([s.exposure_time for s in self.grid])
        needed = (self.counts - counts) @ exposures + FRAME_GAP * np.maximum(more - 1, 0)
        fits = needed <= time_left + _SLACK
        holds: NDArray[np.bool_] = (self.counts >= counts).all(axis=1) & fits
        return holds

    def next_state(self, schedule: int, taken: Ints, alone: Floats) -> int:
        """The state of `schedule` to take next, the best by `alone`; -1 when all are taken.

        Args:
            schedule: Index of the schedule.
            taken: States of the frames so far.
            alone: (S,) error of each state alone.
        """
        left = self.counts[schedule].copy()
        np.subtract.at(left, taken, 1)
        wanted = np.flatnonzero(left > 0)
        return int(wanted[np.argmin(alone[wanted])]) if len(wanted) else -1
