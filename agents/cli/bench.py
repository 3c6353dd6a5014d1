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
    if against is not None and name != "throughput":
        raise ValueError(f"`against` (={str(against)!r}) is an option of throughput only")
    if against is not None and not (against / "simulator" / "__init__.py").is_file():
        raise ValueError(f"`against` (={str(against)!r}) must be a checkout of this project")
    if part is not None:
        if name != "transfer":
            raise ValueError(f"`part` (={part!r}) is an option of transfer only")
        check_word("part", part, ("agents", "tables"))
    if name == "paper" and folder is None:
        raise ValueError("`folder` (=None) must be given: ae-env bench paper FOLDER")
    if weights is not None and name not in ("paper", "features"):
        raise ValueError(f"`weights` (={str(weights)!r}) is an option of paper and features only")
    if folder is not None and name not in ("paper", "recorded"):
        raise ValueError(f"`folder` (={str(folder)!r}) is an argument of paper and recorded only")
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
    given: dict[str, Any] = {
        "against": against,
        "folder": folder,
        "weights": weights,
        "part": part,
    }
    options = {option: value for option, value in given.items() if value is not None}
    importlib.import_module(f"benchmarks.{stem}").run(out, seed=seed, quick=quick, **options)
