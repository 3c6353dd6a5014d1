"""Checks of arguments: an error names the argument, its value and the rule."""

import difflib
import importlib
import math
import reprlib
import sys
from collections.abc import Iterable
from numbers import Integral, Real
from typing import Any
from urllib.parse import parse_qsl

#: Units of times [s].
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
#: Examples of numbers, by the name of what they are.
_EXAMPLES = {"iso": "200", "exposure_time": "1/125 or 8ms", "f_number": "5.6 or f/5.6"}
#: Level of log lines about work under way, which only the command line shows.
NOTE = 25


def did_you_mean(name: Any, known: Iterable[str], mark: str = "'", *, cutoff: float = 0.6) -> str:
    """End of a message that proposes the nearest of `known` to a misspelt `name`; empty if none is.

    `mark` is the quotation mark; for `cutoff` see `difflib.get_close_matches`.

    >>> did_you_mean("scorrer", ["scenes", "scorer"])
    "; did you mean 'scorer'?"
    """
    asked, names = str(name).lower(), {one.lower(): one for one in known}
    near = [one for one in names if len(asked) > 2 and one.startswith(asked)]
    near = near or difflib.get_close_matches(asked, names, n=1, cutoff=cutoff)
    return f"; did you mean {mark}{names[near[0]]}{mark}?" if near else ""


def import_extra(name: str, extra: str, what: str) -> Any:
    """The module `name`; an `ImportError` without it says which extra `what` needs."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"{what} needs {name}: pip install 'ae-env[{extra}]'") from error


def onnx_session(content: bytes, given: str, what: str, threads: int = 1) -> Any:
    """The network of an ONNX file, on the CPU; a `ValueError` about what is `given` if it is none.

    An `ImportError` without ONNX Runtime says that `what` needs it.
    """
    runtime = import_extra("onnxruntime", "onnx", what)
    options = runtime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = threads, 3  # errors only
    try:
        session = runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        session.get_modelmeta()  # raises where it is no text
    except Exception as error:  # ONNX Runtime has errors of its own
        raise ValueError(f"{given} cannot be read: {' '.join(str(error).split())}") from error
    return session


def parse_number(text: str, name: str = "") -> float:
    """The number of ``"1/20"``, ``'0"4'`` (0.4 s), ``"f/5.6"``, ``"200"`` or ``"8ms"``."""
    plain = text.lower().removeprefix("f").removeprefix("/").replace('"', ".")
    unit = next((u for u in ("ms", "us", "s") if plain.endswith(u)), "")
    top, _, bottom = plain.removesuffix(unit).strip(" .").partition("/")
    try:
        return float(top) / float(bottom or 1) * UNITS.get(unit, 1.0)
    except (ValueError, ZeroDivisionError):
        found = f"`{name}` (={text!r})" if name else repr(text)
        example = f", such as {_EXAMPLES[name]}" if name in _EXAMPLES else ""
        raise ValueError(f"{found} must be a number{example}") from None


def check_word(name: str, value: Any, known: tuple[str, ...], *others: object) -> None:
    """Raises a `ValueError` unless `value` is one of the strings `known`, or is one of `others`."""
    if any(value is other for other in others) or (isinstance(value, str) and value in known):
        return
    rule = ", ".join(map(repr, (*others, *known)))
    raise ValueError(f"`{name}` (={value!r}) must be one of {rule}{did_you_mean(value, known)}")


def check_key(name: str, key: Any, known: tuple[str, ...]) -> None:
    """Raises a `ValueError` unless `key` is one of those that the mapping `name` may have."""
    if key not in known:
        rule = f"its keys are {', '.join(map(repr, known))}" if known else "it has none"
        raise ValueError(f"`{name}` must not have {key!r}: {rule}{did_you_mean(key, known)}")


def parse_options(name: str, query: str, known: tuple[str, ...]) -> dict[str, str]:
    """Options ``KEY=VALUE&KEY=VALUE`` of what `name` names; each at most once, of `known` keys."""
    try:
        pairs = parse_qsl(query.replace("+", "%2B"), True, strict_parsing=bool(query))
    except ValueError:
        rule = "must be written NAME=VALUE, with & in between"
        raise ValueError(f"`{name}?{query}`: options {rule}") from None
    if len(dict(pairs)) < len(pairs):
        raise ValueError(f"`{name}?{query}` must have each option once")
    for key, _ in pairs:
        check_key(name, key, known)
    return dict(pairs)


def check_type(name: str, value: Any, *kinds: type | None, more: str = "") -> None:
    """Raises a `ValueError`, which `more` ends, unless `value` is of a type in `kinds`, or None."""
    if not isinstance(value, tuple(type(None) if kind is None else kind for kind in kinds)):
        rule = " or ".join("None" if kind is None else kind.__name__ for kind in kinds)
        found = f"={' '.join(reprlib.repr(value).split())}, of type {type(value).__name__}"
        raise ValueError(f"`{name}` ({found}) must be of type {rule}{more}")


def check_flag(name: str, value: Any) -> None:
    """Raises a `ValueError` unless `value` is True or False."""
    if not isinstance(value, bool):
        raise ValueError(f"`{name}` (={value!r}) must be True or False")


def check_integer(
    name: str, value: Any, low: int, high: int | None = None, *, more: str = ""
) -> int:
    """`value` as an int; a `ValueError`, which `more` ends, unless it is one in [`low`, `high`]."""
    if isinstance(value, Integral) and not isinstance(value, bool):
        number = int(value)
        if number >= low and (high is None or number <= high):
            return number
    rule = f">= {low}" if high is None else f"in [{low}, {high}]"
    raise ValueError(f"`{name}` (={value!r}) must be an integer {rule}{more}")


def as_float(value: Any) -> float:
    """`value` as a float: NaN where it is no real number, infinite where it is too large."""
    try:
        return float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def check_number(name: str, value: Any, low: float, high: float, *, more: str = "") -> float:
    """`value` as a float; a `ValueError`, which `more` ends, unless it is in [`low`, `high`]."""
    number = as_float(value)  # beside a NumPy scalar, bounds lose digits
    if low <= number <= high:
        return number
    rule = f"number in [{low:g}, {high:g}]"
    if high == sys.float_info.max:
        rule = "finite number > 0" if low == sys.float_info.min else f"finite number >= {low:g}"
    raise ValueError(f"`{name}` (={value!r}) must be a {rule}{more}")


def check_seed(seed: Any, name: str = "seed") -> int | None:
    """`seed` as an int >= 0, or None; a `ValueError` if it is neither."""
    return None if seed is None else check_integer(name, seed, 0)
