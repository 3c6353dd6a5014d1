"""Aperture module: the blur that a wider aperture adds."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from simulator.blur import box_mean
from simulator.modules.attention_unet import AttentionUNet
from simulator.modules.defocus_map import DefocusMap
from simulator.modules.disc_bank import DiscBank
from simulator.modules.noise import Preset, check_preset

#: Blur below this diameter [pixel] is not told from sharpness, and left as it is.
DEAD_ZONE = 1.0
#: Up to the first of these [pixel] a picture's most blurred detail counts as sharp, from the second
#: on as defocused.
IN_FOCUS = (1.7, 2.2)
#: Variance over squared mean from which a neighbourhood counts fully as detail.
_FULL_CONTRAST = 0.05
#: Side of the window that contrast is measured in [pixel].
_CONTRAST_WINDOW = 9
#: Share of a picture's detail that may be no more than soft where it counts as in focus.
_IN_FOCUS_SHARE = 0.95
#: Equal parts of `IN_FOCUS` that the weight is summed in before any value is sorted.
_STEPS = 512


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
        """Circle of confusion of each pixel of the source (B, H, W) [pixel], as far as trusted.

        Raises:
            ValueError: If the preset has no such map.
        """
        return usable_defocus(self.estimate_defocus(image, deviation), image)

    def estimate_defocus(self, image: Tensor, deviation: Tensor) -> Tensor:
        """The network's map (B, H, W) [pixel]; each pixel depends on its neighbourhood alone.

        Raises:
            ValueError: If the preset has no such map.
        """
        if not isinstance(self.network, DefocusMap):
            raise ValueError(f"`preset` (={self.preset!r}) must be 'compact' to have a defocus map")
        return self.network.diameter(image, deviation)

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


def usable_defocus(diameter: Tensor, image: Tensor) -> Tensor:
    """The part of an estimated map that is to be trusted: none of it where nothing is defocused.

    Args:
        diameter: (B, H, W) as `ApertureModule.estimate_defocus` gives it [pixel].
        image: (B, 4, H, W) that it was estimated from.
    """
    return dead_zone(diameter) * is_defocused(diameter, image)[:, None, None]


def is_defocused(diameter: Tensor, image: Tensor) -> Tensor:
    """Whether a picture shows defocus at all, (B,) from 0 to 1.

    Blur up to 1.5 pixels is hard to tell from softness, and a false map costs a sharp picture more
    than a missed one costs a blurred picture. So a picture counts as in focus throughout unless a
    twentieth of its detail (weighed by local contrast) is blurred by more than `IN_FOCUS`.

    Args:
        diameter: (B, H, W) estimated circle of confusion [pixel].
        image: (B, 4, H, W).
    """
    grey = image.mean(dim=1, keepdim=True)
    mean = box_mean(grey, _CONTRAST_WINDOW)
    contrast = box_mean((grey - mean).square(), _CONTRAST_WINDOW) / mean.square().clamp(min=1e-24)
    weights = contrast.clamp(max=_FULL_CONTRAST).flatten(1)
    low, high = IN_FOCUS
    levels = [
        _quantile(values, weight, low, high)
        for values, weight in zip(diameter.flatten(1), weights, strict=True)
    ]
    return ((torch.stack(levels) - low) / (high - low)).clamp(0.0, 1.0)


def _quantile(values: Tensor, weight: Tensor, low: float, high: float) -> Tensor:
    """The value that `_IN_FOCUS_SHARE` of the weight does not exceed, told apart in [low, high].

    Only values between matter, as whole frames are sharp or blurred far outside, and of these only
    the ones near the answer are sorted.
    """
    wanted = _IN_FOCUS_SHARE * weight.sum(dtype=torch.float64)
    below = torch.where(values < low, weight, 0.0).sum(dtype=torch.float64)
    if bool(below >= wanted):
        return values.new_tensor(low)
    between = ((values >= low) & (values <= high)).nonzero()[:, 0]
    chosen, share = values[between], weight[between].double()
    step = ((chosen - low) * (_STEPS / (high - low))).long()  # ascends with the value
    sums = torch.zeros(_STEPS + 2, dtype=torch.float64, device=values.device)
    reached = below + sums.index_add_(0, step + 1, share).cumsum(dim=0)
    place = int((reached < wanted).sum()) - 1
    if place > _STEPS:
        return values.new_tensor(high)
    near = (step == place).nonzero()[:, 0]
    chosen, order = chosen[near].sort()
    reached = reached[place] + share[near][order].cumsum(dim=0)
    last = min(
        int((reached < wanted).sum()), len(chosen) - 1
    )  # sums in another order may fall short
    return chosen[last]


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
