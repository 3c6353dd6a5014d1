"""The search for model files that some scorers need and that do not come with the package."""

from __future__ import annotations

import os
from pathlib import Path

from simulator.utils.cache import cache_dir


def find_model_file(
    scorer: str,
    given: str | os.PathLike[str] | None,
    variable: str,
    names: tuple[str, ...],
    *,
    how: str,
) -> Path:
    """The model file of a scorer.

    It is `given`, or else the one that the environment variable names, or else in the cache folder.

    Args:
        scorer: Name of the scorer, for errors.
        given: A file, or None.
        variable: Environment variable that may name one.
        names: File names in the cache folder; the first that exists is taken.
        how: How to get the file: the end of the message where there is none.

    Raises:
        ValueError: If there is none; the message says where to put it.
    """
    named = os.environ.get(variable) if given is None else os.fspath(given)
    if named:
        file = Path(named).expanduser()
        if file.is_file():
            return file
        source = f"`{variable}`" if given is None else "`file`"
        raise ValueError(f"{source} (={named!r}) must be the model file of {scorer!r}; {how}")
    folder = cache_dir()
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise ValueError(
        f"scorer {scorer!r} needs a model file, which does not come with ae-env: set "
        f"{variable}=FILE, or put it at {folder / names[0]}; {how}"
    )
