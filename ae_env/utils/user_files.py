"""A user's files: code by ``path/to/file.py:Name``, and presets of ``configs/``."""

import importlib
import importlib.util
import inspect
import sys
import traceback
from hashlib import sha256
from os import PathLike
from pathlib import Path
from types import ModuleType
from typing import Any

from simulator.utils.checks import did_you_mean
from simulator.utils.files import printable

#: In an installed package a folder of this one, in a clone the one beside the packages.
_FOLDERS = (Path(__file__).parents[1] / "configs", Path(__file__).parents[2] / "configs")
#: Modules beside the file that was run last, which another folder may have under the same name.
_helpers: set[str] = set()


class UserCodeError(ValueError):
    """A user's scorer or policy raised an error, or returned an invalid value."""


def split_file_name(name: str) -> tuple[str, str] | None:
    """The file and the name in it, or None where `name` is not that of a Python file.

    >>> split_file_name("~/mine.py:MyScore"), split_file_name("mine.py"), split_file_name("noise")
    (('~/mine.py', 'MyScore'), ('mine.py', ''), None)
    """
    head, mark, tail = name.rpartition(".py:")
    if mark:
        return f"{head}.py", tail
    return (name, "") if name.endswith(".py") else None


def load_attribute(name: str, argument: str) -> Any:
    """The object that ``"package.module:name"`` names; ``name`` may have dots.

    `argument` is how errors begin, such as ``"`scenes` (='my.module:scenes')"``. A `ValueError` if
    the module cannot be imported (the cause is chained), or lacks the name; nothing is imported
    unless each part of the name is a Python identifier.
    """
    module_name, _, attribute = name.partition(":")
    if not all(part.isidentifier() for part in attribute.split(".")):
        raise ValueError(f"{argument} must be 'package.module:name'")
    try:
        value: Any = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        raise ValueError(f"{argument} cannot be loaded: {_cause(error)}") from error
    for part in attribute.split("."):
        if not hasattr(value, part):
            hint = did_you_mean(part, dir(value))
            raise ValueError(
                f"{argument} cannot be loaded: {module_name} has no attribute {part!r}{hint}"
            )
        value = getattr(value, part)
    return value


def load_from_file(path: str, name: str, argument: str, example: str = "MyClass") -> Any:
    """The object that a Python file calls `name`, a class or a function.

    The file is run once, and again after it has changed. It may import modules beside it at its
    top, not later in a function; files in different folders may have helpers of the same name, each
    its own. A relative `path` is looked for in the current folder, ``~`` is the home. A
    `ValueError` if it cannot be loaded (the cause is chained), or has nothing of that name.

    Args:
        path, name: The file, and the object's name.
        argument: How errors begin, such as ``"`scorer` (='my_scorer.py:MyScore')"``.
        example: A name that the error proposes where there is none.
    """
    if not name:
        raise ValueError(f"{argument} must name a class of the file: '{path}:{example}'")
    file = Path(path).expanduser()
    if not file.is_file():
        where = "" if file.is_absolute() else f" in {Path.cwd()}"
        raise ValueError(f"{argument}: there is no file {path!r}{where}")
    return find_attribute(_module(path, file.resolve(), argument), name, argument)


def find_attribute(module: ModuleType, name: str, argument: str) -> Any:
    """The object that `module` calls `name`; the `ValueError` without one lists its classes."""
    try:
        return getattr(module, name)
    except AttributeError:
        classes = [(k, value) for k, value in vars(module).items() if inspect.isclass(value)]
        own = [key for key, value in classes if value.__module__ == module.__name__]
        found = ", ".join(own) or "no class at all"
        hint = did_you_mean(name, own)
        raise ValueError(f"{argument}: no class {name!r} there; found {found}{hint}") from None


def _module(path: str, file: Path, argument: str) -> ModuleType:
    """The module of a file, under a name that belongs to its path; run again where it changed."""
    try:
        content = file.read_bytes()
    except OSError as error:
        raise ValueError(f"{argument}: {path} cannot be read: {error.strerror}") from error
    name = f"ae_env_user_{file.stem}_{sha256(printable(str(file)).encode()).hexdigest()[:12]}"
    digest = sha256(content).hexdigest()
    known = sys.modules.get(name)
    if known is not None and vars(known).get("_ae_env_content") == digest:
        return known
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None  # its name ends in .py
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up while it loads
    try:
        # Compiled here: the loader's cached bytecode tells files apart by size and second only.
        _run(compile(content, str(file), "exec", dont_inherit=True), module, file.parent)
    except (Exception, SystemExit) as error:  # a script, for example, ends the program
        del sys.modules[name]
        raise ValueError(f"{argument}: {path} cannot be loaded: {_cause(error, file)}") from error
    vars(module)["_ae_env_content"] = digest
    return module


def _run(code: Any, module: ModuleType, folder: Path) -> None:
    """Runs a file's code; modules in its folder can be imported meanwhile, as by a script."""
    for name in [n for n in sys.modules if n.partition(".")[0] in _helpers]:
        del sys.modules[name]
    _helpers.clear()
    before = set(sys.modules)
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()
    try:
        exec(code, vars(module))
    finally:
        if str(folder) in sys.path:  # the code may have changed it
            sys.path.remove(str(folder))
        new = {name.partition(".")[0] for name in set(sys.modules) - before}
        _helpers.update(name for name in new if name in sys.modules and _is_only_in(folder, name))


def _is_only_in(folder: Path, name: str) -> bool:
    """Whether the module `name` came from `folder`, and could not be imported without it."""
    module = sys.modules[name]
    file = getattr(module, "__file__", None)
    origin = file or next(iter(getattr(module, "__path__", [])), None)
    if origin is None or not Path(origin).is_relative_to(folder):
        return False
    del sys.modules[name]  # where `find_spec` would look first
    try:
        spec = importlib.util.find_spec(name)
    finally:
        sys.modules[name] = module
    return spec is None or spec.origin != file


def _cause(error: BaseException, file: Path | None = None) -> str:
    """Type and text of an error, with the line of `file` that it came from, where there is one."""
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == str(file)]
    where = f" (line {lines[-1]})" if lines else ""  # a SyntaxError says so itself
    return f"{type(error).__name__}: {error}{where}"


# -- presets ---------------------------------------------------------------------------------------


def list_presets(kind: str = "env") -> list[str]:
    """Names of the presets of one `kind`, a folder of ``configs/``."""
    return sorted({file.stem for folder in _FOLDERS for file in (folder / kind).glob("*.yaml")})


def find_preset(name: str | PathLike[str], kind: str = "env") -> Path:
    """The YAML file of a preset's name in a folder of ``configs/``, `kind`, or of its own path.

    A `ValueError` proposes the nearest name if there is neither.
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
    """Arguments of ``gymnasium.make`` from the preset or ``.yaml`` file `name`; see `list_presets`.

    A `ValueError` if there is no such preset, or it cannot be read, is too large or no mapping.
    """
    file = find_preset(name)
    from simulator.utils.config_file import read_yaml

    content = read_yaml(file, name="env")
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise ValueError(f"`env` (={str(file)!r}) must map arguments of the environment to values")
    return content
