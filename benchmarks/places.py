"""Real places: the incident light's posterior, other meters than a dome, and more training places.

``posterior`` fits `simulator.radiance.incident_light.POSTERIOR` on views of training places and
says what it covers elsewhere. ``receptors`` judges the same policies where the right exposure comes
from another meter. ``curve`` trains the regression agent on 5, 10, 20 and all training places.
"""

from __future__ import annotations

from contextlib import closing
from functools import partial
from typing import Any

import numpy as np
from scipy.stats import norm

from ae_env.scenes.bundled import add_layout
from ae_env.scenes.polyhaven import VIEWS as VIEWS_OF_POLYHAVEN
from ae_env.scenes.polyhaven import asset_views, dome_lux, polyhaven_scenes, split_assets
from ae_env.scenes.scene import SceneRequest, Split
from agents.evaluation.engine import evaluate, fit_policies
from agents.evaluation.intervals import score_interval
from agents.learning.training import load_config, train_agent
from agents.policy import PolicyContext
from agents.policy_names import PRETRAINED, make_policy
from agents.rollouts import make_envs
from benchmarks.agents import CONFIGS, SEEDS, best_compensations, changed_config
from benchmarks.harness import Part, Report, Row, benchmark, pivot, table
from benchmarks.isolated import ROOT
from simulator.camera import get_camera
from simulator.radiance.incident_light import features, receptor_reading
from simulator.radiance.light import mean_anchor
from simulator.radiance.maps import native_size
from simulator.settings import incident_ev100

CAMERA, RESOLUTION, VIEWS = get_camera("nikon_z6"), 64, 48
#: Weight of the ridge regression, chosen on training places that are left out in turn.
RIDGE = (10.0, 100.0, 300.0, 1000.0, 3000.0)
FOLDS, SHARES = 10, (0.5, 0.8, 0.9, 0.95)
PLACES, TUNED = (5, 10, 20, None), ("average:tuned", "centre_weighted:tuned", "matrix:tuned")


# -- the posterior ---------------------------------------------------------------------------------


def _seen(split: Split, views: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features of views, by how much their incident EV differs from the meter's, and places."""
    request = SceneRequest(split, CAMERA, RESOLUTION)
    known, gaps, places = [], [], []
    for scene in polyhaven_scenes(request, views=views):
        assert scene.illuminance is not None
        green, reflected = scene.light[1:3].mean(dim=0), scene.incident_light.reflected_ev100
        if reflected is None:
            continue
        known.append(features(green * mean_anchor(green), reflected))
        gaps.append(incident_ev100(scene.illuminance) - reflected)
        places.append(scene.group)
    return np.array(known), np.array(gaps), np.array(places)


def _fitted(known: np.ndarray, gaps: np.ndarray, ridge: float) -> tuple[np.ndarray, float]:
    """Weights and offset."""
    mean, spread = known.mean(axis=0), known.std(axis=0)
    scaled = (known - mean) / spread
    penalty = ridge * np.eye(scaled.shape[1])
    own = np.linalg.solve(scaled.T @ scaled + penalty, scaled.T @ (gaps - gaps.mean())) / spread
    return own, float(gaps.mean() - mean @ own)


def posterior(quick: bool) -> Row:
    """The fit, and how much of the views of each split it covers."""
    views = 4 if quick else VIEWS
    splits: tuple[Split, ...] = ("train", "validation", "test")
    seen: dict[str, Any] = {split: _seen(split, views) for split in splits}
    known, gaps, places = seen["train"]
    names = np.unique(places)
    folds = np.array_split(np.random.default_rng(0).permutation(len(names)), FOLDS)

    def left_out(ridge: float) -> np.ndarray:
        """Errors on training places that the fit has not seen."""
        error = np.zeros(len(gaps))
        for fold in folds:
            out = np.isin(places, names[fold])
            weights, offset = _fitted(known[~out], gaps[~out], ridge)
            error[out] = gaps[out] - known[out] @ weights - offset
        return error

    ridge = min(RIDGE, key=lambda r: float(np.square(left_out(r)).mean()))
    weights, offset = _fitted(known, gaps, ridge)
    errors = {"train, left out": left_out(ridge)}
    for split in ("validation", "test"):
        errors[split] = seen[split][1] - seen[split][0] @ weights - offset
    chosen = np.concatenate([errors["train, left out"], errors["validation"]])
    spread = float(np.quantile(np.abs(chosen), 0.8) / norm.ppf(0.9))
    rows = []
    for name, error in errors.items():
        split = name.partition(",")[0]
        covered = {
            f"{s:.0%}": float((abs(error) < norm.ppf(0.5 + s / 2) * spread).mean()) for s in SHARES
        }
        explained = 1.0 - np.square(error).mean() / seen[split][1].var()
        row: Row = {"views of": name, "places": len(np.unique(seen[split][2])), "views": len(error)}
        rows.append(
            {
                **row,
                "rms [EV]": float(np.sqrt(np.square(error).mean())),
                "explained": float(explained),
                **covered,
            }
        )
    return {
        "weights": weights.round(3).tolist(),
        "offset": round(offset, 3),
        "spread": round(spread, 2),
        "ridge": ridge,
        "rows": rows,
    }


# -- other receptors -------------------------------------------------------------------------------


def _context() -> PolicyContext:
    with closing(make_envs({"split": "test", "resolution": 64}, num_envs=1, frames=1)) as envs:
        return PolicyContext.from_envs(envs)


def _comparators(quick: bool) -> dict[str, Any]:
    """Light meters, tuned and compensated on the training places."""
    context = _context()
    policies: dict[str, Any] = {
        name: make_policy(name, context) for name in TUNED[: 1 if quick else 3]
    }
    fit_policies(policies, load_config(CONFIGS["regression"]).environment)
    if not quick:
        for name, stops in best_compensations(context, 0, 2).items():
            own = f"{name}?compensation={stops:g}"
            policies[own] = make_policy(own, context)
    return policies


#: Light meters in a panorama: lux of a flat receptor that asks for the same exposure.
RECEPTORS: dict[str, Any] = {
    "dome": dome_lux,
    "flat": partial(receptor_reading, dome=False),
    "dome, C 250": receptor_reading,
}


def receptors(quick: bool) -> list[Row]:
    """Scores of the same policies where the right exposure is another meter's."""
    policies, context = _comparators(quick), _context()
    for agent in ("regression", "ppo"):
        seeds = SEEDS[: 1 if quick else None]
        policies[agent] = [make_policy(f"{agent}:{PRETRAINED / agent}-{s}", context) for s in seeds]
    size, views = native_size(RESOLUTION), 1 if quick else VIEWS_OF_POLYHAVEN
    rows = []
    for receptor, read in RECEPTORS.items():
        scenes = [
            add_layout(view).resized(RESOLUTION)
            for asset in split_assets("polyhaven", "test")
            for view in asset_views(asset, CAMERA, size=size, views=views, read=read)
        ]
        gap = [s.ev100 - (s.incident_light.reflected_ev100 or s.ev100) for s in scenes]
        options = {"scenes": scenes, "split": "test", "resolution": RESOLUTION}
        result = evaluate(policies, options, episodes_per_scene=1 if quick else 4)
        for policy in policies:
            found = score_interval(*result.group_gains(policy))
            own = {"receptor": receptor, "policy": policy, "score": found.value}
            rows.append(own | {"ci95": found.pair, "gap": float(np.median(gap))})
    return rows


# -- the learning curve ----------------------------------------------------------------------------


def curve(places: int | None, quick: bool) -> Row:
    """The regression agent, one seed, trained on views of so many places, in unseen ones."""
    scenes = "mixed" if places is None else f"mixed:{places}"
    training = {"frames": 2_000} if quick else {}
    config = changed_config(load_config(CONFIGS["regression"]), {"scenes": scenes}, training)
    out = ROOT / "runs" / ("bench_places_quick" if quick else "bench_places") / f"of-{places}"
    train_agent(config, out)  # continues where it was stopped
    context = _context()
    policies = {"regression": make_policy(f"regression:{out}", context)}
    row: Row = {"places": places or len({a.place for a in split_assets("polyhaven", "train")})}
    for split in ("validation", "test"):
        options = {"scenes": "polyhaven", "split": split, "resolution": RESOLUTION}
        result = evaluate(policies, options, episodes_per_scene=1 if quick else 4)
        found = score_interval(*result.group_gains("regression"))
        row |= {split: found.value, f"{split}_ci95": found.pair}
    return row


def parts(seed: int, quick: bool) -> list[Part]:
    """The posterior, the receptors, and a training for each number of places."""
    curves = [Part(f"curve {n}", curve, {"places": n}, threads=1) for n in PLACES]
    return [Part("posterior", posterior), Part("receptors", receptors), *curves]


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """Tables of ``docs/results/places.md``."""
    found = results.pop("posterior")
    covers, judged = found.pop("rows"), results.pop("receptors")
    for row in judged:
        row["rank"] = 1 + sum(
            r["score"] > row["score"] for r in judged if r["receptor"] == row["receptor"]
        )
    curves = list(results.values())
    shares = "".join(f" | {s:.0%} = {{{s:.0%}:.3f}}" for s in SHARES)
    seen = "views of = {views of} | places = {places} | views = {views} | rms [EV] = {rms [EV]:.2f}"
    tables = {
        "posterior": table(covers, seen + " | explained = {explained:.2f}" + shares),
        "receptors": pivot(
            judged, "policy = {policy}", "{receptor}", "score = {score:.3f} ({rank})"
        ),
        "curve": table(
            curves, "places = {places} | validation = {validation:.3f} | test = {test:.3f}"
        ),
    }
    return Report([*covers, *judged, *curves], tables, meta={"posterior": found})


run = benchmark("places", parts, report)
