from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from agents.evaluation import plan_run
from agents.evaluation import store as evaluation_store
from agents.evaluation.evaluation_plan import Condition, EvaluationPlan, digest, load_plan
from agents.evaluation.plan_episodes import PlanEpisodes, groups_in_turn, plan_scenes, start_state
from agents.evaluation.plan_jobs import ranked_policies, run_plan
from agents.evaluation.plan_run import PlanRun
from agents.evaluation.store import EvaluationStore, policy_content

ENVIRONMENT = {"scenes": "bundled:small", "split": "test", "resolution": 36}
STEP = Condition(lighting={"kind": "step", "stops": 4, "at": 3})
PLAN = EvaluationPlan(
    environment=ENVIRONMENT,
    max_scenes=5,
    conditions={
        "static": Condition(),
        "step+4": STEP,
        "step+4/late": STEP.model_copy(update={"delay": 1}),
    },
    frames=8,
    starts=("dark", "bright"),
    policies=("matrix:P", "random", "oracle"),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("parts")


@pytest.fixture(scope="module")
def results(folder):
    return run_plan(PLAN, folder)


# -- the plan -------------------------------------------------------------------------------------


def test_delays_multiply_the_conditions_that_have_none_of_their_own():
    plan = EvaluationPlan(
        conditions={"static": Condition(), "late": Condition(delay=3)}, delays=(0, 2)
    )
    found = {name: c.delay for name, c in plan.all_conditions.items()}
    assert found == {"static": 0, "late": 3, "static/delay2": 2}
    assert [name for name, c in plan.all_conditions.items() if c.at_rest] == ["static"]


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"starts": ["drak"]}, r"`starts` \(='drak'\).*did you mean 'dark'"),
        ({"starts": []}, "`starts` must have one entry or more"),
        ({"seeds": [0, 0]}, "must not have an entry twice"),
        ({"seeds": [-1]}, r"must be in \[0, 4294967295\]"),
        ({"frames": 0}, "greater than or equal to 1"),
        ({"conditions": {"hard": {}}}, "none of"),
        ({"conditions": {"a": {"lighting": "disco"}}}, "condition 'a': `lighting`"),
        ({"conditions": {"a": {"delay": 99}}}, "less than or equal to 16"),
        ({"environment": {"lighting": "sine"}}, "must not have `lighting`"),
        ({"environment": {"scorrer": "noise"}}, "did you mean `scorer`"),
        ({"polices": ["random"]}, "Extra inputs"),
    ],
)
def test_mistakes_in_a_plan_are_told(entries, message):
    with pytest.raises(ValueError, match=message):
        EvaluationPlan.model_validate(entries)


@pytest.mark.parametrize("name", ["quick", "standard", "ae_bench_v1"])
def test_presets_are_valid_and_name_known_policies(name):
    plan = load_plan(name)
    assert plan.policies
    if name == "standard":
        assert len(plan.all_conditions) == 28
        assert {c.delay for c in plan.all_conditions.values()} == {0, 2}
    if name == "ae_bench_v1":
        assert len(plan.all_conditions) == 8
        assert len(plan.scene_ids) >= 40


def test_canonical_text_does_not_depend_on_the_order_or_on_who_runs():
    first = PLAN.model_dump(mode="json")
    turned = dict(reversed([*first.items()]))
    again = EvaluationPlan.model_validate({**turned, "policies": ["spot:P"], "hash": "x"})
    assert again.canonical() == PLAN.canonical()
    assert PLAN.changed(frames=9).canonical() != PLAN.canonical()
    assert digest(1, "a") != digest("1a")


# -- episodes -------------------------------------------------------------------------------------


def test_starts_are_the_ends_of_the_grid_and_the_right_exposure():
    scenes, grid = plan_scenes(PLAN), PLAN.options().make_grid()
    scene = scenes[0]
    dark, middle, bright = (start_state(s, scene, grid) for s in ("dark", "middle", "bright"))
    # f/11 (11.3), 1/1000 s, ISO 100 and f/4, 1/2 s, ISO 6400.
    assert grid.ev100[dark] == pytest.approx(np.log2(128 * 1000), abs=0.01)
    assert grid.ev100[bright] == pytest.approx(np.log2(16 * 2 / 64), abs=0.01)
    assert abs(grid.ev100[middle] - scene.ev100) == np.abs(grid.ev100 - scene.ev100).min()
    assert start_state("random", scene, grid) is None


def test_episodes_of_another_start_share_everything_but_the_start():
    scenes, grid = plan_scenes(PLAN), PLAN.options().make_grid()
    episodes = PlanEpisodes.of(PLAN.changed(seeds=(0, 7)), scenes, grid)
    assert len(episodes) == 2 * 2 * 5
    assert episodes.seeds[:10] == episodes.seeds[10:]
    assert len(set(episodes.seeds)) == 10
    assert episodes.starts[:10] != episodes.starts[10:]
    assert episodes.num_tables == 10


def test_fewer_scenes_take_kinds_and_groups_in_turn():
    scenes = plan_scenes(PLAN.changed(max_scenes=None))
    kinds = {scene.kind for scene in scenes}
    few = groups_in_turn(scenes, len(kinds))
    assert {scene.kind for scene in few} == kinds
    assert [s.scene_id for s in few] == [s.scene_id for s in scenes if s in few]


def test_scene_ids_choose_and_a_wrong_one_is_told():
    ids = [scene.scene_id for scene in plan_scenes(PLAN)]
    plan = PLAN.changed(scene_ids=ids[::-1], max_scenes=None)
    assert [scene.scene_id for scene in plan_scenes(plan)] == ids[::-1]
    with pytest.raises(ValueError, match="did you mean"):
        plan_scenes(PLAN.changed(scene_ids=[ids[0] + "x"]))


# -- a run ----------------------------------------------------------------------------------------


def test_the_oracle_is_right_in_every_frame_but_the_one_of_the_step(results):
    static, step = results["static"], results["step+4"]
    assert np.abs(static.episode_metrics("oracle")["regret"]).max() < 1e-12
    q = np.take_along_axis(step.scores, step.tracks["oracle"].states[0][..., None], axis=-1)[..., 0]
    regret = step.scores.max(-1) - q  # (E, T)
    assert np.abs(np.delete(regret, 2, axis=1)).max() < 1e-6  # frame 3 has index 2
    assert regret[:, 2].mean() > 0.05
    assert (step.settling == 3).all()
    assert (static.settling == 0).all()
    assert (step.episode_metrics("oracle")["frames_to_converge"] == 1).all()
    late = results["step+4/late"].episode_metrics("oracle")["frames_to_converge"]
    assert set(np.unique(late)) <= {1, 2}
    assert late.max() == 2


def test_light_and_its_tables_are_those_of_the_environment(results):
    static, step = results["static"], results["step+4"]
    np.testing.assert_array_equal(static.scores[:, 0], step.scores[:, 0])
    np.testing.assert_array_equal(step.scores[:, 2], step.scores[:, 7])
    assert not np.array_equal(step.scores[:, 1], step.scores[:, 2])
    np.testing.assert_array_equal(
        results["step+4/late"].scores, step.scores
    )  # the delay is no matter of the light


def test_delay_keeps_the_start_state_for_as_many_frames(results):
    late = results["step+4/late"]
    for track in late.tracks.values():
        np.testing.assert_array_equal(track.states[0][:, 0], late.start_states)


def _check_same(first: Path, second: Path) -> None:
    """Raises unless the parts of two folders are the same, bit for bit, but for times."""
    names = [sorted(file.name for file in folder.glob("*.npz")) for folder in (first, second)]
    assert names[0] == names[1]
    for name in names[0]:
        with np.load(first / name) as one, np.load(second / name) as other:
            for array in set(one.files) - {"meta"}:
                np.testing.assert_array_equal(one[array], other[array], err_msg=f"{name} {array}")


def test_the_same_run_twice_is_the_same_bit_for_bit(results, folder, tmp_path):
    run_plan(PLAN, tmp_path)
    _check_same(tmp_path, folder)


def test_a_second_run_does_only_what_is_missing(results, folder, tmp_path, monkeypatch):
    for file in folder.glob("*.npz"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    victims = sorted(tmp_path.glob("policy-*.npz"))[:2]
    victims[0].unlink()
    victims[1].write_bytes(victims[1].read_bytes()[:100])  # killed while it wrote
    ran = []
    real = plan_run.run_batch

    def counted(name, *args, **kwargs):
        ran.append(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(plan_run, "run_batch", counted)
    again = run_plan(PLAN, tmp_path)
    assert len(ran) == 2  # one batch of episodes each
    _check_same(tmp_path, folder)
    run_plan(PLAN, tmp_path)
    assert len(ran) == 2
    np.testing.assert_array_equal(
        again["static"].tracks["matrix:P"].states, results["static"].tracks["matrix:P"].states
    )


def test_what_was_interrupted_keeps_what_was_finished(tmp_path, monkeypatch):
    real = plan_run.run_batch

    def stops(name, *args, **kwargs):
        if name == "random":
            raise KeyboardInterrupt
        return real(name, *args, **kwargs)

    monkeypatch.setattr(plan_run, "run_batch", stops)
    with pytest.raises(KeyboardInterrupt):
        run_plan(PLAN, tmp_path)
    assert len(list(tmp_path.glob("light-*.npz"))) == 2  # two lights, whatever the delay
    assert len(list(tmp_path.glob("policy-*.npz"))) == 3
    assert not list(tmp_path.glob(".*"))


@pytest.mark.slow
def test_two_processes_give_what_one_does(results, folder, tmp_path):
    run_plan(PLAN, tmp_path, workers=2)
    _check_same(tmp_path, folder)


def test_unknown_policies_are_refused_before_any_work(tmp_path):
    with pytest.raises(ValueError, match="did you mean 'random'"):
        run_plan(PLAN.changed(policies=("randm",)), tmp_path)
    assert not list(tmp_path.iterdir())
    with pytest.raises(ValueError, match="at least one policy"):
        run_plan(PLAN.changed(policies=()), tmp_path)
    with pytest.raises(ValueError, match=r"`other_scorers` .*did you mean 'mid_grey'"):
        run_plan(PLAN.changed(other_scorers=("mid_gray",)), tmp_path)
    assert not list(tmp_path.iterdir())


def test_privileged_policies_are_not_ranked(tmp_path):
    run = PlanRun(PLAN.changed(policies=("oracle", "random")), tmp_path)
    assert ranked_policies(run) == ["random"]


def test_modules_beside_a_file_count(tmp_path):
    file, helper, inner = tmp_path / "mine.py", tmp_path / "helper.py", tmp_path / "sub"
    inner.mkdir()
    for path in (file, helper, inner / "other.py", tmp_path / "data.csv"):
        path.write_text("x = 1\n")
    before = policy_content(f"{file}:Mine")
    for path in (inner / "other.py", tmp_path / "data.csv"):
        path.write_text("x = 2\n")
    assert policy_content(f"{file}:Mine") == before
    helper.write_text("x = 2\n")
    assert policy_content(f"{file}:Mine") != before


def test_another_file_of_a_policy_is_another_policy(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text("x = 1\n")
    before = policy_content(f"{file}:Mine")
    assert policy_content(f"{file}:Mine") == before
    file.write_text("x = 2\n")
    assert policy_content(f"{file}:Mine") != before
    assert policy_content("matrix:P") == ""
    assert policy_content("ppo") != policy_content("regression")


@pytest.mark.parametrize(
    "name",
    ["matrix:tuned?weights={0}/a", "ppo:{0}/a?device=cpu", "ppo:{0}/a", "recorded:{0}", "{0}/a:C"],
)
def test_what_a_name_points_to_counts(name, tmp_path):
    name = name.format(tmp_path)
    if name.endswith(":C"):
        name = name.replace("/a:C", "/a.py:C?width=3")
    files = [tmp_path / "a", tmp_path / "a.safetensors", tmp_path / "a.json", tmp_path / "a.py"]
    for file in files:
        file.write_text("before")
    before = policy_content(name)
    assert policy_content(name) == before
    for file in files:
        file.write_text("after!")
    assert policy_content(name) != before


def test_files_of_scorers_and_lightings_count(tmp_path):
    scorer, light = tmp_path / "mine.py", tmp_path / "light.csv"
    scorer.write_text(
        "class Half:\n    domain = 'raw'\n    def __call__(self, images, captures):\n"
        "        return images.new_full((len(images),), 0.5)\n"
    )
    light.write_text("0\n-1\n")

    def key(run):
        return run.light_key(Condition(lighting={"kind": "schedule", "file": str(light)}))

    plan = PLAN.changed(environment={**PLAN.environment, "scorer": {f"{scorer}:Half": 1.0}})
    run = PlanRun(plan, tmp_path / "parts", code="the same")
    first = key(run)
    assert key(run) == first
    light.write_text("0\n-2\n")
    second = key(run)
    scorer.write_text(scorer.read_text().replace("0.5", "0.6"))
    assert len({first, second, key(run)}) == 3


def test_parts_hold_no_pickles(tmp_path):
    store = EvaluationStore(tmp_path)
    store.save("a", {"x": np.arange(3)}, {"y": [1, None]})
    arrays, meta = store.load("a")
    assert (arrays["x"].tolist(), meta) == ([0, 1, 2], {"y": [1, None]})
    np.savez(tmp_path / "b.npz", meta=np.array(json.dumps({})), x=np.array([object()]))
    assert store.load("b") is None
    assert store.load("c") is None
    assert evaluation_store.part_key("k", 1) != evaluation_store.part_key("k", 2)
