"""What `ae-env warm-up` leaves to do: nothing."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

_WARM_UP = """
import importlib, pkgutil
import gymnasium as gym, numba
from agents.cli.data import warm_up
import ae_env, simulator

make_vec = gym.make_vec
small = {"scenes": "bundled:small", "resolution": 36}
gym.make_vec = lambda name, **arguments: make_vec(name, **{**arguments, **small})
warm_up()
for package in (ae_env, simulator):
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        for name, value in vars(importlib.import_module(found.name)).items():
            if isinstance(value, numba.core.dispatcher.Dispatcher) and not value.signatures:
                print("missing", name)
"""


@pytest.mark.slow
def test_nothing_is_compiled_or_drawn_afterwards(dng: Path, tmp_path: Path) -> None:
    kept = {"NUMBA_CACHE_DIR": str(tmp_path / "kernels"), "AE_ENV_CACHE": str(tmp_path / "cache")}

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, *map(str, arguments)]
        done = subprocess.run(command, env=os.environ | kept, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert "compiling" not in done.stderr
        return done

    missing = run("-c", _WARM_UP).stdout.split("missing ")[1:]
    assert [name.strip() for name in missing] == ["philox"]  # part of the code that calls it
    command = ("-m", "agents.cli")
    target = ("--iso", 800, "--shutter", "1/30", "--aperture", 2.8, "--depth", "unknown")
    run(*command, "simulate", dng, *target, "-o", tmp_path / "out.dng")
    focused = ("--aperture", 1.4, "-o", tmp_path / "open.dng", "--weights", "compact")
    run(*command, "refocus", tmp_path / "out.dng", *focused)
    run(*command, "sweep", dng, "--out", tmp_path / "sweep")
    view = "from agents.viewer.viewed_scene import find_scenes; find_scenes('bundled:small')"
    assert "drawing" not in run("-c", view).stderr
