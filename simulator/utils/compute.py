"""Work on the processor: kernels that numba compiles, and threads that share them.

Kernels are compiled once per machine, and run without the interpreter's lock. Compiled code is
cached beside the source, or in the user's cache folder where that cannot be written
(``NUMBA_CACHE_DIR`` names another); where neither can, each process compiles for itself.

As many threads are used as torch would use (`torch.set_num_threads`, ``OMP_NUM_THREADS``). They
belong to the process that made them. A forked child computes on one thread: it would wait for ever
for torch's OpenMP threads, which do not survive a fork.
"""

from __future__ import annotations

import ctypes
import functools
import itertools
import logging
import multiprocessing
import os
import re
import sys
import threading
import timeit
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numba
import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.core import cgutils, event

from simulator.utils.checks import NOTE

logger = logging.getLogger(__name__)
_PACKAGES = ("simulator", "ae_env")
#: Kernels that a default environment needs for its first frame, about.
_FIRST_KERNELS = 12
#: Options of glibc's mallopt: free memory that is given back, and the size of what is taken apart.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
#: Packed pixels up to which networks' memory is kept: taking it anew is a sixth of a sweep's time.
_KEPT_PIXELS = 768**2
#: Ratio of two times above which it is no chance.
_NOTICEABLE = 1.2
#: Warnings that kernels are compiled which are not in the cache.
_KEPT = (
    "compiling parts of the simulator that were not used on this machine before, for this and "
    "later runs (a minute for all; `ae-env warm-up` compiles them beforehand)"
)
_NOT_KEPT = (
    "compiling parts of the simulator, as in every run (a minute for all): no folder can be "
    "written to keep them; NUMBA_CACHE_DIR names one"
)
if hasattr(os, "register_at_fork"):
    # As in the workers of torch's DataLoader; Gymnasium's AsyncVectorEnv forks, too.
    os.register_at_fork(after_in_child=functools.partial(torch.set_num_threads, 1))
#: Folder of the packages.
_ROOT = Path(__file__).parents[2]
#: The modules and names of imports from this project, one line or in parentheses.
_IMPORTS = re.compile(r"^\s*from ((?:simulator|ae_env)[\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator of a function that numba compiles when first called, with options of `njit`."""

    def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
        given: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
        given |= options
        try:
            dispatcher: Callable[..., Any] = numba.njit(cache=True, **given)(function)
        except RuntimeError as error:
            logger.info("%s; it is compiled again in each process", error)
            return numba.njit(**given)(function)
        _adapt_cache(dispatcher, Path(function.__code__.co_filename))
        return dispatcher

    return compiled


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
    pending, found = [module], dict[Path, int]()
    while pending:
        path = pending.pop()
        if path not in found:
            found[path], imported = _read(path)
            pending += imported
    return zlib.crc32(str([found[path] for path in sorted(found)]).encode())


@functools.cache
def _read(module: Path) -> tuple[int, list[Path]]:
    """Checksum of `module` alone, and the modules of this project that it imports."""
    text, modules = module.read_text(encoding="utf-8"), list[Path]()
    for name, imported in _IMPORTS.findall(text):
        folder = _ROOT.joinpath(*name.split("."))  # a package, or a module without ".py"
        parts = (folder, *(folder / part for part in re.findall(r"\w+", imported)))
        modules += [path for part in parts if (path := part.with_suffix(".py")).is_file()]
    return zlib.crc32(text.encode()), modules


class _Announcer(event.Listener):  # type: ignore[misc,unused-ignore]
    """Says once that kernels are compiled, which takes seconds, logs each one, and shows a bar."""

    warned = False
    depth = 0  # kernels compile the kernels that they call
    compiled = 0
    shown = ExitStack()

    def on_start(self, event: Any) -> None:
        """Numba is about to compile a function, not to load one from its cache."""
        self.depth += 1
        function = event.data["dispatcher"].py_func
        if function.__module__.partition(".")[0] in _PACKAGES:
            if not self.warned and multiprocessing.parent_process() is None:  # children are many
                self.warned = True
                kept = hasattr(getattr(event.data["dispatcher"], "_cache", None), "_cache_file")
                level = NOTE if logger.hasHandlers() else logging.WARNING  # Python shows these
                logger.log(level, _KEPT if kept else _NOT_KEPT)
            logger.info("compiling %s.%s", function.__module__, function.__name__)
            if self.depth == 1:
                bar = progress_bar("compiling the simulator", _FIRST_KERNELS, done=self.compiled)
                self.shown.enter_context(bar)

    def on_end(self, event: Any) -> None:
        """It is compiled."""
        self.depth -= 1
        if not self.depth:
            self.compiled += 1
            self.shown.close()


event.register("numba:compile", _Announcer())  # type: ignore[no-untyped-call]


# Images are given to kernels by their addresses: a batch need not lie in one piece of memory.
def addresses(images: Iterable[torch.Tensor | None]) -> np.ndarray:
    """(B,) uintp addresses of contiguous float32 images, 0 for None.

    Take them again for each call: sharing a tensor with another process moves its memory.
    """
    known: np.ndarray | None = getattr(images, "addresses", None)
    if known is not None:
        return known
    return np.array([0 if i is None else i.data_ptr() for i in images], np.uintp)


@numba.extending.intrinsic
def as_pointer(typing, address):  # type: ignore[no-untyped-def]
    """An address as a pointer to float32, inside a kernel."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

    return types.CPointer(types.float32)(types.uintp), generate  # type: ignore[no-untyped-call]


@numba.extending.intrinsic
def prefetch(typing, array, index):  # type: ignore[no-untyped-def]
    """Asks for the cache line of ``array[index]``, which is read soon, inside a kernel."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = context.make_array(array)(context, builder, args[0]).data
        place = builder.bitcast(builder.gep(data, [args[1]]), ir.IntType(8).as_pointer())
        read, near, of_data = (ir.Constant(ir.IntType(32), flag) for flag in (0, 3, 1))
        given = [place.type, *[read.type] * 3]
        called = ir.FunctionType(ir.VoidType(), given)
        builder.call(
            builder.module.declare_intrinsic("llvm.prefetch", given[:1], called),
            [place, read, near, of_data],
        )
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


@numba.extending.intrinsic
def load_alone(typing, words, index):  # type: ignore[no-untyped-def]
    """``words[index]`` of uint64, inside a kernel, loaded by itself.

    Else the compiler loads several words of a table into one vector, which takes longer.
    """

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = context.make_array(words)(context, builder, args[0]).data
        return builder.load_atomic(builder.gep(data, [args[1]]), "monotonic", 8)

    return types.uint64(words, types.intp), generate


@numba.extending.intrinsic
def add_to(typing, numbers, index, more):  # type: ignore[no-untyped-def]
    """Adds `more` to ``numbers[index]``, inside a kernel, and returns what it was.

    The numbers, int64 or float64, may be those of other threads, too.
    """
    add = "add" if isinstance(numbers.dtype, types.Integer) else "fadd"

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = context.make_array(numbers)(context, builder, args[0]).data
        return builder.atomic_rmw(add, builder.gep(data, [args[1]]), args[2], "monotonic")

    return numbers.dtype(numbers, types.intp, numbers.dtype), generate


#: Samples that `add_shifts` adds to.
LANES = 64


@numba.extending.intrinsic
def add_shifts(typing, light, shifts, weights, sums):  # type: ignore[no-untyped-def]
    """Adds weighted shifts of `light`, all 1-dimensional, to the first `LANES` of `sums`.

    ``sums[i] += weights[k] * light[shifts[k] + i]`` for all k, eight of them at a time, with the
    sums in registers: loops over slices take two to three times as long.
    """
    lanes = ir.VectorType(ir.FloatType(), LANES)
    unset, first = ir.Constant(lanes, ir.Undefined), ir.Constant(ir.IntType(32), 0)
    all_first = ir.Constant(ir.VectorType(first.type, LANES), [0] * LANES)

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        arrays = [context.make_array(t)(context, builder, args[i]) for i, t in enumerate(given)]
        of, at, by, to = (array.data for array in arrays)
        contract = ("contract",)

        def at_lanes(pointer: Any) -> Any:
            return builder.bitcast(pointer, lanes.as_pointer())

        def term(k: Any) -> Any:
            weight = builder.load(builder.gep(by, [k]))
            weight = builder.insert_element(unset, weight, first)
            light = at_lanes(builder.gep(of, [builder.load(builder.gep(at, [k]))]))
            weights = builder.shuffle_vector(weight, unset, all_first)
            return builder.fmul(weights, builder.load(light, align=4), flags=contract)

        found = builder.load(at_lanes(to), align=4)
        total = cgutils.alloca_once_value(builder, found)  # type: ignore[no-untyped-call]
        count = builder.extract_value(arrays[2].shape, 0)
        begin, step = ir.Constant(count.type, 0), ir.Constant(count.type, 8)
        with cgutils.for_range_slice(builder, begin, count, step, count.type) as (k, _):
            terms = [term(builder.add(k, ir.Constant(k.type, j))) for j in range(8)]
            while len(terms) > 1:  # in pairs
                pairs = zip(terms[::2], terms[1::2], strict=True)
                terms = [builder.fadd(a, b, flags=contract) for a, b in pairs]
            builder.store(builder.fadd(builder.load(total), *terms, flags=contract), total)
        builder.store(builder.load(total), at_lanes(to), align=4)
        return context.get_dummy_value()

    given = light, shifts, weights, sums
    return types.void(*given), generate


# -- threads --------------------------------------------------------------------------------------

_inside = threading.local()
#: Pieces of work for each thread: what one is late another does.
_PIECES = 8


def parallel_ranges(
    task: Callable[[int, int], object], count: int, *, least: int = 1, threads: int | None = None
) -> None:
    """Call ``task(first, last)`` on contiguous pieces of ``range(count)``, on several threads.

    The caller's is one of them; there are as many as have `least` items each. Whoever is done with
    a piece takes the next. A task that calls `parallel_ranges` itself has one thread. Returns when
    all is done, or, after an error, what was under way; the error is raised here.
    """
    shares = min(threads or torch.get_num_threads(), count // max(least, 1))
    if shares <= 1 or getattr(_inside, "task", False):
        if count:
            task(0, count)
        return
    pieces = min(_PIECES * shares, count)
    numbers, begun = itertools.count(), 0
    errors: list[BaseException] = []
    done: SimpleQueue[None] = SimpleQueue()
    ended: list[None] = []  # beside the queue: an interrupt may lose what was just taken from it

    def work() -> None:
        _inside.task = True  # a thread that waited for others could wait for itself
        try:
            while not errors and (piece := next(numbers)) < pieces:
                task(count * piece // pieces, count * (piece + 1) // pieces)
        except BaseException as error:
            errors.append(error)

    def help_out() -> None:
        work()
        ended.append(None)
        done.put(None)

    try:
        jobs = _jobs(os.getpid(), shares - 1)
        for _ in range(shares - 1):
            jobs.put(help_out)
            begun += 1
        work()
    except BaseException as error:  # an interrupt may come anywhere
        errors.append(error)
    finally:
        _inside.task = False
    while len(ended) < begun:
        try:
            done.get()
        except KeyboardInterrupt as error:  # memory that others still write to must stay
            errors.append(error)
    if errors:
        raise errors[0]


@functools.cache
def _jobs(process: int, size: int) -> SimpleQueue[Callable[[], None]]:
    """What so many threads of a process do; a forked child must not use its parent's.

    An executor takes twice as long to hand over a piece of work.
    """
    jobs: SimpleQueue[Callable[[], None]] = SimpleQueue()

    def serve() -> None:
        while True:
            jobs.get()()

    for number in range(size):
        threading.Thread(target=serve, name=f"simulator_{number}", daemon=True).start()
    return jobs


# -- what else a computation needs ----------------------------------------------------------------


def check_device(device: str | torch.device) -> torch.device:
    """`device` of torch; a `ValueError` unless it is there. ``"auto"``: CUDA where there is one."""
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        found = torch.device(device)
        if found.type == "cuda" and not torch.cuda.is_available():
            raise ValueError(f"`device` (={str(device)!r}) must be 'cpu': there is no CUDA here")
        if found.type != "meta":  # which holds no numbers
            torch.zeros(1, device=found).item()
    except (RuntimeError, TypeError, AssertionError, ImportError) as error:
        why = str(error).partition("\n")[0].partition(". ")[0]
        raise ValueError(f"`device` (={device!r}) cannot be used by torch: {why}") from None
    return found


def outside_inference_mode(call: Callable[..., Any]) -> Callable[..., Any]:
    """`call` outside of torch's inference mode, whose tensors could not be written to later."""

    @functools.wraps(call)
    def called(*args: Any, **options: Any) -> Any:
        if not torch.is_inference_mode_enabled():
            return call(*args, **options)
        with torch.inference_mode(False), torch.no_grad():
            return call(*args, **options)

    return called


def keep_memory() -> None:
    """Makes glibc keep memory that is freed, up to 256 MiB: it is needed again in the next step.

    Else the system takes and clears it anew each time, which can double the time of a torch scorer.
    """
    with suppress(AttributeError, OSError, TypeError):  # no other library has this
        for option, size in (_TRIM_THRESHOLD, 2**28), (_MMAP_THRESHOLD, 2**25):
            ctypes.CDLL(None).mallopt(option, size)


def release_memory(pixels: int) -> None:
    """Gives freed memory back to the system after a large frame; what a small one leaves stays."""
    with suppress(AttributeError, OSError, TypeError):  # no other library has this
        if pixels > _KEPT_PIXELS:
            ctypes.CDLL(None).malloc_trim(0)


def check_bfloat16(device: torch.device) -> None:
    """Logs a warning where bfloat16 makes networks slower."""
    if device.type == "cpu" and (longer := _bfloat16_time()) > _NOTICEABLE:
        text = "precision 'bfloat16': this processor takes %.1f times as long as in 'float32'"
        logger.warning(text, longer)


@functools.cache
def _bfloat16_time() -> float:
    """Time of a convolution in bfloat16, over that in float32.

    Measured, as it cannot be told from what the processor supports: those without bfloat16 emulate
    it, ten times as slow, and one with AVX-512 BF16 but without AMX is faster in float32, too.
    """
    seconds = []
    for dtype in (torch.float32, torch.bfloat16):
        image, weight = (torch.ones(s, dtype=dtype) for s in ((1, 48, 64, 64), (48, 48, 3, 3)))
        convolve = functools.partial(torch.conv2d, image, weight)
        seconds.append(min(timeit.repeat(convolve, number=1, repeat=4)))
    return seconds[1] / seconds[0]


@contextmanager
def progress_bar(title: str, total: int, *, done: int = 0) -> Iterator[Callable[[], None]]:
    """A bar on standard error during work that the user did not ask for, wiped out at the end.

    Yields a function that counts a step; several threads may call it. Nothing is shown where that
    is no terminal, or belongs to a bar of the program's own, or where `total` is 0.
    """
    own = sys.__stderr__
    if not total or own is None or sys.stderr is not own or not own.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as display:
        task = display.add_task(title, total=total, completed=min(done, total))
        yield lambda: display.advance(task)
