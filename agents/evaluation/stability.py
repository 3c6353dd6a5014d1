"""Stability of controllers: a policy, or a law of control, in a closed loop with scalar light.

A camera with one aperture looks at still zones of grey. Every frame it is exposed by what was asked
for some frames ago, as a faulty actuator carries it out; the controller sees the frame and asks for
the next exposure. All cases run side by side: NumPy columns of (frames, cases), in stops.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from time import perf_counter
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd

from ae_env.grid import ExposureGrid
from ae_env.observation import PEDESTAL, encode_settings
from ae_env.utils.user_files import UserCodeError
from agents.evaluation.metrics import frames_to_settle, overshoot
from agents.metering.reading import TARGET_SIGNAL
from agents.metering.rpi_agc import zone_map
from agents.policy import Floats, Ints, Observations, PolicyContext
from agents.policy_names import is_metering, make_policy, split_options
from agents.rollouts import checked_states, choose, errors_of
from simulator.camera import get_camera
from simulator.utils.checks import check_flag, check_key, check_number, parse_number

#: Delays [frames], loop gains [stops: that of 1 moves the exposure by 2 EV for each asked for] and
#: steps of the light [EV] of the cases. A law of control, which is fast, has more gains.
DELAYS, STEPS = tuple(range(7)), (-8.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0, 8.0)
GAINS, LAW_GAINS = (0.0, 0.5, 1.0, 2.0), tuple(np.arange(0.0, 2.01, 0.125).tolist())
#: A fixed lens, exposure times and ISO speeds in third stops: within the ranges of all agents.
GRID = ExposureGrid(
    tuple(100.0 * 2 ** (i / 3) for i in range(19)), tuple(2.0 ** (i / 3) for i in range(-30, -14)),
    (4.0,),
)  # fmt: skip
#: Av of the lens, ranges of log2 of the time [s] and of the gain, and the EV100 in the middle.
AV, TIMES, MOST_GAIN = 4.0, (-10.0, -5.0), 6.0
CENTRE_EV = AV - 0.5 * (sum(TIMES) + MOST_GAIN)
#: Faults of an actuator. `gain`: a stop of gain asked for is 0.85 stops. `lines`: times are whole
#: sensor lines, the shortest is 8. `banding`: times from a period of the lamps' light on are
#: floored to whole ones, and the gain makes up for it. `early gain`: it arrives a frame before the
#: time. `every other`: the controller runs in every other frame only.
FAULTS = ("none", "gain", "lines", "banding", "banding and gain", "early gain", "every other")
RECIPROCITY, LINE, PERIOD = 0.85, 2.0**-13, 0.01
#: Frames before the step, in which the loop comes to rest, and after it.
LEAD, FRAMES = 32, 160
#: Swings below this are rest [EV]. A cycle crosses its mean so often in the tail, and lasts: in the
#: tail's second half it swings by at least this part of the first's.
CYCLE_EV, CROSSINGS, LASTING = 0.05, 3, 0.9
#: Autocorrelation from which a cycle has a period, relative to which the first lag is taken.
_PERIODIC, _NEARLY = 0.5, 0.95
#: Zones of grey [stops], of planes R, G, G, B of daylight; electrons at white at base gain; and
#: levels of the mean signal that a law reads.
_GREYS = 0.1 * np.array([0, 3, -4, 8, -10, 12, -16, 5, -6, 14, -20, 1, -2, 9, -13])
_PLANES, _ELECTRONS, LEVELS = np.array([0.5, 1.0, 1.0, 0.6]), 2.0**16, 2**12 - 1
#: Sides of frames, and most cases at once: of meters, and of agents and users' own policies, of
#: which more at once would be slower.
_SMALL, _USUAL = (16, 1024), (64, 32)


class Cases(NamedTuple):
    """Columns of the cases, ``(N,)``; `light` is the EV100 in the middle of its step."""

    fault: Ints  # index of `FAULTS`
    delay: Ints  # frames after the next until a request is in effect
    gain: Floats  # [stops]
    step: Floats  # of the light [EV]
    light: Floats

    def take(self, rows: Ints) -> "Cases":
        """The cases of these indices."""
        return Cases._make(column[rows] for column in self)


def all_cases(gains: Sequence[float] = GAINS, seed: int = 0) -> Cases:
    """Every fault x delay x gain x step; the light is up to 1/2 EV from the middle of the range."""
    axes = range(len(FAULTS)), DELAYS, gains, STEPS
    fault, delay, gain, step = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
    off = np.random.default_rng(seed).uniform(-0.5, 0.5, len(step))
    return Cases(fault, delay, gain, step, CENTRE_EV + off)


class Request(NamedTuple):
    """Exposure times and gains, log2, ``(N,)`` each: asked for, or carried out."""

    time: Floats  # [s]
    gain: Floats

    @property
    def ev100(self) -> Floats:
        """EV100 by these numbers."""
        return AV - self.time - self.gain


def split(ev100: Floats) -> Request:
    """The time goes up first, then the gain."""
    time = np.clip(AV - ev100, *TIMES)
    return Request(time, np.clip(AV - ev100 - time, 0.0, MOST_GAIN))


def carry_out(asked: Request, cases: Cases) -> tuple[Request, Floats]:
    """What the camera reports of a frame, and the EV100 at which it was really exposed."""
    time, gain = asked
    kinds = [("lines",), ("banding", "banding and gain"), ("gain", "banding and gain")]
    lines, banding, mismatch = (np.isin(FAULTS, kind)[cases.fault] for kind in kinds)
    seconds = np.exp2(time)
    whole = np.floor(seconds / PERIOD + 1e-9) * PERIOD
    seconds = np.where(banding & (whole > 0.0), whole, seconds)
    shown = np.log2(np.where(lines, np.maximum(np.round(seconds / LINE), 1.0) * LINE, seconds))
    made_up = np.where(banding, np.clip(gain + time - shown, 0.0, MOST_GAIN), gain)
    real = AV - shown - made_up * np.where(mismatch, RECIPROCITY, 1.0)
    return Request(shown, made_up), CENTRE_EV + np.exp2(cases.gain) * (real - CENTRE_EV)


# -- controllers ----------------------------------------------------------------------------------


@dataclass
class Proportional:
    """The law ``proportional:K``: each frame the EV moves by K times the error of its mean signal.

    Args:
        gain: K, stops a stop of error; 1 corrects all of it.
        dead_zone: Errors up to this are none [EV].
        slew: Most that the EV moves in a frame [EV].
        anchored: Count from what the frame was taken with, as libcamera does, not from what was
            asked for last, which frames under way do not show yet.
    """

    gain: float
    dead_zone: float = 0.0
    slew: float = 64.0
    anchored: bool = False

    def __post_init__(self) -> None:
        self.gain = check_number("K", self.gain, 1e-3, 16.0)
        self.dead_zone = check_number("dead_zone", self.dead_zone, 0.0, 16.0)
        self.slew = check_number("slew", self.slew, 1e-3, 64.0)
        check_flag("anchored", self.anchored)

    def reset(self, start: Request) -> None:
        """Begin at `start`."""
        self._asked = start.ev100

    def decide(self, signal: Floats, taken: Request) -> Request:
        """What to ask for after a frame of this mean signal, unclipped, and these settings."""
        seen = np.clip(np.round(signal * LEVELS), 0.5, LEVELS) / LEVELS
        error = np.log2(seen / TARGET_SIGNAL)
        error = np.where(np.abs(error) <= self.dead_zone, 0.0, error)
        base = taken.ev100 if self.anchored else self._asked
        move = np.clip(self.gain * error, -self.slew, self.slew)
        self._asked = np.clip(base + move, AV - TIMES[1] - MOST_GAIN, AV - TIMES[0])
        return split(self._asked)


class PolicyLoop:
    """A policy of the package or of a user's own, which sees frames of grey zones with noise."""

    def __init__(self, name: str, delay: int = 0, seed: int = 0) -> None:
        side, self.most = _SMALL if is_metering(name) else _USUAL
        raw = gym.spaces.Box(0, 255, (4, side, side), np.uint8)
        settings, sensors = (gym.spaces.Box(-1.0, 1.0, (size,)) for size in (3, 2))
        space = gym.spaces.Dict({"raw": raw, "settings": settings, "sensors": sensors})
        context = PolicyContext(GRID, get_camera("nikon_z6"), space, delays=(delay,) * 3)
        self.name, self.policy = name, make_policy(name, context)
        self._zones, self._seed = zone_map(side, side), seed
        shares = np.bincount(self._zones.ravel(), minlength=len(_GREYS)) / side**2
        greys = np.exp2(_GREYS)
        self._greys = greys / (shares @ greys) * _PLANES[:, None]  # (4, zones)
        states = GRID.controls(np.arange(len(GRID)))
        times, isos = np.log2(GRID.exposure_times), np.log2(GRID.isos) - np.log2(100.0)
        self._states = Request(times[states[:, 1]], isos[states[:, 0]])

    def reset(self, start: Request) -> None:
        """Begin new episodes at `start`."""
        self._rng = np.random.default_rng(self._seed)
        self._noise = self._rng.standard_normal((4, *self._zones.shape)).astype(np.float32)
        with errors_of(self.name, "reset"):
            self.policy.reset(len(start.time), seed=self._seed)

    def decide(self, signal: Floats, taken: Request) -> Request:
        """What to ask for after a frame of this mean signal, unclipped, and these settings."""
        frames = self._observe(signal, taken)
        masks = np.ones((len(signal), len(GRID)), bool)
        chosen = checked_states(self.name, choose(self.name, self.policy, frames, masks, {}), masks)
        return Request(*(column[chosen] for column in self._states))

    def _observe(self, signal: Floats, taken: Request) -> Observations:
        """Companded, photon noise is alike at all levels: it is added to the codes."""
        light = signal[:, None, None] * self._greys
        codes = 255.0 * np.sqrt((light + PEDESTAL) / (1.0 + PEDESTAL))
        spread = 127.5 * np.exp2(0.5 * taken.gain) / np.sqrt(_ELECTRONS)
        noise = np.roll(self._noise, self._rng.integers(len(self._zones), size=2), (1, 2))
        picture = codes.astype(np.float32)[:, :, self._zones]
        picture += spread.astype(np.float32)[:, None, None, None] * noise
        raw = np.rint(np.clip(picture, 0.0, 255.0, out=picture), out=picture).astype(np.uint8)
        apex = np.stack([np.full_like(signal, AV), -taken.time, taken.gain + 5.0], axis=1)
        still = np.full((len(signal), 2), -1.0, np.float32)  # and sharp
        return {"raw": raw, "settings": encode_settings(apex), "sensors": still}


Controller = Proportional | PolicyLoop


def make_controller(name: str, delay: int = 0, seed: int = 0) -> Controller:
    """The law or policy called `name`; a `ValueError` if there is none, or it needs scenes.

    A policy is told the `delay`; a law is not.
    """
    base, options = split_options(name)
    head, _, text = base.partition(":")
    if head != "proportional":
        return PolicyLoop(name, delay, seed)
    try:
        for option in options:
            check_key("options", option, ("dead_zone", "slew", "anchored"))
        return Proportional(parse_number(text, "K"), **options)
    except ValueError as error:
        raise ValueError(f"`policy` (={name!r}): {error}") from None


def check_controller(name: str) -> None:
    """Raises an error unless the controller called `name` chooses after one frame."""
    controller, start = make_controller(name), split(np.array([CENTRE_EV]))
    controller.reset(start)
    try:
        controller.decide(np.array([TARGET_SIGNAL]), start)
    except UserCodeError as error:
        if not isinstance(error.__cause__, ValueError):
            raise
        raise ValueError(f"`policy` (={name!r}): {error.__cause__}") from error


# -- the loop -------------------------------------------------------------------------------------


def run_loop(controller: Controller, cases: Cases, frames: int = FRAMES) -> Floats:
    """EV100 of the cases, (N, `LEAD` + `frames`); frame `LEAD` is the first of the other light.

    Cases in which the controller runs in every other frame must be alone.
    """
    every = 2 if (cases.fault == FAULTS.index("every other")).any() else 1
    longest, count = int(cases.delay.max()) + 1, len(cases.step)
    before, after = cases.light - 0.5 * cases.step, cases.light + 0.5 * cases.step
    start = split(CENTRE_EV + (before - CENTRE_EV) / np.exp2(cases.gain))
    asked = np.empty((2, longest + LEAD + frames, count))
    asked[:, :longest] = np.stack(start)[:, None]
    evs, columns = np.empty((count, LEAD + frames)), np.arange(count)
    early = (cases.fault == FAULTS.index("early gain")) & (cases.delay > 0)
    controller.reset(start)
    for frame in range(LEAD + frames):
        newest = longest + frame - 1 - cases.delay
        due = Request(asked[0, newest, columns], asked[1, newest + early, columns])
        taken, evs[:, frame] = carry_out(due, cases)
        light = before if frame < LEAD else after
        signal = TARGET_SIGNAL * np.exp2(light - evs[:, frame])
        if frame % every == 0:
            request = controller.decide(signal, taken)
        asked[:, longest + frame] = request
    return evs


def limit_cycles(evs: Floats) -> tuple[Floats, Floats]:
    """Amplitude [EV], 0 where the exposure rests or still decays, and period [frames], of the tail.

    `evs` (N, T) is the second half of what followed a step. A period is NaN where there is none:
    the exposure swings irregularly, or its cycle is longer than half of the tail.
    """
    half = evs.shape[1] // 2
    swing, *halves = (np.ptp(part, axis=1) for part in (evs, evs[:, :half], evs[:, half:]))
    about = evs - evs.mean(axis=1, keepdims=True)
    crossings = (np.diff(about > 0.0, axis=1)).sum(axis=1)
    cycles = (swing > CYCLE_EV) & (crossings >= CROSSINGS) & (halves[1] >= LASTING * halves[0])
    power = np.abs(np.fft.rfft(about, 2 * evs.shape[1])) ** 2
    likeness = np.fft.irfft(power)[:, :half] / np.arange(evs.shape[1], evs.shape[1] - half, -1)
    likeness /= np.maximum(likeness[:, :1], 1e-12)
    likeness[np.cumsum(likeness < 0.0, axis=1) == 0] = -1.0  # lags before the first turn
    best = likeness.max(axis=1, keepdims=True)
    period = np.argmax(likeness >= _NEARLY * best, axis=1).astype(np.float64)
    return np.where(cycles, swing, 0.0), np.where(cycles & (best[:, 0] > _PERIODIC), period, np.nan)


def measure(cases: Cases, evs: Floats) -> pd.DataFrame:
    """A row for each case: its axes, frames to settle, overshoot, error at the end, limit cycle.

    ``settling`` is NaN where the exposure does not stay within 1/3 EV in the second half. ``error``
    is by how much the brightness at the end differs from that before the step [EV].
    """
    after, tail = evs.shape[1] - LEAD, (evs.shape[1] - LEAD) // 2
    amplitude, period = limit_cycles(evs[:, -tail:])
    frames = frames_to_settle(evs, since=LEAD).astype(np.float64)
    rest = evs[:, -tail:].mean(axis=1) - evs[:, LEAD // 2 : LEAD].mean(axis=1)
    columns = {**cases._asdict(), "fault": np.array(FAULTS)[cases.fault]}
    columns |= {"settling": np.where(frames <= after - tail, frames, np.nan)}
    columns |= {"overshoot": overshoot(evs, since=LEAD), "error": cases.step - rest}
    return pd.DataFrame({**columns, "amplitude": amplitude, "period": period})


class Stability(NamedTuple):
    """What a controller does: a row for each case, its EV100s, and loop frames a second."""

    name: str
    cases: pd.DataFrame
    evs: Floats
    speed: float


def judge_stability(
    name: str,
    seed: int = 0,
    frames: int = FRAMES,
    progress: Callable[[float, float], None] | None = None,
) -> Stability:
    """Runs the controller called `name` through all cases."""
    controller = make_controller(name)
    cases = all_cases(LAW_GAINS if isinstance(controller, Proportional) else GAINS, seed)
    evs, begun, done = np.empty((len(cases.step), LEAD + frames)), perf_counter(), 0
    for rows, delay in _batches(cases, controller):
        evs[rows] = run_loop(make_controller(name, delay, seed), cases.take(rows), frames)
        done += len(rows)
        if progress is not None:
            progress(done, len(evs))
    return Stability(name, measure(cases, evs), evs, evs.size / (perf_counter() - begun))


def _batches(cases: Cases, controller: Controller) -> Iterator[tuple[Ints, int]]:
    """Cases that run together, and the delay that their controller is told."""
    alternate = cases.fault == FAULTS.index("every other")
    for delay in DELAYS if isinstance(controller, PolicyLoop) else (0,):
        told = isinstance(controller, Proportional) | (cases.delay == delay)
        for own in (~alternate, alternate):
            rows = np.flatnonzero(own & told)
            most = controller.most if isinstance(controller, PolicyLoop) else len(rows)
            for begin in range(0, len(rows), most):
                yield rows[begin : begin + most], delay


# -- what it comes to -----------------------------------------------------------------------------


def gain_limit(law: Proportional, delay: int) -> float:
    """Loop gain where a proportional law starts to oscillate: docs/results/controllers.md."""
    return 2.0 if law.anchored else float(2.0 * np.sin(np.pi / (4 * delay + 2)))


def stability_rows(found: Stability) -> pd.DataFrame:
    """A row for each fault and delay: of the cases at the loop's own gain, and the gain's margin.

    ``settling`` and ``settling_max`` [frames] are the median and the longest, NaN where a step does
    not settle, and ``settled`` is the share that does. ``overshoot`` and, where it settles,
    ``error`` are the largest [EV]. Limit cycles have a share ``cycles`` and the largest
    ``amplitude`` with its ``period``; ``pulses`` and ``pulse`` are the same of cases that settle.
    ``gain_margin`` is the largest gain [stops] up to which every step settles, ``analytic`` that of
    theory.
    """
    rows, law = list[dict[str, Any]](), make_controller(found.name)
    for fault, delay in product(FAULTS, DELAYS):
        own = found.cases[(found.cases.fault == fault) & (found.cases.delay == delay)]
        still = own.settling.notna()
        row: dict[str, Any] = {"policy": found.name, "fault": fault, "delay": delay}
        settles = still.groupby(own.gain).all()
        kept = settles[np.logical_and.accumulate(settles.to_numpy(bool))]
        row["gain_margin"] = float(kept.index[-1]) if len(kept) else np.nan
        row["analytic"] = np.nan
        if isinstance(law, Proportional) and not law.dead_zone and fault == "none":
            row["analytic"] = np.log2(gain_limit(law, delay) / law.gain)
        own, still = own[own.gain == 0.0], still[own.gain == 0.0]
        row |= {"settled": still.mean(), "settling": own.settling.median(skipna=False)}
        row |= {"settling_max": own.settling.max(skipna=False), "overshoot": own.overshoot.max()}
        row |= {"error": own.error[still].abs().max(), "cycles": (own.amplitude > 0.0).mean()}
        largest = own.iloc[own.amplitude.argmax()]
        row |= {"amplitude": largest.amplitude, "period": largest.period}
        pulsing = own.amplitude.where(still, 0.0)
        row |= {"pulses": (pulsing > 0.0).mean(), "pulse": pulsing.max()}
        rows.append(row)
    return pd.DataFrame(rows)
