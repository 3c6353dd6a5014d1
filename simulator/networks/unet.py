"""Two U-Nets: that of Brooks et al. (2019) for the noise, and the attention U-Net for the aperture.

Both are networks of the preset `paper`. Their layers take maps of any size, down to 1 x 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

#: Slope of every LeakyReLU below zero.
LEAK = 0.2
#: A map that deviates less than this (relative to its mean where that exceeds one) is flat.
FLAT = 1e-5
#: The attention U-Net counts f-numbers in units of this one, so that they are of order one. It only
#: rescales the learnt w_s and w_m.
F_NUMBER_UNIT = 8.0


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


def instance_norm(x: Tensor, scale: Tensor, shift: Tensor, eps: float = 1e-5) -> Tensor:
    """``scale * (x - mean(x)) / sqrt(var(x) + eps) + shift``, over the pixels of each map.

    A flat map, and so every 1 x 1 map, becomes exactly `shift`. Convolutions leave deviations of
    1e-7 in a flat image; each normalisation would multiply them by up to ``1 / sqrt(eps)`` = 300,
    and after three layers they would be the image. Deviations below `FLAT` are that rounding.

    Args:
        x: (B, C, H, W), any H, W >= 1.
        scale: (B, C), of each sample and channel.
        shift: (B, C).
        eps: Added to the variance, which is the biased one, > 0.

    Returns:
        (B, C, H, W), the dtype of `x`; statistics are at least float32.

    >>> flat = torch.full((1, 1, 3, 3), 0.1)
    >>> instance_norm(flat, torch.ones(1, 1), torch.full((1, 1), 0.25)).unique().item()
    0.25
    """
    wide = torch.promote_types(x.dtype, torch.float32)
    mean = x.mean(dim=(2, 3), keepdim=True, dtype=wide)
    centred = x - mean
    variance = centred.square().mean(dim=(2, 3), keepdim=True)
    varies = variance > FLAT**2 * (1.0 + mean.square())
    gain = scale.to(wide)[:, :, None, None] * torch.rsqrt(variance + eps) * varies
    return torch.addcmul(shift.to(wide)[:, :, None, None], centred, gain).to(x.dtype)


def _level(inputs: int, outputs: int) -> nn.Sequential:
    """Two convolutions, each with LeakyReLU."""
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
    7.85 M parameters at the default widths. The weights are drawn from torch's global generator.

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
        residual: Tensor = self.tail(x)
        return residual


class ApertureNorm(nn.Module):
    """Adaptive aperture normalisation.

    ``A(x) = (w_s [n1, n2] + b_s) * (x - mean(x)) / std(x) + (w_m [n1, n2] + b_m)``, per channel,
    mean and deviation over the map. Starts at b_s = 1, b_m = 0.

    Args:
        width: Channels, >= 1.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.affine = nn.Linear(2, 2 * width)  # w_s and w_m, b_s and b_m
        nn.init.xavier_normal_(self.affine.weight)
        with torch.no_grad():
            self.affine.bias[:width] = 1.0
            self.affine.bias[width:] = 0.0

    def forward(self, x: Tensor, aperture: Tensor) -> Tensor:
        """(B, C, H, W) with f-numbers (B, 2) in units of `F_NUMBER_UNIT`, to the same shape."""
        scale, shift = self.affine(aperture).chunk(2, dim=1)
        return instance_norm(x, scale, shift)


class NormalisedConvolution(nn.Module):
    """Convolution and aperture normalisation; no bias, the normalisation would cancel it.

    Args:
        inputs: Input channels, >= 1.
        outputs: Output channels, >= 1.
        kernel: 3 for a 3 x 3 convolution with replicated borders, 1 for 1 x 1.
    """

    def __init__(self, inputs: int, outputs: int, *, kernel: int = 3) -> None:
        super().__init__()
        if kernel == 3:
            self.convolution = convolution(inputs, outputs, bias=False)
        else:
            self.convolution = nn.Conv2d(inputs, outputs, kernel, bias=False)
        self.norm = ApertureNorm(outputs)

    def forward(self, x: Tensor, aperture: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, outputs, H, W)."""
        result: Tensor = self.norm(self.convolution(x), aperture)
        return result


class _ApertureLevel(nn.Module):
    """Two convolutions, each with `ApertureNorm` and ReLU."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = NormalisedConvolution(inputs, outputs)
        self.second = NormalisedConvolution(outputs, outputs)

    def forward(self, x: Tensor, aperture: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, outputs, H, W)."""
        return F.relu(self.second(F.relu(self.first(x, aperture)), aperture))


class SkipAttention(nn.Module):
    """Rescales a skip connection in space and over channels: ``F * beta_s * beta_c``.

    beta_s is one map, from the skip and the gating signal of the coarser level. beta_c is the
    excitation of a global average of ``A(skip) + A(gate)``. The average of a normalised map is
    zero, so that of A is ``w_m [n1, n2] + b_m`` whatever the image, the convolution in front and
    the scale; the sum of the two is again one linear function of the f-numbers. Only this function
    is computed, and learnt, here.

    Args:
        width: Channels of skip and of gate, >= 1.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        inner, reduced = max(width // 2, 1), max(width // 4, 1)
        self.from_skip = NormalisedConvolution(width, inner, kernel=1)
        self.from_gate = NormalisedConvolution(width, inner, kernel=1)
        self.to_map = NormalisedConvolution(inner, 1, kernel=1)
        self.average = nn.Linear(2, width)  # w_m and b_m of both branches, added
        self.excite = nn.Sequential(
            nn.Linear(width, reduced), nn.ReLU(), nn.Linear(reduced, width), nn.Sigmoid()
        )
        nn.init.xavier_normal_(self.average.weight)
        nn.init.zeros_(self.average.bias)
        nn.init.ones_(self.excite[0].bias)  # type: ignore[arg-type]  # else units may start dead

    def forward(self, skip: Tensor, gate: Tensor, aperture: Tensor) -> Tensor:
        """(B, C, H, W), (B, C, H, W) and f-numbers (B, 2), to the rescaled skip."""
        channels = self.channel_attention(aperture)[:, :, None, None]
        return skip * self.spatial_attention(skip, gate, aperture) * channels

    def spatial_attention(self, skip: Tensor, gate: Tensor, aperture: Tensor) -> Tensor:
        """beta_s in (0, 1), (B, 1, H, W)."""
        joint = F.relu(self.from_skip(skip, aperture) + self.from_gate(gate, aperture))
        return torch.sigmoid(self.to_map(joint, aperture))

    def channel_attention(self, aperture: Tensor) -> Tensor:
        """beta_c in (0, 1), (B, C), from the f-numbers (B, 2) alone."""
        result: Tensor = self.excite(self.average(aperture))
        return result


class AttentionUNet(nn.Module):
    """Predicts the residual that a wider aperture's defocus adds to a packed raw.

    A U-Net of two 3 x 3 convolutions a level, each followed by `ApertureNorm` and ReLU; bilinear
    upsampling, a convolution, and skips rescaled by `SkipAttention` on the way up; a last 1 x 1
    convolution. The f-numbers enter every normalisation and, as in the paper, as two planes
    beside the image; being constant, these cancel in the first normalisation as a bias would.
    8.78 M parameters at the default widths. A constant image has a constant residual, which
    depends on the f-numbers only. Run it in float32: so many normalisations in a row multiply
    differences, and bfloat16's rounding grows to half the residual of a new network. The weights
    are drawn from torch's global generator.

    Args:
        widths: Channels of each level, finest first, two levels or more, each >= 1.

    Raises:
        ValueError: If `widths` has fewer than two levels or a channel count below one.

    Source: Ouyang et al. 2021, Neural Camera Simulators, section 3.3; its figure's unstated sizes
    as in Oktay et al. 2018, Attention U-Net (half the channels inside the spatial attention).

    >>> net = AttentionUNet(widths=(4, 8))
    >>> net(torch.zeros(1, 4, 5, 3), torch.tensor([[11.0, 4.0]])).shape
    torch.Size([1, 4, 5, 3])
    """

    def __init__(self, *, widths: Sequence[int] = (32, 64, 128, 256, 512)) -> None:
        super().__init__()
        widths = check_widths(widths)
        fine, coarse = widths[-2::-1], widths[:0:-1]
        self.encoder = nn.ModuleList(
            _ApertureLevel(previous, width)
            for previous, width in zip((6, *widths), widths, strict=False)
        )
        self.upward = nn.ModuleList(
            NormalisedConvolution(c, f) for f, c in zip(fine, coarse, strict=True)
        )
        self.attention = nn.ModuleList(SkipAttention(f) for f in fine)
        self.decoder = nn.ModuleList(_ApertureLevel(2 * f, f) for f in fine)
        self.tail = nn.Conv2d(widths[0], 4, 1)
        with torch.no_grad():
            self.tail.weight.mul_(0.1)  # starts near "no change"
            self.tail.bias.zero_()  # type: ignore[union-attr]

    def forward(self, image: Tensor, f_numbers: Tensor) -> Tensor:
        """Residual of an image.

        Args:
            image: (B, 4, H, W), any H, W >= 1, of order one.
            f_numbers: (B, 2), source's and target's, in [0.5, 1024].

        Returns:
            (B, 4, H, W), to be added to the image.

        Raises:
            ValueError: If `f_numbers` is not a pair for each image.
        """
        batch, _, height, width = image.shape
        if f_numbers.shape != (batch, 2):
            shape = tuple(f_numbers.shape)
            raise ValueError(f"`f_numbers` (of shape {shape}) must have shape ({batch}, 2)")
        aperture = f_numbers.to(image) / F_NUMBER_UNIT
        x = torch.cat([image, aperture[:, :, None, None].expand(-1, -1, height, width)], dim=1)
        skips: list[Tensor] = []
        for level in self.encoder:
            x = level(halve(x) if skips else x, aperture)
            skips.append(x)
        skips.pop()
        for upward, attention, level in zip(self.upward, self.attention, self.decoder, strict=True):
            skip = skips.pop()
            x = F.relu(upward(resize_to(x, skip), aperture))
            x = level(torch.cat([attention(skip, x, aperture), x], dim=1), aperture)
        residual: Tensor = self.tail(x)
        return residual
