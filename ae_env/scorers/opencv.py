"""Scorers by OpenCV: ORB keypoints, and the matches of keypoints for tracking."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from ae_env.scorers.fidelity import distinct_references, reference_pictures
from ae_env.scorers.measures import luma_of
from ae_env.scorers.protocol import Captures, DependsOn, Domain


def opencv() -> Any:
    """The module cv2, or an `ImportError` that names the extra."""
    try:
        import cv2
    except ImportError:
        raise ImportError(
            "the scorers keypoints and matches need OpenCV: pip install 'ae-env[cv]'"
        ) from None
    return cv2


def luma_bytes(images: torch.Tensor) -> np.ndarray:
    """Luma (B, H, W) uint8 of sRGB pictures (B, 3, H, W) in [0, 1]."""
    return luma_of(images).clamp(0.0, 1.0).mul(255.0).round().to("cpu", torch.uint8).numpy()


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


class Keypoints:
    """Number of ORB keypoints: 1 - exp(-n / n0), n0 = 15 per 1000 pixels inside ORB's border.

    Rublee et al., ORB: an efficient alternative to SIFT or SURF, ICCV 2011, in OpenCV with its FAST
    threshold of 20 of 255, patches and a border of 15 pixels, and at most 60 keypoints per 1000
    pixels. A frame of 30 pixels a side or less has none. ORB takes strong noise for corners: pair
    it with ``noise``, or use ``matches``.

    Raises:
        ImportError: If OpenCV is not installed.
    """

    domain: Domain = "srgb"
    depends_on: DependsOn = "image"
    needs = "extra cv"
    version = 1

    def __init__(self) -> None:
        opencv()

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,) of sRGB `images` (B, 3, H, W)."""
        assert images is not None
        height, width = images.shape[2:]
        orb = _detector(height, width)
        counts = [len(orb.detect(picture, None)) for picture in luma_bytes(images)]
        typical = _inside(height, width) * TYPICAL_PER_1000 / 1000.0
        return 1.0 - torch.exp(-torch.tensor(counts, dtype=torch.float64) / typical)


class Matches:
    """Share of a well-exposed, noise-free reference's ORB keypoints that are found again.

    The reference is the scene's light at the right exposure (``captures.proper_ev``), without noise
    and blur, developed as the capture is. Of each picture the 500 strongest keypoints count.
    Descriptors are matched by Hamming distance, each the other's nearest. Both pictures show the
    scene from the same place, so a match is an inlier where its two ends lie within 1/64 of the
    picture's height: the true transform is the identity and need not be estimated by RANSAC.
    Without a keypoint in the reference the score is 0 in every state.

    Raises:
        ImportError: If OpenCV is not installed.
    """

    domain: Domain = "srgb"
    depends_on: DependsOn = "image"
    needs = "extra cv"
    version = 1

    def __init__(self) -> None:
        opencv()

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,) of sRGB `images` (B, 3, H, W)."""
        assert images is not None
        cv2 = opencv()
        height, width = images.shape[2:]
        orb = _detector(height, width, MOST_MATCHED)
        matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        first, which = distinct_references(captures)
        references = [
            orb.detectAndCompute(picture, None)
            for picture in luma_bytes(reference_pictures(captures, first))
        ]
        scores = []
        for picture, reference in zip(luma_bytes(images), which, strict=True):
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
