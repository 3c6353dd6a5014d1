"""How the kernels of this package are compiled: once per machine, without the interpreter's lock.

What numba compiles is kept next to the source, or in the user's cache folder where that cannot be
written (``NUMBA_CACHE_DIR`` names another); where neither can, each process compiles for itself.
"""

from __future__ import annotations

import functools
import logging
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from numba import types
from numba.core import event


# Images handed to kernels by their address: a batch need not lie in one piece of memory.
def addresses(images: Sequence[torch.Tensor | None]) -> np.ndarray:
    """(B,) uintp addresses of contiguous float32 images, 0 for None.

    To be taken anew for each call: sharing a tensor with another process moves its memory.
    """
    return np.array([0 if i is None else i.data_ptr() for i in images], np.uintp)


@numba.extending.intrinsic
def as_pointer(typing, address):  # type: ignore[no-untyped-def]
    """An address as a pointer to float32."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

    return types.CPointer(types.float32)(types.uintp), generate


logger = logging.getLogger(__name__)
#: Modules that hold kernels, or constants and functions of kernels.
_CONSTANTS = (
    *("capture/exposure", "capture/kernels", "capture/light_statistics", "noise/generator"),
    *("optics/blur_kernels", "optics/disc_bank", "optics/shapes", "raw/image"),
    *("raw/noise_estimation", "utils/jit"),
)
_PACKAGE = __name__.partition(".")[0]


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator of a function that numba compiles when it is first called.

    Args:
        options: Of `numba.njit`, such as ``fastmath``.
    """

    def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
        given: dict[str, Any] = {"nogil": True, "error_model": "numpy", **options}
        try:
            dispatcher = numba.njit(cache=True, **given)(function)
        except RuntimeError as error:
            logger.info("%s; it is compiled anew in each process", error)
            return numba.njit(**given)(function)
        _harden(dispatcher._cache)
        return dispatcher

    return compiled


def _harden(cache: Any) -> None:
    """Makes numba's cache of one kernel count for all kernels' code, and a full disk no error.

    Numba looks at the file of the kernel alone, which calls and names what stands in others.
    """
    index, save = cache._cache_file, cache.save_overload
    index._source_stamp = (index._source_stamp, _sources())

    def save_if_possible(*arguments: Any) -> None:
        try:
            save(*arguments)
        except OSError as error:
            logger.info("%s; it is compiled anew in each process", error)

    cache.save_overload = save_if_possible


@functools.cache
def _sources() -> int:
    """Checksum of every module that kernels stand in or take constants from."""
    folder = Path(__file__).parents[1]
    files = [folder / f"{name}.py" for name in _CONSTANTS]
    return functools.reduce(
        lambda value, path: zlib.crc32(path.read_bytes(), value), sorted(files), 0
    )


class _Announcer(event.Listener):  # type: ignore[misc]
    """Logs each kernel of this package that is compiled: the first call of one takes seconds."""

    def on_start(self, event: Any) -> None:
        """Called before numba compiles a function, not when it loads one."""
        function = event.data["dispatcher"].py_func
        if function.__module__.partition(".")[0] == _PACKAGE:
            logger.info("compiling %s.%s", function.__module__, function.__name__)

    def on_end(self, event: Any) -> None:
        """Called afterwards."""


event.register("numba:compile", _Announcer())
