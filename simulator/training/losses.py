"""Losses of the stages: one number per batch to minimise, and values worth a plot."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from simulator.networks.aperture_module import (
    LOG_OFFSET,
    ApertureModule,
    DefocusMap,
    dead_zone,
    to_diameter,
)
from simulator.networks.exposure_module import OVER_EXPOSED, ExposureModule
from simulator.networks.noise_module import NoiseModule, smoothed, variance_map
from simulator.optics.discs import DiscBank, added_blur
from simulator.training.crops import Batch, NoiseBatch

#: Weight of the loss on the logarithm of the circle of confusion beside that on the picture.
_MAP_WEIGHT = 0.1
#: Pixels around a clipped highlight that the aperture stage leaves out: the light there is unknown.
_CLIP_MARGIN = 7
#: Mean square error, in units of the noise's variance, below which a crop is as good as clean.
_LOG_FLOOR = 3e-4
#: From this share of the noise's variance on an error costs extra, and how much.
_WORSE, _WORSE_COST = 0.9, 2.0
#: Least unit of the noise stage (standard deviation). A black source without noise would have no
#: noise to measure the error by. Cameras have 7e-5 and more.
_LEAST_NOISE = 1e-6


class ExposureLoss(nn.Module):
    """L1 of the exposed source against the target, source pixels above 0.99 left out."""

    def __init__(self, exposure: ExposureModule) -> None:
        super().__init__()
        self.exposure = exposure

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """The loss on `batch`."""
        exposed = self.exposure(batch.source, batch.ratio).clamp(0.0, 1.0)
        used = batch.source <= OVER_EXPOSED
        error = (exposed - batch.sample).abs() * used
        return {"loss": error.sum() / used.sum().clamp(min=1)}


class NoiseLoss(nn.Module):
    """Error of the denoised crop in units of the noise it had.

    The family minimises the logarithm of the mean square, so that every crop's gain in decibels
    counts alike, half of it in units of each pixel's noise and half of it as PSNR counts; a crop
    that comes out worse than 0.9 of its noise costs extra. A mean square is least at the mean, so
    what is learnt is unbiased. The paper's network minimises L1, as in the paper; in units of the
    noise, dark crops would rule it, and it would learn to do nothing.
    """

    def __init__(self, noise: NoiseModule) -> None:
        super().__init__()
        self.noise = noise

    def forward(self, batch: NoiseBatch) -> dict[str, Tensor]:
        """The loss on `batch`, and the mean gain over not denoising [dB]."""
        output = self.noise(batch.noisy, batch.shot, batch.read)
        variance = variance_map(batch.clean, batch.shot, batch.read).clamp(min=_LEAST_NOISE**2)
        square = (output - batch.clean).square()
        before = (batch.noisy - batch.clean).square()
        each = (square / variance).mean(dim=(1, 2, 3))
        pooled = square.mean(dim=(1, 2, 3)) / variance.mean(dim=(1, 2, 3))
        ratio = square.detach().sum(dim=(1, 2, 3)) / before.sum(dim=(1, 2, 3)).clamp(min=1e-30)
        gain = -10 * torch.log10(ratio.clamp(min=1e-6)).mean()
        if not self.noise.commutes:
            loss = (output - batch.clean).abs().mean()
        else:
            parts = torch.stack([each, pooled])
            worse = _WORSE_COST * F.relu(parts - _WORSE)
            loss = (torch.log(parts + _LOG_FLOOR) + worse).mean()
        return {"loss": loss, "gain_db": gain}


class ApertureLoss(nn.Module):
    """L1 of the opened source against the target, in units of the change that opening makes.

    Preset ``"compact"`` adds a loss on the logarithm of its map, which else becomes a constant.
    """

    def __init__(
        self, exposure: ExposureModule, noise: NoiseModule, aperture: ApertureModule
    ) -> None:
        super().__init__()
        self.exposure, self.noise, self.aperture = exposure, noise, aperture

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """The loss on `batch`, and the error relative to not opening."""
        with torch.no_grad():
            exposed, shot, read = expose(self.exposure, batch)
            denoised = self.noise(exposed, shot, read)
            deviation = variance_map(smoothed(exposed), shot, read).sqrt()
        values: dict[str, Tensor] = {}
        if isinstance(self.aperture.network, DefocusMap):
            log_blur = self.aperture.network(denoised, deviation)
            values["map"] = (log_blur - torch.log(batch.defocus + LOG_OFFSET)).abs().mean()
            diameter = dead_zone(to_diameter(log_blur))
            stops = (f[:, None, None] for f in (batch.f_source, batch.f_target))
            output = DiscBank(denoised).blurred(added_blur(diameter, *stops)[:, None])
        else:
            output = self.aperture(denoised, deviation, batch.f_source, batch.f_target)
        used = away_from_clipping(batch.source, batch.target)
        error = (output - batch.target).abs() * used
        before = (denoised - batch.target).abs() * used
        # Per pair, so that bright ones do not outweigh the others; not below the noise.
        unit = before.sum(dim=(1, 2, 3)) + (0.5 * deviation * used).sum(dim=(1, 2, 3)) + 1e-9
        picture = (error.sum(dim=(1, 2, 3)) / unit).mean()
        values["relative"] = error.detach().sum() / before.sum().clamp(min=1e-9)
        return {"loss": picture + _MAP_WEIGHT * values.get("map", 0.0), **values}


class BaselineLoss(nn.Module):
    """L1 of a network that maps the source and both settings directly to the target."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """The loss on `batch`."""
        output = self.network(batch.source, batch.parameters).float()
        return {"loss": (output - batch.sample).abs().mean()}


def expose(exposure: ExposureModule, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    """The exposed source, and the shot and read noise (B, 4) that it has there."""
    ratio = (exposure.w * batch.ratio).detach()[:, None]
    exposed = exposure(batch.source, batch.ratio).detach()
    return exposed, batch.shot * ratio, batch.read * ratio.square()


def away_from_clipping(source: Tensor, target: Tensor) -> Tensor:
    """(B, 1, H, W) bool: no plane is clipped within 7 pixels, before or after."""
    clipped = ((source > OVER_EXPOSED) | (target >= 1.0)).any(dim=1, keepdim=True).float()
    return F.max_pool2d(clipped, 2 * _CLIP_MARGIN + 1, stride=1, padding=_CLIP_MARGIN) == 0
