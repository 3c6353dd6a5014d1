"""The ladder of codes over exposure, ISO and motion, and the latitude of its reader."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from PIL import Image

from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.ladder import RUNGS
from ae_env.scorers.captures import describe_captures, prepare_scene
from ae_env.scorers.detection import Legibility
from ae_env.scorers.terms import developed
from agents.applications.latitude import load_detector, measure_latitude, picture_scenes
from benchmarks.harness import Part, Report, Row, benchmark, table
from simulator import get_camera
from simulator.settings import CameraSettings

CAMERA, RESAMPLES = get_camera("nikon_z6"), 2000
#: Condition by condition: exposure [EV], ISO, speed [frame heights per second].
SWEEPS: dict[str, list[tuple[float, float, float]]] = {
    "EV, ISO 100": [(float(ev), 100.0, 0.0) for ev in range(-9, 10)],
    "EV, ISO 6400": [(float(ev), 6400.0, 0.0) for ev in range(-9, 10)],
    "ISO": [(0.0, 100.0 * 2.0**i, 0.0) for i in range(11)],
    "motion in 1/60 s": [(0.0, 100.0, 0.12 * 2.0 ** (i / 2)) for i in range(10)],
}
COLUMNS = """sweep = {sweep} | EV = {ev:+.0f} | ISO = {iso:.0f} | speed [heights/s] = {speed:.2f} |
read = {share:.3f} | 95 % = {low:.3f} to {high:.3f} | easiest rung = {easiest:.2f} |
hardest rung = {hardest:.2f}"""


def views(count: int, seed: int, resolution: int = 128) -> list[Scene]:
    found = load_scenes("polyhaven?codes", "test", camera=CAMERA, resolution=resolution)
    chosen = np.random.default_rng(seed).choice(len(found), count, replace=False)
    return [found[i] for i in chosen]


def state(scene: Scene, ev: float, iso: float) -> CameraSettings:
    """So much brighter than the right exposure; at f/1.4, that nights take no days."""
    base = CameraSettings(iso, 1.0, 1.4)
    return replace(base, exposure_time=2.0 ** (ev - scene.ev100 - base.log2_exposure))


def curves(seed: int, quick: bool) -> list[Row]:
    scenes, scorer, rows = views(6 if quick else 24, seed), Legibility(), list[Row]()
    for sweep, conditions in SWEEPS.items():
        shares, ends = np.zeros((2, len(scenes), len(conditions))), []
        for i, scene in enumerate(scenes):
            for k, (ev, iso, speed) in enumerate(conditions):
                used = state(scene, ev, iso)
                # Blur of so many frame heights, whatever the light asks for.
                own = speed / 60.0 / used.exposure_time
                prepared = prepare_scene(scene, CAMERA, speed=own)
                frame = prepared.expose([used], seed=seed).clamp_(0.0, 1.0)
                one: Any = {"speed": np.array([own]), "defocus": np.zeros(1), "gain": np.ones(1)}
                captures = describe_captures([scene], [used], CAMERA, **one)
                shown = developed(frame, captures.white_balance, captures.colour_matrices)
                found = scorer.read(shown, captures)[0].reshape(-1, len(RUNGS))
                shares[0, i, k] = found.mean()
                ends.append((k, found[:, 0].mean(), found[:, -1].mean()))
        rng = np.random.default_rng(seed)
        drawn = shares[0][rng.integers(len(scenes), size=(RESAMPLES, len(scenes)))].mean(axis=1)
        for k, (ev, iso, speed) in enumerate(conditions):
            low, high = np.quantile(drawn[:, k], (0.025, 0.975))
            row = {"sweep": sweep, "ev": ev, "iso": iso, "speed": speed}
            easiest, hardest = np.mean([one[1:] for one in ends if one[0] == k], axis=0)
            row |= {"share": shares[0, :, k].mean(), "low": low, "high": high}
            rows.append(row | {"easiest": easiest, "hardest": hardest})
    return rows


def latitude(seed: int, quick: bool) -> dict[str, Any]:
    """Of zxing-cpp on pictures of the scenes, twice as large, as they are exposed for the codes."""
    with tempfile.TemporaryDirectory() as folder:
        for i, scene in enumerate(views(4 if quick else 12, seed, 256)):
            light = scene.light[:, None] * (0.5 / scene.light[1].quantile(0.9)).clamp(max=1e6)
            balance = torch.tensor([scene.white_balance])
            shown = developed(light.transpose(0, 1).clamp(0, 1), balance, [CAMERA.colour_matrix])
            picture = shown[0].permute(1, 2, 0).mul(255.0).round().to(torch.uint8).numpy()
            Image.fromarray(picture).save(Path(folder, f"{i:02d}.png"))
        result = measure_latitude(load_detector("codes"), picture_scenes(folder, CAMERA, 256))
    return {"lines": result.lines(), "rows": result.rows.to_dict("records")}


def parts(seed: int, quick: bool) -> list[Part]:
    return [Part("curves", curves, threads=1), Part("latitude", latitude, threads=1)]


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    figure, rows = Figure(figsize=(9, 3), dpi=90, layout="constrained"), results["curves"]
    for axes, key, names in zip(
        figure.subplots(1, 3, sharey=True), ("ev", "iso", "speed"), ([0, 1], [2], [3]), strict=True
    ):
        for sweep in (list(SWEEPS)[n] for n in names):
            own = [row for row in rows if row["sweep"] == sweep]
            x = [row[key] if key == "ev" else np.log2(row[key]) for row in own]
            axes.fill_between(x, [r["low"] for r in own], [r["high"] for r in own], alpha=0.25)
            axes.plot(x, [row["share"] for row in own], marker=".", label=sweep)
        axes.set(xlabel=key if key == "ev" else f"log2 {key}", ylim=(0, 1))
        axes.legend(fontsize=7)
    figure.axes[0].set(ylabel="share of the codes read")
    said = "\n".join(f"- {line}" for line in results["latitude"]["lines"])
    shown = [row for row in rows if row["ev"] % 3 == 0]
    tables = {"curves": table(shown, COLUMNS), "latitude": said}
    return Report([*rows, *results["latitude"]["rows"]], tables, figures={"tasks.png": figure})


run = benchmark("tasks", parts, report)
