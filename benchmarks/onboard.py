"""Exported agents beside themselves in torch: size, time; smaller frames; the firmware guide."""

import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from ae_env.observation import decode_observation, encode_observation
from agents import PolicyContext, make_policy
from agents.onboard.controller import Controller
from agents.onboard.export import export_agent
from benchmarks.harness import Part, Report, Row, benchmark, table
from benchmarks.isolated import ROOT, median_seconds, timed

AGENTS = ("regression", "ppo")
#: Episodes, in light that jumps by `STOPS` in the middle, and their frames.
EPISODES, FRAMES, STOPS = 64, 16, 4.0
#: Decisions whose time is measured, one camera alone, the two in turns.
TIMED = 400
#: Frames that are averaged to what the agent sees: packed height and width.
FRAME_SIZES = ((64, 64), (240, 320), (760, 1014), (1520, 2028))
#: Sides of the frame that the agents are given less and less of.
SIDES = (64, 32, 16, 8, 4, 2)
#: Commands of the firmware guide in docs/on-a-camera.md, on the agent of the package.
GUIDE = (
    "evaluate --workers 1 --grid third_stop --policy rpi_agc?max_gain=8&speed=0.15 "
    "--policy matrix:P --policy regression",
    "stability rpi_agc?max_gain=8&speed=0.15",
    "export regression -o policy.onnx",
)


def _prepared(policy: str, quick: bool) -> tuple[int, Any, Any]:
    """Episodes on unseen scenes, in light that jumps in the middle: how many; and the agent."""
    count = 8 if quick else EPISODES
    given: Any = {"kind": "step", "stops": STOPS, "at": FRAMES // 2}
    given = {"split": "test", "max_episode_steps": None, "lighting": given}
    envs = gym.make_vec("ae_env:ae_env/AutoExposure-v0", num_envs=count, **given)
    return count, envs, make_policy(policy, PolicyContext.from_envs(envs))


def measure(policy: str, seed: int, quick: bool) -> Row:
    _, envs, agent = _prepared(policy, quick)
    with tempfile.TemporaryDirectory() as folder:
        file = export_agent(agent, Path(folder, "agent.onnx"))
        size, alone = file.stat().st_size, Controller(file)
    shown, _ = envs.reset(seed=seed)
    one = {name: values[:1] for name, values in shown.items()}
    times: dict[str, list[float]] = {"torch": [], "onnx": []}
    agent.reset(1)
    for _ in range(TIMED // 10 if quick else TIMED):
        for name, act in (("torch", lambda: agent.act(one)), ("onnx", lambda: alone.act(**one))):
            times[name].append(timed(act))
    row: Row = {"policy": policy, "bytes": size}
    return row | {f"us_{name}": 1e6 * float(np.median(values)) for name, values in times.items()}


def smaller(policy: str, seed: int, quick: bool) -> list[Row]:
    count, envs, agent = _prepared(policy, quick)
    rows, found = list[Row](), list[np.ndarray]()
    for side in SIDES:
        agent.reset(count)
        shown, _ = envs.reset(seed=seed)
        found.append(np.zeros(count))
        for _ in range(FRAMES):
            less = {**shown, "raw": _averaged(shown["raw"], side)}
            shown, reward, *_ = envs.step(agent.act(less))
            found[-1] += reward / FRAMES
        lost = found[0] - found[-1]
        row: Row = {"policy": policy, "side": side, "score": found[-1].mean(), "lost": lost.mean()}
        rows.append(row | {"error": lost.std(ddof=1) / np.sqrt(count)})
    return rows


def _averaged(codes: np.ndarray, side: int) -> np.ndarray:
    """Frames (B, 4, R, R) uint8 whose light is averaged to `side` pixels a side, and shown at R."""
    count, planes, size, _ = codes.shape
    box = size // side
    light = decode_observation(codes).reshape(count, planes, side, box, side, box).mean(axis=(3, 5))
    shown = encode_observation(torch.from_numpy(light)).numpy()
    return shown.repeat(box, axis=2).repeat(box, axis=3)


def encoding(quick: bool) -> list[Row]:
    envs = gym.make_vec("ae_env:ae_env/AutoExposure-v0", num_envs=1, scenes="bundled:small")
    agent = make_policy("ppo", PolicyContext.from_envs(envs))
    with tempfile.TemporaryDirectory() as folder:
        controller = Controller(export_agent(agent, Path(folder, "agent.onnx")))
    rows = []
    for height, width in FRAME_SIZES:
        planes = np.random.default_rng(0).random((4, height, width), dtype=np.float32)
        call, calls = partial(controller.encode_frame, planes), 3 if quick else 15
        ms = 1e3 * median_seconds(call, least=0.0, calls=calls)
        rows.append({"height": height, "width": width, "ms": ms})
    return rows


def guide(quick: bool) -> list[Row]:
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for command in GUIDE[1:] if quick else GUIDE:
            before = os.times()
            program = [sys.executable, "-m", "agents.cli", *command.split()]
            variables = os.environ | {"PYTHONPATH": str(ROOT)}
            subprocess.run(program, cwd=folder, env=variables, check=True, capture_output=True)
            after = os.times()
            seconds = sum(after[2:4]) - sum(before[2:4])  # of processes that have ended
            rows.append({"command": f"ae-env {command}", "cpu_seconds": seconds})
    return rows


def parts(seed: int, quick: bool) -> list[Part]:
    found = [Part("frames", encoding, threads=1), Part("guide", guide, threads=1)]
    for agent in AGENTS:
        found.append(Part(agent, measure, {"policy": agent}, threads=1))
        found.append(Part(f"smaller {agent}", smaller, {"policy": agent}, threads=1))
    return found


_COLUMNS = """agent = {policy} | file [MB] = {mb:.2f} | torch [us] = {us_torch:.0f} |
Controller [us] = {us_onnx:.0f} | torch / Controller = {speedup:.1f}"""
_SMALLER = """agent = {policy} | pixels = {side} x {side} | mean score = {score:.4f} |
lost = {lost:.4f} +- {error:.4f}"""


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    frames = results["frames"]
    rows: list[Row] = [results[name] for name in AGENTS]
    less = [row for name in AGENTS for row in results[f"smaller {name}"]]
    for row in rows:
        row |= {"speedup": row["us_torch"] / row["us_onnx"], "mb": row["bytes"] / 1e6}
    tables = {"agents": table(rows, _COLUMNS), "smaller": table(less, _SMALLER)}
    tables["frames"] = table(frames, "planes = 4 x {height} x {width} | ms = {ms:.2f}")
    steps = results["guide"]
    tables["guide"] = table(steps, "step = `{command:md}` | CPU [s] = {cpu_seconds:.0f}")
    return Report([*rows, *less, *frames, *steps], tables)


run = benchmark("onboard", parts, report)
