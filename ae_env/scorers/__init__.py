"""Image-quality scorers, which rate captures between 0 and 1."""

from ae_env.scorers.captures import Captures, Scorer
from ae_env.scorers.registry import list_scorers, make_scorer, register_scorer
from ae_env.scorers.terms import Balanced, CompositeScorer

__all__ = [
    "Balanced",
    "Captures",
    "CompositeScorer",
    "Scorer",
    "list_scorers",
    "make_scorer",
    "register_scorer",
]
