"""Sequences of real captures, in the two layouts of the paper's dataset.

*Raws*: one folder per sequence, holding its captures as raw files. *Packed*: the authors'
preprocessed form, ``camera_params.csv`` beside packed ``.npy`` files (`simulator.packed_table`).
Both read lazily: a capture is read when it is asked for, and not kept.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import overload

from simulator.camera import CameraProfile
from simulator.dng import write_dng
from simulator.files import RAW_SUFFIXES
from simulator.packed_table import PARAMETERS, PackedCapture, read_table, write_table
from simulator.raw_file import read_raw
from simulator.raw_image import RawImage


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
    """A sequence whose items are read anew each time they are asked for."""

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
            `simulator.packed_table.read_table` for ``.npy`` files.

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

    The layout records an exposure time as a camera does: one within 3 % of a nominal stop is read
    back as that stop.

    Args:
        folder: Where to; new or empty.
        raws: At least one capture, all of one `simulator.packed_table.packed_camera`.

    Raises:
        ValueError: If `folder` holds something already, there is no capture, or a camera is not
            one that the layout knows.
    """
    write_table(_fresh(folder, raws), raws)


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
