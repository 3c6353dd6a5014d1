"""Image-quality scorers: what a capture is worth."""

from ae_env.scorers.composite import Balanced, CompositeScorer
from ae_env.scorers.protocol import Captures, Scorer
from ae_env.scorers.registry import list_scorers, make_scorer, register_scorer

__all__ = [
    "Balanced",
    "Captures",
    "CompositeScorer",
    "Scorer",
    "list_scorers",
    "make_scorer",
    "register_scorer",
]
