"""Severity of six photographic defects, by weight-free measures of the developed picture.

The defects, and that saturation has a sign, are those of N. Yu, X. Shen, Z. Lin, R. Mech and
C. Barnes, "Learning to detect multiple photographic defects", WACV 2018 (without bad composition),
who trained a network on people's labels. These measures are no such network: each is one number of
the picture, its sign, and a monotone map from the sign to the severity that was rendered, fitted on
bundled training scenes. How far to trust them: docs/results/defects.md.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch.nn.functional import avg_pool2d, pad

from ae_env.scorers.captures import Captures, Domain
from ae_env.scorers.measures import by_parts, immerkaer_sigma, luma_of, luminance_of, srgb_decode
from ae_env.scorers.terms import CompositeScorer

# -- signs: one number of the picture for each defect ---------------------------------------------
# All take gamma-encoded sRGB pictures (B, 3, H, W) in [0, 1] and return (B,) float64. Each grows
# with its defect, but also differs from scene to scene.

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

    return by_parts(ratios, images).median(dim=2).values.double().square().sum(dim=1).sqrt()


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

    Linear light. Without haze, pictures have pixels dark in one channel; their light is airlight.

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
        padded = pad(part[:, None], (4, 4, 0, 0), mode="replicate")
        wide = avg_pool2d(padded, (1, 9), stride=1)[:, 0]
        sharp, blurred = part.diff(dim=2).abs_(), wide.diff(dim=2).abs_()
        lost = (sharp - blurred).clamp_(min=0.0)
        return torch.stack([x.sum(dim=(1, 2), dtype=torch.float64) for x in (lost, sharp)], dim=1)

    lost, sharp = by_parts(sums, luma).unbind(dim=1)
    return 1.0 - lost / sharp.clamp(min=1e-6)


def percentile(rows: torch.Tensor, share: float) -> torch.Tensor:
    """Nearest-rank percentile (B,) float64 of `rows` (B, N); `share` in [0, 1]."""
    return rows.kthvalue(1 + round(share * (rows.shape[1] - 1)), dim=1).values.double()


# -- severities: signs mapped to [0, 1] -----------------------------------------------------------

#: Fitted maps: signs, and the severity at each; linear in between, constant beyond. Fitted by
#: ``ae-env bench defects``, which prints them, on 128 x 128 renderings of bundled training scenes.
_MAPS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "over_exposure": (
        (0.0, 0.0004, 0.0031, 0.0127, 0.1282, 0.518, 1.0),
        (0.0111, 0.0392, 0.0392, 0.4866, 0.4902, 0.5205, 0.8544),
    ),
    "under_exposure": (
        (0.0, 0.1727, 0.3547, 0.5365, 0.6893, 0.932),
        (0.027, 0.1067, 0.1899, 0.415, 0.7127, 1.0),
    ),
    "noise": (
        (0.451, 3.1809, 5.0546, 7.2884, 9.3885, 11.5756, 14.3352, 17.5641, 24.4357),
        (0.0, 0.0839, 0.2325, 0.4034, 0.5752, 0.6436, 0.7442, 0.8384, 1.0),
    ),
    "white_balance": (
        (0.0, 0.2147, 0.4682, 0.7693, 1.0715, 1.425, 1.8064, 2.3707, 7.4135),
        (0.1062, 0.1062, 0.2175, 0.3704, 0.521, 0.6421, 0.764, 0.8735, 1.0),
    ),
    "saturation": (
        (0.0, 1.7307, 4.3428, 6.9906, 10.0612, 13.9106, 19.5304, 28.9142, 125.7316),
        (-0.7655, -0.7491, -0.3677, -0.0639, 0.1381, 0.2304, 0.3291, 0.5512, 1.0),
    ),
    "haze": (
        (0.0003, 0.2808, 0.4464, 0.5758, 0.6847, 0.767, 0.8346, 0.8989, 0.9882),
        (0.0, 0.0866, 0.2576, 0.3879, 0.5399, 0.6529, 0.7574, 0.8592, 0.9136),
    ),
    "blur": (
        (0.1892, 0.2799, 0.3263, 0.3758, 0.432, 0.4878, 0.5444, 0.6124, 0.8107),
        (0.0074, 0.1337, 0.2171, 0.3505, 0.5291, 0.6752, 0.7796, 0.8314, 0.9583),
    ),
}
#: Knots (sign, severity) of each map.
KNOTS = {name: tuple(zip(*values, strict=True)) for name, values in _MAPS.items()}
#: Sign that each map takes.
SIGNS: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "over_exposure": white_share,
    "under_exposure": missing_highlights,
    "noise": noise_sigma,
    "white_balance": colour_cast,
    "saturation": colourfulness,
    "haze": veil,
    "blur": blur_effect,
}
#: The defects whose severity is estimated.
DEFECTS = ("exposure", "noise", "white_balance", "saturation", "haze", "blur")


def severity(defect: str, images: torch.Tensor) -> torch.Tensor:
    """Estimated severity (B,) float64 of one of `DEFECTS` in sRGB `images` (B, 3, H, W) in [0, 1].

    In [0, 1], or of ``"saturation"`` in [-1, 1], negative where the colours are too weak; each
    scorer's docstring says what 1 stands for.
    """
    if defect != "exposure":
        return mapped(defect, SIGNS[defect](images))
    sides = ("over_exposure", "under_exposure")
    over, under = (mapped(side, SIGNS[side](images)) for side in sides)
    return torch.maximum(over, under)


def mapped(name: str, sign: torch.Tensor) -> torch.Tensor:
    """Severity (B,) float64 by the map `name` of `KNOTS`, of signs (B,)."""
    return torch.from_numpy(np.interp(sign.double().cpu().numpy(), *_MAPS[name])).to(sign.device)


class _Analytic:
    """1 - |severity| of one defect."""

    domain: Domain = "srgb"
    defect: str

    def __init_subclass__(cls, defect: str) -> None:
        cls.defect = defect

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        return 1.0 - severity(self.defect, images).abs_()


class AnalyticExposure(_Analytic, defect="exposure"):
    """1 - severity of wrong exposure, from white pixels or missing highlights.

    The larger of two maps: of the share of the pixels whose luma is above 0.98, and of 1 minus the
    99th percentile of the luma. 1 stands for 4 EV too much or too little. Night without lamps looks
    under-exposed to it, snow and lamps over-exposed: `brightness` knows the light, this does not.
    """


class AnalyticNoise(_Analytic, defect="noise"):
    """1 - severity of noise, from Immerkaer's estimate on the luma.

    1 stands for photon noise of half the signal of an 18 % card (4 photons a pixel). Fine texture
    counts as noise, blur hides it.
    """


class AnalyticWhiteBalance(_Analytic, defect="white_balance"):
    """1 - severity of a wrong white balance, from the median colour ratios.

    1 stands for gains of red and blue that are each a stop off. A scene of one colour (grass, a
    sunset) looks off balance to it.
    """


class AnalyticSaturation(_Analytic, defect="saturation"):
    """1 - |severity| of weak or strong colours, from Hasler and Suesstrunk's colourfulness.

    -1 stands for a grey picture, 1 for twice the distance of every pixel from its luma.
    """


class AnalyticHaze(_Analytic, defect="haze"):
    """1 - severity of haze, from the light in the darkest pixels (dark channel).

    1 stands for a picture that is 80 % airlight. Pictures without dark pixels (snow, an even
    surface, over-exposure) look hazy to it.
    """


class AnalyticBlur(_Analytic, defect="blur"):
    """1 - severity of blur, from Crete's blur effect on the luma.

    1 stands for a disc of 8 pixels of the frame. Noise hides blur; smooth scenes look blurred.
    """


#: The measures of single defects, by the names that they are registered under.
ANALYTIC: dict[str, type[_Analytic]] = {
    f"analytic_{kind.defect}": kind for kind in _Analytic.__subclasses__()
}


class Defects(CompositeScorer):
    """A picture is nearly as bad as its worst defect: the six `analytic_*` measures together.

    ``1 - (0.75 max + 0.25 mean)`` of the six \\|severities\\|. A mean alone would forgive a useless
    picture five sixths of its one fault; a maximum alone would not see the other five.
    """

    worst_share = 0.75

    def __init__(self) -> None:
        parts: dict[str, Any] = {name: measure() for name, measure in ANALYTIC.items()}
        super().__init__(parts)

    def combine(self, scores: Mapping[str, Any]) -> Any:
        """Total score from the parts' scores: tensors or arrays of any one shape."""
        values = [scores[name] for name in self.parts]
        worst, mean = values[0], sum(values) / len(values)
        for value in values[1:]:
            worst = worst - (worst - value).clip(0.0, None)  # the smaller, of arrays or tensors
        return (self.worst_share * worst + (1.0 - self.worst_share) * mean).clip(0.0, 1.0)
