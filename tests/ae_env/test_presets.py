"""The environments of ``configs/env``, and the package that holds them."""

import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import ae_env
from ae_env.options import EnvOptions
from ae_env.scenes.load import BUNDLED, BUNDLED_PARTS
from ae_env.utils.user_files import find_config
from tests.ae_env.environments import ID, SMALL

PRESETS = ae_env.list_presets()


def _load(name: str) -> dict[str, Any]:
    arguments = ae_env.load_preset(name)
    assert arguments["scenes"] in {*BUNDLED, *BUNDLED_PARTS}
    return {**arguments, **SMALL}


@pytest.mark.parametrize("name", PRESETS)
def test_presets_run_on_small_scenes(name: str) -> None:
    arguments = _load(name)
    steps = arguments["max_episode_steps"]
    env = gym.make(ID, **arguments)
    check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=0)
    ended = [env.step(env.action_space.sample())[3] for _ in range(steps)]
    assert ended == [False] * (steps - 1) + [True]
    envs = gym.make_vec(ID, num_envs=2, **arguments)
    envs.reset(seed=0)
    assert envs.step(np.array([1, 2]))[0]["raw"].shape == (2, 4, 36, 36)


@pytest.mark.parametrize(("name", "kind"), [("snow", "snow"), ("concert", "spot_light")])
def test_scenes_of_one_kind(name: str, kind: str) -> None:
    scenes = EnvOptions(scenes=ae_env.load_preset(name)["scenes"], split="test").load_scenes()
    assert len(scenes) >= 10
    assert {scene.kind for scene in scenes} == {kind}


def test_errors_and_files_of_ones_own(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"`env` .*did you mean 'tunnel'"):
        ae_env.load_preset("tunel")
    for name in (None, ["snow"], ""):
        with pytest.raises(ValueError, match=r"`env` \(=.*\) must be one of .*snow"):
            ae_env.load_preset(name)  # type: ignore[arg-type]
    own = tmp_path / "own.yaml"
    with pytest.raises(ValueError, match=r"`env` \(='.*own.yaml'\): there is no such file"):
        ae_env.load_preset(own)
    own.write_text("lighting: sine\nmax_episode_steps: 4\n")
    expected = {"lighting": "sine", "max_episode_steps": 4}
    assert ae_env.load_preset(own) == ae_env.load_preset(str(own)) == expected
    for text in ("- 1\n", "a: ["):
        own.write_text(text)
        with pytest.raises(ValueError, match=r"`env` \(='.*own\.yaml'\)"):
            ae_env.load_preset(str(own))


def test_every_package_and_the_presets_are_installed() -> None:
    """`configs` is no folder of `ae_env`: it must not be forgotten."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel["packages"] == ["simulator", "ae_env", "agents"]
    assert wheel["force-include"] == {"configs": "ae_env/configs"}


def test_a_config_of_the_package_is_found_from_anywhere(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    shipped = find_config(Path("configs/simulator/nano.yaml"))
    assert shipped.is_file()
    for own in ("configs/none.yaml", "configs/../configs/ppo.yaml", "ppo.yaml"):
        assert find_config(Path(own)) == Path(own)
    mine = Path("configs/ppo.yaml")
    mine.parent.mkdir()
    mine.touch()
    assert find_config(mine) == mine


ROOT = Path(__file__).resolve().parents[2]


def test_a_foreign_package_of_a_common_name_is_named(tmp_path: Path) -> None:
    """Else the first import from it fails with a puzzle."""
    (tmp_path / "simulator").mkdir()
    (tmp_path / "simulator" / "__init__.py").touch()
    code = f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(ROOT)!r}]; import ae_env"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert found.returncode == 1
    message = found.stderr.strip().splitlines()[-1]
    assert message.startswith("ImportError: ae-env needs its own package 'simulator'")
    assert str(tmp_path / "simulator") in message
    assert str(ROOT / "simulator") in message
