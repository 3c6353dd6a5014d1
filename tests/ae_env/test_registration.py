"""Registration with Gymnasium, specs, and the public names."""

import inspect
import pickle
import subprocess
import sys
from dataclasses import fields
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.envs.registration import EnvSpec

import ae_env
from ae_env.options import EnvOptions
from tests.ae_env.environments import ID, assert_equal, make_env
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
    for name in ae_env.__all__:
        assert getattr(ae_env, name).__doc__
    assert {*ae_env.wrappers.__all__} <= {*ae_env.__all__}
    lightings = {kind.__name__ for kind in ae_env.lighting.KINDS.values()}
    assert lightings <= {*ae_env.__all__}
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
