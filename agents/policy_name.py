"""Names of policies with options in them: ``centre_weighted:P?compensation=-1&damping=0.5``."""

from __future__ import annotations

import re
from typing import Any

import yaml

#: Where options begin: a question mark before a slash of a path is a part of the path.
_OPTIONS = re.compile(r"\?(?![^=]*/)")
_FRACTION = re.compile(r"\s*([+-]?\d+(?:\.\d+)?)\s*/\s*(\d+(?:\.\d+)?)\s*")


def split_name(name: str) -> tuple[str, dict[str, Any]]:
    """A policy's name without its options, and the options.

    Args:
        name: A name, or a name, ``?`` and options ``key=value`` with ``&`` between them. Values are
            YAML scalars; a fraction such as ``1/60`` is a number too.

    Raises:
        ValueError: If `name` is not a text, an option has no value or a value that is no scalar, or
            one is given twice.

    >>> split_name("centre_weighted:P?compensation=-1&shutter_cap=1/50")
    ('centre_weighted:P', {'compensation': -1, 'shutter_cap': 0.02})
    >>> split_name("ppo:runs/mine")
    ('ppo:runs/mine', {})
    """
    if not isinstance(name, str):
        raise ValueError(
            f"`policy` (={name!r}) must be a name, such as 'matrix:P', not a {type(name).__name__}"
        )
    # A folder may have a question mark in its name, a class may not.
    mark = _OPTIONS.search(name, max(name.find(".py:"), 0))
    if mark is None:
        return name, {}
    start = mark.start()
    options: dict[str, Any] = {}
    for part in name[start + 1 :].split("&"):
        key, equals, text = part.partition("=")
        key = key.strip()
        if not equals or not key.isidentifier():
            raise ValueError(
                f"`policy` (={name!r}): options are written name?key=value&key=value, not {part!r}"
            )
        if key in options:
            raise ValueError(f"`policy` (={name!r}): option {key!r} is given twice")
        options[key] = _scalar(name, key, text)
    return name[:start], options


def _scalar(name: str, key: str, text: str) -> Any:
    fraction = _FRACTION.fullmatch(text)
    if fraction and float(fraction[2]) > 0:
        return float(fraction[1]) / float(fraction[2])
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        value = {}
    if isinstance(value, str):
        try:  # YAML 1.1 takes 1e-3 for a text
            value = float(value)
        except ValueError:
            return value
    if not (value is None or isinstance(value, bool | int | float)):
        raise ValueError(f"`policy` (={name!r}): option {key!r} (={text!r}) must be a YAML scalar")
    return value
