from __future__ import annotations

import importlib
import textwrap

import numpy as np
import pytest

import agents
from agents.policy import METERS, PROGRAMS, Policy, list_policies, make_policy, masked_argmax


def test_every_listed_name_makes_a_policy(context):
    names = list_policies()
    assert len(names) == len(set(names)) == 5 + len(METERS) * len(PROGRAMS)
    for name in set(names) - {"ppo", "regression"}:  # they come at one resolution: test_pretrained
        policy = make_policy(name, context)
        assert policy.name == name
        assert isinstance(policy, Policy)
        assert policy.privileged == (name == "oracle")
    assert make_policy("spot", context).name == "spot:P"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("matrx:P", r"did you mean 'matrix:P'"),
        ("matrix:Q", r"must be one of .*:tuned_blind"),
        ("oracle:P", r"must be one of"),
        ("", r"must be one of"),
        ("no_such_pkg.mod:Class", r"no module 'no_such_pkg'"),
        ("agents.simple:Rundom", r"no class 'Rundom' there; found Random, BestFixed, Oracle"),
        ("agents.metrics:flicker", r"must name a class, not a function"),
        ("agents.statistics:Interval", r"Interval is not a policy, it has no `reset` and `act`"),
        ("nowhere/mine.py:Mine", r"there is no file 'nowhere/mine.py'"),
        ("mine.py", r"must name a class of the file"),
    ],
)
def test_bad_names_say_what_is_wrong(context, name, message):
    with pytest.raises(ValueError, match=message):
        make_policy(name, context)


def test_unknown_option_is_refused_by_name(context):
    with pytest.raises(ValueError, match=r"does not take.*colour"):
        make_policy("random", context, colour="red")


MINE = """
    from dataclasses import dataclass
    import numpy as np
    from agents import Policy

    @dataclass
    class Helper:
        state: int

    class Constant(Policy):
        def __init__(self, context, state=7):
            super().__init__(context)
            self.helper = Helper(state)

        def act(self, observations, action_masks=None):
            return np.full(len(observations["raw"]), self.helper.state)

    class Forgetful(Policy):
        pass

    class Duck:
        def __init__(self, context): ...
        def reset(self, num_envs, seed=None): ...
"""


def test_own_file(context, photograph, tmp_path):
    file = tmp_path / "my file.py"
    file.write_text(textwrap.dedent(MINE))
    frame = photograph(np.ones((64, 64)), 8.0, [1, 2])
    policy = make_policy(f"{file}:Constant", context, state=9)
    policy.reset(2)
    assert policy.name == "Constant"
    assert policy.act(frame).tolist() == [9, 9]
    with pytest.raises(ValueError, match=r"no class 'Mine' there; found Helper, Constant"):
        make_policy(f"{file}:Mine", context)
    with pytest.raises(ValueError, match=r"Forgetful is not a policy, it has no `act`"):
        make_policy(f"{file}:Forgetful", context)
    with pytest.raises(ValueError, match=r"Duck is not a policy, it has no `act`"):
        make_policy(f"{file}:Duck", context)


def test_an_error_inside_the_users_file_is_not_hidden(context, tmp_path):
    file = tmp_path / "broken.py"
    file.write_text("import a_module_that_is_not_there\n")
    with pytest.raises(ValueError, match="a_module_that_is_not_there") as caught:
        make_policy(f"{file}:Mine", context)
    assert isinstance(caught.value.__cause__, ModuleNotFoundError)


def test_own_module(context):
    assert type(make_policy("agents.simple:Random", context)).__name__ == "Random"


def test_masked_argmax():
    utility = np.array([[3.0, 2.0, 2.0], [1.0, 5.0, 4.0]])
    masks = np.array([[False, True, True], [True, True, True]])
    assert masked_argmax(utility, masks).tolist() == [1, 1]
    assert masked_argmax(utility, None).dtype == np.int64


def test_public_names():
    assert agents.__all__ == sorted(agents.__all__)
    for name in agents.__all__:
        assert getattr(agents, name).__module__.startswith("agents.")
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        getattr(importlib.import_module("agents"), "nothing")  # noqa: B009
