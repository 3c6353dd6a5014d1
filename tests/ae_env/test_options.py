"""The arguments of the environments, of `reset` and of `step`: odd values are refused by name."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ae_env import AutoExposureEnv, AutoExposureVectorEnv
from ae_env.options import EnvOptions
from tests.ae_env.environments import SMALL, assert_equal
from tests.ae_env.scorer_images import CAMERA, make_scene

NAN, INF, HUGE, ARRAY = math.nan, math.inf, 10**30, np.array([1, 2])
ODD = [None, True, "x", 1.5, -1, NAN, INF, [], {}, object(), HUGE, b"x", ["x"], [0.5], ARRAY]
#: Values of `ODD` that an argument takes.
TAKES: dict[str, list[Any]] = {
    **{key: [] for key in ("split", "scorer", "observation", "resolution", "crop")},
    **{key: [] for key in ("lighting", "delay", "camera", "reward", "source")},
    **{key: [True] for key in ("sensors", "noise", "with_oracle")},
    **{key: [1.5] for key in ("motion", "depth")},
    **{key: [None] for key in ("grid", "simulator", "render_mode")},
    "costs": [None, {}],
    "tolerance": [1.5, HUGE],
}
TAKES_VECTOR = {"num_envs": [], "max_episode_steps": [None, HUGE], "autoreset_mode": []}


def _cases(taken: bool) -> list[Any]:
    return [
        pytest.param(name, value, id=f"{name}-{i}")
        for name, known in {**TAKES, **TAKES_VECTOR}.items()
        for i, value in enumerate(ODD)
        if any(type(k) is type(value) and k == value for k in known) == taken
    ]


class Work(Exception):
    """Scenes were loaded."""


@pytest.fixture
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(self: EnvOptions) -> None:
        raise Work

    monkeypatch.setattr(EnvOptions, "scenes_on_demand", load)


def test_the_tables_have_every_argument() -> None:
    assert {"scenes", *TAKES} == {*EnvOptions.__dataclass_fields__, "render_mode"}


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize(("name", "value"), _cases(False))
def test_odd_values(name: str, value: Any) -> None:
    for make in (AutoExposureEnv, AutoExposureVectorEnv):
        if make is AutoExposureVectorEnv or name not in TAKES_VECTOR:
            with pytest.raises(ValueError, match=f"`{name}"):
                make(**{**SMALL, name: value})


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize(("name", "value"), _cases(True))
def test_values_that_are_fine(name: str, value: Any) -> None:
    with pytest.raises(Work):
        AutoExposureVectorEnv(**{**SMALL, name: value})


GRID = {"isos": [100, 200], "exposure_times": [0.01, 0.1], "f_numbers": [4, 8]}


BAD_AXES = [None, "100", [], [100, "x"], [True, 200], [NAN, 1], [2, 1], [1, 1], 100, [100, INF]]


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        *(
            ({"costs": {"flicker": value}}, r"`costs\['flicker'\]`")
            for value in (None, True, "x", -1, NAN, INF, [], [1.0])
        ),
        *(({"costs": {"flicer": 1.0}}, "did you mean 'flicker'"), ({"costs": {3: 1.0}}, "`costs`")),
        *(({"grid": {**GRID, "isos": value}}, "`grid.*iso") for value in BAD_AXES),
        *(({"grid": {**GRID, "f_numbers": [n]}}, "`grid.*f_number") for n in (0.1, 45)),
        *(({"grid": {**GRID, **a}}, "`grid") for a in ({"isos": [25]}, {"exposure_times": [60]})),
        *(({"grid": {"iso": [100]}}, "did you mean 'isos'"), ({"grid": {"isos": [100]}}, "`grid`")),
        *(
            ({name: wrong}, f"did you mean '{right}'")
            for name, wrong, right in (
                *(("camera", "nikon_z7", "nikon_z6"), ("grid", "third_stops", "third_stop")),
                *(("lighting", "tunel", "tunnel"), ("simulator", "compcat", "compact")),
                *(("depth", "unknwon", "unknown"), ("noise", "bnak", "bank")),
                *(("scorer", {"niose": 1.0}, "noise"), ("autoreset_mode", "NEXT", "NEXT_STEP")),
            )
        ),
        *(({"scorer": {"noise": v}}, "`scorer`") for v in (None, True, "x", 0, -1, NAN, INF, [1])),
        ({"scorer": {"noise": 1.0, "mine:noise": 1.0}}, "differ behind the colon"),
        ({"depth": 300.0, "resolution": 128}, "`depth`.*256"),
        ({"depth": "unknown", "simulator": None}, "`depth`.*`simulator`"),
        *(({"delay": {"iso": value}}, r"`delay\['iso'\]`") for value in (17, True)),
        *(({"delay": 17}, "`delay`"), ({"delay": {"shutter": 1}}, "`delay`")),
        *(({"resolution": 35}, "`resolution`"), ({"motion": 1e3 + 1}, "`motion`")),
        *(({"num_envs": 2**16 + 1}, "`num_envs`"), ({"noise": ["bank"]}, "`noise`")),
        ({"max_episode_steps": 0}, "`max_episode_steps`"),
    ],
)
def test_what_else_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        AutoExposureVectorEnv(**{**SMALL, **arguments})


BAD_SEEDS = [True, "x", 1.5, -1, NAN, {}, object(), b"x", np.array(3.0)]
BAD_OPTIONS = [True, "x", 1.5, [], object(), ["state"], {"stat": 1}, {1: 1}]
BAD_CHOICES = [True, 1.5, -1, NAN, {}, object(), HUGE, "x", b"x"]


def _refused_resets(for_many: bool) -> list[tuple[dict[str, Any], str]]:
    lists = [[0, 1], [0, 1, True], [0, 1, "x"], ARRAY, np.zeros(3)] if for_many else [[], [1, 2]]
    refused: list[tuple[dict[str, Any], str]] = [
        ({"seed": seed}, "`seed") for seed in [*BAD_SEEDS, *lists]
    ]
    refused += [({"options": options}, "`options`") for options in BAD_OPTIONS]
    for name in ("scene", "state", "frame"):
        match = rf"`options\['{name}'\]`"
        refused += [({"options": {name: v}}, match) for v in [*BAD_CHOICES, *lists]]
    masks = (True, [True] * 3, np.ones(2, bool), np.zeros(3, bool), np.ones(3)) if for_many else ()
    refused += [({"options": {"reset_mask": mask}}, "reset_mask") for mask in masks]
    return refused


BAD_ACTIONS = [None, True, "x", 1.5, 2.0, -1, 64, NAN, [], {}, object(), HUGE, 2**63, [[1], [2, 3]]]


@pytest.mark.parametrize("for_many", [False, True])
def test_refused_resets_and_steps_change_nothing(for_many: bool) -> None:
    """The twin is asked nothing odd; the episode and the one after it must be the same."""
    make, many = AutoExposureEnv, {}
    bad: list[Any] = [*BAD_ACTIONS, [1], np.zeros(1, int), np.True_]
    if for_many:
        make, many = AutoExposureVectorEnv, {"num_envs": 3}
        rows = [[0, 1, action] for action in BAD_ACTIONS if action is not True]  # numpy makes it 1
        bad = [*BAD_ACTIONS, *rows, [0, 1], [[0, 1, 2]], np.ones(3, bool)]
    env, twin = (make(**SMALL, **many) for _ in range(2))
    for one in (env, twin):
        one.reset(seed=7)
    for arguments, match in _refused_resets(for_many):
        with pytest.raises(ValueError, match=match):
            env.reset(**arguments)
    for action in bad:
        with pytest.raises(ValueError, match=r"`actions?`"):
            env.step(action)
    good = [5] * 3 if for_many else 5
    assert_equal(env.step(good), twin.step(good))
    assert_equal(env.reset(), twin.reset())
    for seed in (np.int64(11), 2**64, 2**100):
        first, second = ([0, s, 5] if for_many else s for s in (seed, int(seed)))
        assert_equal(env.reset(seed=first), twin.reset(seed=second))


def test_scenes_are_loaded_once_and_splits_are_disjoint() -> None:
    train = EnvOptions(**SMALL).load_scenes()
    EnvOptions(**SMALL).load_scenes().clear()  # a list of one's own
    again = EnvOptions(**SMALL).load_scenes()
    assert all(a is b for a, b in zip(again, train, strict=True))
    test, both = (EnvOptions(split=split, **SMALL).load_scenes() for split in ("test", "all"))
    assert {s.group for s in train}.isdisjoint({s.group for s in test})
    assert [s.scene_id for s in both] == [s.scene_id for s in train + test]


def test_cameras_of_one_name_have_scenes_of_their_own() -> None:
    other = replace(CAMERA, colour_matrix=CAMERA.colour_matrix[::-1])
    for one in (CAMERA, other):
        assert EnvOptions(camera=one, **SMALL).load_scenes()[0].camera == one
    with pytest.raises(ValueError, match=r"unknown argument `scorrer`.*did you mean `scorer`"):
        EnvOptions.from_kwargs({"scorrer": "noise"})


def test_a_black_scene_in_unknown_light_is_refused_by_name() -> None:
    black = make_scene(np.zeros((4, 40, 40)), None, scene_id="cap")
    with pytest.raises(ValueError, match=r"scene 'cap': `light` is 0 .* give `illuminance`"):
        EnvOptions(scenes=[black], resolution=36).load_scenes()
    lit = replace(black, illuminance=10.0)
    assert EnvOptions(scenes=[lit], resolution=36).load_scenes()[0].ev100 == 2.0
    for value in ODD:
        with pytest.raises(ValueError, match="scenes"):
            AutoExposureEnv(scenes=value)
