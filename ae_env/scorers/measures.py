"""Measures of one developed picture: exposure, detail and noise, and the scorers that they make.

The functions take luma (B, H, W) in [0, 1], gamma-encoded as in an 8-bit picture, and return (B,)
float64 or, of each pixel, (B, H, W). None of the exposure scorers knows the incident light: they
want every scene middle grey.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch.nn.functional import adaptive_avg_pool2d, pad

from ae_env.scorers.captures import Captures, DependsOn, Domain

#: R, G, B shares of luma (ITU-R BT.601), of gamma-encoded values: an 8-bit camera's grey.
LUMA_SHARES = (0.299, 0.587, 0.114)
#: R, G, B shares of CIE Y (IEC 61966-2-1), of linear sRGB.
LUMINANCE_SHARES = (0.2126, 0.7152, 0.0722)
#: Weight of the middle and of each side in one direction of a gradient filter, and of all together.
SOBEL = (2.0, 1.0)
SCHARR = (10.0, 3.0)
#: Samples that `by_parts` gives to a function at a time.
_PART = 2**18


def luma_of(images: torch.Tensor) -> torch.Tensor:
    """Luma (B, H, W) in [0, 1] of gamma-encoded sRGB `images` (B, 3, H, W) in [0, 1].

    >>> luma_of(torch.ones(1, 3, 1, 1)).item()
    1.0
    """
    red, green, blue = images.unbind(dim=1)
    r, g, b = LUMA_SHARES
    return (red * r).add_(green, alpha=g).add_(blue, alpha=b).clamp_(0.0, 1.0)


def luma_codes(images: torch.Tensor) -> np.ndarray:
    """Luma (B, H, W) of sRGB `images` (B, 3, H, W) in [0, 1] as 8-bit codes."""
    return luma_of(images).mul_(255.0).round_().to("cpu", torch.uint8).numpy()


def srgb_decode(encoded: torch.Tensor) -> torch.Tensor:
    """sRGB values in [0, 1] to linear light in [0, 1] (IEC 61966-2-1).

    >>> round(srgb_decode(torch.tensor([0.4614])).item(), 3)
    0.18
    """
    toe = encoded.mul(1.0 / 12.92).sub_(0.04045 / 12.92).clamp_(max=0.0)  # 0 above it
    curved = encoded.clamp(min=0.04045).add_(0.055).mul_(1.0 / 1.055).log2_().mul_(2.4).exp2_()
    return curved.add_(toe).clamp_(min=0.0)


def luminance_of(images: torch.Tensor) -> torch.Tensor:
    """Linear CIE Y (B, H, W) in [0, 1], 1 is white, of sRGB `images` (B, 3, H, W) in [0, 1]."""

    def luminance(part: torch.Tensor) -> torch.Tensor:
        red, green, blue = srgb_decode(part).unbind(dim=1)
        r, g, b = LUMINANCE_SHARES
        return (red * r).add_(green, alpha=g).add_(blue, alpha=b)

    return by_parts(luminance, images)


def by_parts(
    function: Callable[[torch.Tensor], torch.Tensor], images: torch.Tensor
) -> torch.Tensor:
    """`function` of a few `images` (B, ...) at a time, as one batch.

    Those stay in the CPU's cache: several times as fast where a function takes many steps.
    """
    step = len(images)
    if images.device.type == "cpu":
        step = max(1, _PART // max(1, images[0].numel()))
    return torch.cat([function(part) for part in images.split(step)])  # type: ignore[no-untyped-call]


def squared_gradient(luma: torch.Tensor, weights: tuple[float, float]) -> torch.Tensor:
    """gx^2 + gy^2 (B, H, W) of 3 x 3 difference filters, borders repeated; `luma` in any range.

    `weights` are of the middle row (column) and of the two beside it, such as `SOBEL`. The filters
    are not normalised: a step of 1 gives ``middle + 2 * side``.
    """
    middle, side = weights
    padded = pad(luma[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    across = padded[:, :, 2:] - padded[:, :, :-2]  # (B, H + 2, W)
    gx = (across[:, :-2] + across[:, 2:]).mul_(side).add_(across[:, 1:-1], alpha=middle)
    down = padded[:, 2:] - padded[:, :-2]  # (B, H, W + 2)
    gy = (down[:, :, :-2] + down[:, :, 2:]).mul_(side).add_(down[:, :, 1:-1], alpha=middle)
    return gx.square_().add_(gy.square_())


def check_luma(luma: torch.Tensor) -> torch.Tensor:
    """`luma` as it is; a `ValueError` unless it is floating point (B, H, W) with pixels."""
    known = torch.is_tensor(luma) and luma.is_floating_point() and luma.ndim == 3
    if not known or min(luma.shape[1:]) < 1:
        what = f"{tuple(luma.shape)} {luma.dtype}" if torch.is_tensor(luma) else repr(luma)
        raise ValueError(f"`luma` (={what}) must be a floating point tensor (B, H, W) with pixels")
    return luma


# -- detail ---------------------------------------------------------------------------------------

#: Grey levels of the histogram.
LEVELS = 256
#: Largest squared Sobel gradient that Shim's metric assumes, of luma in [0, 1]: 4^2 + 4^2; and the
#: sum of each side of Scharr's filter, with which gradients are grey levels per pixel.
_LARGEST_SOBEL, _SCHARR_SUM = 32.0, 32.0
#: As the papers have them: delta and lambda of Shim; p and k of Zhang; alpha, beta, K_g and K_e
#: [1 / bit] of Shin.
_DELTA, _LAMBDA = 0.06, 1000.0
_PERCENTILE, _CONCENTRATION = 0.7, 5.0
_ALPHA, _BETA, _GRADIENT_GAIN, _ENTROPY_GAIN = 0.4, 0.4, 2.0, 0.125


def histogram_entropy(luma: torch.Tensor) -> torch.Tensor:
    """Entropy of the histogram of 256 grey levels [bit], in [0, 8].

    ``-sum p log2 p`` (C. E. Shannon, 1948) over the levels ``round(255 luma)``.

    >>> histogram_entropy(torch.tensor([[[0.0, 1.0], [0.0, 1.0]]])).item()
    1.0
    """
    count = len(check_luma(luma))
    codes = luma.mul(LEVELS - 1.0).round_().clamp_(0, LEVELS - 1).long().reshape(count, -1)
    codes += LEVELS * torch.arange(count, device=luma.device)[:, None]
    bins = torch.bincount(codes.flatten(), minlength=LEVELS * count).reshape(count, LEVELS)
    shares = bins.double() / codes.shape[1]
    return torch.special.entr(shares).sum(dim=1).div_(math.log(2.0)).clamp_(min=0.0)


def shim_response(luma: torch.Tensor) -> torch.Tensor:
    """Shim's logarithmic response (B, H, W) in [0, 1] to the gradient of each pixel.

    With m = \\|Sobel\\| / sqrt(32), of luma in [0, 1], delta = 0.06 and lambda = 1000:
    ``log(lambda (m - delta) + 1) / log(lambda (1 - delta) + 1)`` where m >= delta, else 0.
    """
    gradient = squared_gradient(check_luma(luma), SOBEL).mul_(1.0 / _LARGEST_SOBEL).sqrt_()
    above = gradient.sub_(_DELTA).clamp_(min=0.0).mul_(_LAMBDA)
    return above.log1p_().mul_(1.0 / math.log1p(_LAMBDA * (1.0 - _DELTA)))


def shim_gradient(luma: torch.Tensor, mask: Any = None) -> torch.Tensor:
    """Shim's gradient information: mean over the pixels of `shim_response`, in [0, 1].

    The paper sums over the pixels; the mean does not depend on the size. Of `mask` (H, W) bool are
    the pixels that count.

    Source: I. Shim, J.-Y. Lee, I. S. Kweon, "Auto-adjusting camera exposure for outdoor robotics
    using gradient information", IROS 2014; delta 0.06, lambda 1000.
    """
    return _within(shim_response(luma), mask).mean(dim=(1, 2), dtype=torch.float64)


def _within(values: torch.Tensor, mask: Any) -> torch.Tensor:
    """Those of (B, H, W) within `mask` (H, W), as one row (B, 1, K); all without a mask."""
    return values if mask is None else values[:, torch.as_tensor(mask)][:, None]


def zhang_gradient(luma: torch.Tensor, mask: Any = None) -> torch.Tensor:
    """Zhang's soft percentile of the squared gradient [(grey levels of 255 per pixel)^2].

    The squared gradients G (Scharr's filter over 32) of the S pixels are sorted, ascending, and
    averaged with weights ``sin(pi/2 i / (n - 1))^k`` for i < n and
    ``sin(pi/2 - pi/2 (i - n + 1) / (S - n))^k`` above, n = floor(p S), i from 0. Its range is
    0 to 2 * 127.5^2. The percentile p = 0.7 counts most, k = 5 is the concentration around it.
    Of `mask` (H, W) bool are the pixels that count.

    Source: Z. Zhang, C. Forster, D. Scaramuzza, "Active exposure control for robust visual odometry
    in HDR environments", ICRA 2017; p 0.7, k 5.
    """
    squares = _within(squared_gradient(check_luma(luma), SCHARR), mask).flatten(1)
    if squares.device.type == "cpu":  # numpy sorts several times as fast
        ascending = torch.from_numpy(np.sort(squares.detach().numpy(), axis=1))
    else:
        ascending = squares.sort(dim=1).values
    weights = _percentile_weights(squares.shape[1]).to(squares)
    return (ascending * weights).sum(dim=1, dtype=torch.float64).mul_((255.0 / _SCHARR_SUM) ** 2)


def _percentile_weights(samples: int) -> torch.Tensor:
    """(samples,) float64 weights of Zhang's metric; they sum to 1, or are 0 for one sample."""
    index, split = torch.arange(samples, dtype=torch.float64), math.floor(_PERCENTILE * samples)
    rising = index / max(split - 1, 1)
    falling = 1.0 - (index - split + 1.0) / (samples - split)
    angle = torch.where(index < split, rising, falling) * (0.5 * math.pi)
    weights = angle.sin().clamp_(min=0.0) ** _CONCENTRATION
    return weights / weights.sum().clamp(min=1e-300)


# -- noise, and the metric that weighs detail against it ------------------------------------------


def immerkaer_response(luma: torch.Tensor) -> torch.Tensor:
    """|I * N| (B, H, W), N = [1 -2 1; -2 4 -2; 1 -2 1], borders repeated; in units of `luma`.

    Flat areas, straight slopes and edges along rows or columns give 0.
    """
    padded = pad(luma[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    across = (padded[:, :, :-2] + padded[:, :, 2:]).sub_(padded[:, :, 1:-1], alpha=2.0)
    return (across[:, :-2] + across[:, 2:]).sub_(across[:, 1:-1], alpha=2.0).abs_()


def immerkaer_sigma(luma: torch.Tensor) -> torch.Tensor:
    """Standard deviation of the noise [grey levels of 255], estimated from one picture.

    ``sqrt(pi / 2) / (6 (W - 2) (H - 2))`` times the sum of `immerkaer_response` over the pixels
    that have all eight neighbours; 0 where there are none. Fine texture is read as noise.

    Source: J. Immerkaer, "Fast noise variance estimation", Computer Vision and Image Understanding
    64(2), 1996.
    """
    if min(check_luma(luma).shape[1:]) < 3:
        return luma.new_zeros(len(luma), dtype=torch.float64)
    inner = immerkaer_response(luma)[:, 1:-1, 1:-1].mean(dim=(1, 2), dtype=torch.float64)
    return inner * (255.0 * math.sqrt(0.5 * math.pi) / 6.0)


def shin_metric(luma: torch.Tensor) -> torch.Tensor:
    """Shin's noise-aware metric: ``alpha K_g L_grad + (1 - alpha) K_e H - beta L_noise``.

    L_grad is mean over standard deviation (of a sample) of the means of `shim_response` in a grid
    of 10 x 10 cells, 0 where there is no gradient and at most 1000; H is `histogram_entropy`;
    L_noise is `shin_noise`. About -10 to 3, with alpha = beta = 0.4, K_g = 2 and K_e = 1/8.

    Source: U. Shin, J. Park, G. Shim, F. Rameau, I. S. Kweon, "Camera exposure control for robust
    robot vision with noise-aware image quality assessment", IROS 2019, with the factor of 1/6 in
    the noise that the authors' code adds.
    """
    cells = adaptive_avg_pool2d(shim_response(luma).double(), 10).flatten(1)  # (B, 100)
    mean, deviation = cells.mean(dim=1), cells.std(dim=1)
    uniformity = (mean / deviation.clamp(min=1e-12)).clamp_(max=1000.0)
    detail = _ALPHA * _GRADIENT_GAIN * uniformity
    detail += (1.0 - _ALPHA) * _ENTROPY_GAIN * histogram_entropy(luma)
    return detail - _BETA * shin_noise(luma)


def shin_noise(luma: torch.Tensor) -> torch.Tensor:
    """Shin's noise estimate (B,) float64 [grey levels of 255]: Immerkaer's on flat pixels.

    Over the pixels in 15 to 235 grey levels whose squared Sobel gradient is at or below the 10th
    percentile; over all pixels where fewer than one in 10,000 are such.
    """
    count = len(check_luma(luma))
    squares = squared_gradient(luma, SOBEL).reshape(count, -1)
    samples = squares.shape[1]
    percentile = squares.kthvalue(max(1, round(0.1 * samples)), dim=1, keepdim=True).values
    levels = (255.0 * luma).reshape(count, -1)
    used = (squares <= percentile) & (levels >= 15.0) & (levels <= 235.0)
    number = used.sum(dim=1)
    response = (immerkaer_response(luma).reshape(count, -1) * used).sum(dim=1, dtype=torch.float64)
    masked = response * (255.0 * math.sqrt(0.5 * math.pi) / 6.0) / number.clamp(min=1)
    return torch.where(number < 1e-4 * samples, immerkaer_sigma(luma), masked)


class Shim:
    """Shim's gradient information (2014), weak gradients included: `shim_gradient` as it is."""

    domain: Domain = "srgb"

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        return shim_gradient(luma_of(images))


class Zhang:
    """Zhang's soft percentile of the squared gradient (2017): higher with more contrast.

    ``g / (g + 16^2)``, g from `zhang_gradient`: 0.5 where the gradient at the percentile is 16 grey
    levels of 255 per pixel.
    """

    domain: Domain = "srgb"
    half = 256.0

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        gradient = zhang_gradient(luma_of(images))
        return gradient / (gradient + self.half)


class Shin:
    """Shin's noise-aware metric (2019): even detail and entropy, less the noise.

    ``(1 + f / (1 + |f|)) / 2``, f from `shin_metric`: 0.5 at 0, 0.75 at 1, 0.11 at -3.5.
    """

    domain: Domain = "srgb"

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        metric = shin_metric(luma_of(images))
        return 0.5 + 0.5 * metric / (1.0 + metric.abs())


class SignalToNoise:
    """Signal-to-noise ratio of native pixels by the noise level function, in dB.

    Mean over pixels and planes of ``10 log10(min(x, 1)^2 / (shot x + read))``, each held to 0 to
    50 dB, over 50 dB; the camera's PRNU adds ``(prnu x)^2`` to the variance. x is the noise-free
    signal before blur and clip. The noise is that of the sensor's own pixels, not of the
    box-averaged frame. 50 dB is about what a full-frame sensor reaches at white at ISO 100 (Nikon
    Z6: 51.3 dB).
    """

    domain: Domain = "raw"
    depends_on: DependsOn = "light"
    ceiling_db = 50.0

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        shot = torch.tensor([n.shot for n in captures.nlf])[:, :, None, None]
        read = torch.tensor([n.read for n in captures.nlf])[:, :, None, None]
        light = captures.light.clamp(min=0.0)
        variance = (light * shot.to(light)).add_(read.to(light)).clamp_(min=1e-30)
        variance = variance.add_((captures.prnu * light).square_()) if captures.prnu else variance
        power = light.clamp_(max=1.0).square_().div_(variance)
        decibels = power.clamp_(min=1.0).log10_().mul_(10.0).clamp_(max=self.ceiling_db)
        return decibels.mean(dim=(1, 2, 3), dtype=torch.float64) / self.ceiling_db


class BlindNoise:
    """Noise estimated from the developed picture alone (Immerkaer 1996): less is better.

    ``1 / (1 + sigma / 10)``, sigma from `immerkaer_sigma` of the luma in grey levels of 255: 0.5
    where it is 10. Fine texture lowers it, too, and blur and clipping raise it.
    """

    domain: Domain = "srgb"
    half = 10.0

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        return 1.0 / (1.0 + immerkaer_sigma(luma_of(images)) / self.half)


# -- scorers of exposure --------------------------------------------------------------------------


class MidGrey:
    """Mean luminance against 18 % grey: ``2^-|log2(mean Y / 0.18)|``.

    Y is the linear luminance (CIE, white is 1) of the developed picture, whose tone curve shows an
    18 % card in incident-light exposure at 0.18. A stop off scores 0.5, two stops 0.25, black 0.

    Source: the photographers' convention of the 18 % card as the mean of a scene.
    """

    domain: Domain = "srgb"
    target = 0.18

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
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

        def kept(part: torch.Tensor) -> torch.Tensor:
            samples = part.flatten(1)
            high = (samples >= self.white).sum(dim=1).double()
            low = (samples <= self.black).sum(dim=1).double()
            lost = self.high_weight * high + self.low_weight * low
            return (1.0 - lost / samples.shape[1]).clamp_(min=0.0)

        return by_parts(kept, images)


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
        squares = (images - self.centre).square_().sum(dim=1)  # of the product: a sum of exponents
        return squares.mul_(-0.5 / self.sigma**2).exp_().mean(dim=(1, 2), dtype=torch.float64)


class Entropy:
    """Entropy of the luma histogram (`histogram_entropy`) over its 8 bits. Noise raises it."""

    domain: Domain = "srgb"

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        return histogram_entropy(luma_of(images)) / 8.0
