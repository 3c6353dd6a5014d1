import os
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest
from typer.testing import CliRunner

from agents.cli.main import app


def test_every_environment_that_is_warmed_up_can_be_made(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    make_vec = gym.make_vec

    def make_small(name: str, **arguments):
        made.append(name.rpartition("/")[2])
        return make_vec(name, **{**arguments, "scenes": "bundled:small", "resolution": 36})

    monkeypatch.setattr(gym, "make_vec", make_small)
    result = CliRunner().invoke(app, ["warm-up"], catch_exceptions=False)
    assert result.exit_code == 0
    assert {"AutoExposure-v0", "AutoExposureVideo-v0", "ExposureBracket-v0"} == set(made)


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
