"""What is known about each scorer: the rows of ``ae-env scorers``."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ae_env.scorers.registry import (
    list_scorers,
    make_scorer,
    registered_scorer,
    scorer_entry_points,
)


@dataclass(frozen=True)
class ScorerRow:
    """One scorer.

    Args:
        name: What `ae_env.scorers.make_scorer` takes.
        domain: ``"raw"``, ``"srgb"`` or, of parts that differ, ``"raw, srgb"``; empty where it is
            not known.
        depends_on: ``"image"``, ``"light"`` or ``"blur"``; empty where it is not known.
        needs: What does not come with this package; empty where that is nothing.
        summary: First line of its docstring.
        package: The package that it comes from.
        error: Why it cannot be loaded; empty where it can, or where only what it needs is missing.
    """

    name: str
    domain: str = ""
    depends_on: str = ""
    needs: str = ""
    summary: str = ""
    package: str = "ae-env"
    error: str = ""


def describe_scorers() -> list[ScorerRow]:
    """A row for each known scorer, in order of name; one that is broken does not hide others."""
    points = {point.name: point for point in reversed(scorer_entry_points())}
    rows = []
    for name in list_scorers():
        factory = registered_scorer(name)
        package = _package(points[name]) if factory is None else _origin(factory)
        needs = getattr(factory, "needs", "")
        try:
            # Where a file may be missing, its class says all that is asked for.
            found = factory if needs else _made(name)
            rows.append(_row(name, found, package))
        except (Exception, SystemExit) as error:
            rows.append(ScorerRow(name, package=package, error=_cause(error)))
    return rows


def _made(name: str) -> Any:
    """The scorer of that name, out of the composite that stands around a single one."""
    scorer = make_scorer(name)
    parts = list(scorer.parts.values())
    return parts[0] if len(parts) == 1 and list(scorer.parts) == [name] else scorer


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
    """What a scorer sees; of one that is made of others, what they do."""
    parts = getattr(found, "parts", {}).values()
    return set().union(*map(_domains, parts)) if parts else {found.domain}


def _package(point: Any) -> str:
    return point.dist.name if point.dist is not None else point.module.partition(".")[0]


def _origin(factory: Callable[[], Any]) -> str:
    package = factory.__module__.partition(".")[0]
    return "ae-env" if package == "ae_env" else package


def _cause(error: BaseException) -> str:
    """The first error of a chain, in one line: the last one repeats the name of the row."""
    while error.__cause__ is not None:
        error = error.__cause__
    return " ".join(f"{type(error).__name__}: {error}".split())
