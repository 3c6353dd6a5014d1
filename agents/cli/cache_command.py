"""``ae-env cache``: the folder of results that are cached between runs."""

from __future__ import annotations

from typing import Annotated

import typer

from agents.cli.console import console


def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all of it.")] = False,
) -> None:
    """Show what is cached between runs (scenes, networks' outputs), or clear it.

    Example: `ae-env cache --clear`; the folder is another one where AE_ENV_CACHE names it.
    """
    from rich.table import Table

    from simulator.utils.cache import DISK_BYTES, disk_cache

    disk = disk_cache()
    usage = disk.usage()
    if clear:
        disk.clear()
    table = Table(title="removed" if clear else f"cached, at most {DISK_BYTES >> 30} GiB")
    table.add_column("kind")
    table.add_column("files", justify="right")
    table.add_column("bytes", justify="right")
    for kind, (files, size) in usage.items():
        table.add_row(kind.replace("_", " "), f"{files:,}", f"{size:,}")
    console.print(table)
    console.print(f"folder: {disk.folder}", highlight=False, soft_wrap=True, markup=False)
