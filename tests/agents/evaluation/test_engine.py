"""`evaluate` and plans: every policy on the same episodes, whatever the batch; runs resume."""

import dataclasses
import itertools
from contextlib import closing

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from ae_env import UserCodeError
from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import ScoreTables
from agents import Policy, evaluate, fit_policies, make_policy
from agents.evaluation import engine, metrics
from agents.evaluation import evaluation_plan as plans
from agents.evaluation.evaluation_plan import EvaluationPlan, digest, load_plan, plan_scenes
from agents.evaluation.jobs import named_content, run_plan
from agents.policy import PolicyContext
from agents.rollouts import make_envs

OPTIONS = {"scenes": "bundled:small", "split": "test", "resolution": 36}


@pytest.fixture(scope="module")
def small() -> PolicyContext:
    with closing(make_envs(OPTIONS, num_envs=4, frames=2)) as envs:
        return PolicyContext.from_envs(envs)


@pytest.fixture(scope="module")
def few() -> dict:
    return {**OPTIONS, "scenes": plan_scenes(EvaluationPlan(environment=OPTIONS, max_scenes=8))}


def test_the_batch_size_changes_nothing_and_a_plan_is_the_same(small, few, tmp_path):
    policies = {n: make_policy(n, small) for n in ("random", "oracle", "matrix:P")}
    policies["random*3"] = [make_policy("random", small) for _ in range(3)]
    calls, sizes = [], {"episodes_per_scene": 2, "frames": 3}
    result = evaluate(policies, few, **sizes, batch=7, progress=lambda *a: calls.append(a))
    assert calls[-1][0] == calls[-1][1]
    again = evaluate({"matrix:P": policies["matrix:P"]}, few, **sizes, batch=32)
    entries = {"starts": ("random",), "seeds": (0, 1), "frames": 3, "policies": ("matrix:P",)}
    plan = EvaluationPlan(environment=OPTIONS, max_scenes=8, **entries)
    for other in (again, run_plan(plan, tmp_path)["static"]):
        for name in ("scene_ids", "start_states", "scores", "hard", "groups", "speed", "defocus"):
            np.testing.assert_array_equal(getattr(other, name), getattr(result, name))
        for name in ("states", "image_mean", "clipped_high"):
            tracks = (one.tracks["matrix:P"] for one in (other, result))
            np.testing.assert_array_equal(*(track.arrays[name] for track in tracks))


class Bad(Policy):
    answer: object = None

    def act(self, observations, action_masks=None):
        return self.answer


def test_wrong_actions_name_the_policy_and_arguments_are_checked(small, few):
    policy = Bad(small)
    for policy.answer in (
        *(np.zeros(3, int), np.zeros(8), np.full(8, 64), np.full(8, -1)),
        *([[0], [0, 1]], torch.zeros(8, requires_grad=True)),
    ):
        with pytest.raises(UserCodeError, match="policy 'mine'"):
            evaluate({"mine": policy}, few, frames=1)
    policies = {"random": make_policy("random", small)}
    for name, value in (("frames", 0), ("seed", -1), ("batch", 0), ("episodes_per_scene", 1.5)):
        with pytest.raises(ValueError, match=rf"`{name}` \(={value}\)"):
            evaluate(policies, OPTIONS, **{name: value})
    for given, options, name in ((policies, {"scens": 1}, "scenes"), ({}, OPTIONS, "policies")):
        with pytest.raises(ValueError, match=f"`{name}`"):
            evaluate(given, options)


@pytest.fixture(scope="module")
def fitted(small, few) -> dict:
    names = ("best_fixed", "average:tuned", "average:tuned_blind", "random", "average:P")
    policies = {n: make_policy(n, small) for n in names}
    fit_policies(policies, few, seed=1, batch=20)
    return policies


def test_forbidden_states_are_neither_chosen_nor_taken(small, few, fitted):
    """Scenes allow a third of the states each, another third every time."""
    masks = [np.arange(64) % 3 == i % 3 for i in range(6)]
    scenes = zip(few["scenes"], masks, strict=False)
    holes = {**OPTIONS, "scenes": [dataclasses.replace(s, allowed=mask) for s, mask in scenes]}
    names = ("random", "best_fixed", "oracle", "spot:P", "zhang:A", "average:S", "matrix:M")
    policies = {n: make_policy(n, small) for n in (*names, "rpi_agc")}
    policies["best_fixed"].mean_scores = np.linspace(0, 1, 64)
    policies["tuned"] = fitted["average:tuned"]
    result = evaluate(policies, holes, frames=4, episodes_per_scene=2, batch=5)
    allowed = result.allowed[:, 0]
    assert (allowed.sum(axis=1) <= 22).all()
    rows = np.arange(len(allowed))
    assert allowed[rows, result.start_states].all()
    for name, track in result.tracks.items():
        assert allowed[rows[:, None], track.states[0]].all(), name
    best_fixed = np.where(allowed, np.arange(64), -1).max(axis=1)
    assert (result.tracks["best_fixed"].states[0] == best_fixed[:, None]).all()
    # The oracle is the best of the allowed states, and random the mean over them.
    best = np.where(allowed, result.scores[:, 0], -1.0).max(axis=1)
    np.testing.assert_allclose(result.oracle, best, atol=1e-7)
    assert np.abs(result.episode_metrics("oracle")["regret"]).max() < 1e-6
    mean = (result.scores[:, 0] * allowed).sum(axis=1) / allowed.sum(axis=1)
    np.testing.assert_allclose(result.random, mean)
    assert (result.scores[:, 0].max(axis=1) > best + 1e-3).any()  # a forbidden one would be better
    stubborn = Bad(small)
    stubborn.answer = np.zeros(6, int)
    with pytest.raises(UserCodeError, match="policy 'mine'"):
        evaluate({"mine": stubborn}, holes, frames=1)


def test_delay_scores_the_frame_that_was_exposed(small, few):
    options = {**few, "delay": 1}
    result = evaluate({"oracle": make_policy("oracle", small)}, options, frames=3, batch=8)
    states = result.tracks["oracle"].states[0]
    np.testing.assert_array_equal(states[:, 1], result.oracle_states)
    found = result.episode_metrics("oracle")
    np.testing.assert_allclose(found["regret_delayed"], 0.0, atol=1e-12)
    assert found["regret"].mean() > 0.01


def test_fit_makes_tuned_and_fixed_policies_better_than_random(small, few, fitted):
    result = evaluate(fitted, few, frames=3, batch=20, seed=77)
    score = {n: float(result.episode_metrics(n)["score"].mean()) for n in fitted}
    assert score["average:tuned"] > score["average:P"] > score["random"]
    assert score["best_fixed"] > score["random"]
    assert fitted["average:tuned"].regression.features.shape[1] == 3
    assert fitted["average:tuned_blind"].regression.features.shape[1] == 1
    again = make_policy("average:tuned", small)
    fit_policies({"again": again}, few, seed=1, batch=7)
    first = fitted["average:tuned"].regression.scores
    np.testing.assert_array_equal(again.regression.scores, first)


def test_other_scorers_rate_chosen_states_over_frames_then_groups(tmp_path):
    given = {"max_scenes": 3, "frames": 3, "starts": ("dark",), "policies": ("matrix:P", "random")}
    scorers = {"other_scorers": ("brightness", "sharpness"), "other_scorer_scenes": 2}
    plan = EvaluationPlan(environment=OPTIONS, **given, **scorers)
    result = run_plan(plan, tmp_path)["static"]
    table = result.other_scores
    assert list(table) == ["brightness", "sharpness"]
    # By hand: two scenes of the three, each a group of its own.
    tables = ScoreTables(result.grid, plan.options().make_camera(), make_scorer("brightness"))
    for policy, track in result.tracks.items():
        means = [tables.table(result.scenes[j]).mean[track.states[0, j]].mean() for j in (0, 1)]
        assert table["brightness"][policy] == pytest.approx(np.mean(means), abs=1e-9)


PLAN = EvaluationPlan(environment=OPTIONS, max_scenes=5)


def test_delays_multiply_the_conditions_that_have_none_of_their_own():
    conditions = {"late": {"delay": 3}, "static": {}}
    plan = EvaluationPlan(conditions=conditions, delays=(0, 2))
    found = {name: c.delay for name, c in plan.all_conditions.items()}
    assert found == {"late": 3, "static": 0, "static/delay2": 2}
    assert [name for name, c in plan.all_conditions.items() if c.at_rest] == ["static"]
    assert plan.static_condition == "static"
    changing = EvaluationPlan(conditions={"sine": {"lighting": "sine"}})
    assert changing.static_condition == "sine"  # there is no other


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"starts": ["drak"]}, r"`starts` \(='drak'\)"),
        ({"seeds": [0, 0]}, "seeds\n"),
        ({"seeds": [0, 2**32]}, r"`seeds` \(=4294967296\)"),
        ({"conditions": {"hard": {}}}, "`conditions`"),
        ({"conditions": {"a": {"budget": 1.0}}}, "`conditions`"),
        ({"conditions": {"a": {"lighting": "disco"}}}, "condition 'a': `lighting`"),
        ({"conditions": {"a": {"delay": 99}}}, r"`delay` \(=99\)"),
        ({"conditions": {"a": {"delay": 3}}, "frames": 3}, r"`delay` \(=3\)"),
        ({"environment": {"lighting": "sine"}}, "`environment` .* `lighting`"),
        ({"environment": {"device": "cpu"}}, "`environment` .* `device`"),
        ({"budgets": [0.0]}, r"budgets\.0\n"),
        ({"budgets": [0.1], "environment": {"budget": 1}}, "`environment` .* `budget`"),
        ({"budgets": [0.1], "frames": 3}, "`frames`"),
        ({"max_frames": 2}, "`max_frames`"),
    ],
)
def test_mistakes_in_a_plan_are_told(entries, message):
    with pytest.raises(ValueError, match=message):
        EvaluationPlan.model_validate(entries)


#: Of the plans as they were when they were published: their digests must not move.
PUBLISHED = {
    "ae_bench_v3_still": "2fe41abd484f04f975a9d743d842c60e794ec2f21d209d9c4c26fc4d65548923",
    "ae_bench_v3_unknown": "faa414e6a8a705a258df548d4ac3eed3d3e18aff8bb5c10f68e0bbdd6e67490b",
    "ae_bench_v3_video": "48db155337db2424932a2b289157ea81693061af62ce9290ea0058cfd93816cb",
    "ae_bench_v3_bracket": "35022264130a3f009b343d4228385f6b486db83d889d026ec52f1a12aaba466d",
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


def test_starts_are_the_ends_of_the_grid_and_the_right_exposure(scenes):
    scene, grid = scenes[0], PLAN.options().make_grid()
    dark, middle, bright = (plans.start_state(s, scene, grid) for s in ("dark", "middle", "bright"))
    # f/11 (11.3), 1/1000 s, ISO 100 and f/4, 1/2 s, ISO 6400.
    assert grid.ev100[dark] == pytest.approx(np.log2(128 * 1000), abs=0.01)
    assert grid.ev100[bright] == pytest.approx(np.log2(16 * 2 / 64), abs=0.01)
    assert abs(grid.ev100[middle] - scene.ev100) == np.abs(grid.ev100 - scene.ev100).min()
    assert plans.start_state("random", scene, grid) is None
    allowed = np.ones(64, bool)
    allowed[[dark, middle]] = False
    holes = dataclasses.replace(scene, allowed=allowed)
    assert grid.ev100[plans.start_state("dark", holes, grid)] == pytest.approx(16, abs=0.1)
    assert plans.start_state("middle", holes, grid) != middle


def test_episodes_of_another_start_share_everything_but_the_start(scenes):
    given = PLAN.changed(environment={**PLAN.environment, "scenes": scenes[:1]})
    assert "dead_leaves" in str(given.describe()["environment"]["scenes"])
    with pytest.raises(ValueError, match="JSON value"):  # objects are described, but no protocol
        given.protocol()
    plan = PLAN.changed(seeds=(0, 7), starts=("dark", "bright"))
    episodes = plans.plan_episodes(plan, scenes, PLAN.options().make_grid())
    assert episodes.seeds[:10] == episodes.seeds[10:]
    assert len(set(episodes.seeds)) == 10
    assert episodes.seeds[5] == 7 * 2**20
    assert episodes.starts[:10] != episodes.starts[10:]
    assert episodes.scene.tolist() == [0, 1, 2, 3, 4] * 4


STEP = {"lighting": {"kind": "step", "stops": 4, "at": 3}}
CONDITIONS = {"static": {}, "step+4": STEP, "step+4/late": {**STEP, "delay": 1}}
JOBS = PLAN.changed(max_scenes=3, conditions=CONDITIONS, frames=8, starts=("dark", "bright"))
JOBS = JOBS.changed(policies=("matrix:P", "random", "oracle"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("parts")


@pytest.fixture(scope="module")
def results(folder):
    return run_plan(JOBS, folder)


def test_the_oracle_is_right_in_every_frame_but_the_one_of_the_step(results):
    static, step = results["static"], results["step+4"]
    assert np.abs(static.episode_metrics("oracle")["regret"]).max() < 1e-12
    q = np.take_along_axis(step.scores, step.tracks["oracle"].states[0][..., None], axis=-1)[..., 0]
    regret = step.scores.max(-1) - q  # (E, T)
    assert np.abs(np.delete(regret, 2, axis=1)).max() < 1e-6  # frame 3 has index 2
    assert regret[:, 2].mean() > 0.05
    assert (metrics.settling(step.scores) == 3).all()
    assert (metrics.settling(static.scores) == 0).all()
    assert (step.episode_metrics("oracle")["frames_to_converge"] == 1).all()
    late = results["step+4/late"]
    assert late.episode_metrics("oracle")["frames_to_converge"].max() == 2
    # Light and delay are those of the conditions.
    np.testing.assert_array_equal(static.scores[:, 0], step.scores[:, 0])
    np.testing.assert_array_equal(step.scores[:, 2], step.scores[:, 7])
    np.testing.assert_array_equal(late.scores, step.scores)  # the light is not delayed
    for track in late.tracks.values():
        np.testing.assert_array_equal(track.states[0][:, 0], late.start_states)


def _arrays(folder):
    """Arrays of the parts in a folder; the times that they took differ."""
    files = {file.relative_to(folder): load_file(file) for file in folder.rglob("*.safetensors")}
    return {f"{f} {name}": a.tobytes() for f, own in files.items() for name, a in own.items()}


def test_a_stopped_run_continues_with_what_it_lacks(results, folder, tmp_path, monkeypatch, caplog):
    real, ran = engine.run_batch, []

    def counted(name, *args, **kwargs):
        if name == "random" and not ran:
            raise KeyboardInterrupt
        ran.extend([name] if args[3] == JOBS.frames else [])  # not the timing of one camera
        return real(name, *args, **kwargs)

    monkeypatch.setattr(engine, "run_batch", counted)
    with pytest.raises(KeyboardInterrupt):
        run_plan(JOBS.changed(policies=("random", "matrix:P")), tmp_path)
    assert len(list(tmp_path.glob("light/*"))) == 2  # two lights, whatever the delay
    assert not list(tmp_path.rglob(".*"))
    ran.append("")
    run_plan(JOBS, tmp_path)
    assert _arrays(tmp_path) == _arrays(folder)
    victims = sorted(tmp_path.glob("policy/*"))[:2]
    victims[0].unlink()
    damaged = bytearray(victims[1].read_bytes())
    damaged[-9] ^= 255
    victims[1].write_bytes(damaged)
    ran.clear()
    ran.append("")
    for _ in range(2):
        run_plan(JOBS, tmp_path)
        assert len(ran) == 3  # one batch of episodes each, in the first of these runs
    assert str(victims[1]) in caplog.text
    assert _arrays(tmp_path) == _arrays(folder)


@pytest.mark.usefixtures("quick_spawn")
def test_two_processes_give_what_one_does(results, folder, tmp_path):
    run_plan(JOBS, tmp_path, workers=2)
    assert _arrays(tmp_path) == _arrays(folder)


def test_mistakes_are_told_before_any_work(tmp_path):
    for entries, name in (
        ({"policies": ("randm",)}, "`policy`"),
        ({"policies": ()}, "`policies`"),
        ({"other_scorers": ("mid_gray",)}, "`other_scorers`"),
    ):
        with pytest.raises(ValueError, match=name):
            run_plan(JOBS.changed(**entries), tmp_path)
    assert not list(tmp_path.iterdir())


def test_brackets_have_the_same_episodes_for_all_policies_and_resume(tmp_path, monkeypatch):
    """A schedule of one frame, run twice under two names, has the same results; seeds count."""
    names = tuple(f"bracket:fixed?step={step}" for step in ("0", "0.0", "4"))
    given = {"environment": PLAN.environment, "max_scenes": 6, "budgets": (0.05, 0.3)}
    plan = EvaluationPlan(**given, policies=names)
    results = run_plan(plan, tmp_path)
    assert list(results) == ["0.05 s", "0.3 s"]
    for result in results.values():
        first, again, other = (result.episode_metrics(name) for name in names)
        for name in ("quality", "log_error", "unseen", "frames"):
            assert first[name].shape == (1, 6)
            np.testing.assert_array_equal(first[name], again[name])
        assert (first["frames"] == 1).all()
        assert (other["frames"] == 3).all()

    def quality(seeds: tuple[int, ...]) -> list[float]:
        found = run_plan(plan.changed(seeds=seeds, policies=names[:1]), tmp_path)["0.3 s"]
        return found.episode_metrics(names[0])["quality"][0].tolist()

    both = quality((0, 1))
    assert both == quality((0,)) + quality((1,))
    monkeypatch.setattr(engine, "run_brackets", None)  # nothing is run again
    assert quality((0, 1)) == both


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("matrix:tuned?weights={0}/a", {"a", "a.safetensors", "a.json"}),
        ("ppo:{0}/a?device=cpu", {"a", "a.safetensors", "a.json"}),
        ("recorded:{0}", {"a", "a.safetensors", "a.json", "a.py", "other.py", "sub/b.py"}),
        ("{0}/a.py:C", {"a.py", "other.py"}),  # which it may import
        ("{0}", set()),  # a folder of this name is no policy's
    ],
)
def test_what_a_name_points_to_counts_and_nothing_else(name, counts, tmp_path):
    (tmp_path / "sub").mkdir()
    files = ("a", "a.safetensors", "a.json", "a.py", "other.py", "sub/b.py")
    for file in files:
        (tmp_path / file).write_text("before")
    contents = [named_content(name.format(tmp_path))]
    for file in files:
        (tmp_path / file).write_text("after!")
        contents.append(named_content(name.format(tmp_path)))
    changed = [after != before for before, after in itertools.pairwise(contents)]
    assert {file for file, own in zip(files, changed, strict=True) if own} == counts
    assert named_content("ppo") != named_content("regression") != named_content("spot") == ""
