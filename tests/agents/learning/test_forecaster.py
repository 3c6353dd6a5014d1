"""The forecaster of light: it learns, and it remembers what it saw."""

import numpy as np
import pytest
import torch

from ae_env.lighting.moving import MOVES
from agents.learning.forecaster import (
    HORIZON,
    KINDS,
    ForecasterTraining,
    LearntTracker,
    LightForecaster,
    metered,
    sample,
    train_forecaster,
)
from agents.metering.reading import Reading


def _light(kind: str, count: int, seed: int = 9) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([10.0 + MOVES[kind](rng)[:70] for _ in range(count)])


def _forecasts(network: LightForecaster, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """EV100 expected three frames ahead, and the readings, both (B, 60)."""
    reading, exposed_at = metered(light, np.random.default_rng(1))
    tracker, found = LearntTracker(len(light), [network]), []
    for t in range(60):
        one = Reading(reading.ev100[:, t], reading.saturated[:, t], reading.black[:, t])
        tracker.update(one, exposed_at[:, t])
        found.append(tracker.ahead(3)[0])
    return np.stack(found, axis=1), reading.ev100[:, :60]


def test_it_learns_to_foresee_swinging_light():
    """After a short training nearer than the latest reading."""
    training = ForecasterTraining(
        steps=220, batch_size=24, width=48, traces=300, mixed=0.0, bent=0.0, learning_rate=2e-2
    )
    network = train_forecaster(training)
    light = _light("sines", 40)
    expected, reading = _forecasts(network, light)
    ahead = light[:, 23:63]
    forecast, latest = (np.abs(x[:, 20:60] - ahead).mean() for x in (expected, reading))
    assert forecast < 0.8 * latest


def test_samples_are_what_a_meter_reads_and_where_the_light_goes():
    training = ForecasterTraining(batch_size=50, mixed=0.5, bent=0.5)
    rng = np.random.default_rng(0)
    traces = np.stack([MOVES[kind](rng) for kind in KINDS for _ in range(4)])
    described, changes = sample(traces, training, rng)
    assert described.shape[:2] == changes.shape[:2]
    assert described.shape[2:] == (4,)
    assert changes.shape[2:] == (HORIZON + 1,)
    assert np.isfinite(described).all()
    clear = described[:, :, 2] == 0.0  # nothing clipped: the reading is the light itself
    assert np.abs(changes[:, :, 0][clear]).mean() < 0.1
    # The change to the next frame is the next frame's reading against this one's.
    both = clear[:, :-1] & clear[:, 1:]
    step = 2.0 * described[:, 1:, 0] - (changes[:, :-1, 1] - changes[:, 1:, 0])
    assert np.abs(step[both]).mean() < 0.05


def test_cameras_do_not_see_each_other_and_frames_add_up():
    torch.manual_seed(0)
    network = LightForecaster(16).eval()
    light = _light("ramps", 3)
    together, _ = _forecasts(network, light)
    reading, exposed_at = metered(light, np.random.default_rng(1))
    tracker = LearntTracker(1, [network])
    for t in range(60):
        one = Reading(reading.ev100[1:2, t], reading.saturated[1:2, t], reading.black[1:2, t])
        tracker.update(one, exposed_at[1:2, t])
        assert tracker.ahead(3)[0] == pytest.approx(together[1, t : t + 1], abs=1e-4)


def test_forecasts_of_several_trainings_are_averaged_and_less_sure_where_they_differ():
    torch.manual_seed(1)
    networks = [LightForecaster(8).eval() for _ in range(2)]
    reading = Reading(np.array([9.0]), np.zeros(1), np.zeros(1, bool))
    trackers = [LearntTracker(1, n) for n in ([networks[0]], [networks[1]], networks)]
    for tracker in trackers:
        tracker.update(reading, np.array([8.0]))
    (a, s), (b, t), (mean, spread) = (tracker.ahead(2) for tracker in trackers)
    assert mean == pytest.approx((a + b) / 2)
    assert spread**2 == pytest.approx((s**2 + t**2) / 2 + ((a - b) / 2) ** 2)
