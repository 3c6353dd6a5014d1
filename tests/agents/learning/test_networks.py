"""Networks and forecasts, and the environments in the shape of SB3 that they are trained on."""

import functools

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from ae_env.grid import ExposureGrid
from ae_env.lighting.moving import MOVES
from ae_env.observation import encode_sensors
from agents.learning import forecaster, networks
from agents.learning.forecaster import ForecasterTraining, LightForecaster, metered
from agents.learning.networks import LIGHT_NUMBERS, ExposureFeatures, MeterHistory, StateHead
from agents.learning.regression import ScoreRegressor, observation_tensors
from agents.learning.sb3_adapter import SB3VectorAdapter, TrainingFrames, WithHistory
from agents.metering.meters import make_meter
from agents.metering.reading import Reading
from agents.policy import PolicyContext
from tests.ae_env.environments import assert_equal, make_env


def test_an_odd_size_without_sensors() -> None:
    settings = gym.spaces.Box(-1, 1, (3,), np.float32)
    pixels, signal = (gym.spaces.Box(0, 255, (4, 37, 37), kind) for kind in (np.uint8, np.float32))
    space = gym.spaces.Dict({"raw": pixels, "settings": settings})
    network = ScoreRegressor(space, ExposureGrid.default())
    found = network(torch.rand(5, 4, 37, 37), torch.zeros(5, 3), None)
    assert [values.shape for values in found] == [(5, 64)] * 2
    with pytest.raises(ValueError, match=r"`observation_space\['raw'\]`"):
        ExposureFeatures(gym.spaces.Dict({"raw": signal, "settings": settings}))


@pytest.fixture
def exposed(make_tiny_envs):
    """The environment, its scene of dead leaves, and frames so many stops above its exposure."""

    def make(*stops: float):
        options = {"noise": False, "motion": "none", "depth": "far", "split": "test"}
        envs = make_tiny_envs(num_envs=len(stops), **options)
        base = envs.unwrapped
        scene = next(s for s in base.scenes if s.kind == "dead_leaves")
        above = scene.ev100 - np.array(base.grid.ev100)
        states = [int(np.argmin(np.abs(above - each))) for each in stops]
        frames, _ = envs.reset(seed=0, options={"scene": scene.scene_id, "state": states})
        return base, scene, frames

    return make


def test_absolute_luminance_does_not_depend_on_the_settings(exposed) -> None:
    base, scene, frames = exposed(-2.5, -1.5, -0.5, 0.5)
    features, seen = ExposureFeatures(base.single_observation_space), []
    features.cnn.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    with torch.no_grad():
        features(*observation_tensors(frames))
    raw, luminance = seen[0][:, :4], seen[0][:, 4]  # of the planes that enter the network
    # Only where the darkest frame has many codes and the brightest is not clipped.
    usable = (raw[:, 1:3].amin(dim=(0, 1)) > 12 / 255) & (raw[:, 1:3].amax(dim=(0, 1)) < 0.95)
    assert usable.float().mean() > 0.2
    spread = luminance[:, usable].std(dim=0, unbiased=False)
    brightness = raw[:, 1][:, usable].mean(dim=1)
    assert brightness.max() / brightness.min() > 2.0  # the frames themselves do differ
    assert spread.mean() * 8.0 < 0.15  # stops: quantisation and marked f-numbers remain
    # It is log2 x + EV100 as the decoded signal says: 18 % grey at 0.119 of white.
    light = torch.log2(scene.light[1:3].mean(dim=0)) - scene.reference.log2_exposure
    block = light.shape[-1] // luminance.shape[-1]
    expected = nn.functional.avg_pool2d(light[None], block)[0][usable]
    error = luminance[:, usable].mean(dim=0) * 8.0 + 3.0 - expected
    assert error.abs().median() < 0.15


def test_foretold_blur_is_that_of_the_scorer() -> None:
    grid = ExposureGrid.default()
    head = StateHead(grid, 6, True)
    speed, defocus = np.array([0.125, 2.0]), np.array([1.0, 0.5])
    sensors = torch.from_numpy(encode_sensors(speed, defocus, np.zeros((2, 2))))
    foretold = head._blur(sensors.float())
    times = np.array([s.exposure_time for s in grid])
    aperture_blurs = np.array([4.0 / s.effective_f_number for s in grid])
    # Blur of the `sharpness` term in 64 pixels: sqrt((v t)^2 + (4 D / N)^2); marked N here.
    blur = np.hypot(64.0 * speed[:, None] * times, defocus[:, None] * aperture_blurs)
    np.testing.assert_allclose(foretold[..., 0].numpy() * 4.0, np.log2(blur), atol=0.05)
    np.testing.assert_allclose(foretold[..., 1].numpy() * 2.0, np.log1p(blur**2), atol=0.05)


def test_foretold_shares_are_those_of_the_captures(exposed) -> None:
    # What each state would put above white, from one frame that is not clipped.
    base, scene, frames = exposed(-1.5)
    grid = base.grid
    ev100 = np.array(grid.ev100)
    assert frames["raw"].max() < 255
    features, head = ExposureFeatures(base.single_observation_space), StateHead(grid, 6, True)
    codes, settings, sensors = observation_tensors(frames)
    given: list[torch.Tensor] = []
    head.from_light.register_forward_pre_hook(lambda _, inputs: given.append(inputs[0]))
    with torch.no_grad():
        head(torch.zeros(1, 6), features.light(codes, settings), sensors)
    # Of all samples, and of the brightest of each pixel; the last two say what the features tell.
    shares = given[0][0, :, :-2].view(len(grid), 2, -1)
    exposures = 2.0 ** (-scene.reference.log2_exposure - ev100)  # of each state, to the scene's
    signal = scene.light[None] * torch.from_numpy(exposures).float()[:, None, None, None]
    for level, stops in enumerate((1.0, 0.0, -1.0, -2.0, -3.0)):
        above = signal >= 2.0**stops
        for row, counted in enumerate((above, above.any(dim=1, keepdim=True))):
            # The steps are half a stop wide, marked settings a few hundredths off.
            error = (shares[:, row, level] - counted.float().mean(dim=(1, 2, 3))).abs()
            assert error.max() < 0.15
            assert error.mean() < 0.03


def test_the_right_exposure_is_told_against_an_average_meter(exposed) -> None:
    base, _, frames = exposed(-1.5)
    features, head = ExposureFeatures(base.single_observation_space), StateHead(base.grid, 6, True)
    light = features.light(*observation_tensors(frames)[:2])
    nn.init.zeros_(head.right.weight)
    head.right.bias.data[:] = torch.tensor([0.5, -1.0])
    ev100, spread = head.right_ev100(torch.zeros(1, 6), light)
    metered = make_meter("average", base.camera)(frames).ev100
    np.testing.assert_allclose(ev100.detach(), metered + 0.5, atol=0.3)  # of all colours
    networks.exposure_loss(ev100, spread, ev100.detach() + 2.0).backward()
    # d/dm (m - r)^2 = 2 (m - r); d/ds (e^2 / 2 s^2 + ln s) = 1 / s - e^2 / s^3, and ds/dln s = s.
    wanted = [-4.0, 1.0 - 4.0 / spread.item() ** 2]
    np.testing.assert_allclose(head.right.bias.grad, wanted, rtol=1e-4)


def test_statistics_tell_the_light_as_pixels_do(make_tiny_envs) -> None:
    """The mean log2 luminance of the histogram of statistics is that of the pixels' codes."""
    shown = [make_tiny_envs(num_envs=6, observation=o) for o in ("uint8", "statistics")]
    pixels, statistics = (envs.reset(seed=5)[0] for envs in shown)
    found = []
    for envs, seen in zip(shown, (pixels, statistics), strict=True):
        features = ExposureFeatures(envs.single_observation_space, width=8)
        codes = torch.from_numpy(seen["raw"]).float() / 255.0
        histogram = torch.from_numpy(seen["histogram"]) if "histogram" in seen else None
        light = features.light(codes, torch.from_numpy(seen["settings"]), histogram)
        every = light[:, : LIGHT_NUMBERS // 2]
        assert torch.allclose(every.sum(dim=1), torch.ones(6), atol=1e-5)
        found.append((every * torch.arange(LIGHT_NUMBERS // 2)).sum(dim=1) / 2.0)  # [EV]
    # Two codes share a bin: near black they are a stop and more apart.
    assert float((found[0] - found[1]).abs().max()) < 0.35


def test_frames_are_shifted_by_up_to_an_eighth_and_mirrored() -> None:
    """Against all cuts of NumPy's padding."""
    rng = np.random.default_rng(0)
    raw = rng.integers(0, 256, (3, 4, 16, 16), dtype=np.uint8)
    padded = np.pad(raw, ((0, 0), (0, 0), (2, 2), (2, 2)), mode="edge")
    cuts = [padded[:, :, r : r + 16, c : c + 16] for r in range(5) for c in range(5)]
    known = {frames.tobytes() for cut in cuts for frames in (cut, cut[..., ::-1])}
    assert {networks.random_shift(raw, rng).tobytes() for _ in range(600)} == known


def _light(kind: str, count: int, seed: int = 9) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([10.0 + MOVES[kind](rng)[:70] for _ in range(count)])


def _forecasts(trained: list[LightForecaster], reading: Reading, exposed_at: np.ndarray, ahead=0):
    tracker, found = forecaster.LearntTracker(len(exposed_at), trained), []
    for t in range(60):
        one = Reading(reading.ev100[:, t], reading.saturated[:, t], reading.black[:, t])
        tracker.update(one, exposed_at[:, t])
        found.append(tracker.ahead(ahead))
    return np.stack(found, axis=-1)


@pytest.mark.slow
def test_it_learns_to_foresee_swinging_light():
    """After a short training nearer than the latest reading."""
    sizes = {"steps": 70, "batch_size": 10, "width": 32, "traces": 60, "mixed": 0.0, "bent": 0.0}
    training = ForecasterTraining(**sizes, learning_rate=5e-2)
    light = _light("sines", 40)
    reading, exposed_at = metered(light, np.random.default_rng(1))
    before = np.concatenate([reading.ev100[:, :1], reading.ev100[:, :-1]], axis=1)
    shown = torch.from_numpy(forecaster.network_inputs(reading, before, exposed_at))
    changes = forecaster.train_forecaster(training)(shown)[0].detach().numpy()
    off = light[:, 23:63] - reading.ev100[:, 20:60]
    assert np.abs(changes[:, 20:60, 3] - off).mean() < 0.85 * np.abs(off).mean()


@pytest.mark.parametrize("back", [False, True])
def test_light_that_repeats_itself_or_goes_back_is_foreseen(back):
    part = np.random.default_rng(3).normal(10.0, 2.0, (2, 35 if back else 11))
    light = np.concatenate([part, part[:, ::-1]] if back else [part] * 7, axis=1)[:, :70]
    reading = Reading(light, np.zeros_like(light), np.zeros(light.shape, bool))
    expected, _ = _forecasts([LightForecaster(8).eval()], reading, light, ahead=3)
    assert np.abs(expected[:, 45:60] - light[:, 48:63]).mean() < 0.1


def test_samples_are_what_a_meter_reads_and_where_the_light_goes():
    training = ForecasterTraining(batch_size=50, mixed=0.5, bent=0.5)
    rng = np.random.default_rng(0)
    traces = np.stack([MOVES[kind](rng) for kind in forecaster.KINDS for _ in range(4)])
    described, changes = forecaster.sample(traces, training, rng)
    assert (described.shape, changes.shape) == ((50, 128, 4), (50, 128, forecaster.HORIZON + 1))
    assert np.isfinite(described).all()
    clear = described[:, :, 2] == 0.0  # nothing clipped: the reading is the light itself
    assert np.abs(changes[:, :, 0][clear]).mean() < 0.1
    # The change to the next frame is the next frame's reading against this one's.
    both = clear[:, :-1] & clear[:, 1:]
    step = 2.0 * described[:, 1:, 0] - (changes[:, :-1, 1] - changes[:, 1:, 0])
    assert np.abs(step[both]).mean() < 0.05


def test_cameras_do_not_see_each_other_and_trainings_are_averaged():
    trained = [LightForecaster(8).eval() for _ in range(2)]
    reading, exposed_at = metered(_light("ramps", 3), np.random.default_rng(1))
    (a, s), (b, t) = (_forecasts([network], reading, exposed_at) for network in trained)
    second = Reading(reading.ev100[1:2], reading.saturated[1:2], reading.black[1:2])
    mean, spread = _forecasts(trained, second, exposed_at[1:2])
    np.testing.assert_allclose(mean, (a + b)[1:2] / 2, atol=1e-4)
    squared = (s**2 + t**2) / 2 + ((a - b) / 2) ** 2
    np.testing.assert_allclose(spread**2, squared[1:2], rtol=1e-3)


def assert_same_rollout(ours, theirs, steps):
    rng = np.random.default_rng(1)
    assert_equal(dict(ours.reset()), dict(theirs.reset()), "reset")
    assert_equal(ours.reset_infos[1], theirs.reset_infos[1], "reset info")
    for step in range(steps):
        actions = rng.integers(64, size=ours.num_envs)
        (mine, *answers), (other, *wanted) = ours.step(actions), theirs.step(actions)
        assert_equal(dict(mine), dict(other), f"{step}: observation")
        assert_equal(answers, wanted, f"{step}: reward, done, info")
        assert_equal(ours.reset_infos, theirs.reset_infos, f"{step}: reset info")
        for ended, info in zip(*wanted[1:], strict=True):
            assert ("terminal_observation" in info) == info["TimeLimit.truncated"] == ended


def test_rollouts_equal_those_of_single_environments(make_tiny_envs) -> None:
    ours = SB3VectorAdapter(make_tiny_envs(num_envs=3, max_episode_steps=3))
    theirs = DummyVecEnv([functools.partial(make_env, max_episode_steps=3)] * 3)
    for envs in (ours, theirs):
        envs.seed(11)
    assert_same_rollout(ours, theirs, 7)
    for envs in (ours, theirs):  # once seeded, a reset goes on with the same generators
        envs.set_options([{"scene": 0, "state": 5}, {"state": 6}, {}])
    assert_same_rollout(ours, theirs, 4)
    assert_same_rollout(ours, theirs, 1)  # the options were for one reset


class Forbids(gym.vector.VectorWrapper):
    def action_masks(self) -> np.ndarray:
        masks = self.env.unwrapped.action_masks()
        masks[:, 3] = False
        return masks


def test_attributes_methods_and_pictures_of_a_wrapped_batch(make_tiny_envs) -> None:
    inner = make_tiny_envs(num_envs=3, render_mode="rgb_array")
    envs = SB3VectorAdapter(gym.vector.VectorWrapper(Forbids(inner)))
    envs.seed(0)
    envs.reset()
    assert [id(grid) for grid in envs.get_attr("grid", [0, 2])] == [id(inner.unwrapped.grid)] * 2
    assert [bool(mask[3]) for mask in envs.env_method("action_masks")] == [False] * 3
    scores = inner.unwrapped.expected_scores()
    for indices in ([1], 1, np.array([1])):
        (row,) = envs.env_method("expected_scores", indices=indices)
        np.testing.assert_array_equal(row, scores[1])
    assert envs.env_is_wrapped(gym.Wrapper) == [False] * 3
    with pytest.raises(AttributeError, match="`grid`"):
        envs.set_attr("grid", None)
    shown = [(picture.dtype, picture.shape[2]) for picture in envs.get_images()]
    assert shown == [(np.uint8, 3)] * 3
    assert list(SB3VectorAdapter(make_tiny_envs(num_envs=2)).get_images()) == [None, None]
    wrong = {"autoreset_mode": "NEXT_STEP"}, {"autoreset_mode": "DISABLED"}, {"device": "cpu"}
    for arguments in wrong:
        with pytest.raises(ValueError, match=next(iter(arguments))):
            SB3VectorAdapter(make_tiny_envs(**arguments))


def test_training_frames_differ_in_the_raw_and_tell_the_right_exposure(make_tiny_envs) -> None:
    plain, inner = (SB3VectorAdapter(make_tiny_envs(num_envs=2)) for _ in range(2))
    shifted = TrainingFrames(inner, np.random.default_rng(0))
    for envs in (plain, shifted):
        envs.seed(3)
        envs.set_options([{"scene": 2}, {"scene": 0}])
    right = [[inner.envs.unwrapped.scenes[i].ev100] for i in (2, 0)]
    resets = plain.reset(), shifted.reset()
    one, other = (envs.step(np.full(2, 5)) for envs in (plain, shifted))
    np.testing.assert_array_equal(one[1], other[1])
    for seen, moved in (resets, (one[0], other[0])):
        np.testing.assert_allclose(moved["right_ev100"], right, rtol=1e-5)
        assert not np.array_equal(seen["raw"], moved["raw"])
        assert seen["raw"].mean() == pytest.approx(moved["raw"].mean(), rel=0.2)
        for name in ("settings", "sensors"):
            np.testing.assert_array_equal(seen[name], moved[name])


def test_it_holds_readings_exposures_and_what_was_asked_for(context, photograph):
    history, grey, grid = MeterHistory(context, 1, 3), np.ones((64, 64)), context.grid
    state = grid.nearest(9.0)
    frame = photograph(grey, 9.0, state)
    first = history.observe(frame).reshape(3, networks.NUMBERS)
    # Before the first frame there was the same.
    row = [0.0, (9.0 - grid.ev100[state]) / 4.0, 0.0, *frame["settings"][0]]
    np.testing.assert_allclose(first, [row] * 3, atol=0.02)
    history.record_action(np.array([40]))
    second = history.observe(photograph(grey, 8.0, state)).reshape(3, networks.NUMBERS)
    np.testing.assert_allclose(second[0, 3:], photograph(grey, 8.0, 40)["settings"][0])
    np.testing.assert_allclose(second[:, 0], [0.0, 0.5, 0.5], atol=0.02)  # one stop brighter before
    history.forget(np.array([True]))
    assert history.observe(photograph(grey, 5.0, state))[0, 0] == 0.0


def test_wrapped_episodes_end_with_their_own_history(make_tiny_envs):
    envs = make_tiny_envs(num_envs=3, max_episode_steps=2)
    context = PolicyContext.from_envs(envs)
    seen = WithHistory(SB3VectorAdapter(envs), context, 4)
    assert seen.observation_space == networks.with_history(envs.single_observation_space, 4)
    seen.seed(3)
    observations = seen.reset()
    alone = MeterHistory(context, 3, 4)
    np.testing.assert_array_equal(observations["history"], alone.observe(observations))
    for step, action in enumerate((5, 30, 41)):
        alone.record_action(np.full(3, action))
        observations, _, dones, infos = seen.step(np.full(3, action))
        assert dones.all() == (step == 1)
        if dones.all():
            ends = [info["terminal_observation"] for info in infos]
            last = {key: np.stack([end[key] for end in ends]) for key in observations}
            np.testing.assert_array_equal(last.pop("history"), alone.observe(last))
            alone.forget(dones)
        np.testing.assert_array_equal(observations["history"], alone.observe(observations))
