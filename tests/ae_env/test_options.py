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


@pytest.mark.parametrize("value", ODD)
def test_odd_scenes(value: Any) -> None:
    with pytest.raises(ValueError, match="scenes"):
        AutoExposureEnv(scenes=value)


GRID = {"isos": [100, 200], "exposure_times": [0.01, 0.1], "f_numbers": [4, 8]}


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        *(
            ({"costs": {"flicker": value}}, r"`costs\['flicker'\]` \(=.*number in \[0, 1e\+06\]")
            for value in (None, True, "x", -1, NAN, INF, [], [1.0])
        ),
        ({"costs": {"flicer": 1.0}}, "did you mean 'flicker'"),
        ({"costs": {3: 1.0}}, r"`costs` \(=3\)"),
        *(
            ({"grid": {**GRID, "isos": value}}, r"`grid`: `isos` \(=.*ascending list of numbers")
            for value in (None, "100", [], [100, "x"], [True, 200], [NAN, 1], [2, 1], [1, 1], 100)
        ),
        ({"grid": {**GRID, "isos": [100, INF]}}, r"`grid`: `iso` \(=inf\)"),
        ({"grid": {**GRID, "f_numbers": [8, 45]}}, r"`grid\['f_numbers'\]` \(=45\) .*\[1, 32\]"),
        ({"grid": {**GRID, "exposure_times": [60]}}, r"`grid\['exposure_times'\]` \(=60\)"),
        ({"grid": {**GRID, "isos": [25]}}, r"`grid\['isos'\]` \(=25\) must be in \[50, 409600\]"),
        ({"grid": {**GRID, "f_numbers": [0.1]}}, r"`grid`: `f_number` \(=0.1\)"),
        ({"grid": {"iso": [100]}}, "`grid`.*did you mean 'isos'"),
        ({"grid": {"isos": [100]}}, "`grid`"),
        ({"camera": "nikon_z7"}, "did you mean 'nikon_z6'"),
        ({"lighting": "tunel"}, "did you mean 'tunnel'"),
        ({"simulator": "compcat"}, "did you mean 'compact'"),
        ({"depth": "unknwon"}, "did you mean 'unknown'"),
        ({"depth": 300.0, "resolution": 128}, r"`depth` \(=300.0\) must be .*256"),
        ({"depth": "unknown", "simulator": None}, r"`depth` \(='unknown'\) needs.*`simulator`"),
        ({"grid": "third_stops"}, "did you mean 'third_stop'"),
        *(
            ({"scorer": {"noise": value}}, "`scorer`.*must map names to weights")
            for value in (None, True, "x", 0, -1, NAN, INF, [1])
        ),
        ({"scorer": {"niose": 1.0}}, "did you mean 'noise'"),
        ({"scorer": {"noise": 1.0, "mine:noise": 1.0}}, "differ behind the colon"),
        ({"noise": "bnak"}, "one of True, False, 'bank', 'exact', 'sensor'; did you mean 'bank'"),
        ({"noise": ["bank"]}, r"`noise` \(=\['bank'\]\) must be one of True, False"),
        ({"autoreset_mode": "NEXT"}, "did you mean 'NEXT_STEP'"),
        ({"num_envs": 2**16 + 1}, r"`num_envs` \(=65537\) .*\[1, 65536\]"),
        ({"max_episode_steps": 0}, ">= 1, or None for never"),
        ({"delay": 17}, r"in \[0, 16\] frames"),
        ({"delay": {"shutter": 1}}, r"`delay` \(='shutter'\)"),
        ({"delay": {"iso": 17}}, r"`delay\['iso'\]` \(=17\)"),
        ({"delay": {"iso": True}}, r"`delay\['iso'\]`"),
        ({"resolution": 35}, r"\[36, 4096\]"),
        ({"motion": 1e3 + 1}, r"`motion` \(=1001.0\) .*or one of \['random', 'none'\]"),
    ],
)
def test_errors_name_value_and_rule(arguments: dict[str, Any], message: str) -> None:
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


def test_seeds_of_numpy_and_of_any_size() -> None:
    env, envs = AutoExposureEnv(**SMALL), AutoExposureVectorEnv(num_envs=3, **SMALL)
    for seed in (np.int64(11), 2**64, 2**100):
        single, _ = env.reset(seed=seed)
        many, _ = envs.reset(seed=[0, seed, None])
        np.testing.assert_array_equal(single["raw"], many["raw"][1])
    first, _ = envs.reset(seed=np.array([11, 12, 13]))
    second, _ = envs.reset(seed=11)
    np.testing.assert_array_equal(first["raw"], second["raw"])


def test_a_mapping_with_an_unknown_entry_is_refused() -> None:
    with pytest.raises(ValueError, match=r"unknown argument `scorrer`.*did you mean `scorer`"):
        EnvOptions.from_kwargs({"scorrer": "noise"})


def test_scenes_are_loaded_once_and_splits_are_disjoint() -> None:
    train = EnvOptions(**SMALL).load_scenes()
    EnvOptions(**SMALL).load_scenes().clear()  # a list of one's own
    again = EnvOptions(**SMALL).load_scenes()
    assert all(a is b for a, b in zip(again, train, strict=True))
    test, both = (EnvOptions(split=split, **SMALL).load_scenes() for split in ("test", "all"))
    assert {s.group for s in train}.isdisjoint({s.group for s in test})
    assert [s.scene_id for s in both] == [s.scene_id for s in train + test]


def test_cameras_of_one_name_have_scenes_of_their_own() -> None:
    other = replace(CAMERA, colour_matrix=CAMERA.colour_matrix[::-1])  # type: ignore[index]
    for one in (CAMERA, other):
        assert EnvOptions(camera=one, **SMALL).load_scenes()[0].camera == one


def test_a_black_scene_in_unknown_light_is_refused_by_name() -> None:
    black = make_scene(np.zeros((4, 40, 40)), None, scene_id="cap")
    with pytest.raises(ValueError, match=r"scene 'cap': `light` is 0 .* give `illuminance`"):
        EnvOptions(scenes=[black], resolution=36).load_scenes()
    lit = replace(black, illuminance=10.0)
    assert EnvOptions(scenes=[lit], resolution=36).load_scenes()[0].ev100 == 2.0
