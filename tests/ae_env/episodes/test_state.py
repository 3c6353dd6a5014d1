"""The columns of running episodes."""

from dataclasses import asdict

import numpy as np
import pytest

from ae_env.episodes.state import Episode, Episodes


def _episode(number: int) -> Episode:
    floats = {"speed": 0.1, "defocus": 0.2, "focus_drive": 0.3, "phase": 0.01}
    return Episode(
        scene=number,
        state=10 + number,
        noise_seed=2**62 - 1 - number,
        frame=100 * number,
        **{name: value * number for name, value in floats.items()},
    )


def _columns(*numbers: int) -> dict[str, np.ndarray]:
    episodes = [asdict(_episode(number)) for number in numbers]
    return {name: np.array([e[name] for e in episodes]) for name in episodes[0]}


def _filled(count: int, delay: int = 0) -> Episodes:
    episodes = Episodes(count, delay)
    episodes.begin(np.arange(count), _columns(*range(count)))
    return episodes


def test_only_the_given_episodes_advance_or_begin() -> None:
    episodes = _filled(4)
    assert [episodes[i] for i in range(4)] == [_episode(i) for i in range(4)]
    assert (type(episodes[1].scene), type(episodes[1].speed)) == (int, float)
    earlier = episodes[2]
    episodes.act(np.array([0, 2]), np.array([5, 6]))
    assert episodes.state.tolist() == [5, 11, 6, 13]
    assert episodes.frame.tolist() == [1, 100, 201, 300]
    assert episodes.previous.tolist() == [10, -1, 12, -1]
    assert earlier == _episode(2)  # a copy
    episodes.begin(np.array([2]), _columns(3))
    assert episodes[2] == _episode(3)
    assert episodes.previous[2] == -1
    assert episodes.state.tolist() == [5, 11, 13, 13]


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_actions_arrive_after_the_delay(delay: int) -> None:
    episodes = _filled(2, delay)
    actions = [[20 + i, 40 + i] for i in range(6)]
    seen = []
    for action in actions:
        episodes.act(np.arange(2), np.array(action))
        seen.append(episodes.state.tolist())
    assert seen == ([[10, 11]] * delay + actions)[:6]
