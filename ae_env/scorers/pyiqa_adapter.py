"""Metrics of the package pyiqa as scorers, by their names: ``pyiqa:musiq``.

pyiqa is under a non-commercial licence and large, so it is not a dependency of this package: it is
imported only where one of its metrics is asked for.
"""

from __future__ import annotations

import math
import re
from typing import Any

import torch

from ae_env.scorers.protocol import Captures, DependsOn, Domain

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
