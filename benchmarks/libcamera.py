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
from benchmarks.harness import Benchmark, Part, Report, Row, data_folder, table

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

    Args:
        recording: An entry of ``traces`` of the file.
        zone_factors: Light of each of its 15 zones, relative to that of the recording.

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
    """How far `ours` is from the recording: largest deviations, frames beyond `SAME`, settling."""
    theirs = {name: np.array(recording[name]) for name in ("exposure_s", "gain")}
    both = [one["exposure_s"] * one["gain"] for one in (ours, theirs)]
    exposure = np.abs(both[0] / both[1] - 1.0)
    split = np.abs(ours["exposure_s"] / theirs["exposure_s"] - 1.0)
    return {
        "exposure_deviation": exposure.max(),
        "split_deviation": split.max(),
        "frames_beyond": int((np.maximum(exposure, split) > SAME).sum()),
        "settling_ours": settling(both[0], recording["step_at"]),
        "settling_theirs": settling(both[1], recording["step_at"]),
        "us_per_decision": 1e6 * float(np.median(ours["seconds"])),
    }


def settling(exposure: np.ndarray, step_at: int) -> int:
    """Frames from the step on until `exposure` is within `SAME` of its last value, and stays."""
    away = np.abs(exposure[step_at:] / exposure[-1] - 1.0) > SAME
    return int(np.flatnonzero(away)[-1]) + 1 if away.any() else 0


def measure(path: str) -> list[Row]:
    """A row for each recording; those that are drawn have both traces."""
    file, rows = json.loads(Path(path).read_text(encoding="utf-8")), []
    for number, recording in enumerate(file["traces"]):
        ours = play(recording, file["meta"]["zone_factors"][recording["scene"]])
        names = ("metering", "constraint", "exposure_mode", "scene", "step_ev", "flicker_period_us")
        row: Row = {name: recording[name] for name in names} | compare(recording, ours)
        if number in SHOWN:
            exposures = {"ours": ours, "theirs": recording}
            row["traces"] = {
                whose: (np.array(t["exposure_s"]) * np.array(t["gain"])).tolist()
                for whose, t in exposures.items()
            }
            row["step_at"] = recording["step_at"]
        rows.append(row)
    return rows


def parts(seed: int, quick: bool) -> list[Part]:
    """All recordings at once: nothing is random and it takes seconds."""
    path = data_folder(FOLDER) / FILE  # raises before any work
    return [Part("recordings", measure, {"path": str(path)}, threads=1)]


def traces(rows: list[Row]) -> Figure:
    """Exposure over the frames, theirs and ours."""
    figure = Figure(figsize=(10, 5), layout="constrained")
    shown = [row for row in rows if "traces" in row]
    for axis, row in zip(figure.subplots(2, 3, sharex=True).flat, shown, strict=True):
        first = row["step_at"] - 10
        for whose, style in (("theirs", {"lw": 3, "alpha": 0.4}), ("ours", {"lw": 1, "c": "k"})):
            exposure = row["traces"][whose][first : first + 70]
            label = {"theirs": "libcamera", "ours": "ours"}[whose]
            axis.plot(range(-10, len(exposure) - 10), exposure, label=label, **style)
        lamps = ", 100 Hz lamps" if row["flicker_period_us"] else ""
        title = f"{row['scene']}, {row['step_ev']:+g} EV\n{row['metering']}, {row['constraint']}"
        axis.set_title(title + lamps, fontsize=9)
        axis.set(yscale="log", xlabel="frames after the step", ylabel="exposure x gain [s]")
        axis.label_outer()
    axis.legend()
    return figure


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """The report, of the rows of all recordings."""
    rows: list[Row] = results["recordings"]
    frame = pd.DataFrame(rows)
    settling = (frame["settling_ours"] - frame["settling_theirs"]).abs()
    summary = dict(frame[["exposure_deviation", "split_deviation"]].max())
    summary |= {"settling": settling.max(), "us": frame["us_per_decision"].median()}
    summary_columns = {
        "exposure (time x gain) off by": "{exposure_deviation:.2%}",
        "exposure time off by": "{split_deviation:.2%}",
        "settling differs by [frames]": "{settling}",
        "one decision, median [us]": "{us:.0f}",
    }
    columns = {
        "scene": "{scene}",
        "light [EV]": "{step_ev:+g}",
        "metering": "{metering}",
        "constraint": "{constraint}",
        "ladder": "{exposure_mode}",
        "lamps [us]": "{flicker_period_us}",
        "exposure off by": "{exposure_deviation:.2%}",
        "shutter off by": "{split_deviation:.2%}",
        "settling, libcamera": "{settling_theirs}",
        "ours": "{settling_ours}",
    }
    tables = {"summary": table([summary], summary_columns), "recordings": table(rows, columns)}
    return Report(rows, tables, meta={"same": SAME}, figures={"libcamera.png": traces(rows)})


BENCHMARK = Benchmark(
    name="libcamera",
    title="libcamera's auto exposure and our model of it",
    parts=parts,
    report=report,
    code=("agents/metering", "benchmarks/libcamera"),
)
run = BENCHMARK.run
