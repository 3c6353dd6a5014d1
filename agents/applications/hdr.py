"""HDR from one raw: the bracket that the camera did not take, fused to one picture.

Fusion after S. Lee, J. S. Park and N. I. Cho, "A multi-exposure image fusion based on the adaptive
weights reflecting the relative pixel intensity and global gradient", ICIP 2018; blended in a
Laplacian pyramid (T. Mertens, J. Kautz, F. Van Reeth, "Exposure fusion", Pacific Graphics 2007).
"""

import functools
import itertools
import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter
from torch import Tensor

from ae_env.scorers.measures import luma_of
from simulator import CameraSimulator, RawImage, render_srgb
from simulator.raw.develop import srgb_from_camera, upright
from simulator.utils.checks import check_number, import_extra
from simulator.utils.files import write_atomically

#: Ends and step of the bracket [EV].
STOPS, STEP = 4.0, 0.5
#: Width of the first weight, relative to the spacing of the bracket's mean brightnesses.
ALPHA = 0.75
#: Levels of the pyramid of a picture of less than 512 pixels a side, and standard deviation of the
#: weights' smoothing [pixel].
LEVELS, SMOOTHING = 7, 5.0
_BINS = 256
#: Smallest weight: somewhere all pictures may be black or white.
_LEAST = 1e-12
#: [1 4 6 4 1] / 16 both ways.
_FILTER = (torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0).expand(5, 5)
_FILTER = (_FILTER * _FILTER.T)[None, None]


class HdrPicture(NamedTuple):
    """Result of `hdr_picture`."""

    #: (4, H, W) float32 packed light with little noise, 1.0 is the raw's white; what was saturated
    #: there is an estimate.
    radiance: Tensor
    fused: Tensor  # (3, 2H, 2W) float32 in [0, 1], sRGB: the bracket fused
    exposures: tuple[float, ...]  # EV of the bracket's pictures relative to the raw


def hdr_picture(
    raw: RawImage,
    *,
    stops: float = STOPS,
    step: float = STEP,
    simulator: CameraSimulator | None = None,
) -> HdrPicture:
    """Simulates a bracket of `raw`, each picture with little noise, and fuses it.

    Saturated parts of the raw are taken as neutral highlights, brighter than white where every
    plane is clipped (`simulator.raw.develop`): halos would surround them if they stayed white
    in the darkest pictures.

    Args:
        stops: The bracket reaches from -`stops` to +`stops` [EV], in [0.05, 10].
        step: Between its pictures [EV], in [0.05, `stops`].
        simulator: What reduces noise; by default ``CameraSimulator.from_pretrained()``.
    """
    exposures = bracket_exposures(stops, step)
    simulator = CameraSimulator.from_pretrained() if simulator is None else simulator
    prepared = simulator.prepare(raw, tolerance=0.0)
    light = prepared.denoised_lights[-1].light if prepared.denoised_lights else prepared.light

    # 8 bits a sample: the pictures of a large raw fill the memory.
    codes = [render_srgb(_exposed(replace(raw, data=light), ev)) for ev in exposures]
    fused = fuse(lambda: (picture.float() / 255.0 for picture in codes))
    return HdrPicture(light, fused, exposures)


def bracket_exposures(stops: float = STOPS, step: float = STEP) -> tuple[float, ...]:
    """EV of the pictures of a bracket, darkest first.

    >>> bracket_exposures(1.0, 0.5)
    (-1.0, -0.5, 0.0, 0.5, 1.0)
    """
    check_number("stops", stops, 0.05, 10.0)
    check_number("step", step, 0.05, stops, more=", at most `stops`")
    count = math.floor(stops / step + 1e-9)
    return tuple(step * i for i in range(-count, count + 1))


def expose_and_develop(raw: RawImage, ev: float = 0.0) -> Tensor:
    """The picture (3, 2H, 2W) in [0, 1] of `raw`, whose light may exceed white, `ev` brighter.

    Its sensor clips at white, and each code has 8 bits, as in a camera's JPEG.
    """
    return render_srgb(_exposed(raw, ev)).float() / 255.0


def _exposed(raw: RawImage, ev: float) -> RawImage:
    return replace(raw, data=(raw.data * 2.0**ev).clamp(max=1.0))


def linear_rgb(raw: RawImage, radiance: Tensor) -> np.ndarray:
    """Linear light (H, W, 3) float32 in the primaries of sRGB, white-balanced, not clipped.

    The `radiance` of an `HdrPicture` of `raw`, turned as the camera was held.
    """
    gains = np.array(raw.white_balance) / min(raw.white_balance)
    red, green, green2, blue = radiance.double().cpu().numpy()
    rgb = np.stack([red, 0.5 * (green + green2), blue], axis=-1) * gains
    if raw.camera.colour_matrix is not None:
        rgb = rgb @ srgb_from_camera(raw.camera.colour_matrix).numpy().T
    return np.maximum(upright(rgb, raw), 0.0).astype(np.float32)


def write_exr(path: str | Path, image: np.ndarray) -> Path:
    """Writes linear light (H, W, 3) as an EXR of 32-bit floats, for which OpenEXR is needed."""
    openexr = import_extra("OpenEXR", "hdr", "an EXR file")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    with tempfile.TemporaryDirectory() as folder:  # OpenEXR writes to a path only
        file = Path(folder, "image.exr")
        openexr.File(header, {"RGB": np.ascontiguousarray(image)}).write(str(file))
        return write_atomically(Path(path), file.read_bytes())


# -- exposure fusion ------------------------------------------------------------------------------


def fuse(pictures: Sequence[Tensor] | Callable[[], Iterator[Tensor]]) -> Tensor:
    """Fuses a bracket of two or more pictures (3, H, W) float32 in [0, 1], sRGB, to one.

    A picture counts where it is bright if it is one of the darker ones, and where it is dark if it
    is one of the brighter ones; and more where its brightnesses are rare, so that it has contrast
    there: where a picture is black or white, all of it has the same one. A function that yields
    the pictures is called several times: a bracket of large ones need not be held at once.
    """
    every = pictures if callable(pictures) else lambda: iter(pictures)
    means = torch.tensor([float(luma_of(picture[None]).mean()) for picture in every()])
    if len(means) < 2:
        raise ValueError(f"`pictures` (={len(means)}) must be at least 2")
    # Standard deviation of the first weight: `ALPHA` times the distance between both neighbours.
    order = means.argsort()
    widths = torch.empty_like(means)
    widths[order] = ALPHA * 2.0 * torch.gradient(means[order])[0]
    widths = widths.clamp(min=1.0 / _BINS)  # pictures that are alike

    def weighted() -> Iterator[tuple[Tensor, Tensor]]:
        for picture, mean, width in zip(every(), means, widths, strict=True):
            yield picture, _weight(luma_of(picture[None])[0], float(mean), float(width))

    total = functools.reduce(torch.add, (weight for _, weight in weighted()))
    fused: list[Tensor] = []
    for picture, weight in weighted():
        share = (weight / total).cpu().numpy()
        share = gaussian_filter(share, SMOOTHING, mode="nearest", truncate=3.0)
        weights = _gaussian_pyramid(torch.from_numpy(share).to(picture.device)[None])
        levels = _gaussian_pyramid(picture)
        pairs = itertools.pairwise(levels)  # of a Laplacian pyramid
        details = [*(fine - _expand(coarse, fine.shape[-2:]) for fine, coarse in pairs), levels[-1]]
        blended = [w * d for w, d in zip(weights, details, strict=True)]
        fused = blended if not fused else [f.add_(b) for f, b in zip(fused, blended, strict=True)]
    result = fused[-1]
    for detail in reversed(fused[:-1]):
        result = detail + _expand(result, detail.shape[-2:])
    return result.clamp(0.0, 1.0)


def _weight(luma: Tensor, mean: float, width: float) -> Tensor:
    """The product of both weights, (H, W), before it is normalised over the bracket."""
    well_placed = torch.exp(-((luma - (1.0 - mean)) ** 2) / (2.0 * width**2))
    codes = (luma * (_BINS - 1)).round().long().clamp(0, _BINS - 1)
    # The gradient of the cumulative histogram: how many pixels have this brightness.
    counts = torch.bincount(codes.flatten(), minlength=_BINS).double() / codes.numel()
    rarity = (1.0 / counts.clamp(min=1.0 / codes.numel())).float()[codes]
    return well_placed * rarity + _LEAST


# -- pyramids (Burt and Adelson 1983) -------------------------------------------------------------


def _reduce(image: Tensor) -> Tensor:
    """Every second pixel of (C, H, W) after [1 4 6 4 1] / 16 both ways, borders repeated."""
    padded = F.pad(image[:, None], (2, 2, 2, 2), mode="replicate")
    return F.conv2d(padded, _FILTER.to(image), stride=2)[:, 0]


def _expand(image: Tensor, size: Sequence[int]) -> Tensor:
    """(C, H, W) at twice the pixels, cut to `size`, filled in by the same filter.

    Pixel k comes to lie at 2 k, where `_reduce` took it from.
    """
    padded = F.pad(image[:, None], (1, 1, 1, 1), mode="replicate")
    filled = F.conv_transpose2d(padded, 4.0 * _FILTER.to(image), stride=2)
    return filled[:, 0, 4 : 4 + size[0], 4 : 4 + size[1]]


def _gaussian_pyramid(image: Tensor) -> list[Tensor]:
    """Levels down to 4 to 8 pixels along the shorter side, at least `LEVELS` of them.

    What is larger than a pixel of the coarsest level is weighted as a whole: with 7 levels, a flat
    patch of a photograph of some megapixels fades from its edges to its middle.
    """
    levels = [image]
    depth = max(LEVELS, min(image.shape[-2:]).bit_length() - 2)
    while len(levels) < depth and min(levels[-1].shape[-2:]) > 1:
        levels.append(_reduce(levels[-1]))
    return levels
