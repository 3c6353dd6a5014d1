"""Aperture module: the blur that a wider aperture adds."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from simulator.modules.attention_unet import AttentionUNet
from simulator.modules.defocus_map import DefocusMap
from simulator.modules.disc_bank import DiscBank
from simulator.modules.noise import Preset, check_preset

#: Blur below this diameter [pixel] is not told from sharpness, and left as it is.
DEAD_ZONE = 1.0


class ApertureModule(nn.Module):
    """Opens the aperture of a photograph with little noise; it never closes it.

    Args:
        preset: ``"compact"``: estimates a map of the circle of confusion once per scene and blurs
            with a bank of discs; ``"paper"``: the residual attention U-Net of the paper's section
            3.3, run for every pair of f-numbers.
    """

    def __init__(self, preset: Preset = "compact") -> None:
        super().__init__()
        check_preset(preset)
        self.preset = preset
        self.network: nn.Module = DefocusMap() if preset == "compact" else AttentionUNet()

    def forward(
        self, image: Tensor, deviation: Tensor, f_source: Tensor, f_target: Tensor
    ) -> Tensor:
        """The image with the aperture's defocus at `f_target`, at unchanged exposure.

        Args:
            image: (B, 4, H, W) raw with little noise.
            deviation: (B, 4, H, W) standard deviation of the noise that was removed from it.
            f_source: (B,) effective f-number of `image`.
            f_target: (B,) effective f-number wanted; where it is not smaller, the image stays.
        """
        if self.preset == "paper":
            return self._residual(image, f_source, f_target)
        diameter = self.defocus(image, deviation)
        added = added_blur(diameter, f_source[:, None, None], f_target[:, None, None])
        return DiscBank(image).blurred(added[:, None])

    def defocus(self, image: Tensor, deviation: Tensor) -> Tensor:
        """Circle of confusion of each pixel of the source (B, H, W) [pixel], after the dead zone.

        Raises:
            ValueError: If the preset has no such map.
        """
        if not isinstance(self.network, DefocusMap):
            raise ValueError(f"`preset` (={self.preset!r}) must be 'compact' to have a defocus map")
        return dead_zone(self.network.diameter(image, deviation))

    def _residual(self, image: Tensor, f_source: Tensor, f_target: Tensor) -> Tensor:
        # One scalar per image makes the network see every exposure alike: it then commutes with
        # exposure, like the compact one.
        scale = image.abs().mean(dim=(1, 2, 3), keepdim=True).clamp(min=1e-8) / 0.18
        f_numbers = torch.stack([f_source, f_target], dim=1).float()
        # Eighteen normalisations in a row: bfloat16 would change half of the residual.
        with torch.autocast(image.device.type, enabled=False):
            residual = self.network((image / scale).float(), f_numbers)
            # A picture without detail has a constant residual; without it, it stays as it is.
            flat = self.network(image.new_zeros(len(image), 4, 1, 1).float(), f_numbers)
        residual = (residual - flat) * scale
        opens = (f_target < f_source)[:, None, None, None]
        return torch.where(opens, image + residual, image)


def dead_zone(diameter: Tensor, size: float = DEAD_ZONE) -> Tensor:
    """``sqrt(max(c^2 - size^2, 0))``: keeps regions in focus unchanged."""
    excess = diameter.square() - size**2
    return torch.where(excess > 0, excess.clamp(min=1e-12).sqrt(), 0.0)  # no infinite gradient


def added_blur(diameter: Tensor, f_source: Tensor | float, f_target: Tensor | float) -> Tensor:
    """Diameter of the disc that turns the blur at `f_source` into that at `f_target` [pixel].

    The circle of confusion grows with 1 / N and squared diameters add: the difference of squares,
    ``c^2 ((N_1 / N_2)^2 - 1)``, 0 where the aperture closes.
    """
    ratio = torch.as_tensor(f_source) / torch.as_tensor(f_target)
    return diameter * (ratio.square() - 1.0).clamp(min=0.0).sqrt().to(diameter)
