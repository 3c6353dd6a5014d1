"""The long training: both agents over several seeds, and every light meter, on unseen scenes.

Trained agents lie under ``runs/bench_agents``, so that a second run continues where the first was
stopped. Trainings run side by side and show their own progress, so this one is no
`benchmarks.harness.benchmark`.
"""

import json
from ast import literal_eval
from collections.abc import Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.scene import Split
from agents.cli.console import print_files, progress_bars
from agents.evaluation.engine import evaluate, fit_policies
from agents.learning.training import AgentConfig, TrainingJob, load_config, train_in_parallel
from agents.policy import PolicyContext
from agents.policy_names import CLASSIC_METERS, PROGRAMS, make_policy
from agents.report.evaluation import write_report
from agents.rollouts import make_envs
from benchmarks.harness import real_files
from benchmarks.isolated import ROOT
from simulator.camera import CameraProfile
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.settings import CameraSettings

CONFIGS = {name: ROOT / "configs" / f"{name}.yaml" for name in ("regression", "ppo")}
SEEDS = (0, 1, 2)
EPISODES = 8
#: Unseen scenes: of the generators that agents learnt from; real places; the same views without
#: their illuminance; and raws of real cameras, whose light nobody measured.
SETS = {
    "bundled": "bundled",
    "polyhaven": "polyhaven",
    "unknown": "polyhaven:unknown",
    "raws": "benchmarks.agents:raws",
}
#: Scorers that no agent was trained on. `shin` knows nothing of the incident light.
OTHER_SCORERS = ("fidelity", "shin", "defects")
QUICK = {"regression": {"frames": 2_000}, "ppo": {"total_timesteps": 2_048}}
#: Meters that get the constant compensation that suits the training places best [EV].
COMPENSATED = ("average:P", "centre_weighted:P", "matrix:P")
COMPENSATIONS = np.arange(-1.0, 2.01, 0.25)


def raws(split: Split, camera: CameraProfile, resolution: int) -> list[Scene]:
    """Raws of a Canon and two GoPro cameras, each a source group of its own."""
    size: Any = {"camera": camera, "resolution": resolution}
    scenes = load_scenes(real_files("canon_crw_cc0"), split, **size)
    folder = real_files("gopro_raw")
    for name, meta in json.loads((folder / "meta.json").read_text()).items():
        tags: dict[str, str] = meta["dng_tags"]
        iso, seconds, stop = (
            literal_eval(tags[tag]) for tag in ("ISOSpeedRatings", "ExposureTime", "FNumber")
        )
        mosaic = np.asarray(Image.open(folder / name)).astype(np.float32)
        planes = np.stack([mosaic[i::2, j::2] for i in (0, 1) for j in (0, 1)])
        light = torch.from_numpy(planes / meta["white"])  # its black is 0
        shot, read = literal_eval(tags["NoiseProfile"])
        scene = Scene.from_array(
            light.clamp(max=1.0),
            CameraSettings(iso, seconds[0] / seconds[1], stop[0] / stop[1]),
            camera,
            scene_id=Path(name).stem,
            kind="raw",
            nlf=NoiseLevelFunction((shot,) * 4, (read,) * 4),
            white_balance=tuple(meta["wb"][:3]),
            saturated=(light >= 1.0).any(dim=0),
            sampled=True,
        )
        scenes.append(scene.resized(resolution))
    return scenes


def compensated(context: PolicyContext, seed: int) -> list[str]:
    """`COMPENSATED`, each at the compensation that scores best in the training places."""
    names = [[f"{m}?compensation={c:g}" for c in COMPENSATIONS] for m in COMPENSATED]
    policies = {name: make_policy(name, context) for own in names for name in own}
    places = {"scenes": "polyhaven", "split": "train", "resolution": 64}
    result = evaluate(policies, places, episodes_per_scene=2, seed=seed)
    return [max(own, key=result.normalised) for own in names]


def context_of(options: dict[str, Any]) -> PolicyContext:
    """What policies know in an environment with these options."""
    with closing(make_envs(options, num_envs=1, frames=1)) as envs:
        return PolicyContext.from_envs(envs)


def changed_config(
    config: AgentConfig, environment: dict[str, Any], training: dict[str, Any]
) -> AgentConfig:
    changed = {"environment": environment, "training": training}
    parts = {name: {**getattr(config, name), **own} for name, own in changed.items()}
    return AgentConfig.model_validate({**config.model_dump(), **parts})


def run(out: Path, *, seed: int = 0, quick: bool = False) -> None:
    """Trains, evaluates and writes ``agents/`` under `out`."""
    jobs: dict[str, list[TrainingJob]] = {}
    folder = ROOT / "runs" / ("bench_agents_quick" if quick else "bench_agents")
    for name, path in CONFIGS.items():
        config = changed_config(load_config(path), {}, QUICK[name] if quick else {})
        jobs[name] = [
            TrainingJob(f"{name}, seed {s}", config.with_seed(s), folder / f"{name}-{s}")
            for s in SEEDS
        ]
    everything = [job for own in zip(*jobs.values(), strict=True) for job in own]
    with progress_bars() as progress, ExitStack() as bars:
        tasks = {job.name: bars.enter_context(progress(job.name)) for job in everything}
        train_in_parallel(everything, progress=lambda name, *done: tasks[name](*done[:2]))
    meta: dict[str, Any] = {"training_seeds": list(SEEDS)}
    meta["training"] = {name: own[0].config.card() for name, own in jobs.items()}
    context = context_of({"resolution": 64})
    policies = _comparators(context, jobs["regression"][0].config.environment, seed, quick)
    meta["compensated"] = [name for name in policies if "compensation" in name]
    for name, own in jobs.items():
        policies[name] = [make_policy(f"{name}:{job.out}", context) for job in own]
    policies["oracle"] = make_policy("oracle", context)
    command = "ae-env bench agents" + " --quick" * quick
    for name, scenes in list(SETS.items())[: 1 if quick else None]:
        given: dict[str, Any] = {"episodes_per_scene": 1 if quick else EPISODES, "seed": seed}
        test = {"scenes": scenes, "split": "test", "resolution": 64}
        with progress_bars() as progress, progress(f"evaluation on {name}") as task:
            result = evaluate(policies, test, **given, other_scorers=OTHER_SCORERS, progress=task)
        written: dict[str, Any] = {"source": name, "split": "test", "extra_meta": meta}
        print_files(write_report(result, out / "agents" / name, command=command, **written))


def _comparators(
    context: PolicyContext, environment: Mapping[str, Any], seed: int, quick: bool
) -> dict[str, Any]:
    """Every light meter by its name; `environment` is of the agents' training."""
    meters = [f"{meter}:{p}" for meter in CLASSIC_METERS for p in PROGRAMS if p != "M"]
    names = ["random", "best_fixed", *(meters[:1] if quick else meters)]
    with progress_bars() as progress, progress("light meters learn their programs") as task:
        if not quick:
            names += compensated(context, seed)
        policies: dict[str, Any] = {name: make_policy(name, context) for name in names}
        fit_policies(policies, environment, seed=seed, progress=task)
    return policies
