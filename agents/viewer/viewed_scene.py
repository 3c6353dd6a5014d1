"""The scenes that the page offers, and what it shows of one: captures, readouts and scores."""

import io
import math
import re
import threading
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import chain, count
from pathlib import Path
from time import perf_counter
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from PIL import Image

from ae_env.grid import ExposureGrid
from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.bundled import bundled_scenes
from ae_env.scenes.folder import find_files
from ae_env.scenes.load import NAMED
from ae_env.scenes.recorded import PREFIX
from ae_env.scenes.scene import SceneRequest
from ae_env.scorers.registry import make_scorer
from ae_env.scorers.score_table import ScoreTable, ScoreTables
from agents.metering.meters import weight_map
from agents.metering.reading import Region
from agents.policy_names import CLASSIC_METERS
from simulator.camera import get_camera
from simulator.camera_simulator import CameraSimulator, Depth
from simulator.capture.plan import SimulationPlan
from simulator.capture.prepared_scene import PreparedScene
from simulator.radiance.reading import RADIANCE_SUFFIXES
from simulator.raw.develop import render_srgb, upright
from simulator.raw.dng import write_dng
from simulator.raw.image import RawImage
from simulator.raw.read import read_raw
from simulator.settings import CameraSettings
from simulator.utils.checks import did_you_mean
from simulator.utils.files import RAW_SUFFIXES, printable

#: Camera in whose colours named scenes and radiance maps are made, as the environment's default.
CAMERA = "nikon_z6"
#: Raws kept in memory: one of 24 megapixels takes 0.1 GB, with its noise reduced twice that.
_KEPT = 4
_THREADS = torch.get_num_threads()  # as the process began
#: Most files that an error names.
_MOST_NAMED = 8
#: Largest picture of a whole frame, height and width [packed pixel].
FRAME_SIZE = (512, 768)
#: Part of the frame that is shown pixel by pixel, height and width [packed pixel].
WINDOW_SIZE = (128, 192)
#: Pixels a side that scores are found at, as in the environment.
SCORED_PIXELS = 64
#: Names of the planes.
PLANES = ("R", "G1", "G2", "B")
#: Stops below white that a histogram shows, and its bins.
STOPS, BINS = 10, 40
#: Signal of the mid grey that noise is stated at.
MID_GREY = 0.12
#: Colours of clipped pixels: a plane at white, a plane at or below black.
_WHITE_MARK, _BLACK_MARK = (255, 0, 200), (0, 120, 255)
#: Share of the planes' span above which a sample counts as white, below which as black.
_AT_WHITE, _AT_BLACK = 1.0 - 1e-4, 1e-6
_THUMBNAIL = (96, 64)


@dataclass(frozen=True)
class OpenedScene:
    """A scene to look at, at its finest resolution, and the photograph that it is, if it is one."""

    scene: Scene
    raw: RawImage | None = None


class Library:
    """Scenes by name, each read when it is opened; `first` is the one to open first."""

    def __init__(
        self, readers: Mapping[str, Callable[[], OpenedScene]], first: str | None = None
    ) -> None:
        self.readers = dict(readers)
        self.first = first or next(iter(self.readers))

    def add(self, path: Path, name: str) -> str:
        """Adds the raw at `path`; returns the name it got, `name` with a number where taken."""
        _read_raw(path, name)
        own = _free_name(name, self.readers)
        self.readers[own] = partial(_read_raw, path, name)
        return own

    def open(self, name: str) -> OpenedScene:
        """The scene called `name`."""
        return self.readers[name]()


def _free_name(name: str, taken: Container[str]) -> str:
    """`name` as it can be shown, with a number where it is taken."""
    name = printable(name)
    numbered = (f"{name} ({number})" for number in count(2))
    return next(text for text in chain([name], numbered) if text not in taken)


@lru_cache(maxsize=_KEPT)
def _read_raw(path: Path, name: str, **settings: float) -> OpenedScene:
    raw = read_raw(path, settings=settings)
    return OpenedScene(Scene.from_raw(raw, scene_id=name), raw)


def find_scenes(what: str, settings: Mapping[str, float] = MappingProxyType({})) -> Library:
    """The library of a raw or radiance map, a folder or glob, scenes by name, or a scene's id.

    A recorded grid is the light that its captures tell together; `settings` are of all raws.
    """
    known = (*RAW_SUFFIXES, *RADIANCE_SUFFIXES)
    looks_like_files = Path(what).suffix.lower() in known or any(s in what for s in "/*?")
    if Path(what).exists() or (looks_like_files and not what.startswith(PREFIX)):
        base, files = find_files(what)
        readers: dict[str, Callable[[], OpenedScene]] = {}
        for path in files:
            if path.suffix.lower() in RADIANCE_SUFFIXES:
                readers |= _loaded(str(path), readers)
            else:
                own = path != base and path.is_relative_to(base)
                name = _free_name(str(path.relative_to(base)) if own else path.name, readers)
                readers[name] = partial(_read_raw, path, name, **settings)
        return Library(readers, _first_readable(what, readers))
    if settings:
        raise ValueError(f"`what` (={what!r}) must be raws, where their settings are given")
    try:
        return Library(_loaded(what))
    except ValueError:
        if what.startswith(PREFIX):
            raise
    bundled = _bundled()
    if what not in bundled:
        raise ValueError(
            f"`what` (={what!r}) must be a raw, a radiance map, a folder, scenes such as bundled, "
            f"or the id of a bundled scene, such as {next(iter(bundled))}"
            f"{did_you_mean(what, (*NAMED, *bundled))}"
        )
    return Library(bundled, what)


def _first_readable(what: str, readers: Mapping[str, Callable[[], OpenedScene]]) -> str:
    """Name of the first scene that can be read: files are refused here, not on an empty page."""
    broken: list[str] = []
    for name, read in readers.items():
        try:
            read()
            return name
        except (ValueError, OSError) as error:
            if len(readers) == 1:
                raise
            broken.append(f"{name}: {re.sub(r'`path` [(]=.*?[)] ', '', str(error))}")
    if len(broken) > _MOST_NAMED:
        broken[_MOST_NAMED:] = [f"and {len(broken) - _MOST_NAMED} more"]
    named = "; ".join(broken)
    raise ValueError(f"`what` (={what!r}) must hold a raw that can be read, but none can: {named}")


def _loaded(spec: str, taken: Container[str] = ()) -> dict[str, Callable[[], OpenedScene]]:
    """The scenes that `load_scenes` makes of `spec`, by id."""
    scenes = load_scenes(spec, "all", camera=get_camera(CAMERA), resolution=None)
    named = {_free_name(scene.scene_id, taken): scene for scene in scenes}
    return {name: partial(OpenedScene, replace(s, scene_id=name)) for name, s in named.items()}


def _bundled() -> dict[str, Callable[[], OpenedScene]]:
    """The bundled scenes by id, each drawn when it is opened."""
    found: dict[str, Callable[[], OpenedScene]] = {}
    for split in ("train", "test"):
        scenes = bundled_scenes(SceneRequest(split, get_camera(CAMERA), resolution=None))
        for i, name in enumerate(scenes.scene_ids):
            found[name] = partial(lambda scenes, i: OpenedScene(scenes[i]), scenes, i)
    return found


@dataclass(frozen=True)
class View:
    """State and marks of one picture."""

    settings: CameraSettings  # of the camera
    speed: float = 0.0  # image speed [frame heights per second]
    defocus: float = 0.0  # diameter of the defocus disc at f/4 [pixel of a 64-pixel frame]
    clipping: bool = False  # whether clipped pixels are marked
    equal_brightness: bool = False  # developed as if exposed as the scene asks for
    #: Middle of the part shown pixel by pixel, down and to the right, as shares of the upright
    #: picture; None for the whole frame.
    centre: tuple[float, float] | None = None


@dataclass(frozen=True)
class Picture:
    """A simulated capture, developed; `aspect` is its width by its height."""

    jpeg: bytes
    aspect: float
    photosites: int  # of the sensor across it
    capture: torch.Tensor  # (4, H, W)
    milliseconds: tuple[float, float]  # of the capture, and of its development


@dataclass(frozen=True)
class Readout:
    """Numbers about a capture; lengths in packed pixels of the sensor, shares of the samples."""

    plan: SimulationPlan
    score: float  # expected
    #: Score of each part of the scorer, and how much higher the whole were if that were 1; the
    #: costliest first.
    parts: dict[str, tuple[float, float]]
    ev: float  # exposure relative to the right one [stop]
    snr: float  # of mid grey, of one photosite [dB]
    motion: float  # length of the streak
    defocus: float  # diameter of the disc
    white: float
    black: float
    histogram: np.ndarray  # (4, BINS) of each plane, from `STOPS` below white up


class ViewedScene:
    """One scene, ready to be shown at any settings; options as of `CameraSimulator.prepare`."""

    def __init__(
        self,
        opened: OpenedScene,
        simulator: CameraSimulator,
        *,
        depth: Depth = "far",
        tolerance: float = 0.1,
        scorer: str = "balanced",
    ) -> None:
        self.scene, self.photograph = opened.scene, opened.raw
        self._simulator, self._depth, self._tolerance = simulator, depth, tolerance
        self._scorer = make_scorer(scorer)
        self._prepared: dict[tuple[int, int] | None, PreparedScene] = {}
        self._tables: dict[object, ScoreTable] = {}
        self._lock = threading.RLock()  # one capture at a time: more would share the cores

    @property
    def _averaged(self) -> int:
        """Packed pixels a side that one of `small` is the mean of."""
        sides = zip(self.scene.light.shape[1:], FRAME_SIZE, strict=True)
        return max(math.ceil(side / most) for side, most in sides)

    @cached_property
    def small(self) -> Scene:
        """The scene averaged to at most `FRAME_SIZE`; what fills no whole pixel is left out."""
        return self.scene.averaged(self._averaged)

    @cached_property
    def scored(self) -> Scene:
        """The scene as an environment shows it to a policy."""
        return self.scene.resized(min(SCORED_PIXELS, *self.scene.light.shape[1:]))

    def best(self) -> CameraSettings:
        """Settings of the default grid's state with the highest score."""
        grid = ExposureGrid.default()
        return grid[self.table(View(grid[0])).oracle]

    def picture(self, view: View) -> Picture:
        """The capture that `view` asks for."""
        with self._lock:
            begun = perf_counter()
            (capture,) = self._part(view).expose([view.settings])
            taken = perf_counter()
            with _one_thread():
                image = self._to_srgb(capture, view)
            jpeg = encoded(image, quality=88 if view.centre is None else 95)
            times = 1e3 * (taken - begun), 1e3 * (perf_counter() - taken)
            photosites = image.shape[1] * (2 * self._averaged if view.centre is None else 1)
            return Picture(jpeg, image.shape[1] / image.shape[0], photosites, capture, times)

    def readout(self, view: View, capture: torch.Tensor) -> Readout:
        """The numbers about `capture`, which `view` asked for."""
        with self._lock, _one_thread():
            settings, height = view.settings, self.scene.light.shape[1]
            camera = self.scene.camera
            noise = camera.nlf(settings.iso, settings.exposure_time)
            variance = noise.read[1] + noise.shot[1] * MID_GREY + (camera.prnu * MID_GREY) ** 2
            values, bins = capture.reshape(4, -1), BINS // STOPS  # of a stop
            # A stop more lies below the histogram, and a bin of what is at white above it.
            stops = values.div(_AT_WHITE).clamp_(2.0 ** -(STOPS + 1), 1.0).log2_()
            at = stops.add_(STOPS + 1).mul_(bins).int()
            shares = np.stack([torch.bincount(a, minlength=BINS + bins + 1) for a in at])
            shares = shares / values.shape[1]
            table = self.table(view, settings)
            return Readout(
                plan=self._part(view).plan(settings),
                score=float(table.mean[0]),
                parts=self._costs(table),
                ev=settings.log2_exposure + self.scene.ev100,
                snr=20.0 * math.log10(MID_GREY / math.sqrt(variance)) if variance else math.inf,
                motion=view.speed * height * settings.exposure_time,
                defocus=view.defocus * height / SCORED_PIXELS * 4.0 / settings.effective_f_number,
                white=float(shares[:, -1].mean()),
                black=int(torch.count_nonzero(values <= _AT_BLACK)) / values.numel(),
                histogram=shares[:, bins:-1],
            )

    def _costs(self, table: ScoreTable) -> dict[str, tuple[float, float]]:
        costs = {}
        for name, score in table.parts.items():
            perfect = float(self._scorer.combine({**table.parts, name: np.ones_like(score)})[0])
            costs[name] = float(score[0]), max(perfect - float(table.mean[0]), 0.0)
        return dict(sorted(costs.items(), key=lambda item: -item[1][1]))

    def photosite(self, view: View, capture: torch.Tensor, down: float, right: float) -> str:
        """The sample of `capture` at a place of its upright picture, in shares of that."""
        camera, k, start = self.scene.camera, self._averaged, [0, 0]
        if view.centre is not None:
            k, start = 1, [part.start for part in self._window(view.centre)]
        sides = np.array(capture.shape[1:])
        place = np.minimum(2 * sides * self._to_frame(down, right), 2 * sides - 1).astype(int)
        plane = camera.cfa.offsets.index(tuple(place % 2))
        black, white = camera.black_level[plane], camera.white_level
        number = black + float(capture[plane, *(place // 2)]) * (white - black)
        row, column = 2 * (np.array(start) + k * (place // 2)) + place % 2
        text = f"{PLANES[plane]} {number:.0f} of {black:.0f} to {white:.0f}, row {row}, "
        return f"{text}column {column}{f', mean of {k} x {k}' * (k > 1)}"

    def weights_over(self, meter: str) -> bytes:
        """A PNG of where `meter`, or a region ``"left,top,width,height"``, looks in the picture."""
        size, side, (height, width) = (SCORED_PIXELS,) * 2, 256, self.scene.light.shape[1:]
        seen = None if meter in CLASSIC_METERS else Region(meter, None, (4, *size)).masks({})
        weights = weight_map(meter, *size) if seen is None else seen[0].astype(float)
        square = Image.fromarray(np.uint8(150 * weights / weights.max())).resize((side, side), 0)
        full = [round(side * length / min(height, width)) for length in (width, height)]
        alpha, picture = Image.new("L", full), Image.new("RGBA", full, "#ffa500")
        alpha.paste(square, ((full[0] - side) // 2, (full[1] - side) // 2))
        picture.putalpha(alpha)
        return encoded(self._upright(np.asarray(picture)), "PNG")

    def table(self, view: View, settings: CameraSettings | None = None) -> ScoreTable:
        """Scores of `settings` alone, or of the default grid's states, moving as in `view`."""
        with self._lock:
            key = (settings, view.speed, view.defocus)
            if key not in self._tables:
                grid = ExposureGrid.default()
                if settings is not None:
                    values = (settings.iso,), (settings.exposure_time,), (settings.f_number,)
                    grid = ExposureGrid(*values)
                tables = ScoreTables(grid, self.scene.camera, self._scorer)
                speed, defocus = view.speed, view.defocus
                self._tables[key] = tables.table(self.scored, speed=speed, defocus=defocus)
            return self._tables[key]

    def write_dng(self, path: Path, view: View) -> Path:
        """Writes the full frame at the settings of `view`, at the sensor's resolution."""
        with self._lock:
            defocus = view.defocus * self.scene.light.shape[1] / SCORED_PIXELS
            moves: dict[str, Any] = {"image_speed": view.speed, "defocus": defocus}
            raw = self._simulator.simulate(self._prepare(self.scene), view.settings, **moves)
        write_dng(path, raw)
        return path

    def thumbnail(self) -> bytes:
        """A small JPEG of the scene at the exposure that it asks for."""
        grid = ExposureGrid.default()
        settings = grid[grid.nearest(self.scene.ev100)]
        factor = max(1, min(self.scene.light.shape[1:]) // _THUMBNAIL[1])
        capture = replace(self.scene.averaged(factor), denoised=None).prepared.expected(settings)
        return encoded(self._to_srgb(capture.clamp(0.0, 1.0), View(settings)), quality=80)

    def _prepare(self, scene: Scene) -> PreparedScene:
        return self._simulator.prepare(scene.prepared, depth=self._depth, tolerance=self._tolerance)

    def _part(self, view: View) -> PreparedScene:
        """The part that `view` shows, prepared: networks run once a frame and once a window."""
        key, scene = None, self.small
        if view.centre is not None:
            rows, columns = self._window(view.centre)
            key, scene = (rows.start, columns.start), self.scene
        if key not in self._prepared:
            if len(self._prepared) > 8:
                self._prepared = {k: p for k, p in self._prepared.items() if k is None}
            part = scene if key is None else scene.cut(rows, columns)
            self._prepared[key] = self._prepare(part)
        prepared, height = self._prepared[key], scene.light.shape[1]
        return replace(
            prepared,
            image_speed=view.speed * height / prepared.light.shape[1],  # heights of what is shown
            defocus=view.defocus * height / SCORED_PIXELS,
        )

    def _to_frame(self, down: float, right: float) -> tuple[float, float]:
        """A place of the upright picture on the sensor, as `as_recorded`."""
        flip = 0 if self.photograph is None else self.photograph.metadata.get("flip", 0)
        if flip & 4:
            down, right = right, down
        return 1.0 - down if flip & 2 else down, 1.0 - right if flip & 1 else right

    def _window(self, centre: tuple[float, float]) -> tuple[slice, slice]:
        down, right = self._to_frame(*centre)

        def part(share: float, side: int, size: int) -> slice:
            start = round(min(max(share * side - size / 2, 0), max(side - size, 0)))
            return slice(start, min(start + size, side))

        height, width = self.scene.light.shape[1:]
        return part(down, height, WINDOW_SIZE[0]), part(right, width, WINDOW_SIZE[1])

    def _to_srgb(self, capture: torch.Tensor, view: View) -> np.ndarray:
        whole, gain = view.centre is None, 1.0
        if view.equal_brightness:
            gain = 2.0 ** -(view.settings.log2_exposure + self.scene.ev100)
        balance = self.scene.white_balance
        raw = RawImage(capture * gain, view.settings, self.scene.camera, white_balance=balance)
        image = render_srgb(raw, "half" if whole else "malvar").permute(1, 2, 0).numpy()
        if view.clipping:
            image = image.copy()
            scale, black = 1 if whole else 2, (capture <= _AT_BLACK).all(dim=0)
            marks = (black, _BLACK_MARK), ((capture >= _AT_WHITE).any(dim=0), _WHITE_MARK)
            for clipped, colour in marks:
                image[clipped.numpy().repeat(scale, 0).repeat(scale, 1)] = colour
        return self._upright(image)

    def _upright(self, image: np.ndarray) -> np.ndarray:
        seen = image if self.photograph is None else upright(image, self.photograph)
        return np.ascontiguousarray(seen)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Torch computes on this thread alone: on busy cores a small picture would wait for another."""
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(_THREADS)


def encoded(picture: Image.Image | np.ndarray, kind: str = "JPEG", quality: int = 90) -> bytes:
    """The file of a picture, an image or (H, W, 3) uint8."""
    image = Image.fromarray(picture) if isinstance(picture, np.ndarray) else picture
    buffer = io.BytesIO()
    image.save(buffer, format=kind, quality=quality, subsampling=0)
    return buffer.getvalue()
