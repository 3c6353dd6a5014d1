"""``ae-env quickstart``: two agents trained and compared with light meters on unseen scenes."""

import shlex
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from agents.cli import console
from agents.cli.console import print_line
from agents.cli.evaluate import print_scores

if TYPE_CHECKING:
    from agents.policy import Policy

#: Policies that need no training, in the order of the table.
BASELINES = (
    *("random", "best_fixed", "average:P", "centre_weighted:P", "matrix:P"),
    *("centre_weighted:tuned", "matrix:tuned", "oracle"),
)
#: Frames that each agent sees: both trainings end within three minutes on two cores.
REGRESSION_FRAMES = 50_000
PPO_FRAMES = 55_000
#: Episodes per scene of the evaluation.
EPISODES = 2


@console.takes_source
def quickstart(
    scenes: Annotated[
        str, Option(help="'bundled', 'polyhaven', or a folder or file of raws or .hdr/.exr maps.")
    ] = "bundled",
    out: console.Folder = Path("quickstart"),
    on_error: console.OnError = "stop",
    source: Any = None,
    seed: console.Seed = 0,
    device: console.Device = "cpu",
) -> None:
    """Train two agents, compare them with light meters on unseen scenes: 5 to 10 minutes.

    Example: `ae-env quickstart --scenes ~/my_raws --out my_raws_result`
    """
    from agents.evaluation.engine import evaluate, fit_policies
    from agents.evaluation.evaluation_plan import MAX_SEED
    from agents.report.evaluation import write_report
    from agents.rollouts import make_envs, scenes_of, training_arguments
    from simulator.utils.checks import check_integer

    console.make_folder(out)
    device = console.torch_device(device)
    check_integer("seed", seed, 0, MAX_SEED + 1 - EPISODES)
    files = console.scene_files(scenes, on_error, source)
    learnt, zero_shot = training_arguments(files)
    environment = {**learnt, "split": "train", "resolution": 64}
    unseen = {"scenes": files, "split": "test", "resolution": 64}
    with console.progress_bars() as progress:
        # Scenes and compiled code into their caches, before processes share the trainings.
        with progress("scenes") as task:
            with closing(make_envs(environment, num_envs=1, frames=1)) as envs:
                count = len(scenes_of(envs))  # draws every one
                envs.reset(seed=seed)
            task(1, 1, f"{count} to learn from")
        agents = _train(environment, out, seed, progress, device)
        policies = _policies(unseen, agents, device)
        with progress("light meters learn their programs") as task:
            fit_policies(policies, environment, seed=seed, progress=task)
        with progress("evaluation on unseen scenes") as task:
            result = evaluate(
                policies, unseen, episodes_per_scene=EPISODES, seed=seed, progress=task
            )
    commands = next_commands(scenes, out, agents, on_error, source)
    meta = {"trained_on": learnt["scenes"], "zero_shot": zero_shot}
    more: dict[str, Any] = {"next_commands": commands, "extra_meta": meta}
    written = write_report(result, out, command=console.command_line(), **more)
    if zero_shot:
        print_line(f"fewer than 15 source groups in {scenes}: agents trained on bundled scenes")
    print_scores(result)
    console.print_files(written)
    console.terminal.print("\nTry next:")
    for line in commands:
        print_line(f"  {line}")


def _train(
    environment: dict[str, Any], out: Path, seed: int, progress: Any, device: str
) -> dict[str, Path]:
    """Files of the trained agents, by name, without suffix."""
    from agents.learning.training import AgentConfig, TrainingJob, train_in_parallel

    settings: dict[str, dict[str, Any]] = {
        "regression": {"frames": REGRESSION_FRAMES, "seed": seed},
        "ppo": {"total_timesteps": PPO_FRAMES, "seed": seed},
    }
    jobs = []
    for name, training in settings.items():
        config = AgentConfig(agent=name, environment=environment, training=training)  # type: ignore[arg-type]
        jobs.append(TrainingJob(name, config, out / "agents" / name, device))
    with progress("training regression") as first, progress("training PPO") as second:
        tasks = {"regression": first, "ppo": second}
        train_in_parallel(jobs, progress=lambda name, *values: tasks[name](*values))
        for task in tasks.values():
            task(1, 1)
    return {job.name: job.out for job in jobs}


def _policies(
    environment: dict[str, Any], agents: Mapping[str, Path], device: str
) -> "dict[str, Policy]":
    from agents.policy import PolicyContext
    from agents.policy_names import make_policy
    from agents.rollouts import make_envs

    with closing(make_envs(environment, num_envs=1, frames=1)) as envs:
        context = PolicyContext.from_envs(envs)
    learnt = {name: f"{name}:{path}" for name, path in agents.items()}
    names = {name: name for name in BASELINES[:-1]} | learnt | {"oracle": "oracle"}
    return {name: make_policy(own, context, device=device) for name, own in names.items()}


def next_commands(
    scenes: str, out: Path, agents: Mapping[str, Path], on_error: str, source: Mapping[str, float]
) -> Sequence[str]:
    """Command lines to try afterwards."""
    own = [] if scenes == "bundled" else ["--scenes", scenes]
    own += [] if on_error == "stop" else ["--on-error", on_error]
    own += [word for name, v in source.items() for word in (f"--{console.SOURCE[name]}", str(v))]
    evaluation = ["ae-env", "evaluate", "--policy", f"ppo:{agents['ppo']}"]
    evaluation += ["--policy", "matrix:tuned", *own, "--out", f"{out}/meters"]
    return (
        shlex.join(evaluation),
        "ae-env evaluate --policy path/to/your_policy.py:YourPolicy",
        "ae-env quickstart --scenes path/to/your/raws --out my_scenes",
        "ae-env train configs/regression.yaml --out runs/regression",
    )
