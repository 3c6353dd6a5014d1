"""What photographic defects leave in a picture: one number each, before it becomes a severity.

All take gamma-encoded sRGB pictures (B, 3, H, W) in [0, 1] and return (B,) float64. Each grows with
its defect, but also differs from scene to scene.
"""

from __future__ import annotations

import torch
from torch.nn.functional import avg_pool2d, pad

from ae_env.scorers.luma import by_parts, luma_of, luminance_of, srgb_decode
from ae_env.scorers.noise_level import immerkaer_sigma

#: Luma above this is white.
WHITE = 0.98
#: Linear light below this has no colour worth the name.
DARK = 1e-3


def white_share(images: torch.Tensor) -> torch.Tensor:
    """Share of the pixels whose luma is above 0.98: over-exposure."""
    return (luma_of(images) > WHITE).mean(dim=(1, 2), dtype=torch.float64)


def missing_highlights(images: torch.Tensor) -> torch.Tensor:
    """1 minus the 99th percentile of the luma: under-exposure."""
    return 1.0 - percentile(luma_of(images).flatten(1), 0.99)


def noise_sigma(images: torch.Tensor) -> torch.Tensor:
    """Immerkaer's estimate of the noise of the luma [grey levels of 255]."""
    return immerkaer_sigma(luma_of(images))


def colour_cast(images: torch.Tensor) -> torch.Tensor:
    """Length of the median of (log2(R / G), log2(B / G)) over the pixels, linear light [stop].

    Grey world with the median of ratios for the ratio of means: a coloured object or lamp does not
    shift it. Light below 0.001 counts as 0.001, so black is grey.
    """

    def ratios(part: torch.Tensor) -> torch.Tensor:
        logs = srgb_decode(part).clamp_(min=DARK).log2_()
        return torch.stack([logs[:, 0] - logs[:, 1], logs[:, 2] - logs[:, 1]], dim=1).flatten(2)

    medians = by_parts(ratios, images).median(dim=2).values.double()
    return medians.square().sum(dim=1).sqrt()


def colourfulness(images: torch.Tensor) -> torch.Tensor:
    """Hasler and Suesstrunk's colourfulness [grey levels of 255]; 0 for a grey picture.

    ``sqrt(var(rg) + var(yb)) + 0.3 sqrt(mean(rg)^2 + mean(yb)^2)``, rg = R - G and
    yb = (R + G) / 2 - B.

    Source: D. Hasler, S. Suesstrunk, "Measuring colourfulness in natural images", SPIE 5007, 2003.
    """

    def moments(part: torch.Tensor) -> torch.Tensor:
        red, green, blue = part.unbind(dim=1)
        axes = torch.stack([red - green, (red + green).mul_(0.5).sub_(blue)], dim=1).flatten(2)
        mean = axes.mean(dim=2, dtype=torch.float64)
        spread = axes.sub_(mean.to(axes)[:, :, None]).square_().mean(dim=2, dtype=torch.float64)
        return torch.stack([spread.sum(dim=1), mean.square().sum(dim=1)], dim=1)

    variance, square = by_parts(moments, images).unbind(dim=1)
    return 255.0 * (variance.sqrt() + 0.3 * square.sqrt())


def veil(images: torch.Tensor) -> torch.Tensor:
    """Light in the darkest pixels relative to the mean: the 2nd percentile of min(R, G, B) over Y.

    Linear light. Without haze a picture has some pixels that are dark in one of the channels; what
    they show is airlight.

    Source: the dark channel prior of K. He, J. Sun, X. Tang, "Single image haze removal using dark
    channel prior", CVPR 2009, without patches.
    """
    darkest = by_parts(srgb_decode, images.amin(dim=1))  # the decoding is monotone
    mean = luminance_of(images).mean(dim=(1, 2), dtype=torch.float64)
    return percentile(darkest.flatten(1), 0.02) / mean.clamp(min=DARK)


def blur_effect(images: torch.Tensor) -> torch.Tensor:
    """Crete's blur effect in [0, 1]: the share of the gradient that survives more blur.

    Differences of neighbours along rows, before and after a mean over 9 pixels: 1 minus the sum of
    what they lose over the sum of what there was; the same along columns; the larger of the two. A
    picture without any gradient counts as blurred.

    Source: F. Crete, T. Dolmiere, P. Ladret, M. Nicolas, "The blur effect: perception and
    estimation with a new no-reference perceptual blur metric", SPIE 6492, 2007.
    """
    luma = luma_of(images)
    return torch.maximum(_row_blur(luma), _row_blur(luma.transpose(1, 2).contiguous()))


def _row_blur(luma: torch.Tensor) -> torch.Tensor:
    if luma.shape[2] < 2:
        return luma.new_zeros(len(luma), dtype=torch.float64)

    def sums(part: torch.Tensor) -> torch.Tensor:
        wide = avg_pool2d(pad(part[:, None], (4, 4, 0, 0), mode="replicate"), (1, 9), stride=1)[
            :, 0
        ]
        sharp, blurred = part.diff(dim=2).abs_(), wide.diff(dim=2).abs_()
        lost = (sharp - blurred).clamp_(min=0.0)
        total = [x.sum(dim=(1, 2), dtype=torch.float64) for x in (lost, sharp)]
        return torch.stack(total, dim=1)

    lost, sharp = by_parts(sums, luma).unbind(dim=1)
    return 1.0 - lost / sharp.clamp(min=1e-6)


def percentile(rows: torch.Tensor, share: float) -> torch.Tensor:
    """Nearest-rank percentile (B,) float64 of `rows` (B, N); `share` in [0, 1]."""
    rank = 1 + round(share * (rows.shape[1] - 1))
    return rows.kthvalue(rank, dim=1).values.double()
