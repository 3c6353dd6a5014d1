"""Scorers by name: the registry, entry points, and composition.

| file | scorers |
|---|---|
| `terms.py` | weighted means, `balanced`; `brightness`, `highlights`, `shadows`, `noise`, |
| | `sharpness`, `banding` |
| `measures.py` | `mid_grey`, `clipping`, `dynamic_range`, `well_exposedness`, `entropy`; `shim`, |
| | `zhang`, `shin`, `snr`, `blind_noise` |
| `defects.py` | `defects`, `analytic_*` |
| `fidelity.py` | `fidelity`, `keypoints`, `matches` |
| `detection.py` | `legibility`, `tags` |
| `learnt.py` | `nima_aesthetic`, `nima_technical`, `classifier`, ``pyiqa:METRIC`` |
"""

import hashlib
import inspect
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from ae_env.scorers import defects, detection, fidelity, learnt, measures, terms
from ae_env.scorers.captures import Scorer
from ae_env.scorers.terms import CompositeScorer, check_part
from ae_env.utils.user_files import load_attribute, load_from_file, split_file_name
from simulator.utils.checks import as_float, did_you_mean

ENTRY_POINT_GROUP = "ae_env.scorers"
#: ``pyiqa:NAME`` is the metric NAME of the package pyiqa.
PYIQA = "pyiqa"
Factory = TypeVar("Factory", bound=Callable[[], Any])

_REGISTRY: dict[str, Callable[[], Any]] = {
    "balanced": terms.Balanced,
    "brightness": terms.Brightness,
    "highlights": terms.Highlights,
    "shadows": terms.Shadows,
    "noise": terms.Noise,
    "sharpness": terms.Sharpness,
    "banding": terms.Banding,
    "classifier": learnt.Classifier,
    "keypoints": fidelity.Keypoints,
    "legibility": detection.Legibility,
    "matches": fidelity.Matches,
    "nima_aesthetic": learnt.NimaAesthetic,
    "nima_technical": learnt.NimaTechnical,
    "mid_grey": measures.MidGrey,
    "clipping": measures.Clipping,
    "dynamic_range": measures.DynamicRange,
    "well_exposedness": measures.WellExposedness,
    "entropy": measures.Entropy,
    "shim": measures.Shim,
    "zhang": measures.Zhang,
    "shin": measures.Shin,
    "snr": measures.SignalToNoise,
    "blind_noise": measures.BlindNoise,
    "defects": defects.Defects,
    "fidelity": fidelity.Fidelity,
    "tags": detection.Tags,
    **defects.ANALYTIC,
}


def register_scorer(name: str) -> Callable[[Factory], Factory]:
    """Class decorator that makes a scorer known as `name`; the latest one counts (notebooks).

    A `ValueError` if `name` is not an identifier or belongs to a built-in scorer.

    >>> @register_scorer("constant")
    ... class Constant:
    ...     domain = "raw"
    ...     def __call__(self, images, captures):
    ...         return images.new_ones(len(images))
    >>> "constant" in list_scorers()
    True
    """
    fits = isinstance(name, str) and name.isidentifier()
    if not fits or getattr(_REGISTRY.get(name), "__module__", "").startswith("ae_env."):
        rule = "must be a Python identifier, and not that of a built-in scorer"
        raise ValueError(f"`name` (={name!r}) {rule}")

    def register(factory: Factory) -> Factory:
        _REGISTRY[name] = factory
        return factory

    return register


def list_scorers() -> list[str]:
    """Names of all known scorers, those of installed packages included."""
    return sorted({*_REGISTRY, *(point.name for point in scorer_entry_points())})


def scorer_entry_points() -> list[EntryPoint]:
    """Entry points of installed packages in the group ``ae_env.scorers``, not yet loaded."""
    return list(entry_points(group=ENTRY_POINT_GROUP))


def _find_scorer(name: str) -> Any:
    factory = _REGISTRY.get(name)
    if factory is not None:
        # The errors of this package's own scorers are clear already.
        own = factory.__module__.startswith("ae_env.scorers.")
        return factory() if own else _loaded(name, factory)
    for point in scorer_entry_points():
        if point.name == name:
            return _instantiate(name, _loaded(name, point.load))
    rule = f"`scorer` (={name!r})"
    in_file = split_file_name(name)
    if in_file is not None:
        return _instantiate(name, load_from_file(*in_file, rule, example="MyScore"))
    module_name, _, attribute = name.partition(":")
    if attribute and module_name == PYIQA:
        return learnt.PyiqaMetric(attribute)
    if attribute:
        return _instantiate(name, load_attribute(name, rule))
    known = list_scorers()
    raise ValueError(
        f"{rule} must be one of {known}, 'package.module:name', 'my_file.py:name' or "
        f"'pyiqa:metric'{did_you_mean(name, known)}"
    )


def _loaded(name: str, load: Callable[[], Any]) -> Any:
    """The result of `load`, which runs code of the user or of another package."""
    try:
        return load()
    except (Exception, SystemExit) as error:
        raise ValueError(
            f"`scorer` (={name!r}) cannot be loaded: {type(error).__name__}: {error}"
        ) from error


def _instantiate(name: str, found: Any) -> Any:
    return _loaded(name, found) if inspect.isclass(found) else found


def make_scorer(spec: str | Mapping[str, float] | Scorer) -> CompositeScorer:
    """A scorer, of one part or more, from a name, a mapping of names to weights, or a callable.

    Args:
        spec: A registered name, ``"package.module:name"``, ``"path/to/my_file.py:name"``,
            ``"pyiqa:metric"``, a mapping such as ``{"noise": 0.5, "my_file.py:MyScore": 0.5}``
            (weighted mean), or a callable ``(images, captures) -> (B,)``.

    Raises:
        ValueError: If a name is unknown (the nearest is proposed) or cannot be loaded (the cause is
            chained), a model file that it needs is not there, a weight is not positive, or the
            callable has no domain.
        ImportError: If it needs an optional package that is not installed.
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
    names = [_short(name) for name in spec if isinstance(name, str)]
    fit = all(0 < as_float(weight) < math.inf for weight in spec.values())
    if not (spec and fit and len(spec) == len(set(names))):
        raise ValueError(
            f"`scorer` (={dict(spec)!r}) must map one name or more, which differ behind the colon, "
            "to weights > 0 and finite, as {'noise': 0.5} does"
        )
    parts = {_short(name): _find_scorer(name) for name in spec}
    return CompositeScorer(parts, {_short(name): float(w) for name, w in spec.items()})


def _short(name: str) -> str:
    return name.rpartition(":")[2]


def scorer_fingerprint(scorer: CompositeScorer) -> str | None:
    """A hash of everything that decides the scores of `scorer`, or None where that is unknown.

    A user's class may call anything, so it is known only if it has a ``version`` (a string or
    number that its author changes with the class).
    """
    digest = hashlib.sha256()
    for path, part in _nested(scorer):
        kind = part if inspect.isfunction(part) else type(part)
        version = getattr(part, "version", None)
        if not kind.__module__.startswith("ae_env.") and not isinstance(version, str | int | float):
            return None
        digest.update(f"{path}\0{version}\0{kind.__module__}\0{kind.__qualname__}\0".encode())
        for key, value in sorted(getattr(part, "__dict__", {}).items()):
            if key == "closed_form" or (key == "parts" and isinstance(value, Mapping)):
                continue
            if not isinstance(value, int | float | str | bool | dict | tuple):
                return None
            digest.update(f"{key}={value!r}\0".encode())
    return digest.hexdigest()


def _nested(scorer: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """`scorer` and all parts inside of it, however deep, each with the names that lead to it."""
    yield path, scorer
    parts = getattr(scorer, "parts", None)
    if isinstance(parts, Mapping):
        for name, part in parts.items():
            yield from _nested(part, (*path, name))


@dataclass(frozen=True)
class ScorerRow:
    """One scorer; a field is empty where it is unknown, or there is nothing to say."""

    name: str  # that `make_scorer` takes
    domain: str = ""  # "raw", "srgb" or, of parts that differ, "raw, srgb"
    depends_on: str = ""  # "image", "light" or "blur"
    needs: str = ""  # file or package that does not come with this one
    summary: str = ""  # first line of its docstring
    package: str = "ae-env"  # that it comes from
    error: str = ""  # why it cannot be loaded, unless only what it needs is missing


def describe_scorers() -> list[ScorerRow]:
    """A row for each known scorer, in order of name; one that is broken does not hide others."""
    points = {point.name: point for point in reversed(scorer_entry_points())}
    rows = []
    for name in list_scorers():
        factory = _REGISTRY.get(name)
        if factory is None:
            point = points[name]
            package = point.dist.name if point.dist is not None else point.module.partition(".")[0]
        else:
            package = factory.__module__.partition(".")[0].replace("ae_env", "ae-env")
        needs = getattr(factory, "needs", "")
        try:
            # Where a file may be missing, the class says everything.
            found = factory if needs else _find_scorer(name)
            check_part(name, found)
            rows.append(_row(name, found, package))
        except (Exception, SystemExit) as error:
            cause: BaseException = error
            while cause.__cause__ is not None:  # the last error only repeats the scorer's name
                cause = cause.__cause__
            line = " ".join(f"{type(cause).__name__}: {cause}".split())
            rows.append(ScorerRow(name, package=package, error=line))
    return rows


def _row(name: str, found: Any, package: str) -> ScorerRow:
    text = found if inspect.isclass(found) or inspect.isfunction(found) else type(found)
    return ScorerRow(
        name,
        domain=", ".join(sorted(_domains(found))),
        depends_on=getattr(found, "depends_on", "image"),
        needs=str(getattr(found, "needs", "")),
        summary=(inspect.getdoc(text) or "").partition("\n")[0].replace("``", ""),
        package=package,
    )


def _domains(found: Any) -> set[str]:
    """Domains of a scorer, or of all parts of a composite."""
    parts = getattr(found, "parts", {}).values()
    return set().union(*map(_domains, parts)) if parts else {found.domain}
