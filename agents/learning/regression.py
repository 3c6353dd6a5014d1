"""The regression agent: predict the score of every state from one frame, take the best.

After the auto-exposure application of Ouyang et al. (CVPR 2021): a small CNN learns from score
tables (see `regression_training`). Predictions are accumulated over the frames of the same light,
each weighted by the network's own confidence.
"""

from __future__ import annotations

from functools import cached_property

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from ae_env.grid import ExposureGrid
from agents.learning.agent_weights import NetworkPolicy
from agents.learning.networks import ExposureFeatures, StateHead
from agents.metering.meters import make_meter
from agents.metering.reading import Meter
from agents.policy import Observations, PolicyContext, masked_argmax

#: Dropout of the CNN's channels, relative to that of the features.
_OF_CHANNELS = 0.4
#: Bounds of the predicted log variance.
_LOG_VARIANCE = (-8.0, 0.0)
#: Frames whose mean metered EV100 is this near to a frame's show the same light as it [EV]. Chosen
#: among five values from 0.35 to 1.5 on the small bundled training scenes under moving light.
SAME_LIGHT_EV = 0.35


class ScoreRegressor(nn.Module):
    """Predicts the score of each state, and how certain the prediction is.

    Args:
        observation_space: Observation of a single environment.
        grid: The exposure states.
        width: Features that describe a frame.
        dropout: Share of the features that a training step leaves out; of the CNN's channels it
            leaves out 0.4 times as many.
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
        self.features = ExposureFeatures(observation_space, width, _OF_CHANNELS * dropout)
        self.dropout = nn.Dropout(dropout)
        has_sensors = "sensors" in observation_space.spaces
        self.states = StateHead(grid, width, has_sensors, outputs=2, trained_on=trained_on)

    def forward(
        self, codes: torch.Tensor, settings: torch.Tensor, sensors: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Expected score and log variance of the prediction, both (B, S)."""
        features = self.dropout(self.features(codes, settings, sensors))
        values = self.states(features, self.features.light(codes, settings), sensors)
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
    """Takes the state with the highest predicted score, accumulated over the frames so far."""

    kind = "regression"

    @cached_property
    def _meter(self) -> Meter:
        """Meter whose reading tells that the light has changed."""
        return make_meter("average", self.context.camera)

    @staticmethod
    def make_network(
        context: PolicyContext, width: int, trained_on: ExposureGrid | None = None
    ) -> ScoreRegressor:
        """See `NetworkPolicy.make_network`."""
        return ScoreRegressor(context.observation_space, context.grid, width, trained_on=trained_on)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forgets the frames so far."""
        super().reset(num_envs, seed)
        # Scores times their weights and the weights, (N, S), of so many frames, whose mean metered
        # EV100 is the light.
        self._weighted = np.zeros((num_envs, len(self.context.grid)))
        self._precision = np.zeros_like(self._weighted)
        self._light, self._frames = np.zeros(num_envs), np.zeros(num_envs)

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
        """Forgets the earlier frames of those environments whose metered light has changed."""
        ev100 = self._meter(observations).ev100
        self.forget((self._frames > 0) & (np.abs(ev100 - self._light) > SAME_LIGHT_EV))
        self._frames += 1.0
        self._light += (ev100 - self._light) / self._frames

    def forget(self, done: NDArray[np.bool_]) -> None:
        """Forgets the frames of the environments that `done` marks, such as ended episodes."""
        for sums in (self._weighted, self._precision, self._light, self._frames):
            sums[done] = 0.0
