"""What the numbers are measured against: each target with the figure reached."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.isolated import CORES

#: Frame size and case that the targets for steps are about.
SIZE, CASE, NUM_ENVS = 128, "vector env, cached scene", 64
STEPS_PER_SECOND, TIMES_KERNEL = 5000.0, 1.5
MARGINAL, FULL_FRAME_MIB, TIMES_LIBRAW = 1.5, 2048.0, 2.0
#: An exponent counts as linear up to here, and if two standard errors lead down to 1.
_LINEAR = 1.1


@dataclass(frozen=True)
class Target:
    """One target.

    Args:
        what: In words.
        measured: The figure reached.
        limit: What it should be.
        at_least: Whether the figure should be at least the limit, or else at most.
        met: Whether it is.
    """

    what: str
    measured: float
    limit: float
    at_least: bool
    met: bool


def step_row(rows: list[dict[str, Any]], case: str = CASE, **wanted: Any) -> dict[str, Any] | None:
    """The row of `case`, by default with 64 environments at 128 x 128 on all threads."""
    wanted = {"case": case, "num_envs": NUM_ENVS, "size": SIZE, "threads": CORES} | wanted
    found = [row for row in rows if all(row[key] == value for key, value in wanted.items())]
    return found[0] if found else None


def check_targets(rows: list[dict[str, Any]], meta: dict[str, Any]) -> list[dict[str, Any]]:
    """All targets that this run has figures for, as JSON values."""
    found = [*_steps(rows), *_growth(meta), *_full_frame(meta)]
    return [asdict(target) for target in found]


def _at_most(what: str, measured: float, limit: float) -> Target:
    return Target(what, measured, limit, at_least=False, met=measured <= limit)


def _at_least(what: str, measured: float, limit: float) -> Target:
    return Target(what, measured, limit, at_least=True, met=measured >= limit)


def _steps(rows: list[dict[str, Any]]) -> list[Target]:
    row = step_row(rows)
    if row is None:
        return []
    speed, times = row["steps_per_second"], 1.0 / row["ratio_to_kernel"]
    where = f"{NUM_ENVS} environments at {SIZE} x {SIZE}, cached scene, {row['threads']} threads"
    return [
        _at_least(f"steps per second, {where}", speed, STEPS_PER_SECOND),
        _at_most(f"time over that of the fused kernel, {where}", times, TIMES_KERNEL),
    ]


def _growth(meta: dict[str, Any]) -> list[Target]:
    found = []
    for series in meta["growth"]:
        for quantity, fit in series["exponents"].items():
            if series["against"] != "pixels" or fit is None:
                continue
            exponent, error = fit
            what = "memory" if quantity == "mib" else "time"
            name = f"exponent of {what} against pixels, {series['name']}"
            met = exponent <= _LINEAR and exponent - 2.0 * error <= 1.0
            found.append(Target(name, exponent, 1.0, at_least=False, met=met))
    for row in meta["marginal"]:
        what = (
            f"one more state over its scale, noise and clip, {row['height']} x {row['width']}, "
            f"{row['noise']} noise"
        )
        found.append(_at_most(what, row["ratio"], MARGINAL))
    return found


def _full_frame(meta: dict[str, Any]) -> list[Target]:
    found = []
    for row in meta["full_frame"]:
        where = f"{row['case']}, {row['megapixels']:.1f} megapixels ({row['file']})"
        found.append(_at_most(f"peak memory [MiB], {where}", row["peak_mib"], FULL_FRAME_MIB))
        if not row["networks"]:
            limit = row["limits"]["unpack"] + row["limits"]["write"]
            what = f"time over LibRaw's unpacking and writing, {where}"
            found.append(_at_most(what, row["seconds"] / limit, TIMES_LIBRAW))
            first = row["first"] / row["limits"]["first"]
            found.append(_at_most(f"{what}, a process' first frame", first, TIMES_LIBRAW))
    return found
