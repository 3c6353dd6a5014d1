"""The regression agent: predict the score of every state from one frame, take the best.

After the auto-exposure application of Ouyang et al. (CVPR 2021): a small CNN learns from score
tables that the simulator makes for free. Predictions are accumulated over the frames of an episode,
each weighted by the network's own confidence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from ae_env.grid import ExposureGrid
from agents.history import History
from agents.network_policy import NetworkPolicy
from agents.networks import ExposureFeatures, StateHead
from agents.policy import Observations, PolicyContext, masked_argmax
from agents.ranges import check_ranges
from agents.weights import MAX_WIDTH, describe_context, save_agent
from simulator.checkpoint import Checkpoint

#: Bounds of the predicted log variance.
_LOG_VARIANCE = (-8.0, 0.0)


class ScoreRegressor(nn.Module):
    """Predicts the score of each state, and how sure it is.

    Args:
        observation_space: Observation of a single environment.
        grid: The exposure states.
        width: Features that describe a frame.
        dropout: Share of the features that a training step leaves out.
    """

    def __init__(
        self,
        observation_space: gym.spaces.Dict,
        grid: ExposureGrid,
        width: int = 256,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.width = width
        self.features = ExposureFeatures(observation_space, width)
        self.dropout = nn.Dropout(dropout)
        self.states = StateHead(grid, width, "sensors" in observation_space.spaces, outputs=2)

    def forward(
        self, codes: torch.Tensor, settings: torch.Tensor, sensors: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Expected score and log variance of the prediction, both (B, S)."""
        features = self.dropout(self.features(codes, settings, sensors))
        values = self.states(features, sensors)
        scores, log_variance = values.unbind(dim=2)
        return torch.sigmoid(scores), log_variance.clamp(*_LOG_VARIANCE)


def observation_tensors(
    observations: Observations, device: torch.device | str = "cpu"
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    """The network's three inputs from batched observations."""
    codes = torch.as_tensor(observations["raw"], device=device).float().div_(255.0)
    settings = torch.as_tensor(observations["settings"], device=device)
    sensors = observations.get("sensors")
    return codes, settings, None if sensors is None else torch.as_tensor(sensors, device=device)


class RegressionPolicy(NetworkPolicy):
    """Takes the state with the highest accumulated prediction; see `NetworkPolicy`."""

    kind = "regression"

    @staticmethod
    def make_network(context: PolicyContext, width: int) -> ScoreRegressor:
        """See `NetworkPolicy`."""
        return ScoreRegressor(context.observation_space, context.grid, width)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forgets the frames so far."""
        super().reset(num_envs, seed)
        self._weighted = np.zeros((num_envs, len(self.context.grid)))
        self._precision = np.zeros_like(self._weighted)

    def act(
        self, observations: Observations, action_masks: NDArray[np.bool_] | None = None
    ) -> NDArray[np.int64]:
        """Best state (N,) after this frame and those before it."""
        device = next(self.network.parameters()).device
        with torch.inference_mode():
            scores, log_variance = self.network(*observation_tensors(observations, device))
        precision = torch.exp(-log_variance).double().cpu().numpy()
        self._weighted += precision * scores.double().cpu().numpy()
        self._precision += precision
        return masked_argmax(self._weighted / self._precision, action_masks)

    @property
    def accumulated(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What the episodes so far add up to, (N, S) each: weighted scores, and their weights."""
        return self._weighted, self._precision

    @accumulated.setter
    def accumulated(self, values: tuple[NDArray[np.float64], NDArray[np.float64]]) -> None:
        self._weighted, self._precision = (np.array(own) for own in values)

    def forget(self, done: NDArray[np.bool_]) -> None:
        """Begins anew in those environments whose episode is over."""
        self._weighted[done] = 0.0
        self._precision[done] = 0.0


@dataclass(frozen=True)
class RegressionTraining:
    """How the regression agent is trained.

    Args:
        frames: Frames that it takes.
        learning_rate: Peak of the one-cycle schedule of AdamW.
        weight_decay: Of AdamW.
        replay: Frames of the recent past that each optimiser step sees again, per new frame.
        memory: Frames that are remembered for it.
        explore: Share of random actions; the others are the agent's own, so that it learns from
            the frames it will meet.
        width: Hidden features of the network.
        dropout: Share of the features that an optimiser step leaves out.
        seed: Of scenes, noise and weights.
    """

    frames: int = 100_000
    learning_rate: float = 5e-3
    weight_decay: float = 1e-3
    replay: int = 2
    memory: int = 8192
    explore: float = 0.5
    width: int = 256
    dropout: float = 0.1
    seed: int = 0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            frames=(1, 1e12),
            learning_rate=(1e-9, 1.0),
            weight_decay=(0.0, 1.0),
            replay=(0, 64),
            memory=(1, 1e9),
            explore=(0.0, 1.0),
            width=(1, MAX_WIDTH),
            dropout=(0.0, 0.99),
            seed=(0, 2**63),
        )


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
        checkpoint: Where to keep the state of the training, three times a minute or so; a second
            run goes on there and ends with the weights that the first would have ended with.
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
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=training.learning_rate, weight_decay=training.weight_decay
    )
    steps = max(2, training.frames // envs.num_envs)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, max_lr=training.learning_rate, total_steps=steps + 1, pct_start=0.1
    )
    history = History(envs.num_envs)
    store = Checkpoint(
        checkpoint,
        {"network": network, "optimiser": optimiser, "schedule": schedule, "history": history},
        identity=identity or asdict(training),
    )
    done = store.restore()
    rollout = _Rollout(envs, RegressionPolicy(context, network=network), training, history)
    if 0 < done < steps:
        rollout.resume()
    whole = True  # no step is half done
    try:
        while done < steps:
            observations, target = rollout.batch()
            network.train()
            with _seeded(device, training.seed, done):  # dropout draws from the global generator
                loss, error = _loss(network, observations, target)
            if not math.isfinite(error):
                raise ValueError(f"the loss (={error}) must be finite; lower `learning_rate`")
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            whole = False
            optimiser.step()
            schedule.step()
            done += 1
            rollout.mark()
            whole = True
            network.eval()
            if progress is not None:
                progress(done * envs.num_envs, steps * envs.num_envs, {"mse": error})
            store.save(done)
    except (KeyboardInterrupt, SystemExit):
        if whole:
            store.save(done, force=True)
        raise
    store.save(steps, force=True)
    return network


def _loss(
    network: ScoreRegressor, observations: Observations, target: NDArray[np.float64]
) -> tuple[torch.Tensor, float]:
    """Loss to minimise, and the mean squared error.

    The mean learns from the plain squared error, the confidence from the likelihood with that
    error held fixed.
    """
    device = next(network.parameters()).device
    scores, log_variance = network(*observation_tensors(observations, device))
    error = (scores - torch.from_numpy(target).float().to(device)).square()
    likelihood = (error.detach() * torch.exp(-log_variance) + log_variance).mean()
    return error.mean() + 0.01 * likelihood, error.mean().item()


@contextmanager
def _seeded(device: str, *seeds: int) -> Iterator[None]:
    """torch's global generators seeded within, and as they were after."""
    cuda = [torch.device(device)] if torch.device(device).type == "cuda" else []
    with torch.random.fork_rng(devices=cuda):
        number = int(np.random.SeedSequence(seeds).generate_state(1)[0])
        torch.default_generator.manual_seed(number)
        if cuda:
            torch.cuda.manual_seed(number)
        yield


class _Replay:
    """The last frames and their scores, to be seen again mirrored or not."""

    def __init__(self, training: RegressionTraining, rng: np.random.Generator) -> None:
        self.training, self.rng = training, rng
        self.memory: list[dict[str, NDArray[Any]]] = []

    def batch(
        self, observations: Observations, target: NDArray[np.float64]
    ) -> tuple[dict[str, NDArray[Any]], NDArray[np.float64]]:
        """The new frames and some old ones."""
        new = {**observations, "target": target}
        parts = [new]
        for _ in range(min(self.training.replay, len(self.memory))):
            chosen = [self.memory[i] for i in self.rng.integers(len(self.memory), size=4)]
            rows = self.rng.integers(len(target), size=(4, max(1, len(target) // 4)))
            mixed = {
                k: np.concatenate([c[k][r] for c, r in zip(chosen, rows, strict=True)]) for k in new
            }
            if self.rng.random() < 0.5:
                mixed["raw"] = mixed["raw"][..., ::-1]
            parts.append(mixed)
        self.remember(observations, target)
        merged = {key: np.concatenate([p[key] for p in parts]) for key in new}
        return merged, merged.pop("target")

    def remember(self, observations: Observations, target: NDArray[np.float64]) -> None:
        """Keeps the new frames, and forgets the oldest beyond the memory."""
        count = self.batches(len(target))
        self.memory = [*self.memory, {**observations, "target": target}][-count:]

    def batches(self, num_envs: int) -> int:
        """How many steps of that many frames are remembered."""
        return max(1, self.training.memory // num_envs)


class _Rollout:
    """Frames and the scores of all states, from episodes that the policy itself drives."""

    def __init__(
        self,
        envs: gym.vector.VectorEnv,
        policy: RegressionPolicy,
        training: RegressionTraining,
        history: History,
    ) -> None:
        self.envs, self.policy, self.history = envs, policy, history
        self.explore, self.base = training.explore, cast(Any, envs.unwrapped)
        self.rng = np.random.default_rng([training.seed, 0])
        self.replay = _Replay(training, np.random.default_rng([training.seed, 0, 1]))
        self.observations: Observations | None = None

    def batch(self) -> tuple[dict[str, NDArray[Any]], NDArray[np.float64]]:
        """The next frame of every episode, with its scores, and some earlier ones."""
        if self.observations is None:
            self._reset()
        else:
            actions = self.policy.act(self.observations)
            random = self.rng.random(len(actions)) < self.explore
            others = self.rng.integers(len(self.policy.context.grid), size=len(actions))
            self.policy.forget(self._step(np.where(random, others, actions)))
        return self.replay.batch(self._shown(), self.base.expected_scores())

    def mark(self) -> None:
        """Makes this moment the one that a checkpoint holds."""
        weighted, precision = self.policy.accumulated
        self.history.mark(
            rng=self.rng.bit_generator.state,
            replay_rng=self.replay.rng.bit_generator.state,
            weighted=torch.tensor(weighted),
            precision=torch.tensor(precision),
        )

    def resume(self) -> None:
        """Goes to the moment of the history's mark."""
        past, marked = self.history.actions, self.history.marked
        self.history.actions = []
        self._reset()
        for left in range(len(past), -1, -1):
            if left < self.replay.batches(self.envs.num_envs):
                self.replay.remember(self._shown(), self.base.expected_scores())
            if left:
                self._step(past[-left])
        self.rng.bit_generator.state = marked["rng"]
        self.replay.rng.bit_generator.state = marked["replay_rng"]
        self.policy.accumulated = marked["weighted"].numpy(), marked["precision"].numpy()

    def _reset(self) -> None:
        self.observations, _ = self.envs.reset(seed=int(self.rng.integers(2**31)))
        self.policy.reset(self.envs.num_envs)

    def _step(self, actions: NDArray[Any]) -> NDArray[np.bool_]:
        self.history.add(actions)
        self.observations, _, terminated, truncated, _ = self.envs.step(actions)
        return terminated | truncated

    def _shown(self) -> Observations:
        assert self.observations is not None
        return self.observations


def save_regression(
    path: Path, network: ScoreRegressor, context: PolicyContext, training: dict[str, Any]
) -> None:
    """Writes the agent as ``path.safetensors`` and ``path.json``."""
    description = {
        "width": network.width,
        "context": describe_context(context),
        "training": training,
    }
    save_agent(path, "regression", network, description)
