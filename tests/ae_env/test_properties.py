"""Properties of the environment that hold for any grids, scenes, lights, actions and seeds."""

from __future__ import annotations

import json
import math
from dataclasses import fields
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import ae_env  # noqa: F401  (registers the environment)
from ae_env.grid import ExposureGrid
from ae_env.lighting import KINDS, MAX_STOPS, make_lighting
from ae_env.observation import (
    PEDESTAL,
    SENSOR_RANGES,
    SETTINGS_RANGES,
    decode_observation,
    decode_sensors,
    decode_settings,
    encode_observation,
    encode_sensors,
    encode_settings,
)
from ae_env.scenes import Scene
from ae_env.scorers import list_scorers, make_scorer
from ae_env.scorers.score_table import TIE, ScoreTables
from ae_env.wrappers import ContinuousActions, ControlActions, RelativeActions
from simulator import CameraSettings, NoiseLevelFunction, get_camera
from tests.strategies import LIGHT, SEEDS, USUAL_SETTINGS, grids, lights, log_uniform

ID = "ae_env/AutoExposure-v0"
CAMERA = get_camera("nikon_z6")
CAMERA_SETTINGS = CameraSettings(100, 0.01, 4)


def _spec(grid: ExposureGrid) -> dict[str, list[float]]:
    """The grid as an environment's argument, by way of JSON."""
    lists = {n: getattr(grid, n) for n in ("isos", "exposure_times", "f_numbers")}
    return json.loads(json.dumps(lists))


def _env(grid: ExposureGrid, **arguments: Any) -> gym.Env:
    return gym.make(ID, scenes="bundled:small", resolution=36, grid=_spec(grid), **arguments)


# -- grids and actions ----------------------------------------------------------------------------


@given(grids(), SEEDS)
def test_grids_are_what_their_lists_say(grid: ExposureGrid, seed: int) -> None:
    assert ExposureGrid.from_spec(_spec(grid)) == grid
    states = np.arange(len(grid))
    controls = grid.controls(states)
    assert [grid.index(*row) for row in controls.tolist()] == states.tolist()
    for state, (i, t, n) in zip(grid, controls.tolist(), strict=True):
        wanted = (grid.isos[i], grid.exposure_times[t], grid.f_numbers[n])
        assert (state.iso, state.exposure_time, state.f_number) == wanted
    for state in np.random.default_rng(seed).choice(states, 3):
        nearest = grid.nearest(grid.ev100[state])
        assert nearest <= state
        assert grid.ev100[nearest] == pytest.approx(grid.ev100[state], abs=1e-9)


@given(grids(), st.integers(0, 3), SEEDS)
def test_every_allowed_action_is_reached(grid: ExposureGrid, delay: int, seed: int) -> None:
    env = _env(grid, delay=delay)
    env.reset(seed=seed)
    allowed = np.flatnonzero(env.unwrapped.action_masks())
    assert len(env.unwrapped.action_masks()) == env.action_space.n == len(grid)
    np.testing.assert_array_equal(allowed, np.arange(len(grid)))
    shown: list[int] = []
    for i, action in enumerate(np.random.default_rng(seed).permutation(allowed)):
        if i % 8 == 0:  # an episode ends after 8 frames
            shown = [env.reset()[1]["state"]] * delay
        shown.append(int(action))
        observation, *_, info = env.step(action)
        assert info["state"] == shown.pop(0)
        assert env.observation_space.contains(observation)
    for action in (-1, len(grid)):
        with pytest.raises(ValueError, match="action"):
            env.step(action)


@given(grids(), SEEDS)
def test_other_ways_to_act_reach_every_state(grid: ExposureGrid, seed: int) -> None:
    env = _env(grid)
    rng = np.random.default_rng(seed)
    controls, steps, apex = ControlActions(env), RelativeActions(env), ContinuousActions(env)
    values = np.array([[s.aperture_value, s.time_value, s.speed_value] for s in grid])
    low, span = values.min(axis=0), np.ptp(values, axis=0)
    for state in rng.permutation(len(grid))[:16].tolist():
        place = grid.controls(state)
        assert controls.action(place) == state
        unit = np.where(span > 0, 2 * (values[state] - low) / np.where(span > 0, span, 1) - 1, 0)
        found = values[apex.action(unit)]
        np.testing.assert_allclose(found, values[state], atol=1e-4)
        env.reset(seed=seed, options={"state": state})
        move = rng.integers(-1, 2, 3)
        moved = grid.controls(int(steps.action(move + 1)))
        np.testing.assert_array_equal(moved, np.clip(place + move, 0, np.array(grid.shape) - 1))
        assert steps.action(np.ones(3, int)) == state
    wanted = rng.uniform(-1, 1, 3)
    distance = np.square(low + (wanted + 1) / 2 * span - values).sum(axis=1)
    assert distance[apex.action(wanted)] <= distance.min() + 1e-8
    for wrapper in (controls, steps, apex):
        if wrapper is not apex:
            assert wrapper.action_masks().all()


# -- seeds and batches ----------------------------------------------------------------------------


def _rollout(seeds: list[int], actions: np.ndarray, **arguments: Any) -> list[Any]:
    """What each of the seeds' episodes shows: raws, rewards and states, of all of its frames."""
    envs = gym.make_vec(ID, num_envs=len(seeds), scenes="bundled:small", resolution=36, **arguments)
    observation, info = envs.reset(seed=seeds)
    frames = [(*observation.values(), info["state"], info["excess_noise"])]
    for action in actions:
        observation, reward, _, _, info = envs.step(action)
        frames.append((*observation.values(), reward, info["state"], info["clipped_high"]))
    return [[[column[i] for column in frame] for frame in frames] for i in range(len(seeds))]


@settings(max_examples=8)
@given(
    st.lists(SEEDS, min_size=2, max_size=5, unique=True),
    SEEDS,
    st.randoms(use_true_random=False),
    st.sampled_from(["uint8", "linear", "dn"]),
    st.sampled_from(["static", "sine"]),
    st.sampled_from([True, "exact", False]),
)
def test_episodes_do_not_depend_on_their_place(
    seeds: list[int], seed: int, random: Any, observation: str, lighting: str, noise: Any
) -> None:
    """A permutation of the seeds permutes the episodes, which are also those of one alone."""
    arguments = {"observation": observation, "lighting": lighting, "noise": noise}
    actions = np.random.default_rng(seed).integers(0, 64, (10, len(seeds)))  # beyond one episode
    order = random.sample(range(len(seeds)), len(seeds))
    first = _rollout(seeds, actions, **arguments)
    permuted = _rollout([seeds[i] for i in order], actions[:, order], **arguments)
    alone = _rollout(seeds[:1], actions[:, :1], **arguments)
    for one, other in [*zip([first[i] for i in order], permuted, strict=True), (first[0], *alone)]:
        for frame, same in zip(one, other, strict=True):
            for value, expected in zip(frame, same, strict=True):
                if np.asarray(value).dtype == np.float64:  # scores: sums in another order
                    np.testing.assert_allclose(value, expected, rtol=1e-8, atol=1e-12)
                else:
                    np.testing.assert_array_equal(value, expected)
    if noise:
        raws = [frames[0][0].tobytes() for frames in first]
        assert len(set(raws)) == len(seeds)


# -- observations ---------------------------------------------------------------------------------


@given(lights(LIGHT))
def test_observations_are_monotone_and_within_half_a_code(light: torch.Tensor) -> None:
    signal = light.flatten().sort().values
    codes = encode_observation(signal).numpy()
    assert bool((np.diff(codes.astype(int)) >= 0).all())

    def root(x: np.ndarray) -> np.ndarray:  # the scale on which codes are evenly spaced
        return 255 * np.sqrt((x.astype(np.float64) + PEDESTAL) / (1 + PEDESTAL))

    clipped = np.clip(signal.numpy(), -PEDESTAL, 1.0)
    assert np.abs(root(decode_observation(codes)) - root(clipped)).max() <= 0.5 + 1e-4
    every = np.arange(256, dtype=np.uint8)
    again = encode_observation(torch.from_numpy(decode_observation(every)))
    np.testing.assert_array_equal(again.numpy(), every)


@given(st.tuples(*(st.floats(low, high) for low, high in SETTINGS_RANGES)))
def test_settings_are_decoded_as_they_were(apex: tuple[float, float, float]) -> None:
    encoded = encode_settings(np.array(apex))
    assert encoded.dtype == np.float32
    assert np.abs(encoded).max() <= 1.0
    np.testing.assert_allclose(np.stack(decode_settings(encoded)), apex, atol=10 * 2.0**-24)


@given(st.floats(0.0, 1e300), log_uniform(1e-3, 1e3), st.floats(-10, 10), st.floats(-10, 10))
def test_sensors_are_decoded_as_they_read(
    speed: float, defocus: float, first: float, second: float
) -> None:
    noise = np.array([[first, second]])
    encoded = encode_sensors(np.array([speed]), np.array([defocus]), noise)
    assert np.abs(encoded).max() <= 1.0
    low, high = 2.0**SENSOR_RANGES.T
    for found, true, off, least, most in zip(
        decode_sensors(encoded[0]), (speed, defocus), (first, second), low, high, strict=True
    ):
        log2 = math.log2(true) if true else -math.inf
        reading = log2 + off * 0.15 / math.log(2)
        if reading <= math.log2(least):
            assert found in (0.0, least)
        else:
            assert found == pytest.approx(2.0 ** min(reading, math.log2(most)), rel=1e-5)


# -- light and scores -----------------------------------------------------------------------------


@st.composite
def lightings(draw: st.DrawFn) -> dict[str, Any]:
    """Any lighting in its range."""
    stops, frames = st.floats(-MAX_STOPS, MAX_STOPS), st.integers(-(2**31), 2**31)
    values = {"period": log_uniform(1e-3, 2**31), "stops": stops}
    values |= {"stops_per_frame": st.floats(0, MAX_STOPS), "edge": st.integers(0, 2**31)}
    values |= {"frequency": log_uniform(1e-3, 1e6), "frame_rate": log_uniform(1e-3, 1e6)}
    values |= {"depth": st.floats(0, 1), "duty": st.none() | st.floats(1e-6, 1)}
    values |= {"ev": st.lists(stops, min_size=1, max_size=3), "file": st.none()}
    kind = draw(st.sampled_from(sorted(KINDS)))
    drawn = {f.name: draw(values.get(f.name, frames)) for f in fields(KINDS[kind])}
    for first, last in (("enter", "leave"), ("on", "off")):
        if first in drawn:
            drawn[first], drawn[last] = sorted((drawn[first], drawn[last]))
    return {"kind": kind, **drawn}


@given(
    lightings(),
    st.integers(0, 2**31 - 1),
    log_uniform(1e-5, 100),
    st.floats(0, 1, exclude_max=True),
)
def test_light_is_positive_and_finite_in_every_frame(
    spec: dict[str, Any], frame: int, exposure_time: float, phase: float
) -> None:
    lighting = make_lighting(spec)
    gain = lighting.gain(frame, exposure_time, phase)
    assert 0.0 < gain < math.inf
    known = {"flicker": MAX_STOPS, "schedule": max(map(abs, spec.get("ev", [0.0])))}
    most = known.get(spec["kind"], abs(spec.get("stops", 0.0)))
    assert abs(math.log2(gain)) <= most + 1e-9
    assert make_lighting(json.loads(json.dumps(spec))) == lighting


@given(
    lights(LIGHT.map(abs)),
    USUAL_SETTINGS,
    grids(),
    st.sampled_from([None, 1e-3, 640.0, 1e6]),
    st.booleans(),
    st.sampled_from([0.0, 1e-3, 1.0, 100.0]),
    st.sampled_from([0.0, 1.0, 500.0]),
    st.sampled_from([1.0, 2.0**-20, 2.0**20]),
)
def test_scores_are_shares_and_the_oracle_has_the_highest(
    light: torch.Tensor,
    reference: Any,
    grid: ExposureGrid,
    illuminance: float | None,
    is_noisy: bool,
    speed: float,
    defocus: float,
    gain: float,
) -> None:
    if float((light[1:3] > 0).double().mean()) <= 0.2:
        illuminance = illuminance or 640.0  # no exposure is right for a black frame
    nlf = CAMERA.nlf(reference.iso) if is_noisy else NoiseLevelFunction.zero()
    scene = Scene.from_array(
        light, reference, CAMERA, scene_id="any", nlf=nlf, illuminance=illuminance
    )
    for name in list_scorers(self_contained=True):
        tables = ScoreTables(grid, CAMERA, make_scorer(name), use_cache=False)
        table = tables.table(scene, speed=speed, defocus=defocus, gain=gain)
        for values in (table.mean, *table.parts.values()):
            assert values.shape == (len(grid),)
            assert bool(((values >= 0.0) & (values <= 1.0)).all())
        best = table.mean.max()
        assert table.mean[table.oracle] >= best - TIE
        assert bool((table.mean[: table.oracle] < best - TIE).all())


@given(lights(st.floats(-1.0, 100.0, width=32)), st.data(), SEEDS)
def test_averaging_a_scene_down_keeps_its_mean(
    light: torch.Tensor, data: st.DataObject, seed: int
) -> None:
    size = min(light.shape[1:])
    resolution = data.draw(st.integers(1, size))
    nlf = NoiseLevelFunction((1e-3,) * 4, (1e-6,) * 4)
    marks = torch.from_numpy(np.random.default_rng(seed).random(light.shape[1:]) < 0.1)
    scene = Scene.from_array(
        light, CAMERA_SETTINGS, CAMERA, scene_id="any", nlf=nlf, saturated=marks
    )
    small = scene.resized(resolution)
    k = small.box_factor
    assert k == size // resolution
    assert small.light.shape == (4, resolution, resolution)
    top, left = ((n - k * resolution) // 2 for n in light.shape[1:])
    window = slice(top, top + k * resolution), slice(left, left + k * resolution)
    part = light[:, window[0], window[1]].double()
    torch.testing.assert_close(
        small.light.double().mean(dim=(1, 2)), part.mean(dim=(1, 2)), rtol=2e-7, atol=1e-5
    )
    assert small.nlf.shot[0] == pytest.approx(1e-3 / k**2)
    assert (small.saturated is None) == (not bool(marks[window].any()))
    native = scene.resized(resolution, "native")
    top, left = ((n - resolution) // 2 for n in light.shape[1:])
    cut = light[:, top : top + resolution, left : left + resolution]
    assert torch.equal(native.light, cut)
    assert native.box_factor == 1
