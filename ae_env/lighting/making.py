"""`make_lighting`: from what a user names to a lighting."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from ae_env.lighting.base import Lighting
from ae_env.lighting.changes import (
    LensCapLighting,
    RampLighting,
    SineLighting,
    StepLighting,
    TunnelLighting,
)
from ae_env.lighting.flicker import FlickerLighting
from ae_env.lighting.schedule import ScheduleLighting
from ae_env.utils.checks import did_you_mean

KINDS: dict[str, type[Lighting]] = {
    kind.name: kind
    for kind in (
        Lighting,
        StepLighting,
        RampLighting,
        SineLighting,
        TunnelLighting,
        LensCapLighting,
        FlickerLighting,
        ScheduleLighting,
    )
}


def make_lighting(spec: str | Mapping[str, Any] | Lighting) -> Lighting:
    """A lighting from a name or from a mapping such as ``{"kind": "step", "stops": 3}``.

    Raises:
        ValueError: If the kind or one of its options is unknown, or an option is out of range.

    >>> make_lighting({"kind": "step", "stops": 3, "at": 2}).gain(2, 0.01, 0.0)
    8.0
    """
    if isinstance(spec, Lighting):
        return spec
    if not isinstance(spec, str | Mapping):
        raise ValueError(
            f"`lighting` (={spec!r}) must be one of {sorted(KINDS)}, a mapping with a 'kind' of "
            "them, or a Lighting"
        )
    options = {"kind": spec} if isinstance(spec, str) else dict(spec)
    if "kind" not in options:
        raise ValueError(f"`lighting` (={spec!r}) needs a 'kind', one of {sorted(KINDS)}")
    name = options.pop("kind", None)
    if not isinstance(name, str) or name not in KINDS:
        hint = did_you_mean(name, KINDS)
        raise ValueError(f"`lighting` (={spec!r}) must be one of {sorted(KINDS)}{hint}")
    kind = KINDS[name]
    known = [f.name for f in fields(kind)]
    for option in options:
        if option not in known:
            hint = did_you_mean(option, known)
            raise ValueError(
                f"`lighting` (={spec!r}): {name!r} takes {known}, not {option!r}{hint}"
            )
    return kind(**options)
