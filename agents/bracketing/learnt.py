"""A small network that learns which light hides where frames are white or in the noise."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import nn

from ae_env.observation import decode_sensors
from agents.bracketing.policies import Bracketing, Planner, describe
from agents.bracketing.schedules import BINS, Floats, light_histogram
from agents.learning.agent_weights import MAX_WIDTH, load_agent, load_into
from agents.learning.optimisation import Optimisation
from agents.policy import PolicyContext
from simulator.utils.checks import check_flag
from simulator.utils.config_file import Configuration

#: log2 of the blurs [64ths of the frame] at which their error is learnt; less has none.
BLURS = np.arange(-4.0, 8.0)
#: Samples below which a blur's error is not that of their mean but of the next narrower one.
_FEW = 16
#: Share of the scene's samples that counts as none.
_LEAST = 1e-6


class HiddenLight(nn.Module):
    """Spreads what frames show white over the lights above, what is in the noise over those below.

    Args:
        width: Hidden units.
    """

    def __init__(self, width: int = 128) -> None:
        super().__init__()
        self.width = width
        self.body = nn.Sequential(
            nn.Linear(3 * len(BINS), width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
        )
        self.above = nn.Linear(width, len(BINS))
        self.below = nn.Linear(width, len(BINS))
        self.blur: torch.Tensor
        self.register_buffer("blur", torch.zeros(len(BLURS)))  # error [EV] at `BLURS`

    def forward(self, described: torch.Tensor) -> torch.Tensor:
        """Shares (B, L) of the samples in each of `BINS`.

        Args:
            described: (B, 3, L), see `agents.bracketing.policies.describe`.
        """
        hidden = self.body((described + 1e-4).log().flatten(1) / 10.0 + 0.5)
        clear, white, noisy = described.unbind(dim=1)
        lowest = white.cumsum(dim=1) > 0.0  # at and above the bin at which white begins
        highest = noisy.flip(1).cumsum(dim=1).flip(1) > 0.0
        over = self.above(hidden).masked_fill(~lowest, -30.0).softmax(dim=1)
        under = self.below(hidden).masked_fill(~highest, -30.0).softmax(dim=1)
        found = clear + white.sum(dim=1, keepdim=True) * over
        return found + noisy.sum(dim=1, keepdim=True) * under


class LearntLight:
    """`HiddenLight` as a `LightEstimate`.

    Args:
        network: The trained network.
        hidden: Whether light is expected where frames are white or noisy, or only blur is known.
    """

    def __init__(self, network: HiddenLight, hidden: bool = True) -> None:
        self.network, self.hidden = network.eval(), hidden

    def __call__(self, described: NDArray[np.float32]) -> Floats:
        """(L,) shares in `BINS`."""
        if not self.hidden:
            return described.sum(axis=0, dtype=np.float64)
        with torch.inference_mode():
            found: Floats = self.network(torch.from_numpy(described)[None])[0].double().numpy()
        return found

    def blur_error(self, pixels: Floats) -> Floats:
        """Error of a blur over so many 64ths of the frame [EV]."""
        known = self.network.blur.double().numpy()
        log2 = np.log2(np.maximum(pixels, 2.0 ** (BLURS[0] - 1.0)))
        return np.interp(log2, BLURS, known, left=0.0)


class LearntBracket(Planner):
    """The planner with the light that a network expects.

    Args:
        context: The camera.
        weights: File that a training wrote; or give `network`.
        network: A network in memory.
        device: Not used: the network is too small to gain from another.
        hidden: See `LearntLight`.
    """

    def __init__(
        self,
        context: PolicyContext,
        weights: str | Path | None = None,
        network: HiddenLight | None = None,
        device: str = "cpu",
        hidden: bool = True,
    ) -> None:
        check_flag("hidden", hidden)
        if (weights is None) == (network is None):
            raise ValueError("give either `weights` or `network`")
        if network is None:
            tensors, card = load_agent(str(weights), "bracket")
            network = HiddenLight(card["width"])
            load_into(network, tensors, str(weights))
        super().__init__(context, LearntLight(network, hidden))
        self.name = "bracket"


class BracketTraining(Configuration):
    """Hyperparameters of the bracketing agent.

    Args:
        frames: Frames to take.
        learning_rate: Peak of the one-cycle schedule of AdamW.
        weight_decay: Of AdamW.
        memory: Frames that are remembered.
        batch_size: Remembered frames of an optimiser step.
        steps_per_frame: Optimiser steps each time that all environments have taken a frame.
        width: Hidden units of the network.
        seed: Seed of scenes, noise and weights.

    Raises:
        ValueError: If a value is out of range or an entry is unknown; the message names it.
    """

    frames: int = Field(default=40_000, ge=1, le=10**12)
    learning_rate: float = Field(default=3e-3, ge=1e-9, le=1.0)
    weight_decay: float = Field(default=1e-2, ge=0.0, le=1e3)
    memory: int = Field(default=20_000, ge=1, le=10**9)
    batch_size: int = Field(default=512, ge=1, le=10**9)
    steps_per_frame: int = Field(default=8, ge=1, le=10**6)
    width: int = Field(default=128, ge=1, le=MAX_WIDTH)
    seed: int = Field(default=0, ge=0, le=2**63)


def train_bracket(
    envs: gym.vector.VectorEnv,
    training: BracketTraining,
    *,
    checkpoint: Path | None = None,
    progress: Callable[[int, int, dict[str, float]], None] | None = None,
    device: str = "cpu",
    identity: Any = None,
) -> HiddenLight:
    """Trains the network on brackets of random frames (autoreset mode SAME_STEP).

    Args:
        envs: Vector environments of `ExposureBracket-v0`.
        training: Hyperparameters.
        checkpoint: File for the state of the training; a second run resumes from it, with new
            episodes and an empty memory.
        progress: Called with frames done, frames in all, and the loss.
        device: Torch device.
        identity: JSON value; the checkpoint of a training with another one is not resumed. By
            default the hyperparameters.
    """
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(training.seed % 2**63)
        network = HiddenLight(training.width).to(device)
    rounds = max(1, training.frames // envs.num_envs)
    run = Optimisation(
        network,
        steps=rounds * training.steps_per_frame,
        learning_rate=training.learning_rate,
        weight_decay=training.weight_decay,
        checkpoint=checkpoint,
        identity=identity or training.model_dump(),
    )
    first = run.done // training.steps_per_frame
    rng = np.random.default_rng([training.seed, first])
    frames = _RandomBrackets(envs, rng)
    known: list[NDArray[np.float32]] = []
    with run.store:
        for done in range(first, rounds):
            known = [*known, frames.next()][-max(1, training.memory // envs.num_envs) :]
            remembered = np.concatenate(known)
            for _ in range(training.steps_per_frame):
                rows = rng.integers(len(remembered), size=training.batch_size)
                batch = torch.from_numpy(remembered[rows]).to(device)
                found, target = network(batch[:, :3]), batch[:, 3]
                surprise = target * ((target + _LEAST) / (found + _LEAST)).log()
                loss = surprise.sum(dim=1).mean()  # Kullback-Leibler divergence
                run.step(loss)
            if progress is not None:
                values = {"divergence": loss.item()}
                progress((done + 1) * envs.num_envs, rounds * envs.num_envs, values)
            run.store.save_when_due()
    network.blur.copy_(torch.from_numpy(frames.blur_errors()))
    return network.eval()


class _RandomBrackets:
    """Brackets of random states: what their frames show, and the light that there is."""

    def __init__(self, envs: gym.vector.VectorEnv, rng: np.random.Generator) -> None:
        self.envs, self.rng = envs, rng
        self.base: Any = envs.unwrapped
        self.policy = Bracketing(PolicyContext.from_envs(envs))
        self.policy.reset(envs.num_envs)
        self.observations, _ = envs.reset(seed=int(rng.integers(2**31)))
        self._blurs: tuple[list[float], list[float]] = ([], [])

    def next(self) -> NDArray[np.float32]:
        """(N, 4, L): what each camera's frames show (3, L), and the light that there is."""
        policy, count = self.policy, self.envs.num_envs
        policy.observe(self.observations)
        out = np.empty((count, 4, len(BINS)), np.float32)
        for i in range(count):
            reference = float(policy._reference[i])
            out[i, :3] = describe(*policy.merged(i), reference)
            out[i, 3] = light_histogram(self.base.scene(i), reference)
        actions = self.rng.integers(policy.stop, size=count)
        self.observations, _, ended, _, info = self.envs.step(actions)
        self._note_blurs(actions, info, ended)
        policy.forget(ended)
        return out

    def _note_blurs(
        self, actions: NDArray[np.int64], info: dict[str, Any], ended: NDArray[np.bool_]
    ) -> None:
        """Remembers how far first frames are off that are neither white nor noisy."""
        speeds = decode_sensors(self.observations["sensors"])[0]
        noisy = self.observations["bracket"][:, 3]
        first = ~ended & (info["frames"] == 1) & (info["unseen"] < 0.01) & (noisy < 0.01)
        for i in np.flatnonzero(first & (speeds > 0.0)).tolist():
            pixels = 64.0 * speeds[i] * self.policy.context.grid[int(actions[i])].exposure_time
            self._blurs[0].append(float(np.log2(pixels)))
            self._blurs[1].append(float(info["log_error"][i]))

    def blur_errors(self) -> Floats:
        """Mean error [EV] at `BLURS`, which grows with the blur."""
        log2, errors = (np.array(values) for values in self._blurs)
        found = np.zeros(len(BLURS))
        for i, blur in enumerate(BLURS):
            near = np.abs(log2 - blur) <= 0.5
            mean = float(errors[near].mean()) if near.sum() >= _FEW else 0.0
            found[i] = max(mean, found[i - 1] if i else 0.0)
        return found - found[0]
