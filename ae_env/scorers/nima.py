"""NIMA: the mean opinion that a network trained on human ratings expects."""

from __future__ import annotations

import hashlib
import os
from functools import lru_cache

import torch
from torch import Tensor, nn
from torch.nn import functional

from ae_env.scorers.model_files import find_model_file
from ae_env.scorers.nima_network import RATINGS, NimaMobileNet, nima_network
from ae_env.scorers.nima_weights import KERAS_SUFFIXES, PUBLISHED, read_weights
from ae_env.scorers.protocol import Captures, DependsOn, Domain

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
        for part in images.split(_CHUNK):
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
    #: What the weights are called.
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
        _network(self.file, self.digest)  # what is wrong with it is said now

    def __call__(self, images: Tensor | None, captures: Captures) -> Tensor:
        """Scores (B,) of sRGB `images` (B, 3, H, W)."""
        assert images is not None
        return (mean_rating(_network(self.file, self.digest), images) - 1.0) / (RATINGS - 1.0)


class NimaAesthetic(Nima):
    """How pleasing people find the picture: NIMA (2018), trained on AVA."""

    needs = "weights: AE_ENV_NIMA_AESTHETIC"
    name = "nima_aesthetic"


class NimaTechnical(Nima):
    """How good people find the technical quality: NIMA (2018), trained on TID2013."""

    needs = "weights: AE_ENV_NIMA_TECHNICAL"
    name = "nima_technical"
