"""Convert NIMA's published Keras weights for the scorers nima_aesthetic and nima_technical.

    pip install h5py
    python examples/convert_nima.py weights_mobilenet_aesthetic_0.07.hdf5

Writes ``nima_aesthetic.safetensors`` or ``nima_technical.safetensors`` into the cache folder, where
the scorer looks for it. For weights of your own, of the same network, name the file to write as a
second argument, and set ``AE_ENV_NIMA_AESTHETIC`` or ``AE_ENV_NIMA_TECHNICAL`` to it.
"""

import hashlib
import sys
from pathlib import Path

import h5py
import torch
from safetensors.torch import save_file

from ae_env.scorers.learnt import PUBLISHED, NimaMobileNet, read_network
from simulator.utils.cache import cache_dir

#: The layers of Keras' MobileNet in the order of `NimaMobileNet.features`.
LAYERS = ["conv1", *(f"conv_{kind}_{i}" for i in range(1, 14) for kind in ("dw", "pw"))]
NORMALISATION = {
    "gamma": "weight",
    "beta": "bias",
    "moving_mean": "running_mean",
    "moving_variance": "running_var",
}
ARRAYS = (*NORMALISATION, "kernel", "depthwise_kernel", "bias")  # others are states of layers


def torch_name(layer: str, array: str) -> tuple[str, tuple[int, ...]]:
    """Name in torch of a layer's array in Keras, and how its axes are put in torch's order.

    Keras stores a convolution as (height, width, inputs, outputs), a depthwise one as (height,
    width, channels, 1) and a dense layer as (inputs, outputs); torch has outputs first.
    """
    if array in NORMALISATION and layer.endswith("_bn"):
        return f"features.{LAYERS.index(layer[:-3])}.2.{NORMALISATION[array]}", (0,)
    if layer in LAYERS:
        order = (2, 3, 0, 1) if "_dw_" in layer else (3, 2, 0, 1)
        return f"features.{LAYERS.index(layer)}.1.weight", order
    return ("head.weight", (1, 0)) if array == "kernel" else ("head.bias", (0,))


def convert(file: Path, out: Path) -> None:
    """Writes the weights of a Keras file (a whole model or weights alone) as safetensors.

    Raises:
        ValueError: If they are not those of NIMA's MobileNet.
    """
    network = NimaMobileNet()
    state = network.state_dict()
    found: dict[str, torch.Tensor] = {}

    def visit(path: str, item: h5py.Group | h5py.Dataset) -> None:
        *groups, leaf = path.split("/")
        array = leaf.removesuffix(":0")
        if array in ARRAYS and isinstance(item, h5py.Dataset) and "optimizer_weights" not in groups:
            name, order = torch_name(groups[-1], array)
            found[name] = torch.from_numpy(item[()]).float().permute(order).contiguous()
            if name not in state or found[name].shape != state[name].shape:
                raise ValueError(f"{file}: {path} {tuple(item.shape)} is not of NIMA's MobileNet")

    with h5py.File(file, "r") as stored:
        stored.visititems(visit)
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_name(f".{out.name}.tmp")
    save_file(found, partial)
    try:
        read_network(partial)
        partial.replace(out)
    finally:
        partial.unlink(missing_ok=True)


def main(file: str, out: str | None = None) -> None:
    """Converts `file`, and says what it is."""
    content = Path(file).read_bytes()
    blob = hashlib.sha1(f"blob {len(content)}\0".encode() + content).hexdigest()  # as git does
    kind = next((name for name, known in PUBLISHED.items() if known == blob), None)
    if kind is None and out is None:
        sys.exit(f"{file} is not one of the published files: name the .safetensors to write, too")
    target = Path(out) if out else cache_dir() / f"{kind}.safetensors"
    convert(Path(file), target)
    print(f"{file}: {kind or 'not one of the published files'}; wrote {target}")


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    main(*sys.argv[1:])
