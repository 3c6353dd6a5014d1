"""Episodes for fitting and evaluation: the same for every policy, whatever the batch size."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, Self, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from ae_env.options import EnvOptions
from ae_env.scenes import Scene
from ae_env.scenes.folder import FEWEST_GROUPS_TO_SPLIT
from ae_env.scenes.load import BUNDLED, REAL, SceneSpec
from ae_env.utils.user_files import UserCodeError
from agents.policy import Bools, Floats, Ints, Observations, Policy, VectorEnv

ENV_ID = "ae_env:ae_env/AutoExposure-v0"


def make_envs(env_options: Mapping[str, Any], *, num_envs: int, frames: int) -> VectorEnv:
    """Environments of the arguments `env_options`, without autoreset, for `frames` actions."""
    shown = {"with_oracle": False, "with_subject": True}
    options = {**env_options, **shown, "autoreset_mode": "DISABLED"}
    # One frame more than is used: the episode must not end inside the evaluation.
    return gym.make_vec(ENV_ID, num_envs=num_envs, max_episode_steps=frames + 1, **options)


def training_arguments(scenes: SceneSpec, resolution: int = 64) -> tuple[dict[str, Any], bool]:
    """Arguments of an environment to train on for an evaluation on `scenes`.

    That is ``scenes``, with the ``grid`` of recorded ones; and whether they are others, the bundled
    ones, because `scenes` has too few source groups for a training split.
    """
    if isinstance(scenes, str) and scenes in (*BUNDLED, *REAL):
        return {"scenes": scenes}, False
    options = EnvOptions(scenes=scenes, split="all", resolution=resolution)
    if len({scene.group for scene in options.load_scenes()}) >= FEWEST_GROUPS_TO_SPLIT:
        return {"scenes": scenes}, False
    found: dict[str, Any] = {"scenes": "bundled"}
    if options.recorded is not None:
        found["grid"] = {name: list(values) for name, values in asdict(options.make_grid()).items()}
    return found, True


def fitting_arguments(environment: Mapping[str, Any], resolution: int) -> dict[str, Any]:
    """`environment`, arguments of one that a policy is judged in, with scenes to fit it on."""
    own = dict(environment)
    scenes = own.pop("scenes", "bundled")
    if not isinstance(scenes, str | Mapping):
        return dict(environment)
    return training_arguments(scenes, resolution)[0] | own


def scenes_of(envs: VectorEnv) -> list[Scene]:
    """The scenes that the episodes of `envs` draw from."""
    return list(cast(Any, envs.unwrapped).scenes)


def expected_scores(envs: VectorEnv) -> Floats:
    """q of every state in the current frame of each episode, ``(N, S)``."""
    return np.array(cast(Any, envs.unwrapped).expected_scores(), dtype=np.float64)


def action_masks(envs: VectorEnv) -> Bools:
    """States that the scene of each episode allows, ``(N, S)``."""
    return np.array(cast(Any, envs.unwrapped).action_masks(), dtype=np.bool_)


class WatchedEnvs(gym.vector.VectorWrapper):
    """Environments that call `watch` before each step; an error that it raises ends the work."""

    def __init__(self, envs: VectorEnv, watch: Callable[[], None]) -> None:
        super().__init__(envs)
        self._watch = watch

    def step(self, actions: Any) -> Any:
        """Call `watch`, then take the step."""
        self._watch()
        return super().step(actions)


class EpisodeBatch(NamedTuple):
    """One batch of freshly reset episodes."""

    episodes: Ints  # (N,) their numbers
    observations: Observations
    info: Mapping[str, Any]
    action_masks: Bools  # (N, S) allowed states
    groups: NDArray[Any]  # (N,) source group of each episode's scene
    valid: Bools  # (N,) False for the copies that fill the last batch
    seed: int  # of the batch's first episode


@dataclass(frozen=True)
class RolloutPlan:
    """Episodes that are run one batch after the other.

    The seed alone decides an episode's motion, defocus, noise and start, so that an episode is the
    same in a batch of any size.
    """

    scenes: Sequence[Scene]
    seeds: Sequence[int]  # (E,) of each episode
    scene: Ints  # (E,) index of each episode's scene
    starts: Sequence[int | None]  # (E,) state in which each begins; None where the seed draws it

    @classmethod
    def of_each_scene(
        cls, scenes: Sequence[Scene], *, count: int, seed: int, most: int | None = None
    ) -> Self:
        """All scenes, `count` times in a row; episode i has the seed ``seed + i``.

        Of more scenes than `most`, so many are used, evenly over the list.
        """
        used = len(scenes) if most is None else min(most, len(scenes))
        scene = np.tile(np.arange(used) * len(scenes) // used, count)
        return cls(scenes, range(seed, seed + len(scene)), scene, [None] * len(scene))

    def __len__(self) -> int:
        return len(self.seeds)

    def batches(self, envs: VectorEnv) -> Iterator[EpisodeBatch]:
        """Resets `envs` to each batch in turn; the last one repeats its episodes to be full."""
        for begin in range(0, len(self), envs.num_envs):
            index = np.arange(begin, min(begin + envs.num_envs, len(self)))
            valid = np.arange(envs.num_envs) < len(index)
            index = np.concatenate([index, np.resize(index, envs.num_envs - len(index))])
            scenes = [self.scenes[i] for i in self.scene[index]]
            states = [self.starts[i] for i in index.tolist()]
            options = {"scene": [scene.scene_id for scene in scenes], "state": states}
            seeds: Any = [self.seeds[i] for i in index.tolist()]
            observations, info = envs.unwrapped.reset(seed=seeds, options=options)
            groups, masks = np.array([scene.group for scene in scenes]), action_masks(envs)
            seed = int(self.seeds[begin])
            yield EpisodeBatch(index, observations, info, masks, groups, valid, seed)


@contextmanager
def errors_of(policy: str, method: str) -> Iterator[None]:
    """An error that a policy raises inside becomes a `UserCodeError` that names the policy."""
    try:
        yield
    except Exception as error:  # the policy may be the user's own, and raise anything
        text = f"policy {policy!r}: `{method}` raised {type(error).__name__}: {error}"
        raise UserCodeError(text) from error


def choose(
    name: str, policy: Policy, observations: Observations, masks: Bools, info: Mapping[str, Any]
) -> Any:
    """What `act` returns, see `errors_of`; `info` is for policies that ask for it only."""
    told: dict[str, Any] = {"info": info} if getattr(policy, "privileged", False) else {}
    with errors_of(name, "act"):
        return policy.act(shown_to(policy, observations, info), masks, **told)


def shown_to(policy: Policy, observations: Observations, info: Mapping[str, Any]) -> Observations:
    """The observations, with the subject's mask if `policy` needs it and `info` has it."""
    needs = getattr(policy, "needs_subject", False) and "subject" in info
    return {**observations, "subject": info["subject"]} if needs else observations


def checked_states(name: str, actions: Any, masks: Bools) -> Ints:
    """The actions that a policy returned; a `UserCodeError` if not one allowed state per camera."""
    try:
        array = np.asarray(actions)
    except (TypeError, ValueError, RuntimeError):  # rows of different lengths, a tensor of a GPU
        array = np.empty(0, object)
    if array.shape != masks.shape[:1] or not np.issubdtype(array.dtype, np.integer):
        raise UserCodeError(
            f"policy {name!r}: `act` must return {masks.shape[0]} integers, one per camera, not "
            f"{type(actions).__name__} of shape {array.shape} and dtype {array.dtype}"
        )
    count = masks.shape[1]
    outside = (array < 0) | (array >= count)
    if outside.any():
        raise UserCodeError(f"policy {name!r}: state {array[outside][0]} is not in [0, {count})")
    forbidden = ~np.take_along_axis(masks, array[:, None], axis=1)[:, 0]
    if forbidden.any():
        raise UserCodeError(f"policy {name!r}: state {array[forbidden][0]} is masked in this scene")
    return array.astype(np.int64)
