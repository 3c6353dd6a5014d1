"""NIQE: how far a picture's statistics are from those of pristine pictures."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import torch
from torch import Tensor

from ae_env.scorers.luma import luma_of
from ae_env.scorers.model_files import find_model_file
from ae_env.scorers.natural_scene import FEATURES, block_features
from ae_env.scorers.protocol import Captures, DependsOn, Domain
from simulator.files import as_path, write_atomically

VARIABLE = "AE_ENV_NIQE"
#: Side of a block [pixel]; smaller pictures are one block.
BLOCK = 96
#: Blocks of a pristine picture count where they have this share of its sharpest block's deviation.
SHARP_SHARE = 0.75
#: Distance that scores a half.
HALF_DISTANCE = 5.0
#: Names of the mean and the covariance in the authors' .mat, and in the .npz of `save`.
_NAMES = (("mu_prisparam", "cov_prisparam"), ("mean", "covariance"))
_MAX_BYTES = 2**26


@dataclass(frozen=True, eq=False)
class NiqeModel:
    """Statistics of pristine pictures.

    Args:
        mean: (36,) float64.
        covariance: (36, 36) float64.
    """

    mean: np.ndarray
    covariance: np.ndarray

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes an ``.npz`` that `load_niqe_model` reads.

        Raises:
            ValueError: If `path` does not end in ``.npz``.
        """
        file = as_path(path)
        if file.suffix.lower() != ".npz":
            raise ValueError(f"`path` (={str(file)!r}) must end in .npz")
        buffer = io.BytesIO()
        np.savez(buffer, mean=self.mean, covariance=self.covariance)
        return write_atomically(file, buffer.getvalue())


def fit_niqe_model(pictures: Iterable[Tensor], block: int = BLOCK) -> NiqeModel:
    """A model of pristine pictures of one's own, from their sharp blocks.

    Args:
        pictures: sRGB (3, H, W) in [0, 1] each, sharp and without noise, H and W at least `block`.
        block: Side of a block [pixel], even. A model fits pictures that are scored with the same.

    Raises:
        ValueError: If a picture is too small or of another shape, or there are fewer than 37 sharp
            blocks in all: too few for a covariance of 36 numbers.
    """
    if isinstance(block, bool) or not isinstance(block, int) or block < 16 or block % 2:
        raise ValueError(f"`block` (={block!r}) must be an even integer >= 16")
    features = []
    for i, picture in enumerate(pictures):
        if picture.ndim != 3 or len(picture) != 3 or min(picture.shape[1:]) < block:
            raise ValueError(
                f"`pictures`[{i}] (={tuple(picture.shape)}) must be (3, H, W), H and W >= {block}"
            )
        own, sharpness = block_features(_luma(picture[None]), block)
        features.append(own[sharpness > SHARP_SHARE * sharpness.max()])
    blocks = torch.cat(features) if features else torch.zeros(0, FEATURES)
    if len(blocks) <= FEATURES:
        raise ValueError(
            f"`pictures` must have more than {FEATURES} sharp blocks of {block} x {block} pixels, "
            f"got {len(blocks)}: give more or larger pictures"
        )
    return NiqeModel(blocks.mean(dim=0).numpy(), np.cov(blocks.numpy(), rowvar=False))


def load_niqe_model(path: str | os.PathLike[str]) -> NiqeModel:
    """The model in the authors' ``modelparameters.mat``, or in an ``.npz`` of `NiqeModel.save`.

    Raises:
        ValueError: If it cannot be read or does not hold a mean of 36 numbers and a covariance.
    """
    file = as_path(path)
    rule = f"`file` (={str(file)!r})"
    try:
        if file.stat().st_size > _MAX_BYTES:
            raise ValueError(f"{rule} must have at most {_MAX_BYTES} bytes")
        content = file.read_bytes()
    except OSError as error:
        raise ValueError(f"{rule} cannot be read: {error.strerror}") from error
    try:
        found: dict[str, Any] = (
            scipy.io.loadmat(io.BytesIO(content))
            if file.suffix.lower() == ".mat"
            else dict(np.load(io.BytesIO(content), allow_pickle=False))
        )
    except Exception as error:  # SciPy and NumPy raise a dozen kinds for damaged files
        raise ValueError(f"{rule} must be .mat or .npz: {error}") from error
    for mean, covariance in _NAMES:
        if mean in found and covariance in found:
            return _checked(found[mean], found[covariance], rule)
    raise ValueError(f"{rule} must hold {' or '.join(' and '.join(pair) for pair in _NAMES)}")


def niqe_distance(images: Tensor, model: NiqeModel, block: int = BLOCK) -> Tensor:
    """NIQE's distance (B,) of pictures from a model; 0 is pristine, 3 good, above 10 bad.

    ``sqrt((m - m')^T ((S + S') / 2)^+ (m - m'))`` with mean and covariance over the blocks of the
    picture and of the model. A picture of one block has no covariance: zeros stand for it.

    Args:
        images: (B, 3, H, W) sRGB in [0, 1].
        model: The pristine statistics.
        block: Side of a block [pixel]; less where the pictures are smaller.
    """
    side = min(block, images.shape[2], images.shape[3]) // 2 * 2
    if side < 2:  # there is nothing to look at
        return images.new_full((len(images),), torch.inf, dtype=torch.float64)
    features, _ = block_features(_luma(images), side)
    mean = features.mean(dim=1)
    centred = features - mean[:, None]
    covariance = centred.mT @ centred / max(1, features.shape[1] - 1)
    pristine = torch.from_numpy(model.covariance)
    inverse = torch.linalg.pinv((covariance + pristine) / 2.0, hermitian=True)
    difference = mean - torch.from_numpy(model.mean)
    squared = (difference[:, None] @ inverse @ difference[..., None]).flatten()
    return squared.clamp(min=0.0).sqrt()


class Niqe:
    """Naturalness by NIQE: 1 / (1 + D / 5), D the distance from pristine pictures' statistics.

    Mittal, Soundararajan and Bovik, IEEE Signal Processing Letters 20(3), 2013. The model does not
    come with the package: the authors' ``modelparameters.mat``, or one of your own pristine
    pictures (`fit_niqe_model`). The authors' is for blocks of 96 x 96 pixels; smaller frames are
    scored as one block, for which a model fitted with ``block`` of that size is better.

    Args:
        file: The model, ``.mat`` or ``.npz``; by default what ``AE_ENV_NIQE`` names.

    Raises:
        ValueError: If the file is not there or is no model.
    """

    domain: Domain = "srgb"
    depends_on: DependsOn = "image"
    needs = f"model: {VARIABLE}"
    version = 1

    def __init__(self, file: str | os.PathLike[str] | None = None) -> None:
        found = find_model_file(
            "niqe",
            file,
            VARIABLE,
            ("niqe.npz", "niqe.mat"),
            how=(
                "the authors' modelparameters.mat is in their release, "
                "ae_env.scorers.niqe.fit_niqe_model makes one from pictures (docs/scorers.md)"
            ),
        ).resolve()
        self.file = str(found)
        #: SHA-256 of the file: another model under the same name gives other scores.
        self.digest = hashlib.sha256(found.read_bytes()).hexdigest()
        _model(self.file, self.digest)

    def __call__(self, images: Tensor | None, captures: Captures) -> Tensor:
        """Scores (B,) of sRGB `images` (B, 3, H, W)."""
        assert images is not None
        distance = niqe_distance(images, _model(self.file, self.digest))
        return 1.0 / (1.0 + distance / HALF_DISTANCE)


@lru_cache(maxsize=4)
def _model(file: str, digest: str) -> NiqeModel:
    """The model of a file, read once per content."""
    return load_niqe_model(file)


def _luma(images: Tensor) -> Tensor:
    """Luma (B, H, W) float64 in [0, 255], whole numbers as the authors' 8-bit pictures have."""
    return luma_of(images.double().clamp(0.0, 1.0)).mul(255.0).round()


def _checked(mean: Any, covariance: Any, rule: str) -> NiqeModel:
    try:
        mean = np.asarray(mean, np.float64).reshape(-1)
        covariance = np.asarray(covariance, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{rule} must hold numbers: {error}") from None
    if mean.shape != (FEATURES,) or covariance.shape != (FEATURES, FEATURES):
        shapes = f"{mean.shape} and {covariance.shape}"
        raise ValueError(
            f"{rule} must hold a mean of {FEATURES} numbers and their covariance, got {shapes}"
        )
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise ValueError(f"{rule} must hold finite numbers")
    return NiqeModel(mean, covariance)
