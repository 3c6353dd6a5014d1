"""Captures in batches: the same frames as one by one, their statistics, and what is forgotten."""

import pickle
from typing import Any

import numpy as np
import pytest
import torch

from simulator import CameraSettings, NoiseLevelFunction, PreparedScene, get_camera
from simulator.capture import batch as batch_module
from simulator.capture.batch import MODULES, CaptureBatch
from simulator.capture.blurred_light import MapApertureBlur
from simulator.capture.plan import noise_balance
from simulator.capture.prepared_scene import Layout
from simulator.capture.sensor import Noise, Transitions, noise_keys, record, single_normals
from simulator.optics.motion import Movement

Z6 = get_camera("nikon_z6")
REFERENCE = CameraSettings(800, 1 / 64, 4)
STATES = [CameraSettings(iso, time, 4) for iso in (100, 6400) for time in (1 / 500, 1 / 8)]
STATES += [CameraSettings(400, 1 / 30, 8), CameraSettings(200, 1 / 30, 2)]
LIGHTS = [torch.rand(4, 24, 20, generator=torch.Generator().manual_seed(i)) * 2.0 for i in range(7)]
SCENES = np.arange(7)
KEYS = noise_keys(SCENES, SCENES + 5)


def prepared(index: int) -> PreparedScene:
    """Two at rest, one that moves, one that is also out of focus, one whose aperture opens,
    two with a layout and a subject that moves; the first and third are free of noise."""
    light = LIGHTS[index]
    changes: dict[str, Any] = {"image_speed": 0.3} if index in (2, 3) else {}
    if index == 3:
        changes["defocus"] = 2.0
    if index == 4:
        found = torch.full((24, 20), 1.0)
        changes["aperture_blur"] = MapApertureBlur(light, found, 4.0)
    if index > 4:
        rows, columns = torch.arange(24)[:, None], torch.arange(20)
        subject = (abs(rows - 12) < 5) & (abs(columns - 8) < 5)
        changes["layout"] = Layout((columns >= 10).float().expand(24, 20).contiguous(), subject)
        changes["movement"] = Movement(0.6, 2.0, subject_speed=0.4, subject_direction=2.0)
        changes |= {"defocus": 3.0} | ({"image_speed": 0.2} if index == 5 else {})
    nlf = NoiseLevelFunction.zero() if index in (0, 2) else Z6.nlf(800)
    return PreparedScene(light, REFERENCE, Z6, nlf, **changes)


class Counted:
    """Scenes of a batch, and which of them were asked for."""

    def __init__(self) -> None:
        self.calls: list[int] = []

    def __call__(self, index: int) -> PreparedScene:
        self.calls.append(index)
        return prepared(index)


def made(
    noise: Noise | None = "bank", *, cache_light: bool = True, scenes: Any = prepared
) -> CaptureBatch:
    return CaptureBatch(scenes, 7, STATES, Z6, noise=noise, cache_light=cache_light)


def photographed(
    batch: CaptureBatch, states: Any, gains: Any = (1.0,) * 7, **options: Any
) -> tuple[np.ndarray, Any]:
    """Frames of all scenes, and their statistics."""
    chosen, frames = np.broadcast_to(states, 7), np.empty((7, 4, 24, 20), np.float32)
    batch.prepare(SCENES, chosen, np.array(gains))
    return frames, batch.record(SCENES, chosen, SCENES, SCENES + 5, signals=frames, **options)


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
    scenes, rng, seen = Counted(), np.random.default_rng(0), set()
    batch = made(noise, cache_light=cache_light, scenes=scenes)
    for _ in range(12):
        states, gains = rng.integers(len(STATES), size=7), rng.choice([1e-6, 0.25, 1.0, 3.0], 7)
        frames, found = photographed(batch, states, gains)
        for i in range(7):
            key = None if noise is None else int(KEYS[i])
            wanted, counts, exposure = alone(i, states[i], gains[i], key, noise or "bank")
            np.testing.assert_array_equal(frames[i], wanted)
            clipped = found.clipped_low[i], found.clipped_high[i]
            assert clipped == tuple(counts / wanted.size)
            assert clipped == ((wanted <= 2.0**-10).mean(), (wanted == 1.0).mean())
            modules = ["exposure", *["aperture"] * (exposure.opened_to is not None)]
            modules += ["defocus"] * (exposure.defocus_px > 0)
            modules += ["motion_blur"] * (exposure.motion_px > 0) + ["noise"] * bool(noise)
            assert MODULES[found.modules[i]] == "+".join(modules)
            seen |= set(modules)
            balance = noise_balance(prepared(i).blurred_light.blurred(exposure), exposure)
            excess = balance.relative_excess_variance if noise else 0.0
            assert found.excess_variance[i] == pytest.approx(excess, rel=0.05, abs=1e-9)
            seen |= {"excess"} if excess > 0.1 and exposure.opened_to else set()
    assert seen >= {"aperture", "defocus", "motion_blur"}
    assert sorted(scenes.calls) == list(range(7))
    assert noise is None or seen >= {"noise", "excess"}


def test_normals_for_sensors_belong_to_the_frame() -> None:
    _, found = photographed(made(), 0)
    np.testing.assert_array_equal(found.sensor_normals(3), single_normals(KEYS, 3))


def test_rows_have_the_light_that_is_given() -> None:
    rows = np.ones((7, 24))
    rows[1:, 12:] = 0.5
    plain, _ = photographed(made(None), 0)
    banded, _ = photographed(made(None), 0, row_gain=rows)
    np.testing.assert_array_equal(banded[:, :, :12], plain[:, :, :12])
    np.testing.assert_array_equal(banded[0], plain[0])
    np.testing.assert_allclose(banded[1:, :, 12:], 0.5 * plain[1:, :, 12:], atol=1e-4)


def test_forgotten_scenes_are_asked_for_again_and_their_memory_is_used_again() -> None:
    scenes = Counted()
    batch, calls = made(scenes=scenes), scenes.calls
    first, again, _ = photographed(batch, 1)[0], photographed(batch, 1)[0], photographed(batch, 4)
    assert sorted(calls) == list(range(7))
    # The pool is private: memory that is not used again would show as a slow environment only.
    assert not batch._pool.free
    batch.forget(np.array([3]))
    assert len(batch._pool.free) == 3  # discs of two apertures, and a streak
    after, _ = photographed(batch, 1)
    assert (calls[7:], len(batch._pool.free)) == ([3], 1)
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(after, first)


@pytest.mark.parametrize("stage", ["blur_many", "decide"])
def test_an_interrupted_batch_is_made_again(monkeypatch: pytest.MonkeyPatch, stage: str) -> None:
    """While the light is blurred, or while the plan of a later frame is made."""
    batch, calls = made(), []
    photographed(batch, 0)
    original = getattr(batch_module, stage)

    def fail(*args: Any, **kwargs: Any) -> Any:
        calls.append(args)
        if stage == "decide" and len(calls) < 4:
            return original(*args, **kwargs)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(batch_module, stage, fail)
        with pytest.raises(KeyboardInterrupt):
            photographed(batch, 1)
    for states in (1, 0):
        expected, _ = photographed(made(), states)
        np.testing.assert_array_equal(photographed(batch, states)[0], expected)


def test_a_pickled_copy_works_everything_out_again() -> None:
    batch = made()
    first, _ = photographed(batch, [1, 2, 3, 4, 5, 0, 1])
    copy = pickle.loads(pickle.dumps(batch))
    np.testing.assert_array_equal(photographed(copy, [1, 2, 3, 4, 5, 0, 1])[0], first)
