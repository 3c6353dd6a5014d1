"""Scorers made of other scorers: the weighted mean, and the default `balanced`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
import torch

from ae_env.scorers.protocol import Captures, DependsOn, Domain, Scorer
from ae_env.scorers.terms import Brightness, Highlights, Noise, Shadows, Sharpness
from simulator.isp import develop


def depends_on(scorer: Scorer) -> DependsOn:
    """What `scorer` varies with; ``"image"`` unless it says otherwise."""
    return getattr(scorer, "depends_on", "image")


class CompositeScorer:
    """Weighted mean of several scorers.

    Args:
        parts: Scorers by name.
        weights: Weight of each part, > 0; they are divided by their sum. Equal by default.

    Raises:
        ValueError: If there are no parts, or a weight is missing or not positive.
    """

    domain: Domain = "raw"

    def __init__(
        self, parts: Mapping[str, Scorer], weights: Mapping[str, float] | None = None
    ) -> None:
        weights = dict.fromkeys(parts, 1.0) if weights is None else dict(weights)
        if not parts or set(weights) != set(parts):
            raise ValueError(f"`weights` (={weights}) must name exactly the parts {list(parts)}")
        if not all(w > 0 for w in weights.values()):
            raise ValueError(f"`weights` (={weights}) must all be > 0")
        total = sum(weights.values())
        self.parts = dict(parts)
        self.weights = {name: weight / total for name, weight in weights.items()}

    @cached_property
    def closed_form(self) -> bool:
        """Whether every part has a closed form, so that no noise needs to be drawn."""
        return all(depends_on(part) != "image" for part in self.parts.values())

    @property
    def depends_on(self) -> DependsOn:
        """What the whole varies with, as a part of another scorer."""
        if not self.closed_form:
            return "image"
        return "blur" if self.names("blur") else "light"

    def names(self, *kinds: DependsOn) -> list[str]:
        """Names of the parts that depend on one of `kinds`."""
        return [name for name, part in self.parts.items() if depends_on(part) in kinds]

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,) of raw `images` (B, 4, H, W) in [0, 1]."""
        return self.combine(self.score_parts(images, captures))

    def score_parts(
        self,
        images: torch.Tensor | None,
        captures: Captures,
        kinds: tuple[DependsOn, ...] = ("image", "light", "blur"),
    ) -> dict[str, torch.Tensor]:
        """Score (B,) float64 of each part that depends on one of `kinds`.

        The images are developed to sRGB only if a part asks for it.
        """
        srgb: torch.Tensor | None = None
        scores = {}
        for name in self.names(*kinds):
            part = self.parts[name]
            view: torch.Tensor | None = None
            if depends_on(part) == "image":
                if images is None:
                    raise ValueError(f"scorer {name!r} needs `images`, got None")
                view = images
                if part.domain == "srgb":
                    if srgb is None:
                        srgb = _developed(images, captures)
                    view = srgb
            scores[name] = _checked(name, part(view, captures), len(captures))
        return scores

    def combine(self, scores: Mapping[str, Any]) -> Any:
        """Total score from the parts' scores, tensors or arrays of any one shape."""
        return sum(weight * scores[name] for name, weight in self.weights.items())


class Balanced(CompositeScorer):
    """The default scorer: a photograph is as good as its worst fault allows.

    Product of the five terms, each to its weight, times ``(1 - fh^4) (1 - fs^4)``, fh and fs the
    shares of blown and blocked pixels: a frame that is all white or all black scores near 0. It is
    computed on the noise-free light before blur and clip, so its expectation is exact.
    """

    def __init__(self) -> None:
        parts: dict[str, Scorer] = {
            "brightness": Brightness(),
            "highlights": Highlights(),
            "shadows": Shadows(),
            "noise": Noise(),
            "sharpness": Sharpness(),
        }
        weights = {
            "brightness": 0.30,
            "highlights": 0.15,
            "shadows": 0.10,
            "noise": 0.20,
            "sharpness": 0.25,
        }
        super().__init__(parts, weights)

    def combine(self, scores: Mapping[str, Any]) -> Any:
        """Total score from the parts' scores, tensors or arrays of any one shape."""
        blown = -Highlights.scale * _log(scores["highlights"])
        blocked = -Shadows.scale * _log(scores["shadows"])
        score = (1.0 - blown**4) * (1.0 - blocked**4)
        for name, weight in self.weights.items():
            score = score * scores[name] ** weight
        return score


def _developed(images: torch.Tensor, captures: Captures) -> torch.Tensor:
    """sRGB (B, 3, H, W), each image with the colours of its own scene's camera."""
    kinds = set(captures.colour_matrices)
    if len(kinds) == 1:
        return develop(images, captures.white_balance, kinds.pop())
    pairs = zip(images, captures.white_balance, captures.colour_matrices, strict=True)
    return torch.cat([develop(image[None], gains, matrix) for image, gains, matrix in pairs])


def _log(values: Any) -> Any:
    """Of arrays by numpy: torch may use threads for it, which a forked process does not have."""
    return values.log() if torch.is_tensor(values) else np.log(values)


def _checked(name: str, scores: Any, count: int) -> torch.Tensor:
    if not isinstance(scores, torch.Tensor) or scores.shape != (count,):
        shape = tuple(scores.shape) if isinstance(scores, torch.Tensor) else type(scores).__name__
        raise ValueError(f"scorer {name!r} returned {shape}: it must return a tensor ({count},)")
    scores = scores.double()
    if not bool(((scores >= -1e-6) & (scores <= 1 + 1e-6)).all()):
        low, high = float(scores.min()), float(scores.max())
        raise ValueError(f"scorer {name!r} returned scores from {low} to {high}: rule is [0, 1]")
    return scores.clamp(0.0, 1.0)
