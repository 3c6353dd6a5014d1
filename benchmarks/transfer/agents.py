"""Agents trained in each world, and judged on held-out scenes in the truth."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ae_env.options import EnvOptions
from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.load import simulate_source_raw
from ae_env.scenes.polyhaven import list_assets
from ae_env.scenes.scene import Crop, Split
from agents.evaluation.engine import evaluate
from agents.evaluation.evaluation_plan import groups_in_turn
from agents.evaluation.intervals import difference_interval, score_interval
from agents.evaluation.result import EvaluationResult
from agents.learning.training import TrainingJob, load_config, train_in_parallel
from agents.policy_names import make_policy
from benchmarks.agents import changed_config, context_of
from benchmarks.fidelity.models import weights
from benchmarks.harness import RUNS, Row, sections, table
from benchmarks.isolated import ROOT
from simulator import CameraProfile

#: Range of the ISO of the sources that the claim about noisy ones is about.
HIGH_ISO = (1600.0, 6400.0)
#: Packed pixels a side, of every training and every table.
RESOLUTION = 64
#: EXP has no network: exposure ratio and noise level function only. The weights of `PAPER` do not
#: come with the package.
TRUTH, EXP, PAPER = "truth", "EXP", "paper"
SIMULATORS = (EXP, "nano", "compact", "large", PAPER)
#: Bundled scenes and views of real places together.
BOTH = "both"


# -- scenes ---------------------------------------------------------------------------------------


def scenes_of(
    name: str,
    crop: Crop,
    split: Split,
    camera: CameraProfile,
    resolution: int | None,
    high_iso: bool = False,
) -> list[Scene]:
    """Scenes of a set; or each photographed once at an ISO of 1600 to 6400, drawn by its name.

    What `source="raw"` makes of them but for the ISO: exposure and noise are drawn alike.
    """
    names = ("bundled", "polyhaven") if name == BOTH else (name,)
    common: dict[str, Any] = {"camera": camera, "resolution": resolution, "crop": crop}
    found = [scene for one in names for scene in load_scenes(one, split, **common)]
    return [simulate_source_raw(s, iso_range=HIGH_ISO) for s in found] if high_iso else found


#: What the environment's `scenes` names, as ``"benchmarks.transfer.agents:high_iso_both_box"``.
both_box: Callable[..., list[Scene]] = partial(scenes_of, BOTH, "box")
high_iso_both_box: Callable[..., list[Scene]] = partial(both_box, high_iso=True)
high_iso_bundled_box, high_iso_small_box = (
    partial(scenes_of, name, "box", high_iso=True) for name in ("bundled", "bundled:small")
)


# -- worlds ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class World:
    """What an agent is trained in."""

    simulator: str
    high_iso: bool = False

    @property
    def name(self) -> str:
        """In tables and file names."""
        return f"{self.simulator}-iso1600" if self.high_iso else self.simulator

    def options(self, scenes: str) -> dict[str, Any]:
        """Arguments of the environment that differ between the worlds, of a set of scenes."""
        if self.high_iso:
            scenes = f"{__name__}:high_iso_{scenes.split(':')[-1]}_box"
        elif scenes == BOTH:
            scenes = f"{__name__}:{BOTH}_box"
        if self.simulator == TRUTH:
            return {"scenes": scenes, "source": "light"}
        return {"scenes": scenes, "source": "raw", "simulator": simulator_argument(self.simulator)}


def simulator_argument(name: str) -> str | None:
    """The environment's argument for a simulator's name."""
    return None if name == EXP else str(weights(name))


#: All of them by name; the truth comes first: the others are compared with it.
_SOURCES = (World(TRUTH), World(EXP), World("compact"), World("large"), World(PAPER))
_NOISY = (World(EXP, high_iso=True), World("compact", high_iso=True))
WORLDS: dict[str, World] = {world.name: world for world in (*_SOURCES, *_NOISY)}


def has_weights(name: str) -> bool:
    """Whether the networks of a simulator, or of a world's, are there."""
    return not name.startswith(PAPER) or weights(PAPER) is not None


# -- sizes of a run -------------------------------------------------------------------------------


@dataclass(frozen=True)
class TableSet:
    """Score tables that are predicted."""

    scorer: str = "balanced"
    scenes: int = 32
    simulators: tuple[str, ...] = SIMULATORS
    isos: tuple[int, ...] = (100, 400, 1600, 6400)
    evs: tuple[int, ...] = (-3, -1, 0, 1, 3)
    crops: tuple[Crop, ...] = ("box", "native")


#: Tables of a scorer that looks at the captures themselves, noise and all: 0.3 s each.
SEEN = TableSet("fidelity", 10, (EXP, "compact", PAPER), (1600, 6400), (-1, 0, 1))


@dataclass(frozen=True)
class TransferPlan:
    """How much is trained and measured."""

    scenes: str = BOTH
    worlds: tuple[str, ...] = tuple(WORLDS)
    agents: tuple[str, ...] = ("regression", "ppo")
    seeds: tuple[int, ...] = (0, 1, 2)
    frames: int = 16_384
    episodes: int = 2
    judged_scenes: int | None = None
    scorer: str = "balanced"
    tables: tuple[TableSet, ...] = (TableSet(), SEEN)


QUICK = TransferPlan(
    scenes="bundled:small",
    worlds=(TRUTH, EXP, "compact", "EXP-iso1600", "compact-iso1600"),
    seeds=(0,),
    frames=2048,
    episodes=1,
    judged_scenes=16,
    tables=(
        TableSet(scenes=16, simulators=(EXP, "compact"), isos=(100, 6400), evs=(-3, 0, 3)),
        TableSet("fidelity", 2, (EXP, "compact"), (6400,), (0,), ("native",)),
    ),
)


def plan_of(quick: bool) -> TransferPlan:
    return QUICK if quick else TransferPlan()


def training_set(plan: TransferPlan) -> str:
    """The plan's scenes; the bundled ones where it asks for panoramas and there are none."""
    has_panoramas = all(asset.path is not None for asset in list_assets())
    return "bundled" if plan.scenes == BOTH and not has_panoramas else plan.scenes


def held_out(plan: TransferPlan, count: int | None, crop: Crop) -> list[Scene]:
    """`count` test scenes of the truth, kinds and source groups in turn; None for all of them."""
    options = EnvOptions(split="test", resolution=RESOLUTION, crop=crop)
    found = scenes_of(training_set(plan), crop, "test", options.make_camera(), RESOLUTION)
    return groups_in_turn(found, count)


# -- agents trained in each world -----------------------------------------------------------------

#: Name of the hyperparameter that counts frames, by agent.
_FRAMES = {"regression": "frames", "ppo": "total_timesteps"}
#: Of the scenes that agents are trained and judged on: pixels are averaged to frames.
CROP: Crop = "box"
#: What the agents together are called.
TOGETHER = "agents together"
#: The trainings of each agent and world, one for each seed.
Jobs = dict[tuple[str, str], list[TrainingJob]]


def measure(seed: int, quick: bool) -> list[Row]:
    """A row for each agent and world, and for all agents of a world, as so many training seeds.

    `seed` is that of the evaluation; the training seeds are the plan's.
    """
    plan = plan_of(quick)
    jobs = training_jobs(plan, RUNS.parent / f"bench_transfer{'_quick' * quick}")
    train_in_parallel([job for own in zip(*jobs.values(), strict=True) for job in own])
    result, gains, rows = judged(plan, jobs, seed=seed), {}, []
    for agent, world in jobs:  # the span is the same for all
        gains[agent, world], span = result.group_gains(f"{agent} in {world}")
    together = len(plan.agents) > 1
    for world in dict.fromkeys(world for _, world in jobs) if together else ():
        every = [gains[agent, world] for agent in plan.agents]
        gains[TOGETHER, world] = np.concatenate(every)
    for agent in (*plan.agents, *([TOGETHER] if together else [])):
        for world in (world for name, world in gains if name == agent):
            members = plan.agents if agent == TOGETHER else (agent,)
            errors = [result.episode_metrics(f"{one} in {world}") for one in members]
            row: Row = {"agent": agent, "world": world, "high_iso": WORLDS[world].high_iso}
            row |= {"simulator": WORLDS[world].simulator, "frames": plan.frames}
            row |= {"crop": CROP, "scorer": plan.scorer, **comparison(gains, span, agent, world)}
            row |= {"num_scenes": len(set(result.scene_ids.tolist()))}
            for name in ("regret", "ev_within_third"):
                row[name] = float(np.mean([own[name].mean() for own in errors]))
            rows.append(row)
    return rows


def training_jobs(plan: TransferPlan, folder: Path) -> Jobs:
    """The trainings by agent and world: they differ in the environment's options only.

    Seeds change slowest, so that a run that is stopped has some of every world.
    """
    worlds, base = [name for name in plan.worlds if has_weights(name)], training_set(plan)
    jobs: Jobs = {(agent, world): [] for agent in plan.agents for world in worlds}
    for seed in plan.seeds:
        for (agent, world), own in jobs.items():
            options = WORLDS[world].options(base) | common_options(plan)
            config = load_config(ROOT / "configs" / f"{agent}.yaml").with_seed(seed)
            config = changed_config(config, options, {_FRAMES[agent]: plan.frames})
            name = f"{agent}, {world}, seed {seed}"
            own.append(TrainingJob(name, config, folder / f"{agent}-{world}-{seed}"))
    return jobs


def common_options(plan: TransferPlan) -> dict[str, Any]:
    return {"resolution": RESOLUTION, "crop": CROP, "scorer": plan.scorer}


# -- judging --------------------------------------------------------------------------------------


def judged(plan: TransferPlan, jobs: Jobs, *, seed: int = 0) -> EvaluationResult:
    """Every agent on the same episodes on held-out scenes, in the truth."""
    scenes = held_out(plan, plan.judged_scenes, CROP)
    options = {"scenes": scenes, "split": "test", **common_options(plan)}
    context = context_of(options)
    policies = {
        f"{agent} in {world}": [make_policy(f"{agent}:{job.out}", context) for job in own]
        for (agent, world), own in jobs.items()
    }
    return evaluate(policies, options, episodes_per_scene=plan.episodes, seed=seed)


def comparison(
    gains: Mapping[tuple[str, str], np.ndarray], span: np.ndarray, agent: str, world: str
) -> Row:
    """Normalised score of an agent, its drop against the truth, and by how much it beats EXP's."""
    own, truth, score = gains[agent, world], gains[agent, TRUTH], "normalised_score"
    found = {score: score_interval(own, span)}
    exp = World(EXP, high_iso=WORLDS[world].high_iso).name
    if world != TRUTH:
        found["drop"] = difference_interval(truth, own, span)
        if world != exp and (agent, exp) in gains:
            found["more_than_exp"] = difference_interval(own, gains[agent, exp], span)
    row: Row = {"num_seeds": len(own), "num_groups": len(span)}
    row["by_seed"] = (own.sum(axis=1) / span.sum()).tolist()
    for name, interval in found.items():
        row |= {name: interval.value, "ci95" if name == score else f"{name}_ci95": interval.pair}
    return row


# -- tables ---------------------------------------------------------------------------------------

_COLUMNS = """trained in = `{world}` |
normalised score = {normalised_score:.3f} [{ci95[0]:.3f}, {ci95[1]:.3f}] |
drop against `truth` = {drop:+.3f} [{drop_ci95[0]:+.3f}, {drop_ci95[1]:+.3f}] |
more than in `EXP` =
{more_than_exp:+.3f} [{more_than_exp_ci95[0]:+.3f}, {more_than_exp_ci95[1]:+.3f}] |
within 1/3 EV = {ev_within_third:.0%}"""


def shown(rows: Sequence[Row]) -> str:
    return sections(rows, "{agent}", lambda own: table(own, _COLUMNS))
