"""From a key on a slider of `ae-env view` to the new picture, measured in Chromium."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter, sleep
from typing import Any

import numpy as np
import torch.nn.functional as F

from ae_env.scenes import load_scenes
from agents.viewer.viewed_scene import View, ViewedScene, find_scenes
from benchmarks.harness import Part, Report, Row, benchmark, table
from benchmarks.isolated import timed
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera, write_dng

#: Raws, height and width [packed pixel]; the last is averaged to half its sides on the page.
SIZES = ((256, 384), (512, 768), (1024, 1536))
#: Keys pressed on each slider, and the time between two [ms].
KEYS, PAUSE = 24, 500
SLIDERS = ("ISO", "Shutter", "Aperture")
_PROGRAM = (sys.executable, "-m", "agents.cli")
_WATCH = """() => {
  window.times = []; window.begun = 0;
  document.addEventListener('keydown', () => { window.begun = performance.now(); }, true);
  document.querySelector('.stage img').addEventListener('load', () => {
    requestAnimationFrame(() => {
      if (window.begun) { window.times.push(performance.now() - window.begun); window.begun = 0; }
    });
  });
}"""


def measure(height: int, width: int, seed: int, quick: bool) -> Row:
    keys = 4 if quick else KEYS
    with tempfile.TemporaryDirectory() as folder:
        path = _raw(Path(folder, "scene.dng"), height, width, seed)
        times, load = _in_browser(path, keys)
        python = _in_python(path, keys)
        settings = ("--iso", "400", "--shutter", "1/125", "--aperture", "5.6")
        files = ("-o", f"{folder}/out.dng", "--png", f"{folder}/out.png")
        command = [*_PROGRAM, "simulate", str(path), *settings, *files]
        seconds = timed(lambda: subprocess.run(command, check=True, capture_output=True))
    row: Row = {"height": height, "width": width, "keys": len(times), "command_ms": 1e3 * seconds}
    row |= {"median_ms": float(np.median(times)), "p95_ms": float(np.quantile(times, 0.95))}
    return row | {"python_ms": python, "load_ms": load}


def _raw(path: Path, height: int, width: int, seed: int) -> Path:
    camera = get_camera("nikon_z6")
    scene = load_scenes("bundled:small", "test", camera=camera, resolution=None)[0]
    settings = CameraSettings(100, 2.0 ** -round(scene.ev100 - 4), 4)
    scale = max(height / scene.light.shape[1], width / scene.light.shape[2])
    light = F.interpolate(scene.light[None], scale_factor=scale, mode="bilinear")[0]
    light = light[:, :height, :width] / scene.reference.exposure_time * settings.exposure_time
    clean = RawImage(light.clamp(0, 1), settings, camera, white_balance=scene.white_balance)
    write_dng(path, CameraSimulator(device="cpu").simulate(clean, settings, seed=seed))
    return path


def _in_browser(path: Path, keys: int) -> tuple[list[float], float]:
    """Times of `keys` keys on each slider [ms], and that of the page's first picture."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        raise ValueError("this benchmark needs Chromium: apt install chromium")
    log = path.with_suffix(".log")
    with log.open("w") as file:
        process = subprocess.Popen(
            [*_PROGRAM, "view", str(path), "--no-open"], stdout=file, stderr=subprocess.STDOUT
        )
    try:
        while not (found := re.search(r"open (http\S+)", log.read_text())):
            if process.poll() is not None:
                raise RuntimeError(log.read_text())
            sleep(0.1)
        with sync_playwright() as driver:
            options = ["--no-sandbox"] if os.geteuid() == 0 else []
            browser = driver.chromium.launch(executable_path=chromium, args=options)
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            begun = perf_counter()
            page.goto(found.group(1))
            page.wait_for_selector(".stage img[src]", timeout=120_000)
            load = 1e3 * (perf_counter() - begun)
            page.wait_for_selector(".state.shown", timeout=120_000)
            page.evaluate(_WATCH)
            times: list[float] = []
            for name in SLIDERS:
                page.locator(f"[aria-label='{name}'] [tabindex='0']").focus()
                for i in range(keys):
                    page.keyboard.press("ArrowRight" if i % 8 < 4 else "ArrowLeft")
                    page.wait_for_timeout(PAUSE)
            times = page.evaluate("window.times")
            browser.close()
    finally:
        process.terminate()
        process.wait(20)
    return times, load


def _in_python(path: Path, count: int) -> float:
    """Median time of the same pictures without a browser [ms]."""
    library = find_scenes(str(path))
    viewed = ViewedScene(library.open(library.first), CameraSimulator.from_pretrained(device="cpu"))
    seconds = viewed.best().exposure_time
    views = [View(CameraSettings(iso, seconds, 5.6)) for iso in (400, 500, 640, 800)]
    times = [timed(lambda i=i: viewed.picture(views[i % 4])) for i in range(count + 1)]  # type: ignore[misc]
    return 1e3 * float(np.median(times[1:]))  # the first one prepares the scene


def parts(seed: int, quick: bool) -> list[Part]:
    return [
        Part(f"{h}x{w}", measure, {"height": h, "width": w, "seed": seed, "quick": quick})
        for h, w in (SIZES[:1] if quick else SIZES)
    ]


_COLUMNS = """raw = 4 x {height} x {width} | key to picture, median [ms] = {median_ms:.0f} |
95 % within [ms] = {p95_ms:.0f} | of it simulated and developed [ms] = {python_ms:.0f} |
`ae-env simulate` [ms] = {command_ms:.0f} | simulate / page = {speedup:.0f} |
first picture [ms] = {load_ms:.0f}"""


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows: list[Row] = list(results.values())
    for row in rows:
        row["speedup"] = row["command_ms"] / row["median_ms"]
    return Report(rows, {"latency": table(rows, _COLUMNS)})


run = benchmark("viewer", parts, report)
