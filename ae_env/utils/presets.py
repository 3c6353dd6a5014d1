"""The YAML files of ``configs/`` by their names: environments and evaluations."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

from simulator.utils.checks import did_you_mean

#: In an installed package a folder of this one, in a clone the one beside the packages.
_FOLDERS = (Path(__file__).parents[1] / "configs", Path(__file__).parents[2] / "configs")


def list_presets(kind: str = "env") -> list[str]:
    """Names of the presets of one kind.

    Args:
        kind: Folder of ``configs/``, such as ``"env"``.
    """
    return sorted({file.stem for folder in _FOLDERS for file in (folder / kind).glob("*.yaml")})


def find_preset(name: str | PathLike[str], kind: str = "env") -> Path:
    """The YAML file of a preset.

    Args:
        name: Name of a preset, or the path of a ``.yaml`` file.
        kind: Folder of ``configs/``, such as ``"env"``.

    Raises:
        ValueError: If there is neither; the message proposes the nearest name.
    """
    option = "env" if kind == "env" else "preset"  # as the command line calls it
    if isinstance(name, str | PathLike):
        for folder in _FOLDERS:
            file = folder / kind / f"{name}.yaml"
            if file.is_file():
                return file
        own = Path(name).expanduser()
        if own.suffix in (".yaml", ".yml"):
            if own.is_file():
                return own
            raise ValueError(f"`{option}` (={str(name)!r}): there is no such file")
    known = list_presets(kind)
    hint = did_you_mean(name, [k for k in known if k.startswith(f"{name}_")] or known)
    raise ValueError(
        f"`{option}` (={name!r}) must be one of {', '.join(known)} or a .yaml file{hint}"
    )


def find_config(path: Path) -> Path:
    """The YAML file at `path`; of one below ``configs/`` that is not there, the package's own."""
    if path.is_file() or path.parts[:1] != ("configs",) or ".." in path.parts:
        return path
    files = (folder.joinpath(*path.parts[1:]) for folder in _FOLDERS)
    return next((file for file in files if file.is_file()), path)


def load_preset(name: str | PathLike[str]) -> dict[str, Any]:
    """Arguments of the environment from a preset of ``configs/env``.

    Args:
        name: Such as ``"tunnel"``, or the path of a ``.yaml`` file.

    Returns:
        Keyword arguments of ``gymnasium.make("ae_env/AutoExposure-v0", ...)``,
        ``max_episode_steps`` among them.

    Raises:
        ValueError: If there is no such preset, or it cannot be read, is too large or no mapping.
    """
    file = find_preset(name)
    from simulator.utils.config_file import read_yaml

    content = read_yaml(file, name="env")
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise ValueError(f"`env` (={str(file)!r}) must map arguments of the environment to values")
    return content
