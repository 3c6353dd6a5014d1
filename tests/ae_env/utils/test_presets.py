"""The environments of ``configs/env``."""

from __future__ import annotations

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
from ae_env.scenes.loading import BUNDLED, BUNDLED_PARTS
from ae_env.scorers import make_scorer
from ae_env.utils.presets import find_preset

ID = "ae_env/AutoExposure-v0"
PRESETS = ae_env.list_presets()
#: Scores that rise with noise, as docs/scorers.md warns.
READ_NOISE = {"entropy", "shim", "zhang", "keypoints", "analytic_blur", "analytic_haze"}


def _load(name: str) -> dict[str, Any]:
    """A preset with few scenes, to be made quickly."""
    arguments = ae_env.load_preset(name)
    assert arguments["scenes"] in {*BUNDLED, *BUNDLED_PARTS}
    return {**arguments, "scenes": "bundled:small", "resolution": 36}


def test_all_are_there() -> None:
    wanted = {"static", "handheld", "tunnel", "concert", "office_led", "snow", "night"}
    assert wanted <= set(PRESETS)


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


@pytest.mark.parametrize("name", ["snow", "office_led"])
def test_presets_run_as_they_are(name: str) -> None:
    env = gym.make(ID, split="test", **ae_env.load_preset(name))
    observation, info = env.reset(seed=0)
    assert observation["raw"].shape == (4, 64, 64)
    ended, steps = False, 0
    while not ended:
        _, reward, _, ended, info = env.step(env.action_space.sample())
        assert 0.0 <= reward <= 1.0
        steps += 1
    assert steps == ae_env.load_preset(name)["max_episode_steps"]
    assert info["scene_id"]


def _reads_noise_unpaired(scorer: str | dict[str, float]) -> bool:
    """Whether a score that rises with noise stands without `noise`."""
    names = {scorer} if isinstance(scorer, str) else set(scorer)
    parts = set(names)
    for name in names - READ_NOISE:  # some of those need an extra
        parts |= set(make_scorer(name).parts)
    return bool(READ_NOISE & parts) and "noise" not in parts


@pytest.mark.parametrize("name", PRESETS)
def test_scores_that_read_noise_as_detail_are_paired_with_noise(name: str) -> None:
    assert not _reads_noise_unpaired(ae_env.load_preset(name)["scorer"])


def test_the_rule_of_pairing_tells_the_two_apart() -> None:
    for name in READ_NOISE:
        assert _reads_noise_unpaired(name)
        assert _reads_noise_unpaired({name: 0.5, "brightness": 0.5})
        assert not _reads_noise_unpaired({name: 0.5, "noise": 0.5})
        assert not _reads_noise_unpaired({name: 0.5, "balanced": 0.5})
    assert _reads_noise_unpaired("defects")  # it has parts that do
    assert not _reads_noise_unpaired("balanced")


def test_the_office_has_shutters_of_whole_periods() -> None:
    env = gym.make(ID, **_load("office_led")).unwrapped
    assert set(env.grid.exposure_times) >= {1 / 50, 1 / 60, 1 / 100, 1 / 120}
    env.reset(seed=0)
    banding = env.score_table().parts["banding"]
    times = np.array([state.exposure_time for state in env.grid.states])
    whole = np.isin(times, [1 / 100, 1 / 50, 1 / 25])
    assert (banding[whole] == 1.0).all()
    assert banding[~whole].max() < 0.99


@pytest.mark.parametrize(("name", "kind"), [("snow", "snow"), ("concert", "spot_light")])
def test_scenes_of_one_kind(name: str, kind: str) -> None:
    options = EnvOptions(scenes=ae_env.load_preset(name)["scenes"], split="test", resolution=36)
    scenes = options.load_scenes()
    assert len(scenes) >= 10
    assert {scene.kind for scene in scenes} == {kind}
    small = {
        s.scene_id: s
        for s in EnvOptions(scenes="bundled:small", split="test", resolution=36).load_scenes()
    }
    same = [s for s in scenes if s.scene_id in small]
    assert len(same) == 2
    for scene in same:
        np.testing.assert_array_equal(scene.light, small[scene.scene_id].light)


def test_unknown_kinds_are_refused_with_the_nearest() -> None:
    for spec, message in (("bundled:snwo", "did you mean 'bundled:snow'"), ("bundled:sea", "hard")):
        with pytest.raises(ValueError, match=message):
            EnvOptions(scenes=spec).load_scenes()


def test_errors_and_files_of_ones_own(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"`preset` .*did you mean 'tunnel'"):
        ae_env.load_preset("tunel")
    for name in (None, 3, ["snow"], b"snow", ""):
        with pytest.raises(ValueError, match=r"`preset` \(=.*\) must be one of .*'snow'"):
            ae_env.load_preset(name)  # type: ignore[arg-type]
    own = tmp_path / "own.yaml"
    own.write_text("lighting: sine\nmax_episode_steps: 4\n")
    assert ae_env.load_preset(own) == ae_env.load_preset(str(own))
    assert ae_env.load_preset(str(own)) == {"lighting": "sine", "max_episode_steps": 4}
    own.write_text("- 1\n")
    with pytest.raises(ValueError, match="must map arguments"):
        ae_env.load_preset(str(own))
    own.write_text("a: [")
    with pytest.raises(ValueError, match="not YAML"):
        ae_env.load_preset(str(own))
    assert find_preset("snow").read_text().startswith("#")


def test_importing_loads_nothing_heavy() -> None:
    code = (
        "import sys, ae_env; assert 'load_preset' in dir(ae_env); "
        "sys.exit(bool({'torch', 'numba', 'yaml'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_package_and_the_presets_are_installed() -> None:
    """`packages` is a list, as `configs` is no folder of `ae_env`: nothing may be forgotten."""
    root = Path(__file__).resolve().parents[3]
    project = tomllib.loads((root / "pyproject.toml").read_text())
    setuptools = project["tool"]["setuptools"]
    found = {
        ".".join(file.parent.relative_to(root).parts)
        for package in ("simulator", "ae_env", "agents")
        for file in (root / package).rglob("__init__.py")
    }
    assert set(setuptools["packages"]) == found | {"ae_env.configs"}
    assert setuptools["package-dir"] == {"ae_env.configs": "configs"}
    assert setuptools["package-data"]["ae_env.configs"] == ["**/*.yaml"]
