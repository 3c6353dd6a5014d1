"""The camera simulator against the reference camera: error and time of every module.

    ae-env bench simulator

Needs trained weights: ``compact`` comes with the package; ``paper`` and the baselines ``pc`` and
``dl`` are trained by their configurations, once, where ``runs/simulator`` does not hold them. The
real files that ``AE_ENV_DATA`` names are used where they are.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from agents.cli.console import console, print_files
from benchmarks.simulator import (
    brackets,
    defocus,
    denoising,
    exposure,
    noise,
    pairs,
    pictures,
)
from benchmarks.simulator.models import Models
from benchmarks.simulator.parts import measure_parts
from benchmarks.simulator.scenes import data_root
from simulator.utils.files import write_atomically
from simulator.utils.results import result_meta, write_results

#: In the order of the report: module and heading.
PARTS = {
    "pairs": (pairs, "The paper's table"),
    "denoising": (denoising, "Denoising: ISO 6400 to ISO 100"),
    "noise": (noise, "Noise of the full output"),
    "defocus": (defocus, "Defocus: f/11 to f/4"),
    "exposure": (exposure, "Exposure module"),
    "brackets": (brackets, "Real exposures"),
    "pictures": (pictures, "Pictures"),
}
#: What the numbers depend on.
MEASURED = ("simulator", "ae_env/scenes", "benchmarks/simulator")


def run(out: Path, *, seed: int = 0, quick: bool = False) -> None:
    """Measures and writes ``simulator.json`` and ``simulator.md`` under `out`.

    Args:
        out: Folder of results.
        seed: Of pairs, settings, noise and crops.
        quick: A few small images, and only models that are there already.
    """
    modules = {name: module for name, (module, _) in PARTS.items()}
    # One thread: what it is compared with runs on one.
    models, rows = measure_parts(
        "simulator", modules, seed=seed, quick=quick, threads=1, code=MEASURED
    )
    meta = result_meta(f"ae-env bench simulator{' --quick' * quick}", seed)
    meta |= {"models": models.cards, "real_files": data_root() is not None}
    files = {
        "numbers": write_results(out / "simulator.json", rows, meta),
        "report": write_atomically(out / "simulator.md", _markdown(models, rows, meta)),
    }
    print_files(files)
    console.print("the pictures are meant to be looked at", highlight=False)


def _markdown(models: Models, rows: list[dict[str, Any]], meta: dict[str, Any]) -> str:
    machine = meta["machine"]
    lines = [
        "# The camera simulator, measured",
        "",
        f"`{meta['command']}`, {meta['date'][:10]}, seed {meta['seed']}, {machine['cpu']}, one "
        "thread, float32. Ground truth is the reference camera (`simulator/reference/reference_camera.py`); every "
        "scene is from the test split, whose source groups no training saw. Error and time stand "
        "side by side: a millisecond is that of one 4 x 128 x 128 raw unless stated otherwise.",
        "",
        *_model_table(models),
    ]
    if not meta["real_files"]:
        lines += ["", "Without the real files (`AE_ENV_DATA`): what needs them is left out."]
    for name, (part, heading) in PARTS.items():
        own = [row for row in rows if row["part"] == name]
        lines += ["", f"## {heading}", "", part.section(own).strip()]
    return "\n".join(lines) + "\n"


def _model_table(models: Models) -> list[str]:
    lines = [
        "| model | parameters | stage: steps in CPU time | weights (SHA-256) |",
        "|---|--:|---|---|",
    ]
    for name, card in models.cards.items():
        stages = "; ".join(
            f"{stage}: {value['steps']:,} in {value['seconds'] / 60:.1f} min"
            for stage, value in card.get("stages", {}).items()
        )
        lines.append(
            f"| `{name}` | {card['parameters']:,} | {stages or 'unknown'} | "
            f"`{card['sha256'][:12]}` |"
        )
    return lines
