"""Scorers that compare a capture with the picture that its scene should give, and ORB keypoints.

That picture is without noise and blur, exposed for the incident light and developed as the capture
is. `Fidelity` is the judge of agents that were trained on other scorers; nothing is trained on it.
"""

import math
from functools import partial
from typing import Any

import numpy as np
import torch

from ae_env.scorers.captures import Captures, Domain
from ae_env.scorers.measures import luma_codes
from ae_env.scorers.terms import developed
from simulator.utils.checks import import_extra

#: CIEDE2000 difference that brings the colour term to 1/e: plainly another colour.
COLOUR_SCALE = 10.0
#: Range of L*, for the structural similarity; its Gaussian window's standard deviation and side
#: [pixel]. Pictures are mirrored at their borders, so that every pixel counts, in any size.
_LIGHTNESS, _SIGMA, _WINDOW = 100.0, 1.5, 11

#: Keypoints that ORB returns at most, per 1000 pixels inside its border.
MOST_PER_1000 = 60.0
#: Keypoints per 1000 pixels inside the border that score 1 - 1/e.
TYPICAL_PER_1000 = 15.0
#: Keypoints that are matched at most, the strongest ones: OpenCV's own limit.
MOST_MATCHED = 500
#: A matched pair lies at most this share of the picture's height apart.
TOLERANCE = 1.0 / 64.0
#: Side of ORB's descriptor patch, and of the border without keypoints [pixel]: half of OpenCV's
#: own 31, which would leave nothing of a picture of 64 x 64.
_PATCH = 15


class Fidelity:
    """Likeness to the ideal picture: ``sqrt(colour * structure)``.

    Colour is ``exp(-d / 10)``, d the mean CIEDE2000 difference over the pixels (Sharma, Wu and
    Dalal 2005); structure the structural similarity of lightness L* (Wang et al. 2004, Gaussian
    window of 1.5 pixels), at least 0. The ideal picture itself scores 1.
    """

    domain: Domain = "srgb"
    version = 1

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        images, captures = images.cpu(), captures.cpu()  # for scikit-image
        first, which = distinct_references(captures)
        ideal = [_lab(picture) for picture in reference_pictures(captures, first)]
        scores = [
            likeness(_lab(image), ideal[reference])
            for image, reference in zip(images, which, strict=True)
        ]
        return torch.tensor(scores, dtype=torch.float64)


def likeness(picture: np.ndarray, ideal: np.ndarray) -> float:
    """The score of a picture (H, W, 3) in CIELAB beside the ideal one."""
    from skimage.color import deltaE_ciede2000  # not above: they take long
    from skimage.metrics import structural_similarity

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
    from skimage.color import rgb2lab

    return np.asarray(rgb2lab(picture.permute(1, 2, 0).double().numpy()))


def reference_pictures(captures: Captures, which: list[int]) -> torch.Tensor:
    """sRGB (N, 3, H, W) of N captures' scenes at the right exposure, without noise and blur."""
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


# -- keypoints of OpenCV ---------------------------------------------------------------------------


#: The module cv2, or an `ImportError` that names the extra.
opencv = partial(import_extra, "cv2", "cv", "a scorer by keypoints")


def _detector(height: int, width: int, most: float = math.inf) -> Any:
    number = max(1, math.ceil(min(most, _inside(height, width) * MOST_PER_1000 / 1000.0)))
    # Smaller levels than four patches find nothing and take time.
    levels = max(1, min(8, 1 + math.floor(math.log(min(height, width) / (4 * _PATCH) + 1e-9, 1.2))))
    return opencv().ORB_create(
        nfeatures=number, nlevels=levels, edgeThreshold=_PATCH, patchSize=_PATCH
    )


def _inside(height: int, width: int) -> int:
    """Pixels that may be keypoints."""
    return max(1, height - 2 * _PATCH) * max(1, width - 2 * _PATCH)


class _OrbScorer:
    """Base of scorers by ORB keypoints; an `ImportError` where OpenCV is not installed."""

    domain: Domain = "srgb"
    needs = "extra cv"
    version = 1

    def __init__(self) -> None:
        opencv()  # raises now, not at the first score


class Keypoints(_OrbScorer):
    """Number of ORB keypoints: 1 - exp(-n / n0), n0 = 15 per 1000 pixels inside ORB's border.

    Rublee et al., ORB: an efficient alternative to SIFT or SURF, ICCV 2011, in OpenCV with its FAST
    threshold of 20 of 255, patches and a border of 15 pixels, and at most 60 keypoints per 1000
    pixels. A frame of 30 pixels a side or less has none. ORB takes strong noise for corners: pair
    it with ``noise``, or use ``matches``.
    """

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        height, width = images.shape[2:]
        orb = _detector(height, width)
        counts = [len(orb.detect(picture, None)) for picture in luma_codes(images)]
        typical = _inside(height, width) * TYPICAL_PER_1000 / 1000.0
        return 1.0 - torch.exp(-torch.tensor(counts, dtype=torch.float64) / typical)


class Matches(_OrbScorer):
    """Share of a well-exposed, noise-free reference's ORB keypoints that are found again.

    The reference is the scene's light at the right exposure (``captures.proper_ev``), without noise
    and blur, developed as the capture is. Of each picture the 500 strongest keypoints count.
    Descriptors are matched by Hamming distance, each the other's nearest. Both pictures show the
    scene from the same place, so a match is an inlier where its two ends lie within 1/64 of the
    picture's height: the true transform is the identity and need not be estimated by RANSAC.
    Without a keypoint in the reference the score is 0 in every state.
    """

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        cv2 = opencv()
        height, width = images.shape[2:]
        orb = _detector(height, width, MOST_MATCHED)
        matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        first, which = distinct_references(captures)
        references = [
            orb.detectAndCompute(picture, None)
            for picture in luma_codes(reference_pictures(captures, first))
        ]
        scores = []
        for picture, reference in zip(luma_codes(images), which, strict=True):
            points, descriptors = orb.detectAndCompute(picture, None)
            known, wanted = references[reference]
            if descriptors is None or wanted is None:
                scores.append(0.0)
                continue
            inliers = sum(
                math.dist(known[m.queryIdx].pt, points[m.trainIdx].pt) <= TOLERANCE * height
                for m in matcher.match(wanted, descriptors)
            )
            scores.append(inliers / len(known))
        return torch.tensor(scores, dtype=torch.float64)
