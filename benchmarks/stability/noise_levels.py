"""Noise level functions between, below and above the ISOs that were calibrated."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from benchmarks.stability.case import Row
from simulator import CameraProfile, NoiseLevelFunction, get_camera, list_cameras

GROUP = "noise level functions"
LIMIT = 1e-12
#: From below every camera's lowest ISO to above every camera's highest.
ISOS = np.geomspace(50.0, 409_600.0, 400).tolist()


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """The cases of this group."""
    for name in list_cameras():
        camera = get_camera(name)
        yield _interpolated(camera)
        for case, isos in _outside(camera):
            yield _extrapolated(camera, case, isos)
        yield from (_switch(camera, iso) for iso in camera.segments)


def _numbers(nlf: NoiseLevelFunction) -> np.ndarray:
    return np.array([nlf.shot, nlf.read])


def _segment(camera: CameraProfile, iso: float) -> list[float]:
    """Calibrated ISOs of the conversion-gain segment that `iso` lies in."""
    edges = [0.0, *camera.segments, math.inf]
    low = max(edge for edge in edges if edge <= iso)
    high = min(edge for edge in edges if edge > iso)
    return sorted(i for i in camera.nlf_by_iso if low <= i < high)


def _interpolated(camera: CameraProfile) -> Row:
    """Against numpy's interpolation of logarithms, segment by segment."""
    worst, finite, monotone, table = 0.0, True, True, camera.nlf_by_iso
    segments = (_segment(camera, iso) for iso in sorted(table))
    for low, high in dict.fromkeys((isos[0], isos[-1]) for isos in segments):
        previous = None
        for iso in (i for i in ISOS if low <= i <= high):
            known = _segment(camera, iso)
            logs = np.log(np.stack([_numbers(table[i]) for i in known]))  # (K, 2, 4)
            wanted = np.exp(
                np.apply_along_axis(
                    lambda y, k=known, x=iso: np.interp(math.log(x), np.log(k), y), 0, logs
                )
            )
            found = _numbers(camera.nlf(iso))
            worst = max(worst, float(np.abs(found / wanted - 1.0).max()))
            finite &= bool(np.isfinite(found).all())
            shot = found[0].sum()
            monotone &= previous is None or shot >= previous
            previous = shot
    isos = sorted(table)
    case = f"{camera.name}, between ISO {isos[0]:g} and {isos[-1]:g}"
    return Row(
        GROUP, case, worst, limit=LIMIT, dtype="float64", finite=finite, monotone=bool(monotone)
    )


def _outside(camera: CameraProfile) -> Iterator[tuple[str, list[float]]]:
    lowest, highest = min(camera.nlf_by_iso), max(camera.nlf_by_iso)
    yield f"below ISO {lowest:g}, from 50", [i for i in ISOS if i < lowest]
    yield f"above ISO {highest:g}, to 409600", [i for i in ISOS if i > highest]


def _extrapolated(camera: CameraProfile, case: str, isos: list[float]) -> Row:
    """Shot noise goes with the ISO, read noise with its square, from the nearest that is known."""
    worst, finite, declared = 0.0, True, True
    for iso in isos:
        nearest = min(camera.nlf_by_iso, key=lambda known: abs(math.log(known / iso)))
        factor = np.array([[iso / nearest], [(iso / nearest) ** 2]])
        found = camera.nlf(iso)
        wanted = _numbers(camera.nlf_by_iso[nearest]) * factor
        worst = max(worst, float(np.abs(_numbers(found) / wanted - 1.0).max()))
        finite &= bool(np.isfinite(_numbers(found)).all())
        declared &= found.extrapolated
    return Row(
        GROUP,
        f"{camera.name}, {case}",
        worst,
        limit=LIMIT,
        dtype="float64",
        finite=finite and declared,
        declared="`NoiseLevelFunction.extrapolated`" if declared else "",
    )


def _switch(camera: CameraProfile, iso: float) -> Row:
    """Just below the switch the noise is that of the low gain, at it that of the high one."""
    low, high = _segment(camera, iso - 1e-6), _segment(camera, iso)
    below = _numbers(camera.nlf(iso - 1e-6))
    nearest = _numbers(camera.nlf_by_iso[low[-1]])
    ratio = (iso - 1e-6) / low[-1]
    extrapolated = nearest * np.array([[ratio], [ratio**2]])
    at = _numbers(camera.nlf(iso))
    error = np.abs(below / extrapolated - 1.0).max() if iso - 1e-6 > low[-1] else 0.0
    error = max(error, np.abs(at / _numbers(camera.nlf_by_iso[high[0]]) - 1.0).max())
    drop = below[1].mean() / at[1].mean()
    return Row(
        GROUP,
        f"{camera.name}, across the conversion-gain switch at ISO {iso:g}",
        float(error),
        limit=LIMIT,
        dtype="float64",
        note=f"read noise just below it is {drop:.1f} times that at it",
    )
