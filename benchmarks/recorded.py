"""Real captures against the ones that are simulated from one of them.

    ae-env bench recorded
    ae-env bench recorded FOLDER

All states are simulated from the capture that an average meter would have taken, and each is
compared with the capture that was really taken; so are the scores. Without a folder: grids that the
reference camera takes of held-out radiance maps, and the real brackets of ``boreal_brackets``,
whose exposure ratios are measured, too. The alternative is the same capture, scaled and clipped.
"""

import itertools
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from skimage.io import imread
from skimage.measure import block_reduce

from ae_env.grid import ExposureGrid
from ae_env.scenes import load_scenes
from ae_env.scenes.load import DEFAULT_SIMULATOR, SceneNetworks
from ae_env.scenes.recorded import PREFIX, RecordedOptions, merged_scene
from ae_env.scenes.scene import Scene
from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import ScoreTables
from benchmarks.fidelity.models import radiance_views
from benchmarks.harness import Part, Report, Row, benchmark, clipped, pivot, psnr, real_files, table
from benchmarks.isolated import median_seconds
from simulator import CameraSettings, RawImage, exposure_ratio, get_camera, write_dng
from simulator.camera import BayerPattern, CameraProfile
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.radiance.light import MEAN_SIGNAL
from simulator.raw.image import PLANES
from simulator.raw.noise_estimation import estimate_nlf
from simulator.reference.reference_camera import ReferenceCamera

CAMERA = "nikon_z6"
#: Side of a frame [packed pixel].
RESOLUTION = 128
METHODS = {
    "simulated": f"**simulated, `{DEFAULT_SIMULATOR}`**",
    "scaled": "scaled by the exposure ratio, clipped",
}
#: Signal from which on a pixel of the source may be clipped, averaged or not: nobody knows more.
KNOWN_BELOW = 0.8
#: Stops between the source and a state, in groups, by the least of each.
STOPS = {
    "over 6 darker": -np.inf,
    "3 to 6 darker": -6.0,
    "to 3 darker": -3.0,
    "as bright": -0.5,
    "to 3 brighter": 0.5,
    "over 3 brighter": 3.0,
}
#: Sets of scenes; a folder of the user's own is named after it.
REFERENCE, BOREAL = "reference camera", "boreal_brackets"


# -- grids ----------------------------------------------------------------------------------------


def _reference_grids(quick: bool, seed: int) -> list[Scene]:
    """Grids that the reference camera photographs, written to DNGs and read back."""
    camera, body = get_camera(CAMERA), ReferenceCamera(get_camera(CAMERA))
    with tempfile.TemporaryDirectory() as folder:
        for scene in radiance_views(CAMERA, RESOLUTION)[: 2 if quick else None]:
            Path(folder, scene.group).mkdir()
            for number, settings in enumerate(ExposureGrid.default()):
                sample = body.capture(scene, settings, seed).sample
                raw = RawImage(sample, settings, camera, white_balance=scene.white_balance)
                write_dng(Path(folder, scene.group, f"state_{number:02d}.dng"), raw)
        return _of_folder(folder)


def _options(folder: str) -> RecordedOptions:
    found = RecordedOptions.of(f"{PREFIX}{folder}")
    assert found is not None
    return found


def _of_folder(folder: str) -> list[Scene]:
    options: Any = {"camera": get_camera(CAMERA), "resolution": RESOLUTION}
    options["resize"] = lambda s, _, crop: s.resized(min(RESOLUTION, *s.light.shape[1:]), crop)
    return load_scenes(_options(folder), "all", **options)


# -- real brackets --------------------------------------------------------------------------------

#: The first is static, the second moves.
BRACKETS, TIMES_MS = ("left_c0", "left_c5"), (1, 2, 4, 8, 16, 32)
#: Above this level the published response curve is not linear any more (see the ratios).
LINEAR_BELOW = 0.4
#: Side of the blocks that exposure ratios are measured on [packed pixel].
BLOCK = 8
#: For measurement only. The files' largest code is 4094: saturation, 4089 after linearising.
_BOREAL = CameraProfile("boreal_left", BayerPattern.RGGB, (0.0,) * 4, 4089, 12, source="BorealHDR")


def _bracket(name: str) -> dict[int, RawImage]:
    """Frames by time [ms], linearised as the data's README says; gain and aperture are fixed."""
    folder = real_files(BOREAL)
    curve = 16.0 * np.loadtxt(next(folder.glob("pcalib*.txt"))).ravel()
    curve[0], curve[-1] = 0.0, 4095.0
    frames = {}
    for time in TIMES_MS:
        (path,) = folder.glob(f"{name}_{time:04.1f}ms_*.png")
        linear = np.interp(imread(path), np.linspace(0, 4095, 256), curve)
        linear = np.minimum(linear, _BOREAL.white_level)
        frames[time] = RawImage.from_mosaic(linear, CameraSettings(100, time / 1000, 4), _BOREAL)
    return frames


def _boreal(grid: ExposureGrid) -> list[Scene]:
    scenes = []
    for name in BRACKETS:
        frames = _bracket(name)
        estimates = map(estimate_nlf, (frame.data for frame in frames.values()))
        found = np.median([(one.shot, one.read) for one in estimates], axis=0)
        shot, read = map(tuple, found.tolist())
        camera = _BOREAL.with_nlf(100, NoiseLevelFunction(shot, read, source="blind, median of 6"))
        raws = (replace(frame, camera=camera) for frame in frames.values())
        scenes.append(merged_scene(name, enumerate(raws), grid, camera))
    return [scene.resized(RESOLUTION) for scene in scenes]


def ratios() -> list[Row]:
    """Exposure ratio of consecutive frames, per plane, on block means.

    Blocks are selected by the mean of both frames: selecting by one would favour its noise.
    """
    rows, reduced = [], partial(block_reduce, block_size=(1, BLOCK, BLOCK))
    for name in BRACKETS:
        data = {t: frame.data.double().numpy() for t, frame in _bracket(name).items()}
        for shorter, longer in itertools.pairwise(TIMES_MS):
            x, y = (reduced(data[t], func=np.mean) for t in (shorter, longer))
            level, peak = x + y / 2, reduced(data[longer], func=np.max)
            chosen = (level > 0.02) & (level < LINEAR_BELOW) & (peak < KNOWN_BELOW)
            for plane, a, b, use in zip(PLANES, x, y, chosen, strict=True):
                row: Row = {"part": "ratio", "scene": name, "source_ms": shorter, "plane": plane}
                row |= {"target_ms": longer, "median": np.median(b[use] / a[use])}
                rows.append(row | {"least_squares": a[use] @ b[use] / (a[use] @ a[use])})
    return rows


# -- measuring ------------------------------------------------------------------------------------


@torch.no_grad()
def measure(source: str, seed: int, quick: bool, folder: str | None = None) -> list[Row]:
    linear_below = np.inf
    if folder is not None:
        scenes, grid = _of_folder(folder), _options(folder).grid
    elif source == REFERENCE:
        scenes, grid = _reference_grids(quick, seed), ExposureGrid.default()
    else:
        grid = ExposureGrid((100,), tuple(t / 1000 for t in TIMES_MS), (4,))
        scenes, linear_below = _boreal(grid), LINEAR_BELOW
    networks = SceneNetworks(DEFAULT_SIMULATOR, cache=False)
    found = [(s, _compared(s, grid, networks, seed, linear_below)) for s in scenes]
    return [{"source": source, "scene": s.scene_id, **row} for s, rows in found for row in rows]


def _compared(
    scene: Scene, grid: ExposureGrid, networks: SceneNetworks, seed: int, linear_below: float
) -> Iterator[Row]:
    """A row for each method, of one scene's captures and what is simulated from one of them."""
    assert scene.recorded is not None
    assert scene.allowed is not None
    real, there, camera = scene.recorded[scene.frame_of_state], scene.allowed, scene.camera
    # Of the recorded states the one whose mean of green is nearest to a right exposure's.
    means = real[:, 1:3].mean(dim=(1, 2, 3)).numpy()
    source = int(np.where(there, np.abs(means - MEAN_SIGNAL), np.inf).argmin())
    others = [s for s in np.flatnonzero(there).tolist() if s != source]
    look: Any = {"white_balance": scene.white_balance, "box_factor": scene.box_factor}
    raw = RawImage(real[source], grid[source], camera, **look)
    light = Scene.from_raw(raw, scene_id=scene.scene_id)  # what one capture tells
    tables, clean = ScoreTables(grid, camera, make_scorer("balanced")), networks.denoised(light)
    true, known = tables.table(scene), real[source].amax(dim=0) < KNOWN_BELOW
    brightest = torch.maximum(real[source], real).amax(dim=1)  # (S, H, W)
    masks = known & (brightest < linear_below)
    ratios = [exposure_ratio(grid[source], s) for s in grid]

    def simulate() -> torch.Tensor:
        prepared = networks.denoised(light).prepared
        return torch.stack(list(prepared.stream(grid.states, seed=seed)))

    def scale() -> torch.Tensor:
        return torch.stack([clipped(light.light * ratio, camera) for ratio in ratios])

    for method, call in (("simulated", simulate), ("scaled", scale)):
        frames, milliseconds = call(), 1e3 * median_seconds(call, least=0.0)
        expected, q = frames, tables.table(replace(light, recorded=frames[there], allowed=there))
        if method == "simulated":
            every = torch.stack([clean.prepared.expected(state) for state in grid.states])
            expected = clipped(every, camera)
            q = tables.table(clean)
        states = []
        for s in others:
            mask, state = masks[s], {"psnr_all_db": psnr(frames[s], real[s])}
            if mask.any():
                truth, of_two = real[s][:, mask], _ceiling(scene, grid, s, mask)
                state |= {"psnr_db": psnr(frames[s][:, mask], truth), "ceiling_db": of_two}
                state["psnr_expected_db"] = psnr(expected[s][:, mask], truth)
            whole = mask[:-1, :-1] & mask[1:, :-1] & mask[:-1, 1:] & mask[1:, 1:]
            # How many stops the noise is off, which detail that both have dilutes.
            ours, theirs = (texture(frame[s], whole) for frame in (frames, real))
            if min(ours, theirs) > 0.0:
                state["noise_error_stops"] = abs(float(np.log2(ours / theirs)))
                state["distance"] = _distance(state["psnr_db"], state["ceiling_db"], ours - theirs)
            states.append(state)
        frame = pd.DataFrame(states)
        bounds, apart = [*STOPS.values(), np.inf], np.log2(ratios)[others]
        stops = pd.Series(pd.cut(apart, bounds, False, labels=list(STOPS)))
        by_stops = frame.groupby(stops, observed=False)[["psnr_db", "ceiling_db"]].median()
        row: Row = {"method": method, "states": len(others) + 1, "source_state": str(grid[source])}
        row |= {"known_share": float(known.float().mean()), **frame.median()}
        row["score_error"] = float(np.sqrt(np.mean((q.mean - true.mean)[others] ** 2)))
        best = int(np.where(there, q.mean, -np.inf).argmax())
        row["oracle_regret"] = float(true.mean[true.oracle] - true.mean[best])
        row |= {"same_oracle": best == true.oracle, "ms_per_state": milliseconds / len(grid)}
        row["psnr_by_stops"] = by_stops["psnr_db"].to_dict()
        yield row | {"ceiling_by_stops": by_stops["ceiling_db"].to_dict()}


def texture(image: torch.Tensor, use: torch.Tensor) -> float:
    """Mean square of the diagonal difference of 2 x 2 neighbours: noise, and detail alike.

    `use` (H - 1, W - 1) chooses them; 0 where it is nowhere true.
    """
    a, b, c, d = (image[:, i : i - 1 or None, j : j - 1 or None] for i in (0, 1) for j in (0, 1))
    return float(((a - b - c + d) / 2.0)[:, use].square().mean()) if use.any() else 0.0


def _distance(psnr_db: float, ceiling_db: float, added: float) -> float:
    """Distance of distributions, from a frame of each; `added`: variance beyond the real one's."""
    square, noise = 10.0 ** (-psnr_db / 10.0), 0.5 * 10.0 ** (-ceiling_db / 10.0)
    spread = max(noise + added, 0.0)
    apart = max(square - spread - noise, 0.0) + (spread**0.5 - noise**0.5) ** 2
    return float((apart / noise) ** 0.5) if noise else np.nan


def _ceiling(scene: Scene, grid: ExposureGrid, state: int, mask: torch.Tensor) -> float:
    """PSNR of two captures of the same light, each with the camera's noise [dB]."""
    assert scene.recorded is not None
    signal = scene.recorded[scene.frame_of_state[state]][:, mask]
    nlf = scene.camera.nlf(grid[state].iso).scaled(1.0 / scene.box_factor**2)
    shot, read = (torch.tensor(v)[:, None] for v in (nlf.shot, nlf.read))
    variance = (shot * signal.clamp(min=0.0) + read) * (signal < 1.0)
    return psnr((2.0 * variance).sqrt(), torch.zeros_like(variance))


# -- the report -----------------------------------------------------------------------------------


def parts(seed: int, quick: bool, folder: Path | None = None) -> list[Part]:
    if folder is None:
        sets = [Part(name, measure, {"source": name}) for name in (REFERENCE, BOREAL)]
        return [Part("ratios", ratios), *sets]
    assert _options(str(folder)).grid  # raises before any work
    name = folder.resolve().name.partition("?")[0]
    return [Part(name, measure, {"source": name, "folder": str(folder.resolve())})]


_COLUMNS = """PSNR, all pixels [dB] = {psnr_all_db:.1f} | PSNR, known [dB] = {psnr_db:.1f} |
two real captures [dB] = {ceiling_db:.1f} | without its noise [dB] = {psnr_expected_db:.1f} |
distance of distributions = {distance:.2f} | noise off by [stop] = {noise_error_stops:.2f} |
score error = {score_error:.3f} |
oracle's regret = {oracle_regret:.3f}"""
_TIME = " | ms a state = {ms_per_state:.1f}"
_REGRET = "mean = {mean:.3f} | upper quartile = {upper:.3f} | largest = {most:.3f}"


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    steps = results.pop("ratios", [])
    rows = [row for own in results.values() for row in own]
    frame = pd.json_normalize(rows)  # columns such as "psnr_by_stops.as bright"
    sets, stops = [], []
    for (source, method), own in frame.groupby(["source", "method"], sort=False):
        head: Row = {"scenes": source, "title": METHODS[str(method)], "number": len(own)}
        means = own.drop(columns=["source", "method"]).mean(numeric_only=True)
        sets.append({**head, **means})
        stops.append(head | {name: means.get(f"psnr_by_stops.{name}") for name in STOPS})
        if method == list(METHODS)[-1]:
            ceilings = {name: means.get(f"ceiling_by_stops.{name}") for name in STOPS}
            stops.append(head | {"title": "two real captures"} | ceilings)
    regrets = frame.loc[frame["method"] == "simulated", "oracle_regret"]
    regret = {"mean": regrets.mean(), "upper": regrets.quantile(0.75), "most": regrets.max()}
    of_set, method = "scenes = {scenes} | ", "method = {title:md} | "
    each = "scene = {scene} | from = {source_state} | states = {states} | "
    each += "known = {known_share:.1%} | "
    same, number = " | same oracle = {same_oracle:.0%}", "number = {number} | "
    every = [row | {"title": METHODS[row["method"]]} for row in rows]
    by_stops = " | ".join(f"{name} = {{{name}:.1f}}" for name in STOPS)
    line = "scene, frames = {scene}, {source_ms} to {target_ms} ms"
    tables = {
        "ratios": pivot(steps, line, "{plane}", "{median:.3f} ({least_squares:.3f})"),
        "sets": table(sets, of_set + method + number + _COLUMNS + same + _TIME),
        "regret": table([regret], _REGRET),
        "by_stops": table(stops, of_set + method + by_stops),
        "scenes": table(every, each + method + _COLUMNS + _TIME),
    }
    return Report([*steps, *rows], tables)


run = benchmark("recorded", parts, report)
