"""Policies that look at no frame: random, the best constant state, the oracle, a recording."""

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ae_env.scenes.folder import find_files, is_raw
from agents.policy import Bools, Floats, Ints, Observations, Policy, PolicyContext, masked_argmax
from agents.rollouts import RolloutPlan, expected_scores, scenes_of
from simulator.raw.read import read_raw
from simulator.settings import CameraSettings
from simulator.utils.checks import check_word

#: What oracles know, and the entry of ``info`` that holds it.
ORACLES = {"last_frame": "oracle_state", "clairvoyant": "clairvoyant_state"}
#: The best constant state is taken from so many episodes per scene, of so many scenes at most.
FIT_EPISODES, FIT_SCENES = 2, 400


class Random(Policy):
    """A state drawn uniformly from the allowed ones, another at every frame."""

    def __init__(self, context: PolicyContext) -> None:
        super().__init__(context)
        self.name = "random"
        self._rng = np.random.default_rng(0)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Begin new episodes; the same seed draws the same states."""
        super().reset(num_envs, seed)
        self._rng = np.random.default_rng(seed)

    def act(self, observations: Observations, action_masks: Bools | None = None) -> Ints:
        """Draw a state per camera."""
        count = len(self.context.grid) if action_masks is None else action_masks.shape[1]
        return masked_argmax(self._rng.random((len(observations["raw"]), count)), action_masks)


class BestFixed(Policy):
    """The one state with the best mean expected score on the training scenes."""

    def __init__(self, context: PolicyContext) -> None:
        super().__init__(context)
        self.name = "best_fixed"
        self.mean_scores: Floats | None = None

    def fit(self, envs: gym.vector.VectorEnv[Any, Any, Any], seed: int = 0) -> None:
        """Average the expected scores of all states over the scenes of `envs`."""
        sizes = {"count": FIT_EPISODES, "most": FIT_SCENES}
        episodes = RolloutPlan.of_each_scene(scenes_of(envs), seed=seed, **sizes)
        scores = [expected_scores(envs)[batch.valid] for batch in episodes.batches(envs)]
        self.mean_scores = np.concatenate(scores).mean(axis=0)

    def act(self, observations: Observations, action_masks: Bools | None = None) -> Ints:
        """Always the best state, or the best allowed one."""
        if self.mean_scores is None:
            raise ValueError("policy 'best_fixed' learns from scenes first: call fit(envs)")
        shape = (len(observations["raw"]), len(self.mean_scores))
        return masked_argmax(np.broadcast_to(self.mean_scores, shape), action_masks)


class Oracle(Policy):
    """Knows the expected score of every state, in the light that it knows.

    Args:
        knows: ``"last_frame"``: the light of the frame that it has just seen, as a policy does
            that measures light without error but foresees nothing; ``"clairvoyant"``: that of the
            frames that its decision exposes, each control's own: the ceiling, of regret 0.
    """

    privileged = True

    def __init__(self, context: PolicyContext, knows: str = "last_frame") -> None:
        super().__init__(context)
        check_word("knows", knows, tuple(ORACLES))
        self.name, self._oracle_info = f"oracle:{knows}", ORACLES[knows]

    def act(
        self,
        observations: Observations,
        action_masks: Bools | None = None,
        info: Mapping[str, Any] | None = None,
    ) -> Ints:
        """The best allowed state in the light that it knows."""
        if info is None or self._oracle_info not in info:
            raise ValueError(
                f"policy {self.name!r} needs `info` with {self._oracle_info!r}, of environments "
                "made with_oracle=True or, where it knows the light to come, of an evaluation"
            )
        return np.array(info[self._oracle_info], dtype=np.int64)


class Recorded(Policy):
    """The settings of a real camera: frame k of an episode takes those of the k-th raw of a folder.

    `path` is a folder of raws, or a single raw. With the same folder as a scene
    (``scenes={"sequence": FOLDER}``) it replays the recording. Frame 0 is the one that `reset`
    returns, at a state that no policy chooses; a delay is allowed for. The raws count in the
    natural order of their names, from 0; after the last one its settings stay. The nearest of the
    grid's states is taken: the squares of the differences in aperture, time, ISO and EV, in stops,
    add up. A `ValueError` if there is no raw, or one cannot be read or does not say its settings.
    """

    def __init__(self, context: PolicyContext, path: str | os.PathLike[str]) -> None:
        super().__init__(context)
        self.name = f"recorded:{os.fspath(path)}"
        self.settings = tuple(read_raw(file).settings for file in _raw_files(path))
        ours = _coordinates(context.grid.states)
        #: Cost of every state, per raw, ``(T, S)``.
        self._cost = ((_coordinates(self.settings)[:, None] - ours[None]) ** 2).sum(axis=2)
        self.reset(0)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Restart the sequence."""
        super().reset(num_envs, seed)
        self._frame = 1 + max(self.context.delays)  # that the first decision exposes

    def act(self, observations: Observations, action_masks: Bools | None = None) -> Ints:
        """The state nearest to the next raw's settings, or the nearest allowed one."""
        self.check_reset(observations)
        cost = self._cost[min(self._frame, len(self._cost) - 1)].round(9)
        self._frame += 1
        utility = np.broadcast_to(-cost, (len(observations["raw"]), len(cost)))
        return masked_argmax(utility, action_masks)


def _raw_files(path: str | os.PathLike[str]) -> list[Path]:
    raws, folder = [], Path(path).expanduser()
    if os.fspath(path) and folder.exists():
        with suppress(ValueError):  # no file of any known kind
            raws = [file for file in find_files(folder)[1] if is_raw(file)]
    if not raws:
        given = os.fspath(path)
        raise ValueError(f"`path` (={given!r}) must be a folder of raws: 'recorded:FOLDER'")
    return raws


def _coordinates(settings: tuple[CameraSettings, ...]) -> Floats:
    """Aperture, time, ISO and EV of each, in stops, ``(n, 4)``."""
    values = [(s.aperture_stop / 3, s.time_value, s.speed_value, s.log2_exposure) for s in settings]
    return np.array(values)
