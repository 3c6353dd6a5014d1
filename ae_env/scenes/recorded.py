"""Recorded grids as scenes: every state is a real capture that is looked up, never simulated."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageOps, UnidentifiedImageError

from ae_env.grid import ExposureGrid
from ae_env.scenes.recorded_files import (
    PREFIX,
    RecordedFile,
    index_recorded,
    parse_number,
    recorded_grid,
    state_of,
)
from ae_env.scenes.scene import Scene, SceneRequest
from ae_env.scenes.split import log_groups, scenes_of_split
from ae_env.utils.merging import SATURATED, merge
from simulator.camera import CameraProfile
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.radiance.light import MEAN_SIGNAL
from simulator.raw.develop import develop_inverse
from simulator.raw.image import RawImage
from simulator.raw.read import read_raw
from simulator.settings import CameraSettings, exposure_ratio
from simulator.utils.checks import check_number, did_you_mean

logger = logging.getLogger(__name__)

#: The entry of a mapping that names a recorded grid.
KEY = "recorded"


@dataclass(frozen=True)
class RecordedOptions:
    """A folder of recorded grids.

    Args:
        folder: The folder.
        iso: ISO of files that do not state it.
        exposure_time: Exposure time [s] of files that do not state it.
        f_number: F-number of files that do not state it.
    """

    folder: Path
    iso: float | None = None
    exposure_time: float | None = None
    f_number: float | None = None

    def __post_init__(self) -> None:
        for name, value in self.known.items():
            check_number(name, value, 1e-9, 1e8)

    @property
    def known(self) -> dict[str, float]:
        """The settings that are given, by name."""
        values = {"iso": self.iso, "exposure_time": self.exposure_time, "f_number": self.f_number}
        return {name: value for name, value in values.items() if value is not None}

    @classmethod
    def of(cls, spec: object) -> RecordedOptions | None:
        """What `spec`, an environment's `scenes`, says of recorded grids; None if nothing.

        Raises:
            ValueError: If it has an unknown entry, or names no folder.
        """
        if isinstance(spec, RecordedOptions):
            return spec
        if isinstance(spec, str) and spec.startswith(PREFIX):
            spec = _of_text(spec)
        if not isinstance(spec, Mapping) or KEY not in spec:
            return None
        names = (KEY, "iso", "exposure_time", "f_number")
        for name in spec:
            if name not in names:
                hint = did_you_mean(name, names)
                raise ValueError(f"`scenes` field {name!r} must be one of {list(names)}{hint}")
        if not isinstance(spec[KEY], str | Path) or not str(spec[KEY]):
            raise ValueError(f"`scenes[{KEY!r}]` (={spec[KEY]!r}) must be the path of a folder")
        settings = {name: spec[name] for name in names[1:] if name in spec}
        return cls(Path(spec[KEY]).expanduser(), **settings)

    @cached_property
    def files(self) -> tuple[RecordedFile, ...]:
        """Every capture of the folder; see `index_recorded`."""
        return tuple(index_recorded(self.folder, self.known))

    @cached_property
    def grid(self) -> ExposureGrid:
        """Every combination of the settings of its captures."""
        return recorded_grid(self.files)

    @cached_property
    def _body(self) -> CameraProfile | None:
        """The body that took the raws, with their noise; None where there are only pictures."""
        by_iso = {file.settings.iso: file for file in reversed(self.files) if not file.is_picture}
        if not by_iso:
            return None
        noises: dict[float, NoiseLevelFunction] = {}
        for iso, file in sorted(by_iso.items()):
            raw = _read(file)
            noises[iso] = raw.camera.nlf(iso) if raw.nlf is None else raw.nlf
        return replace(raw.camera, nlf_by_iso=noises, segments=())

    def camera(self, default: CameraProfile) -> CameraProfile:
        """The body that took the raws, with their noise; for pictures `default` without colours.

        Args:
            default: Whose noise developed pictures are assumed to have.
        """
        return self._body or replace(default, colour_matrix=None, colour_matrix_source="")


def _of_text(spec: str) -> dict[str, Any]:
    """The mapping that ``recorded:FOLDER?iso=100&f_number=4`` stands for."""
    folder, mark, given = spec.removeprefix(PREFIX).partition("?")
    found: dict[str, Any] = {KEY: folder}
    for part in given.split("&") if mark else ():
        name, _, text = part.partition("=")
        try:
            found[name] = parse_number(text)
        except ValueError:
            raise ValueError(
                f"`scenes` (={spec!r}) must be written {PREFIX}FOLDER?iso=100&f_number=4: "
                f"{part!r} is no setting"
            ) from None
    return found


# -- scenes ---------------------------------------------------------------------------------------


def recorded_scenes(
    options: RecordedOptions, request: SceneRequest, grid: ExposureGrid
) -> list[Scene]:
    """The recorded scenes of `split`, frames of one video after the other.

    Args:
        options: The folder.
        request: Split, camera and size. Each capture is resized before the next is read.
        grid: The states; captures at other settings are left out, states without a capture are
            forbidden (`Scene.allowed`).

    Raises:
        ValueError: If a capture cannot be read or has another size than its scene's others, two
            are of one state, or a scene has fewer than two states.
    """
    camera = options.camera(request.camera)
    scenes: list[Scene] = []
    holes: dict[str, list[int]] = {}
    for name, files in groupby(options.files, lambda file: file.scene):
        places = _places(name, list(files), grid)
        missing = [state for state in range(len(grid)) if state not in places]
        if missing:
            holes[name] = missing
        scenes.append(_scene(name, places, grid, camera, request))
    _log_holes(holes, grid, len(scenes))
    log_groups(str(options.folder), scenes)
    return scenes_of_split(options.folder, scenes, request.split)


def _places(
    scene: str, files: Sequence[RecordedFile], grid: ExposureGrid
) -> dict[int, RecordedFile]:
    """The capture of each state that has one."""
    places: dict[int, RecordedFile] = {}
    for file in files:
        state = state_of(file.settings, grid)
        if state is None:
            continue
        if state in places:
            raise ValueError(
                f"recorded scene {scene!r} must have one file for each state, but "
                f"{str(places[state].path)!r} and {str(file.path)!r} are both {grid[state]}"
            )
        places[state] = file
    if len(places) < 2:
        raise ValueError(
            f"recorded scene {scene!r} ({len(places)} of {len(files)} captures in the grid, such "
            f"as {str(files[0].path)!r}) must have two states or more: settings that its files "
            "share are one state, and what is left of a name without them is the scene's name"
        )
    return places


def _log_holes(holes: Mapping[str, Sequence[int]], grid: ExposureGrid, scenes: int) -> None:
    if holes:
        name, missing = next(iter(holes.items()))
        logger.warning(
            f"{len(holes)} of {scenes} recorded scenes lack states of the grid, which are "
            f"forbidden there: {name!r} lacks {len(missing)} of {len(grid)}, "
            f"the first is {grid[missing[0]]}"
        )


def _scene(
    name: str,
    places: Mapping[int, RecordedFile],
    grid: ExposureGrid,
    camera: CameraProfile,
    request: SceneRequest,
) -> Scene:
    sizes: dict[str, tuple[int, ...]] = {}

    def read(file: RecordedFile) -> RawImage:
        raw = _read(file, camera)
        sizes[str(file.path)] = tuple(raw.data.shape[1:])
        (first, size), *_ = sizes.items()
        if sizes[str(file.path)] != size:
            raise ValueError(
                f"recorded file {str(file.path)!r} ({sizes[str(file.path)]} packed pixels) must be "
                f"of the size of {first!r}, {size}"
            )
        return raw

    raws = ((state, read(file)) for state, file in sorted(places.items()))
    first = next(iter(places.values()))
    merged = merged_scene(name, raws, grid, camera, resize=request.sized)
    return replace(merged, group=first.group, sequence=first.sequence)


def merged_scene(
    name: str,
    raws: Iterable[tuple[int, RawImage]],
    grid: ExposureGrid,
    camera: CameraProfile,
    *,
    resize: Callable[[Scene], Scene] = lambda scene: scene,
) -> Scene:
    """A scene of real captures, with the light that they tell together.

    Args:
        name: Its name, and its source group.
        raws: Captures of one size with their state of `grid`; one at a time is held.
        grid: The states.
        camera: The body, with the noise of its ISO speeds.
        resize: Brings each capture to its size, before they are merged.
    """
    frames = {state: resize(_frame(name, raw, grid[state], camera)) for state, raw in raws}
    shape = next(iter(frames.values())).light.shape
    recorded, allowed = torch.zeros(len(grid), *shape), np.zeros(len(grid), bool)
    for state, frame in frames.items():
        recorded[state], allowed[state] = frame.light, True
    return replace(
        _merged(list(frames.values())),
        scene_id=name,
        group=name,
        kind=KEY,
        source=f"{len(frames)} recorded captures",
        recorded=recorded,
        allowed=allowed,
    )


def _frame(name: str, raw: RawImage, settings: CameraSettings, camera: CameraProfile) -> Scene:
    """A capture as it is: its light is what was recorded, clipped."""
    return Scene.from_array(
        raw.data,
        settings,
        camera,
        scene_id=f"{name}, {settings}",
        nlf=raw.noise,
        white_balance=raw.white_balance,
        box_factor=raw.box_factor,
        sampled=True,
    )


def _merged(frames: Sequence[Scene]) -> Scene:
    """The light that all captures tell, at the settings of the one nearest to a right exposure."""
    means = [abs(float(frame.light[1:3].mean()) - MEAN_SIGNAL) for frame in frames]
    best = frames[int(np.argmin(means))]
    gains = torch.tensor([exposure_ratio(best.reference, frame.reference) for frame in frames])
    signals = torch.stack([frame.light for frame in frames])
    noise = [
        torch.tensor([getattr(f.nlf, name) for f in frames])[None] for name in ("shot", "read")
    ]
    light, precision = merge(signals[None], gains[None], *noise)
    darkest = int(gains.argmin())
    # What every capture clips is at least as bright as the darkest one shows it.
    clipped = (signals[darkest] >= SATURATED) | (precision[0] <= 0.0)
    light = torch.where(clipped, signals[darkest] / float(gains[darkest]), light[0])
    return replace(best, light=light.float(), nlf=best.nlf.zero())


# -- reading --------------------------------------------------------------------------------------


def _read(file: RecordedFile, camera: CameraProfile | None = None) -> RawImage:
    """The capture of `file`, of a raw as `read_raw` reads it, of a picture developed back.

    Args:
        file: The file.
        camera: Whose noise a picture has; a raw brings its own.
    """
    try:
        if not file.is_picture:
            return read_raw(file.path, settings=file.settings)
        with Image.open(file.path) as picture:
            if picture.mode.startswith(("I", "F")):
                raise ValueError(f"must have 8 bits a sample, not mode {picture.mode!r}")
            rgb = np.asarray(ImageOps.exif_transpose(picture).convert("RGB"))
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError) as error:
        raise ValueError(f"recorded file {str(file.path)!r} cannot be read: {error}") from error
    assert camera is not None
    data = develop_inverse(torch.from_numpy(rgb.copy()).permute(2, 0, 1)[None])[0]
    return RawImage(data, file.settings, camera)
