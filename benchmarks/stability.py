"""Cases without a right answer that have a curve to read: error over what is varied.

    ae-env bench stability

What can only be right or wrong (exposure ratios, extreme signals, lamps, noise level functions,
bad input, damaged files) is in the tests. Each group of cases yields rows (`_row`); a row that is
not ok is a defect.
"""

from __future__ import annotations

import gc
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from scipy import stats

import ae_env  # noqa: F401  registers the environment
from agents import PolicyContext, make_policy
from agents.policy_names import CLASSIC_METERS
from agents.rollouts import make_envs
from benchmarks.harness import Part, Report, Row, benchmark, panels, sections, table
from simulator import CameraSettings, NoiseLevelFunction, PreparedScene, get_camera


def _row(
    case: str,
    x: Sequence[float],
    errors: Sequence[float],
    *,
    unit: str,
    limit: float | None = None,
    dtype: str = "",
    ok: bool = True,
    note: str = "",
) -> Row:
    """The row of a case: `errors` at each of `x`, of which none is wrong without a `limit`."""
    finite = all(math.isfinite(error) for error in errors)
    largest = max(map(abs, errors)) if finite else None
    within = finite and (limit is None or (largest is not None and largest <= limit))
    return {
        "case": case,
        "dtype": dtype,
        "finite": finite,
        "max_error": largest,
        "error": unit,
        "limit": limit,
        "ok": within and ok,
        "note": note,
        "curve": {"x": [float(v) for v in x], "y": [float(e) for e in errors]},
    }


# -- few electrons --------------------------------------------------------------------------------

#: Largest distance of two distribution functions that we call the same noise.
SAME = 0.05
#: Lags that autocorrelations are taken over [pixel].
_LAGS = 16


def electrons(seed: int, quick: bool) -> list[Row]:
    nlf, rows = get_camera("nikon_z6").nlf(6400.0), []
    levels = np.geomspace(0.1, 1000.0, 13 if quick else 41)
    for read in (math.sqrt(nlf.read[1]) / nlf.shot[1], 0.3):
        apart = [_gaussian_distance(float(level), read) for level in levels]
        far = levels[np.array(apart) > SAME]
        note = f"below {SAME:.0%} " + (f"above {far.max():.2g} electrons" if len(far) else "always")
        case, unit = f"read noise of {read:.1f} electrons", "of the distribution function"
        note = f"declared: the noise model is Gaussian; {note}"
        rows.append(_row(case, levels.tolist(), apart, unit=unit, dtype="float64", note=note))
    return rows


def _gaussian_distance(level: float, read: float) -> float:
    """Largest distance of the distribution functions of photons and Gaussian read noise [electrons]
    and of a Gaussian of the same mean and variance."""
    sigma, counts = math.hypot(math.sqrt(level), read), np.arange(int(level + 40 * level**0.5 + 60))
    grid, weights = (
        np.linspace(-8 * sigma, level + 10 * sigma + 8, 8001),
        stats.poisson.pmf(counts, level),
    )
    photons = (weights[:, None] * stats.norm.cdf((grid - counts[:, None]) / read)).sum(axis=0)
    return float(np.abs(photons - stats.norm.cdf((grid - level) / sigma)).max())


# -- over the signal ----------------------------------------------------------------------------


def statistics(seed: int, quick: bool) -> list[Row]:
    """Noise of even grey frames, drawn and from the bank, against the noise level function.

    Variance over signal; the distribution's distance from the normal; autocorrelation in space and
    over frames. What chance alone gives is the limit.
    """
    camera, frames, side = get_camera("nikon_z6"), 16 if quick else 128, 64
    levels, state = [2.0**stop for stop in range(-9, 0)], CameraSettings(6400, 1 / 64, 4.0)
    nlf, rows, chance = camera.nlf(state.iso), [], 5.0 / math.sqrt(4 * side * side * frames)
    limits = {"variance": 1.5 * chance, "autocorrelation in space": 1.5 * chance}
    for noise in ("exact", "bank"):
        found: dict[str, list[float]] = {}
        options: dict[str, Any] = {"noise": noise}
        for number, level in enumerate(levels):
            light = torch.full((4, side, side), level)
            prepared = PreparedScene(light, state, camera, NoiseLevelFunction.zero())
            seeds = range(seed + 1000 * number, seed + 1000 * number + frames)
            taken = torch.cat([prepared.expose([state], seed=s, **options) for s in seeds])
            step = 1 / (12 * np.square(camera.span))  # rounding adds its own
            variance = np.array(nlf.read) + np.array(nlf.shot) * level + step
            normals = (taken.double().numpy() - level) / np.sqrt(variance)[:, None, None]
            for name, value in _whiteness(normals).items():
                found.setdefault(name, []).append(value)
        for name, errors in found.items():
            given: dict[str, Any] = {"unit": "of the normal", "dtype": "float32"}
            limit = limits.get(name, chance)
            rows.append(_row(f"{name}, {noise} noise", levels, errors, limit=limit, **given))
    return rows


def _whiteness(normals: np.ndarray) -> dict[str, float]:
    """Departures of (T, 4, H, W) from independent standard normals."""
    ordered = normals[:, 0].ravel()
    values, counts = np.unique(ordered, return_counts=True)  # whole digital numbers
    share = counts.cumsum()[:-1] / ordered.size
    law = stats.norm.cdf((values[1:] + values[:-1]) / 2)
    lagged = [normals[..., lag:] * normals[..., :-lag] for lag in range(1, _LAGS + 1)]
    return {
        "variance": abs(float(normals.var()) - 1.0),
        "distribution of a plane": float(np.abs(share - law).max()) / 2,  # 4 times fewer samples
        "autocorrelation in space": max(abs(float(product.mean())) for product in lagged),
        "autocorrelation over frames": abs(float((normals[1:] * normals[:-1]).mean())),
    }


# -- policies after a jump of the light -----------------------------------------------------------

#: The agents that come with the package: learnt in steady light, in episodes of eight frames.
LEARNT = ("regression", "ppo")
#: The classic meters and the hand-made programs, and the agents.
POLICIES = (*(f"{m}:{p}" for m in CLASSIC_METERS for p in ("P", "A", "S")), *LEARNT)
DELAYS = (0, 1, 2, 4)
#: Frame of the step, frames of an episode, and how many of the last tell whether it came to rest.
_STEP, _FRAMES, _LAST = 12, 72, 12
#: Largest swing at the end [EV]: one state of the grid.
_ONE_STATE = 1.2


def control(seed: int, quick: bool) -> list[Row]:
    rows = []
    for name in POLICIES:
        delays = (0, 2) if quick or name in LEARNT else DELAYS
        loops = [[_loop(name, delay, s, seed) for s in (-6.0, 6.0)] for delay in delays]
        frames = [max(int(settled.max()) for settled, _ in pair) for pair in loops]
        swings = np.concatenate([amplitudes for pair in loops for _, amplitudes in pair])
        still = float(swings.max()) <= _ONE_STATE
        note = f"swings by {swings.max():.2f} EV at the end"
        if not still:
            share = (swings > _ONE_STATE).mean()
            note += f", by more than {_ONE_STATE} in {share:.1%} of the cases"
        note += f"; {len(swings)} cases" + ", learnt in steady light" * (name in LEARNT)
        case = f"{name}, steps of +-6 EV"
        rows.append(_row(case, delays, frames, unit="frames to settle", ok=still, note=note))
    return rows


def _loop(name: str, delay: int, stops: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames from the step until it stayed, and its swing at the end [EV], of each scene.

    Agents see all scenes of the test split, as they were trained on others.
    """
    learnt = name in LEARNT
    options: dict[str, Any] = {
        "scenes": "bundled" if learnt else "bundled:small",
        "split": "test" if learnt else "all",
        "lighting": {"kind": "step", "stops": stops, "at": _STEP},
        "delay": delay,
        "motion": "none",
        "depth": "far",
        "resolution": 64 if learnt else 36,  # theirs; the least
    }
    first = make_envs(options, num_envs=1, frames=1)
    count = len(first.unwrapped.scenes)  # type: ignore[attr-defined]
    first.close()
    envs = make_envs(options, num_envs=count, frames=_FRAMES)
    policy = make_policy(name, PolicyContext.from_envs(envs))
    policy.reset(envs.num_envs, seed)
    observations, info = envs.reset(seed=seed, options={"scene": list(range(envs.num_envs))})
    evs = [info["ev100"]]
    for _ in range(_FRAMES):
        masks = envs.unwrapped.action_masks()  # type: ignore[attr-defined]
        observations, _, _, _, info = envs.step(policy.act(observations, masks))
        evs.append(info["ev100"])
    envs.close()
    track = np.stack(evs, axis=1)  # (E, T)
    moved = np.abs(np.diff(track, axis=1)) > 1e-9
    settled = [int(np.flatnonzero(own)[-1]) + 1 - _STEP if own.any() else 0 for own in moved]
    return np.maximum(settled, 0), np.ptp(track[:, -_LAST:], axis=1)


# -- a long run -----------------------------------------------------------------------------------

#: Steps and episodes, and memory that may be added once everything was in use once [MiB].
STEPS, EPISODES, _GROWTH_MIB = 100_000, 1_000, 16.0


def long_runs(seed: int, quick: bool) -> list[Row]:
    steps, episodes = (2_000, 20) if quick else (STEPS, EPISODES)
    env = gym.make("ae_env/AutoExposure-v0", scenes="bundled:small", max_episode_steps=None)
    rng, x, memory = np.random.default_rng(seed), list[int](), list[float]()
    for step in range(steps):
        if step % (steps // episodes) == 0:
            env.reset(seed=seed if step == 0 else None)
        if step >= steps // 5 and step % (steps // 20) == 0:
            gc.collect()
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
            x.append(step)
            memory.append(pages * os.sysconf("SC_PAGE_SIZE") / 2**20)
        env.step(rng.integers(64))
    growth = [max(0.0, value - memory[0]) for value in memory]
    case = f"{steps:,} steps in {episodes:,} episodes"
    return [_row(case, x, growth, unit="MiB more", limit=_GROWTH_MIB)]


# -- report ---------------------------------------------------------------------------------------

#: Groups, in the order of the page: what measures them, and the label of what is varied.
GROUPS: dict[str, tuple[Any, str]] = {
    "few electrons": (electrons, "electrons"),
    "noise over signal": (statistics, "signal [of white]"),
    "stiff control": (control, "delay [frames]"),
    "long runs": (long_runs, "steps"),
}
LOGARITHMIC = ("few electrons", "noise over signal")


def parts(seed: int, quick: bool) -> list[Part]:
    given = {"seed": seed, "quick": quick}
    return [Part(name, measure, given) for name, (measure, _) in GROUPS.items()]


_COLUMNS = """case = {case} | dtype = {dtype} | largest error = {max_error:.3g} {error} |
allowed = {limit:.3g} | finite = {finite} | right = {ok} | note = {note}"""


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows = [{"group": group, **row} for group, own in results.items() for row in own]
    curves = []
    for row in rows:
        axes: Row = {"xlabel": GROUPS[row["group"]][1], "ylabel": row["error"]}
        if row["group"] in LOGARITHMIC:
            axes["xscale"] = "log"
        x, y = row["curve"]["x"], row["curve"]["y"]
        curve: Row = {"panel": row["group"], "label": row["case"][:56], "x": x, "y": y}
        curves.append(curve | {"axes": axes, "style": {"marker": ".", "lw": 0.9}})
    figure = panels(curves, columns=2, width=5.5)
    tables = {"cases": sections(rows, "{group}", lambda own: table(own, _COLUMNS))}
    return Report(rows, tables, figures={"stability.png": figure})


run = benchmark("stability", parts, report)
