"""``ae-env export``: an agent for a camera, as one ONNX file."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from agents.cli.console import console, make_folder, print_files


def export(
    policy: Annotated[
        str, typer.Argument(help="regression, ppo, regression:video, regression:PATH or ppo:PATH.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The .onnx file.")] = Path("policy.onnx"),
) -> None:
    """Export a trained agent to ONNX, to run it without torch (`agents.onboard.Controller`).

    Its states, and what it keeps in mind between frames, are in the same file.

    Example: `ae-env export regression -o policy.onnx`
    """
    import gymnasium as gym

    from agents.learning.weights import load_agent, trained_grid
    from agents.onboard.controller import Controller
    from agents.onboard.export import export_agent
    from agents.policy import PolicyContext
    from agents.policy_names import make_policy, training_seeds

    kind = policy.partition(":")[0].partition("?")[0]
    if kind not in ("regression", "ppo") or "*" in policy or "?" in policy:
        raise ValueError(
            f"`policy` (={policy!r}) must be regression or ppo, alone or with :video or :PATH"
        )
    if out.suffix != ".onnx":
        raise ValueError(f"`out` (={str(out)!r}) must end in .onnx")
    make_folder(out.parent, file=out)
    name = training_seeds(policy)[0]
    _, card = load_agent(name.partition(":")[2], kind)
    seen, grid = card["context"], trained_grid(card)
    states = {n: list(getattr(grid, n)) for n in ("isos", "exposure_times", "f_numbers")}
    with closing(
        gym.make_vec(
            "ae_env:ae_env/AutoExposure-v0",
            num_envs=1,
            scenes="bundled:small",
            resolution=seen["resolution"][-1],
            sensors=seen["sensors"],
            grid=states,
        )
    ) as envs:
        agent = make_policy(name, PolicyContext.from_envs(envs))
    file = export_agent(agent, out)
    controller = Controller(file)
    console.print(
        f"{len(controller.states)} states, frames of {controller.frame_shape}, "
        f"{file.stat().st_size / 1e6:.2f} MB"
    )
    print_files({"agent": file})
