"""The regression agent: predict the score of every state from one frame, take the best.

After the auto-exposure application of Ouyang et al. (CVPR 2021): a small CNN learns from score
tables that the simulator makes for free. Predictions are accumulated over the frames of the same
light, each weighted by the network's own confidence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from ae_env.grid import ExposureGrid
from agents.learning.agent_weights import MAX_WIDTH, describe_context, save_agent
from agents.learning.history import History
from agents.learning.network_policy import NetworkPolicy
from agents.learning.networks import ExposureFeatures, StateHead, check_ranges
from agents.learning.regression_training import Rollout
from agents.metering.meters import Meter, make_meter
from agents.policy import Observations, PolicyContext, masked_argmax
from simulator.utils.checkpoint import Checkpoint

#: Bounds of the predicted log variance.
_LOG_VARIANCE = (-8.0, 0.0)
#: Frames whose mean metered EV100 is this near to a frame's show the same light as it [EV]. Chosen
#: among five values from 0.35 to 1.5 on the small bundled training scenes under moving light.
SAME_LIGHT_EV = 0.35
#: What is known of the frames so far; see `RegressionPolicy.accumulated`.
_ACCUMULATED = ("weighted", "precision", "light", "frames")


class ScoreRegressor(nn.Module):
    """Predicts the score of each state, and how sure it is.

    Args:
        observation_space: Observation of a single environment.
        grid: The exposure states.
        width: Features that describe a frame.
        dropout: Share of the features that a training step leaves out.
        trained_on: See `StateHead`.
    """

    def __init__(
        self,
        observation_space: gym.spaces.Dict,
        grid: ExposureGrid,
        width: int = 256,
        dropout: float = 0.0,
        trained_on: ExposureGrid | None = None,
    ) -> None:
        super().__init__()
        self.width = width
        self.features = ExposureFeatures(observation_space, width)
        self.dropout = nn.Dropout(dropout)
        has_sensors = "sensors" in observation_space.spaces
        self.states = StateHead(grid, width, has_sensors, outputs=2, trained_on=trained_on)

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

    @cached_property
    def _meter(self) -> Meter:
        """Tells light that changed."""
        return make_meter("average", self.context.camera)

    @staticmethod
    def make_network(
        context: PolicyContext, width: int, trained_on: ExposureGrid | None = None
    ) -> ScoreRegressor:
        """See `NetworkPolicy`."""
        return ScoreRegressor(context.observation_space, context.grid, width, trained_on=trained_on)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forgets the frames so far."""
        super().reset(num_envs, seed)
        self._weighted = np.zeros((num_envs, len(self.context.grid)))
        self._precision = np.zeros_like(self._weighted)
        self._light, self._frames = np.zeros((2, num_envs))

    def act(
        self, observations: Observations, action_masks: NDArray[np.bool_] | None = None
    ) -> NDArray[np.int64]:
        """Best state (N,) after this frame and those before it in the same light."""
        self.check_reset(observations)
        self._forget_other_light(observations)
        device = next(self.network.parameters()).device
        with torch.inference_mode():
            scores, log_variance = self.network(*observation_tensors(observations, device))
        precision = torch.exp(-log_variance).double().cpu().numpy()
        self._weighted += precision * scores.double().cpu().numpy()
        self._precision += precision
        return masked_argmax(self._weighted / self._precision, action_masks)

    def _forget_other_light(self, observations: Observations) -> None:
        """Forgets the frames before where the metered light is no longer theirs."""
        ev100 = self._meter(observations).ev100
        self.forget((self._frames > 0) & (np.abs(ev100 - self._light) > SAME_LIGHT_EV))
        self._frames += 1.0
        self._light += (ev100 - self._light) / self._frames

    @property
    def accumulated(self) -> dict[str, NDArray[np.float64]]:
        """What the episodes so far add up to.

        ``weighted`` scores and their weights ``precision``, (N, S), of the ``frames`` (N,) whose
        mean metered EV100 is ``light`` (N,).
        """
        return {name: getattr(self, f"_{name}") for name in _ACCUMULATED}

    @accumulated.setter
    def accumulated(self, values: Mapping[str, NDArray[np.float64]]) -> None:
        for name in _ACCUMULATED:
            setattr(self, f"_{name}", np.array(values[name]))

    def forget(self, done: NDArray[np.bool_]) -> None:
        """Begins anew in those environments whose episode is over."""
        for name in _ACCUMULATED:
            getattr(self, f"_{name}")[done] = 0.0


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
    rollout = Rollout(envs, RegressionPolicy(context, network=network), training, history)
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
