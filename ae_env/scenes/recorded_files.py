"""Which file is which state of which scene: the index of a folder of recorded grids.

Three layouts, told apart by where the settings stand:

- one folder a scene, one file a state: ``SCENE/iso100_1-125s_f4.dng``, or any names whose settings
  are in EXIF or a table;
- one folder a state, one file a scene, as in ImageNet-ES: ``l1/param_3/CLASS/PICTURE.JPEG`` with a
  table that says what ``param_3`` is;
- stacks of video, one folder a frame: ``SCENE/frame_0007/1-125s.png``.

A table is a ``settings.csv`` or ``grid-options*.csv`` in the folder or below, with a row for each
file or folder.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import ExifTags, Image, UnidentifiedImageError

from ae_env.grid import ExposureGrid
from simulator.raw.read import read_settings
from simulator.settings import CameraSettings
from simulator.utils.files import PICTURE_SUFFIXES, RAW_SUFFIXES

#: How a text names a recorded grid.
PREFIX = "recorded:"
#: Two values of a setting are the same within this share: recorded ones are rounded.
SAME = 0.035
#: Most states of a grid that is put together from files.
MOST_STATES = 4096
_TABLES = ("settings.csv", "grid-options*.csv")
_COLUMNS = {
    "file": ("file", "path", "folder", "param", "idx"),
    "iso": ("iso",),
    "exposure_time": ("exposure_time", "time", "shutter", "ss"),
    "f_number": ("f_number", "aperture"),
}
_SETTINGS = ("iso", "exposure_time", "f_number")
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
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
_FRAME = re.compile(r"frame[_-]?(\d+)", re.I)


@dataclass(frozen=True)
class RecordedFile:
    """One real capture.

    Args:
        path: Its file.
        settings: Settings that it was taken at.
        scene: Name of what it shows, of a frame of video with the frame's number.
        group: Source group: what it shows whatever the light.
        sequence: The video that it is a frame of; empty for a still scene.
        frame: Its number in that video.
    """

    path: Path
    settings: CameraSettings
    scene: str
    group: str
    sequence: str
    frame: int

    @property
    def is_picture(self) -> bool:
        """Whether it is a developed picture; else it is a raw."""
        return self.path.suffix.lower() in PICTURE_SUFFIXES


def index_recorded(folder: Path, known: Mapping[str, float]) -> list[RecordedFile]:
    """Every capture under `folder`, by scene, frame and settings.

    Args:
        folder: Searched with its sub-folders; hidden ones left out.
        known: Settings by name that the files do not state; those that they do come first.

    Raises:
        ValueError: If there is no capture, one does not state its settings, or a table is wrong.
    """
    if not folder.is_dir():
        raise ValueError(f"`scenes` (='recorded:{folder}') must name an existing folder")
    tables = _Tables(folder)
    found = [
        _recorded(folder, path, tables, known)
        for path in sorted(folder.rglob("*"))
        if path.suffix.lower() in (*RAW_SUFFIXES, *PICTURE_SUFFIXES)
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    ]
    if not found:
        raise ValueError(
            f"`scenes` (='recorded:{folder}') must hold captures: raws "
            f"({', '.join(RAW_SUFFIXES[:6])} ...) or pictures "
            f"({', '.join(PICTURE_SUFFIXES[:3])} ...)"
        )
    return sorted(found, key=lambda file: (file.sequence, file.frame, file.scene, file.settings))


def _recorded(
    folder: Path, path: Path, tables: _Tables, known: Mapping[str, float]
) -> RecordedFile:
    """`path` with its settings, and with what is left of its name once those are taken out."""
    parts = [*path.relative_to(folder).parts[:-1], path.stem]
    places = [path, *path.parents][: len(parts)][::-1]  # of each part, the file last
    settings: dict[str, float] = {}
    left: list[str] = []
    states: list[int] = []  # the parts that state a setting
    for number, (part, place) in enumerate(zip(parts, places, strict=True)):
        named, rest = settings_in_name(part)
        row = tables.row(place)
        if named or row:
            settings |= named | row
            states.append(number)
        left.append("" if row else rest)
    try:
        if len(settings) < len(_SETTINGS):
            stated = _in_file(path)
            if not settings and stated:
                left[-1] = ""  # a file of one state, whatever its name
                states.append(len(parts) - 1)
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
    names = [name for name in left if name] or [folder.resolve().name]
    subject = [name for name in left[max(states, default=-1) + 1 :] if name] or names
    frames = [match for name in names if (match := _FRAME.fullmatch(name))]
    still = [name for name in names if not _FRAME.fullmatch(name)]
    return RecordedFile(
        path=path,
        settings=taken_at,
        scene="/".join(names),
        group="/".join(name for name in subject if not _FRAME.fullmatch(name)) or "/".join(still),
        sequence=("/".join(still) or folder.resolve().name) if frames else "",
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
        if more:
            value = (
                value * _UNITS[more[0].lower()]
                if more[0].lower() in _UNITS
                else (value / float(more[0]) if float(more[0]) else 0.0)
            )
        found[setting] = value
        rest = rest[: match.start()] + rest[match.end() :]
    found = {setting: found[setting] for setting in _SETTINGS if setting in found}
    return (found, re.sub(r"[_\-. ]+$|^[_\-. ]+", "", rest)) if found else ({}, name)


# -- settings in tables and files -----------------------------------------------------------------


class _Tables:
    """Settings by file or folder, of all tables in a folder."""

    def __init__(self, folder: Path) -> None:
        self._by_place: dict[Path, dict[str, float]] = {}
        self._by_name: dict[str, dict[str, float]] = {}
        for pattern in _TABLES:
            for table in sorted(folder.rglob(pattern)):
                for name, settings in _rows(table):
                    place = table.parent / name
                    if self._by_place.setdefault(place, settings) != settings:
                        raise ValueError(
                            f"{str(table)!r} must have one row for {name!r}: two say "
                            f"{self._by_place[place]} and {settings}"
                        )
                    self._by_name[name] = settings

    def row(self, place: Path) -> dict[str, float]:
        """Settings that a table gives the file or folder `place`; a folder anywhere by its name."""
        found = self._by_place.get(place) or self._by_place.get(place.with_suffix(""))
        return found or (self._by_name.get(place.name, {}) if not place.suffix else {})


def _rows(table: Path) -> Iterator[tuple[str, dict[str, float]]]:
    """Name and settings of each row of a table."""
    try:
        with table.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream)
            rows, columns = list(reader), list(reader.fieldnames or ())
    except (csv.Error, OSError, UnicodeError) as error:
        raise ValueError(f"{str(table)!r} must be a CSV file in UTF-8: {error}") from error
    names = {
        what: next((c for c in known if c in columns), None) for what, known in _COLUMNS.items()
    }
    if names["file"] is None or not any(names[what] for what in _SETTINGS):
        raise ValueError(
            f"{str(table)!r} (columns {columns}) must have the column file and one or more of iso, "
            "exposure_time and f_number"
        )
    for number, row in enumerate(rows, start=2):
        values = {what: (row[column] or "").strip() for what, column in names.items() if column}
        try:
            settings = {name: parse_number(values[name]) for name in _SETTINGS if values.get(name)}
            # The states of ImageNet-ES are numbered.
            name = values["file"]
            yield f"param_{parse_number(name):g}" if names["file"] == "idx" else name, settings
        except ValueError as error:
            raise ValueError(f"{str(table)!r}, line {number}: {error}") from error


def parse_number(text: str) -> float:
    """The number of ``"1/20"``, ``'0"4'`` (0.4 s), ``"f5.6"``, ``"200"`` or ``"8ms"``."""
    plain = text.lower().removeprefix("f").removeprefix("/").replace('"', ".")
    unit = next((u for u in ("ms", "us", "s") if plain.endswith(u)), "")
    top, _, bottom = plain.removesuffix(unit).strip(" .").partition("/")
    try:
        return float(top) / float(bottom or 1) * _UNITS.get(unit, 1.0)
    except (ValueError, ZeroDivisionError):
        raise ValueError(f"{text!r} must be a number, such as 200, 1/125 or f5.6") from None


def _in_file(path: Path) -> dict[str, float]:
    """Settings that the file states in its EXIF; none where it has none."""
    if path.suffix.lower() in RAW_SUFFIXES:
        return read_settings(path)
    try:
        with Image.open(path) as picture:
            tags = picture.getexif().get_ifd(ExifTags.IFD.Exif)
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError):
        return {}  # said where its pixels are read
    names = {
        "iso": ExifTags.Base.ISOSpeedRatings,
        "exposure_time": ExifTags.Base.ExposureTime,
        "f_number": ExifTags.Base.FNumber,
    }
    values = {name: tags.get(tag) for name, tag in names.items()}
    numbers = {n: v[0] if isinstance(v, tuple) else v for n, v in values.items() if v}
    return {name: float(value) for name, value in numbers.items() if float(value) > 0}


# -- the grid that files make ---------------------------------------------------------------------


def recorded_grid(files: Sequence[RecordedFile]) -> ExposureGrid:
    """The grid of every ISO, exposure time and f-number that some capture was taken at.

    Raises:
        ValueError: If it would have more than `MOST_STATES`.
    """
    values = [
        _distinct([getattr(file.settings, name) for file in files])
        for name in ("iso", "exposure_time", "f_number")
    ]
    count = len(values[0]) * len(values[1]) * len(values[2])
    if count > MOST_STATES:
        raise ValueError(
            f"the recorded captures have {len(values[0])} ISO speeds, {len(values[1])} exposure "
            f"times and {len(values[2])} f-numbers, {count} combinations; at most {MOST_STATES}: "
            "give the `grid` that you want"
        )
    return ExposureGrid(*values)


def _distinct(values: Sequence[float]) -> tuple[float, ...]:
    """Ascending; of those that are the same, the first."""
    found: list[float] = []
    for value in sorted(values):
        if not found or value > found[-1] * (1.0 + SAME):
            found.append(value)
    return tuple(found)


def state_of(settings: CameraSettings, grid: ExposureGrid) -> int | None:
    """Index of the state of `grid` with these settings; None where it has none."""
    indices = []
    for value, known in zip(
        (settings.iso, settings.exposure_time, settings.f_number),
        (grid.isos, grid.exposure_times, grid.f_numbers),
        strict=True,
    ):
        nearest = min(range(len(known)), key=lambda i: abs(known[i] / value - 1.0))
        if abs(known[nearest] / value - 1.0) > SAME:
            return None
        indices.append(nearest)
    return grid.index(*indices)
