"""Our model of libcamera's auto exposure, held to recordings of libcamera's own, frame by frame.

Each recording drove libcamera's code with a simulated sensor: a scene of 15 zones, a light that
steps, settings that arrive frames late. Ours runs here on the same sensor and light, from the same
start, its own settings fed back: nothing of the recording is shown to it.
"""

from __future__ import annotations

import json
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from agents.metering.rpi_agc import LADDERS, LibcameraAgc, signal_histogram
from benchmarks.harness import Part, Report, Row, benchmark, data_folder, panels, table

#: Where the recordings lie in the folder of real data.
FOLDER, FILE = "libcamera_agc", "traces.json"
#: Frames after which a setting reaches the sensor: asked for after frame n, in frame n + 1 + delay.
EXPOSURE_DELAY, GAIN_DELAY = 2, 1
#: Shortest and longest exposure time of the sensor [s], and what it starts with.
SENSOR_TIMES, START_TIME = (60e-6, 66e-3), 1e-3
#: Deviation up to which two exposures are the same, and with which one has settled.
SAME = 0.02
#: Pixels of a zone; of the scene `highlights`, this share is that many times brighter.
ZONE_PIXELS, BRIGHT_SHARE, BRIGHTER = 1000, 0.05, 8.0
#: Recordings that the page draws, by index.
SHOWN = (0, 5, 12, 20, 30, 34)


def play(recording: Row, zone_factors: list[float]) -> dict[str, np.ndarray]:
    """What our AGC does on the sensor and in the light of `recording`, frame by frame.

    Returns:
        ``exposure_s`` and ``gain`` that each frame was taken with, ``seconds`` that each decision
        took.
    """
    period = recording["flicker_period_us"] * 1e-6
    agc = LibcameraAgc(
        1,
        metering=recording["metering"].replace("-", "_"),
        constraint=recording["constraint"],
        ladder=LADDERS[recording["exposure_mode"]],
        max_exposure_time=SENSOR_TIMES[1],
        flicker_period=period or None,
    )
    pixels = np.repeat(np.array(zone_factors, np.float64)[:, None], ZONE_PIXELS, axis=1)
    if recording["scene"] == "highlights":
        pixels[:, : int(BRIGHT_SHARE * ZONE_PIXELS)] *= BRIGHTER
    asked: list[tuple[float, float]] = []
    found: dict[str, list[float]] = {"exposure_s": [], "gain": [], "seconds": []}
    for frame in range(len(recording["gain"])):
        earlier = frame - 1 - EXPOSURE_DELAY
        time = asked[earlier][0] if earlier >= 0 else START_TIME
        time = min(max(time, SENSOR_TIMES[0]), SENSOR_TIMES[1])
        earlier = frame - 1 - GAIN_DELAY
        gain = asked[earlier][1] if earlier >= 0 else 1.0
        light = recording["light"][frame >= recording["step_at"]]
        signals = np.minimum(light * pixels * time * gain, 1.0)
        zones, histogram = signals.mean(axis=1)[None], signal_histogram(signals.reshape(1, -1))
        begun = perf_counter()
        exposure = agc.update(zones, histogram, np.array([time * gain]))
        new_time, new_gain = agc.split(exposure)
        found["seconds"].append(perf_counter() - begun)
        asked.append((float(new_time[0]), float(new_gain[0])))
        found["exposure_s"].append(time)
        found["gain"].append(gain)
    return {name: np.array(values) for name, values in found.items()}


def compare(recording: Row, ours: dict[str, np.ndarray]) -> Row:
    """How far `ours` is from the recording: largest deviations, frames beyond `SAME`, settling.

    It has settled once the exposure is within `SAME` of its last value, and stays; frames count
    from the step.
    """
    theirs = {name: np.array(recording[name]) for name in ("exposure_s", "gain")}
    split = np.abs(ours["exposure_s"] / theirs["exposure_s"] - 1.0)
    row: Row = {"split_deviation": split.max()}
    both, settling = [one["exposure_s"] * one["gain"] for one in (ours, theirs)], []
    for exposure in both:
        away = np.abs(exposure[recording["step_at"] :] / exposure[-1] - 1.0) > SAME
        settling.append(int(np.flatnonzero(away)[-1]) + 1 if away.any() else 0)
    exposure = np.abs(both[0] / both[1] - 1.0)
    row |= {"exposure_deviation": exposure.max(), "exposures": [one.tolist() for one in both]}
    row |= {"frames_beyond": int((np.maximum(exposure, split) > SAME).sum())}
    row |= {"settling_ours": settling[0], "settling_theirs": settling[1]}
    return row | {"us_per_decision": 1e6 * float(np.median(ours["seconds"]))}


def measure(path: str) -> list[Row]:
    file, rows = json.loads(Path(path).read_text(encoding="utf-8")), []
    for recording in file["traces"]:
        ours = play(recording, file["meta"]["zone_factors"][recording["scene"]])
        rows.append(recording | compare(recording, ours))
    return rows


def parts(seed: int, quick: bool) -> list[Part]:
    path = data_folder(FOLDER) / FILE  # raises before any work
    return [Part("recordings", measure, {"path": str(path)}, threads=1)]


def traces(rows: list[Row]) -> Figure:
    curves, styles = [], ({"lw": 1, "c": "k", "zorder": 3}, {"lw": 3, "alpha": 0.4})
    for row in (rows[number] for number in SHOWN):
        lamps = ", 100 Hz lamps" if row["flicker_period_us"] else ""
        title = f"{row['scene']}, {row['step_ev']:+g} EV\n{row['metering']}, {row['constraint']}"
        first = row["step_at"] - 10
        for label, exposure, style in zip(
            ("ours", "libcamera"), row["exposures"], styles, strict=True
        ):
            curve: Row = {"panel": title + lamps, "label": label, "style": style}
            shown = exposure[first : first + 70]
            curves.append(curve | {"x": range(-10, len(shown) - 10), "y": shown})
    labels: Row = {"xlabel": "frames after the step", "ylabel": "exposure x gain [s]"}
    return panels(curves, yscale="log", **labels)


_COLUMNS = """scene = {scene} | light [EV] = {step_ev:+g} | metering = {metering} |
constraint = {constraint} | ladder = {exposure_mode} | lamps [us] = {flicker_period_us} |
exposure off by = {exposure_deviation:.2%} | shutter off by = {split_deviation:.2%} |
settling, libcamera = {settling_theirs} | ours = {settling_ours}"""
_SUMMARY = """exposure (time x gain) off by = {exposure_deviation:.2%} |
exposure time off by = {split_deviation:.2%} | settling differs by [frames] = {settling} |
one decision, median [us] = {us:.0f}"""


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows: list[Row] = results["recordings"]
    frame = pd.DataFrame(rows)
    summary = dict(frame[["exposure_deviation", "split_deviation"]].max())
    summary["settling"] = (frame["settling_ours"] - frame["settling_theirs"]).abs().max()
    summary["us"] = frame["us_per_decision"].median()
    tables = {"summary": table([summary], _SUMMARY), "recordings": table(rows, _COLUMNS)}
    long = ("exposure_s", "gain", "light", "exposures")
    kept = [{k: v for k, v in row.items() if k not in long} for row in rows]
    return Report(kept, tables, meta={"same": SAME}, figures={"libcamera.png": traces(rows)})


run = benchmark("libcamera", parts, report)
