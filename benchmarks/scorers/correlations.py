"""Do the scorers tell good captures from bad ones? Their correlation with a reference picture.

For every bundled test scene, with a motion and a defocus drawn as in an episode, the 64 states are
simulated and compared with the reference: the same scene noise-free, blur-free and exposed for its
incident light. Each pixel carries the noise of one sensor pixel.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.stats import pearsonr, spearmanr
from skimage.metrics import structural_similarity

from ae_env.episodes.core import EpisodeCore
from ae_env.scenes import Scene, reference_settings
from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import prepare_scene
from benchmarks.markdown import table
from simulator import CameraProfile, develop
from simulator.capture.sensor import clip_and_quantise

SCORERS = ("brightness", "highlights", "shadows", "noise", "sharpness", "balanced")
#: What each scorer alone is about, measured on captures with no other fault than that one.
ASPECTS = {
    "brightness": "mean of the developed picture against the reference's, no noise or blur",
    "highlights": "excess over the reference in its brightest quarter, no noise or blur",
    "shadows": "shortfall against the reference in its darkest quarter, no noise or blur",
    "noise": "mean relative deviation from the noise-free capture over the pixels below white; "
    "states with fewer than a tenth of those are left out",
    "sharpness": "RMSE of the blurred against the sharp picture, both well exposed, no noise",
    "balanced": "RMSE of the developed capture, all faults together",
}
#: Below this signal [of white] a relative deviation means nothing: the scale of black.
DARK = 2.0**-10
#: Noise on samples above this is cut off by the clip.
WHITE = 0.97
#: States this close to the incident light's EV are well exposed.
NEAR_EV = 0.75


def rows(core: EpisodeCore, seed: int) -> list[dict[str, Any]]:
    """A row per scorer and reference."""
    # Score tables of the composite hold its parts: one table serves all six scorers.
    names = list(make_scorer("balanced").parts)
    samples: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for i in range(len(core.scenes)):
        core.begin(np.array([0]), [np.random.default_rng([seed, i])], [{"scene": i}])
        episode, table = core.episode(0), core.score_table(0)
        scores = {name: table.parts[name] for name in names} | {"balanced": table.mean}
        closeness = _closeness(core, core.scenes[i], episode.speed, episode.defocus, seed + i)
        for scorer in SCORERS:
            for target in ("rmse", "ssim", "exposed", f"aspect:{scorer}"):
                pair = _correlations(scores[scorer], closeness[target])
                samples.setdefault((scorer, target.partition(":")[0]), []).append(pair)
    return [_row(scorer, target, pairs) for (scorer, target), pairs in samples.items()]


def _closeness(
    core: EpisodeCore, scene: Scene, speed: float, defocus: float, seed: int
) -> dict[str, np.ndarray]:
    """Closeness (64,) of every state's capture to the reference, by measure; higher is better."""
    camera, states = core.camera, core.grid.states
    native = replace(scene, box_factor=1)  # as if each pixel were one of the sensor's
    sharp = prepare_scene(native, camera)
    blurred = prepare_scene(native, camera, speed=speed, defocus=defocus)
    proper = reference_settings(scene.ev100)
    reference = _developed(sharp.expected(proper)[None], scene, camera)[0]
    captures = blurred.expose(states, seed=seed)
    expected = torch.stack([blurred.expected(s) for s in states])
    clean = clip_and_quantise(expected, camera)
    exposed = clip_and_quantise(torch.stack([sharp.expected(s) for s in states]), camera)
    pictures = _developed(captures, scene, camera)
    faultless = _developed(exposed, scene, camera)
    smeared = _developed(torch.stack([_at(blurred, s, proper) for s in states]), scene, camera)

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
    near = np.abs(core.grid.ev100 - scene.ev100) <= NEAR_EV
    exposed_rmse = np.where(near, rmse, np.nan)
    return {"rmse": rmse, "ssim": np.array(ssim), "exposed": exposed_rmse, **aspects}


def _at(prepared: Any, state: Any, proper: Any) -> torch.Tensor:
    """Light with the blur of `state` and the exposure of `proper`."""
    ratio = 2.0 ** (proper.log2_exposure - state.log2_exposure)
    return prepared.expected(state) * ratio


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


def _row(scorer: str, target: str, pairs: list[tuple[float, float]]) -> dict[str, Any]:
    values = np.array(pairs)
    values = values[np.isfinite(values[:, 0])]
    return {
        "scorer": scorer,
        "reference": target,
        "spearman": values[:, 0].mean(),
        "spearman_sd": values[:, 0].std(),
        "pearson": values[:, 1].mean(),
        "pearson_sd": values[:, 1].std(),
        "positive": float((values[:, 0] > 0).mean()),
        "num_scenes": len(values),
    }


def section(rows: list[dict[str, Any]], states: int, scenes: int) -> str:
    """The part of the page that shows `rows`."""
    known = {(row["scorer"], row["reference"]): row for row in rows}

    def cell(scorer: str, target: str, kind: str) -> str:
        row = known[scorer, target]
        return f"{row[kind]:.2f} ± {row[f'{kind}_sd']:.2f}"

    columns = (
        ("rmse", "spearman"),
        ("rmse", "pearson"),
        ("ssim", "spearman"),
        ("exposed", "spearman"),
        ("aspect", "spearman"),
        ("aspect", "pearson"),
    )
    head = ["scorer", "whole picture, -RMSE: Spearman", "Pearson", "whole picture, SSIM: Spearman"]
    head += ["well exposed, -RMSE: Spearman", "own aspect: Spearman", "Pearson"]
    body = []
    for name in SCORERS:
        cells = [cell(name, target, kind) for target, kind in columns]
        body.append([f"`{name}`", *cells, f"{known[name, 'aspect']['positive']:.0%}"])
    aspects = [[f"`{name}`", text] for name, text in ASPECTS.items()]
    return "\n".join(
        [
            f"Over the {states} states of each of {scenes} bundled test scenes, with motion and "
            "defocus drawn as in an episode: the correlation of the default scorer and its parts "
            "with the closeness of the developed capture to the reference, the same scene "
            "noise-free, blur-free and exposed for its incident light. Mean and standard deviation "
            "over the scenes.",
            "",
            "*Whole picture*: all faults together, as minus the RMSE of the sRGB values and as "
            "SSIM. *Own aspect*: minus an error on captures that have no other fault, because a "
            "scorer of one aspect should not follow the others: bright shadows cost blown "
            f"highlights. *Well exposed*: whole picture over the states within {NEAR_EV:g} EV of "
            "the incident light only, where the split between the controls decides.",
            "",
            table([*head, "scenes with a positive one"], body),
            "",
            table(["scorer", "error of its own aspect"], aspects),
        ]
    )
