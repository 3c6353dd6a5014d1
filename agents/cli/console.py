"""Shared by the commands: the terminal, progress bars, common options and their checks.

Help must come at once: no module of a command imports anything heavy, see `main`.
"""

import collections
import functools
import inspect
import os
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console
from typer import Argument, BadParameter, Option

from simulator.utils.checks import parse_number
from simulator.utils.files import printable

terminal = Console(emoji=False)

# -- options of several commands ------------------------------------------------------------------


def each_once(names: list[str] | None) -> list[str] | None:
    """`names` of policies, of which none may be given twice."""
    if twice := [name for name, count in collections.Counter(names).items() if count > 1]:
        raise BadParameter(f"{twice[0]!r} is given twice")
    return names


_INT64_MAX = 2**63 - 1
Seed = Annotated[int, Option(help="Seed of everything random.", min=0, max=_INT64_MAX)]
OwnSeed = Annotated[int | None, Option(help="In place of the YAML's.", min=0, max=_INT64_MAX)]
OnError = Annotated[str, Option(help="At a file of --scenes that cannot be read: stop, or skip.")]
Trust = Annotated[bool, Option("--trust", help="Let the YAML file name Python code, and run it.")]
Device = Annotated[str, Option(help="Torch device: auto, cpu, cuda.")]
Policies = Annotated[list[str] | None, Option(help="Give once per policy.", callback=each_once)]
Raw = Annotated[Path, Argument(help="Any Bayer raw that LibRaw reads.")]
Folder = Annotated[Path, Option(help="Folder for the results.")]
OutDng = Annotated[Path, Option("--out", "-o", help="DNG to write.")]
Png = Annotated[Path | None, Option(help="Also write the developed picture here.")]
_SOURCE = {
    "source_iso": Annotated[
        float | None, Option(help="ISO speed of the raws, instead of what the files say.")
    ],
    "source_shutter": Annotated[str | None, Option(help="Their exposure time [s], likewise.")],
    "source_aperture": Annotated[str | None, Option(help="Their f-number, likewise.")],
}
#: Options of `takes_source` by the setting that each is.
SOURCE = {"iso": "source-iso", "exposure_time": "source-shutter", "f_number": "source-aperture"}
Weights = Annotated[
    str,
    Option(
        help="Largest network that may run: nano, compact, large; a file of weights; or none to "
        "only add noise."
    ),
]
Depth = Annotated[str, Option(help="far, or unknown: blur what is out of focus as f/ opens.")]
Cache = Annotated[bool, Option(help="Cache the outputs of the networks between runs.")]
Tolerance = Annotated[
    float,
    Option(
        help="Error that a capture may have, in units of the target's noise: the cheapest way "
        "within it is taken, or else the best; 0 for the best."
    ),
]
Noise = Annotated[
    str,
    Option(
        help="exact: drawn; bank: looked up in a bank of normals, faster; or sensor: drawn with "
        "the row noise and the tails of a calibrated camera's read noise."
    ),
]
#: `simulator.capture.limits.DEFAULT_TOLERANCE`, which a test compares: help imports no torch.
TOLERANCE = 0.1


# -- the terminal ---------------------------------------------------------------------------------


@contextmanager
def progress_bars() -> Iterator[Any]:
    """Progress bars with time left, in a log a line each; yields a function that opens one."""
    from rich import progress

    columns = (
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        progress.TextColumn("{task.percentage:>3.0f}%"),
        progress.TimeElapsedColumn(),
        progress.TimeRemainingColumn(),
        progress.TextColumn("[dim]{task.fields[note]}"),
    )
    shown = terminal.is_terminal
    with progress.Progress(*columns, console=terminal, disable=not shown) as display:

        @contextmanager
        def bar(title: str) -> Iterator[Any]:
            task = display.add_task(title, total=None, note="")
            if not shown:
                print_line(f"{title} ...")

            def move(done: float, total: float, note: str | Mapping[str, float] = "") -> None:
                if not isinstance(note, str):
                    note = ", ".join(f"{name} {value:.3f}" for name, value in note.items())
                display.update(task, completed=done, total=total, note=note)

            yield move

        yield bar


def print_line(text: str) -> None:
    """Prints a line as it is: names in it are no markup, and it is not wrapped."""
    terminal.print(printable(text), highlight=False, soft_wrap=True, markup=False)


def print_files(files: Mapping[str, Path]) -> None:
    """Prints the files that were written."""
    for name, path in files.items():
        print_line(f"wrote {name}: {path}")


def print_table(
    title: str, rows: Iterable[Sequence[str]], *columns: str, numbers: bool = False
) -> None:
    """Prints a table of texts; with `numbers` all columns but those of names are to the right."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, box=box.SIMPLE_HEAD)
    for column in columns:  # names in it are no markup, and those of policies not cut off
        side: Any = "right" if numbers and column not in ("policy", "kind") else "left"
        table.add_column(Text(column), justify=side, no_wrap=column == "name", overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    terminal.print(table)


def command_line() -> str:
    """The command line that the user typed, for result files."""
    return shlex.join(["ae-env", *sys.argv[1:]])


# -- checks of options ----------------------------------------------------------------------------


def trust_configuration(trust: bool) -> None:
    """With `trust`, the YAML files of this process, and of its workers, may name Python code."""
    from simulator.utils.config_file import TRUST_VARIABLE

    if trust:
        os.environ[TRUST_VARIABLE] = "all"


def takes_source(command: Callable[..., None]) -> Callable[..., None]:
    """Gives a command the options `SOURCE`; its argument `source` has those that were given."""

    @functools.wraps(command)
    def run(**given: Any) -> None:
        texts = {key: given.pop(option.replace("-", "_")) for key, option in SOURCE.items()}
        with all_mistakes() as check:
            found = [check(setting, key, text, SOURCE[key]) for key, text in texts.items()]
        command(**given, source=dict(collections.ChainMap(*found)))

    signature = inspect.signature(command, eval_str=True)
    own = [p for p in signature.parameters.values() if p.name != "source"]
    kind = inspect.Parameter.KEYWORD_ONLY
    own += [inspect.Parameter(k, kind, default=None, annotation=a) for k, a in _SOURCE.items()]
    run.__signature__ = signature.replace(parameters=own)  # type: ignore[attr-defined]
    return run


@contextmanager
def all_mistakes() -> Iterator[Callable[..., Any]]:
    """Yields a function that calls a check; the errors of all checks are raised together."""
    errors: list[Exception] = []

    def check(function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        try:
            return function(*arguments, **options)
        except (ValueError, OSError) as error:
            return errors.append(error)

    yield check
    if errors:
        raise errors[0] if len(errors) == 1 else ExceptionGroup("mistakes", errors)


def setting(key: str, text: float | str | None, option: str) -> dict[str, float]:
    """The camera setting `key` of an option, checked; none if it is not given."""
    if text is None:
        return {}
    from simulator.raw.read import check_settings

    with option_names(**{key: option}):
        check_settings(found := {key: parse_number(str(text), key)})
    return found


@contextmanager
def option_names(**options: str) -> Iterator[None]:
    """Errors within name the option that the user typed, by the argument that it became."""
    try:
        yield
    except ValueError as error:
        text = str(error)
        for argument, option in options.items():
            text = text.replace(f"`{argument}`", f"`{option}`")
        raise ValueError(text) from error


def scene_files(scenes: Any, on_error: str, source: Mapping[str, float]) -> Any:
    """The environment's `scenes` for `--scenes`, `--on-error` and the options of a `source`."""
    if on_error == "stop" and not source:
        return scenes
    options: dict[str, Any] = {SOURCE[setting]: value for setting, value in source.items()}
    options |= {} if on_error == "stop" else {"on-error": on_error}
    name, value = options.popitem()
    from ae_env.scenes.load import NAMED
    from ae_env.scenes.recorded import RecordedOptions

    rule = None
    if scenes is None:
        rule = "is about the files of --scenes: give that, too"
    elif scenes in NAMED:
        rule = f"is about the files of a folder: {scenes!r} has none"
    elif RecordedOptions.of(scenes) is not None and source:
        rule = "is for raws that are simulated from: recorded grids take 'recorded:FOLDER?iso=100'"
    elif RecordedOptions.of(scenes) is not None:
        rule = "must be 'stop' for recorded grids: take captures that cannot be read out of the "
        rule += "folder, and their states are forbidden"
    if rule is not None:
        raise ValueError(f"`{name}` (={value!r}) {rule}")
    found = {"path": scenes, "on_error": on_error}
    return {**found, "settings": source} if source else found


def make_folder(
    path: Path, *, name: str = "out", file: Path | None = None, make: bool = True
) -> None:
    """Makes a folder for results, or checks that it could be made, before any work is done.

    `name` is the option that names it, or `file` in it; raises if nothing can be written there.
    """
    given, rule = f"`{name}` (={str(file or path)!r})", None
    try:
        existing = next(p for p in (path, *path.parents) if p.exists())
        if not existing.is_dir():
            wanted = "be" if file is None else "lie in"
            rule = f"must {wanted} a folder, but {existing} is a file"
        elif file is not None and file.is_dir():
            rule = "must be a file, but it is a folder"
        if rule is not None:
            raise ValueError(f"{given} {rule}")
        with tempfile.TemporaryFile(dir=existing):
            pass
        if make:
            path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{given} cannot be written: {error.strerror}") from error


def check_outputs(*read: Path | None, **files: tuple[Path | None, str]) -> None:
    """Checks that files have their endings, are none that is read, and can be written.

    `read` are files that are read, the raw first; `files`, by the name of the option, have their
    endings. It makes nothing: whoever writes a file makes its folder, and an error leaves none.
    """
    for name, (path, suffix) in files.items():
        if path is None:
            continue
        rules = [] if path.suffix.lower() == suffix else [f"must end in {suffix}"]
        for i, own in enumerate(read):
            if own is not None and os.path.realpath(path) == os.path.realpath(own):
                rules.append(f"must not be {'a file that is read' if i else 'the raw itself'}")
        if rules:
            raise ValueError(f"`{name}` (={str(path)!r}) {rules[0]}")
        make_folder(path.parent, name=name, file=path, make=False)


def torch_device(name: str) -> str:
    """The torch device called `name`, checked."""
    import torch

    cuda = torch.cuda.is_available()
    if name == "auto":
        return "cuda" if cuda else "cpu"
    if name != "cpu" and not (cuda and name.partition(":")[0] == "cuda"):
        raise ValueError(f"`device` (={name!r}) must be auto, cpu{', cuda' if cuda else ''} here")
    return name
