"""Aperture module: the blur that a wider aperture adds."""

import itertools
from typing import Literal, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from simulator.networks.noise_module import ResidualBlock, box_mean
from simulator.networks.unet import AttentionUNet
from simulator.optics.discs import DiscBank, added_blur, disc_blur
from simulator.utils.checks import check_word

AperturePreset = Literal["compact", "paper", "ncs"]
#: Blur below this diameter [pixel] cannot be told from sharpness, and is left as it is.
DEAD_ZONE = 1.0
#: Factor on estimated diameters, as too little blur is worse than too much: of 1, 1.1 ... 1.4
#: that with the least error on validation scenes where these are blurred by 1.5 pixels and more.
BLUR_FACTOR = 1.3
#: Up to the first of these [pixel] a picture's most blurred detail counts as sharp, from the second
#: on as defocused.
IN_FOCUS = (1.7, 2.2)
#: Variance over squared mean from which a neighbourhood counts fully as detail.
_FULL_CONTRAST = 0.05
#: Side of the window that contrast is measured in [pixel].
_USABLE_WINDOW = 9
#: Share of a picture's detail that may be no more than soft where it counts as in focus.
_IN_FOCUS_SHARE = 0.95
#: Discs whose differences are the bands [pixel of diameter]; 0 is the image itself.
BAND_DIAMETERS = (0.0, 1.5, 3.0, 5.5, 10.0)
#: Windows over which a band's energy is averaged, and the contrast that it is compared to.
_ENERGY_WINDOW, _CONTRAST_WINDOW = 7, 25
#: Dilations of the network's blocks.
_DILATIONS = (1, 2, 4, 1)
#: The network estimates log(diameter + this): its resolution is even where blur is visible.
LOG_OFFSET = 0.3
#: Largest diameter that is estimated [pixel].
LARGEST = 12.0


class ApertureModule(nn.Module):
    """Opens the aperture of a photograph with little noise; it never closes it.

    The preset ``"compact"`` estimates a map of the circle of confusion once per scene and blurs
    with a bank of discs; ``"paper"`` is the residual attention U-Net of the paper's section 3.3,
    run for every pair of f-numbers; ``"ncs"`` is that of the authors' released code, which does not
    commute with exposure and is not exact on pictures without detail.
    """

    def __init__(self, preset: AperturePreset = "compact") -> None:
        super().__init__()
        check_word("preset", preset, get_args(AperturePreset))
        self.preset = preset
        self.network: nn.Module = DefocusMap() if preset == "compact" else AttentionUNet(preset)

    def forward(
        self, image: Tensor, deviation: Tensor, f_source: Tensor, f_target: Tensor
    ) -> Tensor:
        """The raw (B, 4, H, W), of little noise, with the defocus of `f_target`, as exposed.

        `deviation` (B, 4, H, W) is that of the noise which was removed from `image`. F-numbers (B,)
        are effective ones; where that wanted is not smaller, the image stays.
        """
        if not self.has_map:
            opens = (f_target < f_source)[:, None, None, None]
            return torch.where(opens, self._opened(image, f_source, f_target), image)
        diameter = self.defocus(image, deviation)
        added = added_blur(diameter, f_source[:, None, None], f_target[:, None, None])
        return DiscBank(image).blurred(added[:, None])

    @property
    def has_map(self) -> bool:
        """Whether it estimates a map of the defocus, from which every f-number follows."""
        return self.preset == "compact"

    def defocus(self, image: Tensor, deviation: Tensor) -> Tensor:
        """Circle of confusion of the source (B, H, W) [pixel]; see `usable_defocus`."""
        return usable_defocus(self.estimate_defocus(image, deviation), image)

    def estimate_defocus(self, image: Tensor, deviation: Tensor) -> Tensor:
        """The network's map (B, H, W) [pixel]; each pixel depends on its neighbourhood alone."""
        if not isinstance(self.network, DefocusMap):
            raise ValueError(f"`preset` (={self.preset!r}) must be 'compact' to have a defocus map")
        return to_diameter(self.network(image, deviation))

    def _opened(self, image: Tensor, f_source: Tensor, f_target: Tensor) -> Tensor:
        f_numbers = torch.stack([f_source, f_target], dim=1).float()
        # Eighteen normalisations in a row: bfloat16 would change half of the residual.
        with torch.autocast(image.device.type, enabled=False):
            if self.preset == "ncs":
                return image + self.network(image.float(), f_numbers)
            # One scalar per image is divided out before the network and multiplied in after it. So
            # it sees every exposure alike and commutes with exposure, like the compact one.
            scale = image.abs().mean(dim=(1, 2, 3), keepdim=True).clamp(min=1e-8) / 0.18
            residual = self.network((image / scale).float(), f_numbers)
            # A picture without detail has a constant residual; without it, it stays as it is.
            flat = self.network(image.new_zeros(len(image), 4, 1, 1).float(), f_numbers)
        return image + (residual - flat) * scale


def usable_defocus(diameter: Tensor, image: Tensor) -> Tensor:
    """The map (B, H, W) that `image` is blurred by: zero where that shows no defocus."""
    return BLUR_FACTOR * dead_zone(diameter) * is_defocused(diameter, image)[:, None, None]


def is_defocused(diameter: Tensor, image: Tensor) -> Tensor:
    """Whether a picture shows defocus at all, (B,) from 0 to 1.

    Blur up to 1.5 pixels is hard to tell from softness, and a false map costs a sharp picture more
    than a missed one costs a blurred picture. So a picture counts as in focus throughout unless a
    twentieth of its detail (weighed by local contrast) is blurred by more than `IN_FOCUS`.
    """
    grey = image.mean(dim=1, keepdim=True)
    mean = box_mean(grey, _USABLE_WINDOW)
    contrast = box_mean((grey - mean).square(), _USABLE_WINDOW) / mean.square().clamp(min=1e-24)
    weights = contrast.clamp(max=_FULL_CONTRAST).flatten(1)
    low, high = IN_FOCUS
    levels = [
        _quantile(values, weight, low, high)
        for values, weight in zip(diameter.flatten(1), weights, strict=True)
    ]
    return ((torch.stack(levels) - low) / (high - low)).clamp(0.0, 1.0)


def _quantile(values: Tensor, weight: Tensor, low: float, high: float) -> Tensor:
    """The value that `_IN_FOCUS_SHARE` of the weight does not exceed, clipped to [low, high].

    Only the values between are sorted: most whole frames are either sharp or blurred far outside.
    """
    wanted = _IN_FOCUS_SHARE * weight.sum(dtype=torch.float64)
    reached = torch.where(values < low, weight, 0.0).sum(dtype=torch.float64)
    if bool(reached >= wanted):
        return values.new_tensor(low)
    between = (values >= low) & (values <= high)
    chosen, order = values[between].sort()
    sums = reached + weight[between].double()[order].cumsum(dim=0)
    index = int((sums < wanted).sum())
    return chosen[index] if index < len(chosen) else values.new_tensor(high)


def dead_zone(diameter: Tensor) -> Tensor:
    """``sqrt(max(c^2 - DEAD_ZONE^2, 0))``: keeps regions in focus unchanged."""
    remainder = diameter.square() - DEAD_ZONE**2
    # Without an infinite gradient.
    return torch.where(remainder > 0, remainder.clamp(min=1e-12).sqrt(), 0.0)


class DefocusMap(nn.Module):
    """A small network that estimates how defocused each pixel of a photograph is, from its texture.

    Defocus removes fine detail first: the energies of neighbouring difference-of-disc bands,
    relative to the contrast of the neighbourhood, tell by how much. They do not depend on the
    exposure. The network works at half the resolution (pixel unshuffle).
    """

    def __init__(self, width: int = 48) -> None:
        super().__init__()
        bands = len(BAND_DIAMETERS) - 1
        self.head = nn.Conv2d(4 * (2 * bands + 1), width, 3, padding=1)
        self.blocks = nn.ModuleList(ResidualBlock(width, dilation=d) for d in _DILATIONS)
        self.tail = nn.Conv2d(width, 1, 3, padding=1)
        nn.init.zeros_(self.tail.bias)  # type: ignore[arg-type]
        with torch.no_grad():  # starts near a constant map
            self.tail.weight.mul_(0.1)
            for block in self.blocks:
                block.second.weight.mul_(0.3)  # type: ignore[operator, union-attr]

    def forward(self, image: Tensor, deviation: Tensor) -> Tensor:
        """``log(diameter + 0.3)`` of the blur (B, H, W), the diameter in pixels of `image`.

        `deviation` (B, 4, H, W) is that of the noise which was removed from `image`.
        """
        height, width = image.shape[-2:]
        features = F.pad(
            band_features(image, deviation), (0, width % 2, 0, height % 2), "replicate"
        )
        x = F.relu_(self.head(F.pixel_unshuffle(features, 2)))
        for block in self.blocks:
            x = block(x)
        coarse = self.tail(x).float()
        fine = F.interpolate(coarse, size=features.shape[-2:], mode="bilinear", align_corners=False)
        return fine[:, 0, :height, :width]


def to_diameter(log_blur: Tensor) -> Tensor:
    """Diameter whose ``log(diameter + 0.3)`` is `log_blur`, in [0, `LARGEST`]."""
    return (log_blur.clamp(max=3.0).exp() - LOG_OFFSET).clamp(0.0, LARGEST)


def band_features(image: Tensor, deviation: Tensor) -> Tensor:
    """Input of `DefocusMap`, (B, 9, H, W), which does not depend on the exposure.

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
