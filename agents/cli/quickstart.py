"""The main job: train two agents on simulated raws and show them beside a light meter."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from agents.evaluation.protocol import evaluate, fit_policies
from agents.evaluation.result import EvaluationResult
from agents.learning.training import AgentConfig, TrainingJob, train_in_parallel
from agents.policy import Policy, PolicyContext, make_policy
from agents.report.of_evaluation import write_report
from simulator.utils.files import write_atomically

#: Policies that need no training, in the order of the table.
BASELINES = (
    "random",
    "best_fixed",
    "average:P",
    "centre_weighted:P",
    "matrix:P",
    "centre_weighted:tuned",
    "matrix:tuned",
    "oracle",
)
#: Frames that each agent sees: both trainings end within about three minutes on two cores.
REGRESSION_FRAMES = 75_000
PPO_FRAMES = 80_000


class Task(Protocol):
    """A progress bar."""

    def __call__(self, done: int, total: int, note: str = "") -> None:
        """Moves the bar."""


#: Opens a progress bar with the given title.
Progress = Callable[[str], AbstractContextManager[Task]]


@dataclass(frozen=True)
class QuickstartResult:
    """What a quickstart leaves.

    Args:
        result: The evaluation.
        files: Written files by name.
        agents: The trained agents, file names without suffix.
        zero_shot: Whether the scenes had no training split, so that the agents were trained on the
            bundled ones.
    """

    result: EvaluationResult
    files: Mapping[str, Path]
    agents: Mapping[str, Path]
    zero_shot: bool


def run_quickstart(
    scenes: str, out: Path, *, seed: int, progress: Progress, command: str, device: str = "cpu"
) -> QuickstartResult:
    """Score tables, trainings, evaluation, report; a second run goes on where the first stopped.

    Args:
        scenes: ``"bundled"``, or a folder of raws or radiance maps.
        out: Folder for everything that is written.
        seed: Of trainings and evaluation.
        progress: Opens progress bars.
        command: The command line, for the report.
        device: Torch device of the agents' networks.
    """
    source, zero_shot = training_scenes(scenes)
    environment = {"scenes": source, "split": "train", "resolution": 64}
    with progress("scenes and score tables") as task:
        prepare_tables(environment, task)
    agents = _train(environment, out, seed, progress, device)
    evaluation = {"scenes": scenes, "split": "test", "resolution": 64}
    policies = _policies(evaluation, agents, device)
    with progress("light meters learn their programs") as task:
        fit_policies(policies, environment, seed=seed, progress=task)
    with progress("evaluation on unseen scenes") as task:
        result = evaluate(policies, evaluation, episodes_per_scene=2, seed=seed, progress=task)
    files = write_report(
        result,
        out,
        command=command,
        source=scenes,
        split="test",
        next_commands=next_commands(scenes, out, agents),
        extra_meta={"trained_on": source, "zero_shot": zero_shot},
    )
    with progress("contact sheet") as task:
        sheet = _contact_sheet(evaluation, policies, out / "contact_sheet.png", seed)
        task(1, 1)
    return QuickstartResult(result, {**files, "contact_sheet.png": sheet}, agents, zero_shot)


def training_scenes(scenes: str) -> tuple[str, bool]:
    """Where agents for `scenes` are trained: there, or on the bundled ones if they are too few."""
    from ae_env.options import EnvOptions
    from ae_env.scenes.loading import BUNDLED

    if scenes not in BUNDLED:
        groups = {s.group for s in EnvOptions(scenes=scenes, split="all").load_scenes()}
        if len(groups) < 15:
            return "bundled", True
    return scenes, False


def prepare_tables(environment: Mapping[str, Any], task: Task) -> None:
    """Works out the score tables of all scenes, so that they are cached for every process."""
    from ae_env.options import EnvOptions
    from ae_env.scorers.score_table import ScoreTables

    options = EnvOptions.from_kwargs(environment)
    scenes = options.load_scenes()
    tables = ScoreTables(options.make_grid(), options.make_camera(), options.make_scorer())
    for i, scene in enumerate(scenes):
        tables.closed_parts(scene)
        task(i + 1, len(scenes))


def _train(
    environment: dict[str, Any], out: Path, seed: int, progress: Progress, device: str
) -> dict[str, Path]:
    settings: dict[str, dict[str, Any]] = {
        "regression": {"frames": REGRESSION_FRAMES, "seed": seed},
        "ppo": {"total_timesteps": PPO_FRAMES, "seed": seed},
    }
    jobs = [
        TrainingJob(
            name,
            AgentConfig(agent=name, environment=environment, training=training),  # type: ignore[arg-type]
            out / "agents" / name,
            device,
        )
        for name, training in settings.items()
    ]
    with progress("training regression") as first, progress("training PPO") as second:
        tasks = {"regression": first, "ppo": second}

        def report(name: str, done: int, total: int, values: dict[str, float]) -> None:
            tasks[name](done, total, ", ".join(f"{k} {v:.3f}" for k, v in values.items()))

        train_in_parallel(jobs, progress=report)
        for task in tasks.values():
            task(1, 1)
    return {job.name: job.out for job in jobs}


def _policies(
    evaluation: dict[str, Any], agents: Mapping[str, Path], device: str
) -> dict[str, Policy]:
    from agents.episodes import make_envs

    envs = make_envs(evaluation, num_envs=1, frames=1)
    context = PolicyContext.from_envs(envs)
    envs.close()
    policies = {name: make_policy(name, context) for name in BASELINES}
    learnt = {
        name: make_policy(f"{name}:{path}", context, device=device) for name, path in agents.items()
    }
    oracle = policies.pop("oracle")
    return {**policies, **learnt, "oracle": oracle}


def _contact_sheet(
    evaluation: dict[str, Any], policies: Mapping[str, Policy], path: Path, seed: int
) -> Path:
    """The states of one scene with the paths of a light meter and the two agents."""
    import io

    from ae_env.rendering import contact_sheet
    from agents.episodes import make_envs

    envs = make_envs(evaluation, num_envs=1, frames=8)
    base: Any = envs.unwrapped
    hard = [s for s in base.scenes if s.kind == "back_light"] or base.scenes
    scene = hard[min(2, len(hard) - 1)]
    paths = {}
    for name in ("centre_weighted:P", "regression", "ppo"):
        observations, _ = envs.reset(seed=seed, options={"scene": scene.scene_id, "state": 0})
        policies[name].reset(1, seed=seed)
        states = [int(base.states[0])]
        for _ in range(4):
            actions = policies[name].act(observations)
            observations, *_ = envs.step(np.asarray(actions))
            states.append(int(base.states[0]))
        paths[name] = states
    episode = base.episode(0)
    picture = contact_sheet(
        scene, camera=base.camera, speed=episode.speed, defocus=episode.defocus, path=paths
    )
    envs.close()
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG")
    return write_atomically(path, buffer.getvalue())


def next_commands(scenes: str, out: Path, agents: Mapping[str, Path]) -> Sequence[str]:
    """Command lines to try after a quickstart."""
    own = [] if scenes == "bundled" else ["--scenes", scenes]
    evaluation = ["ae-env", "evaluate", "--policy", f"ppo:{agents['ppo']}"]
    evaluation += ["--policy", "matrix:tuned", *own, "--out", f"{out}/meters"]
    return (
        shlex.join(evaluation),
        "ae-env evaluate --policy my_policy.py:MyPolicy",
        "ae-env quickstart --scenes path/to/your/raws --out my_scenes",
        "ae-env train configs/regression.yaml --out runs/regression",
    )
