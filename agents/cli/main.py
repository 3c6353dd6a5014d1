"""The command line: the commands together, and what becomes of their errors.

Help and usage errors come at once: modules of commands import nothing heavy (torch, numba, NumPy,
gymnasium and so `ae_env`); each command imports what it needs when it runs.
"""

import importlib
import logging
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from typer import Argument, Option
from typer.core import TyperArgument, TyperGroup, TyperOption

from agents.cli import console
from agents.cli.data import cache, latitude, record, scenes, score_tables, warm_up
from agents.cli.evaluate import evaluate, stability
from agents.cli.quickstart import quickstart
from agents.cli.show import cameras, film, judge, lightings, policies, scorers, view
from agents.cli.simulate import hdr, refocus, simulate, sweep
from agents.cli.train import export, train, train_simulator
from simulator import __version__
from simulator.utils.checks import NOTE, check_word, did_you_mean

#: Names of the benchmarks whose results are in docs/results.
BENCHMARKS = (
    *("agents", "bodies", "bracketing", "cluster", "colour_checker", "curves", "defects"),
    *("denoising", "emva", "features", "hdr", "onboard", "paper", "ptc", "places", "recorded"),
    *("refocus", "scorers", "simulator", "tasks", "throughput", "transfer", "work_precision"),
)
#: The checkout that this package runs from; the benchmarks are not installed with it.
CHECKOUT = Path(__file__).resolve().parents[2]


def bench(
    name: Annotated[str, Argument(help=", ".join(BENCHMARKS))],
    folder: Annotated[
        Path | None,
        Argument(
            help="Of paper, required: sequences of captures (docs/dataset.md). Of recorded, "
            "optional: recorded grids; by default those of the page. Of emva, optional: cameras."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        Option(
            help="Folder for the results; by default the checkout's docs/results, of a FOLDER "
            "of your own ./results."
        ),
    ] = None,
    seed: console.Seed = 0,
    quick: Annotated[bool, Option(help="A short version, to try it out.")] = False,
    weights: Annotated[
        Path | None, Option(help="Of paper: measure these weights, and train nothing.")
    ] = None,
    part: Annotated[str | None, Option(help="Of places and transfer: one part of it.")] = None,
) -> None:
    """Run one of the measurements whose results are in docs/results.

    Example: `ae-env bench throughput --quick --out /tmp/results`
    """
    name = name.replace("-", "_")
    check_word("name", name, BENCHMARKS)
    given = {"folder": folder, "weights": weights, "part": part}
    options: dict[str, Any] = {key: value for key, value in given.items() if value is not None}
    _check_options(name, **options)
    if not (CHECKOUT / "benchmarks" / "__init__.py").is_file():
        raise ValueError(
            f"the benchmarks are not part of the installed package (there are none in {CHECKOUT}): "
            "run this in a clone of the repository, installed with `pip install -e .`"
        )
    if out is None:  # results of a folder of one's own are not those of the docs
        out = CHECKOUT / "docs" / "results" if folder is None else Path("results")
    console.make_folder(out, make=False)  # a benchmark makes it for its results
    sys.path.insert(0, str(CHECKOUT))  # before the working folder, which may have its own
    stem = {"simulator": "fidelity"}.get(name, name)
    importlib.import_module(f"benchmarks.{stem}").run(out, seed=seed, quick=quick, **options)


#: Parts that can be run alone, and benchmarks that take an option.
_PARTS = {"places": ("posterior", "receptors", "curve"), "transfer": ("agents", "tables")}
_TAKES = {"folder": ("emva", "paper", "recorded"), "part": tuple(_PARTS), "weights": ("paper",)}


def _check_options(name: str, **options: Any) -> None:
    for option, value in options.items():
        if name not in _TAKES[option]:
            rule = f"is for {' and '.join(_TAKES[option])} only"
            raise ValueError(f"`{option}` (={str(value)!r}) {rule}")
    if "part" in options:
        check_word("part", options["part"], _PARTS[name])
    if name == "paper" and "folder" not in options:
        raise ValueError("`folder` (=None) must be given: ae-env bench paper FOLDER")


class _Commands(TyperGroup):
    """The commands; errors of options say the value, and all of them are shown at once."""

    def get_params(self, ctx: Any) -> list[Any]:
        params: list[Any] = super().get_params(ctx)
        for flag in (param for param in params if param.is_flag):  # whose None loads pydantic
            flag.default = flag.default or False
        return params

    def format_help(self, ctx: Any, formatter: object) -> None:
        """Shows the help; the imports of Typer's own take as long as all of the rest."""
        from rich.panel import Panel
        from rich.table import Table

        rows = [("Options", ", ".join(param.opts), param.help) for param in self.get_params(ctx)]
        for name, command in dict[str, Any](self.commands).items():
            rows.append((command.rich_help_panel, name, command.get_short_help_str(200)))
        width, panels = max(len(name) for _, name, _ in rows), dict[str, Table]()
        for title, name, about in rows:
            table = panels.setdefault(title, Table.grid(padding=(0, 2)))
            table.add_row(f"[bold cyan]{name.ljust(width)}", escape(about))
        show = console.terminal.print
        show(f"[bold]{escape(self.get_usage(ctx))}\n\n[/]{self.help}\n", highlight=False)
        for title, table in panels.items():
            show(Panel(table, title=title, title_align="left", border_style="dim"))
        show(self.epilog)

    def invoke(self, ctx: Any) -> Any:
        words = [*ctx._protected_args, *ctx.args]
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            command: Any = self.resolve_command(ctx, words)[1]
            error.message = "\n".join(_messages(error, command, words[1:], ctx))
            raise


def _messages(error: typer.BadParameter, command: Any, words: list[str], ctx: Any) -> Iterator[str]:
    """Messages of an error of an option and, without that option, of the next ones."""
    cause: Any = error.__cause__  # pydantic's, of a Typer that names no value itself
    given = f"{cause.errors()[0]['input']!r}: " if hasattr(cause, "errors") else ""
    yield given + error.message
    names = getattr(error.param, "opts", ())
    at = next((i for i, word in enumerate(words) if word.partition("=")[0] in names), len(words))
    rest = words[:at] + words[at + 1 + ("=" not in "".join(words[at : at + 1])) :]
    if rest != words:
        try:
            command.make_context(None, list(rest), parent=ctx)
        except typer.BadParameter as other:
            other.message = "\n".join(_messages(other, command, rest, ctx))
            yield other.format_message()


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    epilog="Missing folders of outputs are made. Exit status: 2 for a mistake in an option or a "
    "file, 1 for a failure while running.",
)
#: Commands by the heading of the help that they stand under.
_HEADINGS: dict[str, tuple[Callable[..., None], ...]] = {
    "Start": (quickstart, view),
    "Policies": (evaluate, stability, train, policies, scorers, film, judge, record, export),
    "Raw files": (simulate, sweep, refocus, hdr, latitude),
    "Scenes": (cameras, lightings, score_tables),
    "Maintenance": (cache, warm_up, train_simulator),
}
for heading, commands in _HEADINGS.items():
    for command in commands:
        app.command(rich_help_panel=heading)(command)
app.add_typer(scenes, name="scenes", rich_help_panel="Scenes")
app.command(no_args_is_help=True, rich_help_panel="Maintenance")(bench)

#: Commands that go on where they were stopped.
_RESUMING = {"quickstart", "evaluate", "bench", "scenes", "score-tables"}
_RESUMING |= {"train", "train-simulator", "judge"}
#: Errors about the user's options and files.
_USAGE = (ValueError, FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError)
#: Exit status after Ctrl-C, and after SIGTERM.
_INTERRUPTED, _TERMINATED = 130, 143


def main() -> None:
    """Runs the command line.

    An error becomes one line, and exit status 2 where it is about what the user gave (options,
    files), 1 where something failed while running; Ctrl-C gives 130, SIGTERM 143.
    """
    if "_AE_ENV_COMPLETE" in os.environ:  # completion needs no values, whose check loads pydantic
        for kind in (TyperArgument, TyperOption):
            kind.process_value = lambda self, ctx, value: value  # type: ignore[method-assign]
    handler, seen = _Log(), dict[str, object]()  # scenes that are loaded again say the same
    handler.addFilter(lambda record: seen.setdefault(record.getMessage(), record) is record)
    logging.addLevelName(NOTE, "NOTE")
    logging.basicConfig(level=NOTE, format="%(message)s", handlers=[handler])
    # As Ctrl-C ends a command: a training writes its checkpoint first.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(_TERMINATED))
    try:
        app(prog_name="ae-env")
    except Exception as error:  # whatever it is, the user gets one line; --debug shows the rest
        if "--debug" in sys.argv:
            raise
        from ae_env.utils.user_files import UserCodeError

        errors = error.exceptions if isinstance(error, ExceptionGroup) else (error,)
        for one in errors:
            text = escape(_as_typed(_one_line(one)))
            Console(stderr=True, emoji=False).print(f"[bold red]error[/] {text}", soft_wrap=True)
        usage = all(isinstance(e, _USAGE) and not isinstance(e, UserCodeError) for e in errors)
        raise SystemExit(2 if usage else 1) from None
    except SystemExit as stop:
        if stop.code in (_INTERRUPTED, _TERMINATED):  # the first is what Typer makes of Ctrl-C
            resumes = not _RESUMING.isdisjoint(sys.argv[1:])
            more = "; run the same command again to continue" if resumes else ""
            Console(stderr=True).print(f"\nstopped{more}")
            # What is kept is written: a second Ctrl-C need not wait for the workers' end.
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, lambda *_, status=stop.code: os._exit(status))
        raise


class _Log(logging.Handler):
    """Rich's log, which is loaded with its first line: help has none."""

    def emit(self, record: logging.LogRecord) -> None:
        from rich.logging import RichHandler

        plain = Console(stderr=True, emoji=False)
        RichHandler(console=plain, show_time=False, show_path=False).emit(record)


def _one_line(error: Exception) -> str:
    own = isinstance(error, OSError) and error.filename is None and error.strerror
    text = " ".join(str(own or error).split())  # errors of ours name the file themselves
    if isinstance(error, ValueError | OSError | ImportError):
        return text
    return f"{type(error).__name__}: {text}; `ae-env --debug` shows where"


#: Rules of errors about a file or folder that is not there.
_MISSING = ("must name an existing file", "does not exist", "there is no such file")


def _as_typed(text: str) -> str:
    """An error with its option or file as it was typed, and what may have been meant first."""
    form = r"`([\w-]+)` \(=(.*?)\):? (.*?)(?:; did you mean ('[^']*'\?)(.*))?"
    found = re.fullmatch(form, text)
    if found is None:
        return text
    name, value, rule, meant, more = found.groups()
    if meant is not None and rule.startswith("must be "):
        name = "scene" if name == "what" else name
        return f"Unknown {name} {value}. Did you mean {meant} It {rule}{more}"
    plain, words = value.strip("'"), [word.partition("=")[0] for word in sys.argv]
    option = next((f"`{o}` " for o in (f"--{name}", f"-{name[0]}") if o in words), "")
    if rule.startswith(_MISSING):
        folder = Path(plain).absolute().parent
        near = did_you_mean(Path(plain).name, (path.name for path in folder.glob("*")))
        near = near or f" in {folder}: check the name, or give the whole path"
        return f"{option}{plain}: no such file or folder{near}"
    if not option and (name == "path" or plain in words):
        return plain + text[found.end(2) + 1 :]
    return text.replace(f"`{name}` ", option, 1) if option else text


def _version(asked: bool) -> None:
    if asked:
        console.print_line(f"ae-env {__version__}")
        raise typer.Exit


@app.callback(
    help="Train and judge auto-exposure on simulated raws. Start with `ae-env quickstart`."
)
def _options(
    debug: Annotated[bool, Option(help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, Option("--version", help="Show the version.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """`main` looks for `debug` itself: it must know before the arguments are parsed."""
