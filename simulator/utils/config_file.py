"""From a YAML file to a validated configuration."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

#: A configuration is no larger than this [byte], nor has it more entries, or deeper ones.
MAX_BYTES, MAX_ENTRIES, MAX_DEPTH = 2**20, 10_000, 50

#: What is said in place of the names of Python's types.
_PLAIN = {
    **dict.fromkeys(("tuple_type", "list_type"), "must be a list"),
    **dict.fromkeys(("dict_type", "mapping_type", "model_type"), "must be a mapping"),
}

_short = reprlib.Repr()
_short.maxstring = _short.maxother = 200


class Configuration(BaseModel):
    """Base of what a YAML file holds: frozen, without unknown entries; true is not the number 1."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @field_validator("*", mode="before")
    @classmethod
    def _no_truth(cls, value: Any) -> Any:
        if isinstance(value, bool):
            raise ValueError("Input should not be true or false")
        return value


Model = TypeVar("Model", bound=BaseModel)


def load_yaml(path: str | Path, model: type[Model]) -> Model:
    """The configuration in a YAML file.

    Raises:
        ValueError: If the file is missing, unreadable or not YAML, or an entry is unknown, given
            twice or out of range; the message names the file and the entry.
    """
    file, name = Path(path).expanduser(), f"`config` (={str(path)!r})"
    try:
        if not file.is_file():
            what = "is a folder, not a YAML file" if file.is_dir() else "there is no such file"
            raise ValueError(f"{name}: {what}")
        if file.stat().st_size > MAX_BYTES:
            raise ValueError(f"{name}: must not be larger than {MAX_BYTES} bytes")
        text = file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{name} is not YAML: {error}") from error
    except OSError as error:
        raise ValueError(f"{name} cannot be read: {error.strerror}") from error
    content = _parsed(text, name)
    if not isinstance(content, dict):
        found = "is empty" if content is None else f"holds {_short.repr(content)}"
        known = ", ".join(model.model_fields)
        raise ValueError(f"{name} {found}: it must have entries, of {known}")
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise ValueError(f"{name}: {one_line(error, model=model)}") from error


def one_line(error: ValidationError, prefix: str = "", model: Any = None) -> str:
    """Every complaint of pydantic's, with the entry that it is about.

    Args:
        error: What pydantic raised.
        prefix: Put before the name of every entry.
        model: What was validated, so that the nearest name is proposed for an unknown one.
    """
    parts = []
    for item in error.errors():
        entry = ".".join(str(key) for key in item["loc"])
        message = _PLAIN.get(item["type"]) or item["msg"].removeprefix("Value error, ")
        if item["type"] == "extra_forbidden" and model is not None:
            message = _unknown(model, item["loc"])
        given = f" (={_short.repr(item['input'])})" if entry and item["type"] != "missing" else ""
        parts.append(f"{prefix}{entry}{given}: {message}" if entry else message)
    return "; ".join(parts)


def _unknown(model: Any, place: tuple[int | str, ...]) -> str:
    """What to say of an unknown entry at `place` of a configuration."""
    for key in place[:-1]:
        if hasattr(model, "model_fields"):
            model = model.model_fields[key].annotation
            if type(None) in get_args(model):  # an entry that may be left out
                model = next(t for t in get_args(model) if t is not type(None))
        else:  # `key` is one of a mapping's, or a place in a list
            model = next(t for t in reversed(get_args(model)) if t is not Ellipsis)
    known = list(model.model_fields)
    near = difflib.get_close_matches(str(place[-1]), known, n=1)
    hint = f"; did you mean `{near[0]}`?" if near else ""
    return f"unknown, the entries are {known}{hint}"


def _parsed(text: str, name: str) -> Any:
    """The values in a text of YAML; in errors, the file is called `name`."""
    with _yaml_errors(name):
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
    if node is None:
        return None
    try:
        _check_node(node, {})
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    with _yaml_errors(name):
        return loader.construct_document(node)


@contextmanager
def _yaml_errors(name: str) -> Iterator[None]:
    try:
        yield
    except RecursionError:
        raise ValueError(f"{name} is not YAML: it is nested too deeply") from None
    except Exception as error:  # of values such as `!!int x`, whatever their conversion raises
        raise ValueError(f"{name} is not YAML: {' '.join(str(error).split())}") from error


def _check_node(node: yaml.Node, entries: dict[int, int], depth: int = 0) -> int:
    """Number of entries below `node`, every alias counted as often as it is used.

    Raises:
        ValueError: If there are too many, or too deep, or an entry is given twice.
    """
    if depth > MAX_DEPTH:
        raise ValueError(f"entries must not be nested deeper than {MAX_DEPTH}")
    if id(node) not in entries:
        children: list[yaml.Node] = []
        if isinstance(node, yaml.SequenceNode):
            children = node.value
        elif isinstance(node, yaml.MappingNode):
            children = [part for pair in node.value for part in pair]
            _check_keys([key for key, _ in node.value])
        entries[id(node)] = 1 + sum(_check_node(child, entries, depth + 1) for child in children)
    if entries[id(node)] > MAX_ENTRIES:
        raise ValueError(f"there must be at most {MAX_ENTRIES} entries, aliases written out")
    return entries[id(node)]


def _check_keys(keys: list[yaml.Node]) -> None:
    seen: set[Hashable] = set()
    for key in keys:
        if isinstance(key, yaml.ScalarNode) and (key.tag, key.value) in seen:
            line = key.start_mark.line + 1
            raise ValueError(f"the entry {key.value!r} is given twice, again in line {line}")
        seen.add((key.tag, key.value) if isinstance(key, yaml.ScalarNode) else id(key))
