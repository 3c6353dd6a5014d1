"""Normals of frames: functions of a frame's key alone, drawn by counting or looked up in a bank.

Drawing 4 x 128 x 128 normals takes about 70 microseconds, everything else that a capture needs
about 30: hence the bank, which is read in hashed pieces.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import torch

from simulator.utils.checks import check_integer
from simulator.utils.compute import kernel, parallel_ranges

#: How the noise of a frame is made: drawn, looked up in a bank of normals, or drawn with the rows
#: and tails of the camera's read noise (`simulator.noise.noise_level_function`).
Noise = Literal["exact", "bank", "sensor"]
#: Samples that are made in one piece; blocks do not reach over the end of a plane.
BLOCK = 256


def noise_generator(seed: int, *key: int | float) -> torch.Generator:
    """A torch generator that depends on `seed` >= 0 and on every number of `key` alone.

    For the reference camera and for training, which draw with torch: `key` is the step of a
    training, or the settings of a capture.
    """
    words = [check_integer("seed", seed, 0), *(int(np.float64(k).view(np.uint64)) for k in key)]
    state = np.random.SeedSequence(words).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))


# -- keys: 64 bits from a seed and from the numbers that frames differ by ----------------------
#
# A chain of splitmix64 (Steele, Lea and Flood 2014) over the seed and the bits of the numbers.
KEY_STEP = np.uint64(0x9E3779B97F4A7C15)
_MULTIPLIERS = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_SHIFTS = np.uint64(30), np.uint64(27), np.uint64(31)


def mixed(words: Any) -> Any:
    """The finaliser of splitmix64: a bijection of uint64, one or an array of them."""
    words = (words ^ (words >> _SHIFTS[0])) * _MULTIPLIERS[0]
    words = (words ^ (words >> _SHIFTS[1])) * _MULTIPLIERS[1]
    return words ^ (words >> _SHIFTS[2])


#: The same inside kernels.
mixed_word = kernel()(mixed)


@kernel()
def _begin(seeds, keys):  # type: ignore[no-untyped-def]
    """Writes the keys of as many seeds, or of one; whether none is negative."""
    for frame in range(len(keys)):
        if seeds[frame % len(seeds)] < 0:
            return False
        keys[frame] = mixed_word(np.uint64(seeds[frame % len(seeds)]) + KEY_STEP)
    return True


@kernel()
def _fold(numbers, keys):  # type: ignore[no-untyped-def]
    """Makes the keys differ by as many numbers, or by one."""
    bits = np.empty(1)
    for frame in range(len(keys)):
        bits[0] = numbers[frame % len(numbers)]
        keys[frame] = mixed_word((keys[frame] ^ bits.view(np.uint64)[0]) + KEY_STEP)


def noise_keys(seeds: np.ndarray | int, *numbers: np.ndarray | float) -> np.ndarray:
    """(B,) uint64 keys of B frames, each a function of its seed and numbers and of nothing else.

    `seeds` are (B,) or a single integer, >= 0. The noise of the frames also differs by `numbers`,
    each (B,) or a single one: the frame of an episode, the settings of a capture.
    """
    given, *columns = map(np.asarray, (seeds, *numbers))
    sizes = [len(values) for values in (given, *columns) if values.ndim]
    keys = np.empty(sizes[0] if sizes else 1, np.uint64)
    if given.dtype.kind not in "iu" or not _begin(given.reshape(-1), keys):
        raise ValueError(f"`seeds` (={seeds!r}) must be integers >= 0")
    for values in columns:
        _fold(values.reshape(-1), keys)
    return keys


# -- exact draws: each block of a frame from its number and the frame's key --------------------
#
# Philox4x32-10 (Salmon, Moraes, Dror and Shaw 2011) turns a counter and a key into four random
# words; the transform of Box and Muller (1958) turns two words into two independent normals. Any
# block can be drawn alone, on any thread, and the compiler draws many counters at once: three times
# as fast as torch's generator. The normals reach to 6.7 standard deviations.

#: Counters of a block: each gives four words, and those four normals.
_COUNTERS = BLOCK // 4
_ROUNDS = 10
_PHILOX_MULTIPLIERS = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_WEYL = np.uint32(0x9E3779B9), np.uint32(0xBB67AE85)
_WORD = np.uint64(32)
_ONE, _HALF, _TWO = np.float32(1), np.float32(0.5), np.float32(2)
_UNIT = np.float32(2.0**-31)
_LN2, _EIGHTH_TURN = np.float32(math.log(2.0)), np.float32(math.pi / 4 * 2.0**-31)
_SQRT_HALF_BITS = np.int32(np.float32(math.sqrt(0.5)).view(np.int32))


def _coefficients(
    function: Callable[[Any], Any], low: float, high: float, degree: int
) -> tuple[np.float32, ...]:
    """Coefficients, lowest power first, of the polynomial through the Chebyshev nodes."""
    fit = np.polynomial.Chebyshev.interpolate(function, degree, domain=[low, high])
    return tuple(np.float32(c) for c in fit.convert(kind=np.polynomial.Polynomial).coef)


# What is left of series behind their first terms: (log(1 + t) - t + t^2 / 2) / t^3, and with
# y = t^2, (sin(t) / t - 1) / y and (cos(t) - 1 + y / 2) / y^2.
_LOG = _coefficients(
    lambda t: (np.log1p(t) - t + t * t / 2) / t**3, math.sqrt(0.5) - 1, math.sqrt(2) - 1, 8
)
_SIN = _coefficients(lambda y: (np.sin(y**0.5) / y**0.5 - 1) / y, 0.0, (math.pi / 4) ** 2, 2)
_COS = _coefficients(lambda y: (np.cos(y**0.5) - 1 + y / 2) / y**2, 0.0, (math.pi / 4) ** 2, 2)

_jit = functools.partial(kernel, fastmath={"nnan", "nsz", "contract"}, boundscheck=False)


@_jit(inline="always")
def philox(c0, c1, c2, c3, k0, k1):  # type: ignore[no-untyped-def]
    """Four random words of a counter of four words and a key of two, all uint32."""
    for _ in range(_ROUNDS):
        first = _PHILOX_MULTIPLIERS[0] * np.uint64(c0)
        second = _PHILOX_MULTIPLIERS[1] * np.uint64(c2)
        c0 = np.uint32(np.uint32(second >> _WORD) ^ c1 ^ k0)
        c2 = np.uint32(np.uint32(first >> _WORD) ^ c3 ^ k1)
        c1, c3 = np.uint32(second), np.uint32(first)
        k0, k1 = np.uint32(k0 + _WEYL[0]), np.uint32(k1 + _WEYL[1])
    return c0, c1, c2, c3


@_jit()
def _polynomial(x, coefficients):  # type: ignore[no-untyped-def]
    value = coefficients[len(coefficients) - 1]
    for i in range(len(coefficients) - 1):
        value = value * x + coefficients[len(coefficients) - 2 - i]
    return value


@_jit()
def _logarithm(x):  # type: ignore[no-untyped-def]
    """Logarithm of a float32 in (0, 1]: a power of two, and a polynomial around 1."""
    bits = np.float32(x).view(np.int32)
    power = np.int32(np.int32(bits - _SQRT_HALF_BITS) >> np.int32(23))
    t = np.int32(bits - np.int32(power << np.int32(23))).view(np.float32) - _ONE
    return t + t * t * (t * _polynomial(t, _LOG) - _HALF) + np.float32(power) * _LN2


@_jit()
def _transform(length, angle, first, second):  # type: ignore[no-untyped-def]
    """Independent normals of random words: a length, and an angle of which two bits are the octant
    pair and the others turn it by up to an eighth either way."""
    for j in range(len(first)):
        share = (np.float32(np.int32(length[j] >> np.uint32(1))) + _HALF) * _UNIT
        radius = np.sqrt(-_TWO * _logarithm(share))
        word = angle[j]
        t = (np.float32(np.int32(np.uint32(word << np.uint32(2)))) + _HALF) * _EIGHTH_TURN
        y = t * t
        sine = t + t * y * _polynomial(y, _SIN)
        cosine = _ONE + y * (y * _polynomial(y, _COS) - _HALF)
        steep = (word >> np.uint32(30)) & np.uint32(1)
        radius = -radius if word >> np.uint32(31) else radius
        first[j] = radius * (sine if steep else cosine)
        second[j] = radius * (cosine if steep else sine)


@_jit()
def draw_block(key, block, words, out):  # type: ignore[no-untyped-def]
    """Draws the `BLOCK` normals of a frame's block, whose number is below 2**26, into `out`.

    `key` is a uint64; `words` (4, BLOCK / 4) uint32 is to work in.
    """
    low, high, zero = np.uint32(key), np.uint32(key >> _WORD), np.uint32(0)
    for j in range(_COUNTERS):
        c0, c1, c2, c3 = philox(np.uint32(block * _COUNTERS + j), zero, zero, zero, low, high)
        words[0, j], words[1, j], words[2, j], words[3, j] = c0, c1, c2, c3
    quarter, half = _COUNTERS, 2 * _COUNTERS
    _transform(words[0], words[1], out[:quarter], out[quarter:half])
    _transform(words[2], words[3], out[half : half + quarter], out[half + quarter :])


@_jit()
def _draw(first, last, key, blocks, out):  # type: ignore[no-untyped-def]
    words, drawn = np.empty((4, _COUNTERS), np.uint32), np.empty(BLOCK, np.float32)
    for block in range(first, last):
        draw_block(key, block, words, drawn)
        part = out[block // blocks, (block % blocks) * BLOCK :][:BLOCK]
        part[:] = drawn[: len(part)]


def drawn_normals(key: int, shape: tuple[int, ...]) -> np.ndarray:
    """`frame_normals` of `shape` (P, H, W), drawn."""
    planes, samples = shape[0], shape[1] * shape[2]
    blocks = -(-samples // BLOCK)
    out = np.empty((planes, samples), np.float32)
    fixed = (np.uint64(key), blocks, out)
    parallel_ranges(lambda a, b: _draw(a, b, *fixed), planes * blocks, least=1024)
    return out.reshape(shape)


# -- the bank ---------------------------------------------------------------------------------
#
# It holds the 2**20 quantiles (i + 1/2) / 2**20 of the normal distribution in a fixed random order.
# A frame reads it in blocks of 256 samples; where each block starts (any multiple of 16) and its
# sign come from a hash of the frame's key and the block's number. Every start is as likely as any
# other, so each sample has the bank's distribution exactly, and two samples share a value only by
# the chance that blocks overlap.

#: Number of different normals.
BANK_SIZE = 2**20
#: A block starts at a multiple of this: one cache line of float32.
STRIDE = 16
_SHUFFLE_SEED = 20210616
_SINGLES = np.uint64(0x5851F42D4C957F2D)  # keeps single normals apart from a frame's blocks
_START_BITS = np.uint64(BANK_SIZE // STRIDE - 1)


def normals_above(shares: np.ndarray) -> np.ndarray:
    """Standard normals that are above these `shares` of all; SciPy's takes 0.2 s to import."""
    return np.asarray(torch.special.ndtri(torch.from_numpy(shares)))


@functools.cache
def noise_bank() -> np.ndarray:
    """The bank, read-only: (BANK_SIZE + BLOCK,) float32; the end repeats the beginning."""
    quantiles = normals_above((np.arange(BANK_SIZE) + 0.5) / BANK_SIZE).astype(np.float32)
    np.random.default_rng(_SHUFFLE_SEED).shuffle(quantiles)
    bank = np.concatenate([quantiles, quantiles[:BLOCK]])
    bank.flags.writeable = False
    return bank


def single_normals(keys: np.ndarray, count: int) -> np.ndarray:
    """(B, count) float64: `count` standard normals for each key, apart from its frame's noise."""
    found = np.empty((len(keys), count))
    _look_up(keys, noise_bank(), found)
    return found


@kernel()
def _look_up(keys, bank, found):  # type: ignore[no-untyped-def]
    for i in range(len(keys)):
        for number in range(found.shape[1]):
            word = mixed_word((keys[i] ^ _SINGLES) + KEY_STEP * np.uint64(number + 1))
            value = bank[word & np.uint64(BANK_SIZE - 1)]
            found[i, number] = -value if word >> np.uint64(63) else value


@_jit()
def bank_block(key, block):  # type: ignore[no-untyped-def]
    """Where in the bank a block of a frame starts, and its sign (`frame_normals`)."""
    word = mixed_word(key + KEY_STEP * np.uint64(block + 1))
    return np.int64(word & _START_BITS) * STRIDE, -_ONE if word >> np.uint64(63) else _ONE


# -- normals of frames -----------------------------------------------------------------------------


def frame_normals(key: int, shape: tuple[int, ...], noise: Noise = "exact") -> np.ndarray:
    """Standard normals of a frame of `shape` (P, H, W), float32.

    They are what `record` adds, as an array: for other devices and for tests.
    """
    return batch_normals(np.array([key], np.uint64), shape, noise, torch.device("cpu"))[0].numpy()


def batch_normals(
    keys: np.ndarray, shape: tuple[int, ...], noise: Noise, device: torch.device
) -> torch.Tensor:
    """`frame_normals` (B, P, H, W) of frames, on any device."""
    if noise != "bank" and device.type == "cpu":  # the compiled loop is faster
        return torch.from_numpy(np.stack([drawn_normals(key, shape) for key in keys.tolist()]))
    planes, samples = shape[0], shape[1] * shape[2]
    blocks = planes * -(-samples // BLOCK)
    own = torch.from_numpy(keys.view(np.int64)).to(device)[:, None]
    if noise == "bank":
        turns = np.arange(1, blocks + 1, dtype=np.uint64) * KEY_STEP
        words = _mixed_words(own + torch.from_numpy(turns.view(np.int64)).to(device))
        pieces = _bank_on(device).unfold(0, BLOCK, STRIDE)
        values = pieces[words & int(_START_BITS)]  # (B, blocks of all planes, 256)
        values *= torch.where(words < 0, -1.0, 1.0)[..., None]
    else:
        values = _drawn_by_torch(own, blocks)
    return values.view(len(keys), planes, -1)[..., :samples].reshape(len(keys), *shape)


def _drawn_by_torch(keys: torch.Tensor, blocks: int) -> torch.Tensor:
    """`draw_block` (B, `blocks`, 256) for int64 keys (B, 1), in words of 32 bits of int64."""
    bits, (one, two) = 2**32 - 1, map(int, _PHILOX_MULTIPLIERS)
    c0 = torch.arange(blocks * _COUNTERS, device=keys.device).expand(len(keys), -1)
    c1 = c2 = c3 = torch.zeros_like(c0)
    k0, k1 = keys & bits, (keys >> 32) & bits
    for _ in range(_ROUNDS):
        first, second = c0 * one, c2 * two
        c0, c2 = ((second >> 32) & bits) ^ c1 ^ k0, ((first >> 32) & bits) ^ c3 ^ k1
        c1, c3 = second & bits, first & bits
        k0, k1 = (k0 + int(_WEYL[0])) & bits, (k1 + int(_WEYL[1])) & bits
    length, angle = torch.stack([c0, c2]), torch.stack([c1, c3])
    radius = ((length >> 1).float() + 0.5).mul_(float(_UNIT)).log_().mul_(-2.0).sqrt_()
    radius = torch.where(angle >> 31 > 0, -radius, radius)
    turn = (angle << 2) & bits
    turn = (turn - ((turn >> 31) << 32)).float().add_(0.5).mul_(float(_EIGHTH_TURN))
    steep = (angle >> 30 & 1) > 0
    sine, cosine = radius * turn.sin(), radius * turn.cos()
    both = torch.where(steep, sine, cosine), torch.where(steep, cosine, sine)
    drawn = torch.stack(both, dim=1).view(4, len(keys), blocks, _COUNTERS)
    return drawn.permute(1, 2, 0, 3).reshape(len(keys), blocks, BLOCK)


@functools.lru_cache(maxsize=8)
def _bank_on(device: torch.device) -> torch.Tensor:
    return torch.tensor(noise_bank(), device=device)


def _mixed_words(words: torch.Tensor) -> torch.Tensor:
    """`mixed` of int64 words: their products wrap, too, and shifts fill in zeros."""
    for shift, multiplier in zip(_SHIFTS, (*_MULTIPLIERS, np.uint64(1)), strict=True):
        shifted = (words >> int(shift)) & ((1 << (64 - int(shift))) - 1)
        words = (words ^ shifted) * int(multiplier.view(np.int64))
    return words
