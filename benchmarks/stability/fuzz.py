"""Damaged files, thousands of them: each is read or refused, and nothing else happens.

Every batch runs in a process of its own: what ends that is a fault, too.
"""

from __future__ import annotations

import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.data import data_folder
from benchmarks.isolated import ROOT, isolated
from benchmarks.stability.case import Row

GROUP = "fuzzing"
#: Inputs of each kind, and of a process.
INPUTS, QUICK_INPUTS, BATCH = 1000, 200, 1000
#: A file that takes longer than this to read or to refuse is a fault [s].
_PATIENCE = 5.0
#: And so is a batch that takes longer than this [s].
_BATCH_PATIENCE = 600.0
_KEY = "0" * 24


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """The cases of this group."""
    for kind in KINDS:
        inputs = QUICK_INPUTS if quick else INPUTS
        if kind == "real raw":
            inputs //= 10
        row = _row(kind, inputs, seed)
        if row is not None:
            yield row


def _row(kind: str, inputs: int, seed: int) -> Row | None:
    """The row of `kind`; None where there are no files of it (real ones, without AE_ENV_DATA)."""
    refused, read, faults, first = 0, 0, 0, ""
    for start in range(0, inputs, BATCH):
        count = min(BATCH, inputs - start)
        batch: dict[str, Any] = {"kind": kind, "first": start, "count": count, "seed": seed}
        try:
            found = isolated(run_batch, num_threads=1, timeout=_BATCH_PATIENCE, **batch)
        except RuntimeError as error:  # the process died
            found = {"read": 0, "refused": 0, "faults": [str(error)]}
        except subprocess.TimeoutExpired as error:
            words = f"inputs from {start} on took more than {error.timeout:g} s"
            found = {"read": 0, "refused": 0, "faults": [words]}
        read, refused = read + found["read"], refused + found["refused"]
        faults += len(found["faults"])
        first = first or next(iter(found["faults"]), "")
    if not read + refused + faults:
        return None
    note = f"{read:,} read, {refused:,} refused" + (f"; first fault: {first}" if first else "")
    return Row(
        GROUP,
        f"{kind}: {inputs:,} damaged files",
        float(faults),
        error="faults",
        limit=0.0,
        dtype="",
        note=note,
    )


def run_batch(kind: str, first: int, count: int, seed: int) -> dict[str, Any]:
    """Reads inputs `first` to ``first + count``: how many were read and refused, and the faults.

    A fault is any error that is not a `ValueError`, any input that is read as what no file says
    (data that are not finite, or not those that were written), and any that takes too long.
    """
    make, read = KINDS[kind]
    found: dict[str, Any] = {"read": 0, "refused": 0, "faults": []}
    with tempfile.TemporaryDirectory() as folder:
        originals = make(Path(folder))
        if not originals:
            return found
        for number in range(first, first + count):
            rng = np.random.default_rng([seed, number])
            original = originals[number % len(originals)]
            path = Path(folder) / f"damaged{original.suffix}"
            path.write_bytes(damaged(original.read_bytes(), rng))
            outcome = _outcome(path, read)
            if outcome in ("read", "refused"):
                found[outcome] += 1
            else:
                found["faults"].append(f"input {number}: {outcome}")
    assert found["read"] + found["refused"] + len(found["faults"]) == count
    return found


def _outcome(path: Path, read: Callable[[Path], bool]) -> str:
    """``"read"``, ``"refused"``, or what is wrong."""
    start = time.perf_counter()
    try:
        outcome = "read" if read(path) else "read as what it does not hold"
    except ValueError:
        outcome = "refused"
    except Exception as error:  # what the user would see as a traceback
        return f"{type(error).__name__}: {error}"
    return outcome if time.perf_counter() - start <= _PATIENCE else "took too long"


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """`content` after one to four accidents: cut off, bits flipped, pieces lost or overwritten.

    Most of them near the beginning, where the structure of a file is.
    """
    data = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        if not data:
            break
        reach = len(data) if rng.random() < 0.3 else min(len(data), 1024)
        at, size = int(rng.integers(reach)), int(rng.integers(1, 65))
        accident = int(rng.integers(6))
        if accident == 0:
            del data[int(rng.integers(len(data))) :]
        elif accident == 1:
            data[at] ^= 1 << int(rng.integers(8))
        elif accident == 2:
            del data[at : at + size]
        elif accident == 3:
            data[at:at] = rng.bytes(size)
        elif accident == 4:
            data[at : at + size] = bytes([int(rng.choice([0, 0x7F, 0xFF]))]) * size
        else:
            data[at : at + size] = rng.bytes(min(size, len(data) - at))
    return bytes(data)


# -- what is read -------------------------------------------------------------------------------


def _dngs(folder: Path) -> list[Path]:
    from simulator import CameraSettings, RawImage, get_camera, write_dng

    generator = torch.Generator().manual_seed(0)
    data = torch.rand(4, 24, 32, generator=generator)
    settings = CameraSettings(400.0, 1 / 60, 4.0)
    raw = RawImage(data, settings, camera=get_camera("nikon_z6"))
    own, foreign = folder / "original_own.dng", folder / "original_foreign.dng"
    write_dng(own, raw)
    # Without our name in it LibRaw reads it, as any other maker's.
    foreign.write_bytes(own.read_bytes().replace(b"ae-env ", b"others ", 1))
    return [own, foreign]


def _real_raws(folder: Path) -> list[Path]:
    try:
        found = data_folder("canon_crw_cc0")
    except FileNotFoundError:
        return []
    return sorted(found.glob("*.CRW"))[:3]


def _radiance_maps(folder: Path) -> list[Path]:
    generator = np.random.default_rng(0)
    pixels = generator.integers(100, 140, (16, 32, 4), dtype=np.uint8)
    path = folder / "original.hdr"
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 32\n"
    path.write_bytes(head + pixels.tobytes())
    return [path]


def _openexr_maps(folder: Path) -> list[Path]:
    import OpenEXR

    generator = np.random.default_rng(0)
    channels = {name: generator.random((16, 32), np.float32) for name in "RGB"}
    paths = []
    for name in ("NO", "ZIP", "PIZ"):
        header = {"compression": getattr(OpenEXR, f"{name}_COMPRESSION")}
        paths.append(folder / f"original_{name}.exr")
        OpenEXR.File(header | {"type": OpenEXR.scanlineimage}, channels).write(str(paths[-1]))
    return paths


def _configs(folder: Path) -> list[Path]:
    return sorted((ROOT / "configs").rglob("*.yaml"))


def _cached(folder: Path) -> list[Path]:
    from simulator.utils.cache import DiskCache

    cache = DiskCache(folder)
    cache.put("denoised", _KEY, _tensors())
    return [cache.path("denoised", _KEY)]


def _tensors() -> dict[str, torch.Tensor]:
    return {"light": torch.rand(4, 16, 16, generator=torch.Generator().manual_seed(0))}


def _read_raw(path: Path) -> bool:
    from simulator import read_raw

    return bool(torch.isfinite(read_raw(path).data).all())


def _read_radiance(path: Path) -> bool:
    from ae_env.scenes.radiance import read_radiance

    return bool(np.isfinite(read_radiance(path)).all())


def _read_config(path: Path) -> bool:
    from agents.learning.training import AgentConfig
    from simulator.training.config import SimulatorConfig
    from simulator.utils.config_file import load_yaml

    try:
        load_yaml(path, AgentConfig)
    except ValueError:
        load_yaml(path, SimulatorConfig)
    return True


def _read_cached(path: Path) -> bool:
    """Whether a cache finds what was written; where it finds nothing, that counts as refused."""
    from simulator.utils.cache import DiskCache

    cache = DiskCache(path.parent / "damaged")  # the original stays
    target = cache.path("denoised", _KEY)
    target.parent.mkdir(parents=True, exist_ok=True)
    path.replace(target)
    found, written = cache.get("denoised", _KEY), _tensors()
    if found is None:
        raise ValueError("damaged")
    return found.keys() == written.keys() and all(
        found[name].dtype == tensor.dtype and torch.equal(found[name], tensor)
        for name, tensor in written.items()
    )


#: By kind: the files that are damaged, made in a folder, and what reads them.
KINDS: dict[str, tuple[Callable[[Path], list[Path]], Callable[[Path], bool]]] = {
    "DNG": (_dngs, _read_raw),
    "real raw": (_real_raws, _read_raw),
    "Radiance map": (_radiance_maps, _read_radiance),
    "OpenEXR map": (_openexr_maps, _read_radiance),
    "configuration": (_configs, _read_config),
    "cache entry": (_cached, _read_cached),
}
