"""NIMA: the mean opinion that a network trained on human ratings expects."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils import fuse_conv_bn_eval

from ae_env.scorers.protocol import Captures, DependsOn, Domain
from ae_env.utils.user_files import find_model_file
from simulator.utils.files import as_path, write_atomically

# -- the network: MobileNet v1 with ten ratings as its output -------------------------------------

#: Ratings are from 1 to this.
RATINGS = 10
#: Added to the variance in Keras' MobileNet.
_EPS = 1e-3
#: Output channels and stride of the 13 depthwise separable blocks.
_BLOCKS = (
    *((64, 1), (128, 2), (128, 1), (256, 2), (256, 1), (512, 2)),
    *((512, 1), (512, 1), (512, 1), (512, 1), (512, 1), (1024, 2), (1024, 1)),
)


class ConvNormReLU6(nn.Sequential):
    """Convolution without bias, batch normalisation and ReLU6, padded as Keras' MobileNet is.

    With stride 2 only the right and the lower edge are padded, by one pixel.

    Args:
        inputs: Channels.
        outputs: Channels.
        kernel: 1 or 3.
        stride: 1 or 2.
        groups: Of the convolution; `inputs` makes it depthwise.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, groups: int = 1):
        padding = (kernel - 1) // 2 if stride == 1 else 0
        convolution = nn.Conv2d(inputs, outputs, kernel, stride, padding, groups=groups, bias=False)
        super().__init__(
            nn.ZeroPad2d((0, 1, 0, 1)) if stride == 2 else nn.Identity(),
            convolution,
            nn.BatchNorm2d(outputs, eps=_EPS),
            nn.ReLU6(),
        )

    def fuse(self) -> None:
        """Takes the normalisation into the convolution, for inference only."""
        convolution, normalisation = self[1], self[2]
        assert isinstance(convolution, nn.Conv2d)
        assert isinstance(normalisation, nn.BatchNorm2d)
        self[1] = fuse_conv_bn_eval(convolution, normalisation)
        self[2] = nn.Identity()


class NimaMobileNet(nn.Module):
    """MobileNet v1 (width 1) with ten ratings as its output: 3,239,114 numbers.

    Source: Howard et al., MobileNets, 2017; Talebi and Milanfar, NIMA: Neural Image Assessment,
    IEEE Transactions on Image Processing 27(8), 2018, with the head of the published weights:
    global mean, then one dense layer.
    """

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = [ConvNormReLU6(3, 32, 3, 2)]
        inputs = 32
        for outputs, stride in _BLOCKS:
            layers.append(ConvNormReLU6(inputs, inputs, 3, stride, groups=inputs))
            layers.append(ConvNormReLU6(inputs, outputs, 1, 1))
            inputs = outputs
        self.features = nn.Sequential(*layers)
        self.head = nn.Linear(inputs, RATINGS)

    def forward(self, pictures: Tensor) -> Tensor:
        """Share of each rating.

        Args:
            pictures: (B, 3, 224, 224) in [-1, 1].

        Returns:
            (B, 10), each row sums to 1.
        """
        features = self.features(pictures).mean(dim=(2, 3))
        ratings: Tensor = self.head(features).softmax(dim=1)
        return ratings


def nima_network(weights: dict[str, Tensor]) -> NimaMobileNet:
    """The network with these weights, ready for inference.

    Args:
        weights: Its state, as `ae_env.scorers.nima.read_weights` gives it.
    """
    network = NimaMobileNet()
    # The counters of training batches are not among the published numbers.
    counts = {k: v for k, v in network.state_dict().items() if k.endswith("num_batches_tracked")}
    network.load_state_dict({**counts, **weights})
    network.eval().requires_grad_(False)
    for layer in network.features:
        assert isinstance(layer, ConvNormReLU6)
        layer.fuse()
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network


# -- the published weights: from Keras' HDF5 to safetensors, without Keras ------------------------
# Keras stores a convolution as (height, width, inputs, outputs), a depthwise one as (height, width,
# channels, 1) and a dense layer as (inputs, outputs); torch has outputs first.

#: Git blob ids of the published Keras files, by the scorer that they make.
PUBLISHED = {
    "nima_aesthetic": "003fb321ce92445e41d708144a3656589f9214e7",
    "nima_technical": "5e4a4ca2ce639309bfa4038d0bc10ba92b93bd26",
}
KERAS_SUFFIXES = (".h5", ".hdf5")
#: Numbers in the network, the running statistics of its normalisations included.
NUMBER_OF_VALUES = 3_239_114
#: The files have 13 MB; nothing larger is read [byte].
_MAX_BYTES = 2**28
_NORMALISATION = {
    "gamma": "weight",
    "beta": "bias",
    "moving_mean": "running_mean",
    "moving_variance": "running_var",
}
#: How the axes of a Keras kernel are put in torch's order.
_POINTWISE, _DEPTHWISE = (3, 2, 0, 1), (2, 3, 0, 1)


def git_blob_id(content: bytes) -> str:
    """Git's id of a file with this content: the SHA-1 of a short head and the content.

    >>> git_blob_id(b"hello\\n")
    'ce013625030ba8dba906f756967f9e9ca394464a'
    """
    return hashlib.sha1(f"blob {len(content)}\0".encode() + content).hexdigest()


def published_as(content: bytes) -> str | None:
    """The scorer whose published Keras file this is, or None."""
    blob = git_blob_id(content)
    return next((name for name, known in PUBLISHED.items() if known == blob), None)


def read_weights(file: str | os.PathLike[str], digest: str | None = None) -> dict[str, Tensor]:
    """State of a `ae_env.scorers.nima.NimaMobileNet`.

    Args:
        file: ``.safetensors`` that `convert_nima` wrote, or Keras' ``.h5`` or ``.hdf5``.
        digest: SHA-256 that its content must have, or None.

    Raises:
        ValueError: If it cannot be read, is not such a file, or does not fit the network.
        ImportError: If it is Keras' and h5py is not installed.
    """
    path = as_path(file)
    content = _read(path)
    if digest is not None and hashlib.sha256(content).hexdigest() != digest:
        raise ValueError(f"`file` (={str(path)!r}) must not change while it is in use")
    if path.suffix.lower() in KERAS_SUFFIXES:
        return weights_from_keras(content, str(path))
    try:
        weights = load(content)
    except SafetensorError as error:
        raise ValueError(
            f"`file` (={str(path)!r}) must be .safetensors, or Keras' .h5 or .hdf5: {error}"
        ) from error
    _check(weights, str(path))
    return weights


def convert_nima(file: str | os.PathLike[str], out: str | os.PathLike[str]) -> str | None:
    """Converts Keras' HDF5 to safetensors.

    Args:
        file: The Keras file of a MobileNet with ten ratings.
        out: The ``.safetensors`` to write.

    Returns:
        ``"nima_aesthetic"`` or ``"nima_technical"`` where it is the published file, else None.

    Raises:
        ValueError: If a file cannot be used.
        ImportError: If h5py is not installed.
    """
    path, target = as_path(file), as_path(out)
    if target.suffix.lower() != ".safetensors":
        raise ValueError(f"`out` (={str(target)!r}) must end in .safetensors")
    content = _read(path)
    weights = weights_from_keras(content, str(path))
    kind = published_as(content)
    card = {"network": "NIMA, MobileNet v1", "source_blob": git_blob_id(content)}
    write_atomically(target, save(weights, metadata={**card, "published_as": kind or "nothing"}))
    return kind


def weights_from_keras(content: bytes, name: str) -> dict[str, Tensor]:
    """Weights in an HDF5 file of Keras' older layout: whole models, and weights alone.

    A group for each layer, in it ``kernel``, ``depthwise_kernel``, ``gamma``, ``beta``,
    ``moving_mean``, ``moving_variance`` or ``bias``, with or without ``:0``. The one dense layer
    may have any name.

    Args:
        content: The file.
        name: Name of the file in errors.

    Raises:
        ValueError: If it is no HDF5, or not of this network.
        ImportError: If h5py is not installed.
    """
    try:
        import h5py
    except ImportError:
        raise ImportError(f"reading {name!r} needs h5py: pip install 'ae-env[nima]'") from None
    layout = _layout()
    found: dict[str, Tensor] = {}

    def visit(path: str, item: Any) -> None:
        *groups, leaf = path.split("/")
        if not isinstance(item, h5py.Dataset) or "optimizer_weights" in groups:
            return
        leaf = leaf.removesuffix(":0")
        layer = next((g for g in reversed(groups) if (g, leaf) in layout), "dense")
        if (layer, leaf) not in layout:
            return
        target, order, shape = layout[layer, leaf]
        if tuple(item.shape) != shape:
            raise ValueError(
                f"`file` (={name!r}): {path} (={tuple(item.shape)}) must have the shape {shape}"
            )
        values = torch.from_numpy(item.astype("float32")[()])
        found[target] = values.permute(order).contiguous()

    try:
        with h5py.File(io.BytesIO(content), "r") as stored:
            stored.visititems(visit)
    except (OSError, RuntimeError, KeyError) as error:
        raise ValueError(f"`file` (={name!r}) must be HDF5 as Keras writes it: {error}") from error
    _check(found, name)
    return found


def _read(path: Path) -> bytes:
    try:
        size = path.stat().st_size
        if size > _MAX_BYTES:
            raise ValueError(f"`file` (={str(path)!r}) must have at most {_MAX_BYTES} bytes")
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"`file` (={str(path)!r}) cannot be read: {error.strerror}") from error


def _layout() -> dict[tuple[str, str], tuple[str, tuple[int, ...], tuple[int, ...]]]:
    """For a layer's array in Keras: its name in torch, the order of its axes, its Keras shape."""
    shapes = _shapes()
    names = ["conv1", *(f"conv_{kind}_{i}" for i in range(1, 14) for kind in ("dw", "pw"))]
    layout: dict[tuple[str, str], tuple[str, tuple[int, ...], tuple[int, ...]]] = {}

    def add(layer: str, array: str, target: str, order: tuple[int, ...]) -> None:
        shape = shapes[target]  # torch's axis i is Keras' axis order[i]
        layout[layer, array] = (
            target,
            order,
            tuple(shape[order.index(i)] for i in range(len(order))),
        )

    for i, layer in enumerate(names):
        if "_dw_" in layer:
            for array in ("depthwise_kernel", "kernel"):  # Keras 2 and 3
                add(layer, array, f"features.{i}.1.weight", _DEPTHWISE)
        else:
            add(layer, "kernel", f"features.{i}.1.weight", _POINTWISE)
        for array, target in _NORMALISATION.items():
            add(f"{layer}_bn", array, f"features.{i}.2.{target}", (0,))
    add("dense", "kernel", "head.weight", (1, 0))
    add("dense", "bias", "head.bias", (0,))
    return layout


def _shapes() -> dict[str, tuple[int, ...]]:
    """Shape of each array of the network in torch."""
    with torch.device("meta"):
        state = NimaMobileNet().state_dict()
    return {k: tuple(v.shape) for k, v in state.items() if "num_batches" not in k}


def _check(weights: Mapping[str, Tensor], name: str) -> None:
    shapes = _shapes()
    missing = [key for key in shapes if key not in weights]
    if missing:
        raise ValueError(
            f"`file` (={name!r}) must hold a MobileNet with ten ratings, all {NUMBER_OF_VALUES:,} "
            f"numbers of it: {len(missing)} of its {len(shapes)} arrays are missing, such as "
            f"{missing[0]}"
        )
    for key, values in weights.items():
        if shapes.get(key) != tuple(values.shape) or not values.is_floating_point():
            raise ValueError(
                f"`file` (={name!r}): {key} (={tuple(values.shape)}, {values.dtype}) must have the "
                f"shape {shapes.get(key)} and hold floating-point numbers"
            )
        if not bool(torch.isfinite(values).all()):
            raise ValueError(f"`file` (={name!r}): {key} must be finite")


# -- scorers --------------------------------------------------------------------------------------

#: Side of the pictures that the network was trained on [pixel].
INPUT_SIZE = 224
#: Pictures that the network sees at once: more only spend time in memory paging.
_CHUNK = 8


def mean_rating(network: nn.Module, images: Tensor) -> Tensor:
    """Mean rating (B,) in [1, 10] of sRGB pictures.

    Args:
        network: A `NimaMobileNet`.
        images: (B, 3, H, W) sRGB in [0, 1], resized to 224 x 224 whatever their shape.
    """
    size = (INPUT_SIZE, INPUT_SIZE)
    ratings = torch.arange(1.0, RATINGS + 1.0, dtype=torch.float64)
    means = []
    with torch.no_grad():
        for part in images.split(_CHUNK):  # type: ignore[no-untyped-call]
            if part.shape[2:] != size:
                part = functional.interpolate(part, size, mode="bilinear", antialias=True)
            part = (2.0 * part.clamp(0.0, 1.0) - 1.0).to(memory_format=torch.channels_last)
            means.append(network(part).double() @ ratings)
    return torch.cat(means)


@lru_cache(maxsize=4)
def _network(file: str, digest: str) -> NimaMobileNet:
    """The network of a file, read once per content."""
    return nima_network(read_weights(file, digest))


class Nima:
    """Mean rating of people as a MobileNet expects it: (mean of 1..10 - 1) / 9.

    Talebi and Milanfar, NIMA: Neural Image Assessment, 2018. The weights do not come with the
    package: `file`, else what the scorer's environment variable names, else in the cache folder.

    Args:
        file: Converted weights (.safetensors), or the published Keras file (.h5, .hdf5: needs the
            extra ``nima``).

    Raises:
        ValueError: If the file is not there or does not fit.
    """

    domain: Domain = "srgb"
    depends_on: DependsOn = "image"
    needs = "weights"
    version = 1
    #: Name of the scorer and of its weights.
    name = ""

    def __init__(self, file: str | os.PathLike[str] | None = None) -> None:
        found = find_model_file(
            self.name,
            file,
            f"AE_ENV_{self.name.upper()}",
            tuple(f"{self.name}{suffix}" for suffix in (".safetensors", *KERAS_SUFFIXES)),
            how=(
                f"`ae-env convert-nima FILE` makes it from the published Keras weights, whose git "
                f"blob id is {PUBLISHED[self.name]} (docs/scorers.md)"
            ),
        )
        self.file = str(found.resolve())
        #: SHA-256 of the file: other weights under the same name give other scores.
        self.digest = hashlib.sha256(found.read_bytes()).hexdigest()
        _network(self.file, self.digest)  # raises now, not at the first score

    def __call__(self, images: Tensor | None, captures: Captures) -> Tensor:
        """Scores (B,) of sRGB `images` (B, 3, H, W)."""
        assert images is not None
        return (mean_rating(_network(self.file, self.digest), images) - 1.0) / (RATINGS - 1.0)


class NimaAesthetic(Nima):
    """Aesthetic quality as people rate it: NIMA (2018), trained on AVA."""

    needs = "weights: AE_ENV_NIMA_AESTHETIC"
    name = "nima_aesthetic"


class NimaTechnical(Nima):
    """Technical quality as people rate it: NIMA (2018), trained on TID2013."""

    needs = "weights: AE_ENV_NIMA_TECHNICAL"
    name = "nima_technical"
