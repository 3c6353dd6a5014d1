"""Compiling kernels: once per machine, and run without the interpreter's lock.

Compiled code is cached beside the source, or in the user's cache folder where that cannot be
written (``NUMBA_CACHE_DIR`` names another); where neither can, each process compiles for itself.
"""

from __future__ import annotations

import functools
import logging
import multiprocessing
import re
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from numba import types
from numba.core import event

from simulator.utils.progress import Progress

logger = logging.getLogger(__name__)
_PACKAGES = ("simulator", "ae_env")
#: Kernels that a default environment needs for its first frame, about.
_FIRST_KERNELS = 12
#: What is said where something is compiled that was not kept from an earlier run.
_KEPT = (
    "compiling parts of the simulator that were not used on this machine before, for this and "
    "later runs (all take 10 s or so; `ae-env warm-up` compiles them beforehand)"
)
_NOT_KEPT = (
    "compiling parts of the simulator, as in every run (10 s or so for all): no folder can be "
    "written to keep them; NUMBA_CACHE_DIR names one"
)
#: Folder of the packages.
_ROOT = Path(__file__).parents[2]
#: The modules and names of imports from this project, one line or in parentheses.
_IMPORTS = re.compile(r"^\s*from ((?:simulator|ae_env)[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator of a function that numba compiles when it is first called.

    Args:
        options: Options of `numba.njit`, such as ``fastmath``.
    """

    def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
        given: dict[str, Any] = {"nogil": True, "error_model": "numpy", **options}
        dispatcher: Callable[..., Any]
        try:
            dispatcher = numba.njit(cache=True, **given)(function)
        except RuntimeError as error:
            logger.info("%s; it is compiled again in each process", error)
            dispatcher = numba.njit(**given)(function)
        else:
            _adapt_cache(dispatcher, Path(function.__code__.co_filename))
        return dispatcher

    return compiled


def _is_kept(dispatcher: Any) -> bool:
    """Whether what is compiled of a kernel is kept for other processes."""
    return hasattr(getattr(dispatcher, "_cache", None), "_cache_file")


def _adapt_cache(dispatcher: Any, module: Path) -> None:
    """Makes numba's cache of a kernel stale when any module changes that the kernel depends on.

    Numba itself looks at the kernel's own module alone, but the functions and constants that a
    kernel names are compiled into it. Also, a full disk must not be an error.
    """
    cache = dispatcher._cache
    index, save = cache._cache_file, cache.save_overload
    index._source_stamp = (index._source_stamp, _checksum(module))

    def save_if_possible(*arguments: Any) -> None:
        try:
            save(*arguments)
        except OSError as error:
            logger.info("%s; it is compiled again in each process", error)

    cache.save_overload = save_if_possible


@functools.cache
def _checksum(module: Path) -> int:
    """Checksum of `module` and of every module of this project that it imports, at any depth."""
    pending, texts = [module], dict[Path, str]()
    while pending:
        path = pending.pop()
        if path not in texts and path.is_file():
            texts[path] = path.read_text(encoding="utf-8")
            for name, imported in _IMPORTS.findall(texts[path]):
                folder = _ROOT.joinpath(*name.split("."))  # a package, or a module without ".py"
                modules = (folder / part for part in re.findall(r"\w+", imported))
                pending += [path.with_suffix(".py") for path in (folder, *modules)]
    return functools.reduce(
        lambda value, path: zlib.crc32(texts[path].encode(), value), sorted(texts), 0
    )


class _Announcer(event.Listener):  # type: ignore[misc,unused-ignore]
    """Says that kernels are compiled, which takes seconds, and logs each one of this package."""

    said = False
    depth = 0  # kernels compile the kernels that they call
    bar = Progress("compiling the simulator", _FIRST_KERNELS)

    def on_start(self, event: Any) -> None:
        """Numba is about to compile a function, not to load one from its cache."""
        self.depth += 1
        function = event.data["dispatcher"].py_func
        if function.__module__.partition(".")[0] in _PACKAGES:
            if not self.said and multiprocessing.parent_process() is None:  # children are many
                self.said = True
                logger.warning(_KEPT if _is_kept(event.data["dispatcher"]) else _NOT_KEPT)
            logger.info("compiling %s.%s", function.__module__, function.__name__)
            if self.depth == 1:
                self.bar.show()

    def on_end(self, event: Any) -> None:
        """It is compiled."""
        self.depth -= 1
        if not self.depth:
            self.bar.advance()
            self.bar.close()


_announcer = _Announcer()
event.register("numba:compile", _announcer)  # type: ignore[no-untyped-call]


# Images are given to kernels by their addresses: a batch need not lie in one piece of memory.
def addresses(images: Sequence[torch.Tensor | None]) -> np.ndarray:
    """(B,) uintp addresses of contiguous float32 images, 0 for None.

    Take them again for each call: sharing a tensor with another process moves its memory.
    """
    return np.array([0 if i is None else i.data_ptr() for i in images], np.uintp)


@numba.extending.intrinsic
def as_pointer(typing, address):  # type: ignore[no-untyped-def]
    """An address as a pointer to float32, inside a kernel."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

    return types.CPointer(types.float32)(types.uintp), generate  # type: ignore[no-untyped-call]
