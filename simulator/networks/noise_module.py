"""Noise module: removes the source's noise, so that the target's can take its place."""

from __future__ import annotations

from typing import Literal, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from simulator.networks.unet import UNet
from simulator.optics.blur import box_mean

Preset = Literal["compact", "paper"]
#: Side of the window that smooths the signal which the noise level is read from.
_SMOOTHING = 5


def check_preset(preset: str) -> None:
    """Raises a `ValueError` unless `preset` is known."""
    if preset not in get_args(Preset):
        raise ValueError(f"`preset` (={preset!r}) must be one of {list(get_args(Preset))}")


class NoiseModule(nn.Module):
    """Denoises an exposed raw of known noise level function.

    Args:
        preset: ``"compact"``: a small bias-free network with a standard-deviation map, which
            commutes with exposure; ``"paper"``: the U-Net of Brooks et al. 2019 with a noise-level
            map, as the paper uses it (section 3.2).
    """

    def __init__(self, preset: Preset = "compact") -> None:
        super().__init__()
        check_preset(preset)
        self.preset = preset
        self.network: nn.Module = CompactDenoiser() if preset == "compact" else UNet()

    def forward(self, exposed: Tensor, shot: Tensor, read: Tensor) -> Tensor:
        """The raw with little noise; one without noise (shot = read = 0) as it is.

        Args:
            exposed: (B, 4, H, W) raw on the scale of the target.
            shot: (B, 4) slope of its noise variance on that scale.
            read: (B, 4) noise variance at zero signal.

        Returns:
            (B, 4, H, W) float32.
        """
        if self.preset == "paper":
            level = variance_map(exposed, shot, read).sqrt()
            result = exposed + self.network(torch.cat([exposed, level], dim=1)).float()
        else:
            deviation = variance_map(smoothed(exposed), shot, read).sqrt()
            result = self.network(exposed, deviation).float()
        noisy = ((shot > 0) | (read > 0)).any(dim=1)
        return torch.where(noisy[:, None, None, None], result, exposed.float())


def variance_map(signal: Tensor, shot: Tensor, read: Tensor) -> Tensor:
    """Noise variance ``read + shot * max(signal, 0)`` of each pixel, (B, 4, H, W) float32."""
    slope, offset = (v.float()[:, :, None, None] for v in (shot, read))
    return signal.float().clamp(min=0.0) * slope + offset


def smoothed(image: Tensor) -> Tensor:
    """Mean over 5 x 5 pixels, borders repeated.

    A noise level read from single noisy pixels would be too low where noise made them dark.
    """
    return box_mean(image, _SMOOTHING)


class CompactDenoiser(nn.Module):
    """A small bias-free U-Net that commutes with exposure: scaling its input scales its output.

    Its inputs are the raw and a map of the noise's standard deviation. Convolutions without biases,
    ReLU, additive skips and no normalisation: every layer satisfies ``f(c x) = c f(x)`` for c > 0,
    so the whole network does. "Expose, denoise" then equals "denoise, expose", no exposure ratio
    lies outside the training range, and one denoised light serves every target.

    Source: Mohan et al. 2020, Robust and interpretable blind image denoising via bias-free
    convolutional neural networks.

    Args:
        widths: Channels of the three levels, each half the resolution of the one before.
    """

    def __init__(self, widths: tuple[int, int, int] = (32, 48, 96)) -> None:
        super().__init__()
        fine, middle, coarse = widths
        self.head = nn.Conv2d(8, fine, 3, padding=1, bias=False)
        self.encode_fine = ResidualBlock(fine)
        self.to_middle = nn.Conv2d(fine, middle, 2, stride=2, bias=False)
        self.encode_middle = ResidualBlock(middle)
        self.to_coarse = nn.Conv2d(middle, coarse, 2, stride=2, bias=False)
        self.coarse = nn.Sequential(ResidualBlock(coarse), ResidualBlock(coarse))
        self.from_coarse = nn.ConvTranspose2d(coarse, middle, 2, stride=2, bias=False)
        self.decode_middle = ResidualBlock(middle)
        self.from_middle = nn.ConvTranspose2d(middle, fine, 2, stride=2, bias=False)
        self.decode_fine = ResidualBlock(fine)
        self.tail = nn.Conv2d(fine, 4, 3, padding=1, bias=False)
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
            if isinstance(module, ResidualBlock):  # starts near the identity: no warm-up needed
                with torch.no_grad():
                    module.second.weight.mul_(0.1)
        with torch.no_grad():
            self.tail.weight.mul_(0.01)

    def forward(self, image: Tensor, deviation: Tensor) -> Tensor:
        """Noise-reduced image.

        Args:
            image: (B, 4, H, W) noisy raw, any exposure; H, W >= 1.
            deviation: (B, 4, H, W) standard deviation of each pixel's noise, on the same scale.

        Returns:
            (B, 4, H, W).
        """
        height, width = image.shape[-2:]
        # Fewer than 4 pixels of padding: three levels need a multiple of 4.
        pad = (0, -width % 4, 0, -height % 4)
        x = F.pad(torch.cat([image, deviation], dim=1), pad, mode="replicate")
        fine = self.encode_fine(self.head(x))
        middle = self.encode_middle(self.to_middle(fine))
        coarse = self.coarse(self.to_coarse(middle))
        middle = self.decode_middle(self.from_coarse(coarse).add_(middle))
        fine = self.decode_fine(self.from_middle(middle).add_(fine))
        residual: Tensor = self.tail(fine)[..., :height, :width]
        return image + residual


class ResidualBlock(nn.Module):
    """``x + conv(relu(conv(x)))``, 3 x 3.

    Args:
        width: Channels.
        dilation: Of the first convolution.
        bias: Whether the convolutions have biases.
    """

    def __init__(self, width: int, *, dilation: int = 1, bias: bool = False) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation, bias=bias)
        self.second = nn.Conv2d(width, width, 3, padding=1, bias=bias)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same shape."""
        # In place where autograd allows it: on large frames fresh memory costs as much as the sums.
        inner: Tensor = self.second(F.relu_(self.first(x)))
        return inner.add_(x)
