"""``ae-env record``: episodes of a policy as a Minari dataset."""

from __future__ import annotations

from contextlib import closing
from typing import Annotated, Any

import typer

from agents.cli.console import Seed, console, print_line, progress_bars


def record(
    policy: Annotated[str, typer.Option(help="The policy that acts.")],
    out: Annotated[str, typer.Option("--out", "-o", help="Name, such as ae_env/matrix-v0.")],
    task: Annotated[
        str, typer.Option(help="AutoExposure-v0 or AutoExposureVideo-v0.")
    ] = "AutoExposure-v0",
    env: Annotated[
        str | None, typer.Option(help="Preset of the environment, or a YAML file.")
    ] = None,
    scenes: Annotated[str | None, typer.Option(help="Scenes to draw from.")] = None,
    split: Annotated[str | None, typer.Option(help="train (default), test or all.")] = None,
    episodes: Annotated[int, typer.Option(help="How many.", min=1, max=1_000_000)] = 200,
    seed: Seed = 0,
) -> None:
    """Record episodes of a policy as a Minari dataset.

    It lies in Minari's folder, or in that of MINARI_DATASETS_PATH; `minari list local` shows it.

    Example: `ae-env record --policy matrix:tuned -o ae_env/matrix-v0`
    """
    import gymnasium as gym

    from ae_env.utils.presets import load_preset
    from agents.evaluation.running import fit_policies
    from agents.policy import PolicyContext
    from agents.policy_names import make_policy
    from agents.recording import check_dataset_id, record_dataset
    from agents.rollouts import fitting_arguments
    from simulator.utils.checks import check_word

    check_word("task", task, ("AutoExposure-v0", "AutoExposureVideo-v0"))
    check_dataset_id(out)
    given = {"split": split, "scenes": scenes}
    options: dict[str, Any] = {
        "split": "train",
        **({} if env is None else load_preset(env)),
        **{name: value for name, value in given.items() if value is not None},
    }
    task = f"ae_env/{task}"
    with closing(gym.make_vec(f"ae_env:{task}", num_envs=1, **options)) as envs:
        acting = make_policy(policy, PolicyContext.from_envs(envs))
        arguments = {k: v for k, v in options.items() if k != "max_episode_steps"}
        arguments |= {"grid": "video"} if "Video" in task and "grid" not in arguments else {}
        arguments = fitting_arguments(arguments, options.get("resolution", 64))
    with progress_bars() as progress:
        with progress("fitting") as bar:
            fit_policies({policy: acting}, arguments, seed=seed, progress=bar)
        with progress("episodes") as bar:
            dataset = record_dataset(
                acting, policy, task, options, out, episodes=episodes, seed=seed, progress=bar
            )
    mean = sum(one.rewards.sum() for one in dataset.iterate_episodes()) / dataset.total_steps
    console.print(f"{dataset.total_steps:,} steps, mean reward {mean:.3f}")
    print_line(f'read it with: minari.load_dataset("{out}")')
