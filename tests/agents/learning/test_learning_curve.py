from pathlib import Path

import pytest

from agents.learning.training import LearningCurve, load_curve


def test_rows_are_means_over_parts_of_the_training(tmp_path: Path) -> None:
    curve = LearningCurve(tmp_path / "agent.csv")
    for done in range(1, 1001):  # a row every 5 frames
        curve(done, 1000, {"reward": float(done)})
    found = load_curve(tmp_path / "agent.csv")
    assert found["frames"] == list(range(5, 1001, 5))
    assert found["reward"] == list(range(3, 1000, 5))


def test_a_training_that_resumes_repeats_no_frames(tmp_path: Path) -> None:
    path = tmp_path / "agent.csv"
    first = LearningCurve(path)
    for done in (200, 400, 600, 800):
        first(done, 1000, {"mse": 1.0})
    second = LearningCurve(path)  # its checkpoint was written after 500 frames
    for done in (600, 800, 1000):
        second(done, 1000, {"mse": 2.0})
    found = load_curve(path)
    assert found["frames"] == [200, 400, 600, 800, 1000]
    assert found["mse"] == [1, 1, 2, 2, 2]
    other = LearningCurve(path)  # another training of the same name
    other(1000, 1000, {"reward": 3.0})
    assert load_curve(path) == {"frames": [1000.0], "reward": [3.0]}


@pytest.mark.parametrize("text", ["name,price\ntable,12\n", "", "frames,mse\n1\n", "\x00"])
def test_a_file_of_something_else_is_not_replaced(text: str, tmp_path: Path) -> None:
    path = tmp_path / "agent.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"agent.csv is not a learning curve"):
        LearningCurve(path)
    assert path.read_text() == text
