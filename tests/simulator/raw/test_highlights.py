"""Saturated highlights are white in the scene's white balance, and stay so in darker exposures."""

import numpy as np
import pytest
import torch

from ae_env.scenes import Scene
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera
from simulator.raw.highlights import neutral_highlights

BASE, CAMERA = CameraSettings(100, 1 / 64, 4), get_camera("nikon_z6")
#: Levels of white: dark, only green clips, blue too, all planes; and a red lamp.
WHITE = (0.5, 1.1, 1.6, 9.0)
BALANCE = (2.0, 1.0, 1.25)


def clipped(*pixels: tuple[float, ...], balance: tuple[float, float, float] = BALANCE) -> RawImage:
    """Light (R, G, B) of pixels, as a sensor clips it."""
    light = np.array(pixels, np.float32)[:, [0, 1, 1, 2]].T[:, None]
    return RawImage(np.minimum(light, 1.0), BASE, CAMERA, white_balance=balance)


@pytest.mark.parametrize(
    ("recorded", "expected"),
    [  # a white of level L is L / 2, L, L / 1.25 by BALANCE; L is known while red is not clipped
        *(((v / 2, v, v / 1.25), (v / 2, v, v / 1.25)) for v in WHITE[:3]),
        ((4.5, 9.0, 7.2), (2.0, 4.0, 3.2)),  # twice as bright as red's white
        ((3.0, 0.3, 0.2), (1.0, 0.3, 0.2)),  # a red lamp stays red
        ((0.9, 1.0, 0.2), (0.9, 1.025, 0.2)),  # levels 1.8 and 0.25 are known
    ],
)
def test_clipped_planes_become_as_bright_as_white(recorded, expected) -> None:
    raw = clipped(recorded)
    light = neutral_highlights(raw, raw.saturated)
    np.testing.assert_allclose(light[[0, 1, 3], 0, 0], expected, rtol=1e-6)
    assert light[2].equal(light[1])


def test_a_full_photosite_below_white_and_an_absurd_balance() -> None:
    raw = clipped((1.0, 1.0, 1.0))
    raw.data[1] = 0.94  # a smaller full well than the other green's
    assert neutral_highlights(raw, raw.saturated)[:, 0, 0].tolist() == pytest.approx([2, 4, 4, 3.2])
    raw = clipped((1.0, 1.0, 1.0), balance=(1e30, 1.0, 1.0))
    assert neutral_highlights(raw, raw.saturated).max() == 16.0


@pytest.mark.parametrize("ratio", [1 / 16, 1 / 4, 1.0, 4.0])
def test_captures_and_scenes_show_neutral_highlights(ratio: float) -> None:
    pixels = [(v / 2, v, v / 1.25) for v in WHITE]
    raw, settings = clipped(*pixels), CameraSettings(100, ratio / 64, 4)
    prepared = CameraSimulator(device="cpu").prepare(raw)
    level = torch.tensor([0.5, 1.1, 1.6, 4.0]) * ratio
    expected = level / torch.tensor([2, 1, 1, 1.25])[:, None]
    scene = Scene.from_raw(raw, scene_id="raw")
    for found in (prepared, scene.prepared):
        light = found.expected(settings)[:, 0]
        torch.testing.assert_close(light, expected)
        if ratio >= 1.0:  # as bright as the clipped raw would be
            assert (
                light.clamp(max=1.0) - (raw.data[:, 0] * ratio).clamp(max=1.0)
            ).abs().max() < 1e-6
        assert found.saturated is not None
        assert found.saturated.tolist() == [[False, True, True, True]]
    black = RawImage(torch.cat([raw.data, torch.zeros(4, 3, 4)], 1), BASE, CAMERA, None, BALANCE)
    small = Scene.from_raw(black, scene_id="raw").resized(1).light.flatten()
    torch.testing.assert_close(small, expected.mean(1) / ratio / 4)  # averaged after, not before
    dark = clipped(pixels[0])
    assert CameraSimulator(device="cpu").prepare(dark).light is dark.data
