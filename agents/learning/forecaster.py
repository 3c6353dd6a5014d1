"""A forecaster of light with a memory: a recurrent network over what a light meter reads.

It learns from light that is drawn (`ae_env.lighting.moving`, the training kinds, mixed and bent),
as a meter reads it on frames exposed for the light of some frames before: clipped where they are
too bright, noisy where they are dark. It needs no picture, so it trains in minutes. Beside it,
light that repeats itself is foreseen from what came after light like it (`analogues`).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from pydantic import Field
from torch import nn

from ae_env.lighting.moving import FRAMES, KIND_SETS, MOVES
from agents.learning.networks import UNWATCHED, Optimisation, Session
from agents.learning.policy_file import MAX_WIDTH, load_agent
from agents.metering.reading import (
    BLACK_SIGNAL,
    TARGET_SIGNAL,
    WHITE_SIGNAL,
    Reading,
    ZoneMatcher,
    mean_reading,
)
from agents.policy import Floats, PolicyContext
from agents.policy_names import FORECASTERS, LEARNT, weight_files
from simulator.networks.weights import load_into
from simulator.utils.config_file import Configuration

#: Frames ahead that are forecast, from the frame in hand (0) on.
HORIZON = 4
#: Kinds of light that it learns from; lamps have no light that goes anywhere.
KINDS = tuple(kind for kind in KIND_SETS["train"] if kind != "lamps")
#: Frames of a sample, and numbers that describe one.
_LENGTH, _INPUTS = 128, 4
#: Frames that past light is compared in, and those that are remembered for it. How alike it must be
#: to count [EV]: so much, and a share of how unlike the most alike is. Like those below, chosen on
#: the training kinds and on stretches of them that repeat themselves or go to and fro.
_COMPARED, _REMEMBERED, _ALIKE, _OF_BEST = 5, 128, 0.05, 0.2
#: The newest error's share in the mean of a forecast's errors, that mean at first, what is added to
#: it [EV], and the power of it that divides the forecast's weight.
_NEWEST, _FIRST_ERROR, _LEAST_ERROR, _POWER = 0.15, 0.3, 0.05, 4
#: Changes beyond this are not learnt from, and the least spread of a forecast [EV].
_LARGEST, _LEAST_SPREAD = 8.0, 0.02


class ForecasterTraining(Configuration):
    """Hyperparameters of a forecaster."""

    steps: int = Field(default=10_000, ge=2, le=10**9)  # optimiser steps
    batch_size: int = Field(default=64, ge=1, le=10**6)  # sequences of a step
    #: At its highest, of a one-cycle schedule.
    learning_rate: float = Field(default=4e-3, ge=1e-9, le=1.0)
    weight_decay: float = Field(default=1e-3, ge=0.0, le=1e3)  # of AdamW
    width: int = Field(default=64, ge=1, le=MAX_WIDTH)  # units of the recurrent network
    traces: int = Field(default=4096, ge=1, le=10**6)  # traces of light that are drawn
    #: Share of the light that is a sum of two to four kinds.
    mixed: float = Field(default=0.5, ge=0.0, le=1.0)
    #: Share of the light that is cut at a level above or below, as light is that comes through
    #: gaps; likewise the share whose pace varies, and the share that is smoothed.
    bent: float = Field(default=0.4, ge=0.0, le=1.0)
    seed: int = Field(default=0, ge=0, le=2**32 - 1)  # seed of light, frames and weights


class LightForecaster(nn.Module):
    """Change of the light in the next frames, from the readings so far, by `width` units."""

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.width = width
        self.inputs = nn.Sequential(nn.Linear(_INPUTS, width), nn.ReLU())
        self.memory = nn.GRU(width, width, batch_first=True)
        self.outputs = nn.Linear(width, 2 * (HORIZON + 1))

    def forward(
        self, readings: torch.Tensor, state: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Forecast of the next frames, from each of the `readings` (B, T, 4) on.

        Changes of the light (B, T, HORIZON + 1) [EV]; their spreads, the mean absolute error
        expected; and the `state` (1, B, width) for the frames that follow.
        """
        found, state = self.memory(self.inputs(readings), state)
        changes, spreads = self.outputs(found).chunk(2, dim=-1)
        return changes, nn.functional.softplus(spreads) + _LEAST_SPREAD, state


def network_inputs(reading: Reading, before: Floats, exposed_at: Floats) -> NDArray[np.float32]:
    """Inputs of the network for a frame, (..., 4): changes and exposure in stops, clipping.

    `before` is the metered EV100 of the frame before, `exposed_at` that of the settings.
    """
    change, exposure = (reading.ev100 - before) / 2.0, (reading.ev100 - exposed_at) / 4.0
    return np.stack([change, exposure, reading.saturated, reading.black], -1).astype(np.float32)


def analogues(light: Floats) -> tuple[Floats, Floats]:
    """What came after light like the latest, as it was and in reverse (Lorenz 1969).

    Every five frames of `light` (N, T) [EV] are compared with the last five. The changes after
    them, or in reverse those before them, are averaged, most of all those of the most alike.
    Returns the changes, (N, 2, HORIZON), and how unlike the most alike are, (N, 2) [EV].
    """
    before = np.repeat(light[:, :1], _COMPARED + HORIZON - 1, axis=1)
    known = np.concatenate([before, light], axis=1)
    stretches = sliding_window_view(known, _COMPARED, axis=1)
    ahead = sliding_window_view(known, HORIZON + 1, axis=1)
    found = []
    for others, after in (
        (stretches[:, :-HORIZON], ahead[:, _COMPARED - 1 :]),
        (stretches[:, HORIZON:, ::-1], ahead[:, : 1 - _COMPARED, ::-1]),
    ):
        apart = np.sqrt(np.square(others - stretches[:, -1:]).mean(axis=2))
        least = apart.min(axis=1, keepdims=True)
        weights = np.exp((least - apart) / (_ALIKE + _OF_BEST * least))
        change = np.einsum("nt,nth->nh", weights, after[..., 1:] - after[..., :1])
        found.append((change / weights.sum(axis=1, keepdims=True), least[:, 0]))
    changes, unlike = zip(*found, strict=True)
    return np.stack(changes, axis=1), np.stack(unlike, axis=1)


class LearntTracker:
    """The forecasts of trained networks and of `analogues`, as a `LightTracker`.

    Networks are averaged; where they differ, they are less sure. They and the two analogues weigh
    by how far off each was so far, and by the error it expects or how unlike the light is.
    """

    def __init__(self, num_envs: int, networks: Sequence[LightForecaster]) -> None:
        self.networks = networks
        self._light = np.empty((num_envs, 0))
        self._states: list[torch.Tensor | None] = [None] * len(networks)
        self._expected, self._spread = np.full((2, num_envs, HORIZON + 1), np.nan)
        self._forecasts: list[Floats] = []  # of the last frames, (N, 3, HORIZON) each
        self._errors = np.full((num_envs, 3, HORIZON), _FIRST_ERROR)

    def update(self, reading: Reading, exposed_at: Floats) -> None:
        """Take in one frame's reading."""
        light = reading.ev100[:, None]
        for i, forecast in enumerate(reversed(self._forecasts)):
            error = np.abs(forecast[:, :, i] - light)
            self._errors[:, :, i] += _NEWEST * (error - self._errors[:, :, i])
        self._light = np.concatenate([self._light, light], axis=1)[:, -_REMEMBERED:]
        before = self._light[:, -2:][:, 0]  # in the first frame itself
        inputs = torch.from_numpy(network_inputs(reading, before, exposed_at))[:, None]
        inputs = inputs.to(next(self.networks[0].parameters()).device)
        found = []
        with torch.inference_mode():
            for i, network in enumerate(self.networks):
                changes, spreads, self._states[i] = network(inputs, self._states[i])
                found.append(torch.stack([changes[:, 0], spreads[:, 0]]).double().cpu().numpy())
        changes, spreads = np.stack(found, axis=1)  # (networks, N, HORIZON + 1) each
        expected = light + changes.mean(axis=0)
        spread = np.sqrt((spreads**2).mean(axis=0) + changes.var(axis=0))
        changes, unlike = analogues(self._light)
        forecasts = np.concatenate([expected[:, None, 1:], light[:, None] + changes], axis=1)
        off = self._errors + _LEAST_ERROR
        off[:, 0] = np.sqrt(off[:, 0] * (spread[:, 1:] + _LEAST_ERROR))
        off[:, 1:] += unlike[:, :, None]
        weights = off**-_POWER / (off**-_POWER).sum(axis=1, keepdims=True)
        self._forecasts = [*self._forecasts, forecasts][-HORIZON:]
        self._expected = np.column_stack([expected[:, 0], (weights * forecasts).sum(axis=1)])
        self._spread = np.column_stack([spread[:, 0], (weights * off).sum(axis=1)])

    def ahead(self, frames: int) -> tuple[Floats, Floats]:
        """See `LightTracker.ahead`; at most `HORIZON` frames."""
        return self._expected[:, frames], self._spread[:, frames]


def load_forecaster(path: str | Path, device: str = "cpu") -> LightForecaster:
    """The forecaster that a training wrote; raises as `load_agent`."""
    tensors, card = load_agent(path, "forecaster")
    with torch.device("meta"):  # what a card claims takes no memory: the file's tensors are used
        network = LightForecaster(card["width"])
    load_into(network, tensors, f"`weights` (={str(path)!r})")
    return network.to(device, torch.float32).eval()


def load_forecasters(
    foresight: str, context: PolicyContext, device: str = "cpu"
) -> list[LightForecaster]:
    """The forecasters that an option ``foresight`` of a policy names.

    A `ValueError` if there are none, or they look less far ahead than the camera's delays.
    """
    pattern = FORECASTERS if foresight == LEARNT else foresight
    files = weight_files(pattern) if isinstance(pattern, str) else []
    if not files:
        raise ValueError(
            f"`foresight` (={foresight!r}) must be 'none', 'trend', {LEARNT!r} or the name of a "
            "forecaster's files, as `ae-env train` writes them"
        )
    if 1 + max(context.delays) > HORIZON:
        raise ValueError(
            f"`foresight` (={foresight!r}) forecasts {HORIZON} frames, and a delay of "
            f"{max(context.delays)} asks for {1 + max(context.delays)}: use 'trend'"
        )
    return [load_forecaster(file, device) for file in files]


def train_forecaster(training: ForecasterTraining, session: Session = UNWATCHED) -> LightForecaster:
    """Trains a forecaster on light of the training kinds."""
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(training.seed)
        network = LightForecaster(training.width).to(session.device)
    run = Optimisation(network, training, session, steps=training.steps)
    rng = np.random.default_rng([training.seed, run.done])
    traces = np.stack([MOVES[KINDS[i % len(KINDS)]](rng) for i in range(training.traces)])
    with run.store:
        while run.done < training.steps:
            readings, changes = sample(traces, training, rng)
            found, spread, _ = network(torch.from_numpy(readings).to(session.device))
            error = (found - torch.from_numpy(changes).to(session.device)).abs()
            run.step((error / spread + spread.log()).mean())  # likelihood of a Laplace distribution
            session.report(run.done, training.steps, {"EV": error.mean().item()})
            run.store.save_when_due()
    return network.eval()


def sample(
    traces: Floats, training: ForecasterTraining, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Descriptions (B, T, 4) of frames in drawn light, and the changes (B, T, HORIZON + 1) [EV]."""
    count = training.batch_size

    def windows() -> Floats:
        rows = rng.integers(len(traces), size=count)
        starts = rng.integers(FRAMES // 4, size=count)
        frames = np.arange(_LENGTH + HORIZON, dtype=np.float64)
        varies = rng.random((count, 1)) < training.bent
        turn = frames / rng.uniform(20.0, 80.0, (count, 1)) + rng.random((count, 1))
        pace = (1.0 + 0.4 * np.sin(2.0 * np.pi * turn)) * np.exp(rng.normal(0.0, 0.2, (count, 1)))
        times = starts[:, None] + np.cumsum(np.where(varies, pace, 1.0), axis=1)
        times = np.minimum(times, FRAMES - 2)
        below = times.astype(np.int64)
        weight = times - below
        known = traces[rows]
        first = np.take_along_axis(known, below, axis=1)
        return first + weight * (np.take_along_axis(known, below + 1, axis=1) - first)

    light = windows()
    mixed = rng.random((count, 1)) < training.mixed
    for _ in range(3):
        share = rng.uniform(0.0, 0.8, (count, 1)) * (mixed & (rng.random((count, 1)) < 0.6))
        light = light * np.where(share > 0.0, rng.uniform(0.4, 1.0, (count, 1)), 1.0)
        light += share * windows()
    light = _bent(light, training.bent, rng)
    light += rng.uniform(4.0, 14.0, (count, 1))
    reading, exposed_at = metered(light, rng)
    before = np.concatenate([reading.ev100[:, :1], reading.ev100[:, :-1]], axis=1)
    described = network_inputs(reading, before, exposed_at)[:, :_LENGTH]
    ahead = np.stack([light[:, k : k + _LENGTH] for k in range(HORIZON + 1)], axis=-1)
    changes = np.clip(ahead - reading.ev100[:, :_LENGTH, None], -_LARGEST, _LARGEST)
    return described, changes.astype(np.float32)


def _bent(light: Floats, share: float, rng: np.random.Generator) -> Floats:
    """`light` (B, T), cut below or above a level, and smoothed, in `share` of the rows each."""
    count = len(light)
    middle, spread = light.mean(axis=1, keepdims=True), light.std(axis=1, keepdims=True)
    for cut in (np.minimum, np.maximum):
        level = middle + spread * rng.normal(0.0, 0.7, (count, 1))
        light = np.where(rng.random((count, 1)) < share, cut(light, level), light)
    smoothed = light.copy()
    for lag in (1, 2):
        smoothed[:, lag:] += light[:, :-lag]
        smoothed[:, :lag] += light[:, :1]
    return np.where(rng.random((count, 1)) < share, smoothed / 3.0, light)


def metered(light: Floats, rng: np.random.Generator) -> tuple[Reading, Floats]:
    """Readings of an average meter on frames exposed for the light three frames before, (B, T).

    A frame is 64 luminances, normal in stops with a mean of 1; each exposure is off by about half a
    stop, and of a grid of whole stops. `light` (B, T) is in EV100. Returns the readings, matched
    where frames clip, and the EV100 of the exposures, (B, T) each.
    """
    count, frames = light.shape
    spread = rng.uniform(0.8, 2.2, (count, 1))
    luminance = np.exp2(np.minimum(rng.normal(0.0, spread, (count, 64)), 5.0))
    luminance /= luminance.mean(axis=1, keepdims=True)
    late = np.concatenate([np.repeat(light[:, :1], 3, axis=1), light], axis=1)[:, :frames]
    off = rng.normal(0.0, 0.6, (count, 1)) + rng.normal(0.0, 0.3, light.shape)
    exposed_at = np.round(late + off)
    signal = TARGET_SIGNAL * np.exp2(light - exposed_at)[:, :, None] * luminance[:, None]
    saturated = (signal >= WHITE_SIGNAL).mean(axis=2)
    mean = np.minimum(signal, 1.0).mean(axis=2) + rng.normal(0.0, BLACK_SIGNAL, light.shape)
    shown = np.where(signal >= WHITE_SIGNAL, np.nan, signal)
    matcher, read = ZoneMatcher(), []
    for t in range(frames):
        taken_at = exposed_at[:, t]
        reading = mean_reading(mean[:, t], saturated[:, t], taken_at)
        read.append(matcher.match(reading, shown[:, t], taken_at))
    columns = zip(*read, strict=True)
    return Reading(*(np.stack(column, axis=1) for column in columns)), exposed_at
