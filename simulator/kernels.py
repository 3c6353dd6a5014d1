"""Captures on the CPU, fused: from light to what the camera records in one pass over the samples.

The steps are those of `simulator.capture`, which stays the reference and the path on other devices:
multiply by the exposure ratio, add noise of the variance that is missing, round to digital numbers
and clip. They run in blocks of 256 samples that stay in the first-level cache, vectorised by the
compiler, on as many threads as `simulator.threads` allows.

This module imports numba.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numba
import numpy as np
import torch

from simulator.camera import CameraProfile, NoiseLevelFunction
from simulator.exposure import SIGNAL_LIMIT, Exposure
from simulator.jit import kernel
from simulator.noise_bank import BANK_SIZE, BLOCK, STRIDE, noise_bank
from simulator.pointers import addresses, as_pointer
from simulator.threads import in_shares

#: Most negative signal that a companded code shows; the offset under its square root.
PEDESTAL = 1.0 / 1024.0
#: A sample at or below this signal counts as clipped low: ten stops below white.
LOW_CLIP = 2.0**-10
#: A sample at or above this signal counts as clipped high.
HIGH_CLIP = 1.0 - 1e-6
#: Samples of a plane that one thread works on at a time, and at least, in units of blocks.
_UNIT_BLOCKS = 256
_WORTH_A_THREAD = 4 * 64 * 64 * 4
_FAST = {"nnan", "nsz", "contract"}
_ZERO, _HALF, _ONE, _CODES = np.float32(0), np.float32(0.5), np.float32(1), np.float32(255)
_STEP = np.uint64(0x9E3779B97F4A7C15)
_MIX_1, _MIX_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
#: How the noise is drawn: not at all, from the bank, or given.
_OFF, _BANK, _GIVEN = 0, 1, 2
_LARGEST = float(np.finfo(np.float32).max)
_START_BITS = np.uint64(BANK_SIZE // STRIDE - 1)


@functools.lru_cache(maxsize=64)
def sensor_table(camera: CameraProfile) -> np.ndarray:
    """What `camera` does to a signal: (5, 4) float32, columns are the planes R, G1, G2, B.

    The rows: digital numbers from black to white, digital number of black, largest one that counts
    as clipped low, smallest one that counts as clipped high, largest one.
    """
    span, black = (np.array(v, np.float32)[:, None] for v in (camera.span, camera.black_level))
    numbers = np.arange(int(camera.white_level) + 1, dtype=np.float32)
    signals = (numbers - black) / span  # (4, W)
    low = (signals <= LOW_CLIP).sum(axis=1) - 1
    high = len(numbers) - (signals >= HIGH_CLIP).sum(axis=1)
    white = np.full(4, camera.white_level)
    table = np.stack([span[:, 0], black[:, 0], low, high, white]).astype(np.float32)
    table.flags.writeable = False
    return table


def exposure_table(exposures: Sequence[Exposure]) -> np.ndarray:
    """What exposures do to light: (B, 5, 4) float32, columns are the planes R, G1, G2, B.

    The rows: exposure ratio; shot and read noise that is missing to the target's (negative where
    the source has more); shot and read noise of the source.
    """
    table = np.zeros((len(exposures), 5, 4))
    for row, exposure in zip(table, exposures, strict=True):
        row[0] = exposure.ratio
        row[1:3] = _noise_rows(exposure.target)
        if not exposure.source.is_zero:
            row[3:] = _noise_rows(exposure.source_noise)
            row[1:3] -= row[3:]
    return table.astype(np.float32)


@functools.lru_cache(maxsize=4096)
def _noise_rows(nlf: NoiseLevelFunction) -> np.ndarray:
    return np.array([nlf.shot, nlf.read])


_jit = functools.partial(kernel, fastmath=_FAST, boundscheck=False)


@_jit()
def _expose(light, ratio, bound, out):  # type: ignore[no-untyped-def]
    """Signals, limited before the product so that it cannot overflow."""
    for j in range(len(out)):
        x = light[j]
        x = x if x < bound else bound
        out[j] = (x if x > -bound else -bound) * ratio


@_jit()
def _add_noise(signal, normals, sign, shot, read):  # type: ignore[no-untyped-def]
    for j in range(len(signal)):
        x = signal[j]
        variance = (x if x > _ZERO else _ZERO) * shot + read
        variance = variance if variance > _ZERO else _ZERO
        signal[j] = x + sign * np.sqrt(variance) * normals[j]


@_jit()
def _add_noise_after_blur(  # type: ignore[no-untyped-def]
    signal, normals, sign, shot, read, source_shot, source_read, remaining
):
    for j in range(len(signal)):
        x = signal[j]
        light = x if x > _ZERO else _ZERO
        variance = light * shot + read
        variance += (_ONE - remaining[j]) * (light * source_shot + source_read)
        variance = variance if variance > _ZERO else _ZERO
        signal[j] = x + sign * np.sqrt(variance) * normals[j]


@_jit()
def _quantise(signal, span, black, white):  # type: ignore[no-untyped-def]
    for j in range(len(signal)):
        x = np.rint(signal[j] * span + black)
        x = x if x > _ZERO else _ZERO
        signal[j] = x if x < white else white


@_jit()
def _count(numbers, low, high):  # type: ignore[no-untyped-def]
    below, above = np.int32(0), np.int32(0)
    for j in range(len(numbers)):
        below += np.int32(1) if numbers[j] <= low else np.int32(0)
        above += np.int32(1) if numbers[j] >= high else np.int32(0)
    return below, above


@_jit()
def _compand(numbers, darkest, scale, out):  # type: ignore[no-untyped-def]
    """Codes ``round(255 sqrt((x + p) / (1 + p)))`` of digital numbers."""
    for j in range(len(out)):
        x = numbers[j] - darkest
        out[j] = np.uint8(np.int32(np.sqrt(x if x > _ZERO else _ZERO) * scale + _HALF))


@_jit()
def _as_integers(numbers, out):  # type: ignore[no-untyped-def]
    for j in range(len(out)):
        out[j] = np.uint16(np.int32(numbers[j]))


@_jit()
def _as_signals(numbers, black, span, out):  # type: ignore[no-untyped-def]
    for j in range(len(out)):
        out[j] = (numbers[j] - black) / span


@_jit()
def _in_bank(key, block):  # type: ignore[no-untyped-def]
    """Where in the bank a block of a frame starts, and its sign; see `simulator.noise_bank`."""
    word = key + _STEP * np.uint64(block + 1)
    word = (word ^ (word >> np.uint64(30))) * _MIX_1
    word = (word ^ (word >> np.uint64(27))) * _MIX_2
    word = word ^ (word >> np.uint64(31))
    return np.int64(word & _START_BITS) * STRIDE, -_ONE if word >> np.uint64(63) else _ONE


@_jit()
def _record(  # type: ignore[no-untyped-def]
    first,
    last,
    samples,
    light,
    remaining,
    exposure,
    keys,
    drawn,
    bank,
    sensor,
    bound,
    codes,
    numbers,
    signals,
    counts,
):
    """Units `first` to `last` of a batch: pieces of the planes of frames, in this order."""
    buffer = np.empty(BLOCK, np.float32)
    blocks = (samples + BLOCK - 1) // BLOCK
    pieces = (blocks + _UNIT_BLOCKS - 1) // _UNIT_BLOCKS
    for unit in range(first, last):
        frame, plane, piece = unit // (4 * pieces), (unit // pieces) % 4, unit % pieces
        ratio, most = exposure[frame, 0, 0], bound[frame]
        shot, read = exposure[frame, 1, plane], exposure[frame, 2, plane]
        source_shot, source_read = exposure[frame, 3, plane], exposure[frame, 4, plane]
        span, black = sensor[0, plane], sensor[1, plane]
        low, high, white = sensor[2, plane], sensor[3, plane], sensor[4, plane]
        darkest = black - np.float32(PEDESTAL) * span
        scale = _CODES / np.sqrt(span * np.float32(1.0 + PEDESTAL))
        plane_light = numba.carray(as_pointer(light[frame]), (4 * samples,))  # type: ignore[call-arg]
        share = numba.carray(as_pointer(remaining[frame]), (samples,))  # type: ignore[call-arg]
        below, above = 0, 0
        for block in range(piece * _UNIT_BLOCKS, min((piece + 1) * _UNIT_BLOCKS, blocks)):
            start = block * BLOCK
            end = min(start + BLOCK, samples)
            at = plane * samples + start
            part = buffer[: end - start]
            _expose(plane_light[at : at + len(part)], ratio, most, part)
            if drawn != _OFF:
                place, sign = np.int64(keys[frame]) * 4 * samples + at, _ONE
                if drawn == _BANK:
                    place, sign = _in_bank(keys[frame], plane * blocks + block)
                normals = bank[place : place + len(part)]
                if remaining[frame] == 0:
                    _add_noise(part, normals, sign, shot, read)
                else:
                    _add_noise_after_blur(
                        part, normals, sign, shot, read, source_shot, source_read, share[start:end]
                    )
            _quantise(part, span, black, white)
            lower, higher = _count(part, low, high)
            below += lower
            above += higher
            if codes.size:
                _compand(part, darkest, scale, codes[frame, plane, start:end])
            if numbers.size:
                _as_integers(part, numbers[frame, plane, start:end])
            if signals.size:
                _as_signals(part, black, span, signals[frame, plane, start:end])
        counts[unit, 0] = below
        counts[unit, 1] = above


def record_frames(
    light: np.ndarray,
    samples: int,
    exposure: np.ndarray,
    camera: CameraProfile,
    *,
    keys: np.ndarray | None = None,
    normals: np.ndarray | None = None,
    remaining: np.ndarray | None = None,
    codes: np.ndarray | None = None,
    numbers: np.ndarray | None = None,
    signals: np.ndarray | None = None,
    threads: int | None = None,
) -> np.ndarray:
    """Records a batch of frames; every output that is given is filled.

    Args:
        light: (B,) uintp `addresses` of each frame's light, 4 planes of `samples`
            contiguous float32. The caller keeps that memory alive.
        samples: Pixels of a plane.
        exposure: (B, 5, 4) float32, see `exposure_table`.
        camera: The body.
        keys: (B,) uint64 of the noise from the bank, see `noise_keys`.
        normals: (B, 4 * samples) float32 standard normals to use instead. Without either there is
            no noise.
        remaining: (B,) uintp addresses of the share of the source's variance that a blur has left,
            `samples` float32; 0 for all of it.
        codes: (B, 4, samples) uint8, companded (`ae_env.observation`).
        numbers: (B, 4, samples) uint16, digital numbers.
        signals: (B, 4, samples) float32, on the scale where white is 1.
        threads: At most so many; those of torch by default.

    Returns:
        (B, 2) int64: samples of each frame that are clipped low, and high.
    """
    count = len(light)
    with np.errstate(divide="ignore"):  # no light at all: any bound will do
        bound = np.minimum(SIGNAL_LIMIT / exposure[:, 0, 0].astype(np.float64), _LARGEST)
    blocks = -(-samples // BLOCK)
    pieces = -(-blocks // _UNIT_BLOCKS)
    counts = np.empty((count * 4 * pieces, 2), np.int64)
    if normals is not None:
        keys = np.arange(count, dtype=np.uint64)
    drawn = _OFF if keys is None else _BANK if normals is None else _GIVEN
    fixed = (
        samples,
        np.ascontiguousarray(light, np.uintp),
        np.zeros(count, np.uintp) if remaining is None else remaining,
        exposure,
        np.zeros(count, np.uint64) if keys is None else keys,
        drawn,
        noise_bank() if normals is None else normals.reshape(-1),
        sensor_table(camera),
        bound.astype(np.float32),
        np.empty((0, 4, 0), np.uint8) if codes is None else codes,
        np.empty((0, 4, 0), np.uint16) if numbers is None else numbers,
        np.empty((0, 4, 0), np.float32) if signals is None else signals,
        counts,
    )
    least = max(1, _WORTH_A_THREAD // min(samples, _UNIT_BLOCKS * BLOCK))
    in_shares(
        lambda first, last: _record(first, last, *fixed), len(counts), least=least, threads=threads
    )
    return counts.reshape(count, -1, 2).sum(axis=1)


def record_capture(
    light: torch.Tensor,
    exposure: Exposure,
    camera: CameraProfile,
    *,
    key: int | None = None,
    normals: torch.Tensor | None = None,
    out: torch.Tensor | None = None,
    threads: int | None = None,
) -> torch.Tensor:
    """One capture of `light`: exposed, noisy, clipped and quantised, blurred by the caller.

    Args:
        light: (4, H, W) float32 on the CPU, at the exposure of the latent.
        exposure: What happens to it; its blur is not applied here.
        camera: The body.
        key: Key of the noise from the bank (`noise_keys`).
        normals: (4, H, W) standard normals to use instead; without either there is no noise.
        out: (4, H, W) contiguous float32 to write into.
        threads: At most so many; those of torch by default.

    Returns:
        (4, H, W) float32 in [-pedestal, 1].
    """
    light = light.contiguous()
    signals = torch.empty(light.shape) if out is None else out
    remaining = exposure.remaining
    if remaining is not None:
        remaining = remaining.float().contiguous()
    record_frames(
        addresses([light]),
        light[0].numel(),
        exposure_table([exposure]),
        camera,
        keys=None if key is None else np.array([key], np.uint64),
        normals=None if normals is None else normals.reshape(1, -1).numpy(),
        remaining=addresses([remaining]),
        signals=signals.numpy().reshape(1, 4, -1),
        threads=threads,
    )
    return signals
