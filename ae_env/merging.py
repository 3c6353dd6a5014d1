"""Several exposures of a scene merged into one estimate of its light, and how good that is."""

import torch

#: A sample at or above this share of white may be clipped: nothing is known of its light.
SATURATED = 0.97
#: Light below which errors count less: that of a white surface times this.
LOG_FLOOR = 2.0**-10
#: Largest error of a sample [EV], which one that no frame shows has.
WORST_EV = 2.0
#: Times that the light is estimated, each with the noise that the estimate before tells.
_ROUNDS = 2
#: Variance below which no sample is: a frame without noise still has digital steps.
_LEAST_VARIANCE = 1e-9


def merge(
    signals: torch.Tensor, gains: torch.Tensor, shot: torch.Tensor, read: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The light that B scenes have in K frames each, weighted by the inverse of the noise.

    The weights are those of the best linear unbiased estimate (Granados et al., CVPR 2010;
    Hasinoff et al., CVPR 2010): each frame's light has the variance ``(read + shot g L) / g**2``,
    where L is the estimate so far. Samples from 0.97 of white on have no weight.

    Args:
        signals: (B, K, 4, H, W) float32, white is 1.
        gains: (B, K) signal per unit of light; 0 for a frame that is not there.
        shot: (B, K, 4) noise: slope of the variance over the signal.
        read: (B, K, 4) noise: variance at no signal.

    Returns:
        (B, 4, H, W) the light, and its inverse variance; 0 both where no frame shows it.
    """
    gain = gains[:, :, None, None, None].float()
    usable = (signals < SATURATED) & (gain > 0.0)
    exposed = usable * gain
    # Photon noise alone weighs all photons alike.
    light = (usable * signals).sum(dim=1) / exposed.sum(dim=1).clamp(min=1e-30)
    slope, floor = (n[..., None, None].float() for n in (shot, read))
    total = torch.zeros_like(light)
    for _ in range(_ROUNDS):
        expected = gain * light.clamp(min=0.0)[:, None]
        variance = (slope * expected + floor).clamp(min=_LEAST_VARIANCE)
        weight = exposed * gain / variance
        total = weight.sum(dim=1)
        seen = (weight * signals / gain.clamp(min=1e-30)).sum(dim=1)
        light = torch.where(total > 0.0, seen / total.clamp(min=1e-30), torch.zeros(()))
    return light, total


def log_error(
    light: torch.Tensor, precision: torch.Tensor, truth: torch.Tensor, floor: torch.Tensor
) -> torch.Tensor:
    """Error of each sample [EV], at most `WORST_EV`, which samples that no frame shows have.

    ``|log2((light + floor) / (truth + floor))|`` of `light` and `precision` (B, 4, H, W) of
    `merge`, `truth` (B, 4, H, W) and `floor` (B,), light below which errors count less.
    """
    dark = floor[:, None, None, None].to(light)
    ratio = (light.clamp(min=0.0) + dark) / (truth.clamp(min=0.0) + dark)
    return ratio.log2_().abs_().clamp_(max=WORST_EV).masked_fill_(precision <= 0.0, WORST_EV)
