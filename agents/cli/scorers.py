"""``ae-env scorers`` and ``ae-env convert-nima``: all scorers, and the weights of one of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from agents.cli.console import console, make_folder, print_files, print_line


def scorers() -> None:
    """List all known scorers, those of installed packages included.

    Example: `ae-env scorers` lists them; docs/plug-in-a-scorer.md says how to add one.
    """
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from ae_env.scorers.registry import describe_scorers

    table = Table(title="scorers: all in [0, 1], higher is better", box=box.SIMPLE_HEAD)
    for title in ("name", "sees", "depends on"):
        table.add_column(title, no_wrap=True)
    table.add_column("what it is", overflow="fold")
    for row in describe_scorers():
        what = Text(f"broken: {row.error}", "red") if row.error else Text(row.summary)
        if row.needs:
            what.append(f" Needs {row.needs}.", "dim")
        if row.package != "ae-env":
            what.append(f" From {row.package}.", "dim")
        table.add_row(Text(row.name), row.domain, row.depends_on, what)
    console.print(table)
    print_line("and by name: my_file.py:MyScore, package.module:MyScore, pyiqa:METRIC")


def convert_nima(
    file: Annotated[Path, typer.Argument(help="The published Keras weights, .h5 or .hdf5.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="The .safetensors; by default in the cache folder."),
    ] = None,
) -> None:
    """Convert NIMA's published Keras weights for the scorers nima_aesthetic and nima_technical.

    Example: `ae-env convert-nima weights_mobilenet_aesthetic_0.07.hdf5`

    Needs h5py: `pip install 'ae-env[nima]'`.
    """
    from ae_env.scorers.nima import PUBLISHED, convert_nima, published_as
    from simulator.utils.cache import cache_dir
    from simulator.utils.files import as_path

    if not as_path(file).is_file():
        raise ValueError(f"`file` (={str(file)!r}) must be the file of Keras weights")
    kind = published_as(file.read_bytes())
    if out is None and kind is None:
        raise ValueError(
            f"`file` (={str(file)!r}) is not one of the published files (git blob ids "
            f"{', '.join(PUBLISHED.values())}): say what it becomes with --out, such as "
            "--out nima_aesthetic.safetensors"
        )
    target = cache_dir() / f"{kind}.safetensors" if out is None else out
    make_folder(target.parent, file=target)
    convert_nima(file, target)
    text = f"the published weights of {kind}" if kind else "not one of the published files"
    print_line(f"{file.name}: {text}")
    print_files({"weights": target})
    name = kind or "nima_aesthetic"
    if out is not None:
        print_line(f"next: export AE_ENV_{name.upper()}={target.resolve()}")
