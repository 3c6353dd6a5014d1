"""Fidelity: a capture against the picture that its scene should give.

That picture is without noise and blur, exposed for the incident light and developed as the capture
is. Nothing is trained on it: it is the judge of agents that were trained on other scorers.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from skimage.color import deltaE_ciede2000, rgb2lab
from skimage.metrics import structural_similarity

from ae_env.scorers.composite import developed
from ae_env.scorers.protocol import Captures, DependsOn, Domain

#: CIEDE2000 difference that brings the colour term to 1/e: plainly another colour.
COLOUR_SCALE = 10.0
#: Range of L*, for the structural similarity; its Gaussian window's standard deviation and side
#: [pixel]. Pictures are mirrored at their borders, so that every pixel counts, in any size.
_LIGHTNESS, _SIGMA, _WINDOW = 100.0, 1.5, 11


class Fidelity:
    """Likeness to the ideal picture: ``sqrt(colour * structure)``.

    Colour is ``exp(-d / 10)``, d the mean CIEDE2000 difference over the pixels (Sharma, Wu and
    Dalal 2005); structure the structural similarity of lightness L* (Wang et al. 2004, Gaussian
    window of 1.5 pixels), at least 0. The ideal picture itself scores 1.
    """

    domain: Domain = "srgb"
    depends_on: DependsOn = "image"
    version = 1

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,) of sRGB `images` (B, 3, H, W)."""
        assert images is not None
        first, which = distinct_references(captures)
        ideal = [_lab(picture) for picture in reference_pictures(captures, first)]
        scores = [
            likeness(_lab(image), ideal[reference])
            for image, reference in zip(images, which, strict=True)
        ]
        return torch.tensor(scores, dtype=torch.float64)


def likeness(picture: np.ndarray, ideal: np.ndarray) -> float:
    """The score of a picture (H, W, 3) in CIELAB beside the ideal one."""
    difference = deltaE_ciede2000(picture, ideal)  # type: ignore[no-untyped-call]
    colour = math.exp(-float(difference.mean()) / COLOUR_SCALE)
    structure = structural_similarity(  # type: ignore[no-untyped-call]
        *(np.pad(p[..., 0], _WINDOW // 2, mode="symmetric") for p in (picture, ideal)),
        data_range=_LIGHTNESS,
        gaussian_weights=True,
        sigma=_SIGMA,
        use_sample_covariance=False,
    )
    return math.sqrt(colour * max(float(structure), 0.0))


def _lab(picture: torch.Tensor) -> np.ndarray:
    return np.asarray(rgb2lab(picture.permute(1, 2, 0).double().numpy()))


def reference_pictures(captures: Captures, which: list[int]) -> torch.Tensor:
    """sRGB (N, 3, H, W) of the captures' scenes at the right exposure, without noise and blur.

    Args:
        captures: The captures.
        which: Indices of N of them.
    """
    ratio = captures.ratio * torch.exp2(captures.ev100 - captures.proper_ev)
    light = captures.scene_light[which] * ratio[which].to(captures.scene_light)[:, None, None, None]
    return developed(
        light.clamp(0.0, 1.0),
        captures.white_balance[which],
        [captures.colour_matrices[i] for i in which],
    )


def distinct_references(captures: Captures) -> tuple[list[int], list[int]]:
    """The first capture of each distinct reference, and the index of each capture's reference."""
    first: list[int] = []
    which: list[int] = []
    by_key: dict[tuple[str, float], int] = {}
    exposure = captures.ratio * torch.exp2(captures.ev100 - captures.proper_ev)
    light = captures.scene_light
    for i, (scene, ratio) in enumerate(zip(captures.scene_ids, exposure.tolist(), strict=True)):
        key = scene, round(math.log2(ratio), 6) if 0 < ratio < math.inf else ratio
        known = by_key.get(key)
        if known is None or not torch.equal(light[i], light[first[known]]):
            known = by_key[key] = len(first)
            first.append(i)
        which.append(known)
    return first, which
