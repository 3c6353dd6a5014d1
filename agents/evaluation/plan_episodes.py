"""The episodes of an evaluation plan: the same for every policy, whatever the batch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from agents.episodes import EpisodeBatch, make_envs
from agents.evaluation.evaluation_plan import Condition, EvaluationPlan

if TYPE_CHECKING:
    import gymnasium as gym

    from ae_env.grid import ExposureGrid
    from ae_env.scenes import Scene

Ints = NDArray[np.int64]

#: Episodes at a time, at most.
BATCH = 64
#: Seeds of two entries of a plan's `seeds` are this far apart: more than any plan has scenes.
_SEED_STRIDE = 2**20
#: What the environments that policies see are scored by: it costs next to nothing, and is not used.
_CHEAP = "sharpness"


def plan_scenes(plan: EvaluationPlan) -> list[Scene]:
    """The scenes of `plan`, in its order.

    Raises:
        ValueError: If one of `scene_ids` is not there.
    """
    from ae_env.utils.checks import did_you_mean

    scenes = plan.options().load_scenes()
    if plan.scene_ids:
        known = {scene.scene_id: scene for scene in scenes}
        for name in plan.scene_ids:
            if name not in known:
                hint = did_you_mean(name, known)
                raise ValueError(
                    f"`scene_ids` (={name!r}) must name scenes of the {len(known)} of "
                    f"{plan.environment.get('scenes', 'bundled')!r}{hint}"
                )
        scenes = [known[name] for name in plan.scene_ids]
    return groups_in_turn(scenes, plan.max_scenes)


def groups_in_turn(scenes: Sequence[Scene], count: int | None) -> list[Scene]:
    """At most `count` of `scenes`: kinds in turn, and within a kind source groups in turn."""
    if count is None or count >= len(scenes):
        return list(scenes)
    ranks: list[tuple[int, int, int]] = []
    seen: dict[str, int] = {}
    groups: dict[str, dict[str, int]] = {}
    for i, scene in enumerate(scenes):
        repeat = seen[scene.group] = seen.get(scene.group, -1) + 1
        of_kind = groups.setdefault(scene.kind, {})
        place = of_kind.setdefault(scene.group, len(of_kind))
        ranks.append((repeat, place, i))
    chosen = sorted(sorted(range(len(scenes)), key=lambda i: ranks[i])[:count])
    return [scenes[i] for i in chosen]


def start_state(start: str, scene: Scene, grid: ExposureGrid) -> int | None:
    """State in which an episode begins; ties go to the lower ISO.

    Args:
        start: ``"dark"``: the least exposure of the grid, its highest EV100 (the under-exposed
            end); ``"middle"``: the state whose EV100 is nearest to that of the scene's right
            exposure; ``"bright"``: the most exposure of the grid; ``"random"``: drawn.
        scene: What is photographed.
        grid: The states.
    """
    if start == "random":
        return None
    ends = {"dark": float(grid.ev100.max()), "bright": float(grid.ev100.min())}
    return grid.nearest(ends.get(start, scene.ev100))


@dataclass(frozen=True)
class PlanEpisodes:
    """Every episode of a condition; starts change slowest, scenes fastest.

    Args:
        scenes: The plan's scenes.
        seeds: Seed of each episode, ``(E,)``: of scene and entry of `seeds`, so that episodes that
            differ in their start only have the same motion, defocus, light and noise.
        scene: Index of each episode's scene.
        table: Index of each episode's score table: the same for all starts.
        starts: State in which each begins; None where it is drawn.
    """

    scenes: list[Scene]
    seeds: list[int]
    scene: Ints
    table: Ints
    starts: list[int | None]

    @classmethod
    def of(cls, plan: EvaluationPlan, scenes: list[Scene], grid: ExposureGrid) -> PlanEpisodes:
        """The episodes of `plan`."""
        own = [(seed * _SEED_STRIDE + j, j) for seed in plan.seeds for j in range(len(scenes))]
        states = [[start_state(start, scene, grid) for scene in scenes] for start in plan.starts]
        repeats = len(plan.starts)
        return cls(
            scenes=scenes,
            seeds=[seed for seed, _ in own] * repeats,
            scene=np.array([j for _, j in own] * repeats),
            table=np.tile(np.arange(len(own)), repeats),
            starts=[states[k][j] for k in range(repeats) for _, j in own],
        )

    def __len__(self) -> int:
        return len(self.seeds)

    @property
    def num_tables(self) -> int:
        """Number of episodes that differ in more than their start."""
        return int(self.table.max()) + 1

    @property
    def batch(self) -> int:
        """Episodes at a time: at most `BATCH`, all batches alike."""
        return batch_size(len(self))

    def batches(self, envs: gym.vector.VectorEnv) -> Iterator[tuple[Ints, EpisodeBatch]]:
        """Resets `envs` to each batch in turn; the last one repeats its episodes to be full.

        Yields:
            Episodes of the batch, ``(N,)``, and what `envs` show of them, without scores.
        """
        base: Any = envs.unwrapped
        for begin in range(0, len(self), envs.num_envs):
            index = np.arange(begin, min(begin + envs.num_envs, len(self)))
            valid = np.arange(envs.num_envs) < len(index)
            index = np.concatenate([index, np.resize(index, envs.num_envs - len(index))])
            scenes = self.scene[index]
            options = {
                "scene": [self.scenes[i].scene_id for i in scenes],
                "state": [self.starts[i] for i in index],
            }
            seeds = [self.seeds[i] for i in index]
            observations, info = base.reset(seed=seeds, options=options)
            yield (
                index,
                EpisodeBatch(
                    observations=observations,
                    info=info,
                    scores=np.empty((len(index), 0)),
                    action_masks=np.array(base.action_masks(), dtype=bool),
                    scenes=scenes,
                    groups=np.array([self.scenes[i].group for i in scenes]),
                    valid=valid,
                    seed=seeds[0],
                ),
            )


def batch_size(count: int) -> int:
    """Size of equal batches of at most `BATCH`.

    >>> batch_size(60), batch_size(120), batch_size(130)
    (60, 60, 44)
    """
    batches = -(-count // BATCH)
    return -(-count // batches)


def seen_envs(
    plan: EvaluationPlan,
    condition: Condition,
    scenes: list[Scene],
    num_envs: int,
    frames: int | None = None,
) -> gym.vector.VectorEnv:
    """Environments that policies see: their reward, which is not used, costs next to nothing."""
    options = {k: v for k, v in plan.arguments(condition).items() if k not in ("costs", "reward")}
    options |= {"scenes": scenes, "scorer": _CHEAP}
    return make_envs(options, num_envs=num_envs, frames=frames or plan.frames)


def judged_envs(
    plan: EvaluationPlan, condition: Condition, scenes: list[Scene], num_envs: int
) -> gym.vector.VectorEnv:
    """Environments with the plan's scorer, for score tables."""
    options = {k: v for k, v in plan.arguments(condition).items() if k != "costs"}
    options |= {"scenes": scenes, "delay": 0}
    return make_envs(options, num_envs=num_envs, frames=plan.frames)
