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
from torch.nn import functional

from ae_env.scorers.luma import luma_of
from ae_env.scorers.protocol import Captures, DependsOn, Domain
from ae_env.utils.user_files import find_model_file
from simulator.utils.files import as_path, write_atomically

# -- statistics of natural pictures ---------------------------------------------------------------
# A natural picture's locally normalised luma is close to a generalised normal distribution, and the
# products of its neighbours to an asymmetric one; noise, blur and clipping change their shapes.
#
# Source: Mittal, Soundararajan and Bovik, Making a "Completely Blind" Image Quality Analyzer, IEEE
# Signal Processing Letters 20(3), 2013; the asymmetric fit: Lasmar, Stitou and Berthoumieu, 2009.

#: Numbers of one scale, and of the two together.
FEATURES_PER_SCALE, SCALES = 18, 2
FEATURES = FEATURES_PER_SCALE * SCALES
#: Neighbours whose products are fitted: right, below, and along both diagonals.
_SHIFTS = ((0, 1), (1, 0), (1, 1), (1, -1))
#: Shapes that the fit chooses from.
_LEAST_SHAPE, _LARGEST_SHAPE, _SHAPE_STEP = 0.2, 10.0, 0.001
_WINDOW, _WINDOW_SIGMA = 7, 7.0 / 6.0


def normalised_luma(luma: Tensor) -> tuple[Tensor, Tensor]:
    """Luma with its local mean taken off, divided by its local deviation + 1.

    The window is a Gaussian of 7 x 7 pixels, sigma 7/6; edges are repeated.

    Args:
        luma: (B, H, W) in [0, 255].

    Returns:
        (B, H, W) normalised (MSCN) coefficients, and (B, H, W) local standard deviation.
    """
    mean = _blur(luma)
    deviation = (_blur(luma.square()) - mean.square()).abs().sqrt()
    return (luma - mean) / (deviation + 1.0), deviation


def fit_asymmetric(samples: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Asymmetric generalised normal distribution of zero mode, by matching moments.

    Density ``exp(-(|x| / beta)^alpha)`` up to its constant, with a beta for each side.

    Args:
        samples: (..., N).

    Returns:
        Shape alpha in [0.2, 10], scale of the left side and scale of the right side, each (...).
        Where all samples are 0, alpha is 10 and the scales are 0.
    """
    below, above = samples < 0, samples > 0
    squares = samples.square()

    def deviation(side: Tensor) -> Tensor:
        return ((squares * side).sum(-1) / side.sum(-1).clamp(min=1)).sqrt()

    left, right = deviation(below), deviation(above)
    tiny = torch.finfo(samples.dtype).tiny
    share = left / right.clamp(min=tiny)
    # Symmetric in the two sides; a share beyond this only overflows.
    share = share.clamp(1e-6, 1e6)
    ratio = samples.abs().mean(-1).square() / squares.mean(-1).clamp(min=tiny)
    ratio = ratio * (share**3 + 1.0) * (share + 1.0) / (share**2 + 1.0).square()
    shapes, ratios = _shape_table(samples.dtype)
    upper = torch.searchsorted(ratios, ratio.contiguous()).clamp(1, len(ratios) - 1)
    nearer_lower = (ratio - ratios[upper - 1]) <= (ratios[upper] - ratio)
    alpha = shapes[upper - nearer_lower.long()]
    empty = squares.amax(-1) == 0
    alpha = torch.where(empty, shapes[-1], alpha)
    # The deviation of a generalised normal of scale 1.
    unit = torch.exp(0.5 * (torch.lgamma(1.0 / alpha) - torch.lgamma(3.0 / alpha)))
    return alpha, left * unit, right * unit


def block_features(luma: Tensor, block: int) -> tuple[Tensor, Tensor]:
    """NIQE's 36 features of each block of each picture.

    Args:
        luma: (B, H, W) float64 in [0, 255], H and W at least `block`; what is left over right and
            below is not looked at.
        block: Side of a block [pixel], even; the second scale has half of it.

    Returns:
        (B, N, 36) features of N = (H // block) (W // block) blocks, and (B, N) their mean local
        deviation at full size, the sharpness.
    """
    rows, columns = luma.shape[1] // block, luma.shape[2] // block
    luma = luma[:, : rows * block, : columns * block]
    features, sharpness = [], luma.new_zeros(0)
    for scale in range(SCALES):
        side = block >> scale
        normalised, deviation = normalised_luma(luma)
        features.append(_scale_features(_blocks(normalised, side)))
        if scale == 0:
            sharpness = _blocks(deviation, side).mean(dim=(2, 3))
            half = [n // 2 for n in luma.shape[1:]]
            luma = functional.interpolate(
                luma[:, None], half, mode="bicubic", antialias=True, align_corners=False
            )[:, 0]
    return torch.cat(features, dim=2), sharpness


def _scale_features(blocks: Tensor) -> Tensor:
    """(B, N, 18) of normalised blocks (B, N, side, side)."""
    alpha, left, right = fit_asymmetric(blocks.flatten(2))
    values = [alpha, (left + right) / 2.0]
    for shift in _SHIFTS:
        neighbours = blocks * blocks.roll(shift, dims=(2, 3))
        alpha, left, right = fit_asymmetric(neighbours.flatten(2))
        mean = (right - left) * torch.exp(torch.lgamma(2.0 / alpha) - torch.lgamma(1.0 / alpha))
        values += [alpha, mean, left, right]
    return torch.stack(values, dim=2)


def _blocks(values: Tensor, side: int) -> Tensor:
    """(B, N, side, side) tiles of (B, H, W), row by row."""
    batch, height, width = values.shape
    tiles = values.reshape(batch, height // side, side, width // side, side)
    return tiles.permute(0, 1, 3, 2, 4).reshape(batch, -1, side, side)


def _blur(values: Tensor) -> Tensor:
    offset = torch.arange(_WINDOW, dtype=values.dtype, device=values.device) - _WINDOW // 2
    weights = torch.exp(-offset.square() / (2.0 * _WINDOW_SIGMA**2))
    weights = weights / weights.sum()
    edge = _WINDOW // 2
    padded = functional.pad(values[:, None], (edge, edge, edge, edge), mode="replicate")
    across = functional.conv2d(padded, weights[None, None, None, :])
    return functional.conv2d(across, weights[None, None, :, None])[:, 0]


@lru_cache(maxsize=4)
def _shape_table(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Shapes, and E|x|^2 / E x^2 of the generalised normal distribution of each: it only rises."""
    count = round((_LARGEST_SHAPE - _LEAST_SHAPE) / _SHAPE_STEP) + 1
    shapes = _LEAST_SHAPE + _SHAPE_STEP * torch.arange(count, dtype=torch.float64)
    log = 2.0 * torch.lgamma(2.0 / shapes) - torch.lgamma(1.0 / shapes)
    return shapes.to(dtype), torch.exp(log - torch.lgamma(3.0 / shapes)).to(dtype)


# -- the model of pristine pictures, and the distance from it -------------------------------------

#: Environment variable that names the model file.
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
    """A model from the sharp blocks of the caller's own pristine pictures.

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
    distance: Tensor = squared.clamp(min=0.0).sqrt()
    return distance


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
