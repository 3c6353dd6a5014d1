"""The packed layout of the paper's dataset: a table of captures beside their ``.npy`` files.

What the authors' preprocessing writes: ``camera_params.csv`` with one row per capture, and for each
a file ``SEQUENCE/NAME.npy``, float32 (4, H, W), planes **R, G1, B, G2**, black-subtracted, 1.0 at
white, not clipped. Rows name the developed picture beside it, ``.../SEQUENCE/NAME.jpg``.
"""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
import torch

from simulator.camera import CameraProfile, NoiseLevelFunction, get_camera
from simulator.files import write_atomically
from simulator.raw_image import RawImage
from simulator.settings import CameraSettings

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


def packed_camera(name: str) -> CameraProfile:
    """The built-in camera `name` with the levels of the packed layout, its noise brought to them.

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
    factor = camera.span[0] / (white - black)  # the same digital numbers on the new scale
    return replace(
        camera,
        black_level=(black,) * 4,
        white_level=white,
        nlf_by_iso={iso: nlf.exposed(factor) for iso, nlf in camera.nlf_by_iso.items()},
    )


@dataclass(frozen=True)
class PackedCapture:
    """One row of the table.

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
        """The capture, read from its file.

        Raises:
            ValueError: If the file is not a finite (4, H, W) array of floating-point numbers;
                pickled objects are refused, not run.
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


def write_table(folder: Path, raws: Sequence[RawImage]) -> None:
    """Write `raws` to `folder`: ``capture_000.npy`` and on, and the table beside them.

    The table has the columns that the authors' script for the camera writes.

    Args:
        folder: Where to.
        raws: At least one capture, all of `packed_camera` of one name.

    Raises:
        ValueError: If a camera is not one that the layout knows.
    """
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

    Its cells hold no commas, and some are longer than what csv takes.
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
