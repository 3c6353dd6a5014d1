"""Two U-Nets, for the noise and for the aperture, each in two variants.

``"paper"``: that of Brooks et al. (2019) and the attention U-Net, as the paper describes them.
``"ncs"``: those of the code that the paper's authors released, layer by layer. docs/networks.md
lists the differences. Both variants take maps of any size, down to 1 x 1.
"""

import functools
from collections.abc import Sequence
from typing import Literal, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from simulator.utils.checks import check_word

Variant = Literal["paper", "ncs"]
#: Channels of each level, finest first.
WIDTHS: dict[Variant, tuple[int, ...]] = {
    "paper": (32, 64, 128, 256, 512),
    "ncs": (64, 128, 256, 512, 512),
}
ATTENTION_WIDTHS = (32, 64, 128, 256, 512)
#: Slope of every LeakyReLU below zero.
LEAK = 0.2
#: A map that deviates less than this (relative to its mean where that exceeds one) is flat.
FLAT = 1e-5
#: The paper's variant counts f-numbers in units of this one, so that they are of order one. It only
#: rescales the learnt w_s and w_m.
F_NUMBER_UNIT = 8.0
#: The authors' pictures have sizes that are multiples of this: they are halved four times.
MULTIPLE = 16
#: f/22 is this many whole stops below f/1.
_STOPS_OF_F22 = 9


def _left(variant: Variant, widths: tuple[int, ...]) -> tuple[int, ...]:
    """Channels per level on the way up, coarsest first: the paper's, or one level finer in ncs."""
    return widths[-2::-1] if variant == "paper" else (*widths[-3::-1], widths[0])


#: Max-pool of 2 x 2 that keeps the last row and column of odd sizes: 5 -> 3, 1 -> 1.
_halve = functools.partial(F.max_pool2d, kernel_size=2, ceil_mode=True)
_resize = functools.partial(F.interpolate, mode="bilinear", align_corners=False)


def padded(image: Tensor, multiple: int) -> Tensor:
    """`image` (B, C, H, W), its last row and column repeated up to a multiple of pixels."""
    height, width = image.shape[-2:]
    return F.pad(image, (0, -width % multiple, 0, -height % multiple), mode="replicate")


def convolution(inputs: int, outputs: int, *, bias: bool = True) -> nn.Conv2d:
    """3 x 3, size-preserving, borders replicated: a black frame is no part of any scene."""
    layer = nn.Conv2d(inputs, outputs, 3, padding=1, padding_mode="replicate", bias=bias)
    nn.init.kaiming_normal_(layer.weight, a=LEAK)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer


def instance_norm(x: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
    """``scale * (x - mean(x)) / sqrt(var(x) + 1e-5) + shift``, over the pixels of each map.

    A flat map, and so every 1 x 1 map, becomes exactly `shift`. Convolutions leave deviations of
    1e-7 in a flat image; each normalisation would multiply them by up to 300,
    and after three layers they would be the image. Deviations below `FLAT` are that rounding.
    `x` is (B, C, H, W), `scale` and `shift` are (B, C); statistics are at least float32.

    >>> flat = torch.full((1, 1, 3, 3), 0.1)
    >>> instance_norm(flat, torch.ones(1, 1), torch.full((1, 1), 0.25)).unique().item()
    0.25
    """
    wide = torch.promote_types(x.dtype, torch.float32)
    mean = x.mean(dim=(2, 3), keepdim=True, dtype=wide)
    centred = x - mean
    variance = centred.square().mean(dim=(2, 3), keepdim=True)
    varies = variance > FLAT**2 * (1.0 + mean.square())
    gain = scale.to(wide)[:, :, None, None] * torch.rsqrt(variance + 1e-5) * varies
    return torch.addcmul(shift.to(wide)[:, :, None, None], centred, gain).to(x.dtype)


def _level(inputs: int, outputs: int, variant: Variant) -> nn.Sequential:
    """Two convolutions with LeakyReLU; or, borders zero, with batch normalisation and ReLU."""
    layers: list[nn.Module] = []
    for channels in (inputs, outputs):
        if variant == "paper":
            layers += [convolution(channels, outputs), nn.LeakyReLU(LEAK)]
        else:
            plain = nn.Conv2d(channels, outputs, 3, padding=1)
            layers += [plain, nn.BatchNorm2d(outputs), nn.ReLU()]
    return nn.Sequential(*layers)


class UNet(nn.Module):
    """Predicts the residual that takes the noise out of a packed raw.

    ``"paper"``: two 3 x 3 convolutions with LeakyReLU(0.2) a level, max-pooling on the way down,
    bilinear upsampling and concatenated skips on the way up, a last 3 x 3 convolution without
    activation; 7.85 M parameters at the default widths. ``"ncs"``: batch normalisation after each
    convolution, zero borders, a last 1 x 1 convolution; 13.4 M. Use it in evaluation mode: in
    training mode the normalisation takes its statistics from the batch.

    Args:
        variant: ``"paper"`` or ``"ncs"``.
        widths: Channels of each level, finest first, two or more (ncs: five); default: `WIDTHS`.

    Source: Brooks et al. 2019, Unprocessing Images for Learned Raw Denoising. Two things differ
    from what its authors released: two convolutions a level, not three, and replicated borders.

    >>> UNet(widths=(4, 8))(torch.zeros(1, 8, 5, 3)).shape
    torch.Size([1, 4, 5, 3])
    """

    def __init__(self, variant: Variant = "paper", *, widths: Sequence[int] | None = None) -> None:
        super().__init__()
        check_word("variant", variant, get_args(Variant))
        widths = WIDTHS[variant] if widths is None else tuple(widths)
        self.variant, left = variant, _left(variant, widths)
        self.encoder = nn.ModuleList(
            _level(previous, width, variant)
            for previous, width in zip((8, *widths), widths, strict=False)
        )
        skips, below = widths[-2::-1], (widths[-1], *left[:-1])
        self.decoder = nn.ModuleList(
            _level(skip + coarse, width, variant)
            for skip, coarse, width in zip(skips, below, left, strict=True)
        )
        if variant == "paper":
            self.tail = convolution(widths[0], 4)
            with torch.no_grad():
                self.tail.weight.mul_(0.1)  # starts near "no change"
        else:
            self.tail = nn.Conv2d(widths[0], 4, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Residual (B, 4, H, W) of a raw, to be added to it.

        `x` is (B, 8, H, W), any H, W >= 1: the raw and its noise-level map, or for ``"ncs"`` the
        raw and the same with a sample of its noise.
        """
        paper, (height, width) = self.variant == "paper", x.shape[-2:]
        x = x if paper else padded(x, MULTIPLE)
        skips: list[Tensor] = []
        for level in self.encoder:
            x = level(_halve(x) if skips else x)
            skips.append(x)
        skips.pop()
        for level in self.decoder:
            skip = skips.pop()
            if paper:
                x = level(torch.cat([_resize(x, skip.shape[-2:]), skip], dim=1))
            else:
                x = F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=True)
                x = level(torch.cat([skip, x], dim=1))
        return self.tail(x)[..., :height, :width]


# -- the attention U-Net --------------------------------------------------------------------------


def light_of_aperture(f_number: Tensor) -> Tensor:
    """The number that stands for an f-number in the authors' code: 1 at f/22, twice that a stop.

    Thirds of stops go linearly between: 1, 4/3, 5/3, 2.

    >>> light = light_of_aperture(torch.tensor([2.0 ** (9 / 2), 2.0 ** (26 / 6), 4.0]))
    >>> [round(value, 5) for value in light.tolist()]
    [1.0, 1.33333, 32.0]
    """
    stops = _STOPS_OF_F22 - 2.0 * f_number.double().log2()
    whole = (stops + 1e-9).floor()  # rounding must not take a whole stop for the one below
    return (torch.exp2(whole) * (1.0 + stops - whole)).to(f_number.dtype)


class ApertureNorm(nn.Module):
    """Adaptive aperture normalisation.

    ``A(x) = (w_s [n1, n2] + b_s) * (x - mean(x)) / std(x) + (w_m [n1, n2] + b_m)``, per channel,
    mean and deviation over the map. The paper's variant starts at b_s = 1, b_m = 0.
    """

    def __init__(self, width: int, variant: Variant = "paper") -> None:
        super().__init__()
        self.affine = nn.Linear(2, 2 * width)  # w_s and w_m, b_s and b_m
        if variant == "paper":
            nn.init.xavier_normal_(self.affine.weight)
            with torch.no_grad():
                self.affine.bias[:width] = 1.0
                self.affine.bias[width:] = 0.0

    def forward(self, x: Tensor, aperture: Tensor) -> Tensor:
        """(B, C, H, W) with the apertures of source and target (B, 2), to the same shape."""
        scale, shift = self.affine(aperture).chunk(2, dim=1)
        return instance_norm(x, scale, shift)


class NormalisedConvolution(nn.Module):
    """Convolution and aperture normalisation.

    The paper's has no bias, as the normalisation cancels it, and replicated borders; the authors'
    weights have one, and borders are zero. `kernel` is 3 or 1.
    """

    def __init__(
        self, inputs: int, outputs: int, *, kernel: int = 3, variant: Variant = "paper"
    ) -> None:
        super().__init__()
        paper = variant == "paper"
        if kernel == 3 and paper:
            self.convolution = convolution(inputs, outputs, bias=False)
        else:
            self.convolution = nn.Conv2d(
                inputs, outputs, kernel, padding=kernel // 2, bias=not paper
            )
        self.norm = ApertureNorm(outputs, variant)

    def forward(self, x: Tensor, aperture: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, outputs, H, W)."""
        return self.norm(self.convolution(x), aperture)


class _ApertureLevel(nn.Module):
    """Two convolutions, each with `ApertureNorm` and ReLU."""

    def __init__(self, inputs: int, outputs: int, variant: Variant) -> None:
        super().__init__()
        self.first = NormalisedConvolution(inputs, outputs, variant=variant)
        self.second = NormalisedConvolution(outputs, outputs, variant=variant)

    def forward(self, x: Tensor, aperture: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, outputs, H, W)."""
        return F.relu(self.second(F.relu(self.first(x, aperture)), aperture))


class SkipAttention(nn.Module):
    """Rescales a skip connection in space and over channels: ``F * beta_s * beta_c``.

    beta_s is one map, from the skip and the gating signal of the coarser level. beta_c is the
    excitation of a global average of ``A(skip) + A(gate)``. The average of a normalised map is
    zero, so that of A is ``w_m [n1, n2] + b_m`` whatever the image, the convolution in front and
    the scale; the sum of the two is again one linear function of the f-numbers. In the paper's
    variant only this function is computed, and learnt; the released one computes the maps.
    """

    def __init__(self, width: int, inner: int, variant: Variant = "paper") -> None:
        super().__init__()
        point = functools.partial(NormalisedConvolution, kernel=1, variant=variant)
        self.from_skip, self.from_gate = point(width, inner), point(width, inner)
        self.to_map = point(inner, 1)
        if variant == "paper":
            reduced = max(width // 4, 1)
            self.average = nn.Linear(2, width)  # w_m and b_m of both branches, added
            self.excite = nn.Sequential(
                nn.Linear(width, reduced), nn.ReLU(), nn.Linear(reduced, width), nn.Sigmoid()
            )
            nn.init.xavier_normal_(self.average.weight)
            nn.init.zeros_(self.average.bias)
            nn.init.ones_(self.excite[0].bias)  # type: ignore[arg-type]  # no unit starts dead
        else:
            reduced = max(inner // 4, 1)
            self.mean_skip, self.mean_gate = point(width, inner), point(width, inner)
            self.excite = nn.Sequential(
                nn.Conv2d(inner, reduced, 1, bias=False),
                nn.ReLU(),
                nn.Conv2d(reduced, width, 1, bias=False),
                nn.Sigmoid(),
            )
        self.variant = variant

    def forward(self, skip: Tensor, gate: Tensor, aperture: Tensor) -> Tensor:
        """(B, C, H, W), (B, C, H, W) and apertures (B, 2), to the rescaled skip."""
        if self.variant == "paper":
            channels = self.channel_attention(aperture)[:, :, None, None]
        else:
            mean = self.mean_gate(gate, aperture) + self.mean_skip(skip, aperture)
            channels = self.excite(mean.mean(dim=(2, 3), keepdim=True))
        return skip * self.spatial_attention(skip, gate, aperture) * channels

    def spatial_attention(self, skip: Tensor, gate: Tensor, aperture: Tensor) -> Tensor:
        """beta_s in (0, 1), (B, 1, H, W)."""
        joint = F.relu(self.from_skip(skip, aperture) + self.from_gate(gate, aperture))
        return torch.sigmoid(self.to_map(joint, aperture))

    def channel_attention(self, aperture: Tensor) -> Tensor:
        """The paper's beta_c in (0, 1), (B, C), from the f-numbers (B, 2) alone."""
        return self.excite(self.average(aperture))


class AttentionUNet(nn.Module):
    """Predicts the residual that a wider aperture's defocus adds to a packed raw.

    A U-Net of two 3 x 3 convolutions a level, each followed by `ApertureNorm` and ReLU;
    upsampling, a convolution, and skips rescaled by `SkipAttention` on the way up; a last 1 x 1
    convolution. The apertures enter every normalisation and, as in the paper, as two planes
    beside the image; being constant, these cancel in the first normalisation as a bias would.
    A constant image has a constant residual, which depends on the apertures only. Run it in
    float32: so many normalisations in a row multiply differences, and bfloat16's rounding grows to
    half the residual of a new network.

    ``"paper"``: f-numbers, bilinear upsampling, replicated borders; 8.78 M parameters at the
    default widths. ``"ncs"``: `light_of_aperture`, nearest-neighbour upsampling, zero borders;
    8.85 M.

    Args:
        variant: ``"paper"`` or ``"ncs"``.
        widths: Channels of each level, finest first, two levels or more (ncs: five), each >= 1.

    Source: Ouyang et al. 2021, Neural Camera Simulators, section 3.3; its figure's unstated sizes
    as in Oktay et al. 2018, Attention U-Net (half the channels inside the spatial attention).

    >>> net = AttentionUNet(widths=(4, 8))
    >>> net(torch.zeros(1, 4, 5, 3), torch.tensor([[11.0, 4.0]])).shape
    torch.Size([1, 4, 5, 3])
    """

    def __init__(
        self, variant: Variant = "paper", *, widths: Sequence[int] = ATTENTION_WIDTHS
    ) -> None:
        super().__init__()
        check_word("variant", variant, get_args(Variant))
        self.variant, widths = variant, tuple(widths)
        fine, coarse = widths[-2::-1], widths[:0:-1]
        # Released: inside the attention of the finest level there are as many as outside.
        inner = _left(variant, widths) if variant == "ncs" else [max(f // 2, 1) for f in fine]
        self.encoder = nn.ModuleList(
            _ApertureLevel(previous, width, variant)
            for previous, width in zip((6, *widths), widths, strict=False)
        )
        self.upward = nn.ModuleList(
            NormalisedConvolution(c, f, variant=variant) for f, c in zip(fine, coarse, strict=True)
        )
        self.attention = nn.ModuleList(
            SkipAttention(f, i, variant) for f, i in zip(fine, inner, strict=True)
        )
        self.decoder = nn.ModuleList(_ApertureLevel(2 * f, f, variant) for f in fine)
        self.tail = nn.Conv2d(widths[0], 4, 1)
        if variant == "paper":
            with torch.no_grad():
                self.tail.weight.mul_(0.1)  # starts near "no change"
                self.tail.bias.zero_()  # type: ignore[union-attr]

    def forward(self, image: Tensor, f_numbers: Tensor) -> Tensor:
        """Residual (B, 4, H, W) of an image (B, 4, H, W) of order one, to be added to it.

        `f_numbers` (B, 2) are the effective ones of source and target, in [0.5, 1024].
        """
        paper, (height, width) = self.variant == "paper", image.shape[-2:]
        x = image if paper else padded(image, MULTIPLE)
        if paper:
            aperture = f_numbers.to(image) / F_NUMBER_UNIT
        else:
            aperture = light_of_aperture(f_numbers).to(image)
        x = torch.cat([x, aperture[:, :, None, None].expand(-1, -1, *x.shape[-2:])], dim=1)
        skips: list[Tensor] = []
        for level in self.encoder:
            x = level(_halve(x) if skips else x, aperture)
            skips.append(x)
        skips.pop()
        for upward, attention, level in zip(self.upward, self.attention, self.decoder, strict=True):
            skip = skips.pop()
            if paper:
                x = _resize(x, skip.shape[-2:])
            else:
                x = F.interpolate(x, scale_factor=2.0, mode="nearest")
            x = F.relu(upward(x, aperture))
            x = level(torch.cat([attention(skip, x, aperture), x], dim=1), aperture)
        return self.tail(x)[..., :height, :width]
