"""Score tables and scorers of scenes that no camera can expose."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch

from ae_env.grid import ExposureGrid
from ae_env.scenes import Scene
from ae_env.scorers import list_scorers, make_scorer
from ae_env.scorers.score_table import ScoreTable, ScoreTables
from ae_env.utils.checks import UserCodeError
from benchmarks.stability.case import Row, time_ratio
from benchmarks.stability.signals import extreme_signals
from simulator import CameraProfile, CameraSettings, get_camera

GROUP = "scores"
_REFERENCE = CameraSettings(iso=100.0, exposure_time=1.0 / 128.0, f_number=4.0)
_EPISODES = ({}, {"speed": 100.0, "defocus": 8.0}, {"gain": 2.0**-20}, {"gain": 2.0**20})
_EXTREMES = "1e-6 to 1e9 lux, +-20 stops, 100 frame heights a second"


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """The cases of this group."""
    camera = get_camera("nikon_z6")
    signals = extreme_signals(seed)
    ordinary = _scene("ordinary", 0.05 + 0.4 * torch.rand(4, 48, 48), camera, 1000.0)
    for name in list_scorers(self_contained=True):
        case = f"{name}: {len(signals)} signals, {_EXTREMES}"
        yield _told(case, lambda c=case, n=name: _finite(c, n, signals, ordinary, camera))
    case = "balanced against float64"
    yield _told(case, lambda: _balanced_parts(case, signals, camera))


def _told(case: str, measure: Callable[[], Row]) -> Row:
    """What `measure` finds; a scorer that leaves its range is refused, which is a finding too."""
    try:
        return measure()
    except UserCodeError as error:
        return Row(GROUP, case, None, limit=0.0, dtype="float64", finite=False, note=str(error))


def _scene(
    name: str, light: torch.Tensor, camera: CameraProfile, illuminance: float | None
) -> Scene:
    return Scene.from_array(
        light, _REFERENCE, camera, scene_id=name.replace(" ", "-"), illuminance=illuminance
    )


def _scenes(signals: dict[str, torch.Tensor], camera: CameraProfile) -> list[Scene]:
    """Every signal in unknown light, in starlight and in light no camera was made for.

    Unknown light must be found from the signal itself; one without any is refused.
    """
    return [
        _scene(f"{name} {lux}", light, camera, lux)
        for name, light in signals.items()
        for lux in (None, 1e-6, 1e9)
        if lux is not None or bool((light > 0).float().mean() > 0.1)
    ]


def _tables(name: str, camera: CameraProfile) -> ScoreTables:
    scorer = make_scorer(name)
    return ScoreTables(ExposureGrid.default(), camera, scorer, use_cache=False)


def _finite(
    case: str,
    name: str,
    signals: dict[str, torch.Tensor],
    ordinary: Scene,
    camera: CameraProfile,
) -> Row:
    tables = _tables(name, camera)
    finite, out_of_range = True, 0.0
    for scene in _scenes(signals, camera):
        for episode in _EPISODES:
            for values in _values(tables.table(scene, **episode)):
                finite &= bool(np.isfinite(values).all())
                out_of_range = max(out_of_range, -values.min(), values.max() - 1.0)
    extreme = _scene("30 stops in one frame", signals["30 stops in one frame"], camera, 1e9)
    return Row(
        GROUP,
        case,
        float(out_of_range),
        error="outside [0, 1]",
        limit=0.0,
        dtype="float64",
        finite=finite,
        time_ratio=time_ratio(
            lambda: _tables(name, camera).table(extreme),
            lambda: _tables(name, camera).table(ordinary),
            repeats=3,
        ),
    )


def _values(table: ScoreTable) -> list[np.ndarray]:
    return [table.mean, *table.parts.values()]


def _balanced_parts(case: str, signals: dict[str, torch.Tensor], camera: CameraProfile) -> Row:
    """The default scorer against its formulas (docs/scorers) in float64."""
    tables, grid = _tables("balanced", camera), ExposureGrid.default()
    worst = 0.0
    for scene in _scenes(signals, camera):
        wanted = np.array([_balanced(scene, state, camera) for state in grid])
        worst = max(worst, float(np.abs(tables.table(scene).mean - wanted).max()))
    return Row(GROUP, case, worst, error="of a score", limit=1e-5)


def _balanced(scene: Scene, state: CameraSettings, camera: CameraProfile) -> float:
    ratio = 2.0 ** (state.log2_exposure - scene.reference.log2_exposure)
    light = scene.light.numpy().astype(np.float64) * ratio
    stops = np.log2(np.maximum(scene.light.numpy().astype(np.float64), 2.0**-40)) + np.log2(ratio)
    error = scene.ev100 + state.log2_exposure
    brightness = np.exp(1.0 - np.sqrt(1.0 + error**2))
    blown = _sigmoid(stops.max(axis=0) / 0.12).mean()
    blocked = _sigmoid(-(stops + 9.0) / 0.5).mean()
    nlf = camera.nlf(state.iso)
    shot, read = (np.array(v)[:, None, None] for v in (nlf.shot, nlf.read))
    seen = np.maximum(light, 0.0)
    snr = (np.minimum(seen, 1.0) / np.sqrt(shot * seen + read)) ** 1.5
    noise = (snr / (snr + 18.0**1.5)).mean()
    score = (1.0 - blown**4) * (1.0 - blocked**4) * brightness**0.30 * noise**0.20
    return float(score * np.exp(-blown / 0.15) ** 0.15 * np.exp(-blocked / 0.20) ** 0.10)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 * (1.0 + np.tanh(0.5 * x))
