"""Where finished scenes and score tables are kept between runs."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import platformdirs

#: Environment variable that names another cache folder.
CACHE_VARIABLE = "AE_ENV_CACHE"


def cache_dir() -> Path:
    """The cache folder: the one named by ``AE_ENV_CACHE``, else the user's (not created here)."""
    named = os.environ.get(CACHE_VARIABLE)
    return Path(named).expanduser() if named else Path(platformdirs.user_cache_dir("ae-env"))


def cache_key(parts: Mapping[str, Any]) -> str:
    """Hexadecimal key of everything that changes a cached result.

    Args:
        parts: JSON values by name; the order of the names does not matter.

    >>> cache_key({"a": 1, "b": 2}) == cache_key({"b": 2, "a": 1}) != cache_key({"a": 1, "b": 3})
    True
    """
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:24]
