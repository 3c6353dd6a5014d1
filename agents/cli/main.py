"""The command line: every command is a thin layer over a function of the three packages."""

from __future__ import annotations

import importlib
import logging
import shlex
import signal
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.logging import RichHandler
from rich.markup import escape

from ae_env.utils.checks import UserCodeError, check_word
from agents.cli.console import (
    Device,
    OwnSeed,
    Seed,
    command_line,
    console,
    make_folder,
    print_files,
    progress_bars,
    torch_device,
)
from agents.cli.evaluate import evaluate, print_scores
from agents.cli.scorers import convert_nima, scorers
from agents.cli.simulator_commands import simulate, sweep, train_simulator

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    help="Train and judge auto-exposure on simulated raws. Start with `ae-env quickstart`.",
    epilog="Exit status: 2 for a mistake in an option or a file, 1 for a failure while running.",
)
BENCHMARKS = (
    *("agents", "brackets", "colour_checker", "convergence", "defects", "scorers", "simulator"),
    *("stability", "throughput", "work-precision"),
)
#: Commands that go on where they were stopped.
_RESUMING = ("quickstart", "train", "train-simulator", "evaluate", "bench")
#: Errors about what the user gave.
_USAGE = (ValueError, FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError)
#: Exit status after Ctrl-C, and after SIGTERM.
_INTERRUPTED, _TERMINATED = 130, 143

Scenes = Annotated[
    str, typer.Option(help="'bundled', or a folder or file of raws or .hdr/.exr radiance maps.")
]


def main() -> None:
    """Runs the command line.

    An error becomes one line, and exit status 2 where it is about what the user gave (options,
    files), 1 where something failed while running; Ctrl-C gives 130, SIGTERM 143.
    """
    logging.basicConfig(
        level=logging.WARNING,
        format="%(message)s",
        handlers=[RichHandler(console=Console(stderr=True), show_time=False, show_path=False)],
    )
    signal.signal(signal.SIGTERM, _terminate)
    try:
        app(prog_name="ae-env")
    except Exception as error:
        if "--debug" in sys.argv:
            raise
        Console(stderr=True).print(f"[bold red]error[/] {escape(_one_line(error))}", soft_wrap=True)
        usage = isinstance(error, _USAGE) and not isinstance(error, UserCodeError)
        raise SystemExit(2 if usage else 1) from None
    except SystemExit as stop:
        if stop.code in (_INTERRUPTED, _TERMINATED):  # the first is what Typer makes of Ctrl-C
            resumes = any(name in sys.argv[1:] for name in _RESUMING)
            more = "; the same command goes on where it was" if resumes else ""
            Console(stderr=True).print(f"\nstopped{more}")
        raise


def _terminate(*_: Any) -> None:
    """Lets SIGTERM end a command as Ctrl-C does: a training writes its checkpoint first."""
    raise SystemExit(_TERMINATED)


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    if isinstance(error, ValueError | OSError | ImportError):
        return text
    return f"{type(error).__name__}: {text}; `ae-env --debug` shows where"


@app.callback()
def _root(
    debug: Annotated[bool, typer.Option(help="Show the traceback of an error.")] = False,
) -> None:
    """Train and judge auto-exposure on simulated raws. Start with `ae-env quickstart`."""


@app.command()
def quickstart(
    scenes: Scenes = "bundled",
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("quickstart"),
    seed: Seed = 0,
    device: Device = "cpu",
) -> None:
    """Train two agents, compare them with light meters on unseen scenes: about 5 minutes.

    Example: `ae-env quickstart --scenes ~/my_raws --out my_raws_result`
    """
    from agents.cli.quickstart import next_commands, run_quickstart

    make_folder(out)
    device = torch_device(device)
    with progress_bars() as progress:
        done = run_quickstart(
            scenes, out, seed=seed, progress=progress, command=command_line(), device=device
        )
    if done.zero_shot:
        text = f"fewer than 15 source groups in {scenes}: agents trained on bundled scenes"
        console.print(text, soft_wrap=True, markup=False)
    print_scores(done.result)
    print_files(done.files)
    console.print("\nTry next:")
    for line in next_commands(scenes, out, done.agents):
        console.print(f"  {line}", soft_wrap=True, highlight=False, markup=False)


app.command()(simulate)
app.command()(sweep)
app.command()(train_simulator)
app.command()(scorers)
app.command()(convert_nima)


@app.command()
def train(
    config: Annotated[Path, typer.Argument(help="YAML such as configs/regression.yaml.")],
    out: Annotated[Path, typer.Option(help="File name of the agent, without suffix.")] = Path(
        "runs/agent"
    ),
    seed: OwnSeed = None,
    device: Device = "cpu",
    tensorboard: Annotated[Path | None, typer.Option(help="Folder for a TensorBoard log.")] = None,
) -> None:
    """Train an agent; a second run goes on where the first was stopped.

    Example: `ae-env train configs/ppo.yaml --out runs/ppo`
    """
    from agents.learning.agent_weights import sibling
    from agents.learning.training import load_config, train_agent

    device = torch_device(device)
    agent = load_config(config)
    file = sibling(out, ".json")
    make_folder(file.parent, file=file)
    if seed is not None:
        agent = agent.with_seed(seed)
    with progress_bars() as progress, progress(f"training {agent.agent}") as task:

        def report(done: int, total: int, values: dict[str, float]) -> None:
            task(done, total, ", ".join(f"{k} {v:.3f}" for k, v in values.items()))

        train_agent(agent, out, progress=report, device=device, tensorboard=tensorboard)
    files = (sibling(out, ".safetensors"), sibling(out, ".json"))
    print_files({"weights": files[0], "description": files[1]})
    command = shlex.join(["ae-env", "evaluate", "--policy", f"{agent.agent}:{out}"])
    console.print(f"next: {command}", highlight=False, soft_wrap=True, markup=False)


app.command()(evaluate)


@app.command()
def bench(
    name: Annotated[str, typer.Argument(help=", ".join(BENCHMARKS))],
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("docs/results"),
    seed: Seed = 0,
    quick: Annotated[bool, typer.Option(help="A short version, to try it out.")] = False,
) -> None:
    """Run one of the measurements whose results are in docs/results.

    Example: `ae-env bench throughput --quick --out /tmp/results`
    """
    check_word("name", name, BENCHMARKS)
    package = f"benchmarks.{name.replace('-', '_')}"
    sys.path.insert(0, str(Path.cwd()))
    try:
        module = importlib.import_module(package)
    except ModuleNotFoundError as error:
        if error.name not in ("benchmarks", package):
            raise
        raise ValueError(
            "the benchmarks are not part of the installed package: run this in a clone of the "
            "repository"
        ) from None
    make_folder(out)
    module.run(out, seed=seed, quick=quick)


@app.command()
def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all of it.")] = False,
) -> None:
    """Show what is kept between runs (scenes, score tables, what networks found), or clear it.

    Example: `ae-env cache --clear`; the folder is another one where AE_ENV_CACHE names it.
    """
    from rich.table import Table

    from simulator.utils.cache import DISK_BYTES, DiskCache

    disk = DiskCache()
    usage = disk.usage()
    if clear:
        disk.clear()
    table = Table(title="removed" if clear else f"kept, at most {DISK_BYTES >> 30} GiB")
    table.add_column("kind")
    table.add_column("files", justify="right")
    table.add_column("bytes", justify="right")
    for kind, (files, size) in usage.items():
        table.add_row(kind.replace("_", " "), f"{files:,}", f"{size:,}")
    console.print(table)
    console.print(f"folder: {disk.folder}", highlight=False, soft_wrap=True, markup=False)
