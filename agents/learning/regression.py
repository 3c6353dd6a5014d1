"""The regression agent: predict the score of every state from one frame, take the best.

After the auto-exposure application of Ouyang et al. (CVPR 2021): a small CNN learns from score
tables (`train_regression`). Predictions are accumulated over the frames of the same light,
each weighted by the network's own confidence.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import nn

from ae_env.grid import ExposureGrid
from ae_env.observation import SETTINGS_RANGES
from agents.foresight import make_foresight
from agents.learning import networks
from agents.learning.forecaster import LightForecaster, load_forecasters
from agents.learning.policy_file import MAX_WIDTH, NetworkPolicy, trained_grid
from agents.metering.metering_policy import HYSTERESIS_SCORE
from agents.metering.meters import make_meter
from agents.policy import Bools, Floats, Ints, Observations, PolicyContext, masked_argmax
from simulator.utils.config_file import Configuration

#: Dropout of the CNN's channels, relative to that of the features.
_OF_CHANNELS = 0.4
#: Bounds of the predicted log variance.
_LOG_VARIANCE = (-8.0, 0.0)
#: Frames whose mean metered EV100 is this near to a frame's show the same light as it [EV]. Chosen
#: among five values from 0.35 to 1.5 on the small bundled training scenes under moving light.
SAME_LIGHT_EV = 0.35
#: What a state must promise beyond that of the last decision to replace it, with foresight [score].
#: Chosen among 0, 0.01, 0.03 and 0.06 on training scenes and kinds of light.
HYSTERESIS = 0.01
#: Past frames come in so many parts, each from another step.
_CHUNKS = 4
#: Observed frames; the scores of all states in them, and the EV100 of the right exposure.
Batch = tuple[dict[str, NDArray[Any]], Floats, Floats]


class ScoreRegressor(nn.Module):
    """Predicts the score of each state, and how certain the prediction is.

    A training step leaves out a share `dropout` of the features, and 0.4 of that of CNN channels.
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
        self.features = networks.ExposureFeatures(observation_space, width, _OF_CHANNELS * dropout)
        self.dropout = nn.Dropout(dropout)
        has_sensors = "sensors" in observation_space.spaces
        self.states = networks.StateHead(grid, width, has_sensors, outputs=2, trained_on=trained_on)

    def forward(
        self, codes: torch.Tensor, settings: torch.Tensor, sensors: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Expected score and log variance of the prediction, both (B, S)."""
        scores, log_variance, _, _ = self.predict(codes, settings, sensors)
        return scores, log_variance

    def predict(
        self, codes: torch.Tensor, settings: torch.Tensor, sensors: torch.Tensor | None
    ) -> tuple[torch.Tensor, ...]:
        """As `forward`, and the right exposure (`StateHead.right_ev100`): its EV100, its spread."""
        features = self.dropout(self.features(codes, settings, sensors))
        light = self.features.light(codes, settings)
        scores, log_variance = self.states(features, light, sensors).unbind(dim=2)
        right = self.states.right_ev100(features, light)
        return torch.sigmoid(scores), log_variance.clamp(*_LOG_VARIANCE), *right


def observation_tensors(
    observations: Observations, device: torch.device | str = "cpu"
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    """The network's three inputs from batched observations."""
    codes = torch.as_tensor(observations["raw"], device=device).float().div_(255.0)
    settings = torch.as_tensor(observations["settings"], device=device)
    sensors = observations.get("sensors")
    return codes, settings, None if sensors is None else torch.as_tensor(sensors, device=device)


def shift_ev(settings: NDArray[np.floating], stops: Floats) -> NDArray[np.float32]:
    """Settings (N, 3) of frames in `stops` (N,) more light that look alike: of a lower gain [EV].

    The network reads the absolute light off a frame and its settings.
    """
    low, high = SETTINGS_RANGES[2]
    shifted = np.array(settings, np.float32)
    shifted[:, 2] -= 2.0 * stops / (high - low)
    return shifted


class RegressionPolicy(NetworkPolicy):
    """Takes the state with the highest predicted score, accumulated over the frames so far.

    Args:
        context, weights, network, device: See `NetworkPolicy`.
        foresight: ``"none"``: frames of the same light count together; else the frame in hand is
            shown to the network as if taken in the light that is expected, and the state is taken
            that promises most in the frames that its controls are in effect in. ``"trend"``: an
            alpha-beta filter expects it; ``"learnt"``: the forecasters that come with the package
            (`LearntTracker`); or the file of another one, or a pattern of several.
    """

    kind, hysteresis = "regression", HYSTERESIS_SCORE

    def __init__(
        self,
        context: PolicyContext,
        weights: str | Path | None = None,
        network: nn.Module | None = None,
        device: str = "cpu",
        foresight: str = "none",
    ) -> None:
        self.foresight = foresight
        self._forecasters: list[LightForecaster] = []
        if foresight not in ("none", "trend"):
            self._forecasters = load_forecasters(foresight, context, device)
        #: Shows that the light has changed.
        self._meter = make_meter("average", context.camera)
        super().__init__(context, weights, network, device)

    @staticmethod
    def make_network(context: PolicyContext, card: dict[str, Any]) -> ScoreRegressor:
        """See `NetworkPolicy.make_network`."""
        space, grid = context.observation_space, context.grid
        return ScoreRegressor(space, grid, card["width"], trained_on=trained_grid(card))

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forgets the frames so far."""
        super().reset(num_envs, seed)
        # Scores times their weights and the weights, (N, S), of so many frames, whose mean metered
        # EV100 is the light.
        self._weighted = np.zeros((num_envs, len(self.context.grid)))
        self._precision = np.zeros_like(self._weighted)
        self._light, self._frames = np.zeros(num_envs), np.zeros(num_envs)
        given = self.foresight, self.context, num_envs, self._forecasters
        self._foresight = make_foresight(*given)

    def act(self, observations: Observations, action_masks: Bools | None = None) -> Ints:
        """Best state (N,) after this frame and those before it in the same light."""
        self.check_reset(observations)
        reading = self._meter(observations)
        device = next(self.network.parameters()).device
        codes, settings, sensors = observation_tensors(observations, device)
        foresight = self._foresight
        if foresight is not None:
            reading = foresight.observe(reading, observations)

            def scores_in(ev100: Floats) -> Floats:
                # What a mostly white frame reads is only a bound: it is shown as it is.
                stops = np.where(reading.saturated < 0.5, ev100 - reading.ev100, 0.0)
                shifted = torch.from_numpy(shift_ev(observations["settings"], stops))
                return self._predict(codes, shifted.to(device), sensors)[0]

            utility = foresight.utility(scores_in)
            utility[np.arange(len(utility)), foresight.pending_action] += HYSTERESIS
            chosen = masked_argmax(utility, action_masks)
            foresight.record_action(chosen)
            return chosen
        # The earlier frames of environments whose metered light has changed count no longer.
        self.forget((self._frames > 0) & (np.abs(reading.ev100 - self._light) > SAME_LIGHT_EV))
        self._frames += 1.0
        self._light += (reading.ev100 - self._light) / self._frames
        scores, precision = self._predict(codes, settings, sensors)
        self._weighted += precision * scores
        self._precision += precision
        return self._choose(self._weighted / self._precision, action_masks)

    def _predict(self, *inputs: torch.Tensor | None) -> tuple[Floats, Floats]:
        """Scores of all states and their precision, (N, S) each."""
        with torch.inference_mode():
            scores, log_variance = self.network(*inputs)
        precision = torch.exp(-log_variance)
        return scores.double().cpu().numpy(), precision.double().cpu().numpy()

    def forget(self, done: Bools) -> None:
        """Forgets the frames of the environments that `done` marks; without foresight."""
        for sums in (self._weighted, self._precision, self._light, self._frames):
            sums[done] = 0.0
        self._asked[done] = -1


class RegressionTraining(Configuration):
    """Hyperparameters of the regression agent."""

    frames: int = Field(default=100_000, ge=1, le=10**12)  # to take
    learning_rate: float = Field(default=5e-3, ge=1e-9, le=1.0)  # peak of AdamW's one cycle
    weight_decay: float = Field(default=1e-3, ge=0.0, le=1.0)  # of AdamW
    #: Frames of the recent past that each optimiser step sees again, per new frame.
    replay: int = Field(default=2, ge=0, le=64)
    memory: int = Field(default=8192, ge=1, le=10**9)  # frames that are remembered for it
    #: Share of random actions; the others are its own, so that it learns from frames it will meet.
    explore: float = Field(default=0.5, ge=0.0, le=1.0)
    width: int = Field(default=256, ge=1, le=MAX_WIDTH)  # hidden features of the network
    #: Share of the features that an optimiser step leaves out; see `ScoreRegressor`.
    dropout: float = Field(default=0.1, ge=0.0, le=0.99)
    #: Weight of the loss of the right exposure's EV100, see `StateHead`.
    ev_coef: float = Field(default=0.01, ge=0.0, le=100.0)
    seed: int = Field(default=0, ge=0, le=2**63)  # of scenes, noise and weights


def train_regression(
    envs: gym.vector.VectorEnv,
    training: RegressionTraining,
    session: networks.Session = networks.UNWATCHED,
) -> ScoreRegressor:
    """A regression agent, trained on the scenes of `envs` (autoreset mode SAME_STEP)."""
    context = PolicyContext.from_envs(envs)
    with _seeded("cpu", training.seed):
        space, grid = context.observation_space, context.grid
        network = ScoreRegressor(space, grid, training.width, training.dropout)
    network.to(session.device)
    steps = max(2, training.frames // envs.num_envs)
    run = networks.Optimisation(network, training, session, steps=steps, warm_up=0.1)
    frames = rollout(envs, RegressionPolicy(context, network=network), training, run.done)
    with run.store:
        while run.done < steps:
            batch = next(frames)
            network.train()
            # Dropout draws from the global generator.
            with _seeded(session.device, training.seed, run.done):
                loss, seen = _loss(network, batch, training.ev_coef)
            run.step(loss)
            network.eval()
            session.report(run.done * envs.num_envs, steps * envs.num_envs, seen)
            run.store.save_when_due()
    return network


def rollout(
    envs: gym.vector.VectorEnv, policy: RegressionPolicy, training: RegressionTraining, step: int
) -> Iterator[Batch]:
    """Each frame with the scores of all states, and some earlier ones; the policy itself drives.

    The training begins, or goes on, after `step` steps: every start draws other episodes.
    """
    rng = np.random.default_rng([training.seed, step])
    replay = Replay(training, np.random.default_rng([training.seed, step, 1]))
    base: Any = envs.unwrapped
    observations, _ = envs.reset(seed=int(rng.integers(2**31)))
    policy.reset(envs.num_envs)
    while True:
        yield replay.batch(observations, base.expected_scores(), base.right_ev100())
        actions = policy.act(observations)
        random = rng.random(len(actions)) < training.explore
        others = rng.integers(len(policy.context.grid), size=len(actions))
        actions = np.where(random, others, actions)
        observations, _, terminated, truncated, _ = envs.step(actions)
        policy.forget(terminated | truncated)


class Replay:
    """The last frames and their scores, to be seen again, shifted; `rng` chooses which."""

    def __init__(self, training: RegressionTraining, rng: np.random.Generator) -> None:
        self.training, self.rng = training, rng
        self.memory: list[dict[str, NDArray[Any]]] = []

    def batch(self, observations: Observations, scores: Floats, right_ev100: Floats) -> Batch:
        """The new frames and some old ones; remembers the new ones and forgets the oldest."""
        new = {**observations, "scores": scores, "right_ev100": right_ev100}
        parts = [new]
        for _ in range(_CHUNKS * min(self.training.replay, len(self.memory))):
            past = self.memory[self.rng.integers(len(self.memory))]
            rows = self.rng.integers(len(scores), size=max(1, len(scores) // _CHUNKS))
            seen = {name: values[rows] for name, values in past.items()}
            parts.append({**seen, "raw": networks.random_shift(seen["raw"], self.rng)})
        steps = max(1, self.training.memory // len(scores))
        self.memory = [*self.memory, new][-steps:]
        merged = {key: np.concatenate([p[key] for p in parts]) for key in new}
        return merged, merged.pop("scores"), merged.pop("right_ev100")


def _loss(
    network: ScoreRegressor, batch: Batch, ev_coef: float
) -> tuple[torch.Tensor, dict[str, float]]:
    """Loss to minimise; the mean squared error, and what the states that seem best lose [score].

    As in `exposure_loss`: a large predicted variance cannot excuse a poor mean.
    """
    device = next(network.parameters()).device
    observations, *targets = batch
    scores, log_variance, ev100, spread = network.predict(
        *observation_tensors(observations, device)
    )
    known, right = (torch.from_numpy(target).float().to(device) for target in targets)
    error = (scores - known).square()
    regret = known.amax(dim=1) - known.gather(1, scores.argmax(dim=1, keepdim=True))[:, 0]
    likelihood = (error.detach() * torch.exp(-log_variance) + log_variance).mean()
    loss = error.mean() + 0.01 * likelihood + ev_coef * networks.exposure_loss(ev100, spread, right)
    seen = {"mse": error, "regret": regret, "ev": (ev100 - right).abs()}
    return loss, {name: values.mean().item() for name, values in seen.items()}


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
