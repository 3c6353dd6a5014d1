"""The image signal processor: from packed raws to sRGB pictures.

White balance, highlight clip, demosaic, colour matrix, tone curve, sRGB encoding: the pipeline of
dcraw and of the DNG specification, without sharpening, denoising or local adaptation.
"""

from __future__ import annotations

import difflib
import functools
import math
from collections.abc import Sequence

import numpy as np
import torch

from simulator.raw.demosaic import demosaic_half, demosaic_malvar
from simulator.raw.image import RawImage, check_packed

#: Linear sRGB (D65) to CIE XYZ, IEC 61966-2-1:1999.
XYZ_FROM_SRGB = (
    (0.4124, 0.3576, 0.1805),
    (0.2126, 0.7152, 0.0722),
    (0.0193, 0.1192, 0.9505),
)
#: Signal of an 18 % grey card in incident-light exposure: 0.18 * 0.6635 of sensor white.
GREY_CARD_SIGNAL = 0.18 * 0.6635
#: Schlick's parameter that shows that card at 18 % of the display's white.
PHOTOGRAPHIC_SLOPE = 0.18 * (1.0 - GREY_CARD_SIGNAL) / (GREY_CARD_SIGNAL * (1.0 - 0.18))

DEMOSAICS = ("half", "malvar")
TONES = ("linear", "photographic")

_SRGB_TOE = 0.0031308
_LARGEST_GAIN = 2.0**32  # of a plane against another: float32 holds its product with any code
_CHUNK = 2**18  # elements

Gains = torch.Tensor | np.ndarray | Sequence[float]
Matrix = torch.Tensor | np.ndarray | Sequence[Sequence[float]]


def develop(
    images: torch.Tensor,
    white_balance: Gains = (1.0, 1.0, 1.0),
    colour_matrix: Matrix | None = None,
    *,
    tone: str = "photographic",
) -> torch.Tensor:
    """Develop a batch of packed raws to sRGB at half the sensor's resolution.

    Args:
        images: (B, 4, H, W) floating point, planes R, G1, G2, B, 1.0 at sensor white. Negative
            values and values above 1 are allowed.
        white_balance: Gains of R, G, B that make a grey card grey, (3,) for all or (B, 3).
        colour_matrix: (3, 3) XYZ (D65) to camera RGB, as `CameraProfile.colour_matrix`; None takes
            camera RGB as linear sRGB.
        tone: ``"photographic"`` (default) shows an 18 % card that was exposed by incident light as
            18 % grey and rolls highlights off towards white; ``"linear"`` leaves light as it is.

    Returns:
        (B, 3, H, W) float32 in [0, 1], sRGB-encoded, on the device of `images`.

    Raises:
        ValueError: If an argument has the wrong shape, dtype or range, or is not finite.

    >>> grey_card = torch.full((1, 4, 1, 1), 0.18 * 0.6635)
    >>> develop(grey_card).flatten()
    tensor([0.4614, 0.4614, 0.4614])
    """
    images = check_packed("images", images, ndim=4)
    check_name("tone", tone, TONES)
    gains = _check_gains(white_balance, images)
    encoded = torch.empty(len(images), 3, *images.shape[2:], device=images.device)
    # A few images at a time stay in the CPU's cache: twice as fast, and the same up to the last
    # bits of float32, which depend on a pixel's position in the array.
    step = max(1, _CHUNK // images[0].numel()) if images.device.type == "cpu" else len(images)
    for start in range(0, len(images), step):
        part = slice(start, start + step)
        rgb = demosaic_half(_balance(images[part], gains[part]))
        encoded[part] = _finish(rgb, colour_matrix, tone)
    return encoded


def develop_inverse(pictures: torch.Tensor) -> torch.Tensor:
    """Packed raws that `develop` turns into these pictures, without balance or colour matrix.

    What a camera's own processing did besides (its tone curve, sharpening, compression) stays in.

    Args:
        pictures: (B, 3, H, W) sRGB, uint8 or floating point in [0, 1].

    Returns:
        (B, 4, H, W) float32 in [0, 1]: each pixel becomes a packed one, its planes at one place.

    >>> picture = torch.tensor([0, 17, 118, 255], dtype=torch.uint8).expand(1, 3, 1, 4)
    >>> develop(develop_inverse(picture)).mul(255.0).round()[0, 0, 0]
    tensor([  0.,  17., 118., 255.])
    """
    if pictures.is_floating_point():
        return _decoded(pictures.float())[:, [0, 1, 1, 2]]
    light = _decoded(torch.arange(256, dtype=torch.float64) / 255.0).float()
    return light.to(pictures.device)[pictures.long()][:, [0, 1, 1, 2]]


def _decoded(encoded: torch.Tensor) -> torch.Tensor:
    """Light that `_finish` shows as `encoded`, sRGB in [0, 1]."""
    curved = ((encoded + 0.055) / 1.055) ** 2.4
    shown = torch.where(encoded <= 0.04045, encoded / 12.92, curved)
    # The inverse of Schlick's curve, see `apply_tone`.
    return shown / (PHOTOGRAPHIC_SLOPE - (PHOTOGRAPHIC_SLOPE - 1.0) * shown)


def render_srgb(
    raw: RawImage,
    demosaic: str = "malvar",
    exposure_ev: float = 0.0,
    *,
    tone: str = "photographic",
) -> torch.Tensor:
    """Develop one raw for looking at, with its own white balance and its camera's matrix.

    Args:
        raw: The raw, 1.0 at sensor white.
        demosaic: ``"malvar"`` at the sensor's resolution, ``"half"`` at half of it.
        exposure_ev: Exposure correction in stops, in [-32, 32]; applied to the linear picture
            after the highlight clip, so that darkened saturated areas turn grey, not coloured.
        tone: As in `develop`.

    Returns:
        (3, 2H, 2W) uint8 for ``"malvar"``, (3, H, W) for ``"half"``, sRGB.

    Raises:
        ValueError: If `raw` is no `RawImage`, a name is unknown or `exposure_ev` is out of range.
    """
    if not isinstance(raw, RawImage):
        raise ValueError(f"`raw` (={type(raw).__name__}) must be a RawImage")
    check_name("demosaic", demosaic, DEMOSAICS)
    check_name("tone", tone, TONES)
    if not (math.isfinite(exposure_ev) and abs(exposure_ev) <= 32.0):
        raise ValueError(f"`exposure_ev` (={exposure_ev!r}) must be in [-32, 32]")
    packed = balance(raw.data[None], raw.white_balance) * 2.0**exposure_ev
    small = min(packed.shape[2:]) < 2  # Malvar's filters need a neighbour of the same colour
    if demosaic == "half":
        rgb = demosaic_half(packed)
    elif small:
        rgb = demosaic_half(packed).repeat_interleave(2, 2).repeat_interleave(2, 3)
    else:
        rgb = demosaic_malvar(packed, raw.camera.cfa)
    encoded = _finish(rgb, raw.camera.colour_matrix, tone)[0]
    return encoded.mul_(255.0).round_().to(torch.uint8)


def quarter_turns(raw: RawImage) -> int:
    """Quarter turns to the left that turn a picture of `raw` upright, as `numpy.rot90` takes them.

    Files state how the camera was held in LibRaw's code, ``metadata["flip"]``.
    """
    return {3: 2, 5: 1, 6: -1}.get(raw.metadata.get("flip", 0), 0)


def balance(images: torch.Tensor, white_balance: Gains) -> torch.Tensor:
    """White-balance packed raws and clip their highlights to white.

    The gains are divided by their smallest, so a saturated pixel reaches at least 1 in every
    channel; then everything is clipped at 1. Without that clip the gains would turn saturated areas
    magenta. Negative values stay: clipping them here would lift the black level of noisy shadows.

    Args:
        images: (B, 4, H, W) float32, planes R, G1, G2, B.
        white_balance: Positive gains of R, G, B, (3,) or (B, 3).

    Returns:
        (B, 4, H, W) in [-1, 1].
    """
    return _balance(images, _check_gains(white_balance, images))


def srgb_from_camera(colour_matrix: Matrix) -> torch.Tensor:
    """Matrix from white-balanced camera RGB to linear sRGB, (3, 3) float64.

    ``XYZ to camera @ sRGB to XYZ`` gives camera RGB from sRGB; each row is divided by its sum,
    because white balance has already mapped the illuminant to equal values; then it is inverted.
    So (1, 1, 1) maps to (1, 1, 1). This is what dcraw's ``cam_xyz_coeff`` does, and what the DNG
    specification 1.4, chapter 6, does for a scene lit by the matrix's own illuminant.

    Args:
        colour_matrix: (3, 3) XYZ (D65) to camera RGB, any positive scale.

    Raises:
        ValueError: If it is not 3 x 3 and finite, or has no such inverse.
    """
    matrix = torch.as_tensor(colour_matrix, dtype=torch.float64)
    if matrix.shape != (3, 3) or not bool(torch.isfinite(matrix).all()):
        raise ValueError(f"`colour_matrix` (={matrix.tolist()}) must be 3 x 3 and finite")
    rows = tuple(tuple(row) for row in matrix.tolist())
    return torch.tensor(_srgb_from_camera(rows), dtype=torch.float64)


@functools.lru_cache(maxsize=64)
def _srgb_from_camera(rows: tuple[tuple[float, ...], ...]) -> list[list[float]]:
    camera_from_srgb = np.array(rows) @ np.array(XYZ_FROM_SRGB)
    white = camera_from_srgb.sum(axis=1, keepdims=True)
    if not (white > 0).all():
        raise ValueError(f"`colour_matrix` (={rows}) must see white in every channel")
    camera_from_srgb /= white
    if np.linalg.cond(camera_from_srgb) > 1e6:
        raise ValueError(f"`colour_matrix` (={rows}) must be invertible")
    inverse: list[list[float]] = np.linalg.inv(camera_from_srgb).tolist()
    return inverse


def apply_tone(linear: torch.Tensor, tone: str) -> torch.Tensor:
    """The tone curve on linear light in [0, 1]; monotone, 0 to 0 and 1 to 1.

    ``"photographic"`` is Schlick's rational curve ``p x / ((p - 1) x + 1)`` with p = 1.618, which
    maps 0.119 to 0.18. Its slope falls from p at black to 1 / p at white.

    Source: C. Schlick, "Quantization techniques for visualization of high dynamic range pictures",
    Eurographics Workshop on Rendering 1994 (uniform rational quantization).
    """
    check_name("tone", tone, TONES)
    if tone == "linear":
        return linear
    slope = PHOTOGRAPHIC_SLOPE
    return linear.mul(slope).div_(linear.mul(slope - 1.0).add_(1.0))


def srgb_encode(linear: torch.Tensor) -> torch.Tensor:
    """Linear light in [0, 1] to sRGB values in [0, 1] (IEC 61966-2-1:1999).

    >>> srgb_encode(torch.tensor([0.0, 0.0031308, 0.18, 1.0]))
    tensor([0.0000, 0.0404, 0.4614, 1.0000])
    """
    toe = linear.sub(_SRGB_TOE).clamp_(max=0.0)  # the straight part, 0 above it
    # exp2(log2(x) / 2.4) is twice as fast as pow and as exact.
    curved = linear.clamp(min=_SRGB_TOE).log2_().mul_(1.0 / 2.4).exp2_()
    return curved.mul_(1.055).sub_(0.055).add_(toe, alpha=12.92).clamp_(0.0, 1.0)


def check_name(argument: str, name: object, known: Sequence[str]) -> None:
    """Raise a `ValueError` that lists the `known` names, and the nearest, if `name` is not one."""
    if name not in known:
        near = difflib.get_close_matches(str(name), known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"`{argument}` (={name!r}) must be one of {list(known)}{hint}")


def _check_gains(white_balance: Gains, images: torch.Tensor) -> torch.Tensor:
    """Gains of the four planes, the smallest 1, as (B, 4, 1, 1)."""
    gains = torch.as_tensor(white_balance, dtype=torch.float32, device=images.device)
    if gains.shape not in ((3,), (len(images), 3)):
        raise ValueError(
            f"`white_balance` (shape {tuple(gains.shape)}) must be (3,) or ({len(images)}, 3)"
        )
    if not bool((torch.isfinite(gains) & (gains > 0)).all()):
        raise ValueError(f"`white_balance` (={gains.tolist()}) must be positive and finite")
    gains = (gains / gains.amin(dim=-1, keepdim=True)).clamp_(max=_LARGEST_GAIN)
    return gains[..., [0, 1, 1, 2]].expand(len(images), 4)[..., None, None]


def _balance(images: torch.Tensor, gains: torch.Tensor) -> torch.Tensor:
    # No sensor goes below -1; the bound keeps infinities out of the sums that follow.
    return torch.mul(images, gains).clamp_(-1.0, 1.0)


def _finish(rgb: torch.Tensor, colour_matrix: Matrix | None, tone: str) -> torch.Tensor:
    """White-balanced camera RGB (B, 3, H, W) to encoded sRGB in [0, 1]."""
    linear = rgb
    if colour_matrix is not None:
        red, green, blue = rgb.unbind(dim=1)
        linear = torch.empty_like(rgb)
        # Spelled out: as a matrix product a GPU may round it to TF32.
        for channel, (r, g, b) in enumerate(srgb_from_camera(colour_matrix).tolist()):
            linear[:, channel] = (red * r).add_(green, alpha=g).add_(blue, alpha=b)
    return srgb_encode(apply_tone(linear.clamp_(0.0, 1.0), tone))
