"""NIMA's published weights: from Keras' HDF5 to safetensors, without Keras.

Keras stores a convolution as (height, width, inputs, outputs), a depthwise one as (height, width,
channels, 1) and a dense layer as (inputs, outputs); torch wants outputs first.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from simulator.files import as_path, write_atomically

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
    """What git calls a file of this content: the SHA-1 of a short head and the content.

    >>> git_blob_id(b"hello\\n")
    'ce013625030ba8dba906f756967f9e9ca394464a'
    """
    return hashlib.sha1(f"blob {len(content)}\0".encode() + content).hexdigest()


def published_as(content: bytes) -> str | None:
    """The scorer whose published Keras file this is, or None."""
    blob = git_blob_id(content)
    return next((name for name, known in PUBLISHED.items() if known == blob), None)


def read_weights(file: str | os.PathLike[str], digest: str | None = None) -> dict[str, Tensor]:
    """State of a `ae_env.scorers.nima_network.NimaMobileNet`.

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
        name: What errors call it.

    Raises:
        ValueError: If it is no HDF5, or not of this network.
        ImportError: If h5py is not installed.
    """
    try:
        import h5py
    except ImportError:
        raise ImportError(f"reading {name!r} needs h5py: pip install 'ae-env[nima]'") from None
    places = _places()
    found: dict[str, Tensor] = {}

    def visit(path: str, item: Any) -> None:
        *groups, leaf = path.split("/")
        if not isinstance(item, h5py.Dataset) or "optimizer_weights" in groups:
            return
        leaf = leaf.removesuffix(":0")
        layer = next((g for g in reversed(groups) if (g, leaf) in places), "dense")
        if (layer, leaf) not in places:
            return
        target, order, shape = places[layer, leaf]
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


def _places() -> dict[tuple[str, str], tuple[str, tuple[int, ...], tuple[int, ...]]]:
    """Of a layer's array in Keras: its name in torch, the order of its axes, its Keras shape."""
    shapes = _shapes()
    names = ["conv1", *(f"conv_{kind}_{i}" for i in range(1, 14) for kind in ("dw", "pw"))]
    places: dict[tuple[str, str], tuple[str, tuple[int, ...], tuple[int, ...]]] = {}

    def add(layer: str, array: str, target: str, order: tuple[int, ...]) -> None:
        shape = shapes[target]  # torch's axis i is Keras' axis order[i]
        places[layer, array] = (
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
    return places


def _shapes() -> dict[str, tuple[int, ...]]:
    from ae_env.scorers.nima_network import NimaMobileNet

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
