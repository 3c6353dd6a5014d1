"""``ae-env view``: a scene at any settings, in the browser."""

from __future__ import annotations

from typing import Annotated

import typer

from agents.cli.console import Device, console, print_line, progress_bars, torch_device
from agents.cli.simulate import Cache, Depth, Tolerance, Weights, check_depth, make_simulator
from simulator.capture.plan import DEFAULT_TOLERANCE, check_tolerance

#: What is shown where nothing is named; `ae-env warm-up` draws it.
DEFAULT_SCENES = "bundled:small"


def view(
    what: Annotated[
        str,
        typer.Argument(
            metavar="[RAW|FOLDER|SCENE]",
            help="A raw or radiance map, a folder of them, scenes such as bundled or polyhaven, or "
            "the id of a bundled scene.",
        ),
    ] = DEFAULT_SCENES,
    port: Annotated[int, typer.Option(help="Port to serve at; 0 for any.", min=0, max=65535)] = 0,
    open_browser: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in the default browser.")
    ] = True,
    scorer: Annotated[str, typer.Option(help="Scorer, as for `evaluate`.")] = "balanced",
    weights: Weights = "compact",
    depth: Depth = "far",
    tolerance: Tolerance = DEFAULT_TOLERANCE,
    device: Device = "auto",
    cache: Cache = True,
) -> None:
    """Look at a scene in the browser: any settings, all scores, episodes of two policies.

    The page is served to this machine alone, until Ctrl-C. Needs the extra `view`.

    Example: `ae-env view IMG_0001.CRW`
    """
    try:
        from agents.viewer.server import free_port, serve
    except ModuleNotFoundError as error:
        if error.name not in ("nicegui", "fastapi"):
            raise
        raise ImportError(
            "`ae-env view` needs the extra view: pip install 'ae-env[view]'"
        ) from None
    from ae_env.scorers import make_scorer
    from agents.viewer.library import find_scenes
    from agents.viewer.page import Options

    check_depth(depth, weights)
    check_tolerance(tolerance)
    make_scorer(scorer)
    port = free_port(port)
    simulator = make_simulator(weights, torch_device(device), cache)
    with progress_bars() as progress, progress("scenes") as task:
        library = find_scenes(what)
        task(1, 1)
    options = Options(library, simulator, depth, tolerance, scorer)  # type: ignore[arg-type]
    serve(options, port, open_browser, _tell)


def _tell(address: str) -> None:
    print_line(f"open {address}")
    print_line("Ctrl-C stops")
    console.file.flush()
