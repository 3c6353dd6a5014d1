"""Scorers that read codes: `Legibility` (Data Matrix, zxing-cpp), `Tags` (AprilTag, OpenCV).

The codes are those of a ladder (``scenes="NAME?codes"``), whose texts and places are known: each
code is looked for where it is, and counts when its text is right.
"""

from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np
import torch
from PIL import Image

from ae_env.scenes.ladder import tag_dictionary, zxing
from ae_env.scorers.captures import Captures, Domain
from ae_env.scorers.measures import luma_codes
from simulator.utils.checks import import_extra

#: Pixels of the picture that a reader is given for each of the frame's, per side: both readers want
#: two or three for a module. The rim around a code's cell [pixel of the frame].
_ENLARGED, _RIM = 2, 1
#: Quantiles of a crop's luma that become black and white; nearer codes than that show nothing.
_SPREAD, _LEAST_CODES, _CODES = np.array((0.05, 0.95)), 3, np.arange(256)
#: Reads the texts in a picture (H, W) uint8.
Reader = Callable[[np.ndarray], list[str]]


class _Ladder:
    """Base of scorers by codes; an `ImportError` where their reader is not installed."""

    domain: Domain = "srgb"
    #: Score tables are stored on the disk: reading takes long.
    stored = True
    kind = "codes"

    def __init__(self) -> None:
        self.version = f"1 {self._made()[1]}"  # raises now, not at the first score

    def _made(self) -> tuple[Reader, str]:
        """The reader, and the version of its package."""
        raise NotImplementedError

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        """The share of the codes that are read."""
        found = self.read(images, captures)
        return torch.tensor([float(np.mean(row)) for row in found], dtype=torch.float64)

    def read(self, images: torch.Tensor, captures: Captures) -> list[np.ndarray]:
        """Which codes of each capture (N,) bool are read."""
        for scene, ladder in zip(captures.scene_ids, captures.ladders, strict=True):
            if ladder is None or ladder.kind != self.kind:
                raise ValueError(
                    f"`scenes` ({scene!r}) must have {self.kind} drawn into them for this scorer, "
                    f"such as 'bundled?{self.kind}'"
                )
        reader, ladders = self._made()[0], captures.ladders
        return [_read(reader, *pair) for pair in zip(luma_codes(images), ladders, strict=True)]


def _read(reader: Reader, picture: np.ndarray, ladder: Any) -> np.ndarray:
    """Which codes (N,) bool of a ladder the reader finds in a picture (H, W) uint8."""
    low = np.floor(ladder.corners.min(axis=1) - _RIM).astype(int).clip(min=0).tolist()
    high = np.ceil(ladder.corners.max(axis=1) + _RIM).astype(int).tolist()
    found = np.zeros(len(ladder.texts), bool)
    for i, ((x0, y0), (x1, y1)) in enumerate(zip(low, high, strict=True)):
        crop = picture[y0:y1, x0:x1]
        # The reader's own thresholds see nothing in contrasts below a tenth: spread them out.
        counts = np.bincount(crop.ravel(), minlength=256).cumsum()
        dark, light = counts.searchsorted(_SPREAD * counts[-1])
        if light - dark >= _LEAST_CODES:
            table = ((_CODES - dark) * (255.0 / (light - dark))).clip(0.0, 255.0)
            spread = Image.fromarray(table.round().astype(np.uint8)[crop])
            size = spread.width * _ENLARGED, spread.height * _ENLARGED
            enlarged = spread.resize(size, Image.Resampling.BICUBIC)
            found[i] = ladder.texts[i] in reader(np.asarray(enlarged))
    return found


class Legibility(_Ladder):
    """Share of a scene's Data Matrix codes that zxing-cpp reads.

    Eight codes on each of one or two boards, in the sun and in the shade, of falling size and
    contrast (`ae_env.scenes.ladder.RUNGS`). Each is looked for where it is, at twice the frame's
    resolution; a wrong text does not count. Frames need 96 pixels a side or more.
    """

    needs = "extra tasks"

    def _made(self) -> tuple[Reader, str]:
        module = zxing()
        options: dict[str, Any] = {"formats": module.BarcodeFormat.DataMatrix}
        options |= dict.fromkeys(("try_rotate", "try_downscale", "try_invert"), False)
        options["binarizer"] = module.Binarizer.GlobalHistogram  # the board's light is even

        def read(crop: np.ndarray) -> list[str]:
            found = module.read_barcode(crop, **options)
            return [] if found is None else [found.text]

        return read, version("zxing-cpp")


class Tags(_Ladder):
    """Share of a scene's AprilTags (36h11) that OpenCV finds: see `Legibility`."""

    needs, kind = "extra cv", "tags"

    def _made(self) -> tuple[Reader, str]:
        cv2 = import_extra("cv2", "cv", "the scorer tags")
        detector = cv2.aruco.ArucoDetector(tag_dictionary())

        def read(crop: np.ndarray) -> list[str]:
            numbers = detector.detectMarkers(crop)[1]
            return [] if numbers is None else [str(n) for n in numbers.ravel().tolist()]

        return read, str(cv2.__version__)
