"""What the learnt agents share: features of a frame, values of every state, optimiser steps."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from ae_env.grid import ExposureGrid
from ae_env.observation import PEDESTAL, SENSOR_RANGES, SETTINGS_RANGES, encode_settings
from agents.metering.meters import make_meter
from agents.metering.reading import frame_ev100
from agents.policy import Bools, Ints, Observations, PolicyContext
from simulator.utils.checkpoint import Checkpoint
from simulator.utils.config_file import Configuration

#: Takes frames (of a forecaster: steps) done, those in all, and the latest losses of a training.
Progress = Callable[[int, int, dict[str, float]], None]

#: Range of log2 luminance that the absolute plane maps to about [-1, 1], and the smallest signal
#: that it shows.
_LUMINANCE_CENTRE, _LUMINANCE_SCALE, _SIGNAL_FLOOR = 3.0, 8.0, 2.0**-12
#: Blocks are averaged so that the planes are about this large.
_PLANE_SIZE = 16
#: Channels of the CNN; their means over quarters of the frame and their maxima are features.
_CHANNELS, _QUARTERS = 48, 2
#: Zones of the meter a side; a code from this share of full scale on counts as clipped.
_ZONES, _CLIPPED = 4, 0.995
#: Samples a side, about, that the histogram of a frame's light counts; and the centres of its bins:
#: log2 luminance, in stops of EV100.
_COUNTED, _BINS = 32, torch.arange(-16.0, 24.0, 0.5)
#: Histograms of a frame, of all samples and of the brightest of each pixel; and the numbers in them
#: that describe its light to a `StateHead`.
_HISTOGRAMS, LIGHT_NUMBERS = 2, 2 * len(_BINS)
#: Levels above which a state would put how much of the light [stops from white], and the width of
#: the steps at them [stops].
_LEVELS = torch.tensor([1.0, 0.0, -1.0, -2.0, -3.0, -4.5, -6.0, -7.5, -9.0])
_SOFTNESS = 0.25
#: Likely values of the right exposure [standard deviations] and how likely each is (Gauss-Hermite),
#: and bounds of the log of their spread.
_LIKELY = torch.tensor(np.stack(np.polynomial.hermite_e.hermegauss(5))).float()
_LOG_SPREAD = (-2.0, 1.0)
#: log2 of the mean signal that an average meter exposes for.
_MEAN_SIGNAL = math.log2(0.12)
#: Numbers of a frame: metered EV against the newest frame's, exposure, clipping, what was asked for
#: after the frame before it (Av, Tv, Sv).
NUMBERS = 6
#: A history's numbers are within this.
_LARGEST = 4.0
#: Frames are shifted by up to this part of their size.
_LARGEST_SHIFT = 1 / 8


class ExposureFeatures(nn.Module):
    """A small CNN over the raw and its absolute luminance, and the numbers beside it.

    The raw alone does not tell a bright scene from a long exposure. A plane of absolute log
    luminance, log2 of the decoded green plus the EV100 of the frame's settings, does. The planes
    are averaged to about 16 x 16, with the maximum of the luminance as another: exposure is decided
    on coarse structure. The CNN's output is averaged over quarters of the frame, with its maxima: a
    network that sees where everything is memorises the training places. Mean luminance and clipped
    share of 4 x 4 zones, as of a light meter, are added.

    Args:
        observation_space: Observation of a single environment, with a uint8 ``raw``.
        width: Output features.
        dropout: Share of the CNN's channels that a training step leaves out.
    """

    def __init__(
        self, observation_space: gym.spaces.Dict, width: int = 256, dropout: float = 0.0
    ) -> None:
        super().__init__()
        raw = observation_space["raw"]
        if raw.dtype != "uint8" or raw.shape is None:
            raise ValueError(f"`observation_space['raw']` (={raw}) must be a uint8 image")
        self.has_sensors = "sensors" in observation_space.spaces
        history = observation_space.spaces.get("history")
        self.history = 0 if history is None else int(np.prod(history.shape or ()))
        self.numbers = 3 + (2 if self.has_sensors else 0) + 2 * _ZONES**2 + self.history
        self.block = max(1, min(raw.shape[1:]) // _PLANE_SIZE)
        self.cnn = nn.Sequential(
            nn.Conv2d(6, 24, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(24, 32, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(32, _CHANNELS, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Dropout2d(dropout),
        )
        pooled = _CHANNELS * (_QUARTERS**2 + 1)
        self.head = nn.Sequential(nn.Linear(pooled + self.numbers, width), nn.ReLU())
        self.ranges: torch.Tensor
        ranges = torch.tensor(SETTINGS_RANGES, dtype=torch.float32)
        self.register_buffer("ranges", ranges, persistent=False)
        self.log2_signal: torch.Tensor
        signals = _decode(torch.arange(256) / 255.0).clamp(min=_SIGNAL_FLOOR)
        self.register_buffer("log2_signal", signals.log2(), persistent=False)

    def forward(
        self,
        codes: torch.Tensor,
        settings: torch.Tensor,
        sensors: torch.Tensor | None,
        history: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Features (B, width) of `codes` (B, 4, H, W), the observed raw divided by 255.

        `settings` (B, 3) and `sensors` (B, 2) in [-1, 1], `history` (B, ...) if the space has them.
        """
        exposure = self._ev100(settings)[:, None, None, None]
        pooled = nn.functional.avg_pool2d(codes, self.block)  # (B, 4, ~16, ~16)
        peak = nn.functional.max_pool2d(codes[:, 1:2], self.block)  # of one green
        signal = _decode(pooled[:, 1:3].mean(dim=1, keepdim=True))
        planes = [pooled, _absolute(signal, exposure), _absolute(_decode(peak), exposure)]
        pool = nn.functional.adaptive_avg_pool2d
        zones = _absolute(pool(signal, _ZONES), exposure)
        clipped = pool((peak >= _CLIPPED).to(codes.dtype), _ZONES)
        found = self.cnn(torch.cat(planes, dim=1))
        features = [pool(found, _QUARTERS).flatten(1), found.amax(dim=(2, 3))]
        features += [zones.flatten(1), clipped.flatten(1)]
        numbers = [n for n in (settings, sensors, history) if n is not None]
        return self.head(torch.cat([*features, *numbers], dim=1))

    def light(
        self, codes: torch.Tensor, settings: torch.Tensor, histogram: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Histograms of the frame's luminance, ``(B, LIGHT_NUMBERS)``, for a `StateHead`.

        Observed statistics have a `histogram` (B, 128), shares of all samples by code.
        """
        step = max(1, min(codes.shape[2:]) // _COUNTED)
        counted = (codes[:, :, ::step, ::step] * 255.0).round().long()
        luminance = self.log2_signal + self._ev100(settings)[:, None]  # (B, 256), of each code
        counts = _count(counted)
        if histogram is not None:
            counts = histogram.repeat_interleave(2, dim=1) / 2.0  # two codes a bin
        every = _spread(counts, luminance)
        return torch.cat([every, _spread(_count(counted.amax(dim=1)), luminance)], dim=1)

    def _ev100(self, settings: torch.Tensor) -> torch.Tensor:
        """EV100 (B,) of settings (B, 3)."""
        low, high = self.ranges.unbind(dim=1)
        apex = low + (settings + 1.0) * 0.5 * (high - low)  # Av, Tv, Sv
        return apex[:, 0] + apex[:, 1] - apex[:, 2] + 5.0


def _decode(codes: torch.Tensor) -> torch.Tensor:
    """Signal of companded codes in [0, 1] (see `ae_env.observation`)."""
    return (1.0 + PEDESTAL) * codes.square() - PEDESTAL


def _absolute(signal: torch.Tensor, ev100: torch.Tensor) -> torch.Tensor:
    """log2 of the luminance that gives `signal` at `ev100`, scaled to about [-1, 1]."""
    luminance = signal.clamp(min=_SIGNAL_FLOOR).log2() + ev100
    return (luminance - _LUMINANCE_CENTRE) / _LUMINANCE_SCALE


def _count(codes: torch.Tensor) -> torch.Tensor:
    """Shares (B, 256) of the codes (B, ...) int64 of each frame."""
    flat = codes.flatten(1)
    counts = torch.zeros(flat.shape[0], 256, device=flat.device)
    return counts.scatter_add(1, flat, torch.ones_like(flat, dtype=counts.dtype)) / flat.shape[1]


def _spread(shares: torch.Tensor, luminance: torch.Tensor) -> torch.Tensor:
    """Shares (B, 256) of values at log2 `luminance` (B, 256) over `_BINS`, by linear weights."""
    place = ((luminance - _BINS[0]) / (_BINS[1] - _BINS[0])).clamp(0.0, len(_BINS) - 1.001)
    below = place.long()
    weight = place - below
    bins = shares.new_zeros(shares.shape[0], len(_BINS))
    bins = bins.scatter_add(1, below, shares * (1.0 - weight))
    return bins.scatter_add(1, below + 1, shares * weight)


class StateHead(nn.Module):
    """Values of every exposure state, by one small network that all states share.

    A state enters as its EV100, Av, Tv and Sv, the blur that the sensors predict for it, and the
    histogram of the frame as the state would expose it: which share of the light it puts above
    white and above so many stops below. So what is learnt about one state serves its neighbours,
    and any grid within the same ranges. Beside it stands what the features tell of the right
    exposure: how bright the state's frame would look, and how much too dark or too bright.

    Args:
        grid: The states.
        features: Size of the features that describe the frame.
        outputs: Values per state.
        trained_on: Grid that the weights come from, on whose scale states enter; default: `grid`.
    """

    def __init__(
        self,
        grid: ExposureGrid,
        features: int,
        has_sensors: bool,
        outputs: int = 1,
        trained_on: ExposureGrid | None = None,
    ) -> None:
        super().__init__()
        self.has_sensors = has_sensors
        grids = grid, trained_on or grid  # EV100, Av, Tv and Sv of every state, (S, 4):
        table, known = (torch.from_numpy(np.column_stack([g.ev100, g.apex])).float() for g in grids)
        self.table: torch.Tensor
        self.states: torch.Tensor
        spread = known.std(dim=0) if len(known) > 1 else torch.ones(known.shape[1])
        normalised = (table - known.mean(dim=0)) / spread.clamp(min=1.0)
        self.register_buffer("states", normalised, persistent=False)
        self.register_buffer("table", table, persistent=False)
        over = (_BINS[:, None, None] - table[:, :1] - _LEVELS) / _SOFTNESS  # (bins, S, levels)
        self.exposed: torch.Tensor
        self.register_buffer("exposed", torch.sigmoid(over), persistent=False)
        width = 64  # hidden units
        self.from_features = nn.Linear(features, width)
        self.from_light = nn.Linear(_HISTOGRAMS * len(_LEVELS) + 2, width, bias=False)
        self.luminance: torch.Tensor
        self.likely: torch.Tensor
        self.register_buffer("luminance", torch.exp2(_BINS), persistent=False)
        self.register_buffer("likely", _LIKELY / _LIKELY[:, 1:].sum(), persistent=False)
        self.right = nn.Linear(features, 2)
        self.from_state = nn.Linear(table.shape[1] + (2 if has_sensors else 0), width, bias=False)
        self.hidden = nn.Linear(width, width)
        self.values = nn.Linear(width, outputs)

    def right_ev100(
        self, features: torch.Tensor, light: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """EV100 (B,) of the right exposure, and the standard deviation of what is likely [EV].

        The features say by how much it differs from what an average meter of all colours reads.
        """
        gap, spread = self.right(features).unbind(dim=1)
        metered = (light[:, : len(_BINS)] @ self.luminance).log2() - _MEAN_SIGNAL
        return metered + gap, torch.exp(spread.clamp(*_LOG_SPREAD))

    def forward(
        self, features: torch.Tensor, light: torch.Tensor, sensors: torch.Tensor | None
    ) -> torch.Tensor:
        """Values (B, S, outputs), from what `ExposureFeatures` says of the frame."""
        mean, spread = self.right_ev100(features, light)
        wrong = mean[:, None, None] - self.table[:, :1]  # (B, S, 1)
        likely = wrong + spread[:, None, None] * self.likely[0]
        brightness = torch.exp(1.0 - torch.sqrt(1.0 + likely.square())) @ self.likely[1]
        exposure = torch.stack([brightness, torch.tanh(wrong[..., 0] / 3.0)], dim=2)
        states = self.states.expand(features.shape[0], -1, -1)  # (B, S, 4)
        if self.has_sensors:
            assert sensors is not None
            states = torch.cat([states, self._blur(sensors)], dim=2)
        histograms = light.view(light.shape[0], _HISTOGRAMS, len(_BINS))
        shares = torch.einsum("bhi,isl->bshl", histograms, self.exposed).flatten(2)
        of_state = self.from_state(states) + self.from_light(torch.cat([shares, exposure], dim=2))
        hidden = torch.relu(self.from_features(features)[:, None] + of_state)
        return self.values(torch.relu(self.hidden(hidden)))

    def _blur(self, sensors: torch.Tensor) -> torch.Tensor:
        """log2 of each state's blur in 64ths of the frame, and its loss of sharpness; scaled."""
        low, high = SENSOR_RANGES[:, 0], SENSOR_RANGES[:, 1]
        speed = low[0] + (sensors[:, :1] + 1.0) * 0.5 * (high[0] - low[0])
        defocus = low[1] + (sensors[:, 1:] + 1.0) * 0.5 * (high[1] - low[1])
        motion_px = torch.exp2(speed + 6.0 - self.table[:, 2])  # (B, S): 64 pixels a frame height
        defocus_px = torch.exp2(defocus + (2.0 - 0.5 * self.table[:, 1]))
        squared = motion_px.square() + defocus_px.square()
        return torch.stack([squared.log2() / 8.0, torch.log1p(squared) / 2.0], dim=2)


def exposure_loss(ev100: torch.Tensor, spread: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """Loss of what a `StateHead` says of the right exposure, whose EV100 is `right`; all (B,).

    The mean learns from the squared error, the spread from the likelihood at that error.
    """
    off = (ev100 - right).square()
    return (off + 0.5 * off.detach() / spread.square() + spread.log()).mean()


# -- what networks see beside a frame, and frames that look different each time --------------------


class MeterHistory:
    """Readings of a meter in the last `frames` frames, that in hand included, and the actions."""

    def __init__(self, context: PolicyContext, num_envs: int, frames: int) -> None:
        self._meter = make_meter("average", context.camera)
        self._apex = encode_settings(context.grid.apex)
        self._frames = np.full((num_envs, frames, NUMBERS), np.nan)
        self._action = np.full((num_envs, 3), np.nan)

    def observe(self, observations: Observations, rows: Bools | None = None) -> NDArray[np.float32]:
        """Takes in a frame of all cameras, or of those that `rows` marks.

        Returns the history (N, frames * NUMBERS), newest first.
        """
        reading, exposed = self._meter(observations), frame_ev100(observations)
        action = np.where(np.isnan(self._action), observations["settings"], self._action)
        numbers = [reading.ev100, (reading.ev100 - exposed) / 4.0, reading.saturated, *action.T]
        new = np.stack(numbers, axis=1)
        shifted = np.concatenate([new[:, None], self._frames[:, :-1]], axis=1)
        # Before the first frame there was the same.
        shifted = np.where(np.isnan(shifted), new[:, None], shifted)
        which = np.ones(len(new), bool) if rows is None else rows
        self._frames[which] = shifted[which]
        shown = self._frames.copy()
        shown[:, :, 0] = (shown[:, :, 0] - shown[:, :1, 0]) / 2.0
        return np.clip(shown, -_LARGEST, _LARGEST).reshape(len(shown), -1).astype(np.float32)

    def record_action(self, states: Ints) -> None:
        """Remembers the states that were asked for after the frame in hand, ``(N,)``."""
        self._action = self._apex[states].astype(np.float64)

    def forget(self, rows: Bools) -> None:
        """Forgets the frames of the cameras that `rows` marks."""
        self._frames[rows], self._action[rows] = np.nan, np.nan


def with_history(space: gym.spaces.Dict, frames: int) -> gym.spaces.Dict:
    """The observation `space` of a single environment with the history of so many frames."""
    box = gym.spaces.Box(-_LARGEST, _LARGEST, (frames * NUMBERS,), np.float32)
    return gym.spaces.Dict({**space.spaces, "history": box})


def random_shift(raw: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Frames (N, 4, H, W) shifted by up to an eighth, all alike, and mirrored half of the time.

    Shifted frames continue their border: the scores of all states stay nearly what they were.
    """
    for axis in (2, 3):
        size = raw.shape[axis]
        most = int(size * _LARGEST_SHIFT)
        places = np.arange(size) + rng.integers(-most, most + 1)
        raw = np.take(raw, np.clip(places, 0, size - 1), axis=axis)
    return np.ascontiguousarray(raw[..., ::-1]) if rng.random() < 0.5 else raw


# -- optimiser steps -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Session:
    """Where a training runs, what it reports to, and where its state is kept.

    A second run resumes from the file `checkpoint`, with new episodes, if that has the same
    `identity`, a JSON value; by default the hyperparameters.
    """

    checkpoint: Path | None = None
    progress: Progress | None = None
    device: str = "cpu"
    identity: Any = None

    def store(self, training: Configuration, state: Callable[[], Mapping[str, Any]]) -> Checkpoint:
        """The checkpoint of `training`, whose state is what `state` returns."""
        return Checkpoint(self.checkpoint, self.identity or training.model_dump(), state)

    def report(self, done: int, total: int, values: dict[str, float]) -> None:
        """Passes on how far the training is."""
        if self.progress is not None:
            self.progress(done, total, values)


#: A session without checkpoint and progress.
UNWATCHED = Session()


class Optimisation:
    """AdamW with a one-cycle schedule; a training that was interrupted goes on where it was.

    Of `steps` in all, `done` are. The learning rate, at its peak that of the hyperparameters
    `training`, rises in a share of `warm_up`. `store` is the checkpoint, a context manager.
    """

    def __init__(
        self,
        network: nn.Module,
        training: Any,
        session: Session,
        *,
        steps: int,
        warm_up: float = 0.3,
    ) -> None:
        self.network, self.done = network, 0
        rate, decay = training.learning_rate, training.weight_decay
        self.optimizer = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=decay)
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(
            self.optimizer, max_lr=rate, total_steps=steps + 1, pct_start=warm_up
        )
        parts: dict[str, Any] = {"network": network, "optimizer": self.optimizer}
        parts["schedule"] = self.schedule

        def state() -> dict[str, Any]:
            return {"step": self.done, **{name: part.state_dict() for name, part in parts.items()}}

        self.store = session.store(training, state)
        past = self.store.load()
        if past is not None:
            self.done = int(past["step"])
            for name, part in parts.items():
                part.load_state_dict(past[name])

    def step(self, loss: torch.Tensor) -> None:
        """One step down `loss`, a `ValueError` if it is not finite."""
        if not math.isfinite(loss.item()):
            raise ValueError(f"the loss (={loss.item()}) must be finite; lower `learning_rate`")
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        self.schedule.step()
        self.done += 1
