"""Pictures: the rendered frame, and the layout of the contact sheet."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from matplotlib import colormaps
from PIL import Image

from ae_env import contact_sheet
from ae_env.grid import ExposureGrid
from ae_env.observation import decode_observation
from ae_env.rendering import _Sheet
from ae_env.scenes import Scene
from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import ScoreTables
from simulator import develop, get_camera
from tests.ae_env.environments import make_env
from tests.ae_env.scorer_images import make_scene

CAMERA = get_camera("nikon_z6")
SMALL = ExposureGrid((100, 1600), (1 / 500, 1 / 30), (4, 8))


def _env(**arguments: Any) -> gym.Env:
    return make_env(**{"resolution": 64, "render_mode": "rgb_array", **arguments})


def _scene() -> Scene:
    return make_scene(np.random.default_rng(0).random((4, 64, 64)), 2560.0)


@pytest.mark.parametrize("kind", ["uint8", "linear", "dn"])
def test_frame_is_the_developed_capture_enlarged(kind: str) -> None:
    env = _env(observation=kind)
    observation, _ = env.reset(seed=1, options={"state": 21})
    picture = env.render()
    assert picture.dtype == np.uint8
    assert picture.shape == (256, 256, 3)
    inner = env.unwrapped
    scene = inner.scenes[inner.core.episode(0).scene]
    raw = observation["raw"]
    if kind == "uint8":
        raw = decode_observation(raw)
    elif kind == "dn":
        black = np.array(CAMERA.black_level)[:, None, None]
        raw = (raw - black) / (CAMERA.white_level - black)
    signal = torch.from_numpy(raw.astype(np.float32))[None]
    expected = develop(signal, scene.white_balance, CAMERA.colour_matrix)[0]
    expected = (expected.permute(1, 2, 0).numpy() * 255).round()
    above_the_caption = slice(2, 200, 4)
    difference = picture[above_the_caption, 2::4].astype(int) - expected[: 200 // 4]
    assert np.abs(difference).max() <= 1


def test_paths_are_drawn_in_their_own_colours() -> None:
    plain = np.asarray(contact_sheet(_scene(), grid=SMALL))
    drawn = contact_sheet(_scene(), grid=SMALL, path={"first": [0, 7], "second": [3, 3, 4]})
    colours = {(0xD5, 0x5E, 0x00), (0x56, 0xB4, 0xE9)}
    assert colours <= {tuple(c) for c in np.asarray(drawn).reshape(-1, 3).tolist()}
    assert not colours & {tuple(c) for c in plain.reshape(-1, 3).tolist()}
    for path in ([0, 64], [], {"mine": [1.5]}):
        with pytest.raises(ValueError, match=r"path|mine|states"):
            contact_sheet(_scene(), path=path)
    with pytest.raises(ValueError, match="at most 256"):
        contact_sheet(_scene(), grid=ExposureGrid.third_stop())


def test_caption_and_size_of_a_frame(caplog: pytest.LogCaptureFixture) -> None:
    env = _env(resolution=40)
    with pytest.raises(gym.error.ResetNeeded):
        env.unwrapped.render()
    env.reset(seed=1, options={"state": 0})
    first = env.render()
    assert first.shape == (280, 280, 3)  # seven times 40
    env.reset(seed=1, options={"state": 3})
    band = slice(-20, None)
    assert (first[band] != env.render()[band]).any()
    assert first[band].max() > 200  # the ink
    first[:] = 0  # the caller may write to it
    assert env.render().max() > 0
    without = make_env().unwrapped
    without.reset(seed=0)
    assert without.render() is None
    assert "render_mode='rgb_array'" in caplog.text


def test_border_shows_the_score_and_the_oracle_is_framed() -> None:
    scene = _scene()
    image = contact_sheet(scene, grid=SMALL, seed=3)
    sheet = np.asarray(image)
    assert image.mode == "RGB"
    np.testing.assert_array_equal(sheet, np.asarray(contact_sheet(scene, grid=SMALL, seed=3)))
    table = ScoreTables(SMALL, CAMERA, make_scorer("balanced")).table(scene)
    # Private: where each state's picture is.
    layout = _Sheet(SMALL, table, [Image.new("RGB", (64, 64))] * 8, {})
    corners = np.array([layout.corner(state) for state in range(8)])
    apart = np.abs(corners[:, None] - corners[None]).max(-1) >= min(layout.thumb)
    assert (apart | np.eye(8, dtype=bool)).all()  # no picture covers another
    for state, (x, y) in enumerate(corners):
        assert (sheet[y - 1, x + 40].min() > 200) == (state == table.oracle)
        if state != table.oracle:
            expected = colormaps["viridis"](table.mean[state] / table.mean.max(), bytes=True)[:3]
            assert sheet[y + 2, x + 40].tolist() == [int(v) for v in expected]
