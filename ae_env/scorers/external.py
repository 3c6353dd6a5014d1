"""BRISQUE by OpenCV, with the model files of the user's own."""

from __future__ import annotations

import hashlib
import math
import os
import re
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ae_env.scorers.keypoints import luma_bytes, opencv
from ae_env.scorers.protocol import Captures, DependsOn, Domain
from ae_env.utils.model_files import find_model_file

# Metrics of the package pyiqa as scorers, by their names: ``pyiqa:musiq``.
#
# pyiqa is under a non-commercial licence and large, so it is not a dependency of this package: it is
# imported only where one of its metrics is asked for.
_NUMBER = re.compile(r"[-+]?(?:inf|\d+\.?\d*(?:e[-+]?\d+)?)", re.IGNORECASE)


class PyiqaMetric:
    """A no-reference metric of pyiqa, its stated range mapped to [0, 1], higher better.

    Score = (value - low) / (high - low), clipped, or 1 minus that where lower is better. The range
    is the metric's own ``score_range``, which pyiqa calls a rough estimate.

    Args:
        metric: What ``pyiqa.create_metric`` calls it.

    Raises:
        ImportError: If pyiqa is not installed.
        ValueError: If pyiqa has no such metric, it needs a reference picture, or it states no
            finite range.
    """

    domain: Domain = "srgb"
    depends_on: DependsOn = "image"
    needs = "pip install pyiqa"

    def __init__(self, metric: str) -> None:
        rule = f"`scorer` (='pyiqa:{metric}')"
        try:
            import pyiqa
        except ImportError as error:
            raise ImportError(
                f"{rule} needs pyiqa, which is non-commercial and no extra of this package: "
                f"pip install pyiqa ({error})"
            ) from error
        try:
            self._metric: Any = pyiqa.create_metric(metric, device=torch.device("cpu"))
        except Exception as error:
            what = f"{type(error).__name__}: {error}"
            raise ValueError(f"{rule} cannot be made by pyiqa.create_metric: {what}") from error
        if getattr(self._metric, "metric_mode", "NR") != "NR":
            raise ValueError(f"{rule} must be a metric that needs no reference picture")
        self.metric = metric
        self.low, self.high = _range(getattr(self._metric, "score_range", None), rule)
        self.lower_better = bool(getattr(self._metric, "lower_better", False))

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,) of sRGB `images` (B, 3, H, W)."""
        assert images is not None
        with torch.no_grad():
            values = torch.as_tensor(self._metric(images)).double().reshape(len(images))
        share = ((values - self.low) / (self.high - self.low)).clamp(0.0, 1.0)
        return 1.0 - share if self.lower_better else share


def _range(stated: Any, rule: str) -> tuple[float, float]:
    """Two finite numbers from such as ``"~0, ~100"``."""
    numbers = [float(n) for n in _NUMBER.findall(str(stated))]
    if len(numbers) != 2 or not all(map(math.isfinite, numbers)) or numbers[0] >= numbers[1]:
        raise ValueError(
            f"{rule} states the score range {stated!r}, which must be two finite numbers to be "
            "mapped to [0, 1]: wrap the metric in a scorer of your own"
        )
    return numbers[0], numbers[1]


VARIABLE = "AE_ENV_BRISQUE"
MODEL, RANGE = "brisque_model_live.yml", "brisque_range_live.yml"
#: Numbers that describe a picture.
FEATURES = 36
#: Value of the worst picture, and of one that has no statistics.
WORST = 100.0
#: Smaller pictures have none, either [pixel].
_LEAST_SIDE = 8


class Brisque:
    """Naturalness by BRISQUE: 1 - value / 100, the value in [0, 100], 0 for a pristine picture.

    Mittal, Moorthy and Bovik, No-Reference Image Quality Assessment in the Spatial Domain, IEEE
    Transactions on Image Processing 21(12), 2012, computed by OpenCV (`cv2.quality`) from the luma.
    A constant picture is 100. Its two files come with opencv_contrib
    (``modules/quality/samples``), not with this package.

    Args:
        file: ``brisque_model_live.yml``; ``brisque_range_live.yml`` must lie beside it.

    Raises:
        ImportError: If OpenCV with its contributed modules is not installed.
        ValueError: If a file is not there or is not OpenCV's.
    """

    domain: Domain = "srgb"
    depends_on: DependsOn = "image"
    needs = f"extra cv; model: {VARIABLE}"
    version = 1

    def __init__(self, file: str | os.PathLike[str] | None = None) -> None:
        cv2 = opencv()
        if not (hasattr(cv2, "quality") and hasattr(cv2, "ml")):
            raise ImportError(
                "the scorer brisque needs OpenCV's contributed modules: pip uninstall "
                "opencv-python-headless, then pip install 'ae-env[cv]'"
            )
        how = f"{MODEL} and, beside it, {RANGE} are in opencv_contrib's modules/quality/samples"
        model = find_model_file("brisque", file, VARIABLE, (MODEL,), how=how).resolve()
        ranges = model.with_name(model.name.replace("model", "range"))
        if ranges == model or not ranges.is_file():
            raise ValueError(f"scorer 'brisque' needs {RANGE} beside {str(model)!r}; {how}")
        self.model, self.range = str(model), str(ranges)
        self.content = f"{_digest(model)} {_digest(ranges)}"
        _model(self.model, self.range, self.content)

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,) of sRGB `images` (B, 3, H, W)."""
        assert images is not None
        machine, low, high = _model(self.model, self.range, self.content)
        values = np.full(len(images), WORST)
        if min(images.shape[2:]) >= _LEAST_SIDE:
            compute = opencv().quality.QualityBRISQUE_computeFeatures
            features = np.concatenate([compute(picture) for picture in luma_bytes(images)])
            # A constant picture has no statistics, which OpenCV's own `compute` rates as pristine.
            known = np.isfinite(features).all(axis=1)
            scaled = -1.0 + 2.0 / (high - low) * (features[known] - low)
            if known.any():
                values[known] = machine.predict(scaled.astype(np.float32))[1][:, 0]
        return torch.from_numpy(1.0 - np.clip(values / WORST, 0.0, 1.0))


@lru_cache(maxsize=2)
def _model(model: str, ranges: str, content: str) -> tuple[Any, np.ndarray, np.ndarray]:
    """OpenCV's support vector machine, and the ranges (1, 36) of the features that it was trained
    on, read once per content of the files.
    """
    cv2 = opencv()
    level = cv2.utils.logging.setLogLevel(0)  # what is wrong is said below, and only there
    try:
        machine = cv2.ml.SVM_load(model)
        storage = cv2.FileStorage(ranges, cv2.FILE_STORAGE_READ)
        bounds = storage.getNode("range").mat()
    except (cv2.error, SystemError) as error:
        raise ValueError(f"`file` (={model!r}) must be OpenCV's BRISQUE model: {error}") from error
    finally:
        cv2.utils.logging.setLogLevel(level)
    if machine.getVarCount() != FEATURES or bounds is None or bounds.shape != (2, FEATURES):
        raise ValueError(
            f"`file` (={model!r}) and {Path(ranges).name} must be OpenCV's BRISQUE model, of "
            f"{FEATURES} numbers"
        )
    if not bool((bounds[1] > bounds[0]).all()):  # nor where one is NaN
        raise ValueError(f"{ranges!r} must hold ranges: a least and a larger largest value each")
    return machine, bounds[:1], bounds[1:]


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()[:16]
