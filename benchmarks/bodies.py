"""What lenses, pixels and a wrong camera profile change of decisions, on real places.

One episode of each view of the unseen places of ``polyhaven`` is drawn with its motion and defocus;
every body and every lens sees the same. The best state of one of them is then judged in the score
table of another.
"""

from dataclasses import replace
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np

from ae_env.scenes import load_scenes
from benchmarks.harness import Part, Report, Row, benchmark, panels, pivot, table
from simulator import get_camera, list_cameras
from simulator.optics.vignetting import RANDOM_LENSES, get_lens, random_lens

TASK, CAMERA, RESOLUTION = "ae_env:ae_env/AutoExposure-v0", "nikon_z6", 64
LENSES = (
    "lensfun:Canon EF 24-70mm f/2.8L II USM?focal=24",
    "lensfun:Canon EF 24-70mm f/2.8L II USM?focal=70",
    "lensfun:NIKKOR Z 50mm f/1.8 S",
    "lensfun:Canon EF-S 18-55mm f/3.5-5.6 IS STM?focal=18",
)
#: Numbers of the lenses of ``lens="random"`` that are looked at.
RANDOM = range(0, RANDOM_LENSES, 8)
#: PRNU, dark currents [e-/s], and shares of the mean light that a lens scatters evenly.
EFFECTS = [f"prnu={x}" for x in (0.005, 0.01, 0.02)]
EFFECTS += [f"dark_current={x}" for x in (30, 300, 3000)]
EFFECTS += [f"glare={x}" for x in (0.01, 0.03)]
BODIES = sorted(list_cameras())
_LOST = "best state changes = {changed:.1%} | score lost = {mean:.4f} | worst view = {worst:.3f}"
_LENS = "{lens} | corners at f/2 [EV] = {wide:.2f} | at f/8 = {closed:.2f} | " + _LOST


def tables(camera: str, lens: Any, seed: int, quick: bool) -> list[list[float]]:
    """(views, states) expected scores; `camera` may have one of `EFFECTS` as an option."""
    if isinstance(lens, int):
        lens = random_lens(lens)
    camera, _, glare = camera.partition("?glare=")
    size: dict[str, Any] = {"camera": get_camera(camera), "resolution": RESOLUTION}
    scenes = load_scenes("polyhaven", "test", **size)
    for i, scene in enumerate(scenes if glare else ()):
        veil = float(glare) * scene.light.mean(dim=(1, 2), keepdim=True)
        scenes[i] = replace(scene, light=scene.light + veil)
    env: Any = gym.make(TASK, scenes=scenes, lens=lens, **size).unwrapped
    found = []
    for index in range(0, len(scenes), 8 if quick else 1):
        env.reset(seed=1000 * seed + index, options={"scene": index})
        found.append(env.core.score_table(0).mean.tolist())
    env.close()
    return found


def parts(seed: int, quick: bool) -> list[Part]:
    names, lenses = [*BODIES, *(f"{CAMERA}?{effect}" for effect in EFFECTS)], [*LENSES, *RANDOM]
    bodies = [Part(f"body|{name}", tables, {"camera": name, "lens": None}) for name in names]
    return bodies + [Part(f"lens|{n}", tables, {"camera": CAMERA, "lens": n}) for n in lenses]


def lost(true: np.ndarray, assumed: np.ndarray) -> Row:
    """Of the best state of the tables `assumed` in those that are `true`, (views, states) each."""
    views, best = np.arange(len(true)), assumed.argmax(axis=1)
    regret = true.max(axis=1) - true[views, best]
    changed = (best != true.argmax(axis=1)).mean()
    return {"changed": changed, "mean": regret.mean(), "worst": regret.max()}


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    found = {name: np.array(scores) for name, scores in results.items()}
    plain, rows, drawn = found[f"body|{CAMERA}"], list[Row](), list[Row]()
    for lens in (*LENSES, *RANDOM):
        known: Any = random_lens(lens) if isinstance(lens, int) else get_lens(lens)
        kind = "drawn" if isinstance(lens, int) else "lensfun"
        name = f"drawn, number {lens}" if kind == "drawn" else str(lens).removeprefix("lensfun:")
        row = {"lens": name, **lost(found[f"lens|{lens}"], plain)}
        row |= {"wide": known.corner_loss(2.0), "closed": known.corner_loss(8.0)}
        rows.append(row)
        point = {"label": "_", "style": {"marker": "o", "ls": "", "c": "C0"}}
        drawn.append({"panel": kind, "x": row["wide"], "y": row["changed"], **point})
    effects = [{"effect": n, **lost(found[f"body|{CAMERA}?{n}"], plain)} for n in EFFECTS]
    wrong = [
        {"true": true, "assumed": assumed, **lost(found[f"body|{true}"], found[f"body|{assumed}"])}
        for true, assumed in product(BODIES, repeat=2)
        if true != assumed
    ]
    shown = {"lenses": table(rows, _LENS), "effects": table(effects, "{effect} | " + _LOST)}
    shown["profiles"] = pivot(wrong, "{true}", "{assumed}", "{mean:.4f} ({worst:.3f})")
    axes: Any = {"xlabel": "light lost in the corners at f/2 [EV]", "ylabel": "best state changes"}
    about, figures = {"views": len(plain), "resolution": RESOLUTION}, panels(drawn, **axes)
    return Report([*rows, *effects, *wrong], shown, meta=about, figures={"bodies.png": figures})


run = benchmark("bodies", parts, report)
