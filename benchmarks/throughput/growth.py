"""How time and memory grow with pixels and states.

Every point is measured in a process of its own, because its peak memory is wanted. Memory is the
peak less what the process held before it, with all libraries loaded and warm.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from scipy.stats import linregress

import ae_env  # noqa: F401  registers the environment
from benchmarks.harness import Part, Row
from benchmarks.isolated import forget_peak, median_seconds, peak_memory, timed
from simulator import (
    CameraSettings,
    CameraSimulator,
    NoiseLevelFunction,
    PreparedScene,
    RawImage,
    get_camera,
)
from simulator.optics.discs import disc_blur
from simulator.radiance.procedural import dead_leaves

#: Packed heights and widths: 16 thousand to 24 million samples, which are the sensor's pixels.
PIXELS = ((64, 64), (128, 128), (256, 256), (512, 512), (1024, 1024), (2000, 3000))
STATES = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512)
#: Least seconds that a point is repeated for, quick and in full.
_LEAST = (0.1, 0.6)
#: Memory below this is that of the allocator's own steps [MiB].
MEMORY_FLOOR = 4.0
CAMERA = "nikon_z6"
#: Side of the picture that is repeated, mirrored, over a larger frame [packed pixel], and diameter
#: of the circle of confusion where it is out of focus.
_TILE, _DEFOCUS = 512, 4.0


def parts(quick: bool) -> Iterator[Part]:
    """A part for each point of each curve; `quick` leaves out most of them."""
    pixels = [{"height": h, "width": w} for h, w in (PIXELS[1:4] if quick else PIXELS)]
    states = [{"count": n} for n in (STATES[:7:3] if quick else STATES)]
    curves: dict[str, tuple[Callable[..., Any], list[Any], dict[str, Any]]] = {
        "pixels|exposure + noise": (measure_pixels, pixels, {"weights": None}),
        "pixels|full model": (measure_pixels, pixels, {"weights": "compact"}),
        "states|sweep, bank noise": (measure_states, states, {"noise": "bank"}),
        "states|sweep, exact noise": (measure_states, states, {"noise": "exact"}),
    }
    for name, (task, points, fixed) in curves.items():
        for point in points:
            label = f"growth|{name}|{'x'.join(map(str, point.values()))}"
            yield Part(label, task, {**point, **fixed, "quick": quick}, fresh_cache=True)


def curves(results: dict[str, Any]) -> list[Row]:
    """The curves with their points, and exponents of time and memory over the upper decades."""
    found: dict[tuple[str, str], list[Row]] = {}
    for label, point in results.items():
        if label.startswith("growth|"):
            _, against, name, _ = label.split("|")
            found.setdefault((against, name), []).append(point)
    rows = []
    for (against, name), points in found.items():
        x = [point["x"] for point in points]
        fits = {
            key: fitted_exponent(x, [p[key] for p in points], floor=MEMORY_FLOOR * (key == "mib"))
            for key in points[0]
            if key != "x"
        }
        rows.append({"name": name, "against": against, "points": points, "exponents": fits})
    return rows


# -- the points, each run in a process of its own --------------------------------------------------


def measure_pixels(
    height: int, width: int, weights: str | None, *, quick: bool
) -> dict[str, float]:
    """`simulate` of one raw at one state: time and memory, the raw itself included."""
    simulator, settings, depth = CameraSimulator(), CameraSettings(1600, 1 / 256, 8.0), "far"
    if weights is not None:  # to cleaner settings and a wider aperture, so that both are needed
        simulator = CameraSimulator.from_pretrained(weights, cache=None)
        settings, depth = CameraSettings(100, 1 / 16, 4.0), "unknown"
    options: dict[str, Any] = {"depth": depth}
    simulator.simulate(noisy_raw(64, 64), settings, **options)
    before = _held()
    raw = noisy_raw(height, width)
    forget_peak()
    seconds = [timed(lambda: simulator.simulate(raw, settings, **options))]
    memory = peak_memory() - before
    while sum(seconds) < _LEAST[not quick]:
        seconds.append(timed(lambda: simulator.simulate(raw, settings, **options)))
    return {"x": 4.0 * height * width, "seconds": float(np.median(seconds)), "mib": memory}


def measure_states(count: int, noise: Any, *, quick: bool) -> dict[str, float]:
    """A sweep of a clean 128 x 128 scene over `count` states: time, and memory of the frames."""
    raw, clean = noisy_raw(128, 128), NoiseLevelFunction.zero()
    prepared = PreparedScene(raw.data.clamp(min=0.0), raw.settings, raw.camera, clean)
    every = itertools.product(range(8), range(8), range(8))
    states = [CameraSettings(100 * 2**i, 2.0 ** (-t - 2), 2 ** (1 + n / 2)) for i, t, n in every]
    states = [states[i] for i in np.random.default_rng(0).permutation(len(states))[:count]]
    prepared.expose(states[:1], noise=noise)
    before = _held()
    seconds = median_seconds(lambda: prepared.expose(states, noise=noise), least=_LEAST[not quick])
    return {"x": float(count), "seconds": seconds, "mib": peak_memory() - before}


def _held() -> float:
    forget_peak()
    return peak_memory()


# -- raws and the fit ------------------------------------------------------------------------------


def noisy_raw(height: int, width: int) -> RawImage:
    """A raw of any size as a Nikon Z6 records it at ISO 400: mirrored dead leaves.

    In focus on the left of each tile, out of focus on the right.
    """
    settings = CameraSettings(400, 1 / 64, 8.0)
    camera, rng = get_camera(CAMERA), np.random.default_rng(0)
    red, green, blue = dead_leaves(rng, _TILE)
    tile = torch.from_numpy(np.stack([red * 0.5, green, green, blue * 0.6]))  # a sensor's, roughly
    tile[..., _TILE // 2 :] = disc_blur(tile, _DEFOCUS)[..., _TILE // 2 :]
    noise, more = camera.nlf(settings.iso), [(0, max(0, n - _TILE)) for n in (height, width)]
    data = np.empty((4, height, width), np.float32)
    for plane, part in enumerate(data):  # little more memory than the raw itself
        part[:] = np.pad(tile[plane].numpy(), more, mode="symmetric")[:height, :width]
        part += np.sqrt(part * noise.shot[plane] + noise.read[plane]) * rng.standard_normal(
            part.shape, dtype=np.float32
        )
    span, black = (np.array(v, np.float32) for v in (camera.span, camera.black_level))
    for plane, part in enumerate(data):
        numbers = np.rint(part * span[plane] + black[plane]).clip(0, camera.white_level)
        part[:] = (numbers - black[plane]) / span[plane]
    return RawImage(torch.from_numpy(data), settings, camera)


def fitted_exponent(
    x: list[float], y: list[float], *, floor: float = 0.0
) -> tuple[float, float] | None:
    """Exponent k of y ~ x^k over the upper two decades of x, and its standard error.

    Values at or below `floor` do not count; None with fewer than three points.
    """
    points = [(a, b) for a, b in zip(x, y, strict=True) if b > floor and 100 * a >= 0.999 * max(x)]
    if len(points) < 3:
        return None
    fit = linregress(*np.log10(points).T)
    return float(fit.slope), float(fit.stderr)
