"""Readings of light meters: of one frame, and what those of several frames say together."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ae_env.grid import ExposureGrid
from ae_env.observation import PEDESTAL, decode_settings, encode_array, linear_signal
from agents.policy import Bools, Floats, Ints, Observations
from simulator.camera import CameraProfile

#: The planes that carry luminance.
GREEN = slice(1, 3)
#: Mean signal, 1.0 at sensor white, that a meter aims at: 18 % grey under ISO 12232's
#: saturation-based speed, 0.1194 rounded.
TARGET_SIGNAL = 0.12
#: Below this mean the 8-bit code of the observation has no step left: the frame is black.
BLACK_SIGNAL = 2e-4
#: At and above this a pixel is saturated (the top code of the observation covers 0.996 to 1).
WHITE_SIGNAL = 0.99
#: A wholly saturated frame is counted this many EV above white, a partly saturated one in
#: proportion: its mean is only a lower bound of the light.
SATURATED_STEP_EV = 3.0
#: Codes of the 8-bit observation, and the signal of each.
CODES = 256
CODE_SIGNALS = (1.0 + PEDESTAL) * (np.arange(CODES) / (CODES - 1.0)) ** 2 - PEDESTAL
#: Zones a side, at most.
ZONES = 32
#: A meter's own reading stands up to this share of saturated weight.
TRUSTED_SATURATED = 0.02
#: Share of the zones that two frames must show unclipped to be compared, and the mean signal of
#: those in each.
LEAST_SHARE, LEAST_SIGNAL = 0.01, 0.004
#: Metered weight from which a frame is all white.
ALL_SATURATED = 0.999
#: Quantiles in which frames are compared.
_QUANTILES = np.linspace(0.05, 0.95, 19)
#: The light is another one where the frames differ by more than these, in the square root of the
#: signal (mean of the quantiles), and in stops (median of those that both frames show well).
_TOLERANCE, _TOLERANCE_EV = 0.04, 0.3
_SHOWN = (0.004, 0.9)
#: Saturated share from which a frame hides something.
SATURATED_SEEN = 0.01


class Reading(NamedTuple):
    """A meter's result for one frame of each camera: metered EV100, ``(N,)``.

    Of the metered weight a share is `saturated`: the reading is a lower bound in so far. Where the
    frame is `black`, nothing was recorded: it is an upper bound.
    """

    ev100: Floats
    saturated: Floats
    black: Bools


#: A light meter: a function of the observations of N cameras and, optionally, the EV100 ``(N,)``
#: that the controller holds, NaN in the first frame; one that goes step by step continues there.
#: The observations may have a ``mask`` (h, w) bool: other pixels count for nothing.
Meter = Callable[..., Reading]


def frame_ev100(observations: Observations) -> Floats:
    """EV100 at which each frame in hand was taken, ``(N,)``: Av + Tv - (Sv - 5).

    Av is rounded to the third of a stop that a marked f-number stands for.
    """
    aperture, time, speed = (
        np.asarray(v, dtype=np.float64) for v in decode_settings(observations["settings"])
    )
    return np.round(3.0 * aperture) / 3.0 + time - (speed - 5.0)


def frame_states(observations: Observations, grid: ExposureGrid) -> Ints:
    """State of `grid` that is nearest to the (nominal) settings of each frame, ``(N,)``."""
    shown = np.stack(decode_settings(observations["settings"]), axis=1)
    return np.asarray(np.abs(shown[:, None] - grid.apex).sum(axis=2).argmin(axis=1))


def signal_codes(
    raw: NDArray[Any], camera: CameraProfile, planes: slice = slice(None)
) -> NDArray[np.uint8]:
    """The 8-bit codes of observed frames, from any kind of observation; see `linear_signal`."""
    if raw.dtype == np.uint8:
        return raw[:, planes]
    return encode_array(linear_signal(raw, camera, planes))


def mean_reading(mean: Floats, saturated: Floats, ev: Floats) -> Reading:
    """The reading of frames with this mean signal, taken at `ev`, all ``(N,)``."""
    level = np.log2(np.maximum(mean, BLACK_SIGNAL) / TARGET_SIGNAL)
    black = mean <= BLACK_SIGNAL * 1.001
    return Reading(ev + level + SATURATED_STEP_EV * saturated, saturated, black)


# -- a part of the frame ---------------------------------------------------------------------------

#: The word for the mask of each scene's own subject, and where observations have it.
SUBJECT = "subject"


class Region:
    """The pixels of frames of `shape` (4, h, w) that a meter reads: all of them by default.

    Give one of `roi`: left, top, width and height in [0, 1] of the frame, in a sequence or a text
    with commas; and `mask`: (h, w) bool, or ``"subject"``.
    """

    def __init__(self, roi: Any, mask: Any, shape: tuple[int, ...] | None) -> None:
        if roi is not None and mask is not None:
            raise ValueError("give `roi` or `mask`, not both")
        self.of_subject, self._shape = isinstance(mask, str) and mask == SUBJECT, (shape or ())[1:]
        mask = mask if roi is None else _rectangle(roi, self._shape)
        #: (1, h, w) bool, the same for all cameras; None for all pixels, and of a subject.
        self._fixed = None if mask is None or self.of_subject else self._checked(mask)[None]
        self.key = mask if self._fixed is None else self._fixed.tobytes()  # for caches

    def masks(self, observations: Observations) -> Bools | None:
        """The pixels to read, (N or 1, h, w) bool; None for all."""
        if not self.of_subject:
            return self._fixed
        if SUBJECT not in observations:
            need = "needs `info['subject']` of environments made with_subject=True"
            raise ValueError(f"`mask` (='subject') {need}")
        return np.stack([self._checked(mask) for mask in observations[SUBJECT]])

    def _checked(self, mask: Any) -> Bools:
        found = np.asarray(mask)
        if found.dtype != bool or found.shape != self._shape or not found.any():
            none = ": the scene has no subject" if self.of_subject and not found.any() else ""
            rule = f"{SUBJECT!r} or bool, {self._shape}, True somewhere{none}"
            raise ValueError(f"`mask` ({found.dtype}, {found.shape}) must be {rule}")
        return found


def _rectangle(roi: Any, shape: tuple[int, ...]) -> Bools:
    """The pixels (h, w) that `roi` touches."""
    found = np.zeros(shape, bool)
    with suppress(TypeError, ValueError):  # which is said below
        left, top, width, height = map(float, roi.split(",") if isinstance(roi, str) else roi)
        ends = np.array([[top, left], [top + height, left + width]])
        if min(left, top) >= 0.0 < min(width, height) and ends.max() <= 1.0 + 1e-9:
            first, last = (ends * shape).round(6)
            rows, columns = map(slice, np.floor(first).astype(int), np.ceil(last).astype(int))
            found[rows, columns] = True
    if not found.any():
        rule = "left, top, width, height in [0, 1], within the frame, such as 0.25,0.25,0.5,0.5"
        raise ValueError(f"`roi` (={roi!r}) must be {rule}")
    return found


def parts_of(
    observations: Observations, masks: Bools | None
) -> Iterator[tuple[slice, Observations]]:
    """Cameras, and their frames cut to the box around their mask, with the ``mask`` in it."""
    if masks is None:
        yield slice(None), observations
        return
    for number, mask in enumerate(masks):
        cameras = slice(None) if len(masks) == 1 else slice(number, number + 1)
        rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
        box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        cut = {"raw": observations["raw"][cameras][:, :, *box], "mask": mask[box]}
        yield cameras, {**cut, "settings": observations["settings"][cameras]}


def read_part(
    meter: Meter, observations: Observations, estimate: Floats, masks: Bools | None
) -> Reading:
    """The reading of a part of each frame: the box around it is the meter's frame."""
    found = [meter(cut, estimate[cameras]) for cameras, cut in parts_of(observations, masks)]
    return Reading(*map(np.concatenate, zip(*found, strict=True)))


def inside(observations: Observations) -> NDArray[Any]:
    """The raw frames, or what a mask leaves of each in one row (N, 4, 1, K), for histograms."""
    raw, mask = observations["raw"], observations.get("mask")
    return raw if mask is None else raw[..., mask][..., None, :]


# -- over the frames of an episode -----------------------------------------------------------------


class EVTracker:
    """Continuous metered EV of each camera over the frames of an episode.

    A reading far from the estimate replaces it; within a stop the two are averaged, which settles
    what would otherwise flip between neighbouring states. A mostly saturated frame only says that
    the light is not below a bound, a black one that it is not above: an estimate that agrees with
    the bound stays. A frame that is all white or all black moves any other estimate half of the
    way to the end of the range.

    With damping, the EV that is handed out follows the estimate. It is never read back from the
    settings, so a grid of whole stops does not hold it up, and its past never counts as lying
    beyond the `ev_range` of the exposure states, which compensation shifts: light that comes back
    after a long night is followed at once.
    """

    def __init__(
        self,
        num_envs: int,
        ev_range: tuple[float, float],
        damping: float = 0.0,
        compensation: float = 0.0,
    ) -> None:
        self.ev100, self.damped = np.full((2, num_envs), np.nan)
        self.ev_range, self.damping, self.compensation = ev_range, damping, compensation

    def update(self, reading: Reading) -> Floats:
        """Take in one frame's reading; returns the estimates, ``(N,)``, damped."""
        old, new = self.ev100, reading.ev100
        low, high = self.ev_range
        bound = new - SATURATED_STEP_EV * reading.saturated
        agrees = (reading.saturated > 0.5) & (old >= bound) | reading.black & (old <= new)
        white = reading.saturated >= ALL_SATURATED
        new = np.where(reading.black, np.minimum(new, 0.5 * (new + low)), new)
        new = np.where(white, np.maximum(new, 0.5 * (bound + high)), new)
        blended = np.where(np.abs(new - old) > 1.0, new, 0.5 * (new + old))
        self.ev100 = np.where(np.isnan(old), new, np.where(agrees, old, blended))
        before = np.clip(self.damped, low + self.compensation, high + self.compensation)
        distance = self.damping * (before - self.ev100)
        self.damped = self.ev100 + np.where(np.isnan(distance), 0.0, distance)
        return self.damped.copy()


class ReferenceFrames:
    """Keeps, for each camera, the best frame of the present light.

    Neither a saturated frame nor a dark one shows what the other does: a search on the frame in
    hand may go to and fro between the two for ever. So it continues on the better one for as long
    as new frames look as that one predicts. Of two frames the less saturated is better; of two that
    are not saturated, the brighter.
    """

    def __init__(self, camera: CameraProfile) -> None:
        self.camera = camera
        #: Codes (N, 4, h, w), settings, quantiles of the signal, saturated share and EV100.
        self._best: tuple[NDArray[Any], ...] | None = None

    def update(self, observations: Observations, masks: Bools | None = None) -> Observations:
        """Take in the frames in hand; returns the best ones, raw and settings.

        Of `masks` (N or 1, h, w) are the pixels to look at.
        """
        raw = signal_codes(observations["raw"], self.camera)
        settings = np.asarray(observations["settings"])
        ev = frame_ev100(observations)
        green = raw[:, GREEN].reshape(len(raw), -1)
        count = np.full((1, 1), green.shape[1])
        if masks is not None:  # codes below all others, which come first
            seen = np.tile(masks.reshape(len(masks), -1), 2)
            green, count = np.where(seen, green, np.int16(-1)), seen.sum(axis=1, keepdims=True)
        ranks = green.shape[1] - count + np.rint(_QUANTILES * (count - 1)).astype(np.intp)
        quantiles = CODE_SIGNALS[np.take_along_axis(np.sort(green, axis=1), ranks, axis=1)]
        saturated = (green >= np.searchsorted(CODE_SIGNALS, WHITE_SIGNAL)).sum(axis=1) / count[:, 0]
        if self._best is None:
            self._best = (raw.copy(), settings.copy(), quantiles, saturated, ev)
        else:
            _, _, _, known_saturated, known_ev = self._best
            hides, hid = saturated >= SATURATED_SEEN, known_saturated >= SATURATED_SEEN
            # The same state again is a newer look at the same light.
            better = np.where(hides | hid, saturated < known_saturated, ev <= known_ev)
            replaced = better | self._changed(quantiles, ev)
            new = raw, settings, quantiles, saturated, ev
            for kept, one in zip(self._best, new, strict=True):
                kept[replaced] = one[replaced]
        return {"raw": self._best[0], "settings": self._best[1]}

    def _changed(self, quantiles: Floats, ev: Floats) -> Bools:
        """Whether the frames in hand look other than predicted, ``(N,)``."""
        assert self._best is not None
        predicted = self._best[2] * np.exp2(self._best[4] - ev)[:, None]
        both = np.stack([predicted, quantiles]).clip(0.0, 1.0)
        apart = np.abs(np.diff(np.sqrt(both), axis=0)[0]).mean(axis=1) > _TOLERANCE
        shown = (both.min(axis=0) > _SHOWN[0]) & (both.max(axis=0) < _SHOWN[1])
        stops = np.abs(np.diff(np.log2(np.maximum(both, 1e-6)), axis=0)[0])
        known = shown.any(axis=1)
        middle = np.nanmedian(np.where(known[:, None] & ~shown, np.nan, stops), axis=1)
        return apart | known & (middle > _TOLERANCE_EV)


class ZoneMatcher:
    """Replaces what a meter reads in frames that clip by how much brighter they are than the last.

    A frame that is exposed four stops too long is mostly white, and its mean is only a lower bound
    of the light. But its shadows are recorded: over the zones that clip nowhere, neither in this
    frame nor in the one before, the ratio of the signals is that of the exposures times that of the
    light (the comparametric principle of Mann 2000, on a linear sensor). Where too little is left
    to compare, the meter's reading stands, with its share of white as a warning.
    """

    def __init__(self) -> None:
        self._zones: Floats | None = None
        self._light, self._exposed_at = np.empty(0), np.empty(0)

    def match(self, reading: Reading, zones: Floats, exposed_at: Floats) -> Reading:
        """Take in one frame of each camera; what it reads, unsaturated where it was matched.

        `zones` are its `zone_signals`, `exposed_at` is the EV100 of its settings, ``(N,)``.
        """
        light, saturated = reading.ev100, reading.saturated
        if self._zones is not None:
            change, comparable = light_change(self._zones, zones)
            matched = comparable & (saturated > TRUSTED_SATURATED)
            change += exposed_at - self._exposed_at
            light = np.where(matched, self._light + change, light)
            saturated = np.where(matched, 0.0, saturated)
        self._zones, self._light, self._exposed_at = zones, light, exposed_at
        return Reading(light, saturated, reading.black)


def light_change(before: Floats, now: Floats) -> tuple[Floats, Bools]:
    """How many stops more signal `now` has than `before` in the zones (..., zones) both show.

    A zone that clips is NaN. Also returns whether there was enough to compare; it is 0 where not.
    """
    both = ~np.isnan(before) & ~np.isnan(now)
    count = np.maximum(both.sum(axis=-1), 1)
    means = [np.where(both, zones, 0.0).sum(axis=-1) / count for zones in (before, now)]
    enough = (both.mean(axis=-1) >= LEAST_SHARE) & (np.minimum(*means) >= LEAST_SIGNAL)
    stops = np.diff(np.log2(np.maximum(means, LEAST_SIGNAL)), axis=0)[0]
    return np.where(enough, stops, 0.0), enough


def zone_signals(raw: NDArray[Any], camera: CameraProfile) -> Floats:
    """Mean green signals of the zones of observed frames, (N, zones); NaN where a pixel clips."""
    signal = linear_signal(raw, camera, GREEN)
    pixels = np.where(signal >= WHITE_SIGNAL, np.nan, signal).mean(axis=1)  # NaN if either does
    high, wide = (max(1, size // ZONES) for size in pixels.shape[1:])
    rows, columns = pixels.shape[1] // high, pixels.shape[2] // wide
    blocks = pixels[:, : rows * high, : columns * wide].reshape(-1, rows, high, columns, wide)
    return blocks.mean(axis=(2, 4), dtype=np.float64).reshape(len(signal), -1)
