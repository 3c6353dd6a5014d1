"""Compiles what a first frame needs last, in a process beside the one that makes the environment.

Numba compiles in one thread of a process, and caches what it has compiled in files: with nothing
cached, a first frame takes half as long again without the other. Run as a program, this module
compiles; nothing waits for it, so where it comes too late a kernel is compiled twice.
"""

import atexit
import multiprocessing
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import torch

from simulator.capture.sensor import is_compiled

#: Set in the process that compiles, which starts none itself.
_MARK = "AE_ENV_COMPILES_FIRST_FRAME"
_started = False


def compile_beside() -> None:
    """Starts the process, once, if there are kernels to compile and a processor to do it on."""
    global _started
    python = Path(sys.executable or "").name.lower().startswith("python")  # no application with one
    child = multiprocessing.parent_process() is not None or _MARK in os.environ
    if _started or child or not python or torch.get_num_threads() < 2 or is_compiled():
        return
    _started = True
    root, own = str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")
    known = os.environ | {_MARK: "1", "PYTHONPATH": os.pathsep.join(filter(None, (root, own)))}
    with suppress(OSError):  # then all is compiled here
        null = subprocess.DEVNULL
        command = [sys.executable, "-P", "-m", __name__]
        process = subprocess.Popen(command, env=known, stdin=null, stdout=null, stderr=null)
        atexit.register(process.kill)  # files are written whole or not at all


def _compile() -> None:
    import numpy as np

    from simulator.camera import get_camera
    from simulator.capture.sensor import Transitions, record

    torch.set_num_threads(1)
    light, table = [torch.full((4, 16, 16), 0.1)], np.zeros((1, 5, 4), np.float32)
    keys, codes = np.ones(1, np.uint64), np.empty((1, 4, 16, 16), np.uint8)
    given = Transitions(light, table, None), get_camera("nikon_z6")
    record(*given, keys=keys, noise="bank", count=True, codes=codes)


if __name__ == "__main__":
    _compile()
