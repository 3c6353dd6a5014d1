"""Cost and taste of the scorers, and whether they tell good captures from bad ones.

*Gain* and *best exposure*: noisy captures without blur of the small bundled test scenes.
*Correlation*: for every bundled test scene, with a motion and a defocus drawn as in an episode, the
64 states are simulated and compared with the reference: the same scene noise-free, blur-free and
exposed for its incident light. Each pixel carries the noise of one sensor pixel.
"""

import functools
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch
from scipy.stats import pearsonr, spearmanr

import ae_env  # noqa: F401  registers the environment
from ae_env.options import EnvOptions
from ae_env.scenes import Scene, reference_settings
from ae_env.scorers import Captures, CompositeScorer, list_scorers, make_scorer
from ae_env.scorers.captures import SceneCaptures, prepare_scene
from benchmarks import harness
from benchmarks.fidelity.models import equal_exposure
from benchmarks.harness import Part, Report, Row, benchmark, pivot, ssim, table
from benchmarks.isolated import timed
from simulator import CameraProfile, CameraSettings, develop
from simulator.capture.sensor import clip_and_quantise

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
    scenes = "bundled:small" if quick else "bundled"
    return [
        Part("milliseconds", milliseconds, {"repeats": 1 if quick else 7}),
        Part("best_ev", best_ev, {"seed": seed}),
        Part("gain", gain, {"seed": seed}),
        Part("correlation", correlation, {"scenes": scenes, "seed": seed}),
    ]


@functools.cache
def available() -> tuple[dict[str, CompositeScorer], dict[str, str]]:
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
    rows = []
    for size in SIZES if repeats > 1 else SIZES[:1]:
        options = EnvOptions(scenes="bundled:small", split="test", resolution=size)
        scene, camera, states = options.load_scenes()[0], options.make_camera(), options.make_grid()
        captures = _described(scene, list(states), camera)
        images = prepare_scene(scene, camera).expose(list(states), seed=0).clamp_(0.0, 1.0)
        look = captures.white_balance, captures.colour_matrices[0]
        tasks: dict[str, Callable[[], Any]] = {DEVELOP: partial(develop, images, *look)}
        tasks |= {n: partial(scorer, images, captures) for n, scorer in available()[0].items()}
        for name, task in tasks.items():
            times = [1e3 * timed(task) for _ in range(repeats + 1)][1:]
            row = {"scorer": name, "size": size, "ms": float(np.median(times))}
            rows.append(row | {"ms_spread": (max(times) - min(times)) / 2})
    return rows


def _described(scene: Scene, states: list[CameraSettings], camera: CameraProfile) -> Captures:
    zeros, scenes = np.zeros(len(states)), [scene] * len(states)
    return SceneCaptures(camera, states).of(scenes, speed=zeros, defocus=zeros, gain=zeros + 1.0)


# -- what they like -------------------------------------------------------------------------------


def best_ev(seed: int) -> list[Row]:
    """A row per scorer: in how many stops above incident light each scene scores best.

    Of equal exposures it is the nearest to the incident light's; None where all are equal.
    """
    best: dict[str, list[float]] = {}
    for name, scores in _small(seed, [(100.0, offset) for offset in OFFSETS]):
        equal = OFFSETS[scores >= scores.max() - _EQUAL]
        nearest = float(equal[np.argmin(np.abs(equal))])
        best.setdefault(name, []).extend([nearest] * int(np.ptp(scores) >= _EQUAL))
    rows = []
    for name, known in best.items():
        row: Row = {"scorer": name, "median": float(np.median(known)) if known else None}
        rows.append(row | {"lowest": min(known, default=None), "highest": max(known, default=None)})
    return rows


def gain(seed: int) -> list[Row]:
    """A row per scorer: its change as the gain rises by 6 stops and the time falls by as many.

    Each pixel carries the noise of one pixel of the sensor, whatever the scene was averaged from.
    """
    found: dict[str, list[np.ndarray]] = {}
    states = [(100.0, 0.0), (100.0 * 2.0**STOPS, 0.0)]
    for name, scores in _small(seed, states, native=True):
        found.setdefault(name, []).append(scores.astype(np.float64))
    rows = []
    for name, pairs in found.items():
        low, high = np.array(pairs).T
        change = high - low
        row: Row = {"scorer": name, "low_gain": low.mean(), "high_gain": high.mean()}
        row |= {"change": change.mean(), "change_sd": change.std()}
        rows.append(row | {"rises": (change > _EQUAL).mean(), "num_scenes": len(pairs)})
    return rows


def _small(
    seed: int, taken: list[tuple[float, float]], *, native: bool = False
) -> Iterator[tuple[str, np.ndarray]]:
    """Scorer and scores (S,) of noisy captures without blur of the small test scenes.

    `taken`: ISOs, and exposures above the incident light's [EV]; `native`: pixels are the sensor's.
    """
    options = EnvOptions(scenes="bundled:small", split="test", resolution=SIZE)
    camera = options.make_camera()
    for number, scene in enumerate(options.load_scenes()):
        scene = replace(scene, box_factor=1) if native else scene
        rights = [(iso, reference_settings(scene.ev100 - ev)) for iso, ev in taken]
        states = [equal_exposure(right, iso, F_NUMBER) for iso, right in rights]
        captures = _described(scene, states, camera)
        images = prepare_scene(scene, camera).expose(states, seed=seed + number).clamp_(0.0, 1.0)
        for name, scorer in available()[0].items():
            yield name, scorer(images, captures).numpy()


# -- good and bad captures ------------------------------------------------------------------------


def correlation(scenes: str, seed: int) -> dict[str, Any]:
    """A row per scorer and reference; ``scenes`` and ``states`` are their numbers."""
    env: Any = gym.make("ae_env/AutoExposure-v0", scenes=scenes, split="test").unwrapped
    # Score tables of the composite hold its parts: one table serves all six scorers.
    found: list[Row] = []
    for i, scene in enumerate(env.scenes):
        env.reset(seed=seed + i, options={"scene": i})
        episode, expected = env.episode(), env.score_table()
        scores = {**expected.parts, "balanced": expected.mean}
        closeness = _closeness(env, scene, episode.speed, episode.defocus, seed + i)
        for scorer, target in product(SCORERS, ("rmse", "ssim", "exposed", "aspect")):
            near = closeness[f"aspect:{scorer}" if target == "aspect" else target]
            known = np.isfinite(near)
            row: Row = {"scorer": scorer, "reference": target}
            for name, measure in (("spearman", spearmanr), ("pearson", pearsonr)):
                pair = scores[scorer][known], near[known]
                row[name] = harness.correlation(*pair, measure) if known.sum() > 2 else np.nan
            found.append(row)
    rows = []
    known_pairs = pd.DataFrame(found).dropna().groupby(["scorer", "reference"], sort=False)
    for (one, reference), own in known_pairs:
        row = {"scorer": one, "reference": reference, "num_scenes": len(own)}
        for key in ("spearman", "pearson"):
            row |= {key: own[key].mean(), f"{key}_sd": own[key].std(ddof=0)}
        rows.append(row | {"positive": float((own["spearman"] > 0).mean())})
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

    def developed(signal: torch.Tensor) -> np.ndarray:
        pictures = develop(signal.clamp(max=1.0), scene.white_balance, camera.colour_matrix)
        return pictures.permute(0, 2, 3, 1).numpy()

    reference = developed(sharp.expected(proper)[None])[0]
    captures = blurred.expose(states, seed=seed)
    expected = torch.stack([blurred.expected(s) for s in states])
    clean, pictures = clip_and_quantise(expected, camera), developed(captures)
    exposed = clip_and_quantise(torch.stack([sharp.expected(s) for s in states]), camera)
    ratios = torch.tensor([2.0 ** (proper.log2_exposure - s.log2_exposure) for s in states])
    smeared = developed(expected * ratios[:, None, None, None])

    luminance = reference.mean(axis=-1)
    bright = luminance >= np.quantile(luminance, 0.75)
    dark = luminance <= np.quantile(luminance, 0.25)
    difference = developed(exposed) - reference
    deviation = ((captures - clean).abs() / clean.clamp(min=DARK)).clamp_(max=1.0)
    below = clean < WHITE
    noise = (deviation * below).sum(dim=(1, 2, 3)) / below.sum(dim=(1, 2, 3))
    noise[below.float().mean(dim=(1, 2, 3)) < 0.1] = torch.nan
    rmse = np.sqrt(((pictures - reference) ** 2).mean(axis=(1, 2, 3)))
    errors = {
        "brightness": np.abs(difference.mean(axis=(1, 2, 3))),
        "highlights": np.maximum(difference[:, bright], 0.0).mean(axis=(1, 2)),
        "shadows": np.maximum(-difference[:, dark], 0.0).mean(axis=(1, 2)),
        "noise": noise.numpy(),
        "sharpness": np.sqrt(((smeared - reference) ** 2).mean(axis=(1, 2, 3))),
        "balanced": rmse,
    }
    similar = [ssim(p, reference, channel_axis=2) for p in pictures]
    near = np.abs(env.grid.ev100 - scene.ev100) <= NEAR_EV
    found = {f"aspect:{name}": -error for name, error in errors.items()}
    exposures = np.where(near, -rmse, np.nan)
    return found | {"rmse": -rmse, "ssim": np.array(similar), "exposed": exposures}


# -- report ---------------------------------------------------------------------------------------

_GAIN = """scorer = `{scorer}` | ISO 100 = {low_gain:.3f} | ISO 6400 = {high_gain:.3f} |
change = {change:+.3f} ± {change_sd:.3f} | scenes in which it rises = {rises:.0%}"""
_BEST = """scorer = `{scorer}` | median [EV] = {median:+.1f} |
range = {lowest:+.1f} to {highest:+.1f}"""
_CORRELATION = """Spearman = {spearman:.2f} ± {spearman_sd:.2f} |
Pearson = {pearson:.2f} ± {pearson_sd:.2f} | positive = {positive:.0%}"""


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    correlations, missing = results["correlation"], available()[1]
    named = {**results, "correlation": correlations["rows"]}
    rows = [{"measure": name, **row} for name, own in named.items() for row in own]
    best = [row for row in results["best_ev"] if row["median"] is not None]
    why = [{"scorer": name, "why": text} for name, text in missing.items()]
    line = "scorer = `{scorer}`"
    tables = {
        "gain": table(sorted(results["gain"], key=lambda row: -row["change"]), _GAIN),
        "best_exposure": table(sorted(best, key=lambda row: row["median"]), _BEST),
        "cost": pivot(
            results["milliseconds"], line, "{size} x {size} [ms]", "{ms:.1f} ± {ms_spread:.1f}"
        ),
        "correlation": pivot(correlations["rows"], line, "{reference}", _CORRELATION),
        "missing": table(why, f"{line} | why = {{why}}"),
    }
    more = {key: correlations[key] for key in ("scenes", "states")} | {"not_measured": missing}
    return Report(rows, tables, meta=more)


run = benchmark("scorers", parts, report)
