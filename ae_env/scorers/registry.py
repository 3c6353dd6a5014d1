"""Scorers by name: the registry, entry points, and composition."""

from __future__ import annotations

import difflib
import hashlib
import importlib
import inspect
from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import Any, TypeVar

from ae_env.scorers.composite import Balanced, CompositeScorer
from ae_env.scorers.protocol import Scorer
from ae_env.scorers.terms import Brightness, Highlights, Noise, Shadows, Sharpness

ENTRY_POINT_GROUP = "ae_env.scorers"
Factory = TypeVar("Factory", bound=Callable[[], Any])

_REGISTRY: dict[str, Callable[[], Any]] = {
    "balanced": Balanced,
    "brightness": Brightness,
    "highlights": Highlights,
    "shadows": Shadows,
    "noise": Noise,
    "sharpness": Sharpness,
}


def register_scorer(name: str) -> Callable[[Factory], Factory]:
    """Class decorator that makes a scorer known as `name`.

    Registering the same class again (a notebook cell run twice) replaces it.

    Raises:
        ValueError: If `name` is not an identifier or belongs to a built-in scorer.

    >>> @register_scorer("constant")
    ... class Constant:
    ...     domain = "raw"
    ...     def __call__(self, images, captures):
    ...         return images.new_ones(len(images))
    >>> "constant" in list_scorers()
    True
    """
    if not name.isidentifier():
        raise ValueError(f"`name` (={name!r}) must be a Python identifier")

    def register(factory: Factory) -> Factory:
        known = _REGISTRY.get(name)
        if known is not None and known.__module__.startswith("ae_env."):
            raise ValueError(f"`name` (={name!r}) must not be that of a built-in scorer")
        _REGISTRY[name] = factory
        return factory

    return register


def list_scorers() -> list[str]:
    """Names of all known scorers, those of installed packages included."""
    return sorted({*_REGISTRY, *(point.name for point in entry_points(group=ENTRY_POINT_GROUP))})


def _find_scorer(name: str) -> Scorer:
    if name in _REGISTRY:
        return _REGISTRY[name]()
    for point in entry_points(group=ENTRY_POINT_GROUP):
        if point.name == name:
            return _instantiate(name, point.load())
    module_name, _, attribute = name.partition(":")
    if attribute:
        try:
            found = getattr(importlib.import_module(module_name), attribute)
        except (ImportError, AttributeError) as error:
            raise ValueError(f"`scorer` (={name!r}) cannot be imported: {error}") from error
        return _instantiate(name, found)
    known = list_scorers()
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise ValueError(f"`scorer` (={name!r}) must be one of {known} or 'package.module:name'{hint}")


def _instantiate(name: str, found: Any) -> Scorer:
    scorer = found() if inspect.isclass(found) else found
    if not callable(scorer):
        raise ValueError(f"`scorer` (={name!r}) must be callable, got {type(scorer).__name__}")
    return scorer


def make_scorer(spec: str | Mapping[str, float] | Scorer) -> CompositeScorer:
    """A scorer from a name, a mapping of names to weights, or a callable.

    Args:
        spec: A registered name, ``"package.module:attribute"``, a mapping such as
            ``{"noise": 0.5, "highlights": 0.5}`` (weighted mean), or a callable
            ``(images, captures) -> (B,)``.

    Returns:
        A composite of one or more parts.

    Raises:
        ValueError: If a name is unknown (the nearest is proposed) or the callable has no domain.
    """
    if isinstance(spec, CompositeScorer):
        return spec
    if isinstance(spec, str):
        scorer = _find_scorer(spec)
        if isinstance(scorer, CompositeScorer):
            return scorer
        return CompositeScorer({spec.rpartition(":")[2]: _with_domain(spec, scorer)})
    if isinstance(spec, Mapping):
        parts: dict[str, Scorer] = {}
        for name in spec:
            parts[name.rpartition(":")[2]] = _with_domain(name, _find_scorer(name))
        weights = {name.rpartition(":")[2]: float(weight) for name, weight in spec.items()}
        return CompositeScorer(parts, weights)
    if callable(spec):
        name = getattr(spec, "__name__", type(spec).__name__)
        return CompositeScorer({name: _with_domain(name, _instantiate(name, spec))})
    raise ValueError(f"`scorer` (={spec!r}) must be a name, a mapping of weights or a callable")


def _with_domain(name: str, scorer: Any) -> Scorer:
    domain = getattr(scorer, "domain", None)
    if domain not in ("raw", "srgb"):
        raise ValueError(f"scorer {name!r} has `domain` (={domain!r}); it must be 'raw' or 'srgb'")
    return scorer


def scorer_fingerprint(scorer: CompositeScorer) -> str | None:
    """A hash of everything that decides the scores of `scorer`, or None where that is not known.

    What a scorer of one's own calls or closes over cannot be seen from its class, so its scores are
    kept on disk only if it has a ``version`` (a string or number that its author changes with it).
    """
    digest = hashlib.sha256()
    for name, part in [("", scorer), *scorer.parts.items()]:
        kind = part if inspect.isfunction(part) else type(part)
        version = getattr(part, "version", None)
        if not kind.__module__.startswith("ae_env.") and not isinstance(version, str | int | float):
            return None
        try:
            source = inspect.getsource(kind)
        except (OSError, TypeError):
            return None
        digest.update(f"{name}\0{version}\0{source}\0".encode())
        for key, value in sorted(getattr(part, "__dict__", {}).items()):
            if key in ("parts", "closed_form"):
                continue
            if not isinstance(value, int | float | str | bool | dict | tuple):
                return None
            digest.update(f"{key}={value!r}\0".encode())
    return digest.hexdigest()
