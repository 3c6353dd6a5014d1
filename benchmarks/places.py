"""Real places: the posterior of unknown light, other receptors than a dome, more training places.

    ae-env bench places
    ae-env bench places --part posterior

``posterior`` says what `simulator.radiance.incident_light.POSTERIOR` covers in views that it was
not fitted on. ``receptors`` judges the same policies on the same views where another receptor tells
the right exposure. ``curve`` trains the regression agent on 5 to all training places: finished
trainings lie under ``runs/bench_places``, named after the number, and one that was stopped goes on.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from scipy.stats import norm

from ae_env.scenes.bundled import add_layout
from ae_env.scenes.polyhaven import VIEWS, asset_views, dome_lux, polyhaven_scenes, split_assets
from ae_env.scenes.scene import Scene, SceneRequest
from agents.evaluation.engine import evaluate, fit_policies
from agents.evaluation.intervals import rank, score_interval
from agents.learning.training import load_config, train_agent
from agents.policy import PolicyContext
from agents.policy_names import make_policy, training_seeds
from agents.rollouts import make_envs
from benchmarks.agents import CONFIGS, best_compensations, changed_config
from benchmarks.harness import Part, Report, Row, benchmark, pivot, side_by_side, table
from benchmarks.isolated import ROOT
from simulator import develop, exposure_ratio, get_camera, incident_ev100
from simulator.radiance.incident_light import LARGEST_GAP, receptor_reading
from simulator.radiance.light import reference_settings
from simulator.raw.develop import srgb_encode

CAMERA, RESOLUTION = get_camera("nikon_z6"), 64
#: Views of a map that tell what the posterior covers, and the intervals that are looked at.
MANY, SHARES = 48, (0.5, 0.8, 0.9, 0.95)
METERS = ("average:tuned", "centre_weighted:tuned", "matrix:tuned", "average:P")
#: Receptors in a panorama: lux of a flat receptor that asks for the same exposure.
RECEPTORS: dict[str, Any] = {
    "dome, C = 340": dome_lux,
    "flat, C = 250": partial(receptor_reading, dome=False),
    "dome, C = 250": receptor_reading,
}
#: At the right exposure a view counts as white with more than this share of its pixels above white,
#: and as black with a mean of green below the other.
WHITE, BLACK = 0.15, 0.01
#: Training places of the learning curve, the last of them all.
PLACES = (5, 10, 20, 30)
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
            row: Row = {
                "place": scene.group,
                "deviations": (known.ev100 - told.ev100) / told.spread,
            }
            row |= {"light": known.ev100 - told.ev100, "light, meter": known.ev100 - meter}
            row |= {"right": scene.ev100 - told.right_ev100.mean()}
            rows.append(row | {"right, meter": scene.ev100 - meter})
    frame = pd.DataFrame(rows)
    result: Row = {"split": split, "places": frame["place"].nunique(), "views": len(frame)}
    result |= frame.filter(regex="light|right").pow(2).mean().pow(0.5).to_dict()
    within = {f"{s:.0%}": frame["deviations"].abs() < norm.ppf(0.5 + s / 2) for s in SHARES}
    return result | {name: float(inside.mean()) for name, inside in within.items()}


def views_of_test_places(read: Any, count: int = VIEWS) -> Iterator[Scene]:
    """The views of `polyhaven`, of which a receptor tells the illuminance; 256 x 256."""
    for asset in split_assets("polyhaven", "test"):
        for view in asset_views(asset, CAMERA, size=SIZE, views=count, read=read):
            yield add_layout(view)


def _context() -> PolicyContext:
    options = {"split": "test", "resolution": RESOLUTION}
    with closing(make_envs(options, num_envs=1, frames=1)) as envs:
        return PolicyContext.from_envs(envs)


def _policies(seed: int, quick: bool) -> dict[str, Any]:
    """Meters and agents, all of which learnt under the dome."""
    context, names = _context(), list(METERS[: 1 if quick else None])
    if not quick:
        found = best_compensations(context, seed, episodes=2)
        names += [f"{name}?compensation={stops:g}" for name, stops in found.items()]
    policies: dict[str, Any] = {name: make_policy(name, context) for name in names}
    fit_policies(policies, load_config(CONFIGS["regression"]).environment, seed=seed)
    for agent in CONFIGS:
        policies[agent] = [make_policy(name, context) for name in training_seeds(agent)]
    return policies


def receptors(seed: int, quick: bool) -> list[Row]:
    """A row for each receptor and policy, and one for the right exposures of each receptor."""
    policies, rows = _policies(seed, quick), []
    for receptor, read in RECEPTORS.items():
        scenes = [v.resized(RESOLUTION) for v in views_of_test_places(read, 1 if quick else VIEWS)]
        exposed = [
            (s.light * exposure_ratio(s.reference, reference_settings(s.ev100))).clamp(max=1.0)
            for s in scenes
        ]
        lights = [s.incident_light for s in scenes]
        gaps = np.array([i.ev100 - i.reflected_ev100 for i in lights if i.reflected_ev100])
        row: Row = {"receptor": receptor, "above": -np.median(gaps), "views": len(scenes)}
        row["moved"] = (np.abs(gaps) > LARGEST_GAP).mean()
        row["white"] = np.mean([(x == 1.0).any(dim=0).float().mean() > WHITE for x in exposed])
        row["black"] = np.mean([x[1:3].mean() < BLACK for x in exposed])
        rows.append({name: getattr(v, "item", lambda v=v: v)() for name, v in row.items()})
        options = {"scenes": scenes, "split": "test", "resolution": RESOLUTION}
        result = evaluate(policies, options, episodes_per_scene=1 if quick else 4, seed=seed)
        gains = {name: result.group_gains(name) for name in policies}
        found = rank({name: own for name, (own, _) in gains.items()}, gains[METERS[0]][1])
        rows += [{"receptor": receptor, **own} for own in found.to_dict("records")]
    return rows


def curve(places: int, seed: int, quick: bool) -> Row:
    """The regression agent, one seed, trained on views of so many places, which are drawn."""
    changes = {"seed": seed} | ({"frames": 2_000} if quick else {})
    config = load_config(CONFIGS["regression"])
    config = changed_config(config, {"scenes": f"mixed:{places}"}, changes)
    out = ROOT / "runs" / f"bench_places{'_quick' * quick}" / str(places)
    agent, row = make_policy(f"regression:{train_agent(config, out)}", _context()), Row()
    for split, number in (("train", places), ("validation", None), ("test", None)):
        request: Any = SceneRequest(split, CAMERA, RESOLUTION)  # type: ignore[arg-type]
        scenes = polyhaven_scenes(request, assets=split_assets("polyhaven", split, number))
        options = {"scenes": scenes, "resolution": RESOLUTION}
        result = evaluate({"own": agent}, options, episodes_per_scene=1 if quick else 4, seed=seed)
        found = score_interval(*result.group_gains("own"))
        row |= {split: found.value, f"{split}_ci95": found.pair}
    return {"places": places, **row}


# -- pictures -------------------------------------------------------------------------------------


def pictures(seed: int) -> tuple[Figure, Figure, list[Row]]:
    """The contact sheet, the receptors in one of its views, and facts of its frames."""
    read_at: list[Any] = []
    count = VIEWS * len(split_assets("polyhaven", "test"))
    drawn = np.random.default_rng(seed).choice(count, SHOWN, replace=False)
    every = views_of_test_places(lambda *at: read_at.append(at) or dome_lux(*at))
    views = [view for number, view in enumerate(every) if number in drawn]
    options: Any = {"scenes": views, "split": "test", "resolution": SIZE, "observation": "linear"}
    env: Any = gym.make("ae_env/AutoExposure-v0", render_mode="rgb_array", **options)
    shown, rows = [], []
    for number, (view, at) in enumerate(zip(views, np.sort(drawn), strict=True)):
        env.reset(seed=seed, options={"scene": number})
        state = env.unwrapped.score_table().oracle
        raw, settings = env.step(state)[0]["raw"], env.unwrapped.grid[state]
        row: Row = {"view": view.scene_id, "kind": view.kind, "settings": str(settings)}
        row |= {"lux": view.illuminance, "off": view.ev100 + settings.log2_exposure}
        row |= {"asked": view.incident_light.reflected_ev100 - view.ev100}
        row |= {"white": float((raw >= 1.0).any(axis=0).mean()), "mean": float(raw[1:3].mean())}
        shown.append(torch.from_numpy(env.render().copy()).permute(2, 0, 1))
        rows.append(
            row | {"flat": receptor_reading(*read_at[at], dome=False) / dome_lux(*read_at[at])}
        )
    titles = [f"{number}: {row['view']}" for number, row in enumerate(rows, 1)]
    lines = [
        dict(zip(titles[i : i + 4], shown[i : i + 4], strict=True)) for i in range(0, SHOWN, 4)
    ]
    most = int(np.argmax([abs(np.log2(row["flat"])) for row in rows]))
    figure = receptor_figure(views[most], rows[most]["flat"], *read_at[np.sort(drawn)[most]])
    return side_by_side(*lines), figure, rows


def receptor_figure(
    view: Scene, flat: float, panorama: np.ndarray, azimuth: float, pitch: float
) -> Figure:
    """Both receptors, the dome over a panorama, and a view at the exposures that they ask for."""
    figure = Figure(figsize=(9.0, 5.6), dpi=100, layout="constrained")
    polar = {"A": {"projection": "polar", "theta_offset": np.pi / 2}}
    axes = figure.subplot_mosaic("ABB;CDE", per_subplot_kw=polar)  # type: ignore[arg-type]
    angles = np.linspace(0.0, 2.0 * np.pi, 361)
    axes["A"].plot(angles, (1.0 + np.cos(angles)) / 2.0, label="dome, (1 + cos) / 2")
    axes["A"].plot(angles, np.maximum(np.cos(angles), 0.0), "--", label="flat, cos")
    axes["A"].legend(fontsize=7, loc="lower center")
    axes["A"].set_title("weight of light, by its angle to the camera", fontsize=9)
    light = torch.from_numpy(panorama / np.quantile(panorama, 0.95)).clamp(0.0, 1.0)
    box = (-180.0, 180.0, -90.0, 90.0)
    axes["B"].imshow(srgb_encode(light).permute(1, 2, 0).numpy(), extent=box)
    longitude, latitude = np.meshgrid(np.linspace(-180, 180, 361), np.linspace(-90, 90, 181))
    turned, up, tilt = (np.radians(v) for v in (longitude - azimuth, latitude, pitch))
    cosine = np.cos(up) * np.cos(tilt) * np.cos(turned) + np.sin(up) * np.sin(tilt)
    lines = axes["B"].contour(longitude, latitude, (1.0 + cosine) / 2.0, (0.25, 0.5, 0.75, 0.95))
    axes["B"].clabel(lines, fontsize=7)
    axes["B"].set_title("weight under a dome that points at the camera (inside 0.95)", fontsize=9)
    ev100 = {"average meter": view.incident_light.reflected_ev100}
    ev100["flat, C = 250"] = incident_ev100(view.illuminance * flat)
    ev100["dome, C = 340"] = incident_ev100(view.illuminance)
    for axis, (name, ev) in zip("CDE", ev100.items(), strict=True):
        signal = view.light * exposure_ratio(view.reference, reference_settings(ev))
        picture = develop(signal[None].clamp(0.0, 1.0), view.white_balance, CAMERA.colour_matrix)
        axes[axis].imshow(picture[0].permute(1, 2, 0).numpy())
        axes[axis].set_title(f"{name}: EV100 {ev:.1f}", fontsize=9)
    for name in "BCDE":
        axes[name].set_axis_off()
    return figure


# -- report ---------------------------------------------------------------------------------------


def parts(seed: int, quick: bool, part: str | None = None) -> list[Part]:
    splits = ("validation", "test")
    found = [Part(f"posterior {s}", posterior, {"split": s}) for s in splits]
    found += [
        Part("receptors", receptors),
        *(Part(f"curve {n}", curve, {"places": n}) for n in PLACES),
    ]
    return [own for own in found if part is None or own.name.startswith(part)]


_COVERED = """views of = {split} places | places = {places} | views = {views} |
light: meter's rule [EV] = {light, meter:.2f} | posterior = {light:.2f} |
right exposure: meter's rule [EV] = {right, meter:.2f} | posterior = {right:.2f}"""
_ASKED = """right exposure by = {receptor} | views = {views} |
above an average meter's [EV] = {above:+.2f} | held by the bound = {moved:.0%} |
white = {white:.0%} | black = {black:.1%}"""
_CURVE = """places = {places} | those places = {train:.3f} | validation = {validation:.3f} |
test = {test:.3f} | 95 % interval = {test_ci95[0]:.3f} to {test_ci95[1]:.3f}"""
_SHEET = """view = {view} | kind = {kind} | light [lux] = {lux:.3g} | oracle = {settings} |
above the right exposure [EV] = {off:+.2f} | right above average meter's [EV] = {asked:+.2f} |
white = {white:.1%} | mean of green = {mean:.3f}"""


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    kinds: dict[str, list[Row]] = {"posterior": [], "receptors": [], "curve": []}
    for name, own in results.items():
        kinds[name.partition(" ")[0]] += own if isinstance(own, list) else [own]
    covered, judged, curves = kinds.values()
    sheet, figure, facts = pictures(meta["seed"])
    shares = "".join(f" | {s:.0%} interval = {{{s:.0%}:.1%}}" for s in SHARES)
    score = "score = {normalised_score:.3f} | rank = {place} | tier = {tier}"
    ranked = pivot([r for r in judged if "policy" in r], "policy = {policy}", "{receptor}", score)
    tables = {
        "posterior": table(covered, _COVERED + shares),
        "asked": table([row for row in judged if "policy" not in row], _ASKED),
        "ranks": ranked if judged else "",
        "curve": table(curves, _CURVE),
        "sheet": table(facts, _SHEET),
    }
    image: Any = "incident_light.webp" if meta["quick"] else IMAGE
    texts = {name: text or "Not measured in this run." for name, text in tables.items()}
    return Report(
        [*covered, *judged, *curves, *facts], texts, figures={"places.webp": sheet, image: figure}
    )


run = benchmark("places", parts, report)
