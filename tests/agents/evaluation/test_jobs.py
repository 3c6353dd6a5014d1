import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from agents.evaluation import engine
from agents.evaluation.jobs import policy_content, run_plan
from agents.evaluation.plan import Condition, EvaluationPlan

STEP = Condition(lighting={"kind": "step", "stops": 4, "at": 3})
PLAN = EvaluationPlan(
    environment={"scenes": "bundled:small", "split": "test", "resolution": 36},
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


def test_light_and_delay_are_those_of_the_conditions(results):
    static, step, late = results.values()
    np.testing.assert_array_equal(static.scores[:, 0], step.scores[:, 0])
    np.testing.assert_array_equal(step.scores[:, 2], step.scores[:, 7])
    assert not np.array_equal(step.scores[:, 1], step.scores[:, 2])
    np.testing.assert_array_equal(late.scores, step.scores)  # the light is not delayed
    for track in late.tracks.values():
        np.testing.assert_array_equal(track.states[0][:, 0], late.start_states)


def _check_same(first: Path, second: Path) -> None:
    names = [
        sorted(str(file.relative_to(folder)) for file in folder.rglob("*.safetensors"))
        for folder in (first, second)
    ]
    assert names[0] == names[1]
    for name in names[0]:
        one, other = load_file(first / name), load_file(second / name)
        for array in one:
            np.testing.assert_array_equal(one[array], other[array], err_msg=f"{name} {array}")


def test_a_second_run_does_only_what_is_missing(results, folder, tmp_path, monkeypatch, caplog):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    victims = sorted(tmp_path.glob("policy/*"))[:2]
    victims[0].unlink()
    damaged = bytearray(victims[1].read_bytes())
    damaged[-9] ^= 255
    victims[1].write_bytes(damaged)
    ran = []
    real = engine.run_batch

    def counted(*args, **kwargs):
        if args[4] == PLAN.frames:  # not the timing of one camera
            ran.append(args)
        return real(*args, **kwargs)

    monkeypatch.setattr(engine, "run_batch", counted)
    again = run_plan(PLAN, tmp_path)
    assert len(ran) == 2  # one batch of episodes each
    assert str(victims[1]) in caplog.text
    _check_same(tmp_path, folder)
    run_plan(PLAN, tmp_path)
    assert len(ran) == 2
    states = [one["static"].tracks["matrix:P"].states for one in (again, results)]
    np.testing.assert_array_equal(*states)


def test_what_was_interrupted_keeps_what_was_finished(tmp_path, monkeypatch):
    real = engine.run_batch

    def stops(name, *args, **kwargs):
        if name == "random":
            raise KeyboardInterrupt
        return real(name, *args, **kwargs)

    monkeypatch.setattr(engine, "run_batch", stops)
    with pytest.raises(KeyboardInterrupt):
        run_plan(PLAN, tmp_path)
    assert len(list(tmp_path.glob("light/*"))) == 2  # two lights, whatever the delay
    assert list(tmp_path.glob("policy/*"))
    assert not list(tmp_path.rglob(".*"))


@pytest.mark.usefixtures("quick_spawn")
def test_two_processes_give_what_one_does(results, folder, tmp_path):
    run_plan(PLAN, tmp_path, workers=2)
    _check_same(tmp_path, folder)


def test_mistakes_are_told_before_any_work(tmp_path):
    for entries, name in (
        ({"policies": ("randm",)}, "`policy`"),
        ({"policies": ()}, "`policies`"),
        ({"other_scorers": ("mid_gray",)}, "`other_scorers`"),
    ):
        with pytest.raises(ValueError, match=name):
            run_plan(PLAN.changed(**entries), tmp_path)
    assert not list(tmp_path.iterdir())


def test_brackets_have_the_same_episodes_for_all_policies_and_resume(tmp_path, monkeypatch):
    """A schedule of one frame, run twice under two names, has the same results; seeds count."""
    plan = EvaluationPlan(
        environment=PLAN.environment,
        max_scenes=6,
        budgets=(0.05, 0.3),
        policies=("bracket:fixed?step=0", "bracket:fixed?step=0.0", "bracket:fixed?step=4"),
    )
    results = run_plan(plan, tmp_path)
    assert list(results) == ["0.05 s", "0.3 s"]
    for result in results.values():
        first, again, other = (result.episode_metrics(name) for name in plan.policies)
        for name in ("quality", "log_error", "unseen", "frames"):
            assert first[name].shape == (1, 6)
            np.testing.assert_array_equal(first[name], again[name])
        assert (first["frames"] == 1).all()
        assert (other["frames"] == 3).all()
    name = plan.policies[0]
    plan = plan.changed(policies=(name,))

    def quality(seeds: tuple[int, ...]) -> list[float]:
        found = run_plan(plan.changed(seeds=seeds), tmp_path)["0.3 s"]
        return found.episode_metrics(name)["quality"][0].tolist()

    both = quality((0, 1))
    assert both == quality((0,)) + quality((1,))
    monkeypatch.setattr(engine, "run_brackets", None)  # nothing is run again
    assert quality((0, 1)) == both


NAMES = ("matrix:tuned?weights={0}/a", "ppo:{0}/a?device=cpu", "recorded:{0}", "{0}/a.py:C")


@pytest.mark.parametrize("name", NAMES)
def test_what_a_name_points_to_counts(name, tmp_path):
    name = name.format(tmp_path)
    files = [tmp_path / f"a{suffix}" for suffix in ("", ".safetensors", ".json", ".py")]
    for file in files:
        file.write_text("before")
    before = policy_content(name)
    assert policy_content(name) == before != ""
    for file in files:
        file.write_text("after!")
    assert policy_content(name) != before


def test_modules_beside_a_file_count_and_nothing_else(tmp_path):
    file, helper, inner = tmp_path / "mine.py", tmp_path / "helper.py", tmp_path / "sub"
    inner.mkdir()
    others = (inner / "other.py", tmp_path / "data.csv")
    for path in (file, helper, *others):
        path.write_text("x = 1\n")
    before = policy_content(f"{file}:Mine")
    for path in others:
        path.write_text("x = 2\n")
    assert policy_content(f"{file}:Mine") == before
    helper.write_text("x = 2\n")
    assert policy_content(f"{file}:Mine") != before
    assert policy_content("ppo") != policy_content("regression") != policy_content("spot") == ""
