"""From a YAML file to a validated configuration."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import yaml
from pydantic import BaseModel, ValidationError

Model = TypeVar("Model", bound=BaseModel)


def load_yaml(path: str | Path, model: type[Model]) -> Model:
    """The configuration in a YAML file.

    Raises:
        ValueError: If the file is missing or not YAML, or an entry is unknown or out of range; the
            message names the file and the entry.
    """
    file = Path(path).expanduser()
    if not file.is_file():
        raise ValueError(f"`config` (={str(path)!r}): there is no such file")
    try:
        return model.model_validate(yaml.safe_load(file.read_text(encoding="utf-8")))
    except ValidationError as error:
        raise ValueError(f"`config` (={str(path)!r}): {one_line(error)}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        text = " ".join(str(error).split())
        raise ValueError(f"`config` (={str(path)!r}) is not YAML: {text}") from error


def one_line(error: ValidationError, prefix: str = "") -> str:
    """Every complaint of pydantic's, with the entry that it is about."""
    parts = []
    for item in error.errors():
        entry = ".".join(str(key) for key in item["loc"])
        message = item["msg"].removeprefix("Value error, ")
        given = f" (={item['input']!r})" if entry and item["type"] != "missing" else ""
        parts.append(f"{prefix}{entry}{given}: {message}" if entry else message)
    return "; ".join(parts)
