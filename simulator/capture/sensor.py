"""The sensor: from linear light to the numbers that the camera records.

The order is physical, and it matters: exposed light, not clipped -> motion and defocus blur of that
light -> the light of each row, where it flickers -> noise of that signal -> clip -> quantise, each
of the last two once. (Exposure and blur are linear: one blur here serves many exposures.)

*The missing variance*: a pixel of signal x whose source has the noise (shot1, read1) carries
``a shot1 x + a^2 read1`` after the exposure ratio a (`NoiseLevelFunction.exposed`). To carry the
target's noise (shot2, read2) it lacks the variance

    D(x) = (read2 - a^2 read1) + (shot2 - a shot1) max(x, 0).

Where D is positive, noise of that variance is added, and mean and variance are exact. Where D is
negative the source is noisier than the target: nothing is added, and -D is the excess variance.
A blur averages the source's noise: where it leaves only a share r of the variance, the other share
``(1 - r) (a shot1 max(x, 0) + a^2 read1)`` is missing, too.

*Bands* of flickering light: rows have light of their own, which multiplies the blurred light before
there is noise. That is exact for motion along the rows; other motion blurs across rows that do not
share their light. The source's own noise is multiplied with its light, its variance by the square
of the row's gain, r^2. What the top-up takes away for it has the variance times r: exact for shot
noise, and off by r (1 - r) of the source's read noise.

`record` is the one way from light to frames: on the CPU one fused kernel, in blocks of 256 samples
that stay in the first-level cache; elsewhere the steps one by one. The noise of a frame is a
function of its key alone (`simulator.noise.generator`).
"""

from __future__ import annotations

import functools
import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numba
import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.capture.limits import PEDESTAL, SIGNAL_LIMIT
from simulator.noise.generator import (
    BLOCK,
    STRIDE,
    Noise,
    bank_block,
    batch_normals,
    draw_block,
    frame_normals,
    noise_bank,
    noise_keys,
)
from simulator.noise.noise_level_function import TAIL_STEPS, ReadNoises, plane_tensor, tail_tables
from simulator.settings import CameraSettings
from simulator.utils.checks import check_integer
from simulator.utils.compute import (
    add_to,
    addresses,
    as_pointer,
    kernel,
    load_alone,
    parallel_ranges,
    prefetch,
)

#: Blocks of a plane that one thread works on at a time, and samples that are worth a thread.
_UNIT_BLOCKS, _WORTH_A_THREAD, _CODES_WORTH_A_THREAD = 256, 4 * 64 * 64 * 4, 2**15
_ZERO, _HALF, _ONE, _CODES = np.float32(0), np.float32(0.5), np.float32(1), np.float32(255)
#: Bit from which samples clipped high are counted: no unit has as many that are clipped low.
_HIGH_BITS = 16
_NEITHER, _LOW, _HIGH = np.int32(0), np.int32(1), np.int32(1 << _HIGH_BITS)
_NO_KEYS, _NO_BANK = np.empty(0, np.uint64), np.empty(0, np.float32)
_NO_BANK.flags.writeable = False  # of the bank's type
_LIMIT, _LARGEST = np.float32(SIGNAL_LIMIT), np.finfo(np.float32).max
#: Outputs that are signals, and the least one that each shows.
LEAST_SIGNALS = {"signals": -_LARGEST, "linear": np.float32(-PEDESTAL), "images": _ZERO}
_LEAST = tuple(LEAST_SIGNALS.values())
#: What `packed_tables` count as 1, and how their words are split.
_WHOLE, _HALF_WORD, _LOW_HALF = 2.0**24 - 1.0, np.uint64(32), np.uint64(2**32 - 1)
_KINDS = {"codes": np.uint8, "numbers": np.uint16} | dict.fromkeys(LEAST_SIGNALS, np.float32)
_jit = functools.partial(kernel, fastmath={"nnan", "nsz", "contract"}, boundscheck=False)


def sweep_keys(seed: int, states: Sequence[CameraSettings]) -> np.ndarray:
    """(S,) uint64 keys of the noise of a sweep's frames, which differ by their settings.

    `seed` is an integer >= 0 of at most 64 bits.
    """
    seed = check_integer("seed", seed, 0, 2**64 - 1)
    numbers = np.array([(s.iso, s.exposure_time, s.f_number) for s in states], np.float64)
    return noise_keys(seed, *numbers.reshape(-1, 3).T)


@functools.lru_cache(maxsize=8)
def pixel_response(camera: CameraProfile, shape: tuple[int, ...], box_factor: int) -> torch.Tensor:
    """Gains of the photosites relative to their mean, `shape` (4, H, W) float32, >= 0.

    The pattern is a function of the camera's name: every frame of a body has it. Of `box_factor`
    squared pixels averaged it is as many times weaker.
    """
    normals = frame_normals(zlib.crc32(camera.name.encode()), shape)
    gains = 1.0 + np.float32(camera.prnu / box_factor) * normals
    return torch.from_numpy(gains.clip(min=0.0))


# -- a batch of frames ------------------------------------------------------------------------


@dataclass
class Transitions:
    """All that B frames depend on, except for their noise."""

    #: (4, H, W) each, contiguous float32: blurred already, at the exposure of its prepared scene.
    #: Several may be the same. One tensor (B, 4, H, W) where torch is to record the frames.
    light: Sequence[torch.Tensor] | torch.Tensor
    #: (B, 5, 4) float32, columns are the planes R, G1, G2, B. The rows: exposure ratio; shot and
    #: read noise that is missing, negative where the source has more; shot and read noise of the
    #: source on the target's scale.
    table: np.ndarray
    #: (H, W) contiguous float32 each: shares of the source's noise variance that blurs leave,
    #: beyond what is in the `table`; None for all of it. None in place of the sequence where no
    #: frame has any.
    remaining_variance: Sequence[torch.Tensor | None] | None = None

    def seen_by(self, responses: Sequence[torch.Tensor | None]) -> Transitions:
        """The same on sensors of these gains, (4, H, W) each; None for gains of 1."""
        if all(gains is None for gains in responses):
            return self
        lights: Any = [
            light if gains is None else light * gains.to(light.device)
            for light, gains in zip(self.light, responses, strict=True)
        ]
        if isinstance(self.light, torch.Tensor):
            lights = torch.stack(lights)
        return replace(self, light=lights)

    def before_rounding(self, camera: CameraProfile) -> Transitions:
        """The same without the variance that rounding to whole digital numbers will add, 1/12.

        It is part of the calibrated read noise: the rest of that is what has to be drawn.
        """
        table = self.table.copy()
        table[:, 2] -= camera.digits[5]
        return replace(self, table=table)

    def averaged_table(self) -> np.ndarray:
        """`table` in which each source's noise is what its blur leaves in the mean."""
        if self.remaining_variance is None:
            return self.table
        shares = self.remaining_variance  # of which many frames have the same
        _, first, which = np.unique(addresses(shares), return_index=True, return_inverse=True)
        distinct = [shares[i] for i in first.tolist()]
        left = [1.0 if share is None else float(share.mean()) for share in distinct]
        remaining, table = np.array(left, np.float32)[which, None, None], self.table.copy()
        table[:, 1:3] += (1.0 - remaining) * table[:, 3:]
        table[:, 3:] *= remaining
        return table

    @property
    def shape(self) -> tuple[int, ...]:
        """(4, H, W) of each light."""
        known = getattr(self.light, "shape", None)
        return tuple(self.light[0].shape if known is None else known[1:])

    @property
    def needs_torch(self) -> bool:
        """Whether torch has to record the frames: of light in one tensor, or on a device."""
        if hasattr(self.light, "addresses"):
            return False
        return isinstance(self.light, torch.Tensor) or not self.light[0].is_cpu

    @property
    def lacks_noise(self) -> bool:
        """Whether any signal could have less noise than its target; else none need be drawn."""
        missing = bool((self.table[:, 1:3] > 0.0).any())
        return missing or any(share is not None for share in self.remaining_variance or ())


def missing_variance(
    signal: torch.Tensor, table: torch.Tensor, remaining_variance: torch.Tensor | None = None
) -> torch.Tensor:
    """D(x) of each pixel; negative where the source is noisier.

    Args:
        signal: (..., 4, H, W) on the target's scale.
        table: (..., 4, 4, 1, 1), rows 1 to 4 of a `Transitions.table`.
        remaining_variance: (H, W) share of the source's variance that a blur left, or
            (..., 1, H, W); None for all.
    """
    shot, read, source_shot, source_read = table.unbind(-4)
    bright = signal.float().clamp(min=0.0)
    missing = (bright * shot).add_(read)
    if remaining_variance is not None:
        missing = missing + (1.0 - remaining_variance) * (bright * source_shot + source_read)
    return missing


def record(
    transitions: Transitions,
    camera: CameraProfile,
    *,
    keys: np.ndarray | None = None,
    noise: Noise = "exact",
    read_noise: ReadNoises | None = None,
    row_gain: np.ndarray | None = None,
    count: bool = False,
    means: CodeMeans | None = None,
    run: Callable[[int, tuple[Any, ...]], None] | None = None,
    **outputs: torch.Tensor | np.ndarray,
) -> np.ndarray | torch.Tensor:
    """Records a batch of frames: exposes, adds noise, clips and quantises.

    Args:
        transitions: Light and exposures.
        camera: The body.
        keys: (B,) uint64 of the noise; None for none.
        noise: How the keys become noise.
        read_noise: Rows and tails of each frame's read noise, for the noise ``"sensor"``.
        row_gain: (B, H) light of each row relative to the frame's; None where all rows have that.
        count: Whether clipped samples are counted.
        means: Of the output ``codes``, an array, to fill; None where torch records.
        run: Calls `record_units` for all frames, of which each has so many units, with these
            arguments, once their light is made; there is no light before, and nothing reads it.
        outputs: What to fill, each (B, 4, H, W) and contiguous: ``codes``, uint8, companded;
            ``numbers``, uint16, digital numbers; and in float32, where black is 0 and white is 1,
            ``signals``, ``linear``, which are at least -`PEDESTAL`, and ``images``, at least 0.

    Returns:
        (B, 2) float64: samples of each frame that are clipped low, and high; 0 without `count`. A
        tensor of int64 on the device of the light where `Transitions.needs_torch`.
    """
    if unknown := [name for name in outputs if name not in _KINDS]:
        raise ValueError(f"`outputs` (={sorted(unknown)}) must be of {', '.join(_KINDS)}")
    if len(transitions.light) == 0:
        return np.zeros((0, 2))
    if transitions.needs_torch:
        tensors = {name: torch.as_tensor(out) for name, out in outputs.items()}
        noises = keys, noise, read_noise
        return _record_stepwise(transitions, camera, noises, row_gain, tensors, count)
    light, remaining, read = transitions.light, transitions.remaining_variance, None
    frames, samples, places = len(light), math.prod(transitions.shape[1:]), addresses(light)
    pieces = -(-samples // (BLOCK * _UNIT_BLOCKS))
    counts = np.zeros((frames, 2))
    shares = np.zeros(frames, np.uintp) if remaining is None else addresses(remaining)
    drawn = None if keys is None or noise == "bank" else True
    if keys is not None and read_noise is not None:
        of_rows, of_pixels = (noise_keys(keys, number) for number in (1, 2))
        tables = tail_tables(read_noise.kinds)
        read = of_rows, of_pixels, transitions.shape[2], read_noise.which, *tables
    arrays = {name: np.asarray(out) for name, out in outputs.items()}
    codes, numbers, *signals = (
        arrays[name].reshape(frames, 4, samples) if name in arrays else np.empty((0, 4, 0), dtype)
        for name, dtype in _KINDS.items()
    )
    turns = np.arange(frames) if run else places.argsort(kind="stable")  # light stays in caches
    fixed = (
        samples,
        (places, shares, transitions.table, turns),
        (_NO_KEYS, _NO_BANK) if keys is None else (keys, _NO_BANK if drawn else noise_bank()),
        camera.digits,
        (codes, numbers, tuple(signals), counts if count else counts[:0]),
    )
    # Means come with the frames where none of these is to be divided.
    least = max(1, _WORTH_A_THREAD // min(samples, _UNIT_BLOCKS * BLOCK))
    size = 4 * pieces if least >= 4 * pieces or frames >= 2 * torch.get_num_threads() else 1
    filled = tuple(_NO_MEANS if means is None or size == 1 else means)
    whole = *fixed, filled, drawn, read, None if row_gain is None else row_gain.astype(np.float32)
    if run is None:
        parallel_ranges(
            lambda first, last: record_units(first * size, last * size, *whole),
            frames * 4 * pieces // size,
            least=max(1, least // size),
        )
    else:
        run(4 * pieces, whole)
    if means is not None and size == 1:
        means.fill(codes)
    return counts


# -- the steps one by one ---------------------------------------------------------------------


def _record_stepwise(
    transitions: Transitions,
    camera: CameraProfile,
    noises: tuple[np.ndarray | None, Noise, ReadNoises | None],
    row_gain: np.ndarray | None,
    outputs: Mapping[str, torch.Tensor],
    count: bool,
) -> torch.Tensor:
    """`record` on any device by torch operations: the reference of the fused kernel.

    The `noises` are keys, how they become noise, and the read noise. Frames in one tensor go
    together, others singly.
    """
    (keys, noise, read_noise), transitions = noises, transitions.before_rounding(camera)
    lights, device = transitions.light, transitions.light[0].device
    span, black, low, high = (plane_tensor(row, device) for row in camera.digits[:4])
    counts = torch.zeros(len(lights), 2, dtype=torch.int64, device=device)
    together = len(lights) if isinstance(lights, torch.Tensor) else 1
    shares = [*(transitions.remaining_variance or ())]
    for first in range(0, len(lights), together):
        part = slice(first, first + together)
        light = lights[part] if isinstance(lights, torch.Tensor) else lights[first][None]
        table = torch.from_numpy(transitions.table[part]).to(device)[..., None, None]
        share = None
        if keys is not None and any(left is not None for left in shares[part]):
            all_left = light.new_ones(light.shape[-2:])
            each = [all_left if left is None else left.to(device) for left in shares[part]]
            share = torch.stack(each)[:, None]  # (B, 1, H, W)
        if row_gain is not None:
            gains = torch.from_numpy(row_gain[part]).to(light)[:, None, :, None]
            light = light * gains
            if transitions.table[part, 3:].any():  # the source has noise of its own
                share = gains if share is None else share * gains
        signal = (light * table[:, 0]).clamp_(-SIGNAL_LIMIT, SIGNAL_LIMIT)
        if keys is not None:
            missing = missing_variance(signal, table[:, 1:], share).clamp_(min=0.0)
            if read_noise is not None:
                some = keys[part], read_noise.part(part)
                signal = signal + _read_part(missing, table[:, 1:], share, *some)
            normals = batch_normals(keys[part], tuple(light.shape[1:]), noise, device)
            signal = missing.sqrt_().mul_(normals).add_(signal)
        numbers = signal.mul_(span).add_(black).round_().clamp_(0.0, camera.white_level)
        if "numbers" in outputs:
            outputs["numbers"][part] = numbers.to(torch.int32).to(torch.uint16)
        if count:
            for column, clipped in enumerate((numbers <= low, numbers >= high)):
                counts[part, column] = clipped.flatten(1).sum(dim=1)
        if "codes" in outputs:
            bright = (numbers - (black - PEDESTAL * span)).clamp_(min=0.0)
            codes = bright.sqrt_().mul_(255.0 / (span * (1.0 + PEDESTAL)).sqrt()).add_(0.5)
            outputs["codes"][part] = codes.to(torch.uint8)
        if shown := LEAST_SIGNALS.keys() & outputs:
            signals = numbers.sub_(black).div_(span)
            for name in shown:
                outputs[name][part] = signals.clamp(float(LEAST_SIGNALS[name]), 1.0)
    return counts


def _read_part(
    missing: torch.Tensor,
    table: torch.Tensor,
    remaining_variance: torch.Tensor | None,
    keys: np.ndarray,
    read_noise: ReadNoises,
) -> torch.Tensor:
    """Read noise with rows and tails, (B, 4, H, W); its variance is taken out of `missing`.

    A source's read noise counts as having rows and tails of the same kind.
    """
    dark = missing_variance(torch.zeros_like(table[:, 0]), table, remaining_variance)
    read = torch.minimum(dark.clamp(min=0.0), missing)
    missing -= read
    shape, device = tuple(missing.shape[1:]), missing.device
    rows = batch_normals(noise_keys(keys, 1), (1, 2, shape[1]), "exact", device)
    pixels = batch_normals(noise_keys(keys, 2), shape, "exact", device)
    shared = table[:, 1].clamp(min=0.0)
    for number in np.unique(read_noise.which).tolist():
        kind, (some,) = read_noise.kinds[number], np.nonzero(read_noise.which == number)
        own = kind.pixel_part((1.0 - kind.row**2) * read[some], pixels[some])
        read[some] = own.add_(kind.row_part(shared[some], rows[some, 0]))
    return read


def clip_and_quantise(signal: torch.Tensor, camera: CameraProfile) -> torch.Tensor:
    """The camera's digital numbers of `signal` (..., 4, H, W), on the scale where white is 1."""
    span, black = (plane_tensor(row, signal.device) for row in camera.digits[:2])
    numbers = (signal * span).add_(black).round_().clamp_(0.0, camera.white_level)
    return numbers.sub_(black).div_(span)


# -- means over codes -------------------------------------------------------------------------


class CodeMeans(NamedTuple):
    """Means over the codes of B frames, which `record` fills in while a frame is in the cache."""

    tables: np.ndarray  # (K, 4, 256) of `packed_tables`
    which: np.ndarray  # (B,) the one of each frame
    #: (B, 3) float64: share of the pixels with a plane at white, and means of both functions.
    means: np.ndarray

    @classmethod
    def empty(cls, tables: np.ndarray, which: np.ndarray) -> CodeMeans:
        """Those that are still to be filled."""
        return cls(tables, which, np.empty((len(which), 3)))

    def fill(self, codes: np.ndarray) -> None:
        """Fills in those of codes (B, 4, ...) uint8."""
        flat = codes.reshape(len(codes), 4, -1)
        least = max(1, _CODES_WORTH_A_THREAD // flat[0].size)
        parallel_ranges(lambda a, b: mean_codes(a, b, flat, *self), len(flat), least=least)


_NO_MEANS = CodeMeans.empty(np.empty((0, 4, 256), np.uint64), np.empty(0, np.int64))


def packed_tables(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(K, 4, 256) uint64 of two functions of a code, in [0, 1], the second in the lower half.

    One sum serves both: with 24 bits each, the halves hold that of a block.
    """
    high, low = (np.rint(_WHOLE * np.float64(x)).astype(np.uint64) for x in (first, second))
    return (high << _HALF_WORD) + low


@kernel(fastmath={"nsz", "contract", "reassoc"}, boundscheck=False)
def mean_codes(first, last, codes, tables, which, means):  # type: ignore[no-untyped-def]
    """`CodeMeans` of the frames (B, 4, N) uint8 from the `first` to before the `last`."""
    size = codes.shape[2]
    for frame in range(first, last):
        total_first, total_second, white = np.uint64(0), np.uint64(0), 0
        for plane in range(4):
            table = tables[which[frame], plane]
            for start in range(0, size, BLOCK):
                total = np.uint64(0)
                for code in codes[frame, plane, start : start + BLOCK]:
                    total += load_alone(table, code)  # type: ignore[call-arg]
                total_first += total >> _HALF_WORD
                total_second += total & _LOW_HALF
        red, green, other, blue = codes[frame]
        for i in range(size):
            brightest = max(max(red[i], green[i]), max(other[i], blue[i]))
            white += brightest == 255
        means[frame, 0] = white / size
        means[frame, 1] = total_first / (_WHOLE * 4 * size)
        means[frame, 2] = total_second / (_WHOLE * 4 * size)


# -- the fused kernel -------------------------------------------------------------------------


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
    """Digital numbers of light, without noise; `sensor` is of `CameraProfile.digits`."""
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
def _digitise_with_rows(  # type: ignore[no-untyped-def]
    size, light, normals, rows, tails, parts, shares, bound, ratio, noise, sensor, out
):
    """The same with read noise that has `rows` and `tails`: draws whose variance is 1.

    Of its variance, rows and the rest have the `parts` (2,) of `tail_tables`.
    """
    (shot, read, source_shot, source_read), (span, black, white) = noise, sensor
    deviation, rest = parts[0] * np.sqrt(read if read > _ZERO else _ZERO), parts[1]
    for j in range(size):
        x = _exposed(light[j], ratio, bound)
        bright, lacking = x if x > _ZERO else _ZERO, _ONE - shares[j]
        missing = bright * shot + read
        missing += lacking * (bright * source_shot + source_read)
        missing = missing if missing > _ZERO else _ZERO
        dark = read + lacking * source_read
        dark = dark if dark > _ZERO else _ZERO
        dark = dark if dark < missing else missing
        x += deviation * rows[j] + tails[j] * np.sqrt(rest * dark)
        out[j] = _rounded(_noisy(x, normals[j], missing - dark), span, black, white)


@_jit()
def _draw_tails(read, frame, block, words, out):  # type: ignore[no-untyped-def]
    """`tukey_lambda` of a block of normals; returns its row of the parts of `tail_tables`.

    See `record` for `read`.
    """
    _, keys, _, which, parts, tables = read
    kind = which[frame]
    table = tables[kind]
    draw_block(keys[frame], block, words, out)
    for j in range(BLOCK):
        place = abs(out[j]) * np.float32(TAIL_STEPS)
        step = np.int32(place)
        low, high = table[np.uint32(step)], table[np.uint32(step + 1)]
        value = low + (place - np.float32(step)) * (high - low)
        out[j] = value if out[j] > _ZERO else -value
    return parts[kind]


@_jit()
def _draw_rows(read, frame, plane, block, samples, words, out):  # type: ignore[no-untyped-def]
    """Draws the normals that rows share, those of the rows of a unit that begins with a `block`.

    Returns how much further on samples of the plane would be if their first row were that of `out`.
    """
    keys, width = read[0], read[2]
    before = plane // 2 * (samples // width)  # rows of the planes R and G1
    start, end = block * BLOCK, min((block + _UNIT_BLOCKS) * BLOCK, samples)
    first = (before + start // width) // BLOCK
    for number in range(first, (before + (end - 1) // width) // BLOCK + 1):
        draw_block(keys[frame], number, words, out[(number - first) * BLOCK :][:BLOCK])
    return (before - first * BLOCK) * width


@_jit()
def _by_row(start, width, values, out):  # type: ignore[no-untyped-def]
    """Fills a piece of a plane with the value of each row, which has so many samples."""
    first, size = 0, len(out)
    while first < size:
        row = (start + first) // width
        last = min(size, (row + 1) * width - start)
        out[first:last] = values[row]
        first = last


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
    """Codes ``round(255 sqrt((x + p) / (1 + p)))`` of digital numbers; counts as `_count` does."""
    for j in range(len(out)):
        x = numbers[j] - darkest
        out[j] = np.uint8(np.int32(np.sqrt(x if x > _ZERO else _ZERO) * scale + _HALF))
        counts[j] += _clips(numbers[j], low, high)


@_jit()
def _as_integers(numbers, out):  # type: ignore[no-untyped-def]
    for j in range(len(out)):
        out[j] = np.uint16(np.int32(numbers[j]))


@_jit()
def _as_signals(numbers, black, span, least, out):  # type: ignore[no-untyped-def]
    for j in range(len(out)):
        x = (numbers[j] - black) / span
        x = x if x < _ONE else _ONE  # black and span are rounded
        out[j] = x if x > least else least


@_jit()
def _in_bands(start, samples, gain, light, shares, lit, left):  # type: ignore[no-untyped-def]
    """Light of a piece of a plane in bands, and what is `left` there of the source's variance."""
    lit, left = lit[: len(light)], left[: len(light)]
    _by_row(start, samples // len(gain), gain, left)
    for j in range(len(left)):
        lit[j] = light[j] * left[j]
        left[j] *= shares[j]
    return lit, left


@_jit()
def record_units(  # type: ignore[no-untyped-def]
    first, last, samples, scenes, noise, sensor, outputs, means, drawn, read, gains
):
    """Units `first` to `last` of a batch: pieces of the planes of frames, in this order.

    Of `scenes` there are addresses of light and of shares of variance, the table of `Transitions`,
    and the order of the frames; of `noise` keys and the bank. What is None is not compiled: whether
    noise is `drawn`, what `read` noise with rows and tails is drawn by, and the `gains` (B, H) of
    rows. Where there are `means` (of `CodeMeans`) to fill, frames are not divided.

    It is one function: calls with arrays in tuples, once a block, take a tenth of its time.
    """
    (light, remaining, exposure, turns), (keys, bank) = scenes, noise
    codes, numbers, signals, counts = outputs
    part, made = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    lit, varied = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    rows, tails = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    all_left, clipped = np.ones(BLOCK, np.float32), np.empty(BLOCK, np.int32)
    words = np.empty((4, BLOCK // 4), np.uint32)
    if read is not None:
        of_rows = np.empty((_UNIT_BLOCKS // read[2] + 3) * BLOCK, np.float32)
    blocks = (samples + BLOCK - 1) // BLOCK
    pieces = (blocks + _UNIT_BLOCKS - 1) // _UNIT_BLOCKS
    for unit in range(first, last):
        frame, plane, piece = turns[unit // (4 * pieces)], (unit // pieces) % 4, unit % pieces
        ratio, shot, dark, source_shot, source_read = exposure[frame, :, plane]
        span, black, low, high, white, rounding = sensor[:, plane]
        body, dark = (span, black, white), dark - rounding
        bound = min(_LIMIT / ratio, _LARGEST)  # light beyond it is white; not at an exposure of 0
        darkest = black - np.float32(PEDESTAL) * span
        scale = _CODES / np.sqrt(span * np.float32(1.0 + PEDESTAL))
        frame_light = numba.carray(as_pointer(light[frame]), (4 * samples,))  # type: ignore[attr-defined, call-arg]
        shares = samples if remaining[frame] else 0
        share = numba.carray(as_pointer(remaining[frame]), (shares,))
        clipped[:], begin = 0, piece * _UNIT_BLOCKS
        if read is not None:
            shift = _draw_rows(read, frame, plane, begin, samples, words, of_rows)
        for block in range(begin, min(begin + _UNIT_BLOCKS, blocks)):
            start, end = block * BLOCK, min((block + 1) * BLOCK, samples)
            size, at, number = end - start, plane * samples + start, plane * blocks + block
            exposed, normals, sign, out = frame_light[at : at + size], made, _ONE, part[:size]
            left = share[start:end] if shares else all_left[:size]
            if gains is not None:
                exposed, left = _in_bands(start, samples, gains[frame], exposed, left, lit, varied)
            if drawn is not None:
                draw_block(keys[frame], number, words, made)
            elif keys.size:
                offset, sign = bank_block(keys[frame], number)
                normals = bank[offset : offset + BLOCK]
                coming = bank_block(keys[frame], number + 1)[0]
                for line in range(coming, coming + BLOCK, STRIDE):
                    prefetch(bank, line)
            given = bound, ratio, (shot, dark, source_shot, source_read), body, part
            if not keys.size:
                _digitise(size, exposed, bound, ratio, body, part)
            elif read is not None:
                _by_row(start + shift, read[2], of_rows, rows[:size])
                parts = _draw_tails(read, frame, number, words, tails)
                _digitise_with_rows(size, exposed, made, rows, tails, parts, left, *given)
            elif gains is not None or shares:
                _digitise_averaged(size, exposed, normals, sign, left, *given)
            else:
                _digitise_noisy(size, exposed, normals, sign, bound, ratio, shot, dark, body, part)
            if codes.size:
                _compand(out, darkest, scale, low, high, clipped, codes[frame, plane, start:end])
            elif counts.size:
                _count(out, low, high, clipped)
            if numbers.size:
                _as_integers(out, numbers[frame, plane, start:end])
            for k in range(len(signals)):
                if signals[k].size:
                    _as_signals(out, black, span, _LEAST[k], signals[k][frame, plane, start:end])
        if counts.size:
            add_to(counts, 2 * frame, (clipped & (_HIGH - 1)).sum())
            add_to(counts, 2 * frame + 1, (clipped >> _HIGH_BITS).sum())
        if means[2].size and (unit + 1) % (4 * pieces) == 0:
            mean_codes(frame, frame + 1, codes, *means)


def is_compiled() -> bool:
    """Whether the kernel that records frames was compiled before, on this machine."""
    file = getattr(getattr(record_units, "_cache", None), "_cache_file", None)
    return file is None or bool(file._load_index())  # without a cache a second process is no use
