"""Real captures against the ones that are simulated from one of them.

    ae-env bench recorded
    ae-env bench recorded FOLDER

Of every scene of a recorded grid one capture is kept, the one that an average meter would have
taken, and all other states are simulated from it. Each is compared with the capture that was
really taken, and so are the scores. Without a folder: grids that the reference camera takes of
held-out radiance maps, written to files and read back, and the real bracket of
``boreal_brackets``. Scaled by the exposure ratio and clipped, the same capture is the alternative.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ae_env.grid import ExposureGrid
from ae_env.scenes import load_scenes
from ae_env.scenes.loading import DEFAULT_SIMULATOR, SceneNetworks
from ae_env.scenes.recorded import RecordedOptions, merged_scene
from ae_env.scenes.reference_scenes import reference_scenes
from ae_env.scenes.scene import MEAN_SIGNAL, Scene
from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import ScoreTable, ScoreTables
from benchmarks import brackets
from benchmarks.captures import clipped, psnr
from benchmarks.fidelity.models import checksums
from benchmarks.harness import (
    Benchmark,
    Part,
    Report,
    Row,
    data_root,
    quartiles,
    table,
)
from simulator import RawImage, exposure_ratio, get_camera, write_dng
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene

CAMERA = "nikon_z6"
#: Side of a frame [packed pixel].
RESOLUTION = 128
METHODS = {
    "simulated": f"**simulated, `{DEFAULT_SIMULATOR}`**",
    "scaled": "scaled by the exposure ratio, clipped",
}
#: Sets of scenes; a folder of the user's own is named after it.
REFERENCE, BOREAL = "reference camera", "boreal_brackets"


# -- grids ----------------------------------------------------------------------------------------


def write_grid(folder: Path, scene: ReferenceScene, grid: ExposureGrid, *, seed: int = 0) -> None:
    """Photographs every state of `grid` with the reference camera: one DNG a state in `folder`."""
    camera = get_camera(CAMERA)
    body = ReferenceCamera(camera)
    folder.mkdir(parents=True, exist_ok=True)
    for number, settings in enumerate(grid):
        sample = body.capture(scene, settings, seed).sample
        raw = RawImage(sample, settings, camera, white_balance=scene.white_balance)
        write_dng(folder / f"state_{number:02d}.dng", raw)


def _reference_grids(quick: bool, seed: int) -> list[Scene]:
    camera = get_camera(CAMERA)
    found = reference_scenes("test", camera, number=0, size=RESOLUTION, data=data_root())
    groups = {s.group: s for s in reversed(found) if s.kind == "radiance" and s.pitch == 2}
    grid = ExposureGrid.default()
    with tempfile.TemporaryDirectory() as folder:
        for name, scene in list(groups.items())[: 2 if quick else None]:
            write_grid(Path(folder) / name, scene, grid, seed=seed)
        return _of_folder(folder)


def _of_folder(folder: str) -> list[Scene]:
    camera = get_camera(CAMERA)
    scenes = load_scenes(f"recorded:{folder}", "all", camera=camera, resolution=None)
    smaller = (min(RESOLUTION, *scene.light.shape[1:]) for scene in scenes)
    return [scene.resized(side) for scene, side in zip(scenes, smaller, strict=True)]


def _boreal() -> list[Scene]:
    folder = data_root() / BOREAL
    grid = ExposureGrid((100,), tuple(t / 1000 for t in brackets.TIMES_MS), (4,))
    scenes = []
    for name in brackets.SCENES:
        frames, _ = brackets.calibrated(
            {t: brackets.load(folder, name, t)[0] for t in brackets.TIMES_MS}
        )
        scenes.append(merged_scene(name, enumerate(frames.values()), grid, frames[1].camera))
    return [scene.resized(RESOLUTION) for scene in scenes]


# -- measuring ------------------------------------------------------------------------------------


@torch.no_grad()
def measure(source: str, seed: int, quick: bool, folder: str | None = None) -> list[Row]:
    """Rows of one set of scenes, one for each scene and method."""
    if folder is not None:
        scenes, grid = _of_folder(folder), RecordedOptions(Path(folder)).grid
    elif source == REFERENCE:
        scenes, grid = _reference_grids(quick, seed), ExposureGrid.default()
    else:
        scenes = _boreal()
        grid = ExposureGrid((100,), tuple(t / 1000 for t in brackets.TIMES_MS), (4,))
    networks = SceneNetworks(DEFAULT_SIMULATOR, cache=False)
    rows = []
    for scene in scenes:
        rows += [{"source": source, **row} for row in _compared(scene, grid, networks, seed)]
    return rows


def source_state(scene: Scene) -> int:
    """The recorded state whose mean of green is nearest to a right exposure's."""
    assert scene.recorded is not None
    means = scene.recorded[:, 1:3].mean(dim=(1, 2, 3)).numpy()
    return int(np.where(scene.allowed, np.abs(means - MEAN_SIGNAL), np.inf).argmin())


def _compared(scene: Scene, grid: ExposureGrid, networks: SceneNetworks, seed: int) -> list[Row]:
    source, camera = source_state(scene), scene.camera
    real, allowed = scene.recorded, scene.allowed
    assert real is not None
    assert allowed is not None
    tables = ScoreTables(grid, camera, make_scorer("balanced"))
    true = tables.table(scene)
    others = [s for s in np.flatnonzero(allowed).tolist() if s != source]
    stops = [abs(np.log2(exposure_ratio(grid[source], grid[s]))) for s in others]
    known = _known(scene, source, grid)
    makers: dict[str, Callable[[], tuple[torch.Tensor, ScoreTable]]] = {
        "simulated": partial(_simulated, known, grid, tables, networks, seed),
        "scaled": partial(_scaled, known, scene, grid, tables),
    }
    rows = []
    for method, make in makers.items():
        begin = time.perf_counter()
        frames, q = make()
        seconds = time.perf_counter() - begin
        errors = [psnr(frames[s], real[s]) for s in others]
        best = int(np.where(allowed, q.mean, -np.inf).argmax())
        far = [e for e, stop in zip(errors, stops, strict=True) if stop > 3.0]
        rows.append(
            {
                "scene": scene.scene_id,
                "method": method,
                "states": len(others) + 1,
                "source_state": str(grid[source]),
                "psnr_db": float(np.median(errors)),
                "psnr_db_beyond_3_stops": float(np.median(far)) if far else None,
                "ceiling_db": float(np.median([_ceiling(scene, grid, s) for s in others])),
                "score_error": float(np.sqrt(np.mean((q.mean - true.mean)[others] ** 2))),
                "oracle_regret": float(true.mean[true.oracle] - true.mean[best]),
                "same_oracle": best == true.oracle,
                "ms_per_state": 1e3 * seconds / len(grid),
            }
        )
    return rows


def _known(scene: Scene, source: int, grid: ExposureGrid) -> Scene:
    """What one capture tells of the scene."""
    assert scene.recorded is not None
    raw = RawImage(
        scene.recorded[source],
        grid[source],
        scene.camera,
        white_balance=scene.white_balance,
        box_factor=scene.box_factor,
    )
    return Scene.from_raw(raw, scene_id=scene.scene_id)


def _simulated(
    known: Scene, grid: ExposureGrid, tables: ScoreTables, networks: SceneNetworks, seed: int
) -> tuple[torch.Tensor, ScoreTable]:
    scene = networks.denoised(known)
    frames = torch.stack(list(scene.prepared.stream(grid.states, seed=seed)))
    return frames, tables.table(scene)


def _scaled(
    known: Scene, scene: Scene, grid: ExposureGrid, tables: ScoreTables
) -> tuple[torch.Tensor, ScoreTable]:
    ratios = [exposure_ratio(known.reference, settings) for settings in grid]
    frames = torch.stack([clipped(known.light * ratio, known.camera) for ratio in ratios])
    scaled = replace(known, recorded=frames, allowed=scene.allowed)
    return frames, tables.table(scaled)


def _ceiling(scene: Scene, grid: ExposureGrid, state: int) -> float:
    """PSNR of two captures of the same light, each with the camera's noise [dB]."""
    assert scene.recorded is not None
    signal = scene.recorded[state]
    nlf = scene.camera.nlf(grid[state].iso).scaled(1.0 / scene.box_factor**2)
    shot, read = (torch.tensor(v)[:, None, None] for v in (nlf.shot, nlf.read))
    variance = (shot * signal.clamp(min=0.0) + read) * (signal < 1.0)
    noise = (2.0 * variance).sqrt()
    return psnr(noise, torch.zeros_like(noise))


# -- the report -----------------------------------------------------------------------------------


def parts(seed: int, quick: bool, folder: Path | None = None) -> list[Part]:
    """One part for each set of scenes."""
    shared: dict[str, Any] = {"seed": seed, "quick": quick}
    depends = checksums(DEFAULT_SIMULATOR)
    if folder is not None:
        name = folder.resolve().name
        arguments = {"source": name, "folder": str(folder.resolve()), **shared}
        return [Part(name, measure, arguments, depends=depends)]
    return [
        Part(name, measure, {"source": name, **shared}, depends=depends)
        for name in (REFERENCE, BOREAL)
    ]


_COLUMNS: dict[str, Any] = {
    "scenes": "{source}",
    "method": "{title}",
    "number": "{number}",
    "PSNR [dB]": "{psnr_db:.1f}",
    "beyond 3 stops": "{psnr_db_beyond_3_stops:.1f}",
    "two real captures": "{ceiling_db:.1f}",
    "score error": "{score_error:.3f}",
    "oracle's regret": "{oracle_regret:.3f}",
    "same oracle": "{same_oracle:.0%}",
    "ms a state": "{ms_per_state:.1f}",
}


def _summary(rows: Sequence[Row]) -> list[Row]:
    """Means over the scenes of a set, for each method."""
    found = []
    for source in dict.fromkeys(row["source"] for row in rows):
        for method, title in METHODS.items():
            own = [r for r in rows if r["source"] == source and r["method"] == method]
            numbers: Row = {"source": source, "title": title, "number": len(own)}
            for name in own[0]:
                values = [row[name] for row in own if isinstance(row[name], int | float)]
                if values and name not in numbers:
                    numbers[name] = float(np.mean(values))
            found.append(numbers)
    return found


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """The page: one row a set and method, then the scenes."""
    rows = [row for own in results.values() for row in own]
    regrets = [r["oracle_regret"] for r in rows if r["method"] == "simulated"]
    page = [
        "One capture of each recorded grid, the one whose mean is nearest to a right exposure, "
        "and every other state simulated from it, against the captures that were really taken. "
        f"Frames of {RESOLUTION} x {RESOLUTION} packed pixels; `balanced` scores. PSNR is between "
        "two noisy frames, median over the states: two real captures of one light reach what "
        "their noise allows, by the camera's calibration. The oracle's regret is what is lost in "
        "the real scores where the best state is chosen by the simulated ones; the score error is "
        "the root mean square over the states.",
        table(_summary(rows), _COLUMNS),
        f"The simulated oracle loses {np.mean(regrets):.3f} in the mean, "
        f"{quartiles(regrets)[2]:.3f} at the upper quartile, {max(regrets):.3f} at most.",
        "## Scenes",
        table(
            [{**row, "title": METHODS[row["method"]]} for row in rows],
            {"scene": "{scene}", "from": "{source_state}", "states": "{states}"}
            | {k: v for k, v in _COLUMNS.items() if k not in ("scenes", "number", "same oracle")},
        ),
    ]
    return Report(rows, page)


BENCHMARK = Benchmark(
    name="recorded",
    title="Recorded grids",
    parts=parts,
    report=report,
    code=("simulator", "ae_env", "benchmarks/recorded", "benchmarks/brackets"),
)
run = BENCHMARK.run
