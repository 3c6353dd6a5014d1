"""YAML files, turned into validated configurations."""

import os
import reprlib
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from simulator.utils.checks import did_you_mean

#: Most bytes of a YAML file.
MAX_BYTES = 2**20
#: Most values of a YAML file, those of an alias counted wherever it stands; most of them nested,
#: and most characters of one.
MAX_VALUES, MAX_DEPTH, MAX_LENGTH = 2**16, 100, 2**11
#: Environment variable: folders whose YAML files may name Python code, or ``all``.
TRUST_VARIABLE = "AE_ENV_TRUST"
#: A package that stands before the names of its metrics, of which none is code.
_METRICS = "pyiqa"

#: Words for pydantic's errors that name Python types.
_PLAIN = {
    **dict.fromkeys(("tuple_type", "list_type"), "must be a list"),
    **dict.fromkeys(("dict_type", "mapping_type", "model_type"), "must be a mapping"),
}

_MOST_COMPLAINTS = 8
_short = reprlib.Repr()
_short.maxstring = _short.maxother = 200


class Configuration(BaseModel):
    """Base of all configurations: frozen, without unknown entries; true is not the number 1."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_booleans(cls, value: Any) -> Any:
        if isinstance(value, bool):
            raise ValueError("Input should not be true or false")
        return value


Model = TypeVar("Model", bound=BaseModel)


def load_yaml(path: str | Path, model: type[Model]) -> Model:
    """The configuration in a YAML file; a `ValueError` names the file and the wrong entry."""
    name, content = f"`config` (={str(path)!r})", read_yaml(path)
    if not isinstance(content, dict):
        found = "is empty" if content is None else f"holds {_short.repr(content)}"
        rule = f"it must map entries to values; known entries: {', '.join(model.model_fields)}"
        raise ValueError(f"{name} {found}: {rule}")
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise ValueError(f"{name}: {one_line(error, model=model)}") from error


def read_yaml(path: str | Path, *, name: str = "config") -> Any:
    """The values in a YAML file from anybody; None for an empty file.

    No tag runs code, and no value may name code to run, unless `TRUST_VARIABLE` has the file's
    folder; `name` is the argument that gave the path, for error messages. A `ValueError` if the
    file is missing, unreadable, not YAML, larger than one of the bounds above, gives an entry
    twice, or names Python code.
    """
    file = Path(path).expanduser()
    cause: Exception | None = None
    try:
        if not file.is_file():
            fault = "is a folder, not a YAML file" if file.is_dir() else "there is no such file"
        elif file.stat().st_size > MAX_BYTES:
            fault = f"must not be larger than {MAX_BYTES} bytes"
        else:
            content = _values(file.read_text(encoding="utf-8"))
            named = list(filter(_names_code, _texts(content)))
            if not named or _is_trusted(file):
                return content
            fault = f"it names Python code ({named[0]!r}), which would run: read both, then give "
            fault += f"--trust, or name the folder in {TRUST_VARIABLE}"
    except OSError as error:
        fault, cause = f"cannot be read: {error.strerror}", error
    except _Fault as error:
        fault = str(error)
    except RecursionError:
        fault = "is not YAML: it is nested too deeply"
    except Exception as error:  # of values such as `!!int x`, whatever their conversion raises
        fault, cause = f"is not YAML: {' '.join(str(error).split())}", error
    raise ValueError(f"`{name}` (={str(path)!r}): {fault}") from cause


def _values(text: str) -> Any:
    depth = 0
    for count, event in enumerate(yaml.parse(text, _Loader)):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:  # the loader in C would crash
            raise RecursionError
        if count > MAX_VALUES or len(getattr(event, "value", "")) > MAX_LENGTH:
            rule = f"it holds more than {MAX_VALUES} values, or one of more than {MAX_LENGTH}"
            raise _Fault(f"{rule} characters")
    return yaml.load(text, _Loader)


def _is_trusted(file: Path) -> bool:
    named = os.environ.get(TRUST_VARIABLE, "")
    folders = [Path(folder).expanduser().resolve() for folder in named.split(os.pathsep) if folder]
    return named == "all" or any(file.resolve().is_relative_to(folder) for folder in folders)


def _texts(content: Any) -> Iterator[str]:
    """All texts of a YAML file, keys among them; an error for more than `MAX_VALUES` values."""
    waiting, count = [content], 0
    while waiting:
        value, count = waiting.pop(), count + 1
        if count > MAX_VALUES:
            raise _Fault(f"its aliases stand for more than {MAX_VALUES} values")
        if isinstance(value, bytes):  # of `!!binary`; pydantic takes them as text
            value = value.decode(errors="replace")
        if isinstance(value, str):
            yield value
        elif isinstance(value, Iterable):
            waiting.extend(chain(*value.items()) if isinstance(value, dict) else value)


def _names_code(text: str) -> bool:
    """Whether a text names a Python file, or anything of a module that there is.

    Nothing that loads code takes a name behind a space or a slash (``time: tunnel``).
    """
    text = text.strip()
    head, colon, tail = text.partition(":")
    top = head.partition(".")[0]  # to look for a submodule would run its parent
    if ".py:" in text or text.endswith(".py"):
        return True
    try:
        named = colon and top and not tail[:1].isspace() and tail[:1] != "/"
        return bool(named and find_spec(top)) and head != _METRICS
    except ValueError:  # such as `__main__`
        return True


class _Fault(Exception):
    """What is wrong with a file that is YAML."""


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """PyYAML's safe loader, in C where it has one; by itself it takes the last of two entries."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._flat: set[int] = set()  # mappings that have the entries of what they merge
        self._entries = 0

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        if id(node) in self._flat:
            return
        self._flat.add(id(node))
        seen: set[tuple[str, str]] = set()
        for key, value in node.value:
            if isinstance(key, yaml.ScalarNode) and (key.tag, key.value) in seen:
                line = key.start_mark.line + 1
                raise _Fault(f"the entry {key.value!r} is given twice, again in line {line}")
            seen.add((key.tag, str(key.value)))
            if key.tag == "tag:yaml.org,2002:merge" and isinstance(value, yaml.SequenceNode):
                raise _Fault("`<<` merges one mapping, not a list of them")
        super().flatten_mapping(node)
        self._entries += len(node.value)
        if self._entries > MAX_VALUES:
            raise _Fault(f"it merges more than {MAX_VALUES} entries")


def one_line(error: ValidationError, prefix: str = "", model: Any = None) -> str:
    """Pydantic's first eight complaints in one line, each with the entry that it is about.

    `prefix` stands before every entry's name; of `model` the nearest to an unknown one is proposed.
    """
    parts, more = [], error.error_count() - _MOST_COMPLAINTS
    for item in error.errors()[:_MOST_COMPLAINTS]:
        entry = ".".join(str(key) for key in item["loc"])
        message = _PLAIN.get(item["type"]) or item["msg"].removeprefix("Value error, ")
        if item["type"] == "extra_forbidden" and model is not None:
            message = _unknown(model, item["loc"])
        given = f" (={_short.repr(item['input'])})" if entry and item["type"] != "missing" else ""
        parts.append(f"{prefix}{entry}{given}: {message}" if entry else message)
    return "; ".join(parts) + (f"; and {more} more" if more > 0 else "")


def _unknown(model: Any, location: tuple[int | str, ...]) -> str:
    """Message for an unknown entry at `location` of a configuration."""
    for key in location[:-1]:
        if hasattr(model, "model_fields"):
            model = model.model_fields[key].annotation
            if type(None) in get_args(model):  # an entry that may be left out
                model = next(t for t in get_args(model) if t is not type(None))
        else:  # `key` is one of a mapping's, or an index in a list
            model = next(t for t in reversed(get_args(model)) if t is not Ellipsis)
    known = list(model.model_fields)
    return f"unknown, the entries are {known}{did_you_mean(location[-1], known, '`')}"
