"""Captures in batches: the same frames as one by one, their statistics, and what is forgotten."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
import torch

from simulator import CameraSettings, NoiseLevelFunction, PreparedScene, get_camera
from simulator.capture import batch as batch_module
from simulator.capture.batch import CaptureBatch
from simulator.capture.sensor import Transitions, noise_balance, record
from simulator.noise.generator import Noise, noise_keys, single_normals

Z6 = get_camera("nikon_z6")
REFERENCE = CameraSettings(800, 1 / 64, 4)
STATES = [CameraSettings(iso, time, 4) for iso in (100, 6400) for time in (1 / 500, 1 / 8)]
STATES += [CameraSettings(400, 1 / 30, 8)]
LIGHTS = [torch.rand(4, 24, 20, generator=torch.Generator().manual_seed(i)) * 2.0 for i in range(4)]


def prepared(index: int) -> PreparedScene:
    """Two scenes at rest, two that move and are out of focus; every other one is noisy."""
    nlf = Z6.nlf(800) if index % 2 else NoiseLevelFunction.zero()
    moves = {"image_speed": 0.3, "defocus": 2.0} if index > 1 else {}
    return PreparedScene(LIGHTS[index], REFERENCE, Z6, nlf, **moves)  # type: ignore[arg-type]


def made(noise: Noise | None = "bank", *, cache_light: bool = True) -> CaptureBatch:
    return CaptureBatch(prepared, 4, STATES, Z6, noise=noise, cache_light=cache_light)


def photographed(
    batch: CaptureBatch, states: Any, gains: Any = (1.0, 1.0, 1.0, 1.0), **options: Any
) -> tuple[np.ndarray, Any]:
    """Frames of all four scenes, and their statistics."""
    indices, chosen = np.arange(4), np.array(states)
    batch.prepare(indices, chosen, np.array(gains))
    frames = np.empty((4, 4, 24, 20), np.float32)
    found = batch.record(indices, chosen, np.arange(4), indices + 5, signals=frames, **options)
    return frames, found


def alone(index: int, state: int, gain: float, key: int | None, noise: Noise = "bank") -> Any:
    scene, frame = prepared(index), torch.empty(1, 4, 24, 20)
    exposure = scene.exposure(STATES[state], gain=gain)
    transitions = Transitions.of([scene.blurred_light.blurred(exposure)], [exposure])
    keys = None if key is None else np.array([key], np.uint64)
    counts = record(transitions, Z6, keys=keys, noise=noise, signals=frame, count=True)
    return frame[0].numpy(), counts[0], exposure


@pytest.mark.parametrize("noise", ["bank", "exact", None])
@pytest.mark.parametrize("cache_light", [True, False])
def test_frames_are_those_of_each_scene_alone(noise: Noise | None, cache_light: bool) -> None:
    batch, rng = made(noise, cache_light=cache_light), np.random.default_rng(0)
    keys = noise_keys(np.arange(4), np.arange(4) + 5)
    for _ in range(8):
        states, gains = rng.integers(len(STATES), size=4), rng.choice([0.25, 1.0, 3.0], 4)
        frames, found = photographed(batch, states, gains)
        for i in range(4):
            key = None if noise is None else int(keys[i])
            wanted, counts, exposure = alone(i, states[i], gains[i], key, noise or "bank")
            np.testing.assert_array_equal(frames[i], wanted)
            assert found.clipped_low[i] == counts[0] / wanted.size
            assert found.clipped_high[i] == counts[1] / wanted.size
            modules = ["exposure", *["defocus"] * (exposure.defocus_px > 0)]
            modules += ["motion_blur"] * (exposure.motion_px > 0) + ["noise"] * bool(noise)
            assert found.modules[i] == "+".join(modules)
            if noise is not None:
                balance = noise_balance(prepared(i).blurred_light.blurred(exposure), exposure)
                wanted_excess = balance.relative_excess_variance
                assert found.excess_variance[i] == pytest.approx(wanted_excess, rel=0.05, abs=1e-9)
    assert found.excess_variance[[0, 2]].tolist() == [0.0, 0.0]


def test_clipped_samples_by_hand() -> None:
    batch = made(None)
    frames, found = photographed(batch, [0, 3, 1, 2])
    low = (frames <= 2.0**-10).reshape(4, -1).mean(axis=1)
    np.testing.assert_array_equal(found.clipped_low, low)
    np.testing.assert_array_equal(found.clipped_high, (frames == 1.0).reshape(4, -1).mean(axis=1))
    assert found.clipped_high[1] > 0.2


def test_normals_for_sensors_belong_to_the_frame() -> None:
    _, found = photographed(made(), [0, 0, 0, 0])
    wanted = single_normals(noise_keys(np.arange(4), np.arange(4) + 5), 3)
    np.testing.assert_array_equal(found.sensor_normals(3), wanted)


def test_rows_have_the_light_that_is_given() -> None:
    rows = np.ones((4, 24))
    rows[1:, 12:] = 0.5
    plain, _ = photographed(made(None), [0, 0, 4, 4])
    banded, _ = photographed(made(None), [0, 0, 4, 4], row_gain=rows)
    np.testing.assert_array_equal(banded[:, :, :12], plain[:, :, :12])
    np.testing.assert_array_equal(banded[0], plain[0])
    inside = plain[1:, :, 12:] < 0.9
    np.testing.assert_allclose(
        banded[1:, :, 12:][inside], 0.5 * plain[1:, :, 12:][inside], atol=1e-4
    )


def test_forgotten_scenes_are_asked_for_again_and_their_memory_is_used_again() -> None:
    calls: list[int] = []

    def counted(index: int) -> PreparedScene:
        calls.append(index)
        return prepared(index)

    batch = CaptureBatch(counted, 4, STATES, Z6, noise="bank", cache_light=True)
    first, _ = photographed(batch, [1, 1, 1, 1])
    again, _ = photographed(batch, [1, 1, 1, 1])
    photographed(batch, [4, 4, 4, 4])
    assert sorted(calls) == [0, 1, 2, 3]
    assert not batch._free
    batch.forget(np.array([2]))
    assert len(batch._free) == 3  # discs of two apertures, and a streak
    after, _ = photographed(batch, [1, 1, 1, 1])
    assert (calls[4:], len(batch._free)) == ([2], 1)
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(after, first)


@pytest.mark.parametrize("stage", ["blur_many", "_modules"])
def test_an_interrupted_batch_is_made_again(monkeypatch: pytest.MonkeyPatch, stage: str) -> None:
    """While the light is blurred, or while the plan of a later frame is made."""
    batch, calls = made(), []
    photographed(batch, [0, 0, 0, 0])
    original = getattr(batch_module, stage)

    def fail(*args: Any, **kwargs: Any) -> Any:
        calls.append(args)
        if stage == "_modules" and len(calls) < 4:
            return original(*args, **kwargs)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(batch_module, stage, fail)
        with pytest.raises(KeyboardInterrupt):
            photographed(batch, [1, 1, 1, 1])
    for states in ([1, 1, 1, 1], [0, 0, 0, 0]):
        expected, _ = photographed(made(), states)
        np.testing.assert_array_equal(photographed(batch, states)[0], expected)


def test_a_pickled_copy_works_everything_out_again() -> None:
    batch = made()
    first, _ = photographed(batch, [1, 2, 3, 4])
    copy = pickle.loads(pickle.dumps(batch))
    assert not copy._lights
    np.testing.assert_array_equal(photographed(copy, [1, 2, 3, 4])[0], first)
