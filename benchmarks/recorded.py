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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ae_env.grid import ExposureGrid
from ae_env.scenes import load_scenes
from ae_env.scenes.load import DEFAULT_SIMULATOR, SceneNetworks
from ae_env.scenes.recorded import PREFIX, RecordedOptions, merged_scene
from ae_env.scenes.scene import Crop, Scene
from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import ScoreTable, ScoreTables
from benchmarks import brackets
from benchmarks.brackets import timed_result
from benchmarks.fidelity.models import checksums
from benchmarks.harness import (
    Benchmark,
    Part,
    Report,
    Row,
    clipped,
    data_root,
    psnr,
    quartiles,
    table,
)
from simulator import RawImage, exposure_ratio, get_camera, write_dng
from simulator.radiance.light import MEAN_SIGNAL
from simulator.reference.camera import ReferenceCamera, ReferenceScene
from simulator.training.scenes import reference_scenes

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


def _options(folder: str) -> RecordedOptions:
    found = RecordedOptions.of(f"{PREFIX}{folder}")
    assert found is not None
    return found


def _of_folder(folder: str) -> list[Scene]:
    def smaller(scene: Scene, resolution: int | None, crop: Crop) -> Scene:
        return scene.resized(min(RESOLUTION, *scene.light.shape[1:]), crop)

    options: Any = {"camera": get_camera(CAMERA), "resolution": RESOLUTION, "resize": smaller}
    return load_scenes(_options(folder), "all", **options)


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
    linear_below = np.inf
    if folder is not None:
        scenes, grid = _of_folder(folder), _options(folder).grid
    elif source == REFERENCE:
        scenes, grid = _reference_grids(quick, seed), ExposureGrid.default()
    else:
        scenes, linear_below = _boreal(), brackets.LINEAR_BELOW
        grid = ExposureGrid((100,), tuple(t / 1000 for t in brackets.TIMES_MS), (4,))
    networks = SceneNetworks(DEFAULT_SIMULATOR, cache=False)
    found = [(s, _Comparison(s, grid, networks, seed, linear_below).rows()) for s in scenes]
    return [{"source": source, "scene": s.scene_id, **row} for s, rows in found for row in rows]


def source_state(scene: Scene) -> int:
    """The recorded state whose mean of green is nearest to a right exposure's."""
    assert scene.recorded is not None
    means = scene.recorded[:, 1:3].mean(dim=(1, 2, 3)).numpy()
    return int(np.where(scene.allowed, np.abs(means - MEAN_SIGNAL), np.inf).argmin())


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
        self.source = source_state(scene)
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
        ours, theirs = (_texture(f, self.masks[state]) for f in (frame, self.real[state]))
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


def _texture(frame: torch.Tensor, mask: torch.Tensor) -> float:
    """Mean square of the diagonal difference of 2 x 2 neighbours, all of them in `mask`."""
    a, b, c, d = (frame[:, i : i - 1 or None, j : j - 1 or None] for i in (0, 1) for j in (0, 1))
    inside = mask[:-1, :-1] & mask[1:, :-1] & mask[:-1, 1:] & mask[1:, 1:]
    return float(((a - b - c + d) / 2.0)[:, inside].square().mean()) if inside.any() else 0.0


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
    """One part for each set of scenes."""
    shared: dict[str, Any] = {"seed": seed, "quick": quick}
    depends = checksums(DEFAULT_SIMULATOR)
    if folder is not None:
        assert _options(str(folder)).grid  # raises before any work
        name = folder.resolve().name.partition("?")[0]
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
    "PSNR, all pixels [dB]": "{psnr_all_db:.1f}",
    "PSNR, known [dB]": "{psnr_db:.1f}",
    "two real captures [dB]": "{ceiling_db:.1f}",
    "without its noise [dB]": "{psnr_expected_db:.1f}",
    "noise off by [stop]": "{noise_error_stops:.2f}",
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
                numbers.setdefault(name, _mean([row[name] for row in own]))
            found.append(numbers)
    return found


def _mean(values: Sequence[Any]) -> Any:
    """Mean of numbers, or of the mappings' numbers by name; None of anything else."""
    if isinstance(values[0], Mapping):
        return {name: _mean([value[name] for value in values]) for name in values[0]}
    numbers = [value for value in values if isinstance(value, int | float)]
    return float(np.mean(numbers)) if numbers else None


def _stops(rows: Sequence[Row]) -> list[Row]:
    """The summary's PSNR by stops, after each set what two real captures have."""
    found = []
    for source in dict.fromkeys(row["source"] for row in rows):
        own = [row for row in _summary(rows) if row["source"] == source]
        found += [{"source": source, "title": r["title"], **r["psnr_by_stops"]} for r in own]
        ceiling = own[0]["ceiling_by_stops"]
        found.append({"source": source, "title": "two real captures", **ceiling})
    return found


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """The page: one row a set and method, PSNR by stops, then the scenes."""
    rows = [row for own in results.values() for row in own]
    regrets = [r["oracle_regret"] for r in rows if r["method"] == "simulated"]
    page = [
        "One capture of each recorded grid is kept, the one whose mean is nearest to a right "
        "exposure, and every other state is simulated from it and compared with the capture that "
        f"was really taken. Frames of at most {RESOLUTION} x {RESOLUTION} packed pixels; "
        "`balanced` scores. PSNR, against white, is the median over the states, first of all "
        f"pixels, then of those that are known: below {KNOWN_BELOW} of white in the source, as "
        "nothing tells how bright a clipped highlight is. Both frames have noise, each its own, so "
        "that two real captures of one light reach only what the camera's noise allows; *without "
        "its noise* is the simulation before noise is added, against the real frame. A frame with "
        "too little noise has a higher PSNR than one with the right noise: *noise off by* compares "
        "the texture (diagonal differences of neighbours). The score error is the root mean square "
        "over the states, the oracle's regret what is lost in the real scores where the best state "
        "is chosen by the simulated ones. Where a network would err more than the noise that the "
        "source brought, the plan leaves that noise in: such frames are noisier than real ones, "
        "and their scores count it. The scores of scaled frames do not: they take whatever noise "
        "is in a frame for the camera's.",
        table(_summary(rows), _COLUMNS),
        f"The simulated oracle loses {np.mean(regrets):.3f} in the mean, "
        f"{quartiles(regrets)[2]:.3f} at the upper quartile, {max(regrets):.3f} at most.",
        "## By the distance from the source",
        "PSNR of known pixels [dB], by the stops between the source and the state.",
        table(
            _stops(rows),
            {"scenes": "{source}", "method": "{title}"}
            | {name: f"{{{name}:.1f}}" for name in STOPS},
        ),
        "## Scenes",
        table(
            [{**row, "title": METHODS[row["method"]]} for row in rows],
            {"scene": "{scene}", "from": "{source_state}", "states": "{states}"}
            | {"known": "{known_share:.1%}"}
            | {k: v for k, v in _COLUMNS.items() if k not in ("scenes", "number", "same oracle")},
        ),
    ]
    if BOREAL in results:
        page.insert(
            3,
            f"Of `{BOREAL}` pixels above {brackets.LINEAR_BELOW} in either frame are not compared, "
            "because the published response is not linear there ([brackets](brackets.md)); they do "
            "count in the first PSNR and in the scores. `left_c5` was taken in motion: its frames "
            "do not lie on each other. Averaged over 4 x 4 pixels, both have so little noise that "
            "no network runs.",
        )
    return Report(rows, page)


BENCHMARK = Benchmark(
    name="recorded",
    title="Recorded grids",
    parts=parts,
    report=report,
    code=("simulator", "ae_env", "benchmarks/recorded", "benchmarks/brackets"),
)
run = BENCHMARK.run
