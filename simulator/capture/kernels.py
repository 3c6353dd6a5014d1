"""Captures on the CPU, fused: from light to what the camera records in one pass over the samples.

The steps are those of `simulator.capture.sensor`, which stays the reference and the path on other
devices: multiply by the exposure ratio, add noise of the variance that is missing, round to digital
numbers and clip. They run in blocks of 256 samples that stay in the first-level cache, vectorised
by the compiler, on as many threads as `simulator.utils.compute` allows.

This module imports numba.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numba
import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.capture.exposure import PEDESTAL, SIGNAL_LIMIT
from simulator.noise.generator import (
    BANK_SIZE,
    BLOCK,
    KEY_STEP,
    STRIDE,
    Noise,
    draw_block,
    mixed_word,
    noise_bank,
)
from simulator.utils.compute import addresses, as_pointer, kernel, parallel_ranges

#: A sample at or below this signal counts as clipped low: ten stops below white.
LOW_CLIP = 2.0**-10
#: A sample at or above this signal counts as clipped high.
HIGH_CLIP = 1.0 - 1e-6
#: Samples of a plane that one thread works on at a time, and at least, in units of blocks.
_UNIT_BLOCKS = 256
_WORTH_A_THREAD = 4 * 64 * 64 * 4
_FAST = {"nnan", "nsz", "contract"}
_ZERO, _HALF, _ONE, _CODES = np.float32(0), np.float32(0.5), np.float32(1), np.float32(255)
#: Bit from which samples clipped high are counted: no unit has as many that are clipped low.
_HIGH_BITS = 16
_NEITHER, _LOW, _HIGH = np.int32(0), np.int32(1), np.int32(1 << _HIGH_BITS)
#: How the noise is made: not at all, from the bank, or drawn.
_OFF, _BANK, _DRAWN = 0, 1, 2
_NO_BANK = np.empty(0, np.float32)
_NO_BANK.flags.writeable = False  # of the bank's type
_LIMIT, _LARGEST = np.float32(SIGNAL_LIMIT), np.finfo(np.float32).max
_START_BITS = np.uint64(BANK_SIZE // STRIDE - 1)


@functools.lru_cache(maxsize=64)
def sensor_table(camera: CameraProfile) -> np.ndarray:
    """How `camera` digitises a signal: (5, 4) float32, columns are the planes R, G1, G2, B.

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


_jit = functools.partial(kernel, fastmath=_FAST, boundscheck=False)


@_jit()
def _exposed(x, ratio, bound):  # type: ignore[no-untyped-def]
    """Signal of a light, limited before the product so that it cannot overflow."""
    x = x if x < bound else bound
    return (x if x > -bound else -bound) * ratio


@_jit()
def _noisy(x, normal, variance):  # type: ignore[no-untyped-def]
    return x + normal * np.sqrt(variance if variance > _ZERO else _ZERO)


@_jit()
def _rounded(x, span, black, white):  # type: ignore[no-untyped-def]
    """Digital number of a signal."""
    x = np.rint(x * span + black)
    x = x if x > _ZERO else _ZERO
    return x if x < white else white


@_jit()
def _digitise(size, light, bound, ratio, sensor, out):  # type: ignore[no-untyped-def]
    """Digital numbers of light, without noise; `sensor` is of `sensor_table`."""
    span, black, white = sensor
    for j in range(size):
        out[j] = _rounded(_exposed(light[j], ratio, bound), span, black, white)


@_jit()
def _digitise_noisy(  # type: ignore[no-untyped-def]
    size, light, normals, sign, bound, ratio, shot, read, sensor, out
):
    """The same with noise of the variance that is missing (`simulator.noise.top_up`)."""
    span, black, white = sensor
    for j in range(size):
        x = _exposed(light[j], ratio, bound)
        variance = (x if x > _ZERO else _ZERO) * shot + read
        out[j] = _rounded(_noisy(x, sign * normals[j], variance), span, black, white)


@_jit()
def _digitise_averaged(  # type: ignore[no-untyped-def]
    size, light, normals, sign, shares, bound, ratio, noise, sensor, out
):
    """The same where a blur has left only a share of the source's variance."""
    (shot, read, source_shot, source_read), (span, black, white) = noise, sensor
    for j in range(size):
        x = _exposed(light[j], ratio, bound)
        bright = x if x > _ZERO else _ZERO
        variance = bright * shot + read
        variance += (_ONE - shares[j]) * (bright * source_shot + source_read)
        out[j] = _rounded(_noisy(x, sign * normals[j], variance), span, black, white)


@_jit()
def _count(numbers, low, high, counts):  # type: ignore[no-untyped-def]
    """Counts clipped samples by their index in the block: low ones as 1, high ones as 2^16.

    A sum over the block would cost more than all comparisons.
    """
    for j in range(len(numbers)):
        counts[j] += _clips(numbers[j], low, high)


@_jit()
def _clips(number, low, high):  # type: ignore[no-untyped-def]
    return (_LOW if number <= low else _NEITHER) + (_HIGH if number >= high else _NEITHER)


@_jit()
def _compand(numbers, darkest, scale, low, high, counts, out):  # type: ignore[no-untyped-def]
    """Codes ``round(255 sqrt((x + p) / (1 + p)))`` of digital numbers, which are counted, too."""
    for j in range(len(out)):
        x = numbers[j] - darkest
        out[j] = np.uint8(np.int32(np.sqrt(x if x > _ZERO else _ZERO) * scale + _HALF))
        counts[j] += _clips(numbers[j], low, high)


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
    """Where in the bank a block of a frame starts, and its sign (`simulator.noise.generator`)."""
    word = mixed_word(key + KEY_STEP * np.uint64(block + 1))
    return np.int64(word & _START_BITS) * STRIDE, -_ONE if word >> np.uint64(63) else _ONE


@_jit()
def _record(  # type: ignore[no-untyped-def]
    first,
    last,
    samples,
    light,
    remaining_variance,
    exposure,
    keys,
    drawn,
    bank,
    sensor,
    codes,
    numbers,
    signals,
    counts,
):
    """Units `first` to `last` of a batch: pieces of the planes of frames, in this order."""
    part, made = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    words, clipped = np.empty((4, BLOCK // 4), np.uint32), np.empty(BLOCK, np.int32)
    blocks = (samples + BLOCK - 1) // BLOCK
    pieces = (blocks + _UNIT_BLOCKS - 1) // _UNIT_BLOCKS
    for unit in range(first, last):
        frame, plane, piece = unit // (4 * pieces), (unit // pieces) % 4, unit % pieces
        ratio, shot, read, source_shot, source_read = exposure[frame, :, plane]
        span, black, low, high, white = sensor[:, plane]
        body = span, black, white
        # A light beyond it is white; one of an exposure of 0 has no bound.
        bound = min(_LIMIT / ratio, _LARGEST)
        darkest = black - np.float32(PEDESTAL) * span
        scale = _CODES / np.sqrt(span * np.float32(1.0 + PEDESTAL))
        pointer = as_pointer(light[frame])  # type: ignore[call-arg, var-annotated]
        frame_light = numba.carray(pointer, (4 * samples,))
        shares = samples if remaining_variance[frame] else 0
        share = numba.carray(as_pointer(remaining_variance[frame]), (shares,))
        clipped[:] = 0
        for block in range(piece * _UNIT_BLOCKS, min((piece + 1) * _UNIT_BLOCKS, blocks)):
            start = block * BLOCK
            end = min(start + BLOCK, samples)
            size, at, number = end - start, plane * samples + start, plane * blocks + block
            exposed, normals, sign = frame_light[at : at + size], made, _ONE
            if drawn == _BANK:
                offset, sign = _in_bank(keys[frame], number)
                normals = bank[offset : offset + BLOCK]
            elif drawn == _DRAWN:
                draw_block(keys[frame], number, words, made)
            if drawn == _OFF:
                _digitise(size, exposed, bound, ratio, body, part)
            elif shares:
                noise, left = (shot, read, source_shot, source_read), share[start:end]
                _digitise_averaged(
                    size, exposed, normals, sign, left, bound, ratio, noise, body, part
                )
            else:
                _digitise_noisy(size, exposed, normals, sign, bound, ratio, shot, read, body, part)
            out = part[:size]
            if codes.size:
                _compand(out, darkest, scale, low, high, clipped, codes[frame, plane, start:end])
            elif counts.size:
                _count(out, low, high, clipped)
            if numbers.size:
                _as_integers(out, numbers[frame, plane, start:end])
            if signals.size:
                _as_signals(out, black, span, signals[frame, plane, start:end])
        if counts.size:
            counts[unit, 0] = (clipped & (_HIGH - 1)).sum()
            counts[unit, 1] = (clipped >> _HIGH_BITS).sum()


def record_frames(
    light: Sequence[torch.Tensor],
    table: np.ndarray,
    camera: CameraProfile,
    *,
    keys: np.ndarray | None = None,
    noise: Noise = "bank",
    remaining_variance: Sequence[torch.Tensor | None] | None = None,
    codes: np.ndarray | None = None,
    numbers: np.ndarray | None = None,
    signals: np.ndarray | None = None,
    count: bool = True,
    threads: int | None = None,
) -> np.ndarray:
    """`simulator.capture.sensor.record` on the CPU; every output that is given is filled.

    Args:
        light: (4, H, W) each, contiguous float32; B of them.
        table: (B, 5, 4) float32 of `simulator.capture.exposure.exposure_table`.
        camera: The body.
        keys: (B,) uint64 of the noise, see `noise_keys`; None for no noise.
        noise: How the keys become noise.
        remaining_variance: (H, W) contiguous float32 each, share of the source's variance that a
            blur has left, or None for all of it.
        codes: (B, 4, H, W) uint8, ``round(255 sqrt((x + p) / (1 + p)))`` with p = `PEDESTAL`.
        numbers: (B, 4, H, W) uint16, digital numbers.
        signals: (B, 4, H, W) float32, on the scale where white is 1.
        count: Whether to count clipped samples.
        threads: At most so many; those of torch by default.

    Returns:
        (B, 2) int64: samples of each frame that are clipped low, and high; 0 without `count`.
    """
    frames, samples = len(light), light[0].numel() // 4
    blocks = -(-samples // BLOCK)
    pieces = -(-blocks // _UNIT_BLOCKS)
    units = frames * 4 * pieces
    counts = np.empty((units if count else 0, 2), np.int64)
    drawn = _OFF if keys is None else _BANK if noise == "bank" else _DRAWN
    empty, flat = (0, 4, 0), (frames, 4, samples)
    fixed = (
        samples,
        addresses(light),
        np.zeros(frames, np.uintp) if remaining_variance is None else addresses(remaining_variance),
        table,
        np.zeros(frames, np.uint64) if keys is None else keys,
        drawn,
        noise_bank() if drawn == _BANK else _NO_BANK,
        sensor_table(camera),
        np.empty(empty, np.uint8) if codes is None else codes.reshape(flat),
        np.empty(empty, np.uint16) if numbers is None else numbers.reshape(flat),
        np.empty(empty, np.float32) if signals is None else signals.reshape(flat),
        counts,
    )
    least = max(1, _WORTH_A_THREAD // min(samples, _UNIT_BLOCKS * BLOCK))
    parallel_ranges(
        lambda first, last: _record(first, last, *fixed), units, least=least, threads=threads
    )
    return counts.reshape(frames, 4 * pieces if count else 0, 2).sum(axis=1)
