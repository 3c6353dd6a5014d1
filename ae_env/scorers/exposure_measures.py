"""Classic measures of exposure: brightness, clipping and the histogram.

Unlike `brightness`, none of them knows the incident light: they want every scene middle grey.
"""

from __future__ import annotations

import torch

from ae_env.scorers.detail import histogram_entropy
from ae_env.scorers.luma import by_parts, luma_of, luminance_of
from ae_env.scorers.protocol import Captures, DependsOn, Domain


class MidGrey:
    """Mean luminance against 18 % grey: ``2^-|log2(mean Y / 0.18)|``.

    Y is the linear luminance (CIE, white is 1) of the developed picture, whose tone curve shows an
    18 % card in incident-light exposure at 0.18. A stop off scores 0.5, two stops 0.25, black 0.

    Source: the photographers' convention of the 18 % card as the mean of a scene.
    """

    domain: Domain = "srgb"
    target = 0.18

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        ratio = luminance_of(images).mean(dim=(1, 2), dtype=torch.float64) / self.target
        return torch.minimum(ratio, 1.0 / ratio.clamp(min=1e-30))


class Clipping:
    """Share of raw samples that are neither blown nor black: ``1 - (w_h f_h + w_l f_l)``.

    f_h is the share of the samples of all four planes at sensor white, f_l that at or below
    2^-9 of white, where `shadows` has its middle. Both weights are 1. Alone it prefers dark
    pictures: nothing clips there.
    """

    domain: Domain = "raw"
    high_weight = 1.0
    low_weight = 1.0
    white = 1.0 - 1e-6  # rounding
    black = 2.0**-9

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        return by_parts(self._kept, images)

    def _kept(self, images: torch.Tensor) -> torch.Tensor:
        samples = images.flatten(1)
        high = (samples >= self.white).sum(dim=1).double()
        low = (samples <= self.black).sum(dim=1).double()
        lost = self.high_weight * high + self.low_weight * low
        return (1.0 - lost / samples.shape[1]).clamp_(min=0.0)


class DynamicRange:
    """Share of a sensor's range that the light fills: stops from its 1st to 99th percentile / 14.

    Of the noise-free mean green x, held to [x_1, 1]: from the signal at which the signal-to-noise
    ratio of a native pixel is 1, ``x_1 = (shot + sqrt(shot^2 + 4 read)) / 2``, to white (the range
    as in EMVA 1288). ``min(log2(P99 / P1) / 14, 1)``; 14 stops is what a full-frame sensor has at
    ISO 100 (Nikon Z6: 13.6). Percentiles are of the nearest rank.
    """

    domain: Domain = "raw"
    depends_on: DependsOn = "light"
    stops = 14.0
    percentiles = (0.01, 0.99)

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        shot = torch.tensor([0.5 * (n.shot[1] + n.shot[2]) for n in captures.nlf]).double()
        read = torch.tensor([0.5 * (n.read[1] + n.read[2]) for n in captures.nlf]).double()
        floor = (0.5 * (shot + (shot**2 + 4.0 * read).sqrt())).clamp_(2.0**-40, 1.0)
        green = captures.light[:, 1:3].mean(dim=1).flatten(1)
        last = green.shape[1] - 1
        ranks = [1 + round(share * last) for share in self.percentiles]
        low, high = (green.kthvalue(rank, dim=1).values.double() for rank in ranks)
        low, high = (end.clamp(max=1.0).maximum(floor) for end in (low, high))
        return ((high / low).log2() / self.stops).clamp_(0.0, 1.0)


class WellExposedness:
    """Mertens' well-exposedness: how near each channel of each pixel is to 0.5.

    Mean over the pixels of the product over R, G, B of ``exp(-(c - 0.5)^2 / (2 * 0.2^2))``, c the
    gamma-encoded value.

    Source: T. Mertens, J. Kautz, F. Van Reeth, "Exposure fusion", Pacific Graphics 2007, section 3.
    """

    domain: Domain = "srgb"
    centre = 0.5
    sigma = 0.2

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        squares = (images - self.centre).square_().sum(dim=1)  # of the product: a sum of exponents
        weights = squares.mul_(-0.5 / self.sigma**2).exp_()
        return weights.mean(dim=(1, 2), dtype=torch.float64)


class Entropy:
    """Entropy of the luma histogram in bits, over the 8 bits of 256 grey levels.

    See `histogram_entropy`. Noise raises it.
    """

    domain: Domain = "srgb"
    bits = 8.0

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        return histogram_entropy(luma_of(images)) / self.bits
