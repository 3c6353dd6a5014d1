"""What a lens, pixels that differ and a wrong profile change of decisions, on real places.

One episode of each view of the unseen places of ``polyhaven`` is drawn with its motion and defocus;
every body and every lens sees the same. The best state of one of them is then judged in the score
table of another.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

from benchmarks.harness import Part, Report, Row, benchmark, panels, pivot, table
from simulator import list_cameras
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
#: PRNU and dark currents [e-/s] that are looked at; the reference sets of EMVA have 0.3 to 0.7 %
#: and up to 28.
PIXELS = [f"prnu={x}" for x in (0.005, 0.01, 0.02)]
PIXELS += [f"dark_current={x}" for x in (30, 300, 3000)]
BODIES = sorted(list_cameras())
_LOST = "best state changes = {changed:.1%} | score lost = {mean:.4f} | worst view = {worst:.3f}"
_LENS = "{lens} | corners at f/2 [EV] = {wide:.2f} | at f/8 = {closed:.2f} | " + _LOST


def tables(camera: str, lens: Any, seed: int, quick: bool) -> list[list[float]]:
    """(views, states) expected scores."""
    if isinstance(lens, int):
        lens = random_lens(lens)
    scenes: dict[str, Any] = {"scenes": "polyhaven", "split": "test", "resolution": RESOLUTION}
    env: Any = gym.make(TASK, **scenes, camera=camera, lens=lens).unwrapped
    count, found = len(env.scene_ids), []
    for scene in range(0, count, 8 if quick else 1):
        env.reset(seed=1000 * seed + scene, options={"scene": scene})
        found.append(env.core.score_table(0).mean.tolist())
    env.close()
    return found


def parts(seed: int, quick: bool) -> list[Part]:
    names, lenses = [*BODIES, *(f"{CAMERA}?{pixels}" for pixels in PIXELS)], [*LENSES, *RANDOM]
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
        known = random_lens(lens) if isinstance(lens, int) else get_lens(lens)
        assert known is not None
        row = lost(found[f"lens|{lens}"], plain)
        row |= {"wide": known.corner_loss(2.0), "closed": known.corner_loss(8.0)}
        rows.append({"lens": str(lens).removeprefix("lensfun:"), **row})
        kind = "drawn" if isinstance(lens, int) else "lensfun"
        drawn.append({"panel": kind, "x": row["wide"], "y": row["changed"], "label": "_"})
    wrong = [
        {"true": true, "assumed": assumed, **lost(found[f"body|{true}"], found[f"body|{assumed}"])}
        for true, assumed in product(BODIES, repeat=2)
        if true != assumed
    ]
    for row in wrong:
        row["text"] = f"{row['mean']:.4f} ({row['worst']:.3f})"
    pixels = [{"pixels": n, **lost(found[f"body|{CAMERA}?{n}"], plain)} for n in PIXELS]
    shown = {
        "pixels": table(pixels, "{pixels} | " + _LOST),
        "lenses": table([{**row, "lens": _named(row["lens"])} for row in rows], _LENS),
        "profiles": pivot(wrong, "{true}", "{assumed}", "{text}"),
    }
    about = {"views": len(plain), "resolution": RESOLUTION}
    return Report(
        [*rows, *pixels, *wrong], shown, meta=about, figures={"bodies.png": _drawn(drawn)}
    )


def _named(lens: str) -> str:
    return f"drawn, number {lens}" if lens.isdigit() else lens


def _drawn(rows: list[Row]) -> Figure:
    for row in rows:
        row["style"] = {"marker": "o", "ls": "", "c": "C0"}
    return panels(rows, xlabel="light lost in the corners at f/2 [EV]", ylabel="best state changes")


run = benchmark("bodies", parts, report)
