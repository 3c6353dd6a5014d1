"""Real places: the posterior of unknown light, other receptors than a dome, more training places.

``posterior`` says what `simulator.radiance.incident_light.POSTERIOR` covers in views that it was
not fitted on. ``receptors`` judges the same policies where another receptor tells the right
exposure. ``curve`` trains the regression agent on 5 to all training places, and on all without one
thing or another: trainings lie under ``runs/bench_places``.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from scipy.stats import norm
from torch import Tensor

from ae_env.scenes.bundled import add_layout
from ae_env.scenes.polyhaven import VIEWS, asset_views, dome_lux, polyhaven_scenes, split_assets
from ae_env.scenes.scene import Scene, SceneRequest
from agents.evaluation.engine import evaluate, fit_policies
from agents.evaluation.intervals import rank, score_interval
from agents.learning.networks import StateHead
from agents.learning.training import load_config, train_agent
from agents.policy_names import make_policy, training_seeds
from benchmarks.agents import CONFIGS, changed_config, compensated, context_of
from benchmarks.harness import Part, Report, Row, benchmark, pivot, side_by_side, table
from benchmarks.isolated import ROOT
from simulator import develop, exposure_ratio, get_camera
from simulator.radiance.incident_light import LARGEST_GAP, receptor_reading
from simulator.radiance.light import reference_settings
from simulator.raw.develop import srgb_encode

CAMERA, RESOLUTION = get_camera("nikon_z6"), 64
#: Views of a map that tell what the posterior covers, and the intervals that are looked at.
MANY, SHARES = 16, (0.5, 0.8, 0.9, 0.95)
METERS = ("average:tuned", "centre_weighted:tuned", "matrix:tuned", "average:P")
#: Receptors in a panorama: lux of a flat receptor that asks for the same exposure.
RECEPTORS: dict[str, Any] = {
    "dome, C = 340": dome_lux,
    "flat, C = 250": partial(receptor_reading, dome=False),
    "dome, C = 250": receptor_reading,
}
#: Where a receptor is: a panorama of luminances, and azimuth and pitch that it points at [degrees].
Place = tuple[np.ndarray, float, float]
#: At the right exposure a view counts as white with more than this share of its pixels above white,
#: and as black with a mean of green below the other.
WHITE, BLACK = 0.15, 0.01
#: Trainings of the regression agent: what differs in the environment and in the hyperparameters.
VARIANTS: dict[str, tuple[Row, Row]] = {
    **{f"{n} places": ({"scenes": f"mixed:{n}"}, {}) for n in (5, 10, 20)},
    "30 places, all": ({}, {}),
    "no loss of the right exposure": ({}, {"ev_coef": 0.0}),
    "no sensors": ({"sensors": False}, {}),
    "drawn scenes alone": ({"scenes": "bundled:large"}, {}),
    "no absolute luminance": ({}, {}),
    "a linear layer, no head": ({}, {}),
}


def _linear(head: StateHead, features: Tensor, *others: Any) -> Tensor:
    scores = head.from_features(features)  # of as many units as there are states
    return torch.stack([scores, torch.zeros_like(scores)], dim=2)


#: What the network of a variant has in place of a function of `agents.learning.networks`.
REPLACED: dict[str, tuple[str, Any]] = {
    "no absolute luminance": ("_absolute", lambda signal, _: signal.clamp(2**-12).log2() / 8.0),
    "a linear layer, no head": ("StateHead.forward", _linear),
}
#: Views of the contact sheet, and packed pixels a side of each.
SHOWN, SIZE = 12, 256
#: The picture of the page of the incident light; a quick run leaves it alone.
IMAGE = ROOT / "docs" / "images" / "incident_light.webp"


def posterior(split: Any, quick: bool) -> Row:
    """Root mean square errors, and shares of the views whose light lies within an interval."""
    request, rows = SceneRequest(split, CAMERA, RESOLUTION), []
    for scene in polyhaven_scenes(request, views=4 if quick else MANY):
        known, told = scene.incident_light, replace(scene, illuminance=None).incident_light
        if (meter := told.reflected_ev100) is not None:
            errors = known.ev100 - told.ev100, known.ev100 - meter, scene.ev100 - meter
            right = scene.ev100 - told.right_ev100.mean()
            rows.append((scene.group, errors[0] / told.spread, *errors, right))
    names = ("place", "deviation", "light", "light, meter", "right, meter", "right")
    frame = pd.DataFrame(rows, columns=names)
    result: Row = {"split": split, "places": frame["place"].nunique(), "views": len(frame)}
    result |= {name: float(frame[name].pow(2).mean() ** 0.5) for name in names[2:]}
    for share in SHARES:
        within = frame["deviation"].abs() < norm.ppf(0.5 + share / 2)
        result[f"{share:.0%}"] = float(within.mean())
    return result


def views_of_test_places(count: int = VIEWS) -> Iterator[tuple[Scene, Place]]:
    """The views of `polyhaven`, 256 x 256, and where the receptor is that tells their light."""
    places: list[Place] = []

    def read(*place: Any) -> float:
        places[:] = [place]
        return dome_lux(*place)

    for asset in split_assets("polyhaven", "test"):
        for view in asset_views(asset, CAMERA, size=SIZE, views=count, read=read):
            yield add_layout(view), places[0]


def read_by(receptor: str, view: Scene, place: Place) -> Scene:
    """The same view, whose light another receptor tells."""
    assert view.illuminance is not None
    ratio = RECEPTORS[receptor](*place) / dome_lux(*place)
    return replace(view, illuminance=view.illuminance * ratio)


def _policies(seed: int, quick: bool) -> dict[str, Any]:
    """Meters and agents, all of which learnt under the dome."""
    context, names = context_of({"resolution": RESOLUTION}), list(METERS[: 1 if quick else None])
    if not quick:
        names += compensated(context, seed)
    policies: dict[str, Any] = {name: make_policy(name, context) for name in names}
    fit_policies(policies, load_config(CONFIGS["regression"]).environment, seed=seed)
    for agent in CONFIGS:
        policies[agent] = [make_policy(name, context) for name in training_seeds(agent)]
    return policies


def receptors(seed: int, quick: bool) -> list[Row]:
    """A row for each receptor and policy, and one for the right exposures of each receptor."""
    policies, rows = _policies(seed, quick), list[Any]()
    every = views_of_test_places(1 if quick else VIEWS)
    views = [(view.resized(RESOLUTION), place) for view, place in every]
    for receptor in RECEPTORS:
        scenes = [read_by(receptor, *own) for own in views]
        facts = pd.DataFrame(map(_right_exposure, scenes))
        row: Row = {"receptor": receptor, "views": len(scenes), "above": facts["above"].median()}
        rows.append(row | {name: facts[name].mean() for name in ("moved", "white", "black")})
        options = {"scenes": scenes, "split": "test", "resolution": RESOLUTION}
        result = evaluate(policies, options, episodes_per_scene=1 if quick else 4, seed=seed)
        gains = {name: result.group_gains(name) for name in policies}
        found = rank({name: own for name, (own, _) in gains.items()}, gains[METERS[0]][1])
        rows += found.assign(receptor=receptor).to_dict("records")
    return rows


def _right_exposure(scene: Scene) -> Row:
    """How far above an average meter's it is [EV], before it is bounded, and what is shown."""
    light, settings = scene.incident_light, reference_settings(scene.ev100)
    signal = (scene.light * exposure_ratio(scene.reference, settings)).clamp(max=1.0)
    above = None if light.reflected_ev100 is None else light.reflected_ev100 - light.ev100
    row: Row = {"above": above, "moved": above is not None and abs(above) > LARGEST_GAP}
    row["white"] = float((signal == 1.0).any(dim=0).float().mean()) > WHITE
    return row | {"black": float(signal[1:3].mean()) < BLACK}


def curve(variant: str, seed: int, quick: bool) -> Row:
    """The regression agent, one seed, trained as `VARIANTS` says."""
    environment, training = VARIANTS[variant]
    for name, own in filter(None, [REPLACED.get(variant)]):
        patch(f"agents.learning.networks.{name}", own).start()  # for this process
    training = training | {"seed": seed} | ({"frames": 2_000} if quick else {})
    config = changed_config(load_config(CONFIGS["regression"]), environment, training)
    out = ROOT / "runs" / f"bench_places{'_quick' * quick}" / re.sub(r"\W+", "_", variant)
    options = {"resolution": RESOLUTION, "sensors": environment.get("sensors", True)}
    agent = make_policy(f"regression:{train_agent(config, out)}", context_of(options))
    row, own = Row(training=variant), re.findall(r"mixed:(\d+)", environment.get("scenes", ""))
    for split in ("train", "validation", "test"):
        request: Any = SceneRequest(split, CAMERA, RESOLUTION)
        assets = split_assets("polyhaven", split, int(own[0]) if own and split == "train" else None)
        given = {"scenes": polyhaven_scenes(request, assets=assets), **options}
        result = evaluate({"own": agent}, given, episodes_per_scene=1 if quick else 4, seed=seed)
        found = score_interval(*result.group_gains("own"))
        row |= {split: found.value, f"{split}_ci95": found.pair}
    return row


def pictures(seed: int) -> tuple[Figure, Figure]:
    """The oracle's frames of some views, and the receptors where they disagree most of these."""
    count = VIEWS * len(split_assets("polyhaven", "test"))
    drawn = np.random.default_rng(seed).choice(count, SHOWN, replace=False)
    views = [own for number, own in enumerate(views_of_test_places()) if number in drawn]
    options: Any = {"scenes": [view for view, _ in views], "split": "test", "resolution": SIZE}
    options |= {"observation": "linear", "render_mode": "rgb_array"}
    env: Any = gym.make("ae_env/AutoExposure-v0", **options)
    frames = []
    for index, (view, _) in enumerate(views):
        env.reset(seed=seed, options={"scene": index})
        raw = env.step(env.unwrapped.score_table().oracle)[0]["raw"]
        title = f"{view.scene_id}: {(raw >= 1.0).any(axis=0).mean():.0%}"
        frames.append((title, torch.from_numpy(env.render().copy()).permute(2, 0, 1)))
    sheet = side_by_side(*(dict(frames[i : i + 4]) for i in range(0, SHOWN, 4)))
    apart = [abs(np.log2(receptor_reading(*p, dome=False) / dome_lux(*p))) for _, p in views]
    return sheet, receptor_figure(*views[int(np.argmax(apart))])


def receptor_figure(view: Scene, place: Place) -> Figure:
    """Both receptors, the dome over a panorama, and a view at the exposures that they ask for."""
    panorama, azimuth, pitch = place
    figure = Figure(figsize=(9.0, 5.6), dpi=100, layout="constrained")
    polar: Any = {"A": {"projection": "polar", "theta_offset": np.pi / 2}}
    axes = figure.subplot_mosaic("ABB;CDE", per_subplot_kw=polar)
    angles = np.linspace(0.0, 2.0 * np.pi, 361)
    axes["A"].plot(angles, (1.0 + np.cos(angles)) / 2.0, label="dome, (1 + cos) / 2")
    axes["A"].plot(angles, np.maximum(np.cos(angles), 0.0), "--", label="flat, cos")
    axes["A"].legend(fontsize=7, loc="lower center")
    light = torch.from_numpy(panorama / np.quantile(panorama, 0.95)).clamp(0.0, 1.0)
    shown, titles = {"B": srgb_encode(light)}, {"A": "weight of light by its angle to the camera"}
    titles["B"] = "weight of light for a dome that points from the subject to the camera"
    asked = {"average meter": view.incident_light.reflected_ev100 or view.ev100}
    for receptor in ("flat, C = 250", "dome, C = 340"):
        asked[receptor] = read_by(receptor, view, place).incident_light.ev100
    for name, (title, ev100) in zip("CDE", asked.items(), strict=True):
        signal = view.light * exposure_ratio(view.reference, reference_settings(ev100))
        look = view.white_balance, CAMERA.colour_matrix
        shown[name] = develop(signal.clamp(max=1.0)[None], *look)[0]
        titles[name] = f"{title}: EV100 {ev100:.1f}"
    for name, picture in shown.items():
        box = (-180, 180, -90, 90) if name == "B" else None
        axes[name].imshow(picture.permute(1, 2, 0).numpy(), extent=box)
        axes[name].set_axis_off()
    across, up = np.meshgrid(np.linspace(-180, 180, 361), np.linspace(-90, 90, 181))
    x, y, tilt = (np.radians(v) for v in (across - azimuth, up, pitch))
    cosine = np.cos(y) * np.cos(tilt) * np.cos(x) + np.sin(y) * np.sin(tilt)
    lines = axes["B"].contour(across, up, (1.0 + cosine) / 2.0, (0.25, 0.5, 0.75, 0.95))
    axes["B"].clabel(lines, fontsize=7)
    for name, title in titles.items():
        axes[name].set_title(title, fontsize=9)
    return figure


def parts(seed: int, quick: bool, part: str | None = None) -> list[Part]:
    found = [Part(f"posterior {s}", posterior, {"split": s}) for s in ("validation", "test")]
    found.append(Part("receptors", receptors))
    found += [Part(f"curve {own}", curve, {"variant": own}, threads=1) for own in VARIANTS]
    return [own for own in found if part is None or own.name.startswith(part)]


_COVERED = """views of = {split} places | places = {places} | views = {views} |
light: meter's rule [EV] = {light, meter:.2f} | light: posterior = {light:.2f} |
right exposure: meter's rule = {right, meter:.2f} | right exposure: posterior = {right:.2f}"""
_ASKED = """right exposure by = {receptor} | views = {views} |
above an average meter's [EV] = {above:+.2f} | held by the bound = {moved:.0%} |
white = {white:.0%} | black = {black:.1%}"""
_CURVE = """training = {training} | its places = {train:.3f} | validation = {validation:.3f} |
test = {test:.3f} | 95 % interval = {test_ci95[0]:.3f} to {test_ci95[1]:.3f}"""


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    judged: list[Row] = results.pop("receptors", [])
    covered = [own for name, own in results.items() if name.startswith("posterior")]
    curves = [own for name, own in results.items() if name.startswith("curve")]
    sheet, figure = pictures(meta["seed"])
    shares = "".join(f" | {s:.0%} interval = {{{s:.0%}:.1%}}" for s in SHARES)
    score = "score = {normalised_score:.3f} | rank = {place} | tier = {tier}"
    ranked = [row for row in judged if "policy" in row]
    tables = {
        "posterior": table(covered, _COVERED + shares),
        "asked": table([row for row in judged if "policy" not in row], _ASKED),
        "ranks": pivot(ranked, "policy = {policy}", "{receptor}", score),
        "curve": table(curves, _CURVE),
    }
    image: Any = "incident_light.webp" if meta["quick"] else IMAGE
    figures = {"places.webp": sheet, image: figure}
    return Report([*covered, *judged, *curves], tables, figures=figures)


run = benchmark("places", parts, report)
