"""Tasks as rewards: the ladder of codes over exposure, ISO and motion; the latitude of its reader.

An agent is trained on the ladder beside meters that learn from the same views (the training lies
under ``runs/bench_tasks``), and policies that were made for the score `balanced` are ranked by it
and by each task, in unseen views of real places.
"""

import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from PIL import Image

from ae_env.observation import decode_observation, encode_array
from ae_env.scenes import Scene, load_scenes, reference_settings
from ae_env.scenes.ladder import RUNGS
from ae_env.scorers.captures import SceneCaptures, prepare_scene
from ae_env.scorers.detection import Legibility
from ae_env.scorers.terms import developed
from agents.applications.latitude import load_detector, measure_latitude, picture_scenes
from agents.evaluation.engine import evaluate, fit_policies
from agents.evaluation.intervals import mean_rows, rank_agreement
from agents.evaluation.result import EvaluationResult, group_rows
from agents.learning.training import load_config, train_agent
from agents.policy import PolicyContext
from agents.policy_names import make_policy
from benchmarks.agents import changed_config, context_of
from benchmarks.fidelity.models import equal_exposure
from benchmarks.harness import Part, Report, Row, benchmark, interval, table
from benchmarks.isolated import ROOT
from simulator import get_camera
from simulator.settings import CameraSettings

CAMERA, CONFIG = get_camera("nikon_z6"), ROOT / "configs" / "legibility.yaml"
#: Mean score in each place, by policy.
Scores = dict[str, list[float]]
#: The agent, meters that learn from the same views, and what else stands beside them.
AGENT, TUNED = "agent", ("average:tuned", "centre_weighted:tuned", "matrix:tuned")
BESIDE = ("best_fixed", "average:P", "centre_weighted:P")
#: Policies that are ranked, and the scorer of each kind of scenes.
METERS = ("random", *BESIDE, "matrix:P", "spot:P", "highlight_weighted:P", "rpi_agc", *TUNED)
AGENTS = ("regression", "ppo")
TASKS, QUICK_SCENES = {"codes": "legibility", "tags": "tags"}, "bundled:small?codes"
#: Of so many views one is ranked by: a score table of tags takes 10 s.
ONE_OF = {"codes": 2, "tags": 8}
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
_AGENT = """policy = {policy} | read = {score:.3f} | 95 % = {ci95:.3f} |
more than the best tuned meter = {more:+.1%} | 95 %, paired = {more_ci95:+.1%}"""


def views(count: int, seed: int, resolution: int = 128) -> list[Scene]:
    found = load_scenes("polyhaven?codes", "test", camera=CAMERA, resolution=resolution)
    chosen = np.random.default_rng(seed).choice(len(found), count, replace=False)
    return [found[i] for i in chosen]


def state(scene: Scene, ev: float, iso: float) -> CameraSettings:
    """So much brighter than the right exposure; at f/1.4, that nights take no days."""
    return equal_exposure(reference_settings(scene.ev100 - ev), iso, 1.4)


def curves(seed: int, quick: bool) -> list[Row]:
    scenes, scorer, rows = views(6 if quick else 24, seed), Legibility(), list[Row]()
    for sweep, ev, iso, speed in ((name, *one) for name, every in SWEEPS.items() for one in every):
        found = []
        for scene in scenes:
            used = state(scene, ev, iso)
            # Blur of so many frame heights, whatever the light asks for.
            own = speed / 60.0 / used.exposure_time
            frame = prepare_scene(scene, CAMERA, speed=own).expose([used], seed=seed).clamp_(0, 1)
            one: Any = {"speed": np.array([own]), "defocus": np.zeros(1), "gain": np.ones(1)}
            captures = SceneCaptures(CAMERA, [used]).of([scene], **one)
            shown = developed(frame, captures.white_balance, captures.colour_matrices)
            read = scorer.read(shown, captures)[0].reshape(-1, len(RUNGS)).mean(axis=0)
            found.append((read.mean(), read[0], read[-1]))
        row: Row = {"sweep": sweep, "ev": ev, "iso": iso, "speed": speed}
        low, high = interval(np.array(found)[:, 0], seed)
        row |= dict(zip(("share", "easiest", "hardest"), np.mean(found, axis=0), strict=True))
        rows.append(row | {"low": low, "high": high})
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


def _judged(policies: Row, own: Row, seed: int, quick: bool) -> EvaluationResult:
    given = {**own, "split": "test"}
    return evaluate(policies, given, episodes_per_scene=1 if quick else 2, seed=seed)


def _by_place(result: EvaluationResult, names: Iterable[str]) -> Scores:
    shares = group_rows(result)
    return {name: shares[name].tolist() for name in names}


def trained(seed: int, quick: bool) -> Scores:
    """Share that is read in each unseen place, by policy."""
    changes: Any = ({"scenes": QUICK_SCENES}, {"frames": 2_000}) if quick else ({}, {})
    config = changed_config(load_config(CONFIG), *changes)
    out = train_agent(config, ROOT / "runs" / f"bench_tasks{'_quick' * quick}")
    test = {**config.environment, "scenes": QUICK_SCENES if quick else "polyhaven?codes"}
    context = context_of({**test, "scenes": QUICK_SCENES})
    policies: Row = {name: make_policy(name, context) for name in (*BESIDE, *TUNED, "oracle")}
    policies[AGENT] = make_policy(f"regression:{out}", context)
    fit_policies(policies, config.environment, seed=seed)
    return _by_place(_judged(policies, test, seed, quick), policies)


def _of_package(name: str, small: PolicyContext) -> Any:
    """An agent of the package, which is shown frames averaged to the 64 x 64 that it knows."""
    policy: Any = make_policy(name, small)
    act = policy.act

    def on_small_frames(observations: Any, masks: Any = None) -> Any:
        codes = observations["raw"]
        light = decode_observation(codes).reshape(*codes.shape[:2], 64, 2, 64, 2)
        return act({**observations, "raw": encode_array(light.mean(axis=(3, 5)))}, masks)

    policy.act = on_small_frames
    return policy


def ranks(kind: str, seed: int, quick: bool) -> dict[str, Scores]:
    """Scores in each unseen place, by a task and by `balanced`, for the same states.

    They were made for `balanced`; and no policy sees what its frames score.
    """
    own = {**load_config(CONFIG).environment, "scorer": "balanced"}
    own["scenes"], task = "bundled:small" if quick else "polyhaven", TASKS[kind]
    context = context_of({**own, "scenes": "bundled:small"})
    policies: Row = {name: make_policy(name, context) for name in METERS}
    small = context_of({**own, "scenes": "bundled:small", "resolution": 64})
    policies |= {name: _of_package(name, small) for name in AGENTS}
    fit_policies(policies, own, seed=seed)
    size: Any = {"camera": CAMERA, "resolution": own["resolution"]}
    shown = load_scenes(f"{own['scenes']}?{kind}", "test", **size)[:: ONE_OF[kind]]
    test, alone = {**own, "scenes": shown}, {"random": policies["random"]}
    judged = _judged(policies, {**test, "scorer": task}, seed, quick)
    both = {"balanced": replace(_judged(alone, test, seed, quick), tracks=judged.tracks)}
    both[task] = judged
    return {name: _by_place(one, policies) for name, one in both.items()}


def parts(seed: int, quick: bool) -> list[Part]:
    found = [Part(own.__name__, own, threads=1) for own in (trained, curves, latitude)]
    return [*found, *(Part(f"ranks {kind}", ranks, {"kind": kind}, threads=1) for kind in TASKS)]


def rankings(found: dict[str, Scores]) -> tuple[str, list[Row]]:
    """Kendall's tau in words, and a row for each policy, the best by `balanced` first."""
    tau = rank_agreement(*(np.array([*own.values()]) for own in found.values()))
    means = pd.DataFrame(found).map(np.mean)
    rows = means.join(means.rank(ascending=False).add_suffix(" place")).reset_index(names="policy")
    shown = " | ".join(f"{k} = {{{k}:.3f}} | place by {k} = {{{k} place:.0f}}" for k in means)
    ends = "" if tau.low is None else f", 95 % interval {tau.low:.2f} to {tau.high:.2f}"
    by_place: list[Any] = rows.sort_values("balanced place").to_dict("records")
    words = f"Kendall's tau {tau.value:.2f}{ends}; {tau.num_groups} places.\n\n"
    return words + table(by_place, f"policy = {{policy}} | {shown}"), by_place


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
    rows = [*rows, *results["latitude"]["rows"], *(found := mean_rows(results["trained"], TUNED))]
    tables["agent"] = table(found, _AGENT)
    for kind in TASKS:
        tables[kind], found = rankings(results[f"ranks {kind}"])
        rows += found
    return Report(rows, tables, figures={"tasks.png": figure})


run = benchmark("tasks", parts, report)
