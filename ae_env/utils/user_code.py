"""Classes and functions in a Python file of the user's own, named ``path/to/file.py:Name``."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from ae_env.utils.checks import did_you_mean

#: Modules that the files run so far have imported from their own folders.
_helpers: set[str] = set()


def split_file_name(name: str) -> tuple[str, str] | None:
    """The file and what of it is meant, or None where `name` is not that of a Python file.

    >>> split_file_name("~/mine.py:MyScore"), split_file_name("mine.py"), split_file_name("noise")
    (('~/mine.py', 'MyScore'), ('mine.py', ''), None)
    """
    head, mark, tail = name.rpartition(".py:")
    if mark:
        return f"{head}.py", tail
    return (name, "") if name.endswith(".py") else None


def load_from_file(path: str, name: str, argument: str, example: str = "MyClass") -> Any:
    """What a Python file calls `name`.

    The file is run once, and again only after it has changed. At its top it may import modules
    beside it, as a script may; files in different folders may have helpers of the same name.

    Args:
        path: The file; a relative one is looked for in the current folder, ``~`` is the home.
        name: A class, or a function.
        argument: What errors call it, such as ``"`scorer` (='my_scorer.py:MyScore')"``.
        example: A name that the error proposes where there is none.

    Raises:
        ValueError: If there is no such file, it cannot be loaded (the cause is chained), or it has
            nothing of that name.
    """
    if not name:
        raise ValueError(f"{argument} must name a class of the file: '{path}:{example}'")
    file = Path(path).expanduser()
    if not file.is_file():
        where = "" if file.is_absolute() else f" in {Path.cwd()}"
        raise ValueError(f"{argument}: there is no file {path!r}{where}")
    return find_attribute(_module(path, file.resolve(), argument), name, argument)


def find_attribute(module: ModuleType, name: str, argument: str) -> Any:
    """What `module` calls `name`.

    Raises:
        ValueError: If there is nothing of that name; the message lists the module's own classes.
    """
    try:
        return getattr(module, name)
    except AttributeError:
        own = [
            key
            for key, value in vars(module).items()
            if inspect.isclass(value) and value.__module__ == module.__name__
        ]
        found = ", ".join(own) or "no class at all"
        hint = did_you_mean(name, own)
        raise ValueError(f"{argument}: no class {name!r} there; found {found}{hint}") from None


def _module(path: str, file: Path, argument: str) -> ModuleType:
    try:
        content = file.read_bytes()
    except OSError as error:
        raise ValueError(f"{argument}: {path} cannot be read: {error.strerror}") from error
    digest = hashlib.sha256(content).hexdigest()
    place = hashlib.sha256(str(file).encode()).hexdigest()[:12]
    stem = "".join(c if c.isalnum() else "_" for c in file.stem)
    key = f"ae_env_user_{stem}_{place}"
    known = sys.modules.get(key)
    if known is not None and getattr(known, "_ae_env_content", None) == digest:
        return known
    spec = importlib.util.spec_from_file_location(key, file)
    if spec is None or spec.loader is None:
        raise ValueError(f"{argument}: {path!r} cannot be loaded as Python")
    module = importlib.util.module_from_spec(spec)
    sys.modules[key] = module  # dataclasses look their module up while it loads
    try:
        # Not through the loader, whose bytecode of a second ago may be that of other content.
        with _importing_from(file.parent):
            exec(compile(content, str(file), "exec", dont_inherit=True), module.__dict__)
    except (Exception, SystemExit) as error:  # a script, for example, ends the program
        sys.modules.pop(key, None)
        raise ValueError(
            f"{argument}: {path} cannot be loaded: {type(error).__name__}: {error}"
        ) from error
    module.__dict__["_ae_env_content"] = digest
    return module


@contextmanager
def _importing_from(folder: Path) -> Iterator[None]:
    """Modules in `folder` can be imported; those of earlier files, from theirs, are forgotten."""
    for name in [n for n in sys.modules if n.partition(".")[0] in _helpers]:
        del sys.modules[name]
    _helpers.clear()
    before = {name.partition(".")[0] for name in sys.modules}
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()
    try:
        yield
    finally:
        if str(folder) in sys.path:  # what was run may have changed it
            sys.path.remove(str(folder))
        new = {name.partition(".")[0] for name in sys.modules} - before
        _helpers.update(name for name in new if _is_only_in(folder, name))


def _is_only_in(folder: Path, name: str) -> bool:
    """Whether the module `name` came from `folder`, and would not be found without it."""
    module = sys.modules.get(name)
    place = getattr(module, "__file__", None) or next(iter(getattr(module, "__path__", [])), None)
    if module is None or place is None or not Path(place).is_relative_to(folder):
        return False
    del sys.modules[name]
    try:
        spec = importlib.util.find_spec(name)
    finally:
        sys.modules[name] = module
    return spec is None or spec.origin != getattr(module, "__file__", None)
