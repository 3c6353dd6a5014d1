"""Real captures against the ones that are simulated from one of them.

    ae-env bench recorded
    ae-env bench recorded FOLDER

Of every scene of a recorded grid one capture is kept, the one that an average meter would have
taken, and all other states are simulated from it. Each is compared with the capture that was
really taken, and so are the scores. Without a folder: grids that the reference camera takes of
held-out radiance maps, written to files and read back, and the real bracket of
``boreal_brackets``. The alternative is the same capture, scaled by the exposure ratio and clipped.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from ae_env.grid import ExposureGrid
from ae_env.scenes import load_scenes
from ae_env.scenes.load import DEFAULT_SIMULATOR, SceneNetworks
from ae_env.scenes.recorded import PREFIX, RecordedOptions, merged_scene
from ae_env.scenes.scene import Crop, Scene
from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import ScoreTable, ScoreTables
from benchmarks import brackets
from benchmarks.brackets import texture, timed_result
from benchmarks.fidelity.models import radiance_views
from benchmarks.harness import Part, Report, Row, benchmark, clipped, data_folder, psnr, table
from simulator import RawImage, exposure_ratio, get_camera, write_dng
from simulator.radiance.light import MEAN_SIGNAL
from simulator.reference.camera import ReferenceCamera

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
    def smaller(scene: Scene, resolution: int | None, crop: Crop) -> Scene:
        return scene.resized(min(RESOLUTION, *scene.light.shape[1:]), crop)

    options: Any = {"camera": get_camera(CAMERA), "resolution": RESOLUTION, "resize": smaller}
    return load_scenes(_options(folder), "all", **options)


def _boreal(grid: ExposureGrid) -> list[Scene]:
    folder, scenes = data_folder(BOREAL), []
    for name in brackets.SCENES:
        taken = {t: brackets.load(folder, name, t)[0] for t in brackets.TIMES_MS}
        frames, _ = brackets.calibrated(taken)
        scenes.append(merged_scene(name, enumerate(frames.values()), grid, frames[1].camera))
    return [scene.resized(RESOLUTION) for scene in scenes]


# -- measuring ------------------------------------------------------------------------------------


@torch.no_grad()
def measure(source: str, seed: int, quick: bool, folder: str | None = None) -> list[Row]:
    linear_below = np.inf
    if folder is not None:
        scenes, grid = _of_folder(folder), _options(folder).grid
    elif source == REFERENCE:
        scenes, grid = _reference_grids(quick, seed), ExposureGrid.default()
    else:
        grid = ExposureGrid((100,), tuple(t / 1000 for t in brackets.TIMES_MS), (4,))
        scenes, linear_below = _boreal(grid), brackets.LINEAR_BELOW
    networks = SceneNetworks(DEFAULT_SIMULATOR, cache=False)
    found = [(s, _Comparison(s, grid, networks, seed, linear_below).rows()) for s in scenes]
    return [{"source": source, "scene": s.scene_id, **row} for s, rows in found for row in rows]


class _Comparison:
    """One scene's captures, and what is simulated from one of them."""

    def __init__(
        self,
        scene: Scene,
        grid: ExposureGrid,
        networks: SceneNetworks,
        seed: int,
        linear_below: float,
    ) -> None:
        assert scene.recorded is not None
        assert scene.allowed is not None
        self.scene, self.grid, self.networks, self.seed = scene, grid, networks, seed
        self.real, self.allowed = scene.recorded, scene.allowed
        # Of the recorded states the one whose mean of green is nearest to a right exposure's.
        means = self.real[:, 1:3].mean(dim=(1, 2, 3)).numpy()
        self.source = int(np.where(self.allowed, np.abs(means - MEAN_SIGNAL), np.inf).argmin())
        self.others = [s for s in np.flatnonzero(self.allowed).tolist() if s != self.source]
        self.tables = ScoreTables(grid, scene.camera, make_scorer("balanced"))
        self.true = self.tables.table(scene)
        brightest = torch.maximum(self.real[self.source], self.real).amax(dim=1)  # (S, H, W)
        self.known = self.real[self.source].amax(dim=0) < KNOWN_BELOW
        self.masks = self.known & (brightest < linear_below)
        raw = RawImage(
            self.real[self.source],
            grid[self.source],
            scene.camera,
            white_balance=scene.white_balance,
            box_factor=scene.box_factor,
        )
        self.light = Scene.from_raw(raw, scene_id=scene.scene_id)  # what one capture tells

    def rows(self) -> list[Row]:
        """A row for each method."""
        grid, light, camera = self.grid, self.light, self.scene.camera
        known = self.networks.denoised(light)

        def simulate() -> torch.Tensor:
            prepared = self.networks.denoised(light).prepared
            return torch.stack(list(prepared.stream(grid.states, seed=self.seed)))

        def scale() -> torch.Tensor:
            ratios = [exposure_ratio(light.reference, settings) for settings in grid]
            return torch.stack([clipped(light.light * ratio, camera) for ratio in ratios])

        (simulated, fast), (scaled, faster) = (timed_result(f, 3) for f in (simulate, scale))
        expected = clipped(known.prepared.expected_sweep(grid.states), camera)
        as_if_taken = replace(light, recorded=scaled, allowed=self.allowed)
        return [
            self._row("simulated", simulated, expected, self.tables.table(known), fast),
            self._row("scaled", scaled, scaled, self.tables.table(as_if_taken), faster),
        ]

    def _row(
        self,
        method: str,
        frames: torch.Tensor,
        expected: torch.Tensor,
        q: ScoreTable,
        milliseconds: float,
    ) -> Row:
        best = int(np.where(self.allowed, q.mean, -np.inf).argmax())
        errors = {s: self._psnr(frames[s], s) for s in self.others}
        ceilings = {s: _ceiling(self.scene, self.grid, s, self.masks[s]) for s in self.others}
        return {
            "method": method,
            "states": len(self.others) + 1,
            "source_state": str(self.grid[self.source]),
            "known_share": float(self.known.float().mean()),
            "psnr_all_db": _median([psnr(frames[s], self.real[s]) for s in self.others]),
            "psnr_db": _median(errors.values()),
            "ceiling_db": _median(ceilings.values()),
            "psnr_expected_db": _median([self._psnr(expected[s], s) for s in self.others]),
            "noise_error_stops": _median([self._noise_error(frames[s], s) for s in self.others]),
            "score_error": float(np.sqrt(np.mean((q.mean - self.true.mean)[self.others] ** 2))),
            "oracle_regret": float(self.true.mean[self.true.oracle] - self.true.mean[best]),
            "same_oracle": best == self.true.oracle,
            "ms_per_state": milliseconds / len(self.grid),
            "psnr_by_stops": self._by_stops(errors),
            "ceiling_by_stops": self._by_stops(ceilings),
        }

    def _psnr(self, frame: torch.Tensor, state: int) -> float | None:
        mask = self.masks[state]
        return psnr(frame[:, mask], self.real[state][:, mask]) if bool(mask.any()) else None

    def _noise_error(self, frame: torch.Tensor, state: int) -> float | None:
        """How many stops the noise is off, which detail that both have dilutes."""
        ours, theirs = (texture(f, self.masks[state]) for f in (frame, self.real[state]))
        return abs(float(np.log2(ours / theirs))) if min(ours, theirs) > 0.0 else None

    def _by_stops(self, values: Mapping[int, float | None]) -> dict[str, float | None]:
        stops = {s: np.log2(exposure_ratio(self.grid[self.source], self.grid[s])) for s in values}
        names, bounds = list(STOPS), [*STOPS.values(), np.inf]
        return {
            name: _median([v for s, v in values.items() if low <= stops[s] < high])
            for name, low, high in zip(names, bounds, bounds[1:], strict=False)
        }


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def _ceiling(scene: Scene, grid: ExposureGrid, state: int, mask: torch.Tensor) -> float | None:
    """PSNR of two captures of the same light, each with the camera's noise [dB]."""
    assert scene.recorded is not None
    signal = scene.recorded[state][:, mask]
    if not signal.numel():
        return None
    nlf = scene.camera.nlf(grid[state].iso).scaled(1.0 / scene.box_factor**2)
    shot, read = (torch.tensor(v)[:, None] for v in (nlf.shot, nlf.read))
    variance = (shot * signal.clamp(min=0.0) + read) * (signal < 1.0)
    noise = (2.0 * variance).sqrt()
    return psnr(noise, torch.zeros_like(noise))


# -- the report -----------------------------------------------------------------------------------


def parts(seed: int, quick: bool, folder: Path | None = None) -> list[Part]:
    shared: dict[str, Any] = {"seed": seed, "quick": quick}
    if folder is None:
        return [Part(name, measure, {"source": name, **shared}) for name in (REFERENCE, BOREAL)]
    assert _options(str(folder)).grid  # raises before any work
    name = folder.resolve().name.partition("?")[0]
    return [Part(name, measure, {"source": name, "folder": str(folder.resolve()), **shared})]


_COLUMNS = """PSNR, all pixels [dB] = {psnr_all_db:.1f} | PSNR, known [dB] = {psnr_db:.1f} |
two real captures [dB] = {ceiling_db:.1f} | without its noise [dB] = {psnr_expected_db:.1f} |
noise off by [stop] = {noise_error_stops:.2f} | score error = {score_error:.3f} |
oracle's regret = {oracle_regret:.3f} | ms a state = {ms_per_state:.1f}"""
_REGRET = "mean = {mean:.3f} | upper quartile = {upper:.3f} | largest = {most:.3f}"


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
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
    each = (
        "scene = {scene} | from = {source_state} | states = {states} | known = {known_share:.1%} | "
    )
    same, number = " | same oracle = {same_oracle:.0%}", "number = {number} | "
    every = [row | {"title": METHODS[row["method"]]} for row in rows]
    by_stops = " | ".join(f"{name} = {{{name}:.1f}}" for name in STOPS)
    tables = {
        "sets": table(sets, of_set + method + number + _COLUMNS + same),
        "regret": table([regret], _REGRET),
        "by_stops": table(stops, of_set + method + by_stops),
        "scenes": table(every, each + method + _COLUMNS),
    }
    return Report(rows, tables)


run = benchmark("recorded", parts, report)
