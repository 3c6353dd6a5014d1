"""Estimates how defocused each pixel of a photograph is, from its texture."""

from __future__ import annotations

import itertools

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from simulator.blur import box_mean, disc_blur

#: Discs whose differences are the bands [pixel of diameter]; 0 is the image itself.
BAND_DIAMETERS = (0.0, 1.5, 3.0, 5.5, 10.0)
#: Windows over which a band's energy is averaged, and the contrast that it is compared to.
_ENERGY_WINDOW, _CONTRAST_WINDOW = 7, 25
#: The network estimates log(diameter + this): its resolution is even where blur is visible.
LOG_OFFSET = 0.3
#: Largest diameter that is estimated [pixel].
LARGEST = 12.0


class DefocusMap(nn.Module):
    """A small network from local band energies to the circle of confusion.

    Defocus removes fine detail first: the energies of neighbouring difference-of-disc bands,
    relative to the contrast of the neighbourhood, tell by how much. They do not depend on the
    exposure. The network looks at half the resolution (pixel unshuffle).

    Args:
        width: Channels of the network.
        dilations: One residual block each.
    """

    def __init__(self, width: int = 48, dilations: tuple[int, ...] = (1, 2, 4, 1)) -> None:
        super().__init__()
        bands = len(BAND_DIAMETERS) - 1
        self.head = nn.Conv2d(4 * (2 * bands + 1), width, 3, padding=1)
        self.blocks = nn.ModuleList(_Block(width, dilation) for dilation in dilations)
        self.tail = nn.Conv2d(width, 1, 3, padding=1)
        nn.init.zeros_(self.tail.bias)  # type: ignore[arg-type]
        with torch.no_grad():
            self.tail.weight.mul_(0.1)

    def forward(self, image: Tensor, deviation: Tensor) -> Tensor:
        """Logarithm of the blur, ``log(diameter + 0.3)``.

        Args:
            image: (B, 4, H, W) raw with little noise, any exposure; H, W >= 1.
            deviation: (B, 4, H, W) standard deviation of the noise that was removed from it.

        Returns:
            (B, H, W); the diameter is in pixels of `image`.
        """
        height, width = image.shape[-2:]
        features = F.pad(
            band_features(image, deviation), (0, width % 2, 0, height % 2), "replicate"
        )
        x = F.relu_(self.head(F.pixel_unshuffle(features, 2)))
        for block in self.blocks:
            x = block(x)
        coarse = self.tail(x).float()
        size = features.shape[-2:]
        fine = F.interpolate(coarse, size=size, mode="bilinear", align_corners=False)
        return fine[:, 0, :height, :width]

    def diameter(self, image: Tensor, deviation: Tensor) -> Tensor:
        """Diameter of the circle of confusion of each pixel (B, H, W), in pixels of `image`."""
        return to_diameter(self(image, deviation))


def to_diameter(log_blur: Tensor) -> Tensor:
    """What ``log(diameter + 0.3)`` stands for, in [0, `LARGEST`]."""
    return (log_blur.clamp(max=3.0).exp() - LOG_OFFSET).clamp(0.0, LARGEST)


class _Block(nn.Module):
    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        with torch.no_grad():
            self.second.weight.mul_(0.3)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same shape."""
        return self.second(F.relu_(self.first(x))).add_(x)


def band_features(image: Tensor, deviation: Tensor) -> Tensor:
    """What the network sees, (B, 9, H, W): independent of the exposure.

    Four signed bands relative to the local contrast, the logarithms of their local energies
    relative to it, and the logarithm of the noise relative to it.
    """
    grey = image.float().mean(dim=1)
    # Noise of the mean of four planes.
    floor = deviation.float().square().mean(dim=1) / 4.0 + 1e-6 * grey.square() + 1e-24
    discs = [disc_blur(grey, diameter) for diameter in BAND_DIAMETERS]
    bands = torch.stack([a - b for a, b in itertools.pairwise(discs)], dim=1)
    energy = box_mean(bands.square(), _ENERGY_WINDOW)
    contrast = box_mean(bands.square().sum(dim=1, keepdim=True), _CONTRAST_WINDOW) + floor[:, None]
    signed = (bands / contrast.sqrt()).clamp(-8.0, 8.0)
    relative = torch.log(energy / contrast + 1e-5)
    noise = torch.log(floor[:, None] / contrast + 1e-5)
    return torch.cat([signed, 0.3 * relative + 1.0, 0.3 * noise + 1.0], dim=1)
