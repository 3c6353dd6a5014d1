"""The weights that the paper's authors released, as those of our preset `ncs`.

Their files, of the layout of github.com/ken-ouyang/neural_image_simulator: one for each module
(``exp_model``, ``unet_model`` and ``ap_model`` of the demo; a training writes ``exp_N``, ``unet_N``
and ``unet_att_N``), a dictionary whose entry ``model`` is the whole module. Which file is which is
told by the names of the tensors in it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from simulator.networks.torch_files import is_torch_file, read_state
from simulator.networks.weights import build_modules

#: Python modules of the authors' code, whose classes stand in their files.
PACKAGES = (
    "__main__",
    "exposure_module",
    "unet_model",
    "unet_model_ori",
    "unet_parts",
    "unet_parts_ori",
    "unet_attention_decouple",
)
#: Our modules, and what the demo calls their files.
FILES = {"exposure": "exp_model", "noise": "unet_model", "aperture": "ap_model"}
#: Names of the files of the demo and of a training: these are never passed over.
_NAMED = re.compile(r"(exp|unet|unet_att|ap)_(model|\d+)(\.pth?)?")
#: Planes R, G1, B, G2 of the authors' pictures in the order of ours, R, G1, G2, B.
_PLANES = [0, 1, 3, 2]
#: Tensors by our name: along which dimension they have planes, and in which order these come.
_PLANAR = {
    "exposure.b": (0, _PLANES),
    "noise.network.encoder.0.0.weight": (1, [*_PLANES, *(4 + p for p in _PLANES)]),
    "noise.network.tail.weight": (0, _PLANES),
    "noise.network.tail.bias": (0, _PLANES),
    "aperture.network.encoder.0.first.convolution.weight": (1, [*_PLANES, 4, 5]),
    "aperture.network.tail.weight": (0, _PLANES),
    "aperture.network.tail.bias": (0, _PLANES),
}
#: What the released code does otherwise than the paper says, for the model card.
DIFFERENCES = (
    "U-Net of 13.4 M parameters with batch normalisation, where Brooks et al. 2019 have none",
    "the noise module is shown a sample of the noise in place of its level; here it is the same "
    "sample whenever it is asked for",
    "apertures enter as amounts of light relative to f/22, not as f-numbers",
    "no clip of the aperture's residual: a picture without detail may change",
    "attention U-Net of 8.85 M parameters, zero borders, nearest-neighbour upsampling",
)


def read_authors_weights(folder: Path) -> tuple[nn.ModuleDict, dict[str, Any]]:
    """Modules of preset `ncs` with the weights in `folder`, and what their card says of the files.

    Args:
        folder: Holds one file for each of the exposure, the noise and the aperture module. Files
            that neither are torch's nor are named as those of the authors are passed over.

    Raises:
        ValueError: If a file is missing, there twice, damaged or harmful, or its tensors are not
            those of the released networks. Nothing of a file is executed.
    """
    if not folder.is_dir():
        fault = "is a file" if folder.exists() else "does not exist"
        raise ValueError(
            f"`folder` (={str(folder)!r}) must be a folder of the authors' files, but {fault}"
        )
    names = author_names()
    files: dict[str, Path] = {}
    tensors: dict[str, Tensor] = {}
    for path in sorted(p for p in folder.iterdir() if p.is_file()):
        if not (_NAMED.fullmatch(path.name) or is_torch_file(path)):
            continue
        state = read_state(path, packages=PACKAGES)
        kind = _kind(path, state, names)
        if kind in files:
            raise ValueError(
                f"`folder` (={str(folder)!r}) must hold one file of the {kind} module, "
                f"not both {files[kind].name} and {path.name}"
            )
        files[kind] = path
        tensors |= _ours(path, kind, state, names[kind])
    missing = [kind for kind in FILES if kind not in files]
    if missing:
        found = ", ".join(f"{path.name} ({kind})" for kind, path in files.items()) or "none"
        wanted = ", ".join(f"{FILES[kind]} ({kind})" for kind in missing)
        raise ValueError(
            f"`folder` (={str(folder)!r}) must also hold {wanted}; files of torch found: {found}"
        )
    modules = build_modules("ncs")
    modules.load_state_dict(tensors)
    return modules.eval().requires_grad_(False), _card(files)


def _card(files: dict[str, Path]) -> dict[str, Any]:
    return {
        "source": {
            kind: {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
            for kind, path in files.items()
        },
        "origin": "released by the authors of Neural Camera Simulators (CVPR 2021), converted",
        "licence": "none stated by the authors: ask them before you pass these weights on",
        "differences_from_the_paper": list(DIFFERENCES),
    }


def author_names() -> dict[str, dict[str, str]]:
    """Names in the authors' files by module, each with our name of the same tensor."""
    ours = build_modules("ncs").state_dict()
    names: dict[str, dict[str, str]] = {kind: {} for kind in FILES}
    names["exposure"] = {"linear.weight": "exposure.w", "bias": "exposure.b"}
    for kind, prefixes in (("noise", _unet_prefixes()), ("aperture", _attention_prefixes())):
        known = dict(prefixes)
        for name in (n for n in ours if n.startswith(f"{kind}.network.")):
            layer, _, entry = name.removeprefix(f"{kind}.network.").rpartition(".")
            names[kind][f"{known[layer]}.{entry}"] = name
    return names


def _unet_prefixes() -> Iterator[tuple[str, str]]:
    """Our and the authors' names of the layers of the noise module's network."""
    for index in (0, 1, 3, 4):  # two convolutions, each with its normalisation
        yield f"encoder.0.{index}", f"inc.conv.conv.{index}"
        for level in range(4):
            yield f"encoder.{level + 1}.{index}", f"down{level + 1}.mpconv.1.conv.{index}"
            yield f"decoder.{level}.{index}", f"up{level + 1}.conv.conv.{index}"
    yield "tail", "outc.conv"


def _attention_prefixes() -> Iterator[tuple[str, str]]:
    """Our and the authors' names of the layers of the aperture module's network."""

    def styled(ours: str, convolution: str, norm: str) -> Iterator[tuple[str, str]]:
        yield f"{ours}.convolution", convolution
        yield f"{ours}.style", f"{norm}.style.linear"

    def level(ours: str, theirs: str) -> Iterator[tuple[str, str]]:
        for number, half in enumerate(("first", "second"), start=1):
            yield from styled(f"{ours}.{half}", f"{theirs}.conv{number}", f"{theirs}.norm{number}")

    for index in range(5):
        yield from level(f"encoder.{index}", f"Conv{index + 1}")
    for index, number in enumerate((5, 4, 3, 2)):
        yield from styled(f"upward.{index}", f"Up{number}.conv", f"Up{number}.norm")
        yield from level(f"decoder.{index}", f"Up_conv{number}")
        ours, theirs = f"attention.{index}", f"Att{number}"
        for own, branch in (
            ("map_gate", "W_g_{}1"),
            ("map_skip", "W_x_{}1"),
            ("to_map", "psi_{}"),
            ("mean_gate", "W_g_{}2"),
            ("mean_skip", "W_x_{}2"),
        ):
            layers = (f"{theirs}.{branch.format(part)}" for part in ("conv", "norm"))
            yield from styled(f"{ours}.{own}", *layers)
        yield f"{ours}.squeeze", f"{theirs}.conv_down"
        yield f"{ours}.excite", f"{theirs}.conv_up"
    yield "tail", "Conv"


def _kind(path: Path, state: dict[str, Tensor], names: dict[str, dict[str, str]]) -> str:
    """The module that most names of a file are of."""
    shared = {kind: len(own.keys() & state.keys()) for kind, own in names.items()}
    kind = max(shared, key=lambda k: shared[k])
    if not shared[kind]:
        raise ValueError(f"`{path}`: none of its names is known: {_few(state)}")
    return kind


def _ours(
    path: Path, kind: str, state: dict[str, Tensor], names: dict[str, str]
) -> dict[str, Tensor]:
    """The tensors of a file by our names, planes in our order."""
    surplus = [name for name in state if name not in names]
    # Before torch 0.4.1 batch normalisation did not count its batches.
    missing = [n for n in names if n not in state and not n.endswith("num_batches_tracked")]
    for what, found in (("unknown names", surplus), ("names that are missing", missing)):
        if found:
            raise ValueError(f"`{path}`: {what} for the {kind} module: {_few(found)}")
    bad = [name for name, tensor in state.items() if not bool(torch.isfinite(tensor).all())]
    if bad:
        raise ValueError(f"`{path}`: every number must be finite, not so in {_few(bad)}")
    expected = build_modules("ncs").state_dict()
    tensors = {}
    for theirs, ours in names.items():
        wanted = expected[ours]
        tensor = state.get(theirs, torch.zeros_like(wanted))
        if ours == "exposure.w" and tensor.shape == (1, 1):
            tensor = tensor.reshape(())
        if wanted.is_floating_point() and not tensor.is_floating_point():
            raise ValueError(f"`{path}`: {theirs} (of {tensor.dtype}) must be floating point")
        if tensor.shape != wanted.shape:
            shapes = tuple(tensor.shape), tuple(wanted.shape)
            raise ValueError(f"`{path}`: {theirs} (of shape {shapes[0]}) must be of {shapes[1]}")
        if ours in _PLANAR:
            dimension, order = _PLANAR[ours]
            tensor = tensor.index_select(dimension, torch.tensor(order))
        tensors[ours] = tensor.to(wanted.dtype)
    return tensors


def _few(names: Any) -> str:
    """The first names of many."""
    first = list(names)[:4]
    more = len(names) - len(first)
    return ", ".join(map(repr, first)) + (f" and {more} more" if more else "")
