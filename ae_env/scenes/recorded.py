"""Recorded grids as scenes: every state is a real capture that is looked up, never simulated.

Three layouts, told apart by where the settings stand:

- one folder a scene, one file a state: ``SCENE/iso100_1-125s_f4.dng``, or any names whose settings
  are in EXIF or a table;
- one folder a state, one file a scene, as in ImageNet-ES: ``l1/param_3/CLASS/PICTURE.JPEG`` with a
  table that says what ``param_3`` is;
- stacks of video, one folder a frame: ``SCENE/frame_0007/1-125s.png``.

A table is a ``settings.csv`` or ``grid-options*.csv`` in the folder or below, a row for each.
"""

import logging
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
from PIL import ExifTags, ImageOps

from ae_env.grid import ExposureGrid
from ae_env.merging import SATURATED, merge
from ae_env.scenes.folder import scenes_of_split, visible_files
from ae_env.scenes.scene import Scene, SceneRequest
from simulator.camera import CameraProfile
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.radiance.light import MEAN_SIGNAL
from simulator.raw.develop import develop_inverse
from simulator.raw.image import RawImage
from simulator.raw.read import marks_stops, read_raw, read_settings
from simulator.settings import CameraSettings, exposure_ratio, snap_exposure_time
from simulator.utils.checks import UNITS, check_key, check_number, import_extra, parse_number
from simulator.utils.files import (
    PICTURE_SUFFIXES,
    RAW_SUFFIXES,
    open_picture,
    printable,
    read_table,
)

logger = logging.getLogger(__name__)

#: The entry of a mapping that names a recorded grid, and how a text does.
KEY = "recorded"
PREFIX = f"{KEY}:"
#: Two values of a setting are the same within this share: recorded ones are rounded.
SAME = 0.035
#: Most states of a grid that is put together from files.
MOST_STATES = 4096
_SETTINGS = ("iso", "exposure_time", "f_number")
_TABLES = ("settings.csv", "grid-options*.csv")
_COLUMNS = {
    "file": ("file", "path", "folder", "param", "idx"),
    "iso": ("iso",),
    "exposure_time": ("exposure_time", "time", "shutter", "ss"),
    "f_number": ("f_number", "aperture"),
}
_NUMBER = r"(\d+(?:\.\d+)?)"
#: Settings in a name, in the order in which they are looked for.
# A fraction is one over something. An underscore parts words as well, so that it is a fraction's
# bar only where nothing else stands before: "1_125s", but not "frame_0001_8s".
_IN_NAMES = (
    ("iso", re.compile(rf"(?<![a-z\d.]){_NUMBER} ?iso(?![a-z\d])", re.I)),
    ("iso", re.compile(rf"(?<![a-z])iso[_-]?{_NUMBER}", re.I)),
    ("f_number", re.compile(rf"(?<![a-z\d])f-?{_NUMBER}(?![a-z\d])", re.I)),
    ("exposure_time", re.compile(rf"(?<![\d.])(?<!frame[_-])(1)-{_NUMBER} ?s(?![a-z])", re.I)),
    ("exposure_time", re.compile(rf"^[_\-. ]*(1)_{_NUMBER} ?s(?![a-z])", re.I)),
    ("exposure_time", re.compile(rf"(?<![\d.]){_NUMBER} ?(s|ms|us)(?![a-z])", re.I)),
)
_FRAME = re.compile(r"frame[_-]?(\d+)", re.I)
#: What a folder that is a bare number may state, with the size of its unit.
FOLDERS = {"iso": 1.0, "f_number": 1.0, "exposure_s": 1.0, "exposure_ms": 1e-3, "exposure_us": 1e-6}
#: Part of the path of a picture that no exposure took, but was averaged from many.
_TRUTH = re.compile(r"(?<![a-z])(gt|ground[_\-. ]?truth)(?![a-z])", re.I)


@dataclass(frozen=True)
class RecordedFile:
    """One real capture."""

    path: Path
    settings: CameraSettings  # that it was taken at
    scene: str  # name of what it shows, of a frame of video with the frame's number
    group: str  # source group: what it shows whatever the light
    sequence: str  # the video that it is a frame of, empty for a still scene
    frame: int  # which of its frames

    @property
    def is_picture(self) -> bool:
        """Whether it is a developed picture; else it is a raw."""
        return self.path.suffix.lower() in PICTURE_SUFFIXES


@dataclass(frozen=True)
class RecordedOptions:
    """A folder of recorded grids; ISO, time [s] and f-number of files that do not state theirs."""

    folder: Path
    iso: float | None = None
    exposure_time: float | None = None
    f_number: float | None = None
    numbers: str | None = None  # what folders are that are bare numbers, of `FOLDERS`

    def __post_init__(self) -> None:
        if self.numbers not in (None, *FOLDERS):
            raise ValueError(f"`folder` (={self.numbers!r}) must be one of {list(FOLDERS)}")
        for name, value in self.known.items():
            check_number(name, value, 1e-9, 1e8)

    @property
    def known(self) -> dict[str, float]:
        """The settings that are given, by name."""
        values = {name: getattr(self, name) for name in _SETTINGS}
        return {name: value for name, value in values.items() if value is not None}

    @classmethod
    def of(cls, spec: object) -> "RecordedOptions | None":
        """What `spec`, an environment's `scenes`, says of recorded grids; None if nothing."""
        if isinstance(spec, RecordedOptions):
            return spec
        if isinstance(spec, str) and spec.startswith(PREFIX):
            folder, mark, given = spec.removeprefix(PREFIX).partition("?")
            pairs = [part.partition("=")[::2] for part in given.split("&")] if mark else []
            try:
                values = {n: v if n == "folder" else parse_number(v) for n, v in pairs}
                spec = {KEY: folder, **values}
            except ValueError as error:
                form = f"must be written {PREFIX}FOLDER?iso=100&f_number=4"
                raise ValueError(f"`scenes` (={spec!r}) {form}: {error}") from None
        if not isinstance(spec, Mapping) or KEY not in spec:
            return None
        for name in spec:
            check_key("scenes", name, (KEY, "folder", *_SETTINGS))
        if not isinstance(spec[KEY], str | Path) or not str(spec[KEY]):
            raise ValueError(f"`scenes[{KEY!r}]` (={spec[KEY]!r}) must be the path of a folder")
        settings = {name: spec[name] for name in _SETTINGS if name in spec}
        return cls(Path(spec[KEY]).expanduser(), **settings, numbers=spec.get("folder"))

    @cached_property
    def files(self) -> tuple[RecordedFile, ...]:
        """Every capture of the folder; see `index_recorded`."""
        return tuple(index_recorded(self.folder, self.known, self.numbers))

    @cached_property
    def grid(self) -> ExposureGrid:
        """Every combination of the settings of its captures, but of scenes with one state only."""
        states = Counter(scene for scene, _ in {(f.scene, f.settings) for f in self.files})
        return recorded_grid([f for f in self.files if states[f.scene] > 1] or self.files)

    @cached_property
    def _body(self) -> CameraProfile | None:
        """The body that took the raws, with their noise; None where there are only pictures."""
        by_iso = {file.settings.iso: file for file in reversed(self.files) if not file.is_picture}
        if not by_iso:
            return None
        noises: dict[float, NoiseLevelFunction] = {}
        for iso, file in sorted(by_iso.items()):
            raw = _read(file)
            noises[iso] = raw.nlf or raw.camera.nlf(iso)
        return replace(raw.camera, nlf_by_iso=noises, segments=())

    def camera(self, default: CameraProfile) -> CameraProfile:
        """The body that took the raws, with their noise; of pictures `default` without colours.

        Developed pictures are assumed to have its noise.
        """
        return self._body or replace(default, colour_matrix=None, colour_matrix_source="")


def recorded_scenes(
    options: RecordedOptions, request: SceneRequest, grid: ExposureGrid
) -> list[Scene]:
    """The recorded scenes of a split, frames of one video after the other.

    Each capture is resized before the next is read. Captures at settings that are not in `grid` are
    left out, and scenes with fewer than two states; states without a capture are forbidden
    (`Scene.allowed`). A `ValueError` if a capture cannot be read, no scene is left, or a scene's
    captures are no grid of one size.
    """
    camera = options.camera(request.camera)
    scenes: list[Scene] = []
    single: list[RecordedFile] = []
    for name, group in groupby(options.files, lambda file: file.scene):
        files = list(group)
        states = _states(name, files, grid)
        if len(states) < 2:
            single.append(files[0])
            continue
        raws = _raws_of_one_size(states, camera)
        merged = merged_scene(name, raws, grid, camera, resize=request.sized)
        scenes.append(replace(merged, group=files[0].group, sequence=files[0].sequence))
    if single:
        said = f"{len(single)} of {len(scenes) + len(single)} recorded scenes have fewer than two "
        said += f"states of the grid and are left out, such as {str(single[0].path)!r}"
        if not scenes:
            raise ValueError(f"{said}: what a name has beside settings is the scene's")
        logger.warning(said)
    holes = {s.scene_id: ~s.allowed for s in scenes if s.allowed is not None}
    lacking = {name: missing for name, missing in holes.items() if missing.any()}
    for name, missing in list(lacking.items())[:1]:
        logger.warning(
            f"{len(lacking)} of {len(scenes)} recorded scenes lack states of the grid, which are "
            f"forbidden there: {name!r} lacks {missing.sum()} of {len(grid)}, "
            f"the first is {grid[int(missing.argmax())]}"
        )
    return scenes_of_split(options.folder, scenes, request.split)


def _states(
    scene: str, files: Sequence[RecordedFile], grid: ExposureGrid
) -> dict[int, RecordedFile]:
    """The capture of each state that has one, by state, in order."""
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
    return dict(sorted(places.items()))


def _raws_of_one_size(
    states: Mapping[int, RecordedFile], camera: CameraProfile
) -> Iterator[tuple[int, RawImage]]:
    size: torch.Size | None = None
    for state, file in states.items():
        raw = _read(file, camera)
        size = size or raw.data.shape
        if raw.data.shape != size:
            raise ValueError(
                f"recorded file {str(file.path)!r} ({tuple(raw.data.shape[1:])} packed pixels) "
                f"must be of the size of its scene's others, {tuple(size[1:])}"
            )
        yield state, raw


def merged_scene(
    name: str,
    raws: Iterable[tuple[int, RawImage]],
    grid: ExposureGrid,
    camera: CameraProfile,
    *,
    resize: Callable[[Scene], Scene] = lambda scene: scene,
) -> Scene:
    """A scene of real captures, with the light that they tell together.

    `raws` are captures with their state of `grid`, of which one at a time is held; `camera` has the
    noise of its ISO speeds; `resize` brings each capture to its size, before they are merged.
    """
    frames: dict[int, Scene] = {}
    for state, raw in raws:
        capture = Scene.from_array(
            raw.data,
            grid[state],
            camera,
            scene_id=f"{name}, {grid[state]}",
            nlf=raw.noise,
            white_balance=raw.white_balance,
            box_factor=raw.box_factor,
            sampled=True,
        )
        frames[state] = resize(capture)
    merged, allowed = _merged(list(frames.values())), np.zeros(len(grid), bool)
    allowed[[*frames]] = True
    return replace(
        merged,
        scene_id=name,
        group=name,
        kind=KEY,
        source=f"{len(frames)} recorded captures",
        recorded=torch.stack([frames[state].light for state in sorted(frames)]),
        allowed=allowed,
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


def _read(file: RecordedFile, camera: CameraProfile | None = None) -> RawImage:
    """The capture of `file`; a picture is developed back and has the noise of `camera`."""
    if not file.is_picture:
        try:
            return read_raw(file.path, settings=file.settings)
        except (OSError, ValueError) as error:
            raise ValueError(f"recorded file {str(file.path)!r} cannot be read: {error}") from error
    with open_picture(file.path, bits=16) as picture:
        if picture.mode.startswith(("I", "F")):
            raise ValueError(f"it must have 8 bits a sample, not mode {picture.mode!r}")
        if picture.info["deep"]:
            cv2 = import_extra("cv2", "cv", f"picture {str(file.path)!r}, of 16 bits,")
            content, how = np.fromfile(file.path, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
            if (bgr := cv2.imdecode(content, how)) is None or bgr.dtype != np.uint16:
                raise ValueError("its pixels cannot be decoded")
            rgb = bgr[:, :, ::-1] / np.float32(65535.0)
        else:
            rgb = np.array(ImageOps.exif_transpose(picture).convert("RGB"))
    assert camera is not None
    data = develop_inverse(torch.from_numpy(rgb).permute(2, 0, 1)[None])[0]
    return RawImage(data, file.settings, camera)


# -- which file is which state of which scene ---------------------------------------------------


def index_recorded(
    folder: Path, known: Mapping[str, float], numbers: str | None = None
) -> list[RecordedFile]:
    """Every capture under `folder`, by scene, frame and settings; hidden folders are left out.

    So is ground truth, with ``gt`` or ``ground_truth`` in a name of its path. `known` are settings
    by name that the files do not state; those that they do come first. Warnings count the files
    that do, and rows of tables without a file. A `ValueError` if there is no capture, one does not
    state its settings, or a table is wrong.
    """
    tables = _read_tables(folder)
    paths = visible_files(folder, sorted(folder.rglob("*")), (*RAW_SUFFIXES, *PICTURE_SUFFIXES))
    shots = [path for path in paths if not _TRUTH.search(str(path.relative_to(folder)))]
    if len(shots) < len(paths):
        count = f"{len(paths) - len(shots)} of {len(paths)} files"
        logger.warning(f"{str(folder)!r}: ground truth is left out, {count}")
    found = [_recorded(folder, path, tables, known, numbers) for path in shots]
    if not found:
        raise ValueError(
            f"`scenes` (='recorded:{folder}') must be an existing folder that has captures: raws "
            f"({', '.join(RAW_SUFFIXES[:6])} ...) or pictures ({PICTURE_SUFFIXES[0]} ...)"
        )
    for name, value in known.items():
        own = [f for f in found if abs(getattr(f.settings, name) / value - 1.0) > SAME]
        if own:
            count = f"{len(own)} of {len(found)} files state another"
            logger.warning(f"`{name}` (={value:g}): {count}, which counts: {str(own[0].path)!r}")
    places = set[Path]()
    for path in paths:
        for place in [path, *path.parents][: len(path.relative_to(folder).parts)]:
            places |= {place, place.with_suffix("")}
    names, rows = {p.name for p in places}, [row for row in tables if isinstance(row, Path)]
    if lacking := [row for row in rows if row not in places and row.name not in names]:
        count = f"{len(lacking)} of {len(rows)} rows of tables name no file that there is"
        logger.warning(f"{str(folder)!r}: {count}, such as {str(lacking[0])!r}")
    return sorted(found, key=lambda file: (file.sequence, file.frame, file.scene, file.settings))


def _recorded(
    folder: Path,
    path: Path,
    tables: Mapping[Path | str, dict[str, float]],
    known: Mapping[str, float],
    numbers: str | None,
) -> RecordedFile:
    """`path` with its settings, and with what is left of its name once those are taken out."""
    parts = [printable(p) for p in (*path.relative_to(folder).parts[:-1], path.stem)]
    settings: dict[str, float] = {}
    left: list[str] = []
    last = -1  # part that states a setting
    for number, part in enumerate(parts):
        named, rest = settings_in_name(part)
        if numbers and number < len(parts) - 1 and re.fullmatch(_NUMBER, part):
            name = "exposure_time" if numbers.startswith("exposure") else numbers
            named, rest = {name: float(part) * FOLDERS[numbers]}, ""
        place = [path, *path.parents][len(parts) - 1 - number]
        row = tables.get(place) or tables.get(place.with_suffix("")) or {}
        if not row and not place.suffix:  # a folder anywhere by its name
            row = tables.get(place.name, {})
        if named or row:
            settings |= named | row
            last = number
        left.append("" if row else rest)
    try:
        if len(settings) < len(_SETTINGS):
            stated = _in_file(path)
            if not settings and stated:
                left[-1] = ""  # a file of one state, whatever its name
                last = len(parts) - 1
            settings = {**known, **stated, **settings}
        taken_at = CameraSettings(*(settings[name] for name in _SETTINGS))
    except KeyError:
        missing = [name for name in _SETTINGS if name not in settings]
        raise ValueError(
            f"recorded file {str(path)!r} does not state its {' and '.join(missing)}: name it in a "
            "settings.csv (columns file, iso, exposure_time, f_number), put it into its name "
            "(iso100_1-125s_f4) or, where it is the same in all files, give it with the folder: "
            f"{PREFIX}FOLDER?iso=100&f_number=4"
        ) from None
    except ValueError as error:
        raise ValueError(f"recorded file {str(path)!r}: {error}") from error
    names = [name for name in left if name] or [printable(folder.resolve().name)]
    subject = [name for name in left[last + 1 :] if name and not numbers] or names
    frames = [match for name in names if (match := _FRAME.fullmatch(name))]
    still = "/".join(name for name in names if not _FRAME.fullmatch(name))
    return RecordedFile(
        path=path,
        settings=taken_at,
        scene="/".join(names),
        group="/".join(name for name in subject if not _FRAME.fullmatch(name)) or still,
        sequence=(still or printable(folder.resolve().name)) if frames else "",
        frame=int(frames[-1][1]) if frames else 0,
    )


def settings_in_name(name: str) -> tuple[dict[str, float], str]:
    """Settings that a file's or folder's name states, and the rest of the name.

    >>> settings_in_name("frame_0012_iso200_1-125s_f5.6")
    ({'iso': 200.0, 'exposure_time': 0.008, 'f_number': 5.6}, 'frame_0012')
    >>> settings_in_name("n01443537")
    ({}, 'n01443537')
    """
    found: dict[str, float] = {}
    rest = name
    for setting, pattern in _IN_NAMES:
        match = None if setting in found else pattern.search(rest)
        if match is None:
            continue
        number, *more = match.groups()
        value = float(number)
        if more and more[0].lower() in UNITS:
            value *= UNITS[more[0].lower()]
        elif more:  # one over it; 0 is no setting, which is said where the settings are made
            value = value / float(more[0]) if float(more[0]) else 0.0
        found[setting] = value
        rest = rest[: match.start()] + rest[match.end() :]
    found = {setting: found[setting] for setting in _SETTINGS if setting in found}
    return (found, re.sub(r"[_\-. ]+$|^[_\-. ]+", "", rest)) if found else ({}, name)


# -- settings in tables and files -----------------------------------------------------------------


def _read_tables(folder: Path) -> dict[Path | str, dict[str, float]]:
    """Settings of all tables in a folder, by the place of a file or folder, and by its name."""
    found: dict[Path | str, dict[str, float]] = {}
    for pattern in _TABLES:
        for table in sorted(folder.rglob(pattern)):
            for name, settings in _rows(table):
                known = found.setdefault(table.parent / name, settings)
                if known != settings:
                    raise ValueError(
                        f"{str(table)!r} must have one row for {name!r}: two say {known} and "
                        f"{settings}"
                    )
                found[name] = settings
    return found


def _rows(table: Path) -> Iterator[tuple[str, dict[str, float]]]:
    """Name and settings of each row of a table."""
    rows = read_table(table)
    names = {what: next((c for c in known if c in rows), None) for what, known in _COLUMNS.items()}
    if names["file"] is None or not any(names[what] for what in _SETTINGS):
        raise ValueError(
            f"{str(table)!r} (columns {[*rows]}) must have the column file and one or more of iso, "
            "exposure_time and f_number"
        )
    for number, row in enumerate(rows.to_dict("records"), start=2):
        values = {what: row[column].strip() for what, column in names.items() if column}
        try:
            settings = {name: parse_number(values[name]) for name in _SETTINGS if values.get(name)}
            # The states of ImageNet-ES are numbered.
            name = values["file"]
            yield f"param_{parse_number(name):g}" if names["file"] == "idx" else name, settings
        except ValueError as error:
            raise ValueError(f"{str(table)!r}, line {number}: {error}") from error


def _in_file(path: Path) -> dict[str, float]:
    """Settings that the file states in its EXIF; none where it has none."""
    if path.suffix.lower() in RAW_SUFFIXES:
        return read_settings(path)
    try:
        with open_picture(path) as picture:
            exif = picture.getexif()
            make, model = (str(exif.get(getattr(ExifTags.Base, n), "")) for n in ("Make", "Model"))
            tags = exif.get_ifd(ExifTags.IFD.Exif)
    except ValueError:
        if not path.exists():  # a link that leads nowhere
            raise
        return {}  # said where its pixels are read
    names = (ExifTags.Base.ISOSpeedRatings, ExifTags.Base.ExposureTime, ExifTags.Base.FNumber)
    values = {what: tags.get(tag) for what, tag in zip(_SETTINGS, names, strict=True)}
    numbers = {n: v[0] if isinstance(v, tuple) else v for n, v in values.items() if v}
    found = {name: float(value) for name, value in numbers.items() if float(value) > 0}
    if "exposure_time" in found and marks_stops(make, model, numbers["exposure_time"]):
        found["exposure_time"] = snap_exposure_time(found["exposure_time"])
    return found


def recorded_grid(files: Sequence[RecordedFile]) -> ExposureGrid:
    """The grid of every ISO, exposure time and f-number that some capture was taken at."""
    values: list[list[float]] = []
    for name in _SETTINGS:
        values.append([])
        for value in sorted(getattr(file.settings, name) for file in files):
            if not values[-1] or value > values[-1][-1] * (1.0 + SAME):
                values[-1].append(value)  # of those that are the same, the first
    isos, times, f_numbers = map(len, values)
    if isos * times * f_numbers > MOST_STATES:
        raise ValueError(
            f"the recorded captures have {isos} ISO speeds, {times} exposure times and {f_numbers} "
            f"f-numbers, {isos * times * f_numbers} combinations; at most {MOST_STATES}: give the "
            "`grid` that you want"
        )
    return ExposureGrid(*map(tuple, values))


def state_of(settings: CameraSettings, grid: ExposureGrid) -> int | None:
    """Index of the state of `grid` with these settings; None where it has none."""
    wanted = (settings.iso, settings.exposure_time, settings.f_number)
    indices = []
    for value, known in zip(wanted, (grid.isos, grid.exposure_times, grid.f_numbers), strict=True):
        off = [abs(one / value - 1.0) for one in known]
        if min(off) > SAME:
            return None
        indices.append(off.index(min(off)))
    return grid.index(*indices)
