"""The two U-Nets of the code that the paper's authors released, which are not quite the paper's.

Both are networks of the preset `ncs`, whose weights `ae-env import-weights ncs` brings in. Layers,
widths and arithmetic are the authors'; names and the order of planes are ours, as
`simulator.networks.authors_weights` translates them. What they differ in from the paper is listed
in docs/networks.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from simulator.networks.unet import instance_norm

#: Both networks halve the picture four times, so height and width must be multiples of this.
MULTIPLE = 16
#: Channels of each level, finest first; the U-Net's two coarsest have the same.
UNET_WIDTHS = (64, 128, 256, 512, 512)
ATTENTION_WIDTHS = (32, 64, 128, 256, 512)
#: f/22 is this many whole stops below f/1.
_STOPS_OF_F22 = 9


def padded(image: Tensor) -> Tensor:
    """`image` (B, C, H, W), its last row and column repeated up to a multiple of `MULTIPLE`.

    The authors' pictures have such sizes; their attention U-Net refuses others.
    """
    height, width = image.shape[-2:]
    return F.pad(image, (0, -width % MULTIPLE, 0, -height % MULTIPLE), mode="replicate")


def light_of_aperture(f_number: Tensor) -> Tensor:
    """The number that stands for an f-number in the authors' code: 1 at f/22, twice that a stop.

    Thirds of stops go linearly between: 1, 4/3, 5/3, 2.

    Args:
        f_number: (B,) effective f-numbers, such as sqrt(2) ** 9 for f/22.

    >>> light = light_of_aperture(torch.tensor([2.0 ** (9 / 2), 2.0 ** (26 / 6), 4.0]))
    >>> [round(value, 5) for value in light.tolist()]
    [1.0, 1.33333, 32.0]
    """
    stops = _STOPS_OF_F22 - 2.0 * f_number.double().log2()
    whole = (stops + 1e-9).floor()  # rounding must not take a whole stop for the one below
    return (torch.exp2(whole) * (1.0 + stops - whole)).to(f_number.dtype)


def _convolutions(inputs: int, outputs: int) -> nn.Sequential:
    """Two 3 x 3 convolutions with batch normalisation and ReLU, borders zero."""
    layers: list[nn.Module] = []
    for channels in (inputs, outputs):
        layers += [
            nn.Conv2d(channels, outputs, 3, padding=1),
            nn.BatchNorm2d(outputs),
            nn.ReLU(),
        ]
    return nn.Sequential(*layers)


class NcsUNet(nn.Module):
    """Predicts the residual that takes the noise out of a packed raw; 13.4 M parameters.

    Batch normalisation after each of two convolutions a level, bilinear upsampling without
    convolution, a last 1 x 1 convolution. Use it in evaluation mode: in training mode the
    normalisation takes its statistics from the batch.

    Args:
        widths: Channels of each level, finest first, five levels of one channel or more.

    >>> NcsUNet(widths=(4, 8, 8, 8, 8)).eval()(torch.zeros(1, 8, 5, 3)).shape
    torch.Size([1, 4, 5, 3])
    """

    def __init__(self, *, widths: Sequence[int] = UNET_WIDTHS) -> None:
        super().__init__()
        # Going up, a level leaves as many channels as the next one expects from below.
        below = (*widths[-3::-1], widths[0])
        self.encoder = nn.ModuleList(
            _convolutions(previous, width)
            for previous, width in zip((8, *widths), widths, strict=False)
        )
        self.decoder = nn.ModuleList(
            _convolutions(skip + coarse, left)
            for skip, coarse, left in zip(
                widths[-2::-1], (widths[-1], *below[:-1]), below, strict=True
            )
        )
        self.tail = nn.Conv2d(widths[0], 4, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Residual of a raw.

        Args:
            x: (B, 8, H, W), the raw and the same with a sample of its noise, any H, W >= 1.

        Returns:
            (B, 4, H, W), to be added to the raw.
        """
        height, width = x.shape[-2:]
        x = padded(x)
        skips: list[Tensor] = []
        for level in self.encoder:
            x = level(F.max_pool2d(x, 2) if skips else x)
            skips.append(x)
        skips.pop()
        for level in self.decoder:
            x = F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=True)
            x = level(torch.cat([skips.pop(), x], dim=1))
        residual: Tensor = self.tail(x)
        return residual[..., :height, :width]


class StyledConvolution(nn.Module):
    """Convolution, then instance normalisation whose scale and shift come from the apertures.

    Its bias cancels in the normalisation; the authors' weights have it.

    Args:
        inputs: Input channels, >= 1.
        outputs: Output channels, >= 1.
        kernel: 3 (borders zero) or 1.
    """

    def __init__(self, inputs: int, outputs: int, *, kernel: int = 3) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2)
        self.style = nn.Linear(2, 2 * outputs)

    def forward(self, x: Tensor, apertures: Tensor) -> Tensor:
        """(B, inputs, H, W) with `light_of_aperture` of source and target (B, 2)."""
        scale, shift = self.style(apertures).chunk(2, dim=1)
        return instance_norm(self.convolution(x), scale, shift)


class _StyledLevel(nn.Module):
    """Two `StyledConvolution`, each with ReLU."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = StyledConvolution(inputs, outputs)
        self.second = StyledConvolution(outputs, outputs)

    def forward(self, x: Tensor, apertures: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, outputs, H, W)."""
        return F.relu(self.second(F.relu(self.first(x, apertures)), apertures))


class StyledAttention(nn.Module):
    """Rescales a skip connection in space and over channels.

    Both parts have convolutions of their own. The average of the channels is, as in the paper's
    network, a function of the apertures alone; it is computed as the authors do.

    Args:
        width: Channels of skip and of gate.
        inner: Channels inside.
    """

    def __init__(self, width: int, inner: int) -> None:
        super().__init__()
        self.map_gate = StyledConvolution(width, inner, kernel=1)
        self.map_skip = StyledConvolution(width, inner, kernel=1)
        self.to_map = StyledConvolution(inner, 1, kernel=1)
        self.mean_gate = StyledConvolution(width, inner, kernel=1)
        self.mean_skip = StyledConvolution(width, inner, kernel=1)
        self.squeeze = nn.Conv2d(inner, max(inner // 4, 1), 1, bias=False)
        self.excite = nn.Conv2d(max(inner // 4, 1), width, 1, bias=False)

    def forward(self, skip: Tensor, gate: Tensor, apertures: Tensor) -> Tensor:
        """(B, width, H, W), (B, width, H, W), to the rescaled skip."""
        joint = F.relu(self.map_gate(gate, apertures) + self.map_skip(skip, apertures))
        place = torch.sigmoid(self.to_map(joint, apertures))
        mean = self.mean_gate(gate, apertures) + self.mean_skip(skip, apertures)
        mean = mean.mean(dim=(2, 3), keepdim=True)
        channels = torch.sigmoid(self.excite(F.relu(self.squeeze(mean))))
        return skip * place * channels


class NcsAttentionUNet(nn.Module):
    """Predicts the residual that a wider aperture's defocus adds; 8.85 M parameters.

    Nearest-neighbour upsampling, zero borders, and apertures as `light_of_aperture` states them,
    both as planes beside the image and in every normalisation.

    Args:
        widths: Channels of each level, finest first, five levels of one channel or more.

    >>> net = NcsAttentionUNet(widths=(4, 8, 8, 8, 8))
    >>> net(torch.zeros(1, 4, 5, 3), torch.tensor([[11.3, 4.0]])).shape
    torch.Size([1, 4, 5, 3])
    """

    def __init__(self, *, widths: Sequence[int] = ATTENTION_WIDTHS) -> None:
        super().__init__()
        fine, coarse = widths[-2::-1], widths[:0:-1]
        # Half the channels inside the attention, but on the finest level as many as outside.
        inner = (*widths[-3::-1], widths[0])
        self.encoder = nn.ModuleList(
            _StyledLevel(previous, width)
            for previous, width in zip((6, *widths), widths, strict=False)
        )
        self.upward = nn.ModuleList(
            StyledConvolution(c, f) for f, c in zip(fine, coarse, strict=True)
        )
        self.attention = nn.ModuleList(
            StyledAttention(f, i) for f, i in zip(fine, inner, strict=True)
        )
        self.decoder = nn.ModuleList(_StyledLevel(2 * f, f) for f in fine)
        self.tail = nn.Conv2d(widths[0], 4, 1)

    def forward(self, image: Tensor, f_numbers: Tensor) -> Tensor:
        """Residual of an image.

        Args:
            image: (B, 4, H, W) in [0, 1], any H, W >= 1.
            f_numbers: (B, 2), effective f-numbers of source and target.

        Returns:
            (B, 4, H, W), to be added to the image.
        """
        height, width = image.shape[-2:]
        x = padded(image)
        apertures = light_of_aperture(f_numbers).to(image)
        x = torch.cat([x, apertures[:, :, None, None].expand(-1, -1, *x.shape[-2:])], dim=1)
        skips: list[Tensor] = []
        for level in self.encoder:
            x = level(F.max_pool2d(x, 2) if skips else x, apertures)
            skips.append(x)
        skips.pop()
        for upward, attention, level in zip(self.upward, self.attention, self.decoder, strict=True):
            skip = skips.pop()
            x = F.relu(upward(F.interpolate(x, scale_factor=2.0, mode="nearest"), apertures))
            x = level(torch.cat([attention(skip, x, apertures), x], dim=1), apertures)
        residual: Tensor = self.tail(x)
        return residual[..., :height, :width]
