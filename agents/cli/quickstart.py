"""``ae-env quickstart``: two agents trained and compared with light meters on unseen scenes."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from agents.cli.console import (
    Device,
    OnError,
    Seed,
    command_line,
    console,
    make_folder,
    print_files,
    print_line,
    progress_bars,
    scene_files,
    torch_device,
)
from agents.cli.evaluate import print_scores

if TYPE_CHECKING:
    from agents.evaluation.result import EvaluationResult
    from agents.policy import Policy

#: Policies that need no training, in the order of the table.
BASELINES = (
    *("random", "best_fixed", "average:P", "centre_weighted:P", "matrix:P"),
    *("centre_weighted:tuned", "matrix:tuned", "oracle"),
)
#: Frames that each agent sees: both trainings end within within three minutes on two cores.
REGRESSION_FRAMES = 50_000
PPO_FRAMES = 55_000
#: Episodes per scene of the evaluation.
EPISODES = 2

#: Opens a progress bar with the given title; yields the function that moves it.
Progress = Callable[[str], AbstractContextManager[Callable[..., None]]]

Scenes = Annotated[
    str, typer.Option(help="'bundled', 'polyhaven', or a folder or file of raws or .hdr/.exr maps.")
]


def quickstart(
    scenes: Scenes = "bundled",
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("quickstart"),
    on_error: OnError = "stop",
    seed: Seed = 0,
    device: Device = "cpu",
) -> None:
    """Train two agents, compare them with light meters on unseen scenes: about 5 minutes.

    Example: `ae-env quickstart --scenes ~/my_raws --out my_raws_result`
    """
    make_folder(out)
    device = torch_device(device)
    with progress_bars() as progress:
        done = run_quickstart(
            scenes,
            out,
            seed=seed,
            progress=progress,
            command=command_line(),
            device=device,
            on_error=on_error,
        )
    if done.zero_shot:
        print_line(f"fewer than 15 source groups in {scenes}: agents trained on bundled scenes")
    print_scores(done.result)
    print_files(done.files)
    console.print("\nTry next:")
    for line in next_commands(scenes, out, done.agents, on_error):
        print_line(f"  {line}")


@dataclass(frozen=True)
class QuickstartResult:
    """The evaluation, files and agents of a quickstart.

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
    scenes: str,
    out: Path,
    *,
    seed: int,
    progress: Progress,
    command: str,
    device: str = "cpu",
    on_error: str = "stop",
) -> QuickstartResult:
    """Trainings, evaluation, report; a second run resumes the first.

    Args:
        scenes: ``"bundled"``, ``"polyhaven"``, or a folder of raws or radiance maps.
        out: Folder for everything that is written.
        seed: Of trainings and evaluation.
        progress: Opens progress bars.
        command: The command line, for the report.
        device: Torch device of the agents' networks.
        on_error: See `ae_env.scenes.folder.FolderOptions`.
    """
    from agents.evaluation.engine import evaluate, fit_policies
    from agents.evaluation.plan import MAX_SEED
    from agents.report.evaluation import write_report
    from agents.rollouts import make_envs, training_arguments
    from simulator.utils.checks import check_integer

    check_integer("seed", seed, 0, MAX_SEED + 1 - EPISODES)
    files = scene_files(scenes, on_error)
    learnt, zero_shot = training_arguments(files)
    environment = {**learnt, "split": "train", "resolution": 64}
    # Scenes and compiled code into their caches, before processes share the trainings.
    with progress("scenes") as task:
        envs = make_envs(environment, num_envs=1, frames=1)
        found = list(envs.unwrapped.scenes)  # type: ignore[attr-defined]  # draws every one
        envs.reset(seed=seed)
        envs.close()
        task(1, 1, f"{len(found)} to learn from")
    agents = _train(environment, out, seed, progress, device)
    unseen = {"scenes": files, "split": "test", "resolution": 64}
    policies = _policies(unseen, agents, device)
    with progress("light meters learn their programs") as task:
        fit_policies(policies, environment, seed=seed, progress=task)
    with progress("evaluation on unseen scenes") as task:
        result = evaluate(policies, unseen, episodes_per_scene=EPISODES, seed=seed, progress=task)
    written = write_report(
        result,
        out,
        command=command,
        next_commands=next_commands(scenes, out, agents, on_error),
        extra_meta={"trained_on": learnt["scenes"], "zero_shot": zero_shot},
    )
    return QuickstartResult(result, written, agents, zero_shot)


def _train(
    environment: dict[str, Any], out: Path, seed: int, progress: Progress, device: str
) -> dict[str, Path]:
    from agents.learning.training import AgentConfig, TrainingJob, train_in_parallel

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
    environment: dict[str, Any], agents: Mapping[str, Path], device: str
) -> dict[str, Policy]:
    from agents.policy import PolicyContext
    from agents.policy_names import make_policy
    from agents.rollouts import make_envs

    envs = make_envs(environment, num_envs=1, frames=1)
    context = PolicyContext.from_envs(envs)
    envs.close()
    learnt = {name: f"{name}:{path}" for name, path in agents.items()}
    names = {name: name for name in BASELINES[:-1]} | learnt | {"oracle": "oracle"}
    return {name: make_policy(own, context, device=device) for name, own in names.items()}


def next_commands(
    scenes: str, out: Path, agents: Mapping[str, Path], on_error: str = "stop"
) -> Sequence[str]:
    """Command lines to try after a quickstart."""
    own = [] if scenes == "bundled" else ["--scenes", scenes]
    own += [] if on_error == "stop" else ["--on-error", on_error]
    evaluation = ["ae-env", "evaluate", "--policy", f"ppo:{agents['ppo']}"]
    evaluation += ["--policy", "matrix:tuned", *own, "--out", f"{out}/meters"]
    return (
        shlex.join(evaluation),
        "ae-env evaluate --policy path/to/your_policy.py:YourPolicy",
        "ae-env quickstart --scenes path/to/your/raws --out my_scenes",
        "ae-env train configs/regression.yaml --out runs/regression",
    )
