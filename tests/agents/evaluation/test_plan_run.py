import zipfile
from pathlib import Path

import numpy as np
import pytest

from agents.evaluation import engine
from agents.evaluation.jobs import run_plan
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
    names = [sorted(file.name for file in folder.glob("*.npz")) for folder in (first, second)]
    assert names[0] == names[1]
    for name in names[0]:
        with np.load(first / name) as one, np.load(second / name) as other:
            for array in set(one.files) - {"meta"}:
                np.testing.assert_array_equal(one[array], other[array], err_msg=f"{name} {array}")


def test_a_second_run_does_only_what_is_missing(results, folder, tmp_path, monkeypatch, caplog):
    for file in folder.glob("*.npz"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    victims = sorted(tmp_path.glob("policy-*.npz"))[:2]
    victims[0].unlink()
    damaged = bytearray(victims[1].read_bytes())
    with zipfile.ZipFile(victims[1]) as archive:  # in the numbers: other bytes change nothing
        second = archive.infolist()[1].header_offset
    damaged[second - 12] ^= 255
    victims[1].write_bytes(damaged)
    ran = []
    real = engine.run_batch

    def counted(*args, **kwargs):
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
    assert len(list(tmp_path.glob("light-*.npz"))) == 2  # two lights, whatever the delay
    assert list(tmp_path.glob("policy-*.npz"))
    assert not list(tmp_path.glob(".*"))


@pytest.mark.usefixtures("quick_spawn")
def test_two_processes_give_what_one_does(results, folder, tmp_path):
    run_plan(PLAN, tmp_path, workers=2)
    _check_same(tmp_path, folder)


def test_mistakes_are_told_before_any_work(tmp_path):
    for entries, message in (
        ({"policies": ("randm",)}, "did you mean 'random'"),
        ({"policies": ()}, "at least one policy"),
        ({"other_scorers": ("mid_gray",)}, r"`other_scorers` .*did you mean 'mid_grey'"),
    ):
        with pytest.raises(ValueError, match=message):
            run_plan(PLAN.changed(**entries), tmp_path)
    assert not list(tmp_path.iterdir())
