"""The packages that are installed together have common names: whose they are is checked."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

#: Folder that our packages are in.
_ROOT = Path(__file__).resolve().parents[2]


def check_package(name: str) -> None:
    """Checks that the top-level package `name` is the one that came with this package.

    Raises:
        ImportError: If another one comes first on ``sys.path``; the message names both.
    """
    spec = find_spec(name)
    folders = [] if spec is None else [*(spec.submodule_search_locations or [])]
    found = folders[0] if folders else None if spec is None else spec.origin
    if found is None or Path(found).resolve() != _ROOT / name:
        raise ImportError(
            f"ae-env needs its own package {name!r} ({_ROOT / name}), but Python finds "
            f"{found or 'none'}: rename the other one, or take its folder off sys.path "
            "(PYTHONPATH, the working folder)"
        )
