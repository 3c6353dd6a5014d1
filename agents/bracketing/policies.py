"""Bracketing policies: fixed steps around the meter's reading, Hasinoff's schedule, a planner.

A schedule is up to K states, in any order. Its error in a light L follows from the noise of merged
frames in closed form up to one integral, so all that fit into the time are rated at once.
"""

import copy
import itertools
from functools import lru_cache
from time import perf_counter
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import ndtri

from ae_env.grid import ExposureGrid
from ae_env.merging import LOG_FLOOR, SATURATED, WORST_EV, merge
from ae_env.observation import decode_observation, decode_sensors
from ae_env.tasks import FRAME_GAP
from agents.metering.reading import frame_states
from agents.policy import Bools, BracketLimits, Floats, Ints, Observations, Policy, PolicyContext
from agents.rollouts import RolloutPlan, checked_states, choose, errors_of, scenes_of
from simulator.camera import CameraProfile
from simulator.radiance.light import WHITE_SIGNAL
from simulator.utils.checks import check_flag, check_number

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

    Luminance is in units of that which makes an exposure at EV100 0 white. A schedule has `states`
    (M, K), -1 for none, each `counts` times (M, S), so many `frames` (M,), the `longest` of so long
    (M,) [s]; the first is no frame at all.
    """

    def __init__(self, grid: ExposureGrid, camera: CameraProfile, limits: BracketLimits) -> None:
        self.grid, self.limits = grid, limits
        budget, max_frames, box_factor = limits
        self.exposure_times = times = np.array([s.exposure_time for s in grid])
        found = [(-1,) * max_frames]
        for count in range(1, max_frames + 1):
            for chosen in itertools.combinations_with_replacement(range(len(grid)), count):
                if times[list(chosen)].sum() + FRAME_GAP * (count - 1) <= budget + _SLACK:
                    found.append((*chosen, *(-1,) * (max_frames - count)))
        self.states = np.array(found)
        self.counts = np.stack([(self.states == s).sum(axis=1) for s in range(len(grid))], axis=1)
        self.frames = (self.states >= 0).sum(axis=1)
        self.longest = np.where(self.counts > 0, times, 0.0).max(axis=1)
        nlfs = [nlf.scaled(1.0 / box_factor**2) for nlf in camera.nlfs(grid)]
        self.shot = np.array([np.mean(n.shot) for n in nlfs])
        self.read = np.array([np.mean(n.read) for n in nlfs])
        self.precision = lru_cache(maxsize=64)(self._precision)
        self.noise_error = lru_cache(maxsize=256)(self._noise_error)

    def _precision(self, reference: float) -> tuple[Floats, Floats]:
        """Inverse variance (M, L) of merged luminance, and each frame's share of it (M, K, L)."""
        luminance = np.exp2(BINS + reference)
        gain = np.exp2(-self.grid.ev100)[:, None]
        signal = gain * luminance
        variance = self.shot[:, None] * signal + self.read[:, None]
        weight = np.where(signal < SATURATED, gain**2 / variance, 0.0)  # (S, L)
        weight = np.concatenate([weight, np.zeros((1, len(BINS)))])  # of no frame
        each = weight[self.states]  # (M, K, L); -1 is the last
        total = each.sum(axis=1)
        return total, (each / np.maximum(total, 1e-300)[:, None]).astype(np.float32)

    def _noise_error(self, reference: float, floor: float) -> Floats:
        """(M, L) expected error of merged samples [EV]; `WORST_EV` where all frames are white.

        `floor` is log2 of the luminance below which errors count less, to the nearest stop.
        """
        total, _ = self.precision(reference)
        luminance, dark = np.exp2(BINS + reference), 2.0 ** round(floor)
        deviation = 1.0 / np.sqrt(np.maximum(total, 1e-300))
        error = np.zeros_like(total)
        for normal in _NORMALS:
            seen = np.maximum(luminance + normal * deviation, 0.0)
            ratio = np.abs(np.log2((seen + dark) / (luminance + dark)))
            error += np.minimum(ratio, WORST_EV) / _QUANTILES
        return np.where(total > 0.0, error, WORST_EV).astype(np.float32)

    def errors(self, reference: float, floor: float, light: Floats, blur: Floats) -> Floats:
        """(M,) expected error of each schedule over all samples [EV].

        `light` (L,) are the shares of the samples in `BINS`, which are relative to `reference`;
        `blur` (S,) is the error that the blur of each state makes [EV].
        """
        noise = self.noise_error(reference, floor)
        if not blur.any():
            return noise @ light.astype(np.float32)
        _, share = self.precision(reference)
        own = np.append(blur, 0.0).astype(np.float32)[self.states]  # (M, K)
        merged = (share * own[:, :, None]).sum(axis=1)
        both = np.where(noise < WORST_EV, np.hypot(noise, merged), noise)
        return np.minimum(both, WORST_EV) @ light.astype(np.float32)

    def completions(self, taken: Ints, time_left: float) -> Bools:
        """(M,) bool: schedules that hold the states `taken` and fit into the `time_left` [s]."""
        counts = np.bincount(taken, minlength=len(self.grid)) if len(taken) else 0
        more = self.frames - len(taken)
        needed = (self.counts - counts) @ self.exposure_times + FRAME_GAP * np.maximum(more - 1, 0)
        return np.asarray((self.counts >= counts).all(axis=1) & (needed <= time_left + _SLACK))

    def next_state(self, schedule: int, taken: Ints, alone: Floats) -> int:
        """The next state of `schedule`, of the least error `alone` (S,); S when all are taken."""
        left = self.counts[schedule].copy()
        np.subtract.at(left, taken, 1)
        wanted = np.flatnonzero(left > 0)
        return int(wanted[np.argmin(alone[wanted])]) if len(wanted) else len(alone)


#: log2 of the luminance below which errors count less, from the EV100 of the viewfinder's frame.
_FLOOR = float(np.log2(LOG_FLOOR * WHITE_SIGNAL))
#: Shares of the samples that are left out at either end of the range of a frame.
_TAIL = 0.005
#: Headrooms above white [EV] that `Hasinoff` tries when it is fitted.
HEADROOMS = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0)
#: Scenes that it is fitted on, at most.
_FIT_SCENES = 256
#: log2 of blurs [64ths of the frame height], and the error [EV] that each adds: the mean over first
#: frames, neither white nor noisy, of 64,000 random ones of the training scenes `mixed`.
BLURS = np.arange(-4.0, 8.0)
BLUR_ERRORS = np.array(
    [0.0, 0.0, 0.0, 0.00406927662, 0.0141781196, 0.0653904602, 0.170125484, 0.317824543]
    + 4 * [0.438196421],
    np.float32,  # as they were measured
)


class Bracketing(Policy):
    """Base of the policies: keeps the frames of each camera, and what they show together."""

    def __init__(self, context: PolicyContext) -> None:
        super().__init__(context)
        if context.bracket is None:
            raise ValueError(
                "bracketing policies are for ae_env/ExposureBracket-v0 (`ae-env evaluate --preset "
                "bracket`)"
            )
        space = context.observation_space
        if space["raw"].dtype != np.uint8 or "histogram" in space.spaces:
            raise ValueError("bracketing policies need `observation`='uint8'")
        self.schedules = Schedules(context.grid, context.camera, context.bracket)
        self.stop = len(context.grid)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forgets the frames so far."""
        super().reset(num_envs, seed)
        self._frames: list[list[tuple[int, NDArray[np.uint8]]]] = [[] for _ in range(num_envs)]
        self._reference = np.full(num_envs, np.nan)  # EV100 of the viewfinder's frame
        self._done = np.zeros(num_envs, bool)

    def observe(self, observations: Observations) -> None:
        """Keeps the frames of `observations`."""
        self.check_reset(observations)
        states = frame_states(observations, self.context.grid)
        for i, frames in enumerate(self._frames):
            if not self._done[i]:
                frames.append((int(states[i]), observations["raw"][i].copy()))
        new = np.isnan(self._reference)
        self._reference[new] = self.context.grid.ev100[states[new]]

    def taken(self, camera: int) -> Ints:
        """States of the frames that a camera has taken, without the viewfinder's."""
        return np.array([state for state, _ in self._frames[camera][1:]], np.int64)

    def merged(self, camera: int) -> tuple[Floats, Floats, float]:
        """Luminance of each sample in all frames of a camera, and its inverse variance, both flat.

        The third is log2 of the luminance that the shortest exposure shows white.
        """
        states = [state for state, _ in self._frames[camera]]
        codes = np.stack([raw for _, raw in self._frames[camera]])
        signals = torch.from_numpy(decode_observation(codes))[None]
        gains = np.exp2(-self.context.grid.ev100[states])
        shot, read = (
            torch.from_numpy(values[states])[None, :, None].expand(1, -1, 4).float()
            for values in (self.schedules.shot, self.schedules.read)
        )
        # Eight-bit codes are coarser than the noise of a bright sample.
        scale = float(gains.max())
        light, precision = merge(signals, torch.from_numpy(gains / scale)[None], shot, read)
        limit = -float(np.log2(gains.min()))
        luminance, known = (part.flatten().double().numpy() for part in (light, precision))
        return luminance / scale, known * scale**2, limit

    def act(self, observations: Observations, action_masks: Bools | None = None) -> Ints:
        """The next frame's state for each camera, or to stop."""
        self.observe(observations)
        left = np.asarray(observations["bracket"][:, 0], np.float64) * self.schedules.limits.budget
        speeds = np.zeros(self.num_envs)
        if "sensors" in observations:
            speeds = decode_sensors(observations["sensors"])[0]
        actions = np.full(self.num_envs, self.stop, np.int64)
        for i in np.flatnonzero(~self._done).tolist():
            actions[i] = self.choose(i, float(left[i]), float(speeds[i]))
        if action_masks is not None:
            actions = np.where(action_masks[np.arange(len(actions)), actions], actions, self.stop)
        self._done |= actions == self.stop
        return actions

    def choose(self, camera: int, time_left: float, speed: float) -> int:
        """The next state of a camera, or `stop`; `speed` of its shake [frame heights / s]."""
        raise NotImplementedError(f"{type(self).__name__} must implement `choose`")


class FixedBracket(Bracketing):
    """The meter's exposure and `step` stops above and below it, at the lowest ISO that fits.

    With a step of 0, the metered frame alone.
    """

    def __init__(self, context: PolicyContext, step: float = 2.0) -> None:
        super().__init__(context)
        self.step = check_number("step", step, 0.0, 16.0, more=" EV")
        self.name = f"bracket:fixed, {step:g} EV"

    def choose(self, camera: int, time_left: float, speed: float) -> int:
        """The next of the frames."""
        count = len(self.taken(camera))
        steps = np.array([0.0, 1.0, -1.0] if self.step else [0.0])
        wanted = (self._reference[camera] + self.step * steps)[: self.schedules.limits.max_frames]
        return self.stop if count >= len(wanted) else int(self._plan(wanted)[count])

    def _plan(self, wanted: Floats) -> Ints:
        """States within half a stop of the EV100 `wanted`, at the lowest ISO, that fit."""
        grid, times = self.context.grid, self.schedules.exposure_times
        off = (2.0 * np.abs(grid.ev100 - wanted[:, None])).round()
        off += 1e-3 * np.log2([s.iso for s in grid])
        for longest in reversed(grid.exposure_times):
            chosen: Ints = np.where(times <= longest, off, np.inf).argmin(axis=1)
            gaps = FRAME_GAP * (len(chosen) - 1)
            if times[chosen].sum() + gaps <= self.schedules.limits.budget:
                break
        return chosen


class Hasinoff(Bracketing):
    """The noise-optimal schedule: the largest signal-to-noise ratio in the worst light.

    Of all schedules that fit into the time, the one whose merged signal-to-noise ratio is largest
    where it is smallest over the range of the scene's light (Hasinoff et al., CVPR 2010). The range
    is that of the viewfinder's frame; where that is clipped it reaches `headroom` above white. The
    schedule knows no motion, so exposures are at most `longest` [s]. `fit` finds what is None on
    training scenes.
    """

    def __init__(
        self, context: PolicyContext, headroom: float | None = None, longest: float | None = None
    ) -> None:
        super().__init__(context)
        self.name = "bracket:hasinoff"
        if headroom is not None:
            headroom = check_number("headroom", headroom, 0.0, 16.0, more=" EV")
        if longest is not None:
            longest = check_number("longest", longest, context.grid.exposure_times[0], 3600.0)
        self.headroom, self.longest = headroom, longest

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forgets the frames and the schedules."""
        super().reset(num_envs, seed)
        self._plans: dict[int, int] = {}

    def fit(self, envs: gym.vector.VectorEnv[Any, Any, Any], seed: int = 0) -> None:
        """Takes what gives the best pictures of the training scenes."""

        def quality(headroom: float, longest: float) -> float:
            tried = copy.copy(self)
            tried.headroom, tried.longest = headroom, longest
            return float(run_brackets(tried, envs, seed=seed, most=_FIT_SCENES)["quality"].mean())

        headroom, longest = self.headroom, self.longest
        times = self.context.grid.exposure_times
        if longest is None:
            middle = HEADROOMS[len(HEADROOMS) // 2] if headroom is None else headroom
            longest = max(times, key=lambda time: quality(middle, time))
        if headroom is None:
            headroom = max(HEADROOMS, key=lambda stops: quality(stops, longest))
        self.headroom, self.longest = headroom, longest

    def choose(self, camera: int, time_left: float, speed: float) -> int:
        """The next frame of the schedule."""
        if self.headroom is None or self.longest is None:
            raise ValueError("policy 'bracket:hasinoff' learns from scenes first: call fit(envs)")
        reference = float(self._reference[camera])
        taken = self.taken(camera)
        if not len(taken):
            low, high = self._range(camera)
            total, _ = self.schedules.precision(reference)
            inside = (low <= BINS + reference) & (high >= BINS + reference)
            inside[np.abs(BINS + reference - 0.5 * (low + high)).argmin()] = True
            ratio = np.exp2(BINS + reference) * np.sqrt(total)
            worst = ratio[:, inside].min(axis=1) + 1e-6 * ratio[:, inside].mean(axis=1)
            fits = self.schedules.completions(taken, time_left)
            fits &= self.schedules.longest <= self.longest * (1.0 + 1e-6)
            self._plans[camera] = int(np.where(fits, worst, -1.0).argmax())
        plan = self._plans[camera]
        return self.schedules.next_state(plan, taken, np.abs(self.context.grid.ev100 - reference))

    def _range(self, camera: int) -> tuple[float, float]:
        """log2 of the least and the most luminance."""
        assert self.headroom is not None
        light, precision, limit = self.merged(camera)
        clear = light * np.sqrt(precision) > 1.0  # above the noise
        shown = light[clear & (precision > 0.0)]
        white = float((precision <= 0.0).mean())
        if not len(shown):
            return limit - 8.0, limit + self.headroom
        low, high = np.log2(np.quantile(shown, [_TAIL, 1.0 - _TAIL]))
        return float(low), limit + self.headroom if white > _TAIL else float(high)


def light_shares(light: Floats, precision: Floats, limit: float, reference: float) -> Floats:
    """(L,) shares of the samples in `BINS`, which are relative to `reference` [EV100].

    White samples count where they begin, at `limit`; those in the noise at the noise. See
    `Bracketing.merged`.
    """
    deviation = 1.0 / np.sqrt(np.maximum(precision, 1e-300))
    shown = np.where(light < 2.0 * deviation, deviation, light)
    place = np.log2(np.where(precision <= 0.0, 2.0**limit, shown)) - reference
    return np.bincount(bin_of(place), minlength=len(BINS)) / len(light)


class Planner(Bracketing):
    """Takes the frame that the best schedule for the light begins with, planned again each frame.

    With `blur`, the error of motion blur (`blur_error`) is added to that of noise.
    """

    def __init__(self, context: PolicyContext, blur: bool = True) -> None:
        super().__init__(context)
        check_flag("blur", blur)
        self.name, self.blur = "bracket" if blur else "bracket:planned", blur

    def choose(self, camera: int, time_left: float, speed: float) -> int:
        """The next state, or to stop where no further frame helps."""
        reference, taken = float(self._reference[camera]), self.taken(camera)
        pixels = 64.0 * speed * self.schedules.exposure_times
        blur = blur_error(pixels) if self.blur else np.zeros(self.stop)
        errors = self.schedules.errors(reference, reference + _FLOOR, self.light(camera), blur)
        best = int(np.where(self.schedules.completions(taken, time_left), errors, np.inf).argmin())
        alone = np.full(self.stop, np.inf)  # error of single frames; inf where none fits
        single = np.flatnonzero(self.schedules.frames == 1)
        alone[self.schedules.states[single, 0]] = errors[single]
        return self.schedules.next_state(best, taken, alone)

    def light(self, camera: int) -> Floats:
        """(L,) shares of the samples in `BINS`, as the frames so far show them."""
        return light_shares(*self.merged(camera), float(self._reference[camera]))


def blur_error(pixels: Floats) -> Floats:
    """Error [EV] of a blur over so many 64ths of the frame height, by linear interpolation."""
    log2 = np.log2(np.maximum(pixels, 2.0 ** (BLURS[0] - 1.0)))
    return np.interp(log2, BLURS, BLUR_ERRORS.astype(np.float64), left=0.0)


def run_brackets(
    policy: Policy,
    envs: gym.vector.VectorEnv[Any, Any, Any],
    *,
    count: int = 1,
    seed: int = 0,
    most: int | None = None,
    name: str | None = None,
) -> dict[str, NDArray[Any]]:
    """`count` episodes of each scene of `envs`, of `ExposureBracket-v0`, driven by `policy`.

    ``quality``, ``log_error``, ``unseen``, ``frames``, ``time_left`` and ``group`` of each episode,
    and the ``seconds`` that each decision took on average. The autoreset mode of `envs` is
    DISABLED; `count`, `seed` and `most` are those of `RolloutPlan.of_each_scene`; `name` is the
    policy's in errors.
    """
    name = name or policy.name
    names = ("quality", "log_error", "unseen", "frames", "time_left")
    found: list[dict[str, NDArray[Any]]] = []
    episodes = RolloutPlan.of_each_scene(scenes_of(envs), count=count, seed=seed, most=most)
    for batch in episodes.batches(envs):
        with errors_of(name, "reset"):
            policy.reset(envs.num_envs, batch.seed)
        observations, info, masks = batch.observations, batch.info, batch.action_masks
        base: Any = envs.unwrapped
        running = np.ones(envs.num_envs, bool)
        last: dict[str, NDArray[Any]] = {key: np.array(info[key], np.float64) for key in names}
        seconds, decisions = 0.0, 0
        while running.any():
            begun = perf_counter()
            chosen = choose(name, policy, observations, masks, info)
            seconds, decisions = seconds + perf_counter() - begun, decisions + envs.num_envs
            # A state that no longer fits is allowed, and ends the episode.
            actions = checked_states(name, chosen, np.ones_like(masks))
            observations, _, ended, _, info = envs.step(actions)
            for key in names:
                last[key][running] = info[key][running]
            running &= ~ended
            if running.any() and ended.any():  # the others go on with episodes that do not count
                observations, _ = base.reset(options={"reset_mask": ended})
            masks = base.action_masks()
        last |= {"group": batch.groups, "seconds": np.full(envs.num_envs, seconds / decisions)}
        found.append({key: values[batch.valid] for key, values in last.items()})
    return {key: np.concatenate([one[key] for one in found]) for key in found[0]}
