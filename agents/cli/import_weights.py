"""``ae-env import-weights``: weights that others released, as ours."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from agents.cli.console import command_line, make_folder, print_files, print_line

#: Whose weights can be read.
KINDS = ("ncs",)


def import_weights(
    kind: Annotated[str, typer.Argument(help="ncs: of the authors of Neural Camera Simulators.")],
    folder: Annotated[
        Path, typer.Argument(help="Their files: exp_model, unet_model and ap_model.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The .safetensors to write.")] = Path(
        "ncs.safetensors"
    ),
) -> None:
    """Convert released weights to safetensors; nothing in their pickles is executed.

    Example: `ae-env import-weights ncs exp/demo -o ncs.safetensors`
    """
    from simulator.networks.authors_weights import read_authors_weights

    from simulator.networks.weights import save_modules
    from simulator.utils.checks import check_word

    check_word("kind", kind, KINDS)
    if out.suffix != ".safetensors":
        raise ValueError(f"`out` (={str(out)!r}) must end in .safetensors")
    modules, card = read_authors_weights(folder)
    make_folder(out.parent, file=out)
    save_modules(out, modules, "ncs", {**card, "command": command_line()})
    for stage, source in card["source"].items():
        count = sum(p.numel() for p in modules[stage].parameters())
        print_line(f"{stage}: {count:,} parameters of {source['file']}")
    print_line(f"licence: {card['licence']}")
    print_files({"weights": out, "model card": out.with_suffix(".json")})
    weights = shlex.quote(str(out))
    print_line(f"next: ae-env simulate RAW --weights {weights} ...")
    print_line(f"or, on the authors' data: ae-env bench paper FOLDER --weights {weights}")
