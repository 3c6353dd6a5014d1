"""Registration, specs, public names, presets of ``configs/env``, and classes from users' files."""

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
from ae_env.utils.user_files import find_config, load_from_file
from tests.ae_env.environments import ID, SMALL, assert_equal, make_env
from tests.ae_env.scorer_images import Own


def test_spec_round_trips_and_in_process_arguments_say_so() -> None:
    given = {"observation": "linear", "costs": {"switch": 0.1}, "lighting": {"kind": "ramp"}}
    env = make_env(scorer="ae_env.scorers.terms:Noise", **given)
    env.reset(seed=3)
    expected = env.step(11)
    for spec in (EnvSpec.from_json(env.spec.to_json()), pickle.loads(pickle.dumps(env.spec))):
        assert spec == env.spec
        again = gym.make(spec)
        again.reset(seed=3)
        assert_equal(again.step(11), expected)
    env = make_env(scorer=Own())
    env.reset(seed=0)
    assert 0.0 <= env.step(0)[1] <= 1.0
    with pytest.raises(ValueError, match=r"`scorer`.*this process only.*package\.module"):
        env.spec.to_json()
    env = make_env(scenes=make_env().unwrapped.scenes[:2])
    with pytest.raises(ValueError, match="`scenes`"):
        env.spec.to_json()


def test_public_names_resolve_and_import_is_light() -> None:
    assert set(dir(ae_env)) == {*ae_env.__all__, "__version__"}
    assert all(getattr(ae_env, name).__doc__ for name in ae_env.__all__)
    lightings = {kind.__name__ for kind in ae_env.lighting.KINDS.values()}
    assert {*ae_env.wrappers.__all__} | lightings <= {*ae_env.__all__}
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = ae_env.nonsense
    code = (
        "import sys, gymnasium, ae_env, ae_env.registration as r; r.register_envs(); dir(ae_env);"
        f"assert {ID!r} in gymnasium.registry; "
        "sys.exit(bool({'torch', 'numba', 'yaml', 'matplotlib'} & set(sys.modules)))"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


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


def test_packages_and_configs_are_installed_and_found_from_anywhere(tmp_path, monkeypatch) -> None:
    """`configs` is no folder of `ae_env`: it must not be forgotten."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel["packages"] == ["simulator", "ae_env", "agents"]
    assert wheel["force-include"] == {"configs": "ae_env/configs"}
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
    (tmp_path / "simulator").mkdir()
    (tmp_path / "simulator" / "__init__.py").touch()
    code = f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(ROOT)!r}]; import ae_env"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert found.returncode == 1
    message = found.stderr.strip().splitlines()[-1]
    assert message.startswith("ImportError: ae-env needs its own package 'simulator'")
    assert str(tmp_path / "simulator") in message
    assert str(ROOT / "simulator") in message


ARGUMENT = "`thing` (='mine.py:Mine')"


def test_files_are_run_once_until_they_change_and_imports_once(tmp_path, monkeypatch):
    file = tmp_path / "my file-1.py"
    file.write_text("class Mine:\n    number = 1\n")
    first = load_from_file(str(file), "Mine", ARGUMENT)
    monkeypatch.chdir(tmp_path)
    assert load_from_file("my file-1.py", "Mine", ARGUMENT) is first
    monkeypatch.setenv("HOME", str(tmp_path))
    assert load_from_file("~/my file-1.py", "Mine", ARGUMENT) is first
    file.write_text("class Mine:\n    number = 2\n")  # in the same second, of the same length
    assert load_from_file(str(file), "Mine", ARGUMENT).number == 2
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "on_the_path.py").write_text("class Base: ...")
    for name in ("one", "two"):
        (tmp_path / f"{name}.py").write_text("from on_the_path import Base as Mine")
    one, two = (load_from_file(str(tmp_path / f"{n}.py"), "Mine", ARGUMENT) for n in ("one", "two"))
    assert one is two
    monkeypatch.delitem(sys.modules, "on_the_path")


def test_helpers_beside_a_file_are_found_and_not_mixed_up(tmp_path: Path) -> None:
    before, path = set(sys.modules), list(sys.path)
    for number in (1, 2):
        folder = tmp_path / str(number)
        (folder / "own_package").mkdir(parents=True)
        (folder / "own_helper.py").write_text(f"number = {number}")
        (folder / "own_package" / "__init__.py").write_text("")
        part = folder / "own_package" / "part.py"
        part.write_text(f"from own_helper import number as n{number}")
        text = f"from own_package.part import n{number} as n\nclass Mine:\n    number = n\n"
        (folder / "mine.py").write_text(text)
    files = [str(tmp_path / str(number) / "mine.py") for number in (1, 2)]
    assert [load_from_file(f, "Mine", ARGUMENT).number for f in (*files, files[0])] == [1, 2, 1]
    (tmp_path / "1" / "own_helper.py").write_text("number = 333")
    with open(files[0], "a") as file:
        file.write("# changed")
    assert load_from_file(files[0], "Mine", ARGUMENT).number == 333
    assert sys.path == path
    for name in set(sys.modules) - before:
        del sys.modules[name]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import a_module_that_is_not_there", "ModuleNotFoundError: No module named 'a_module"),
        ("def (:", "SyntaxError"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("x = 1\n1 / 0", r"mine\.py cannot be loaded: ZeroDivisionError: .* \(line 2\)"),
        ("class Mime: ...", "no class 'Mine' there; found Mime; did you mean 'Mime'"),
        ("x = 3", "no class 'Mine' there; found no class at all"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "mine.py"
    file.write_text(text)
    before = set(sys.modules)
    with pytest.raises(ValueError, match=message) as caught:
        load_from_file(str(file), "Mine", ARGUMENT)
    assert str(caught.value).startswith(ARGUMENT)
    left = [name for name in set(sys.modules) - before if name.startswith("ae_env_user_")]
    assert len(left) == ("class" in message)  # what failed to load is not kept
    for path, name in ((tmp_path / "none.py", "Mine"), (file, "")):
        with pytest.raises(ValueError, match=r"`thing` \(='mine.py:Mine'\)"):
            load_from_file(str(path), name, ARGUMENT)
