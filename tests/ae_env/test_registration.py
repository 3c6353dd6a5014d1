"""Registration with Gymnasium, specs, and the public names."""

from __future__ import annotations

import inspect
import pickle
import subprocess
import sys
from dataclasses import fields
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec

import ae_env
from ae_env.options import EnvOptions

ID = "ae_env/AutoExposure-v0"
ARGUMENTS: dict[str, Any] = {"scenes": "bundled:small", "resolution": 36}


def _make(**arguments: Any) -> gym.Env:
    return gym.make(ID, **{**ARGUMENTS, **arguments})


class MeanSignal:
    domain = "raw"

    def __call__(self, images: torch.Tensor, captures: Any) -> torch.Tensor:
        return images.mean(dim=(1, 2, 3))


def _assert_equal(first: Any, second: Any) -> None:
    assert type(first) is type(second)
    if isinstance(first, dict):
        assert list(first) == list(second)
        for key in first:
            _assert_equal(first[key], second[key])
    elif isinstance(first, tuple | list):
        for a, b in zip(first, second, strict=True):
            _assert_equal(a, b)
    else:
        np.testing.assert_array_equal(first, second)


def test_spec_round_trips_through_json_and_pickle() -> None:
    env = _make(
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
        _assert_equal(again.step(11), expected)


def test_in_process_arguments_say_so_when_json_is_asked_for() -> None:
    env = _make(scorer=MeanSignal())
    env.reset(seed=0)
    assert 0.0 <= env.step(0)[1] <= 1.0
    with pytest.raises(ValueError, match=r"`scorer`.*this process only.*package\.module"):
        env.spec.to_json()
    env = gym.make(ID, scenes=_make().unwrapped.scenes[:2], resolution=36)
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


def test_module_prefix_makes_the_environment_known() -> None:
    assert gym.make(f"ae_env:{ID}", **ARGUMENTS).unwrapped.spec.id == ID
