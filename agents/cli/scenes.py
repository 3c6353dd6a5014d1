"""``ae-env scenes``: sets of real scenes."""

from __future__ import annotations

from typing import Annotated

import typer

from agents.cli.console import console, print_line, progress_bars

scenes = typer.Typer(no_args_is_help=True)


@scenes.callback()
def _scenes() -> None:
    """Sets of real scenes.

    Example: `ae-env scenes download`
    """


@scenes.command()
def download(
    url: Annotated[
        str | None, typer.Option(help="Another server's folder that holds NAME_1k.hdr.")
    ] = None,
) -> None:
    """Fetch Poly Haven's panoramas (CC0) for `--scenes polyhaven`; a second run resumes the first.

    They go to the cache folder (`ae-env cache` names it). Those that AE_ENV_DATA holds are not
    fetched. A proxy is taken from the environment.

    Example: `ae-env scenes download`
    """
    from ae_env.scenes.polyhaven import URL, download, list_assets

    with progress_bars() as progress, progress("maps") as task:
        fetched = download(url=url or URL, progress=task)
    console.print(f"{len(fetched)} of {len(list_assets())} maps were fetched, all are there")
    print_line("try next: ae-env quickstart --scenes polyhaven --out real_scenes")
