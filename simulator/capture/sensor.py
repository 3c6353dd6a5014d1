"""The sensor: from linear light to the numbers that the camera records.

The order is physical, and it matters: exposed light, not clipped -> motion and defocus blur of
that unclipped light -> the light of each row, where it flickers -> noise of that signal -> clip ->
quantise, each of the last two once. (Exposure and blur are linear and change places here: one blur
then serves many exposures.)

`record` is the one way from light to frames: sweeps, the full run and the environment all take it.
On the CPU it is one fused kernel, which works in blocks of 256 samples that stay in the first-level
cache, vectorised by the compiler, on as many threads as `simulator.utils.compute` allows.
Elsewhere, and where the read noise has rows and tails, the steps run one by one.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numba
import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.capture.exposure import PEDESTAL, SIGNAL_LIMIT, Exposure, exposure_table
from simulator.noise.generator import (
    BANK_SIZE,
    BLOCK,
    KEY_STEP,
    STRIDE,
    Noise,
    draw_block,
    frame_normals,
    mixed_word,
    noise_bank,
    noise_keys,
)
from simulator.noise.noise_level_function import (
    VARIANCE_LIMIT,
    ReadNoise,
    missing_variance,
    plane_tensor,
    top_up_table,
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
_TINY = torch.finfo(torch.float32).tiny
#: Samples whose noise is balanced at a time: they stay in the cache, and on one thread.
_BALANCED = 2**15
_jit = functools.partial(kernel, fastmath=_FAST, boundscheck=False)


# -- a batch of frames ------------------------------------------------------------------------


@dataclass
class Transitions:
    """All that B frames depend on, except for their noise.

    Args:
        light: (4, H, W) each, contiguous float32: blurred already, at the exposure of its
            prepared scene. Several may be the same.
        table: (B, 5, 4) of `simulator.capture.exposure.exposure_table`.
        remaining_variance: `Exposure.remaining_variance` of each, contiguous float32; None for
            all of the variance. None in place of the sequence where no frame has any.
    """

    light: Sequence[torch.Tensor]
    table: np.ndarray
    remaining_variance: Sequence[torch.Tensor | None] | None = None

    @classmethod
    def of(cls, lights: Sequence[torch.Tensor], exposures: Sequence[Exposure]) -> Transitions:
        """Those of lights that are blurred already."""
        shares = [e.remaining_variance for e in exposures]
        return cls(
            [light.contiguous() for light in lights],
            exposure_table(exposures),
            [None if share is None else share.float().contiguous() for share in shares],
        )

    def in_bands(self, row_gain: np.ndarray) -> Transitions:
        """The same where rows have light of their own: the bands of flickering light.

        The light of each row multiplies the blurred light before there is noise, so that the noise
        is that of the banded signal: exact for motion along the rows; other motion blurs across
        rows that do not share their light. The source's own noise is multiplied with
        its light: its variance by the square of the row's gain, r^2. What the top-up takes away for
        it has the variance times r: exact for shot noise, whose variance is worked out from the
        banded signal, and off by r (1 - r) of the source's read noise.

        Args:
            row_gain: (B, H) light of each row relative to the frame's.
        """
        lights, width = list(self.light), self.light[0].shape[-1]
        shares = self.shares()
        noisy = self.table[:, 3:].max(axis=(1, 2)) > 0.0  # the source is
        for i in np.flatnonzero(row_gain.max(axis=1) > row_gain.min(axis=1)).tolist():
            gain = torch.from_numpy(row_gain[i]).float()[:, None].to(lights[i].device)
            lights[i] = (lights[i] * gain).contiguous()
            if noisy[i]:
                share, known = gain.expand(-1, width), shares[i]
                shares[i] = (share if known is None else share * known).contiguous()
        return Transitions(lights, self.table, shares)

    def before_rounding(self, camera: CameraProfile) -> Transitions:
        """The same without the variance that rounding to whole digital numbers will add, 1/12.

        It is part of the calibrated read noise: the rest of that is what has to be drawn.
        """
        table = self.table.copy()
        table[:, 2] -= 1.0 / (12.0 * np.square(np.array(camera.span, np.float32)))
        return replace(self, table=table)

    def averaged_table(self) -> np.ndarray:
        """`table` in which each source's noise is what its blur leaves in the mean."""
        if self.remaining_variance is None:
            return self.table
        left = [1.0 if share is None else float(share.mean()) for share in self.shares()]
        remaining, table = np.array(left, np.float32)[:, None, None], self.table.copy()
        table[:, 1:3] += (1.0 - remaining) * table[:, 3:]
        table[:, 3:] *= remaining
        return table

    def shares(self) -> list[torch.Tensor | None]:
        """`remaining_variance` as a list, one entry for each frame."""
        known = self.remaining_variance
        return [None] * len(self.light) if known is None else list(known)

    @property
    def lacks_noise(self) -> bool:
        """Whether any signal could have less noise than its target; else none need be drawn."""
        if (self.table[:, 1:3] > 0.0).any():
            return True
        return any(share is not None for share in self.shares())


def record(
    transitions: Transitions,
    camera: CameraProfile,
    *,
    keys: np.ndarray | None = None,
    noise: Noise = "exact",
    read_noise: Sequence[ReadNoise] | None = None,
    row_gain: np.ndarray | None = None,
    signals: torch.Tensor | None = None,
    codes: np.ndarray | None = None,
    numbers: np.ndarray | None = None,
    count: bool = False,
) -> np.ndarray:
    """Records a batch of frames: exposes, adds noise, clips and quantises.

    Every output that is given is filled; `codes`, `numbers` and `count` on the CPU only.

    Args:
        transitions: Light and exposures.
        camera: The body.
        keys: (B,) uint64 of the noise; None for none.
        noise: How the keys become noise.
        read_noise: Rows and tails of each frame's read noise, for the noise ``"sensor"``.
        row_gain: See `Transitions.in_bands`; None where all rows have the frame's light.
        signals: (B, 4, H, W) contiguous float32 in [-pedestal, 1], where white is 1.
        codes: (B, 4, H, W) uint8, companded.
        numbers: (B, 4, H, W) uint16, digital numbers.
        count: Whether clipped samples are counted.

    Returns:
        (B, 2) int64: samples of each frame that are clipped low, and high; 0 without `count`.
    """
    if len(transitions.light) == 0:
        return np.zeros((0, 2), np.int64)
    if row_gain is not None:
        transitions = transitions.in_bands(row_gain)
    transitions = transitions.before_rounding(camera)
    frames, on_cpu = len(transitions.light), transitions.light[0].is_cpu
    if read_noise is not None and keys is not None:
        if signals is None:
            signals = torch.empty(frames, *transitions.light[0].shape)
        record_stepwise(transitions, camera, keys, "exact", signals, read_noise)
        if not on_cpu or (codes is None and numbers is None and not count):
            return np.zeros((frames, 2), np.int64)
        # What is recorded already passes the fused kernel unchanged, which fills the rest.
        table, keys = np.zeros_like(transitions.table), None
        table[:, 0] = 1.0
        transitions, signals = Transitions(list(signals), table), None
    if on_cpu:
        shown = None if signals is None else signals.numpy()
        return _record_fused(transitions, camera, keys, noise, codes, numbers, shown, count)
    assert signals is not None
    record_stepwise(transitions, camera, keys, noise, signals)
    return np.zeros((frames, 2), np.int64)


# -- the steps one by one ---------------------------------------------------------------------


def exposed_light(light: torch.Tensor, exposure: Exposure) -> torch.Tensor:
    """Light on the sensor, (4, H, W), of `light` that has the blur of `exposure` already."""
    return _limited(light * exposure.ratio)


def _limited(signal: torch.Tensor) -> torch.Tensor:
    return signal.clamp_(-SIGNAL_LIMIT, SIGNAL_LIMIT)


def record_stepwise(
    transitions: Transitions,
    camera: CameraProfile,
    keys: np.ndarray | None,
    noise: Noise,
    signals: torch.Tensor,
    read_noise: Sequence[ReadNoise] | None = None,
) -> None:
    """`record` on any device: the reference of the fused kernel. Fills `signals`."""
    for i, (light, table) in enumerate(zip(transitions.light, transitions.table, strict=True)):
        signal = _limited(light * table[0, 0].item())
        if keys is not None:
            missing = missing_variance(signal, table[1:], transitions.shares()[i])
            normals = frame_normals(int(keys[i]), tuple(light.shape), noise)
            drawn = torch.from_numpy(normals).to(signal.device)
            missing.clamp_(min=0.0)
            if read_noise is not None:
                share, own = transitions.shares()[i], read_noise[i]
                signal = signal + _read_part(missing, table, share, int(keys[i]), own)
            signal = missing.sqrt_().mul_(drawn).add_(signal)
        signals[i] = clip_and_quantise(signal, camera)


def _read_part(
    missing: torch.Tensor,
    table: np.ndarray,
    remaining_variance: torch.Tensor | None,
    key: int,
    read_noise: ReadNoise,
) -> torch.Tensor:
    """Read noise with rows and tails; its variance is taken out of `missing` (4, H, W), in place.

    A source's read noise counts as having rows and tails of the same kind.
    """
    planes, height, width = missing.shape
    dark = missing_variance(missing.new_zeros(planes, 1, 1), table[1:], remaining_variance)
    read = torch.minimum(dark.clamp(min=0.0), missing)
    missing -= read
    row_key, pixel_key = (int(noise_keys(np.array([key], np.uint64), n)[0]) for n in (1, 2))
    rows = torch.from_numpy(frame_normals(row_key, (1, 2, height))[0]).to(missing)
    pixels = torch.from_numpy(frame_normals(pixel_key, (planes, height, width))).to(missing)
    shared = plane_tensor(table[2].clip(min=0.0), missing.device)
    own = read_noise.pixel_part((1.0 - read_noise.row**2) * read, pixels)
    return read_noise.row_part(shared, rows) + own


def clip_and_quantise(signal: torch.Tensor, camera: CameraProfile) -> torch.Tensor:
    """The camera's digital numbers of `signal` (..., 4, H, W), on the scale where white is 1."""
    device = signal.device
    span = torch.tensor(camera.span, dtype=torch.float32, device=device)[:, None, None]
    black = torch.tensor(camera.black_level, dtype=torch.float32, device=device)[:, None, None]
    numbers = (signal * span).add_(black).round_().clamp_(0.0, camera.white_level)
    return numbers.sub_(black).div_(span)


# -- excess variance --------------------------------------------------------------------------


@dataclass(frozen=True)
class NoiseBalance:
    """The source's noise in a capture against the noise that the capture should have.

    Args:
        relative_excess_variance: Mean over the pixels of the variance beyond the target's,
            relative to it.
        lacks_noise: Whether any pixel has less noise than the target.
    """

    relative_excess_variance: float
    lacks_noise: bool


def noise_balance(light: torch.Tensor, exposure: Exposure) -> NoiseBalance:
    """Compares the source's noise in one image with the target's.

    Args:
        light: (4, H, W) at the exposure of the prepared scene.
        exposure: Its exposure; neither its ratio nor its noise are in `light` yet.
    """
    source, target = exposure.source_noise, exposure.target
    if source.is_zero:
        return NoiseBalance(0.0, not target.is_zero)
    (table,), remaining = top_up_table([source], [target]), exposure.remaining_variance
    height, width = light.shape[-2:]
    rows = max(1, _BALANCED // width)
    parts = [slice(top, top + rows) for top in range(0, height, rows)]
    relative, lacks = np.zeros(4), np.zeros(4, bool)

    def balance(first: int, last: int) -> None:
        for plane in range(first, last):
            if table[0, plane] >= 0.0 and table[1, plane] > 0.0:
                lacks[plane] = True  # at every pixel, whatever its light
                continue
            for part in parts:
                signal = (light[plane, part] * exposure.ratio).clamp_(0.0, SIGNAL_LIMIT)
                share = None if remaining is None else remaining[part]
                missing = missing_variance(signal, table[:, plane], share)
                lacks[plane] |= bool((missing > 0).any())
                wanted = signal.mul_(target.shot[plane]).add_(target.read[plane])
                missing.clamp_(max=0.0)
                relative[plane] -= float((missing / wanted.clamp_(min=_TINY)).sum())

    parallel_ranges(balance, 4, threads=None if len(parts) > 4 else 1)
    share = abs(float(relative.sum())) / light.numel()
    return NoiseBalance(min(share, VARIANCE_LIMIT), bool(lacks.any()))  # finite over no noise, too


# -- the fused kernel -------------------------------------------------------------------------


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
    """The same with noise of the variance that is missing (`missing_variance`)."""
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
    noise_source,
    sensor,
    outputs,
):
    """Units `first` to `last` of a batch: pieces of the planes of frames, in this order."""
    (keys, drawn, bank), (codes, numbers, signals, counts) = noise_source, outputs
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
            start, end = block * BLOCK, min((block + 1) * BLOCK, samples)
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


def _record_fused(
    transitions: Transitions,
    camera: CameraProfile,
    keys: np.ndarray | None,
    noise: Noise,
    codes: np.ndarray | None,
    numbers: np.ndarray | None,
    signals: np.ndarray | None,
    count: bool,
) -> np.ndarray:
    """`record` on the CPU, of transitions `before_rounding`."""
    light, remaining = transitions.light, transitions.remaining_variance
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
        np.zeros(frames, np.uintp) if remaining is None else addresses(remaining),
        transitions.table,
        (
            np.zeros(frames, np.uint64) if keys is None else keys,
            drawn,
            noise_bank() if drawn == _BANK else _NO_BANK,
        ),
        sensor_table(camera),
        (
            np.empty(empty, np.uint8) if codes is None else codes.reshape(flat),
            np.empty(empty, np.uint16) if numbers is None else numbers.reshape(flat),
            np.empty(empty, np.float32) if signals is None else signals.reshape(flat),
            counts,
        ),
    )
    least = max(1, _WORTH_A_THREAD // min(samples, _UNIT_BLOCKS * BLOCK))
    parallel_ranges(lambda first, last: _record(first, last, *fixed), units, least=least)
    return counts.reshape(frames, 4 * pieces if count else 0, 2).sum(axis=1)


_TINY = torch.finfo(torch.float32).tiny
#: Samples whose noise is balanced at a time: they stay in the cache, and on one thread.
_BALANCED = 2**15
