"""The encoding of observations, and its inverse: light, settings and sensors.

The raw is companded to eight bits with a square root, which gives every signal level about the
same number of codes per standard deviation of photon noise.
"""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING

import numpy as np

from simulator.capture.limits import PEDESTAL as PEDESTAL
from simulator.utils.compute import kernel

if TYPE_CHECKING:
    import torch

    from simulator.camera import CameraProfile

#: Fixed ranges of Av, Tv and Sv that map to [-1, 1].
SETTINGS_RANGES = np.array([[0.0, 10.0], [-5.0, 15.0], [4.0, 17.0]])
#: Fixed ranges of log2 image speed [frame heights/s] and log2 defocus [pixel of a 64-pixel frame].
SENSOR_RANGES = np.array([[-9.0, 3.0], [-4.0, 4.0]])
#: Relative standard deviation of both sensors.
SENSOR_NOISE = 0.15
#: Zones of the statistics, rows and columns, and bins of their histogram.
ZONES, HISTOGRAM_BINS = (12, 16), 128
_LOG2_NOISE = SENSOR_NOISE / math.log(2.0)
_TINY = sys.float_info.min


def encode_observation(signal: torch.Tensor, out: torch.Tensor | None = None) -> torch.Tensor:
    """8-bit codes ``round(255 sqrt((x + p) / (1 + p)))`` of a signal whose white is 1.

    x is clipped to [-p, 1], p = 1/1024; `out` is uint8 to write to, instead of a new tensor.
    """
    codes = signal.clamp(-PEDESTAL, 1.0).add_(PEDESTAL).div_(1.0 + PEDESTAL)
    codes = codes.sqrt_().mul_(255.0).round_()
    return codes.byte() if out is None else out.copy_(codes)


def encode_array(signal: np.ndarray) -> np.ndarray:
    """`encode_observation` of an array, without torch: its threads do not survive a fork."""
    light = np.clip(signal, -PEDESTAL, 1.0) + PEDESTAL
    return np.rint(255.0 * np.sqrt(light / (1.0 + PEDESTAL))).astype(np.uint8)


def frame_statistics(codes: np.ndarray) -> dict[str, np.ndarray]:
    """What an image processor hands to its auto exposure, from 8-bit codes (N, 4, R, R) of frames.

    ``raw`` (N, 4, 12, 16) uint8: codes of the mean signal of each zone of each plane, in 12 rows
    and 16 columns; ``histogram`` (N, 128) float32: shares of all samples by code, two codes a bin;
    ``clipped`` (N, 2) float32: shares at white and black, first and last code.
    """
    height, width = codes.shape[-2:]
    rows, columns = (
        np.arange(zones) * size // zones for size, zones in zip((height, width), ZONES, strict=True)
    )
    sums = np.add.reduceat(decode_observation(codes), rows, axis=-2)
    sums = np.add.reduceat(sums, columns, axis=-1)
    area = np.diff(rows, append=height)[:, None] * np.diff(columns, append=width)
    flat = codes.reshape(len(codes), -1)
    counts = np.stack([np.bincount(frame, minlength=256) for frame in flat])
    shares = (counts / flat.shape[1]).astype(np.float32)
    return {
        "raw": encode_array(np.clip(sums / area, 0.0, 1.0)),
        "histogram": shares.reshape(len(codes), HISTOGRAM_BINS, -1).sum(axis=2),
        "clipped": np.ascontiguousarray(shares[:, [255, 0]]),
    }


def tensor_statistics(codes: torch.Tensor) -> dict[str, torch.Tensor]:
    """`frame_statistics` of codes on any device; means are off by rounding."""
    import torch

    lights = decode_observation(np.arange(256, dtype=np.uint8))
    means = torch.from_numpy(lights).to(codes.device)[codes.long()].double()  # products: no TF32
    for size, zones in zip(codes.shape[:1:-1], ZONES[::-1], strict=True):  # columns, then rows
        inside = np.repeat(np.eye(zones), np.diff(np.arange(zones + 1) * size // zones), axis=1)
        shares = inside / inside.sum(axis=1, keepdims=True)
        means = (means @ torch.from_numpy(shares.T).to(means)).mT
    flat = codes.flatten(1).long()
    counts = flat.new_zeros(len(flat), 256).scatter_add_(1, flat, torch.ones_like(flat))
    shares = counts.float() / flat.shape[1]
    found = {"raw": encode_observation(means.clip(0.0, 1.0)), "clipped": shares[:, [255, 0]]}
    return found | {"histogram": shares.view(len(flat), HISTOGRAM_BINS, -1).sum(dim=2)}


def decode_observation(raw: np.ndarray) -> np.ndarray:
    """Signal of the codes `raw`, float32 in [-1/1024, 1]: the inverse of `encode_observation`.

    >>> decode_observation(np.array([0, 255], np.uint8)).tolist()
    [-0.0009765625, 1.0]
    """
    table = (1.0 + PEDESTAL) * (np.arange(256) / 255.0) ** 2 - PEDESTAL
    return np.asarray(table.astype(np.float32)[raw])


def linear_signal(
    raw: np.ndarray, camera: CameraProfile, planes: slice = slice(None)
) -> np.ndarray:
    """Signal of observed frames, white is 1; of the `planes` among R, G1, G2, B.

    `raw` (N, 4, h, w) is of any kind: uint8 codes, float32 signal, or the camera's uint16 numbers.
    """
    chosen = raw[:, planes]
    if chosen.dtype == np.uint8:
        return decode_observation(chosen)
    if np.issubdtype(chosen.dtype, np.floating):
        return chosen.astype(np.float32)
    black, span = (np.array(v)[planes, None, None] for v in (camera.black_level, camera.span))
    return np.asarray(((chosen - black) / span).astype(np.float32))


def _from_unit(values: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    low, high = ranges.T
    return np.asarray(low + (np.asarray(values, np.float64) + 1.0) * 0.5 * (high - low))


def encode_settings(apex: np.ndarray) -> np.ndarray:
    """Av, Tv and Sv (..., 3) as float32 in [-1, 1]."""
    low, high = SETTINGS_RANGES.T
    return np.clip(2.0 * (apex - low) / (high - low) - 1.0, -1.0, 1.0).astype(np.float32)


def decode_settings(settings: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Av, Tv and Sv of `settings` (..., 3). The frame's EV100 is ``Av + Tv - (Sv - 5)``."""
    apex = _from_unit(settings, SETTINGS_RANGES)
    return apex[..., 0], apex[..., 1], apex[..., 2]


def encode_sensors(speed: np.ndarray, defocus: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Readings (N, 2) float32 in [-1, 1] of the gyro and the focus drive; no motion reads -1.

    `speed` (N,) is the image's [frame heights/s], `defocus` (N,) the blur diameter at f/4 [pixel of
    a 64-pixel frame], > 0; readings are off by 15 % times the standard normals `noise` (N, 2).
    """
    # A kernel, because a dozen NumPy calls for two numbers are 8 % of the time of a step.
    out = np.empty((len(speed), 2), np.float32)
    _read_sensors(speed, defocus, noise, out)
    return out


@kernel()
def _read_sensors(speed, defocus, noise, out):  # type: ignore[no-untyped-def]
    for i in range(len(out)):
        for j, value in enumerate((speed[i], defocus[i])):
            low, high = SENSOR_RANGES[j]
            reading = np.log2(max(value, _TINY)) + _LOG2_NOISE * noise[i, j]
            out[i, j] = min(max(2.0 * (reading - low) / (high - low) - 1.0, -1.0), 1.0)


def decode_sensors(sensors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Speed [frame heights/s] and defocus [pixel of a 64-pixel frame] of `sensors` (..., 2).

    A speed at the lower end of the range is returned as 0.
    """
    values = 2.0 ** _from_unit(sensors, SENSOR_RANGES)
    return np.where(np.asarray(sensors)[..., 0] <= -1.0, 0.0, values[..., 0]), values[..., 1]
