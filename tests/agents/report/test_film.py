"""A filmed episode: the frames, settings and scores that the policies had."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

from agents.policy import PolicyContext
from agents.policy_names import make_policy
from agents.report.plots import CHART, GAP, PICTURE, TITLE, Recording, record, write_film
from tests.agents.conftest import TINY


@pytest.fixture
def envs():
    options = {**TINY, "render_mode": "rgb_array", "with_oracle": True, "max_episode_steps": 9}
    return gym.make_vec("ae_env/AutoExposureVideo-v0", num_envs=1, **options)


def test_it_shows_the_episode_of_each_policy(envs, tmp_path: Path) -> None:
    context = PolicyContext.from_envs(envs)
    found = record("oracle", make_policy("oracle", context), envs, 5, 3)
    envs.reset(seed=3)
    best = [envs.unwrapped.grid.ev100[envs.unwrapped.score_table(0).oracle]]
    assert found.best[:1] == best
    assert [len(v) for v in (found.pictures, found.ev100, found.best, found.scores)] == [6] * 4
    # Settings are in effect two frames after the next: frame 3 has what was best for frame 0.
    assert found.ev100[3] == found.best[0]
    done = []
    other = record("average:P", make_policy("average:P", context), envs, 5, 3)
    assert other.best == found.best  # the same episode
    path = tmp_path / "film.gif"
    write_film(path, [other, found], lambda n, total: done.append((n, total)))
    with Image.open(path) as image:
        assert (image.format, image.n_frames) == ("GIF", 6)
        assert image.size == (2 * PICTURE + GAP, TITLE + PICTURE + CHART)
    assert done == [(n, 6) for n in range(1, 7)]


def test_the_chart_draws_the_policy_up_to_now(tmp_path: Path) -> None:
    picture = np.full((16, 16, 3), 200, np.uint8)
    flat = Recording("flat", [picture] * 3, [5.0] * 3, [9.0] * 3, [0.5] * 3)
    with Image.open(write_film(tmp_path / "f.gif", [flat])) as image:
        red = []
        for frame in range(3):
            image.seek(frame)
            pixels = np.asarray(image.convert("RGB")).astype(int)
            reddish = (pixels[..., 0] - pixels[..., 1] > 80).any(axis=0)
            red.append(int(reddish.sum()))
    assert red[0] == 0
    assert 0.4 * PICTURE < red[1] < 0.6 * PICTURE < red[2]
