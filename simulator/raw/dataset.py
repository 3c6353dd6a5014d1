"""Sequences of real captures, in the two layouts of the paper's dataset.

*Raws*: one folder per sequence, holding its captures as raw files. *Packed*: what the authors'
preprocessing writes, a table ``camera_params.csv`` with one row per capture, and for each capture a
file ``SEQUENCE/NAME.npy``: float32 (4, H, W), planes **R, G1, B, G2**, black-subtracted, 1.0 at
white, not clipped. Rows name the developed picture beside it, ``.../SEQUENCE/NAME.jpg``.

A capture is read when it is asked for, and not held.
"""

from __future__ import annotations

import csv
import io
import logging
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import overload

import numpy as np
import torch

from simulator.camera import CameraProfile, get_camera
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.raw.dng import write_dng
from simulator.raw.image import RawImage
from simulator.raw.read import read_raw
from simulator.settings import CameraSettings
from simulator.utils.files import RAW_SUFFIXES, write_atomically

logger = logging.getLogger(__name__)

#: The table, and the one beside it with what developing the raws needs.
PARAMETERS, DEVELOPING = "camera_params.csv", "camera_isp_params.csv"
#: Columns that the table must have. ``wb`` and ``noiseprofile`` are read where they are.
COLUMNS = ("path", "time", "iso", "aperture")
#: Black and white level that the authors' preprocessing takes, per camera.
LEVELS = {"nikon_z6": (1008.0, 15520.0), "canon_70d": (2048.0, 15000.0)}
#: From R, G1, B, G2 of the ``.npy`` files to R, G1, G2, B, and back: it inverts itself.
_PLANES = [0, 1, 3, 2]

Balance = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class RawSequence:
    """Captures of one static scene with different settings.

    Args:
        name: Name of the sequence: its folder.
        captures: The raws. Those of `read_sequence` are a lazy sequence: indexing or iterating
            reads one capture at a time; ``list(sequence.captures)`` holds them all.
    """

    name: str
    captures: Sequence[RawImage]


class _Lazy(Sequence[RawImage]):
    """A sequence whose items are read from their files each time they are asked for."""

    def __init__(self, readers: Sequence[Callable[[], RawImage]]) -> None:
        self._readers = readers

    def __len__(self) -> int:
        return len(self._readers)

    @overload
    def __getitem__(self, index: int) -> RawImage: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[RawImage]: ...
    def __getitem__(self, index: int | slice) -> RawImage | Sequence[RawImage]:
        if isinstance(index, slice):
            return _Lazy(self._readers[index])
        return self._readers[index]()


def read_dataset(
    root: str | os.PathLike[str], *, camera: CameraProfile | str | None = None
) -> list[RawSequence]:
    """Every sequence under `root`, in either layout, sorted by name.

    Args:
        root: A folder. If there is a ``camera_params.csv`` in it or below, the sequences are the
            ones that such tables list; otherwise every folder that holds raws is a sequence.
        camera: As in `read_sequence`.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If it holds no sequence, or a table cannot be read.
    """
    folder = _existing("root", root)
    tables = sorted(folder.rglob(PARAMETERS))
    if tables:
        packed = [
            _packed(name, captures)
            for table in tables
            for name, captures in read_table(table, camera).items()
        ]
        return sorted(packed, key=lambda sequence: sequence.name)
    folders = sorted({path.parent for path in folder.rglob("*") if _is_raw(path)})
    if not folders:
        raise ValueError(
            f"`root` (={str(folder)!r}) must hold a {PARAMETERS}, or folders of raw files "
            f"({', '.join(RAW_SUFFIXES[:8])} ...)"
        )
    names = [f.relative_to(folder).as_posix() if f != folder else f.name for f in folders]
    return [_raws(name, f, camera) for name, f in zip(names, folders, strict=True)]


def read_sequence(
    folder: str | os.PathLike[str], *, camera: CameraProfile | str | None = None
) -> RawSequence:
    """The sequence in `folder`, in either layout.

    Args:
        folder: A folder of raws (any that LibRaw reads; a capture that is there as DNG and in its
            maker's format is read from the DNG), or of ``.npy`` files with ``camera_params.csv``
            beside them or in the folder above.
        camera: The body, in place of what the files say: as in `read_raw` for raws, as in
            `simulator.raw.dataset.read_table` for ``.npy`` files.

    Returns:
        The captures, raws by file name, others in the order of the table. Settings come from EXIF
        or the table, the shutter speed as the exact stop that the recorded one stands for.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If it holds no sequence or several, or the table cannot be read.
    """
    folder = _existing("folder", folder)
    if (folder / PARAMETERS).is_file():
        sequences = read_table(folder / PARAMETERS, camera)
        if len(sequences) > 1:
            raise ValueError(
                f"`folder` (={str(folder)!r}) must hold one sequence, but its {PARAMETERS} lists "
                f"{len(sequences)}; use read_dataset"
            )
        return _packed(*next(iter(sequences.items())))
    if (folder.parent / PARAMETERS).is_file():
        captures = read_table(folder.parent / PARAMETERS, camera).get(folder.name)
        if captures is not None:
            return _packed(folder.name, captures)
    if not any(map(_is_raw, folder.iterdir())):
        endings = sorted({p.suffix.lower() or "(none)" for p in folder.iterdir() if p.is_file()})
        raise ValueError(
            f"`folder` (={str(folder)!r}, files ending in {endings}) must hold raw files "
            f"({', '.join(RAW_SUFFIXES[:8])} ...), or be listed by a {PARAMETERS}"
        )
    return _raws(folder.name, folder, camera)


def write_raw_sequence(folder: str | os.PathLike[str], raws: Sequence[RawImage]) -> None:
    """Write `raws` as one folder of DNGs, ``capture_000.dng`` and on.

    Args:
        folder: Where to; new or empty.
        raws: At least one capture.

    Raises:
        ValueError: If `folder` holds something already, or there is no capture.
    """
    folder = _fresh(folder, raws)
    for index, raw in enumerate(raws):
        write_dng(folder / f"capture_{index:03d}.dng", raw)


def write_packed_sequence(folder: str | os.PathLike[str], raws: Sequence[RawImage]) -> None:
    """Write `raws` in the packed layout: ``capture_000.npy`` and on, beside ``camera_params.csv``.

    The table has the columns that the authors' script for the camera writes. It records an exposure
    time as a camera does: one within 3 % of a nominal stop is read back as that stop.

    Args:
        folder: Where to; new or empty.
        raws: At least one capture, all of one `simulator.raw.dataset.packed_camera`.

    Raises:
        ValueError: If `folder` holds something already, there is no capture, or a camera is not
            one that the layout knows.
    """
    folder = _fresh(folder, raws)
    name = raws[0].camera.name
    _check_cameras(raws, packed_camera(name))
    nikon = name == "nikon_z6"
    rows: list[list[object]] = [[*COLUMNS, *(["wb"] if nikon else []), "noiseprofile"]]
    for index, raw in enumerate(raws):
        stem = f"capture_{index:03d}"
        content = io.BytesIO()
        np.save(content, raw.data.detach().cpu().numpy()[_PLANES], allow_pickle=False)
        write_atomically(folder / f"{stem}.npy", content.getvalue())
        settings, noise = raw.settings, _profile_text(raw.noise, colours=nikon)
        row = [f"{folder.name}/{stem}.jpg", settings.exposure_time, settings.iso, settings.f_number]
        rows.append([*row, *([[*raw.white_balance, 0.0]] if nikon else []), noise])
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    write_atomically(folder / PARAMETERS, text.getvalue())


def _packed(name: str, captures: list[PackedCapture]) -> RawSequence:
    return RawSequence(name, _Lazy([capture.read for capture in captures]))


def _raws(name: str, folder: Path, camera: CameraProfile | str | None) -> RawSequence:
    by_stem: dict[str, Path] = {}
    for path in sorted(filter(_is_raw, folder.iterdir())):
        if path.stem not in by_stem or path.suffix.lower() == ".dng":
            by_stem[path.stem] = path
    return RawSequence(name, _Lazy([partial(read_raw, p, camera=camera) for p in by_stem.values()]))


def _is_raw(path: Path) -> bool:
    return path.suffix.lower() in RAW_SUFFIXES and not path.name.startswith(".") and path.is_file()


def _existing(name: str, folder: str | os.PathLike[str]) -> Path:
    path = Path(folder).expanduser()
    if not path.is_dir():
        raise FileNotFoundError(f"`{name}` (={str(path)!r}) must be an existing folder")
    return path


def _fresh(folder: str | os.PathLike[str], raws: Sequence[RawImage]) -> Path:
    path = Path(folder).expanduser()
    if path.exists() and any(path.iterdir()):
        raise ValueError(f"`folder` (={str(path)!r}) must be new or empty")
    if not raws:
        raise ValueError("`raws` (=[]) must hold at least one capture")
    return path


# -- the packed layout ----------------------------------------------------------------------------


def packed_camera(name: str) -> CameraProfile:
    """The built-in camera `name` with the levels of the packed layout, and its noise on that scale.

    Args:
        name: ``"nikon_z6"`` or ``"canon_70d"``.

    Raises:
        ValueError: If the packed layout does not know the camera.

    >>> packed_camera("canon_70d").black_level
    (2048.0, 2048.0, 2048.0, 2048.0)
    """
    if name not in LEVELS:
        raise ValueError(f"`camera` (={name!r}) must be one of {', '.join(LEVELS)}")
    camera = get_camera(name)
    black, white = LEVELS[name]
    return camera.with_levels((black,) * 4, white, camera.bit_depth)


@dataclass(frozen=True)
class PackedCapture:
    """One capture of the packed layout: a row of its table.

    Args:
        file: Its ``.npy`` file.
        camera: The body.
        settings: The exposure settings.
        white_balance: Gains of R, G, B, green 1; None if not stated.
        nlf: Noise as the row states it; None if it does not.
    """

    file: Path
    camera: CameraProfile
    settings: CameraSettings
    white_balance: Balance | None
    nlf: NoiseLevelFunction | None

    def read(self) -> RawImage:
        """Read the capture from its file.

        Raises:
            ValueError: If the file is not a finite (4, H, W) array of floating-point numbers;
                pickled objects are refused.
        """
        try:
            array = np.load(self.file, allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise ValueError(
                f"`{self.file}` must be a whole .npy file of numbers: {error}"
            ) from None
        if not isinstance(array, np.ndarray) or array.ndim != 3 or array.shape[0] != 4:
            shape = getattr(array, "shape", type(array).__name__)
            raise ValueError(f"`{self.file}` (shape {shape}) must be (4, H, W): R, G1, B, G2")
        stated = self.nlf is not None
        return RawImage(
            torch.from_numpy(array[_PLANES]),
            self.settings,
            self.camera,
            self.nlf,
            self.white_balance or (1.0, 1.0, 1.0),
            metadata={
                "path": self.file.name,
                "make": self.camera.make,
                "model": self.camera.model,
                "nlf_source": PARAMETERS if stated else f"camera calibration ({self.camera.name})",
                "white_balance_source": "camera" if self.white_balance else "none",
            },
        )


def read_table(
    table: Path, camera: CameraProfile | str | None = None
) -> dict[str, list[PackedCapture]]:
    """The captures that `table` lists, by sequence, in the order of the table.

    Rows whose ``.npy`` file is not there are left out, with a warning in the log: a copy of the
    dataset may be partial.

    Args:
        table: A ``camera_params.csv``. Its paths begin where the preprocessing ran: only their last
            two parts count, and the last alone if the files lie beside the table.
        camera: The body: a profile, or a name that `packed_camera` knows. Without it, a table with
            a column ``wb`` is the Nikon Z6's and one without the Canon 70D's, as the authors'
            scripts write them.

    Raises:
        ValueError: If a column is missing, a cell is no number, or no file is there.
    """
    found, rows = _rows(table)
    if camera is None:
        camera = "nikon_z6" if "wb" in found else "canon_70d"
    profile = packed_camera(camera) if isinstance(camera, str) else camera
    balances = _white_balances(table.with_name(DEVELOPING))
    captures: dict[str, list[PackedCapture]] = {}
    lost = []
    for number, row in enumerate(rows, start=2):
        path = _path(row["path"] or "")
        try:
            capture = _capture(table, path, row, profile, balances.get(path))
        except ValueError as error:
            raise ValueError(f"`{table}`, row {number}: {error}") from None
        if capture.file.is_file():
            name = path.parts[-2] if len(path.parts) > 1 else table.parent.name
            captures.setdefault(name, []).append(capture)
        else:
            lost.append(path)
    if lost:
        logger.warning("%s: %d of %d files are not there, %s", table, len(lost), len(rows), lost[0])
    if not captures:
        raise ValueError(
            f"`{table}` ({len(rows)} rows) must list .npy files that are there, as "
            "SEQUENCE/NAME.npy or NAME.npy beside the table"
        )
    return captures


def _check_cameras(raws: Sequence[RawImage], known: CameraProfile) -> None:
    for camera in (raw.camera for raw in raws):
        levels = (camera.name, camera.cfa, camera.black_level, camera.white_level)
        if levels != (known.name, known.cfa, known.black_level, known.white_level):
            raise ValueError(
                f"`raws` (one of {camera.name!r}, {camera.cfa.value}, black {camera.black_level}, "
                f"white {camera.white_level:g}) must all be of packed_camera({known.name!r}): the "
                "files do not state levels"
            )


def _rows(table: Path) -> tuple[list[str], list[dict[str, str | None]]]:
    with table.open(encoding="utf-8-sig", newline="") as stream:
        reader = csv.DictReader(stream)
        found = [name.strip() for name in reader.fieldnames or []]
        missing = [name for name in COLUMNS if name not in found]
        if missing:
            raise ValueError(
                f"`{table}` (columns: {', '.join(found) or 'none'}) must have the columns "
                f"{', '.join(COLUMNS)}, and may have wb and noiseprofile; "
                f"missing: {', '.join(missing)}"
            )
        reader.fieldnames = found
        return found, list(reader)


def _path(text: str) -> PurePosixPath:
    return PurePosixPath(text.strip().replace("\\", "/"))


def _capture(
    table: Path,
    path: PurePosixPath,
    row: Mapping[str, str | None],
    camera: CameraProfile,
    developing: Balance | None,
) -> PackedCapture:
    values = {}
    for name in ("iso", "time", "aperture"):
        try:
            values[name] = float(row[name] or "")
        except ValueError:
            raise ValueError(f"`{name}` (={row[name]!r}) must be a number") from None
    settings = CameraSettings.from_exif(values["iso"], values["time"], values["aperture"])
    gains, noise = _numbers(row.get("wb")), _numbers(row.get("noiseprofile"))
    balance = (gains[0] / gains[1], 1.0, gains[2] / gains[1]) if _positive(gains) else developing
    stem = f"{path.stem}.npy"
    nested = table.parent.joinpath(*path.parts[-2:-1], stem)
    file = nested if nested.is_file() else table.with_name(stem)
    return PackedCapture(file, camera, settings, balance, _noise_profile(noise) if noise else None)


def _numbers(text: str | None) -> tuple[float, ...]:
    """Numbers separated by blanks, or a list as Python prints it."""
    return tuple(float(v) for v in (text or "").strip(" []()\r\n").replace(",", " ").split())


def _positive(values: tuple[float, ...]) -> bool:
    return len(values) >= 3 and min(values[:3]) > 0


def _noise_profile(numbers: tuple[float, ...]) -> NoiseLevelFunction:
    """Pairs (shot, read) of a DNG NoiseProfile: one for all colours, or one each for R, G, B."""
    if len(numbers) not in (2, 6):
        raise ValueError(f"`noiseprofile` (={numbers}) must be 2 or 6 numbers")
    pairs = [numbers[i : i + 2] for i in range(0, len(numbers), 2)] * (
        3 if len(numbers) == 2 else 1
    )
    shot, read = zip(*(pairs[colour] for colour in (0, 1, 1, 2)), strict=True)
    return NoiseLevelFunction(shot, read, source=f"DNG NoiseProfile, from {PARAMETERS}")


def _profile_text(nlf: NoiseLevelFunction, *, colours: bool) -> str:
    """A DNG NoiseProfile of `nlf`: greens averaged, or without `colours` all averaged."""
    groups: Iterable[tuple[int, ...]] = ((0,), (1, 2), (3,)) if colours else ((0, 1, 2, 3),)
    return " ".join(
        repr(sum(values[i] for i in planes) / len(planes))
        for planes in groups
        for values in (nlf.shot, nlf.read)
    )


def _white_balances(table: Path) -> dict[PurePosixPath, Balance]:
    """Gains by path, from AsShotNeutral, if there is such a table.

    Its cells hold no commas, and some are longer than Python's csv module reads.
    """
    if not table.is_file():
        return {}
    with table.open(encoding="utf-8-sig") as stream:
        header = [name.strip() for name in next(stream, "").split(",")]
        if not {"path", "AsShotNeutral"} <= set(header):
            return {}
        at, neutral = header.index("path"), header.index("AsShotNeutral")
        rows = (line.split(",", max(at, neutral) + 1) for line in stream if line.strip())
        values = {_path(row[at]): _numbers(row[neutral]) for row in rows}
    return {p: (v[1] / v[0], 1.0, v[1] / v[2]) for p, v in values.items() if _positive(v)}
