"""Convert the networks that the paper's authors released into weights of the preset ``ncs``.

    pip install safetensors
    python convert_ncs.py

Run it in the folder of the authors' code and in its environment (torch 1.13 or newer), on files
that you trust: a pickle is a program that may call anything. It reads ``exp_model``, ``unet_model``
and ``ap_model`` there, or what their training writes under other names, given in this order, and
writes ``ncs.safetensors`` and ``ncs.json``. Nothing of this package has to be installed there.
"""

import hashlib
import json
import sys
from pathlib import Path

import torch
from safetensors.torch import save

#: Planes R, G1, B, G2 of the authors' pictures in the order of ours, R, G1, G2, B.
PLANES = [0, 1, 3, 2]
#: Tensors by our name: along which dimension they have planes, and in which order these come.
PLANAR = {
    "exposure.b": (0, PLANES),
    "noise.network.encoder.0.0.weight": (1, [*PLANES, *(4 + p for p in PLANES)]),
    "noise.network.tail.weight": (0, PLANES),
    "noise.network.tail.bias": (0, PLANES),
    "aperture.network.encoder.0.first.convolution.weight": (1, [*PLANES, 4, 5]),
    "aperture.network.tail.weight": (0, PLANES),
    "aperture.network.tail.bias": (0, PLANES),
}


def convert(tensors):
    """Tensors by our names, planes in our order."""
    scalars = {"exposure.linear.weight": "exposure.w", "exposure.bias": "exposure.b"}
    ours, found = dict(layers()), {}
    for theirs, tensor in tensors.items():
        layer, _, entry = theirs.rpartition(".")
        name = scalars.get(theirs, f"{ours.get(layer, layer)}.{entry}")
        if name in PLANAR:
            dimension, order = PLANAR[name]
            tensor = tensor.index_select(dimension, torch.tensor(order))
        found[name] = tensor.reshape(()) if name == "exposure.w" else tensor
    return found


def layers():
    """The authors' and our names of the layers of both U-Nets."""
    noise, aperture = "noise.network", "aperture.network"
    for index in (0, 1, 3, 4):  # two convolutions, each with its normalisation
        yield f"noise.inc.conv.conv.{index}", f"{noise}.encoder.0.{index}"
        for level in range(4):
            down, up = f"down{level + 1}.mpconv.1.conv", f"up{level + 1}.conv.conv"
            yield f"noise.{down}.{index}", f"{noise}.encoder.{level + 1}.{index}"
            yield f"noise.{up}.{index}", f"{noise}.decoder.{level}.{index}"
    yield "noise.outc.conv", f"{noise}.tail"

    def normalised(theirs, ours):
        convolution, norm = (f"aperture.{theirs}".replace("*", kind) for kind in ("conv", "norm"))
        yield convolution, f"{aperture}.{ours}.convolution"
        yield f"{norm}.style.linear", f"{aperture}.{ours}.norm.affine"

    def level_of(theirs, ours):
        yield from normalised(f"{theirs}.*1", f"{ours}.first")
        yield from normalised(f"{theirs}.*2", f"{ours}.second")

    for index in range(5):
        yield from level_of(f"Conv{index + 1}", f"encoder.{index}")
    for index, level in enumerate((5, 4, 3, 2)):
        yield from normalised(f"Up{level}.*", f"upward.{index}")
        yield from level_of(f"Up_conv{level}", f"decoder.{index}")
        theirs, ours = f"Att{level}", f"attention.{index}"
        yield from normalised(f"{theirs}.W_g_*1", f"{ours}.from_gate")
        yield from normalised(f"{theirs}.W_x_*1", f"{ours}.from_skip")
        yield from normalised(f"{theirs}.psi_*", f"{ours}.to_map")
        yield from normalised(f"{theirs}.W_g_*2", f"{ours}.mean_gate")
        yield from normalised(f"{theirs}.W_x_*2", f"{ours}.mean_skip")
        yield f"aperture.{theirs}.conv_down", f"{aperture}.{ours}.excite.0"
        yield f"aperture.{theirs}.conv_up", f"{aperture}.{ours}.excite.2"
    yield "aperture.Conv", f"{aperture}.tail"


def main(exposure="exp_model", noise="unet_model", aperture="ap_model"):
    """Writes the two files into the current folder."""
    tensors = {}
    for stage, file in {"exposure": exposure, "noise": noise, "aperture": aperture}.items():
        module = torch.load(file, map_location="cpu", weights_only=False)["model"]
        for name, tensor in getattr(module, "module", module).state_dict().items():
            tensors[f"{stage}.{name}"] = tensor
    content = save({name: tensor.contiguous() for name, tensor in convert(tensors).items()})
    card = {"format": 2, "preset": "ncs", "sha256": hashlib.sha256(content).hexdigest()}
    Path("ncs.safetensors").write_bytes(content)
    Path("ncs.json").write_text(json.dumps(card))


if __name__ == "__main__":
    main(*sys.argv[1:])
