"""Every metering policy in the loop with the environment, on small scenes."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest

from agents.episodes import make_envs
from agents.policy import MANUAL_PROGRAMS, METERS, PolicyContext, make_policy

CONTROLLERS = (*METERS, "rpi_agc")
SMALL = {"scenes": "bundled:small", "split": "all", "resolution": 36}
STILL = {"motion": "none", "depth": "far"}
#: Scenes of every kind: each third of the small ones.
EVERY = 3


@functools.cache
def _loop(
    name: str, frames: int, start: int | None = None, **options: Any
) -> tuple[Any, np.ndarray, np.ndarray]:
    """The grid, the states (E, T) and the EV of the light at the start (E,)."""
    options = {
        **SMALL,
        **STILL,
        **{k: dict(v) if k == "lighting" else v for k, v in options.items()},
    }
    envs = make_envs(options, num_envs=1, frames=1)
    count = len(envs.unwrapped.scenes)  # type: ignore[attr-defined]
    envs.close()
    scenes = list(range(0, count, EVERY))
    envs = make_envs(options, num_envs=len(scenes), frames=frames)
    try:
        base: Any = envs.unwrapped
        policy = make_policy(name, PolicyContext.from_envs(envs))
        policy.reset(len(scenes), seed=0)
        observations, _ = envs.reset(
            seed=0, options={"scene": scenes, **({} if start is None else {"state": start})}
        )
        states = []
        for _ in range(frames):
            states.append(policy.act(observations, base.action_masks()))
            observations, *_ = envs.step(states[-1])
        light = np.array([base.scenes[i].ev100 for i in scenes])
        return base.grid, np.stack(states, axis=1), light
    finally:
        envs.close()


@pytest.mark.parametrize(
    ("program", "start"), [*((p, None) for p in MANUAL_PROGRAMS), ("P", 3), ("P", 60)]
)
@pytest.mark.parametrize("name", CONTROLLERS)
def test_comes_to_rest_in_steady_light(name, program, start):
    """From a start of the environment's, from the darkest state (3) and from the brightest (60)."""
    grid, states, light = _loop(f"{name}:{program}", 24, start)
    ev = grid.ev100[states]
    # Shim's and Zhang's meters may still be on their way in the dark, but they do not turn back.
    moves = np.sign(np.diff(ev[:, -10:], axis=1).round(1))
    assert (np.abs(moves).sum(axis=1) == np.abs(moves.sum(axis=1))).all()
    assert (moves != 0).sum() <= (2 if name in ("shim", "zhang") else 0)
    if program == "P":
        median = np.median(ev[:, -1] - light)
        assert abs(median) < (3.5 if name in ("entropy", "shim", "zhang") else 1.5)


@pytest.mark.parametrize("stops", [-4.0, 4.0])
@pytest.mark.parametrize("name", CONTROLLERS)
def test_comes_to_rest_after_a_step_with_delay(name, stops):
    lighting = (("kind", "step"), ("stops", stops), ("at", 12))
    grid, states, _ = _loop(f"{name}:P", 60, delay=2, lighting=lighting)
    last = grid.ev100[states[:, -8:]]
    assert (last.max(axis=1) - last.min(axis=1)).max() < 0.1
    before, after = grid.ev100[states[:, 11]], grid.ev100[states[:, -1]]
    end = 5.6 if name == "rpi_agc" else grid.ev100.min() + 0.6  # of its ladder
    inside = (after > end) & (after < grid.ev100.max() - 0.6)
    assert np.median((after - before)[inside]) == pytest.approx(stops, abs=1.5)


@pytest.mark.parametrize("name", ["centre_weighted", "rpi_agc"])
def test_damped_controllers_converge_on_whole_stops(name):
    """A controller that took its EV back from the settings would stay: its first step is short."""
    lighting = (("kind", "step"), ("stops", -3.0), ("at", 6))
    grid, damped, _ = _loop(f"{name}:P?damping=0.9", 90, lighting=lighting)
    _, free, _ = _loop(f"{name}:P", 90, lighting=lighting)
    ev_damped, ev_free = grid.ev100[damped], grid.ev100[free]
    assert np.abs(ev_damped[:, -1] - ev_free[:, -1]).max() < 1.1
    assert np.mean(np.abs(ev_damped[:, -1] - ev_free[:, -1]) < 0.1) > 0.6
    # 3 EV * 0.9^n falls below half a stop after 17 frames.
    late = np.abs(ev_damped[:, 12] - ev_damped[:, 5]) <= 2.1
    assert late.mean() > 0.9


@pytest.mark.parametrize("name", CONTROLLERS)
def test_compensation_shifts_the_exposure_by_its_ev(name):
    grid, plain, _ = _loop(f"{name}:P", 24)
    _, darker, _ = _loop(f"{name}:P?compensation=-2", 24)
    first, second = grid.ev100[plain[:, -1]], grid.ev100[darker[:, -1]]
    inside = (second < grid.ev100.max() - 0.6) & (first > grid.ev100.min() + 0.6)
    assert inside.sum() >= 4
    assert np.median((second - first)[inside]) == pytest.approx(2.0, abs=0.3)


@pytest.mark.parametrize("program", MANUAL_PROGRAMS)
@pytest.mark.parametrize("name", ["average", "rpi_agc"])
def test_shutter_cap_holds_whatever_the_program(name, program):
    slow = "&exposure_time=0.5" if program in ("S", "M") else ""
    grid, states, _ = _loop(f"{name}:{program}?shutter_cap=1/500{slow}", 8)
    assert {grid[int(s)].exposure_time for s in states.ravel()} == {1 / 1000}
    none_shorter, states, _ = _loop(f"{name}:{program}?shutter_cap=1/8000", 4)
    assert {none_shorter[int(s)].exposure_time for s in states.ravel()} == {1 / 1000}


@pytest.mark.parametrize("name", ["matrix", "rpi_agc"])
def test_manual_holds_what_is_set(name):
    grid, states, _ = _loop(f"{name}:M?f_number=11&exposure_time=1/15", 8)
    found = {(grid[int(s)].f_number, grid[int(s)].exposure_time) for s in states.ravel()}
    assert found == {(11.0, 1 / 15)}
    assert len({grid[int(s)].iso for s in states.ravel()}) > 1  # the ISO follows
    _, fixed, _ = _loop(f"{name}:M?f_number=11&exposure_time=1/15&iso=400", 8)
    assert {grid[int(s)] for s in fixed.ravel()} == {grid[grid.index(1, 2, 3)]}


@pytest.mark.parametrize(("stops", "frames"), [(-4.0, 7), (4.0, 19)])
def test_rpi_agc_needs_the_frames_of_its_filter(stops, frames):
    """Within 1/3 EV on a grid of thirds; 15/16 * 0.8^n < 0.206 and 15 * 0.8^n < 0.26."""
    lighting = (("kind", "step"), ("stops", stops), ("at", 12))
    grid, states, _ = _loop("rpi_agc:P", 60, grid="third_stop", lighting=lighting)
    ev = grid.ev100[states]
    moved = np.abs(ev[:, -1] - ev[:, 10])
    whole = np.abs(moved - abs(stops)) < 0.5  # not clipped, not at the end of the ladder
    settled = [
        int(np.flatnonzero(np.abs(row - row[-1]) > 1 / 3 + 1e-6)[-1]) + 1 - 11 for row in ev[whole]
    ]
    assert len(settled) >= 3
    assert abs(np.median(settled) - frames) <= 2
