"""``ae-env film``: one episode of moving light, by several policies side by side."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import typer

from agents.cli.console import Seed, make_folder, print_files, progress_bars

#: Policies of a film where none is given.
POLICIES = ("average:tuned", "average:tuned?foresight=model", "regression:video?foresight=learnt")


def film(
    policy: Annotated[
        list[str] | None, typer.Option(help="A policy; give the option several times.")
    ] = None,
    light: Annotated[
        str, typer.Option(help="Kind of moving light: tunnels, sines, shadows, clouds, pans...")
    ] = "tunnels",
    scenes: Annotated[str, typer.Option(help="Scenes to draw from.")] = "bundled",
    scene: Annotated[str | None, typer.Option(help="Id of the scene; drawn by default.")] = None,
    frames: Annotated[int, typer.Option(help="Actions of the episode.", min=1)] = 64,
    seed: Seed = 0,
    out: Annotated[Path, typer.Option(help="The animated GIF.")] = Path("film.gif"),
) -> None:
    """Film one episode of AutoExposureVideo-v0: policies side by side, in the same moving light.

    Example: `ae-env film --policy average:tuned --policy ppo:video --light shadows`
    """
    import gymnasium as gym

    import ae_env  # noqa: F401  (registers the environment)
    from ae_env.lighting.moving import KIND_SETS, MOVES
    from agents.evaluation.running import fit_policies
    from agents.policy import PolicyContext
    from agents.policy_names import make_policy
    from agents.report.film import film as write
    from simulator.utils.checks import check_word

    if out.suffix.lower() != ".gif":
        raise ValueError(f"`out` (={str(out)!r}) must end in .gif: the film is an animated GIF")
    make_folder(out.parent, file=out)
    check_word("light", light, (*MOVES, *KIND_SETS))
    options: dict[str, Any] = {"scenes": scenes, "split": "test"}
    envs = gym.make_vec(
        "ae_env/AutoExposureVideo-v0",
        num_envs=1,
        **options,
        lighting={"kind": "moving", "kinds": light},
        max_episode_steps=frames + 1,
        render_mode="rgb_array",
        with_oracle=True,
    )
    with closing(envs), progress_bars() as progress:
        if scene is not None:
            _check_scene(scene, envs)
        context = PolicyContext.from_envs(envs)
        policies = {name: make_policy(name, context) for name in policy or POLICIES}
        with progress("fitting") as task:
            fit_policies(policies, {"scenes": "bundled", "grid": "video"}, progress=task)
        with progress("film") as task:
            write(policies, envs, out, frames=frames, seed=seed, scene=scene, progress=task)
    print_files({"film": out})


def _check_scene(scene: str, envs: Any) -> None:
    """Raises a `ValueError` unless `envs` have `scene`."""
    from simulator.utils.checks import did_you_mean

    known = [one.scene_id for one in envs.unwrapped.scenes]
    if scene not in known:
        raise ValueError(
            f"`scene` (={scene!r}) must be the id of a test scene, such as {known[0]!r}"
            f"{did_you_mean(scene, known)}"
        )
