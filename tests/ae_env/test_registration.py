"""Registration with Gymnasium, specs, the public names, and the environments of ``configs/env``."""

import inspect
import pickle
import subprocess
import sys
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import ae_env
from ae_env.options import EnvOptions
from ae_env.scenes.load import BUNDLED, BUNDLED_PARTS
from ae_env.utils.user_files import find_config
from tests.ae_env.environments import ID, SMALL, assert_equal, make_env
from tests.ae_env.scorer_images import Own


def test_spec_round_trips_through_json_and_pickle() -> None:
    env = make_env(
        observation="linear",
        costs={"switch": 0.1},
        scorer="ae_env.scorers.terms:Noise",
        lighting={"kind": "ramp"},
    )
    env.reset(seed=3)
    expected = env.step(11)
    for spec in (EnvSpec.from_json(env.spec.to_json()), pickle.loads(pickle.dumps(env.spec))):
        assert spec == env.spec
        again = gym.make(spec)
        again.reset(seed=3)
        assert_equal(again.step(11), expected)


def test_in_process_arguments_say_so_when_json_is_asked_for() -> None:
    env = make_env(scorer=Own())
    env.reset(seed=0)
    assert 0.0 <= env.step(0)[1] <= 1.0
    with pytest.raises(ValueError, match=r"`scorer`.*this process only.*package\.module"):
        env.spec.to_json()
    env = make_env(scenes=make_env().unwrapped.scenes[:2])
    with pytest.raises(ValueError, match="`scenes`"):
        env.spec.to_json()


def test_import_is_light_and_registers_once() -> None:
    code = (
        "import sys, gymnasium, ae_env, ae_env.registration as r; r.register_envs(); dir(ae_env);"
        f"assert {ID!r} in gymnasium.registry; "
        "sys.exit(bool({'torch', 'numba', 'yaml', 'matplotlib'} & set(sys.modules)))"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


def test_public_names_resolve_and_nothing_else_is_listed() -> None:
    assert set(dir(ae_env)) == {*ae_env.__all__, "__version__"}
    assert all(getattr(ae_env, name).__doc__ for name in ae_env.__all__)
    lightings = {kind.__name__ for kind in ae_env.lighting.KINDS.values()}
    assert {*ae_env.wrappers.__all__} | lightings <= {*ae_env.__all__}
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = ae_env.nonsense


@pytest.mark.parametrize("kind", [ae_env.AutoExposureEnv, ae_env.AutoExposureVectorEnv])
def test_constructors_list_their_arguments(kind: Any) -> None:
    """With the defaults of `EnvOptions`; an unknown one raises Python's own error."""
    parameters = inspect.signature(kind).parameters
    assert all(p.kind is not p.VAR_KEYWORD and p.annotation for p in parameters.values())
    options = EnvOptions()
    for field in fields(EnvOptions):
        default = parameters[field.name].default
        assert (default or {} if field.name == "costs" else default) == getattr(options, field.name)
    message = r"got an unexpected keyword argument 'scorrer'; did you mean 'scorer'\?"
    with pytest.raises(TypeError, match=message):
        kind(scorrer="noise")
    with pytest.raises(TypeError, match="got an unexpected keyword argument 'frameskip'"):
        gym.make(ID, frameskip=4)  # the wording that TorchRL looks for


PRESETS = ae_env.list_presets()
ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", PRESETS)
def test_presets_run_on_small_scenes(name: str) -> None:
    arguments = ae_env.load_preset(name)
    assert arguments["scenes"] in {*BUNDLED, *BUNDLED_PARTS}
    if (kind := {"snow": "snow", "concert": "spot_light"}.get(name)) is not None:
        scenes = EnvOptions(scenes=arguments["scenes"], split="test").load_scenes()
        assert len(scenes) >= 10
        assert {scene.kind for scene in scenes} == {kind}
    arguments |= SMALL
    steps = arguments["max_episode_steps"]
    env = gym.make(ID, **arguments)
    check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=0)
    ended = [env.step(env.action_space.sample())[3] for _ in range(steps)]
    assert ended == [False] * (steps - 1) + [True]


def test_errors_and_files_of_ones_own(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    for name in ("tunel", None, ["snow"], "", own):
        with pytest.raises(ValueError, match=r"`env` \(=.*(snow|did you mean|no such file)"):
            ae_env.load_preset(name)
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
