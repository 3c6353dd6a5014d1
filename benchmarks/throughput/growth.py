"""How time and memory grow with pixels, states, environments and scenes.

Every point is measured in a process of its own, because its peak memory is wanted. Memory is the
peak less what the process held before it, with all libraries loaded and warm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch

import ae_env  # noqa: F401  registers the environment
from ae_env.scenes import Scene
from benchmarks.isolated import forget_peak, isolated, median_seconds, peak_memory, timed
from benchmarks.keeping import Kept
from benchmarks.throughput.frames import noisy_raw
from benchmarks.throughput.kernel_limit import KernelLimit
from simulator import CameraSettings, CameraSimulator, get_camera
from simulator.capture.prepared_scene import PreparedScene
from simulator.noise.generator import Noise

#: Packed heights and widths: 16 thousand to 24 million samples, which are the sensor's pixels.
PIXELS = ((64, 64), (128, 128), (256, 256), (512, 512), (1024, 1024), (2000, 3000))
STATES = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512)
ENVIRONMENTS = (1, 4, 16, 64, 256, 1024)
SCENES = (1, 3, 10, 30, 100, 300, 1000)
#: Frame sizes at which the cost of one more state is compared with the bare loop.
MARGINAL_SIZES = ((128, 128), (512, 768))
#: Least seconds that a point is repeated for, quick and in full.
_LEAST = (0.1, 0.6)
#: Memory below this is that of the allocator's own steps [MiB].
MEMORY_FLOOR = 4.0
#: Smallest frame side of the environments here [packed pixel].
_SIDE = 64


@dataclass(frozen=True)
class Series:
    """One curve: `task` measures a point of it.

    Args:
        name: Of the curve.
        against: What is varied.
        task: Name of a function of this module.
        points: Values of what is varied, as arguments of `task`.
        fixed: Its other arguments.
    """

    name: str
    against: str
    task: str
    points: tuple[dict[str, Any], ...]
    fixed: dict[str, Any]


def all_series(quick: bool) -> Iterator[Series]:
    """What is measured; `quick` leaves out the larger points and the slower curves."""
    cached = {"motion": "none", "depth": "far"}
    curves: list[tuple[str, str, str, list[dict[str, Any]], dict[str, Any]]] = []
    sizes = [{"height": h, "width": w} for h, w in (PIXELS[1:4] if quick else PIXELS)]
    for name, fixed in (
        ("exposure + noise", {"weights": None}),
        ("full model", {"weights": "compact", "depth": "unknown"}),
    ):
        curves.append((name, "pixels", "measure_pixels", sizes, fixed))
    counts = [{"count": n} for n in (STATES[:7:3] if quick else STATES)]
    for noise in ("bank", "exact"):
        fixed = {"noise": noise}
        curves.append((f"sweep, {noise} noise", "states", "measure_states", counts, fixed))
    counts = [{"count": n} for n in (ENVIRONMENTS[1:4] if quick else ENVIRONMENTS)]
    for name, options in (("cached scene", cached), ("motion and defocus", {})):
        fixed = {"options": options}
        curves.append((f"step, {name}", "environments", "measure_environments", counts, fixed))
    counts = [{"count": n} for n in (SCENES[2:5] if quick else SCENES)]
    curves.append(("step", "scenes", "measure_scenes", counts, {}))
    skipped = ("sweep, exact noise", "step, motion and defocus") * quick
    for name, against, task, points, fixed in curves:
        if name not in skipped:
            yield Series(name, against, task, tuple(points), fixed)


def measure_series(
    series: Series, kept: Kept, *, threads: int, quick: bool, progress: Callable[[], None]
) -> dict[str, Any]:
    """All points of a curve, with the exponents of time and memory over the upper decades."""
    points, fresh = [], series.against in ("pixels", "scenes")
    for point in series.points:
        arguments: dict[str, Any] = {**point, **series.fixed, "quick": quick}
        points.append(
            kept(
                f"{series.task}-{arguments}",
                lambda arguments=arguments: isolated(
                    globals()[series.task], num_threads=threads, fresh_cache=fresh, **arguments
                ),
            )
        )
        progress()
    x = [point["x"] for point in points]
    fits = {
        name: fitted_exponent(x, [p[name] for p in points], floor=MEMORY_FLOOR * (name == "mib"))
        for name in points[0]
        if name != "x"
    }
    return {"name": series.name, "against": series.against, "points": points, "exponents": fits}


# -- the points, each run in a process of its own --------------------------------------------------


def measure_pixels(
    height: int, width: int, weights: str | None, depth: str = "far", *, quick: bool
) -> dict[str, float]:
    """`simulate` of one raw at one state: time and memory, the raw itself included."""
    simulator = CameraSimulator()
    if weights is not None:
        simulator = CameraSimulator.from_pretrained(weights, cache=None)
    # With networks to cleaner settings and a wider aperture, so that they are needed.
    settings = CameraSettings(1600, 1 / 256, 8.0)
    if weights is not None:
        settings = CameraSettings(100, 1 / 16, 4.0 if depth == "unknown" else 8.0)
    scene = {"depth": depth}
    simulator.simulate(noisy_raw(64, 64), settings, **scene)
    before = _held()
    raw = noisy_raw(height, width)
    forget_peak()
    seconds = [timed(lambda: simulator.simulate(raw, settings, **scene))]
    memory = peak_memory() - before
    while sum(seconds) < _LEAST[not quick]:
        seconds.append(timed(lambda: simulator.simulate(raw, settings, **scene)))
    return {"x": 4.0 * height * width, "seconds": float(np.median(seconds)), "mib": memory}


def measure_states(count: int, noise: Noise, *, quick: bool) -> dict[str, float]:
    """`PreparedScene.expose` of a 128 x 128 scene at `count` states: time, and memory of the frames."""
    prepared, states = clean_prepared(128, 128), many_states(512)
    prepared.expose(states[:1], noise=noise)
    before = _held()
    seconds = median_seconds(
        lambda: prepared.expose(states[:count], noise=noise), least=_LEAST[not quick]
    )
    return {"x": float(count), "seconds": seconds, "mib": peak_memory() - before}


def measure_environments(count: int, options: dict[str, Any], *, quick: bool) -> dict[str, float]:
    """A step of `count` environments of 64 x 64: time, memory of all but the libraries."""
    make = {"scenes": "bundled:small", "resolution": _SIDE, "autoreset_mode": "SAME_STEP"}
    first = gym.make_vec("ae_env/AutoExposure-v0", num_envs=1, **make, **options)
    for number in range(len(first.unwrapped.scenes)):  # type: ignore[attr-defined]
        first.reset(seed=0, options={"scene": number})
    before = _held()
    envs = gym.make_vec("ae_env/AutoExposure-v0", num_envs=count, **make, **options)
    envs.reset(seed=0)
    rng = np.random.default_rng(0)

    def episodes() -> None:
        for _ in range(8):
            envs.step(rng.integers(64, size=count))

    episodes()
    seconds = median_seconds(episodes, least=_LEAST[not quick]) / 8
    return {"x": float(count), "seconds": seconds, "mib": peak_memory() - before}


def measure_scenes(count: int, *, quick: bool) -> dict[str, float]:
    """64 environments over `count` scenes: time of their first frames and of a step, memory."""
    make = {"resolution": _SIDE, "autoreset_mode": "SAME_STEP"}
    _over(_many_scenes(1), **make).reset(seed=0)
    before = _held()
    scenes = _many_scenes(count)
    envs = _over(scenes, **make)

    def prepare() -> None:
        for first in range(0, count, 64):
            chosen = [(first + i) % count for i in range(64)]
            envs.reset(seed=0, options={"scene": chosen})

    preparation = timed(prepare)
    rng = np.random.default_rng(0)

    def episodes() -> None:
        for _ in range(8):
            envs.step(rng.integers(64, size=64))

    episodes()
    seconds = median_seconds(episodes, least=_LEAST[not quick]) / 8
    return {
        "x": float(count),
        "seconds": seconds,
        "preparation": preparation,
        "mib": peak_memory() - before,
    }


def measure_marginal(height: int, width: int, noise: Noise, *, quick: bool) -> dict[str, float]:
    """Seconds of one more state of a sweep beside the bare loop on the same frame.

    Both write to memory that is there, one frame behind the other. Sweeps of several lengths and
    the bare loop take turns; the cost is the slope of time against the number of states.
    """
    prepared, states = clean_prepared(height, width), many_states(64)
    lengths = (1, 8, 16, 32, 64) if height < 512 and not quick else (1, 4, 8)
    bare = KernelLimit(prepared.light.numpy()[None], max(lengths), noise=noise, result="raw")
    frames = torch.zeros(max(lengths), *prepared.light.shape)

    def sweep(length: int) -> None:
        prepared.expose(states[:length], noise=noise, out=frames[:length])

    slopes, limits = [], []
    for turn in range(4 if quick else 10):
        times = [timed(lambda length=length: sweep(length)) for length in lengths]
        limit = timed(bare.step) / max(lengths)
        if turn:  # the first warms up
            slopes.append(float(np.polynomial.Polynomial.fit(lengths, times, 1).convert().coef[1]))
            limits.append(limit)
    ratios = np.array(slopes) / limits
    return {
        "height": height,
        "width": width,
        "noise": noise,
        "seconds": float(np.median(slopes)),
        "limit": float(np.median(limits)),
        "ratio": float(np.median(ratios)),
        "spread": float(np.subtract(*np.quantile(ratios, (0.75, 0.25)))),
    }


def _held() -> float:
    forget_peak()
    return peak_memory()


def clean_prepared(height: int, width: int) -> PreparedScene:
    """A scene without noise of its own: its states cost exposure, noise and clip, nothing else."""
    raw, camera = noisy_raw(height, width), get_camera("nikon_z6")
    nothing = replace(camera.nlf(100), shot=(0.0,) * 4, read=(0.0,) * 4)
    return PreparedScene(raw.data.clamp(min=0.0), raw.settings, camera, nothing)


def many_states(count: int) -> list[CameraSettings]:
    """Up to 512 settings: 8 of ISO x 8 of exposure time x 8 of the f-number, in mixed order."""
    every = [
        CameraSettings(100 * 2.0**i, 2.0 ** (-t - 2), 2.0 ** (1 + n / 2))
        for i in range(8)
        for t in range(8)
        for n in range(8)
    ]
    order = np.random.default_rng(0).permutation(len(every))[:count]
    return [every[i] for i in order]


def _many_scenes(count: int) -> list[Scene]:
    """Scenes that differ: parts of dead leaves, each from another place."""
    raw, camera = noisy_raw(512, 512), get_camera("nikon_z6")
    nothing = replace(camera.nlf(100), shot=(0.0,) * 4, read=(0.0,) * 4)
    rng = np.random.default_rng(1)
    scenes = []
    for number in range(count):
        top, left = rng.integers(512 - _SIDE, size=2)
        light = raw.data[:, top : top + _SIDE, left : left + _SIDE].clamp(min=0.0).clone()
        scenes.append(
            Scene(
                scene_id=f"leaves-{number}",
                group=f"leaves-{number}",
                light=light,
                reference=raw.settings,
                camera=camera,
                nlf=nothing,
                illuminance=None,
                white_balance=(1.0, 1.0, 1.0),
                kind="leaves",
            )
        )
    return scenes


def _over(scenes: list[Scene], **options: Any) -> gym.vector.VectorEnv:
    return gym.make_vec("ae_env/AutoExposure-v0", num_envs=64, scenes=scenes, **options)


# -- the fit --------------------------------------------------------------------------------------


def fitted_exponent(
    x: list[float], y: list[float], *, floor: float = 0.0, decades: float = 2.0
) -> tuple[float, float] | None:
    """Exponent k of y ~ x^k over the upper decades, and its standard error.

    Least squares of log y against log x.

    Args:
        x: Positive and increasing.
        y: Values; those at or below `floor` do not count.
        floor: Largest value that means nothing.
        decades: How far below the largest x points count.

    Returns:
        ``(k, standard error)``; None with fewer than three points.
    """
    points = [
        (math.log10(a), math.log10(b))
        for a, b in zip(x, y, strict=True)
        if b > floor and a * 10**decades >= max(x) * (1 - 1e-9)
    ]
    if len(points) < 3:
        return None
    u, v = np.array(points).T
    design = np.stack([u, np.ones_like(u)], axis=1)
    (slope, offset), *_ = np.linalg.lstsq(design, v, rcond=None)
    residual = v - design @ (slope, offset)
    variance = float(residual @ residual) / (len(u) - 2)
    return float(slope), math.sqrt(variance / float(np.square(u - u.mean()).sum()))
