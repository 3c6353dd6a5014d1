"""The normals of frames, drawn and looked up, against closed forms.

Every bound is a sampling error of white noise.
"""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from scipy import stats

from simulator.noise.generator import FrameNoise, Noise, noise_keys, sweep_keys
from simulator.settings import CameraSettings

SHAPE = (4, 128, 128)
PIXELS = math.prod(SHAPE)

both = pytest.mark.parametrize("kind", ["exact", "bank"])


def frames(kind: Noise, count: int, seed: int = 1) -> np.ndarray:
    """(count, 4, 128, 128) noise of one rollout."""
    return np.stack([normals(k, kind) for k in noise_keys(seed, np.arange(count))])


def normals(key: int, kind: Noise, shape: tuple[int, int, int] = SHAPE) -> np.ndarray:
    """Of one frame."""
    return FrameNoise(int(key), kind).normals(shape)


@both
def test_a_frame_is_a_function_of_its_key_in_every_process(kind: Noise) -> None:
    key = int(noise_keys(5, 2)[0])
    np.testing.assert_array_equal(normals(key, kind), normals(key, kind))
    assert (normals(key, kind) != normals(key + 1, kind)).mean() > 0.99
    code = (
        "from simulator.noise.generator import FrameNoise\n"
        "from simulator.noise.generator import noise_keys\n"
        f"noise = FrameNoise(int(noise_keys(5, 2)[0]), {kind!r})\n"
        "print(noise.normals((4, 16, 16)).tobytes().hex())"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert bytes.fromhex(other.stdout.strip()) == normals(key, kind, (4, 16, 16)).tobytes()


@both
def test_frames_have_the_moments_of_a_normal(kind: Noise) -> None:
    noise = frames(kind, 100).astype(np.float64)
    n = noise.size
    assert abs(noise.mean()) < 5.0 / math.sqrt(n)
    # Standard errors of the k-th moment: sqrt(E x^2k - (E x^k)^2), 15 = E x^6 and so on.
    assert abs((noise**2).mean() - 1.0) < 5.0 * math.sqrt(2.0 / n)
    assert abs((noise**3).mean()) < 5.0 * math.sqrt(15.0 / n)
    assert abs((noise**4).mean() - 3.0) < 5.0 * math.sqrt(96.0 / n)


@both
def test_one_frame_is_normally_distributed(kind: Noise) -> None:
    """Distance of the distribution functions of a frame: 1.95 / sqrt(n) is its 99.9 % bound."""
    for key in noise_keys(9, np.arange(5)):
        distance = stats.kstest(normals(key, kind).ravel(), "norm").statistic
        assert distance < 1.95 / math.sqrt(PIXELS)


@both
def test_frames_are_white_in_space(kind: Noise) -> None:
    noise = frames(kind, 50).astype(np.float64)
    for rows, columns in [(0, 1), (0, 2), (0, 16), (1, 0), (1, 1), (2, 0), (2, 3), (4, 0), (64, 0)]:
        first = noise[..., rows:, columns:]
        second = noise[..., : 128 - rows, : 128 - columns]
        assert abs((first * second).mean()) < 5.0 / math.sqrt(first.size)


@both
def test_frames_are_white_in_time_and_over_planes(kind: Noise) -> None:
    noise = frames(kind, 100).astype(np.float64)
    for lag in (1, 2, 7):
        pairs = noise[lag:] * noise[:-lag]
        assert abs(pairs.mean()) < 5.0 / math.sqrt(pairs.size)
    across = noise[:, 1:] * noise[:, :-1]
    assert abs(across.mean()) < 5.0 / math.sqrt(across.size)


@both
def test_neighbouring_seeds_are_independent(kind: Noise) -> None:
    first, second = frames(kind, 50, seed=100).astype(np.float64), frames(kind, 50, seed=101)
    assert abs((first * second).mean()) < 5.0 / math.sqrt(first.size)


@both
def test_variance_over_time_is_the_same_everywhere(kind: Noise) -> None:
    """No pixel is stuck: each one's variance over 200 frames is chi-squared."""
    noise = np.stack([normals(k, kind, (4, 32, 32)) for k in noise_keys(2, np.arange(200))])
    p = stats.kstest(199.0 * noise.var(axis=0, ddof=1).ravel(), "chi2", args=(199,)).pvalue
    assert p > 1e-3


@both
def test_no_shift_makes_two_frames_alike(kind: Noise) -> None:
    """Largest correlation of two frames over all 65,536 shifts, against that of white noise.

    The largest of n standard normals is near sqrt(2 ln n) = 4.7. A pair of blocks that share
    their samples adds 256 to a sum whose standard deviation is sqrt(65,536) = 256: one unit more.
    """
    noise = frames(kind, 20).astype(np.float64).reshape(20, -1)
    spectra = np.fft.rfft(noise)
    for i in range(19):
        correlation = np.fft.irfft(spectra[i].conj() * spectra[i + 1], n=PIXELS)
        peak = np.abs(correlation).max() / math.sqrt(PIXELS)
        assert peak < math.sqrt(2.0 * math.log(PIXELS)) + 2.0


# -- keys of sweeps -------------------------------------------------------------------------------


def test_frames_of_a_sweep_differ_by_each_setting_and_the_seed() -> None:
    base = CameraSettings(100, 1 / 64, 4.0)
    others = [CameraSettings(200, 1 / 64, 4.0), CameraSettings(100, 1 / 32, 4.0)]
    others.append(CameraSettings(100, 1 / 64, 5.6))
    keys = [*sweep_keys(7, [base, *others]), *sweep_keys(8, [base, *others])]
    assert len(set(keys)) == 8
    assert sweep_keys(np.int64(7), [others[1]])[0] == keys[2]
    assert sweep_keys(2**64 - 1, [base]).dtype == np.uint64
    assert len(sweep_keys(7, [])) == 0


@pytest.mark.parametrize("seed", [-1, 1.5, "1", None, True, 2**64])
def test_bad_seeds_are_named(seed: object) -> None:
    with pytest.raises(ValueError, match="`seed`"):
        sweep_keys(seed, [CameraSettings(100, 1 / 64, 4.0)])  # type: ignore[arg-type]
