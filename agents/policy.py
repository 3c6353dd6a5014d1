"""The interface of a policy: what it knows of its camera, and what it has to answer."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from ae_env.grid import ExposureGrid
from simulator.camera import CameraProfile

Observations = Mapping[str, NDArray[Any]]
Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
VectorEnv = gym.vector.VectorEnv[Any, Any, Any]


class BracketLimits(NamedTuple):
    """What the frames of an episode of `ExposureBracket-v0` may take together."""

    budget: float  # [s]
    max_frames: int
    box_factor: int  # photosites averaged a side into one pixel, which the noise depends on


@dataclass(frozen=True)
class PolicyContext:
    """The camera that a policy drives; an action is an index into its `grid`."""

    grid: ExposureGrid  #: states that actions choose from
    camera: CameraProfile  #: body that takes the frames
    #: Observation of a single environment (a `Dict` with ``raw``, ``settings`` and, where the
    #: camera has them, ``sensors``).
    observation_space: gym.spaces.Dict
    #: Frames after the next until a decision's ISO, exposure time and aperture are in effect.
    delays: tuple[int, int, int] = (0, 0, 0)
    bracket: BracketLimits | None = None  #: None for tasks without a bracket

    @classmethod
    def from_envs(cls, envs: VectorEnv) -> Self:
        """The context of the environments that `envs` runs."""
        base: Any = envs.unwrapped
        limits = None
        if hasattr(base, "budget"):
            limits = BracketLimits(base.budget, base.max_frames, base.scenes[0].box_factor)
        space = base.single_observation_space
        return cls(base.grid, base.camera, space, delays=base.delays, bracket=limits)

    @property
    def has_sensors(self) -> bool:
        """Whether the observation has image speed and defocus spread."""
        return "sensors" in self.observation_space.spaces


class Policy:
    """Base class of everything that chooses exposures, for a batch of cameras of a `context`.

    A policy is causal: `act` sees the frames so far and nothing else. Override `reset` (call it
    through `super`) and `act`; override `fit` where the policy has something to learn from the
    training scenes. Per-camera memory lives in arrays of length `num_envs`.
    """

    #: Only a privileged policy's `act` gets ``info=`` as well; its scores are upper bounds.
    privileged: bool = False
    #: Whether the observations of `act` must have ``info["subject"]``, too.
    needs_subject: bool = False
    #: Frames a policy takes for one decision (a bracketing policy takes more).
    captures_per_decision: float = 1.0

    def __init__(self, context: PolicyContext) -> None:
        self.context = context
        self.num_envs = 0
        self.name = type(self).__name__

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Begin new episodes of `num_envs` cameras; random choices follow `seed`."""
        self.num_envs = num_envs

    def check_reset(self, observations: Observations) -> None:
        """Raises a `ValueError` unless `reset` was called for as many cameras as `observations`."""
        count = len(observations["raw"])
        if count != self.num_envs:
            raise ValueError(
                f"policy {self.name!r} keeps {self.num_envs} cameras in mind, `observations` are "
                f"of {count}: call reset(num_envs) first"
            )

    def act(self, observations: Observations, action_masks: Bools | None = None) -> Ints:
        """Choose the next frame's state for each camera: indices into the grid, ``(num_envs,)``.

        Args:
            observations: Arrays with a leading axis of `num_envs`.
            action_masks: ``(num_envs, len(grid))``, False where a state is not allowed.
        """
        raise NotImplementedError(f"{type(self).__name__} must implement `act`")

    def fit(self, envs: VectorEnv, seed: int = 0) -> None:
        """Learn from the scenes of `envs`, in episodes of `seed`; once, before evaluation."""


def masked_argmax(utility: NDArray[np.floating], action_masks: Bools | None) -> Ints:
    """Index of the highest allowed utility (N, S) per row (N,), ties to the lower index.

    A `ValueError` unless the masks are of the utility's shape and allow a state in every row.

    >>> masked_argmax(np.array([[1.0, 3.0, 2.0]]), np.array([[True, False, True]]))
    array([2])
    """
    if action_masks is not None:
        if np.shape(action_masks) != utility.shape:
            shape = np.shape(action_masks)
            raise ValueError(f"`action_masks` (shape {shape}) must be of shape {utility.shape}")
        if not np.any(action_masks, axis=-1).all():
            raise ValueError("`action_masks` must allow a state to every camera")
        utility = np.where(action_masks, utility, -np.inf)
    return np.asarray(np.argmax(utility, axis=-1), np.int64)
