"""Noise module: removes the source's noise, so that the target's can take its place."""

from __future__ import annotations

import copy
import functools
from typing import Literal, get_args

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from simulator.capture.residual import Residual
from simulator.networks.denoiser import SIZES, Denoiser
from simulator.networks.unet import UNet
from simulator.noise.generator import frame_normals, noise_keys
from simulator.optics.blur import box_mean
from simulator.utils.checks import check_word

Preset = Literal["nano", "compact", "large", "paper", "ncs"]
#: Side of the window that smooths the signal which the noise level is read from.
_SMOOTHING = 5
#: Seed of the sample of noise that the authors' network is shown.
_SAMPLE_SEED = 1234


class NoiseModule(nn.Module):
    """Denoises an exposed raw of known noise level function.

    Args:
        preset: ``"nano"``, ``"compact"`` or ``"large"``: one of the family of
            `simulator.networks.denoiser`, which commute with exposure; ``"paper"``: the U-Net of
            Brooks et al. 2019 with a noise-level map, as the paper uses it (section 3.2);
            ``"ncs"``: the U-Net of the authors' released code, which is shown a sample of the
            noise in place of its level. The sample is the same whenever it is asked for.
    """

    def __init__(self, preset: Preset = "compact") -> None:
        super().__init__()
        check_word("preset", preset, get_args(Preset))
        self.preset = preset
        self.residual: Residual | None = None  # known once it is trained
        if preset == "paper" or preset == "ncs":
            self.network: nn.Module = UNet(preset)
        else:
            self.network = Denoiser(preset)

    @property
    def commutes(self) -> bool:
        """Whether it commutes with exposure: denoising at any exposure gives the same light."""
        return self.preset in SIZES

    @functools.cached_property
    def operations(self) -> int:
        """Arithmetic operations per packed pixel, counted as torch counts them."""
        twin, side = copy.deepcopy(self.network).to("meta"), 64
        image, noise = (torch.empty(1, 4, *size, device="meta") for size in ((side, side), ()))
        inputs = (image, noise, noise) if self.commutes else (torch.cat([image, image], dim=1),)
        with FlopCounterMode(display=False) as counter:
            twin(*inputs)
        return round(counter.get_total_flops() / side**2)

    def forward(self, exposed: Tensor, shot: Tensor, read: Tensor) -> Tensor:
        """The raw with little noise; one without noise (shot = read = 0) as it is.

        Args:
            exposed: (B, 4, H, W) raw on the scale of the target.
            shot: (B, 4) slope of its noise variance on that scale.
            read: (B, 4) noise variance at zero signal.

        Returns:
            (B, 4, H, W) float32.
        """
        if self.commutes:
            result = self.network(exposed, shot, read)
        else:
            level = variance_map(exposed, shot, read).sqrt()
            shown = level if self.preset == "paper" else exposed + level * _sample(exposed)
            result = exposed + self.network(torch.cat([exposed, shown], dim=1)).float()
        noisy = ((shot > 0) | (read > 0)).any(dim=1)
        return torch.where(noisy[:, None, None, None], result, exposed.float())


def _sample(image: Tensor) -> Tensor:
    """Standard normals (1, 4, H, W) for an image (B, 4, H, W); the same for every one of its size.

    Results of the noise module are shared between captures of all seeds.
    """
    normals = frame_normals(int(noise_keys(_SAMPLE_SEED)[0]), tuple(image.shape[1:]))
    return torch.from_numpy(normals)[None].to(image.device)


def variance_map(signal: Tensor, shot: Tensor, read: Tensor) -> Tensor:
    """Noise variance ``read + shot * max(signal, 0)`` of each pixel, (B, 4, H, W) float32."""
    slope, offset = (v.float()[:, :, None, None] for v in (shot, read))
    return signal.float().clamp(min=0.0) * slope + offset


def smoothed(image: Tensor) -> Tensor:
    """Mean over 5 x 5 pixels, borders repeated.

    A noise level read from single noisy pixels would be too low where noise made them dark.
    """
    return box_mean(image, _SMOOTHING)
