import dataclasses

import numpy as np
import pytest

from agents.evaluation.plan import (
    Condition,
    EvaluationPlan,
    digest,
    load_plan,
    plan_episodes,
    plan_scenes,
    start_state,
)

PLAN = EvaluationPlan(
    environment={"scenes": "bundled:small", "split": "test", "resolution": 36}, max_scenes=5
)


def test_delays_multiply_the_conditions_that_have_none_of_their_own():
    plan = EvaluationPlan(
        conditions={"late": Condition(delay=3), "static": Condition()}, delays=(0, 2)
    )
    found = {name: c.delay for name, c in plan.all_conditions.items()}
    assert found == {"late": 3, "static": 0, "static/delay2": 2}
    assert [name for name, c in plan.all_conditions.items() if c.at_rest] == ["static"]
    assert plan.static_condition == "static"
    changing = EvaluationPlan(conditions={"sine": Condition(lighting="sine")})
    assert changing.static_condition == "sine"  # there is no other


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"starts": ["drak"]}, r"`starts` \(='drak'\)"),
        ({"starts": []}, "starts\n"),
        ({"seeds": [0, 0]}, "seeds\n"),
        ({"seeds": [-1]}, r"seeds\.0\n"),
        ({"conditions": {"hard": {}}}, "`conditions`"),
        ({"conditions": {"a": {"budget": 1.0}}}, "`conditions`"),
        ({"conditions": {"a": {"lighting": "disco"}}}, "condition 'a': `lighting`"),
        ({"conditions": {"a": {"delay": 99}}}, r"`delay` \(=99\)"),
        ({"conditions": {"a": {"delay": 3}}, "frames": 3}, r"`delay` \(=3\)"),
        ({"environment": {"lighting": "sine"}}, "`environment` .* `lighting`"),
        ({"budgets": [0.1, 0.1]}, "budgets\n"),
        ({"budgets": [0.0]}, r"budgets\.0\n"),
        ({"budgets": [0.1], "environment": {"budget": 1}}, "`environment` .* `budget`"),
        ({"budgets": [0.1], "frames": 3}, "`frames`"),
        ({"max_frames": 2}, "`max_frames`"),
    ],
)
def test_mistakes_in_a_plan_are_told(entries, message):
    with pytest.raises(ValueError, match=message):
        EvaluationPlan.model_validate(entries)


def test_presets_are_valid():
    plans = {name: load_plan(name) for name in ("quick", "standard", "bracket")}
    assert all(plan.policies for plan in plans.values())
    assert [len(plan.all_conditions) for plan in plans.values()] == [4, 24, 2]
    assert [plan.measure for plan in plans.values()] == ["score", "score", "quality"]


#: Of the plans as they were when they were published: their digests must not move.
PUBLISHED = {
    "ae_bench_v1": "20d6df59f3a8569bfb6c658410b2fafe0fd86f4aa307622ac77f1e88ffefc2cd",
    "ae_bench_v2_still": "856f17927b9315102f1ff743f630fa0c315a1e8d9ab029d2335aca23c8eba6e0",
    "ae_bench_v2_video": "ae0cafd1d4b00e651ecbc12fe7e7dbd565619a40c56a5007352e6141d279bbe3",
    "ae_bench_v2_bracket": "bb8f3ec9034d3ec41c93463cd8054ba24ef816ee16dd51b30df48f12518a8bed",
}


def test_digests_are_of_the_episodes_and_do_not_move():
    assert {name: digest(load_plan(name).protocol()) for name in PUBLISHED} == PUBLISHED
    turned = dict(reversed([*PLAN.model_dump(mode="json").items()]))
    again = EvaluationPlan.model_validate({**turned, "policies": ["spot:P"], "hash": "x"})
    assert digest(again.protocol()) == digest(PLAN.protocol())
    assert digest(PLAN.changed(frames=9).protocol()) != digest(PLAN.protocol())


@pytest.fixture(scope="module")
def scenes():
    return plan_scenes(PLAN)


def test_objects_of_a_callers_own_are_described_but_are_no_protocol(scenes):
    plan = PLAN.changed(environment={**PLAN.environment, "scenes": scenes[:1]})
    assert "dead_leaves" in str(plan.describe()["environment"]["scenes"])
    with pytest.raises(ValueError, match="JSON value"):
        plan.protocol()


def test_starts_are_the_ends_of_the_grid_and_the_right_exposure(scenes):
    scene, grid = scenes[0], PLAN.options().make_grid()
    dark, middle, bright = (start_state(s, scene, grid) for s in ("dark", "middle", "bright"))
    # f/11 (11.3), 1/1000 s, ISO 100 and f/4, 1/2 s, ISO 6400.
    assert grid.ev100[dark] == pytest.approx(np.log2(128 * 1000), abs=0.01)
    assert grid.ev100[bright] == pytest.approx(np.log2(16 * 2 / 64), abs=0.01)
    assert abs(grid.ev100[middle] - scene.ev100) == np.abs(grid.ev100 - scene.ev100).min()
    assert start_state("random", scene, grid) is None
    allowed = np.ones(64, bool)
    allowed[[dark, middle]] = False
    holes = dataclasses.replace(scene, allowed=allowed)
    assert grid.ev100[start_state("dark", holes, grid)] == pytest.approx(16, abs=0.1)
    assert start_state("middle", holes, grid) != middle


def test_episodes_of_another_start_share_everything_but_the_start(scenes):
    plan = PLAN.changed(seeds=(0, 7), starts=("dark", "bright"))
    episodes = plan_episodes(plan, scenes, PLAN.options().make_grid())
    assert episodes.seeds[:10] == episodes.seeds[10:]
    assert len(set(episodes.seeds)) == 10
    assert episodes.seeds[5] == 7 * 2**20
    assert episodes.starts[:10] != episodes.starts[10:]
    assert episodes.scene.tolist() == [0, 1, 2, 3, 4] * 4
