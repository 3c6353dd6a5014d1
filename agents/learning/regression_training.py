"""Training of the regression agent on score tables that the simulator makes for free."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from agents.learning.augmentation import moved
from agents.learning.optimisation import Optimisation
from agents.learning.regression import RegressionPolicy, ScoreRegressor, observation_tensors
from agents.learning.weights import MAX_WIDTH
from agents.policy import Observations, PolicyContext
from simulator.utils.config_file import Configuration

#: Past frames come in so many parts, each from another step.
_CHUNKS = 4


class RegressionTraining(Configuration):
    """Hyperparameters of the regression agent.

    Args:
        frames: Frames to take.
        learning_rate: Peak of the one-cycle schedule of AdamW.
        weight_decay: Of AdamW.
        replay: Frames of the recent past that each optimiser step sees again, per new frame.
        memory: Frames that are remembered for it.
        explore: Share of random actions; the others are the agent's own, so that it learns from
            the frames it will meet.
        width: Hidden features of the network.
        dropout: Share of the features that an optimiser step leaves out; see `ScoreRegressor`.
        seed: Seed of scenes, noise and weights.

    Raises:
        ValueError: If a value is out of range or an entry is unknown; the message names it.
    """

    frames: int = Field(default=100_000, ge=1, le=10**12)
    learning_rate: float = Field(default=5e-3, ge=1e-9, le=1.0)
    weight_decay: float = Field(default=1e-3, ge=0.0, le=1.0)
    replay: int = Field(default=2, ge=0, le=64)
    memory: int = Field(default=8192, ge=1, le=10**9)
    explore: float = Field(default=0.5, ge=0.0, le=1.0)
    width: int = Field(default=256, ge=1, le=MAX_WIDTH)
    dropout: float = Field(default=0.1, ge=0.0, le=0.99)
    seed: int = Field(default=0, ge=0, le=2**63)


def train_regression(
    envs: gym.vector.VectorEnv,
    training: RegressionTraining,
    *,
    checkpoint: Path | None = None,
    progress: Callable[[int, int, dict[str, float]], None] | None = None,
    device: str = "cpu",
    identity: Any = None,
) -> ScoreRegressor:
    """Trains a regression agent on the training scenes of `envs` (autoreset mode SAME_STEP).

    Args:
        envs: Vector environments.
        training: Hyperparameters.
        checkpoint: File for the state of the training, written three times a minute; a second run
            resumes from it, with new episodes and an empty memory of past frames.
        progress: Called with frames done, frames in all, and losses.
        device: Torch device of the network.
        identity: JSON value; the checkpoint of a training with another one is not resumed. By
            default the hyperparameters.

    Returns:
        The trained network.
    """
    context = PolicyContext.from_envs(envs)
    with _seeded("cpu", training.seed):
        network = ScoreRegressor(
            context.observation_space, context.grid, training.width, training.dropout
        )
    network.to(device)
    steps = max(2, training.frames // envs.num_envs)
    run = Optimisation(
        network,
        steps=steps,
        learning_rate=training.learning_rate,
        weight_decay=training.weight_decay,
        checkpoint=checkpoint,
        identity=identity or training.model_dump(),
        warm_up=0.1,
    )
    rollout = Rollout(envs, RegressionPolicy(context, network=network), training, run.done)
    with run.store:
        while run.done < steps:
            observations, target = rollout.batch()
            network.train()
            with _seeded(
                device, training.seed, run.done
            ):  # dropout draws from the global generator
                loss, seen = _loss(network, observations, target)
            run.step(loss)
            network.eval()
            if progress is not None:
                progress(run.done * envs.num_envs, steps * envs.num_envs, seen)
            run.store.save_when_due()
    return network


class Rollout:
    """Frames and the scores of all states, from episodes that the policy itself drives.

    Args:
        envs: Vector environments.
        policy: Chooses the actions that are not random.
        training: Hyperparameters.
        first_step: Optimiser steps that an earlier run has taken; every start draws other episodes.
    """

    def __init__(
        self,
        envs: gym.vector.VectorEnv,
        policy: RegressionPolicy,
        training: RegressionTraining,
        first_step: int = 0,
    ) -> None:
        self.envs, self.policy = envs, policy
        self.explore, self.base = training.explore, cast(Any, envs.unwrapped)
        self.rng = np.random.default_rng([training.seed, first_step])
        self.replay = Replay(training, np.random.default_rng([training.seed, first_step, 1]))
        self.observations: Observations | None = None

    def batch(self) -> tuple[dict[str, NDArray[Any]], NDArray[np.float64]]:
        """The next frame of every episode with its scores, and some earlier ones."""
        if self.observations is None:
            self.observations, _ = self.envs.reset(seed=int(self.rng.integers(2**31)))
            self.policy.reset(self.envs.num_envs)
        else:
            actions = self.policy.act(self.observations)
            random = self.rng.random(len(actions)) < self.explore
            others = self.rng.integers(len(self.policy.context.grid), size=len(actions))
            actions = np.where(random, others, actions)
            self.observations, _, terminated, truncated, _ = self.envs.step(actions)
            self.policy.forget(terminated | truncated)
        return self.replay.batch(self.observations, self.base.expected_scores())


class Replay:
    """The last frames and their scores, to be seen again, `moved`.

    Args:
        training: Hyperparameters.
        rng: Chooses the frames to see again.
    """

    def __init__(self, training: RegressionTraining, rng: np.random.Generator) -> None:
        self.training, self.rng = training, rng
        self.memory: list[dict[str, NDArray[Any]]] = []

    def batch(
        self, observations: Observations, target: NDArray[np.float64]
    ) -> tuple[dict[str, NDArray[Any]], NDArray[np.float64]]:
        """The new frames and some old ones; remembers the new ones and forgets the oldest."""
        new = {**observations, "target": target}
        parts = [new]
        for _ in range(_CHUNKS * min(self.training.replay, len(self.memory))):
            past = self.memory[self.rng.integers(len(self.memory))]
            rows = self.rng.integers(len(target), size=max(1, len(target) // _CHUNKS))
            seen = {name: values[rows] for name, values in past.items()}
            parts.append({**seen, "raw": moved(seen["raw"], self.rng)})
        steps = max(1, self.training.memory // len(target))
        self.memory = [*self.memory, new][-steps:]
        merged = {key: np.concatenate([p[key] for p in parts]) for key in new}
        return merged, merged.pop("target")


def _loss(
    network: ScoreRegressor, observations: Observations, target: NDArray[np.float64]
) -> tuple[torch.Tensor, dict[str, float]]:
    """Loss to minimise; the mean squared error, and what the states that seem best lose [score].

    The mean learns from the plain squared error, the confidence from the likelihood with that
    error held fixed: a large predicted variance cannot excuse a poor mean.
    """
    device = next(network.parameters()).device
    scores, log_variance = network(*observation_tensors(observations, device))
    known = torch.from_numpy(target).float().to(device)
    error = (scores - known).square()
    regret = known.amax(dim=1) - known.gather(1, scores.argmax(dim=1, keepdim=True))[:, 0]
    likelihood = (error.detach() * torch.exp(-log_variance) + log_variance).mean()
    loss = error.mean() + 0.01 * likelihood
    return loss, {"mse": error.mean().item(), "regret": regret.mean().item()}


@contextmanager
def _seeded(device: str, *seeds: int) -> Iterator[None]:
    """Within, torch's global generators are seeded; after, they are as they were before."""
    cuda = [torch.device(device)] if torch.device(device).type == "cuda" else []
    with torch.random.fork_rng(devices=cuda):
        number = int(np.random.SeedSequence(seeds).generate_state(1)[0])
        torch.default_generator.manual_seed(number)
        if cuda:
            torch.cuda.manual_seed(number)
        yield
