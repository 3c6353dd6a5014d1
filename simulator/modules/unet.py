"""The U-Net of Brooks et al. (2019), the network of the noise module's preset `paper`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

#: Slope of every LeakyReLU below zero.
LEAK = 0.2


def check_widths(widths: Sequence[int]) -> tuple[int, ...]:
    """`widths` as a tuple; ValueError unless it names the channels of two or more levels."""
    checked = tuple(widths)
    if len(checked) < 2 or not all(isinstance(w, int) and w >= 1 for w in checked):
        raise ValueError(f"`widths` (={widths!r}) must be two or more integers >= 1")
    return checked


def halve(x: Tensor) -> Tensor:
    """Max-pool of 2 x 2 that keeps the last row and column of odd sizes: 5 -> 3, 1 -> 1."""
    return F.max_pool2d(x, 2, ceil_mode=True)


def resize_to(x: Tensor, skip: Tensor) -> Tensor:
    """`x` bilinearly enlarged to the height and width of `skip`, whatever they are."""
    return F.interpolate(x, size=skip.shape[-2:], mode="bilinear", align_corners=False)


def convolution(inputs: int, outputs: int, *, bias: bool = True) -> nn.Conv2d:
    """3 x 3, size-preserving, borders replicated: a black frame is no part of any scene."""
    layer = nn.Conv2d(inputs, outputs, 3, padding=1, padding_mode="replicate", bias=bias)
    nn.init.kaiming_normal_(layer.weight, a=LEAK)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer


def _level(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        convolution(inputs, outputs),
        nn.LeakyReLU(LEAK),
        convolution(outputs, outputs),
        nn.LeakyReLU(LEAK),
    )


class UNet(nn.Module):
    """Predicts the residual that takes the noise out of a packed raw.

    Two 3 x 3 convolutions with LeakyReLU(0.2) a level, max-pooling on the way down, bilinear
    upsampling and concatenated skips on the way up, a last 3 x 3 convolution without activation.
    7.85 M parameters at the default widths. Initialised by the global generator: seed it with
    `torch.manual_seed` for the same network again.

    Args:
        widths: Channels of each level, finest first, two levels or more, each >= 1.
        inputs: Input planes, >= 1: the raw's four and the four of its noise-level map.
        outputs: Output planes, >= 1.

    Raises:
        ValueError: If `widths` has fewer than two levels or a channel count below one.

    Source: Brooks et al. 2019, Unprocessing Images for Learned Raw Denoising. Two things differ
    from what its authors released: two convolutions a level, not three, and replicated borders.

    >>> UNet(widths=(4, 8))(torch.zeros(1, 8, 5, 3)).shape
    torch.Size([1, 4, 5, 3])
    """

    def __init__(
        self,
        *,
        widths: Sequence[int] = (32, 64, 128, 256, 512),
        inputs: int = 8,
        outputs: int = 4,
    ) -> None:
        super().__init__()
        widths = check_widths(widths)
        self.encoder = nn.ModuleList(
            _level(previous, width)
            for previous, width in zip((inputs, *widths), widths, strict=False)
        )
        self.decoder = nn.ModuleList(
            _level(coarse + fine, fine)
            for fine, coarse in zip(widths[-2::-1], widths[:0:-1], strict=True)
        )
        self.tail = convolution(widths[0], outputs)
        with torch.no_grad():
            self.tail.weight.mul_(0.1)  # starts near "no change"

    def forward(self, x: Tensor) -> Tensor:
        """Residual of a raw.

        Args:
            x: (B, 8, H, W), raw and noise-level map, any H, W >= 1.

        Returns:
            (B, 4, H, W), to be added to the raw.
        """
        skips: list[Tensor] = []
        for level in self.encoder:
            x = level(halve(x) if skips else x)
            skips.append(x)
        skips.pop()
        for level in self.decoder:
            skip = skips.pop()
            x = level(torch.cat([resize_to(x, skip), skip], dim=1))
        return self.tail(x)
