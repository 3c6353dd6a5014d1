"""``ae-env bench``: the measurements whose results are in docs/results."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from agents.cli.console import Seed, make_folder

BENCHMARKS = (
    *("ablation", "agents", "bracketing", "brackets", "cluster", "colour_checker", "convergence"),
    *("defects", "denoising", "features", "hdr", "libcamera", "onboard", "paper", "ptc"),
    *("recorded", "refocus", "scorers", "simulator", "stability", "throughput", "transfer"),
    *("viewer", "work_precision"),
)
#: The checkout that this package runs from; the benchmarks are not installed with it.
CHECKOUT = Path(__file__).resolve().parents[2]


def bench(
    name: Annotated[str, typer.Argument(help=", ".join(BENCHMARKS))],
    folder: Annotated[
        Path | None,
        typer.Argument(
            help="Of paper, required: sequences of captures (docs/dataset.md). Of recorded, "
            "optional: recorded grids; by default those of the page."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the results; by default the checkout's docs/results, of a FOLDER "
            "of your own ./results."
        ),
    ] = None,
    seed: Seed = 0,
    quick: Annotated[bool, typer.Option(help="A short version, to try it out.")] = False,
    against: Annotated[
        Path | None, typer.Option(help="Of throughput: another checkout, timed in turns with this.")
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(
            help="Of paper: measure these weights, and train nothing; of features: ALIKED's "
            "(aliked-n16.pth), judged beside."
        ),
    ] = None,
    part: Annotated[
        str | None, typer.Option(help="Of transfer: agents or tables; by default both.")
    ] = None,
) -> None:
    """Run one of the measurements whose results are in docs/results.

    Example: `ae-env bench throughput --quick --out /tmp/results`
    """
    from simulator.utils.checks import check_word

    name = name.replace("-", "_")
    check_word("name", name, BENCHMARKS)
    given = {"against": against, "folder": folder, "weights": weights, "part": part}
    options: dict[str, Any] = {key: value for key, value in given.items() if value is not None}
    _check_options(name, **options)
    if not (CHECKOUT / "benchmarks" / "__init__.py").is_file():
        raise ValueError(
            f"the benchmarks are not part of the installed package (there are none in {CHECKOUT}): "
            "run this in a clone of the repository, installed with `pip install -e .`"
        )
    if out is None:  # results of a folder of one's own are not those of the docs
        out = CHECKOUT / "docs" / "results" if folder is None else Path("results")
    make_folder(out, make=False)  # a benchmark makes it for its results
    sys.path.insert(0, str(CHECKOUT))  # before the working folder, which may have its own
    stem = {"simulator": "fidelity"}.get(name, name)
    importlib.import_module(f"benchmarks.{stem}").run(out, seed=seed, quick=quick, **options)


#: Benchmarks that take an option.
_TAKES = {
    "against": ("throughput",),
    "folder": ("paper", "recorded"),
    "part": ("transfer",),
    "weights": ("paper", "features"),
}


def _check_options(name: str, **options: Any) -> None:
    """Raises a `ValueError` if a benchmark takes no such option, or not its value."""
    from simulator.utils.checks import check_word

    for option, value in options.items():
        if name not in _TAKES[option]:
            rule = f"is for {' and '.join(_TAKES[option])} only"
            raise ValueError(f"`{option}` (={str(value)!r}) {rule}")
    against = options.get("against")
    if against is not None and not (against / "simulator" / "__init__.py").is_file():
        raise ValueError(f"`against` (={str(against)!r}) must be a checkout of this project")
    if "part" in options:
        check_word("part", options["part"], ("agents", "tables"))
    if name == "paper" and "folder" not in options:
        raise ValueError("`folder` (=None) must be given: ae-env bench paper FOLDER")
