"""Trainings and their results: ``ae-env train``, ``train-simulator`` and ``export``."""

import contextlib
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from agents.cli import console
from agents.cli.console import print_files, print_line, progress_bars

if TYPE_CHECKING:
    from agents.learning.training import AgentConfig


def train(
    config: Annotated[Path, Argument(help="YAML such as configs/regression.yaml.")],
    out: Annotated[Path, Option(help="File name of the agent, without suffix.")] = Path(
        "runs/agent"
    ),
    seed: console.OwnSeed = None,
    device: console.Device = "cpu",
    tensorboard: Annotated[Path | None, Option(help="Folder for a TensorBoard log.")] = None,
    trust: console.Trust = False,
) -> None:
    """Train an agent; a second run resumes the first.

    Example: `ae-env train configs/ppo.yaml --out runs/ppo`
    """
    from ae_env.utils.user_files import find_config
    from agents.learning.training import load_config, load_curve, train_agent
    from agents.report.plots import plot_learning
    from simulator.utils.files import sibling

    console.trust_configuration(trust)
    device = console.torch_device(device)
    agent = load_config(find_config(config))
    file = sibling(out, ".json")
    console.make_folder(file.parent, file=file)
    if tensorboard is not None:
        console.make_folder(tensorboard, name="tensorboard", make=False)
    if seed is not None:
        agent = agent.with_seed(seed)
    with progress_bars() as progress, progress(f"training {agent.agent}") as task:
        train_agent(agent, out, progress=task, device=device, tensorboard=tensorboard)
    files = {"weights": sibling(out, ".safetensors"), "description": file}
    curve = sibling(out, ".csv")
    if curve.is_file():
        picture = plot_learning(sibling(out, ".png"), {agent.agent: load_curve(curve)})
        files |= {"learning curve": curve, "its picture": picture}
    print_files(files)
    print_line("next: " + shlex.join(["ae-env", "evaluate", *_evaluation(agent, out)]))


def _evaluation(agent: "AgentConfig", out: Path) -> list[str]:
    """Options that evaluate the agent on what it was trained for."""
    if agent.agent == "forecaster":
        return ["--preset", "video", "--policy", f"regression:video?foresight={out}"]
    words = ["--policy", f"{agent.agent}:{out}"]
    if agent.task == "ae_env/AutoExposureVideo-v0":
        words = ["--preset", "video", *words]
    elif isinstance(agent.environment.get("grid"), str):
        words += ["--grid", agent.environment["grid"]]
    for name in ("observation", "resolution"):
        if name in agent.environment:
            words += [f"--{name}", str(agent.environment[name])]
    return words if agent.environment.get("sensors", True) else [*words, "--no-sensors"]


def train_simulator(
    config: Annotated[Path, Argument(help="YAML such as configs/simulator/compact.yaml.")],
    out: Annotated[
        Path | None, Option(help="Folder; by default runs/simulator/NAME-OF-THE-CONFIG.")
    ] = None,
    seed: console.OwnSeed = None,
    device: console.Device = "auto",
    tensorboard: Annotated[bool, Option(help="Log to OUT/tensorboard.")] = True,
) -> None:
    """Train the simulator's modules stage by stage; a second run resumes the first.

    Example: `ae-env train-simulator configs/simulator/compact.yaml`

    Several processes or GPUs: `accelerate launch -m agents.cli train-simulator CONFIG`.
    """
    from ae_env.utils.user_files import find_config
    from simulator.training.trainer import SimulatorConfig, first_modules, train_and_save
    from simulator.utils.config_file import load_yaml

    training = load_yaml(find_config(config), SimulatorConfig)
    if seed is not None:
        training = training.model_copy(update={"seed": seed})
    if training.start is not None:
        first_modules(training)
    folder = Path("runs/simulator") / config.stem if out is None else out
    console.make_folder(folder)
    device = console.torch_device(device)
    tasks: dict[str, Any] = {}
    with progress_bars() as progress, contextlib.ExitStack() as stack:

        def report(name: str, share: float, values: dict[str, float]) -> None:
            if name not in tasks:
                tasks[name] = stack.enter_context(progress(name))
            tasks[name](share, 1.0, values)

        how: dict[str, Any] = {"device": device, "tensorboard": tensorboard, "progress": report}
        how["command"] = console.command_line()
        weights = train_and_save(training, folder / training.preset, **how)
    print_files({"weights": weights, "model card": weights.with_suffix(".json")})
    if training.preset in ("compact", "paper"):
        command = shlex.join(["ae-env", "simulate", "RAW", "--weights", str(weights)])
        print_line(f"next: {command} ...")


def export(
    policy: Annotated[
        str, Argument(help="regression, ppo, regression:video, regression:PATH or ppo:PATH.")
    ],
    out: Annotated[Path, Option("--out", "-o", help="The .onnx file.")] = Path("policy.onnx"),
) -> None:
    """Export a trained agent to ONNX, to run it without torch.

    `agents.onboard.controller.Controller` runs it. Its states, and what it keeps in mind between
    frames, are in the same file.

    Example: `ae-env export regression -o policy.onnx`
    """
    import gymnasium as gym

    from agents.learning.policy_file import load_agent, trained_grid
    from agents.onboard.controller import Controller
    from agents.onboard.export import export_agent
    from agents.policy import PolicyContext
    from agents.policy_names import LEARNT_AGENTS, make_policy, training_seeds

    kind = policy.partition(":")[0].partition("?")[0]
    if kind not in LEARNT_AGENTS or "*" in policy or "?" in policy:
        rule = "must be regression or ppo, alone or with :video or :PATH"
        raise ValueError(f"`policy` (={policy!r}) {rule}")
    console.check_outputs(out=(out, ".onnx"))
    name = training_seeds(policy)[0]
    _, card = load_agent(name.partition(":")[2], kind)
    seen, grid = card["context"], trained_grid(card)
    states = {n: list(getattr(grid, n)) for n in ("isos", "exposure_times", "f_numbers")}
    resolution = [64, *seen.get("resolution", ())][-1]
    options = {"resolution": resolution, "sensors": seen.get("sensors", True), "grid": states}
    task = "ae_env:ae_env/AutoExposure-v0"
    with contextlib.closing(gym.make_vec(task, scenes="bundled:small", **options)) as envs:
        agent = make_policy(name, PolicyContext.from_envs(envs))
    agent.name = policy  # for errors
    file = export_agent(agent, out)
    controller = Controller(file)
    size, frame = file.stat().st_size / 1e6, controller.frame_shape
    print_line(f"{len(controller.states)} states, frames of {frame}, {size:.2f} MB")
    print_files({"agent": file})
