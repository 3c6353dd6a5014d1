"""Drawn normals against the generator's published vectors and the formulas in float64."""

from __future__ import annotations

import numpy as np
import pytest

from simulator.noise.generator import BLOCK, drawn_normals, philox


# From the test vectors that come with Random123 (Salmon et al. 2011).
@pytest.mark.parametrize(
    ("counter", "key", "words"),
    [
        (
            "00000000 00000000 00000000 00000000",
            "00000000 00000000",
            "6627e8d5 e169c58d bc57ac4c 9b00dbd8",
        ),
        (
            "ffffffff ffffffff ffffffff ffffffff",
            "ffffffff ffffffff",
            "408f276d 41c83b0e a20bc7c6 6d5451fd",
        ),
        (
            "243f6a88 85a308d3 13198a2e 03707344",
            "a4093822 299f31d0",
            "d16cfe09 94fdcceb 5001e420 24126ea1",
        ),
    ],
)
def test_words_are_those_of_philox(counter: str, key: str, words: str) -> None:
    given = [np.uint32(int(word, 16)) for word in f"{counter} {key}".split()]
    assert " ".join(f"{word:08x}" for word in philox(*given)) == words


def test_normals_are_the_transform_of_the_words() -> None:
    """Box and Muller in float64: the length from the first word of a pair, the angle from the
    second, of which the sign, one bit that swaps sine and cosine, and an angle up to pi / 4."""
    key, blocks = 0x0123456789ABCDEF, 50
    found = drawn_normals(key, (1, blocks, BLOCK))[0].reshape(blocks, 2, 2, BLOCK // 4)
    low, high = np.uint32(key & 0xFFFFFFFF), np.uint32(key >> 32)
    zero = np.uint32(0)
    counters = np.arange(blocks * BLOCK // 4, dtype=np.uint32)
    words = np.array([philox(c, zero, zero, zero, low, high) for c in counters], np.uint64)
    words = words.reshape(blocks, BLOCK // 4, 2, 2).transpose(0, 2, 3, 1)
    length, angle = words[:, :, 0], words[:, :, 1]
    radius = np.sqrt(-2.0 * np.log(((length >> 1) + 0.5) / 2.0**31))
    sign = np.where(angle >> 31, -1.0, 1.0)
    part = (angle & 0x3FFFFFFF).astype(np.int64)
    part = np.where(part >= 2**29, part - 2**30, part) / 2.0**29 * np.pi / 4
    swapped = (angle >> 30) & 1 > 0
    first = np.where(swapped, np.sin(part), np.cos(part))
    second = np.where(swapped, np.cos(part), np.sin(part))
    # The length is that of a float32: near 0, where it is the root of 1 - u, to 1e-4.
    np.testing.assert_allclose(found[:, :, 0], sign * radius * first, atol=2e-4)
    np.testing.assert_allclose(found[:, :, 1], sign * radius * second, atol=2e-4)
    large = radius > 0.1
    error = np.abs(found[:, :, 0] - sign * radius * first)[large]
    assert error.max() < 3e-6


def test_frames_end_inside_a_block() -> None:
    whole = drawn_normals(5, (2, 1, 2 * BLOCK))
    part = drawn_normals(5, (2, 1, 2 * BLOCK - 37))
    np.testing.assert_array_equal(part, whole[..., : 2 * BLOCK - 37])


def test_tails_are_those_of_a_normal() -> None:
    """Samples beyond 3, 4 and 5 standard deviations: their number is Poisson distributed."""
    normals = np.abs(drawn_normals(2, (4, 2048, 2048)))
    for limit, share in ((3.0, 2.6998e-3), (4.0, 6.3342e-5), (5.0, 5.7330e-7)):
        expected = share * normals.size
        assert (normals > limit).sum() == pytest.approx(expected, abs=5.0 * expected**0.5)
