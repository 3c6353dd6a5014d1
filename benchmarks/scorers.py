"""Cost and taste of the scorers, and whether they tell good captures from bad ones.

    ae-env bench scorers

*Gain* and *best exposure*: noisy captures without blur of the small bundled test scenes.
*Correlation*: for every bundled test scene, with a motion and a defocus drawn as in an episode, the
64 states are simulated and compared with the reference: the same scene noise-free, blur-free and
exposed for its incident light. Each pixel carries the noise of one sensor pixel.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from scipy.stats import pearsonr, spearmanr
from skimage.metrics import structural_similarity

import ae_env  # noqa: F401  registers the environment
from ae_env.options import EnvOptions
from ae_env.scenes import Scene, reference_settings
from ae_env.scorers import Captures, CompositeScorer, list_scorers, make_scorer
from ae_env.scorers.captures import describe_captures, prepare_scene
from benchmarks.harness import Benchmark, Part, Report, Row, pivot, recorded, rounded, table
from benchmarks.isolated import timed
from simulator import CameraProfile, CameraSettings, develop

#: Captures of a batch that is timed, and the packed size of captures [pixel].
BATCH, SIZES, SIZE = 64, (128, 256), 128
#: A row that is no scorer: what each of those that look at sRGB needs first.
DEVELOP = "(developing to sRGB)"
#: Exposures of the sweep, in EV above that of the incident light: half stops.
OFFSETS = np.arange(-6.0, 4.01, 0.5)
#: Stops that the gain rises by, at fixed brightness.
STOPS, F_NUMBER = 6, 5.6
#: Scores nearer than this are equal.
_EQUAL = 1e-9
SCORERS = ("brightness", "highlights", "shadows", "noise", "sharpness", "balanced")
#: Below this signal [of white] a relative deviation means nothing: the scale of black.
DARK = 2.0**-10
#: Noise on samples above this is cut off by the clip.
WHITE = 0.97
#: States this close to the incident light's EV are well exposed.
NEAR_EV = 0.75


def parts(seed: int, quick: bool) -> list[Part]:
    """One part for each question."""
    scenes = "bundled:small" if quick else "bundled"
    return [
        Part("milliseconds", milliseconds, {"repeats": 1 if quick else 7}),
        Part("best_ev", best_ev, {"seed": seed}),
        Part("gain", gain, {"seed": seed}),
        Part("correlation", correlation, {"scenes": scenes, "seed": seed}),
    ]


@functools.cache
def available() -> tuple[dict[str, CompositeScorer], dict[str, str]]:
    """The known scorers, and why those that cannot be made here cannot."""
    made, missing = {}, {}
    for name in list_scorers():
        try:
            made[name] = make_scorer(name)
        except (ValueError, ImportError, OSError) as error:
            # What follows is where files of this machine lie.
            missing[name] = " ".join(str(error).partition(":")[0].split())
    return made, missing


# -- what they cost -------------------------------------------------------------------------------


def milliseconds(repeats: int) -> list[Row]:
    """A row per scorer and size: median and half the range of the time of a batch, developed."""
    scorers, rows = available()[0], []
    for size in SIZES if repeats > 1 else SIZES[:1]:
        options = EnvOptions(scenes="bundled:small", split="test", resolution=size)
        scene, camera, states = options.load_scenes()[0], options.make_camera(), options.make_grid()
        captures = _described(scene, list(states), camera)
        images = prepare_scene(scene, camera).expose(list(states), seed=0).clamp_(0.0, 1.0)
        matrix = captures.colour_matrices[0]
        tasks: dict[str, Callable[[], Any]] = {
            DEVELOP: lambda i=images, c=captures, m=matrix: develop(i, c.white_balance, m),  # type: ignore[misc]
            **{name: partial(scorer, images, captures) for name, scorer in scorers.items()},
        }
        for name, task in tasks.items():
            times = [1e3 * timed(task) for _ in range(repeats + 1)][1:]
            row = {"scorer": name, "size": size, "ms": float(np.median(times))}
            rows.append(row | {"ms_spread": (max(times) - min(times)) / 2})
    return rows


def _described(scene: Scene, states: list[CameraSettings], camera: CameraProfile) -> Captures:
    """Captures of `scene` in each of `states`, without blur."""
    zeros, scenes = np.zeros(len(states)), [scene] * len(states)
    return describe_captures(scenes, states, camera, speed=zeros, defocus=zeros, gain=zeros + 1.0)


# -- what they like -------------------------------------------------------------------------------


def best_ev(seed: int) -> list[Row]:
    """A row per scorer: in how many stops above incident light each scene scores best."""
    best: dict[str, dict[str, float | None]] = {}
    for scene, camera, seeded in _small(seed):
        states = [_state(scene, 100.0, offset) for offset in OFFSETS]
        for name, scores in _scores(scene, states, camera, seeded).items():
            best.setdefault(name, {})[scene.scene_id] = _best(scores)
    rows = []
    for name, by_scene in best.items():
        known = [value for value in by_scene.values() if value is not None]
        row: Row = {"scorer": name, "median": float(np.median(known)) if known else None}
        row |= {"lowest": min(known, default=None), "highest": max(known, default=None)}
        rows.append(row | {"by_scene": by_scene})
    return rows


def _best(scores: np.ndarray) -> float | None:
    """The best exposure, of equal ones that nearest to the incident light's; None of all equal."""
    if np.ptp(scores) < _EQUAL:
        return None
    best = OFFSETS[scores >= scores.max() - _EQUAL]
    return float(best[np.argmin(np.abs(best))])


def gain(seed: int) -> list[Row]:
    """A row per scorer: its change as the gain rises by 6 stops and the time falls by as many.

    Each pixel carries the noise of one pixel of the sensor, whatever the scene was averaged from.
    """
    found: dict[str, list[np.ndarray]] = {}
    for scene, camera, seeded in _small(seed):
        states = [_state(scene, iso, 0.0) for iso in (100.0, 100.0 * 2.0**STOPS)]
        native = replace(scene, box_factor=1)
        for name, scores in _scores(native, states, camera, seeded).items():
            found.setdefault(name, []).append(scores.astype(np.float64))
    rows = []
    for name, pairs in found.items():
        low, high = np.array(pairs).T
        change = high - low
        row: Row = {"scorer": name, "low_gain": low.mean(), "high_gain": high.mean()}
        row |= {"change": change.mean(), "change_sd": change.std()}
        rows.append(row | {"rises": (change > _EQUAL).mean(), "num_scenes": len(pairs)})
    return [rounded(row) for row in rows]


def _small(seed: int) -> Iterator[tuple[Scene, CameraProfile, int]]:
    """The small bundled test scenes, their camera, and a seed for each."""
    options = EnvOptions(scenes="bundled:small", split="test", resolution=SIZE)
    camera = options.make_camera()
    for number, scene in enumerate(options.load_scenes()):
        yield scene, camera, seed + number


def _state(scene: Scene, iso: float, offset: float) -> CameraSettings:
    """Settings `offset` stops above the incident light's exposure, at this gain."""
    at_one_second = CameraSettings(iso, 1.0, F_NUMBER)
    time = 2.0 ** (-at_one_second.log2_exposure - scene.ev100 + offset)
    return CameraSettings(iso, time, F_NUMBER)


def _scores(
    scene: Scene, states: list[CameraSettings], camera: CameraProfile, seed: int
) -> dict[str, np.ndarray]:
    """(S,) of each scorer, on noisy captures without blur."""
    captures = _described(scene, states, camera)
    images = prepare_scene(scene, camera).expose(states, seed=seed).clamp_(0.0, 1.0)
    return {name: scorer(images, captures).numpy() for name, scorer in available()[0].items()}


# -- good and bad captures ------------------------------------------------------------------------


def correlation(scenes: str, seed: int) -> dict[str, Any]:
    """A row per scorer and reference; ``scenes`` and ``states`` are their numbers."""
    env: Any = gym.make("ae_env/AutoExposure-v0", scenes=scenes, split="test").unwrapped
    # Score tables of the composite hold its parts: one table serves all six scorers.
    names = list(make_scorer("balanced").parts)
    samples: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for i, scene in enumerate(env.scenes):
        env.reset(seed=seed + i, options={"scene": i})
        episode, expected = env.episode(), env.score_table()
        scores = {name: expected.parts[name] for name in names} | {"balanced": expected.mean}
        closeness = _closeness(env, scene, episode.speed, episode.defocus, seed + i)
        for scorer in SCORERS:
            for target in ("rmse", "ssim", "exposed", f"aspect:{scorer}"):
                pair = _correlations(scores[scorer], closeness[target])
                samples.setdefault((scorer, target.partition(":")[0]), []).append(pair)
    rows = []
    for (scorer, target), pairs in samples.items():
        values = np.array([pair for pair in pairs if np.isfinite(pair[0])])
        row: Row = {"scorer": scorer, "reference": target, "num_scenes": len(values)}
        for name, column in zip(("spearman", "pearson"), values.T, strict=True):
            row |= {name: float(column.mean()), f"{name}_sd": float(column.std())}
        rows.append(row | {"positive": float((values[:, 0] > 0).mean())})
    return {"rows": rows, "scenes": len(env.scenes), "states": len(env.grid)}


def _closeness(
    env: Any, scene: Scene, speed: float, defocus: float, seed: int
) -> dict[str, np.ndarray]:
    """Closeness (64,) of every state's capture to the reference, by measure; higher is better."""
    camera, states = env.camera, env.grid.states
    native = replace(scene, box_factor=1)  # as if each pixel were one of the sensor's
    sharp = prepare_scene(native, camera)
    blurred = prepare_scene(native, camera, speed=speed, defocus=defocus)
    proper = reference_settings(scene.ev100)
    reference = _developed(sharp.expected(proper)[None], scene, camera)[0]
    captures = blurred.expose(states, seed=seed)
    expected = torch.stack([blurred.expected(s) for s in states])
    clean = recorded(expected, camera)
    exposed = recorded(torch.stack([sharp.expected(s) for s in states]), camera)
    pictures = _developed(captures, scene, camera)
    faultless = _developed(exposed, scene, camera)
    ratios = [2.0 ** (proper.log2_exposure - s.log2_exposure) for s in states]
    as_proper = [own * ratio for own, ratio in zip(expected, ratios, strict=True)]
    smeared = _developed(torch.stack(as_proper), scene, camera)

    luminance = reference.mean(axis=-1)
    bright = luminance >= np.quantile(luminance, 0.75)
    dark = luminance <= np.quantile(luminance, 0.25)
    difference = faultless - reference
    deviation = ((captures - clean).abs() / clean.clamp(min=DARK)).clamp_(max=1.0)
    below = clean < WHITE
    noise = (deviation * below).sum(dim=(1, 2, 3)) / below.sum(dim=(1, 2, 3))
    noise[below.float().mean(dim=(1, 2, 3)) < 0.1] = torch.nan
    rmse = -np.sqrt(((pictures - reference) ** 2).mean(axis=(1, 2, 3)))
    errors = {
        "brightness": np.abs(difference.mean(axis=(1, 2, 3))),
        "highlights": np.maximum(difference[:, bright], 0.0).mean(axis=(1, 2)),
        "shadows": np.maximum(-difference[:, dark], 0.0).mean(axis=(1, 2)),
        "noise": noise.numpy(),
        "sharpness": np.sqrt(((smeared - reference) ** 2).mean(axis=(1, 2, 3))),
        "balanced": -rmse,
    }
    ssim = [structural_similarity(p, reference, channel_axis=2, data_range=1.0) for p in pictures]
    aspects = {f"aspect:{name}": -error for name, error in errors.items()}
    near = np.abs(env.grid.ev100 - scene.ev100) <= NEAR_EV
    exposed_rmse = np.where(near, rmse, np.nan)
    return {"rmse": rmse, "ssim": np.array(ssim), "exposed": exposed_rmse, **aspects}


def _developed(signal: torch.Tensor, scene: Scene, camera: CameraProfile) -> np.ndarray:
    """(B, H, W, 3) float32 sRGB of captures (B, 4, H, W), clipped at white."""
    clipped = signal.clamp(max=1.0)
    pictures = develop(clipped, scene.white_balance, camera.colour_matrix)
    return pictures.permute(0, 2, 3, 1).numpy()


def _correlations(scores: np.ndarray, closeness: np.ndarray) -> tuple[float, float]:
    """Spearman's and Pearson's coefficient over the states whose closeness is known.

    0 where one of the two does not vary at all, NaN for fewer than three states.
    """
    known = np.isfinite(closeness)
    scores, closeness = scores[known], closeness[known]
    if len(scores) < 3:
        return np.nan, np.nan
    if np.ptp(scores) < 1e-12 or np.ptp(closeness) < 1e-12:
        return 0.0, 0.0
    spearman = float(spearmanr(scores, closeness).statistic)
    return spearman, float(pearsonr(scores, closeness).statistic)


# -- report ---------------------------------------------------------------------------------------


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """The report, of the results by question."""
    correlations, missing = results["correlation"], available()[1]
    named = {**results, "correlation": correlations["rows"]}
    rows = [{"measure": name, **row} for name, own in named.items() for row in own]
    best = [row for row in results["best_ev"] if row["median"] is not None]
    tables = {
        "gain": table(sorted(results["gain"], key=lambda row: -row["change"]), _GAIN),
        "best_exposure": table(sorted(best, key=lambda row: row["median"]), _BEST),
        "cost": pivot(
            results["milliseconds"],
            line=("scorer", "`{scorer}`"),
            columns="{size} x {size} [ms]",
            contents={"": "{ms:.1f} ± {ms_spread:.1f}"},
        ),
        "correlation": pivot(
            correlations["rows"],
            line=("scorer", "`{scorer}`"),
            columns="{reference}",
            contents={
                "Spearman": "{spearman:.2f} ± {spearman_sd:.2f}",
                "Pearson": "{pearson:.2f} ± {pearson_sd:.2f}",
                "positive": "{positive:.0%}",
            },
        ),
        "missing": table(
            [{"scorer": name, "why": why} for name, why in missing.items()],
            {"scorer": "`{scorer}`", "why": "{why}"},
        ),
    }
    more = {key: correlations[key] for key in ("scenes", "states")} | {"not_measured": missing}
    return Report(rows, tables, meta=more)


_GAIN: dict[str, Any] = {
    "scorer": "`{scorer}`",
    "ISO 100": "{low_gain:.3f}",
    "ISO 6400": "{high_gain:.3f}",
    "change": "{change:+.3f} ± {change_sd:.3f}",
    "scenes in which it rises": "{rises:.0%}",
}
_BEST: dict[str, Any] = {
    "scorer": "`{scorer}`",
    "median [EV]": "{median:+.1f}",
    "range": "{lowest:+.1f} to {highest:+.1f}",
    "scene by scene": lambda row: " ".join(
        "=" if v is None else f"{v:+g}" for v in row["by_scene"].values()
    ),
}
BENCHMARK = Benchmark(
    name="scorers",
    title="The scorers, measured",
    parts=parts,
    report=report,
    code=("simulator", "ae_env", "benchmarks/scorers", "benchmarks/harness"),
)
run = BENCHMARK.run
