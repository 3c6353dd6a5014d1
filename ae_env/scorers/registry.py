"""Scorers by name: the registry, entry points, and composition."""

from __future__ import annotations

import hashlib
import importlib
import inspect
import math
from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from numbers import Real
from typing import Any, TypeVar

from ae_env.checks import did_you_mean
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
    if not isinstance(name, str) or not name.isidentifier():
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
        return _loaded(name, _REGISTRY[name])
    for point in entry_points(group=ENTRY_POINT_GROUP):
        if point.name == name:
            return _instantiate(name, _loaded(name, point.load))
    module_name, _, attribute = name.partition(":")
    if attribute:

        def load() -> Any:
            return getattr(importlib.import_module(module_name), attribute)

        return _instantiate(name, _loaded(name, load))
    known = list_scorers()
    hint = did_you_mean(name, known)
    raise ValueError(f"`scorer` (={name!r}) must be one of {known} or 'package.module:name'{hint}")


def _loaded(name: str, load: Callable[[], Any]) -> Any:
    """What `load` returns; it runs code of the user's own, or of another package."""
    try:
        return load()
    except Exception as error:
        raise ValueError(
            f"`scorer` (={name!r}) cannot be loaded: {type(error).__name__}: {error}"
        ) from error


def _instantiate(name: str, found: Any) -> Any:
    return _loaded(name, found) if inspect.isclass(found) else found


def make_scorer(spec: str | Mapping[str, float] | Scorer) -> CompositeScorer:
    """A scorer from a name, a mapping of names to weights, or a callable.

    Args:
        spec: A registered name, ``"package.module:attribute"``, a mapping such as
            ``{"noise": 0.5, "highlights": 0.5}`` (weighted mean), or a callable
            ``(images, captures) -> (B,)``.

    Returns:
        A composite of one or more parts.

    Raises:
        ValueError: If a name is unknown (the nearest is proposed) or cannot be loaded (the cause is
            chained), a weight is not positive, or the callable has no domain.
    """
    if isinstance(spec, CompositeScorer):
        return spec
    if isinstance(spec, str):
        scorer = _find_scorer(spec)
        if isinstance(scorer, CompositeScorer):
            return scorer
        return CompositeScorer({_short(spec): scorer})
    if isinstance(spec, Mapping):
        return _weighted_mean(spec)
    if callable(spec):
        name = getattr(spec, "__name__", type(spec).__name__)
        scorer = _instantiate(name, spec)
        return scorer if isinstance(scorer, CompositeScorer) else CompositeScorer({name: scorer})
    raise ValueError(f"`scorer` (={spec!r}) must be a name, a mapping of weights or a callable")


def _weighted_mean(spec: Mapping[str, float]) -> CompositeScorer:
    rule = f"`scorer` (={dict(spec)!r}) must map"
    if not spec or not all(isinstance(name, str) for name in spec):
        raise ValueError(f"{rule} one name or more to weights, as {{'noise': 0.5}} does")
    for weight in spec.values():
        known = isinstance(weight, Real) and not isinstance(weight, bool)
        if not (known and 0 < weight < math.inf):
            raise ValueError(f"{rule} names to weights, which must all be > 0 and finite")
    if len({_short(name) for name in spec}) < len(spec):
        raise ValueError(f"{rule} names that differ behind the colon, too")
    parts = {_short(name): _find_scorer(name) for name in spec}
    return CompositeScorer(parts, {_short(name): float(w) for name, w in spec.items()})


def _short(name: str) -> str:
    return name.rpartition(":")[2]


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
