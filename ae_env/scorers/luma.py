"""Luma, luminance and gradients of developed pictures, which several scorers share."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch.nn.functional import pad

#: R, G, B shares of luma (ITU-R BT.601), of gamma-encoded values: an 8-bit camera's grey.
LUMA_SHARES = (0.299, 0.587, 0.114)
#: R, G, B shares of CIE Y (IEC 61966-2-1), of linear sRGB.
LUMINANCE_SHARES = (0.2126, 0.7152, 0.0722)
#: Weight of the middle and of each side in one direction of a gradient filter, and of all together.
SOBEL = (2.0, 1.0)
SCHARR = (10.0, 3.0)
#: Samples that `by_parts` gives to a function at a time.
_PART = 2**18


def luma_of(images: torch.Tensor) -> torch.Tensor:
    """Luma (B, H, W) in [0, 1] of gamma-encoded sRGB `images` (B, 3, H, W) in [0, 1].

    >>> luma_of(torch.ones(1, 3, 1, 1)).item()
    1.0
    """
    red, green, blue = images.unbind(dim=1)
    r, g, b = LUMA_SHARES
    return (red * r).add_(green, alpha=g).add_(blue, alpha=b).clamp_(0.0, 1.0)


def srgb_decode(encoded: torch.Tensor) -> torch.Tensor:
    """sRGB values in [0, 1] to linear light in [0, 1] (IEC 61966-2-1).

    >>> round(srgb_decode(torch.tensor([0.4614])).item(), 3)
    0.18
    """
    toe = encoded.mul(1.0 / 12.92).sub_(0.04045 / 12.92).clamp_(max=0.0)  # 0 above it
    curved = encoded.clamp(min=0.04045).add_(0.055).mul_(1.0 / 1.055).log2_().mul_(2.4).exp2_()
    return curved.add_(toe).clamp_(min=0.0)


def luminance_of(images: torch.Tensor) -> torch.Tensor:
    """Linear CIE Y (B, H, W) in [0, 1], 1 is white, of sRGB `images` (B, 3, H, W) in [0, 1]."""
    return by_parts(_luminance, images)


def _luminance(images: torch.Tensor) -> torch.Tensor:
    red, green, blue = srgb_decode(images).unbind(dim=1)
    r, g, b = LUMINANCE_SHARES
    return (red * r).add_(green, alpha=g).add_(blue, alpha=b)


def by_parts(
    function: Callable[[torch.Tensor], torch.Tensor], images: torch.Tensor
) -> torch.Tensor:
    """`function` of a few `images` (B, ...) at a time, as one batch.

    They stay in the CPU's cache: several times as fast where a function takes many steps.
    """
    step = len(images)
    if images.device.type == "cpu":
        step = max(1, _PART // max(1, images[0].numel()))
    return torch.cat([function(part) for part in images.split(step)])  # type: ignore[no-untyped-call]


def squared_gradient(luma: torch.Tensor, weights: tuple[float, float]) -> torch.Tensor:
    """gx^2 + gy^2 (B, H, W) of 3 x 3 difference filters, borders repeated.

    Args:
        luma: (B, H, W), any range.
        weights: Weight of the middle row (column) and of the two beside it, such as `SOBEL`. The
            filters are not normalised: a step of 1 gives ``middle + 2 * side``.
    """
    middle, side = weights
    padded = pad(luma[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    across = padded[:, :, 2:] - padded[:, :, :-2]  # (B, H + 2, W)
    gx = (across[:, :-2] + across[:, 2:]).mul_(side).add_(across[:, 1:-1], alpha=middle)
    down = padded[:, 2:] - padded[:, :-2]  # (B, H, W + 2)
    gy = (down[:, :, :-2] + down[:, :, 2:]).mul_(side).add_(down[:, :, 1:-1], alpha=middle)
    return gx.square_().add_(gy.square_())


def check_luma(luma: torch.Tensor) -> torch.Tensor:
    """`luma` as it is.

    Raises:
        ValueError: Unless it is a floating point tensor (B, H, W) with pixels.
    """
    if not torch.is_tensor(luma) or luma.ndim != 3 or not luma.is_floating_point():
        what = f"{tuple(luma.shape)} {luma.dtype}" if torch.is_tensor(luma) else repr(luma)
        raise ValueError(f"`luma` (={what}) must be a floating point tensor (B, H, W)")
    if min(luma.shape[1:]) < 1:
        raise ValueError(f"`luma` (shape {tuple(luma.shape)}) must have pixels")
    return luma
