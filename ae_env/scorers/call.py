"""Calling one scorer, which may be the user's own: it may raise, return rubbish, or hang."""

from __future__ import annotations

import logging
import threading
import time
from typing import Any

import torch

from ae_env.checks import UserCodeError
from ae_env.scorers.protocol import Captures, Scorer

logger = logging.getLogger(__name__)

#: A scorer that takes longer than this for one batch is told of, once [s].
SLOW_SECONDS = 5.0
#: Scores may be this far outside [0, 1] by rounding.
ROUNDING = 1e-6
#: Names of the scorers that have been called in this process, and of those found to be slow.
_called: set[str] = set()
_slow: set[str] = set()


def scores_of(
    name: str, scorer: Scorer, images: torch.Tensor | None, captures: Captures
) -> torch.Tensor:
    """Scores (B,) float64 in [0, 1] of one scorer.

    Args:
        name: What errors call it.
        scorer: The scorer.
        images: (B, C, H, W), or None where it has a closed form.
        captures: What they come from, B of them.

    Raises:
        UserCodeError: If it raises (the cause is chained), returns something else than B numbers in
            [0, 1], or changes `captures`.
    """
    if not is_own(scorer):
        return _checked(name, scorer(images, captures), len(captures))
    before = _versions(captures)
    try:
        scores: Any = _watched(name, scorer, images, captures)
    except Exception as error:
        raise UserCodeError(f"scorer {name!r} raised {type(error).__name__}: {error}") from error
    if _versions(captures) != before:
        raise UserCodeError(
            f"scorer {name!r} changed its `captures` in place: it must work on copies, as others "
            "are scored from them, too"
        )
    return _checked(name, scores, len(captures))


def is_own(scorer: Any) -> bool:
    """Whether `scorer`, or a part of it, comes from outside of this package."""
    if not type(scorer).__module__.startswith("ae_env."):
        return True
    return any(is_own(part) for part in getattr(scorer, "parts", {}).values())


def describe_range(values: Any) -> str:
    """For messages, what was returned that is not all in [0, 1].

    Args:
        values: An array or a tensor.
    """
    if bool((values != values).any()):
        return "NaN"
    return f"scores from {float(values.min())} to {float(values.max())}"


def _versions(captures: Captures) -> dict[str, int]:
    """Numbers that torch counts up as tensors are written to, views of them included.

    By name of the field or property; those that are 0 are left out, as are properties that nobody
    has asked for yet.
    """
    tensors = {name: value for name, value in vars(captures).items() if torch.is_tensor(value)}
    counted = {name: t._version for name, t in tensors.items() if not t.is_inference()}
    return {name: version for name, version in counted.items() if version}


def _watched(
    name: str, scorer: Scorer, images: torch.Tensor | None, captures: Captures
) -> torch.Tensor:
    """Calls `scorer`; says, once, if it is slow: in its first batch while it runs."""
    if name not in _called:
        _called.add(name)
        timer = threading.Timer(SLOW_SECONDS, _tell, (name,))
        timer.daemon = True
        timer.start()
        try:
            return scorer(images, captures)
        finally:
            timer.cancel()
    begin = time.perf_counter()
    scores = scorer(images, captures)
    if time.perf_counter() - begin > SLOW_SECONDS:
        _tell(name)
    return scores


def _tell(name: str) -> None:
    if name not in _slow:
        _slow.add(name)
        logger.warning("scorer %r takes more than %g s for one batch", name, SLOW_SECONDS)


def _checked(name: str, scores: Any, count: int) -> torch.Tensor:
    if not isinstance(scores, torch.Tensor) or scores.shape != (count,) or scores.is_complex():
        what = type(scores).__name__
        if isinstance(scores, torch.Tensor):
            what = f"{tuple(scores.shape)} {scores.dtype}"
        raise UserCodeError(f"scorer {name!r} returned {what}: it must return a tensor ({count},)")
    scores = scores.detach().to("cpu", torch.float64)
    if not bool(((scores >= -ROUNDING) & (scores <= 1 + ROUNDING)).all()):
        raise UserCodeError(f"scorer {name!r} returned {describe_range(scores)}: rule is [0, 1]")
    return scores.clamp(0.0, 1.0)
