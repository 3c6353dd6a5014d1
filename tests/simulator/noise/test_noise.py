"""Noise of a pixel and of frames: variances, rows and tails, keys, the bank, exact draws.

Every bound of a frame is a sampling error of white noise.
"""

import functools
import itertools
import math
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.stats import norm

from ae_env.observation import encode_observation
from simulator.camera import CameraProfile, get_camera
from simulator.camera_simulator import CameraSimulator
from simulator.capture.blurred_frames import Layout
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import Transitions, record, sweep_keys
from simulator.noise import generator
from simulator.noise import noise_level_function as nlfs
from simulator.noise.generator import BLOCK, drawn_normals, noise_generator, noise_keys, philox
from simulator.noise.noise_level_function import (
    NoiseLevelFunction,
    ReadNoise,
    ReadNoises,
    noise_variance,
)
from simulator.optics.discs import disc_kernel
from simulator.reference.reference_camera import ReferenceCamera
from simulator.settings import CameraSettings
from tests.simulator.tables import exposure_table

CLEAN = NoiseLevelFunction((1e-5, 2e-5, 3e-5, 4e-5), (1e-8, 2e-8, 3e-8, 4e-8))
ZERO = NoiseLevelFunction.zero()


def signal(*levels: float) -> torch.Tensor:
    return torch.tensor(levels, dtype=torch.float32).expand(4, 1, len(levels))


def test_variance_is_read_plus_shot_times_signal_in_float32() -> None:
    """Below black read noise alone; variances of 5e-9 are kept of a signal in half precision."""
    levels = np.array([-1e6, -1e-9, 0.0, 0.5, 2.0])
    variance = noise_variance(signal(*levels), CLEAN)[:, 0]
    expected = np.array(CLEAN.read)[:, None] + np.outer(CLEAN.shot, levels.clip(0))
    np.testing.assert_allclose(variance.numpy(), expected, rtol=1e-6)
    tiny = NoiseLevelFunction((0.0,) * 4, (5e-9,) * 4)
    found = noise_variance(signal(0.0, 0.1).half(), tiny)
    assert found.dtype == torch.float32
    np.testing.assert_allclose(found.numpy(), 5e-9, rtol=1e-6)


def test_arithmetic() -> None:
    nlf = NoiseLevelFunction((4e-5, 3e-5, 3e-5, 2e-5), (4e-8, 3e-8, 3e-8, 2e-8))
    assert nlf.exposed(8).shot == pytest.approx((32e-5, 24e-5, 24e-5, 16e-5))
    assert nlf.exposed(8).read == pytest.approx((256e-8, 192e-8, 192e-8, 128e-8))
    assert nlf.scaled(1 / 16).shot == pytest.approx((2.5e-6, 1.875e-6, 1.875e-6, 1.25e-6))
    assert nlf.scaled(1 / 16).read == pytest.approx((2.5e-9, 1.875e-9, 1.875e-9, 1.25e-9))
    assert ZERO.is_zero
    for beyond in (nlf, replace(nlf, extrapolation=2.0)):  # whatever is done with it
        made = beyond.exposed(8), beyond.scaled(0.5), beyond.at_least(ZERO)
        assert [n.extrapolation for n in made] == [0.0 if beyond is nlf else 2.0] * 3
    assert not NoiseLevelFunction((0,) * 4, (0, 0, 0, 1e-12)).is_zero
    most = NoiseLevelFunction((1.0,) * 4, (1.0,) * 4).exposed(1e30)
    assert (most.shot, most.read) == ((1e24,) * 4, (1e24,) * 4)
    larger = nlf.at_least(NoiseLevelFunction((3e-5,) * 4, (1e-8, 4e-8, 3e-8, 3e-8)))
    assert larger.shot == (4e-5, 3e-5, 3e-5, 3e-5)
    assert larger.read == (4e-8, 4e-8, 3e-8, 3e-8)


@pytest.mark.parametrize(
    "value",
    [(1e-5,) * 3, (1e-5,) * 5, (math.nan,) * 4, (math.inf,) * 4, 1, "abcd", (1e-5, 0, -1e-9, 0)],
)
@pytest.mark.parametrize("name", ["shot", "read"])
def test_bad_noise_level_functions_are_refused(name: str, value: object) -> None:
    arguments = {"shot": (1e-5,) * 4, "read": (1e-8,) * 4, name: value}
    with pytest.raises(ValueError, match=f"`{name}`"):
        NoiseLevelFunction(**arguments)


# -- rows and tails of read noise -------------------------------------------------------------

BASE = CameraSettings(100, 1 / 64, 4)
READ, SHOT, SPAN, ROW = 1e-4, 2e-3, 12000.0, 0.5  # a read noise of 120 digital numbers
HEIGHT, WIDTH = 512, 256


def quantile(p: float, shape: float) -> float:
    """Of Tukey's lambda distribution."""
    return (p**shape - (1 - p) ** shape) / shape if shape else math.log(p / (1 - p))


def moment(shape: float, power: int) -> float:
    """Over the normal score, where the integrand has no singularity."""
    return norm.expect(lambda z: quantile(norm.cdf(z), shape) ** power, lb=-8, ub=8, epsabs=0)


def kurtosis(shape: float) -> float:
    return moment(shape, 4) / moment(shape, 2) ** 2 - 3


@pytest.mark.parametrize("shape", [-0.2, -0.1, 0.0, 0.05, 0.135, 0.3, 1.0])
def test_draws_are_quantiles_of_variance_one(shape: float) -> None:
    z = np.array([-4.0, -1.5, 0.0, 0.3, 2.0])
    deviation = math.sqrt(moment(shape, 2))
    expected = [quantile(norm.cdf(x), shape) / deviation for x in z]
    drawn = nlfs.tukey_lambda(torch.from_numpy(z), shape).numpy()
    np.testing.assert_allclose(drawn, expected, rtol=1e-6, atol=1e-12)
    pixels = ReadNoise(0.0, shape).pixel_part(torch.tensor(4.0), torch.from_numpy(z))
    np.testing.assert_allclose(pixels, 2.0 * drawn)  # one pixel, no rows


@pytest.mark.parametrize(
    ("shape", "k"), [(-0.1, 1), (-0.1, 3), (0.05, 2), (0.3, 2), (0.13, 4), (0.13491, 2)]
)
def test_kurtosis_falls_with_the_number_of_averaged_pixels(shape: float, k: int) -> None:
    """Cumulants of a mean of n independent draws: the fourth falls as n^3, the variance as n."""
    averaged = nlfs.averaged_shape(shape, k)
    assert kurtosis(averaged) == pytest.approx(kurtosis(shape) / k**2, abs=2e-3)


def camera(row: float = ROW, shape: float = -0.05) -> CameraProfile:
    nlf = NoiseLevelFunction((SHOT,) * 4, (READ,) * 4)
    tables = {"nlf_by_iso": {100.0: nlf}, "read_noise_by_iso": {100.0: ReadNoise(row, shape)}}
    return CameraProfile("round", "RGGB", 3000, 3000 + SPAN, 14, **tables)


def by_engine(level: float, k: int) -> np.ndarray:
    light = torch.full((4, HEIGHT, WIDTH), level)
    scene = PreparedScene(light, BASE, camera(), ZERO, box_factor=k)
    return scene.expose([BASE], seed=5, noise="sensor")[0].double().numpy()


def by_reference(level: float, k: int) -> np.ndarray:
    signal = torch.full((4, k * HEIGHT, k * WIDTH), level)  # averaged after it was recorded
    generator = torch.Generator().manual_seed(5)
    body = ReferenceCamera(camera(), box_factor=k, sensor_noise=True)
    return body.record(signal, 100.0, generator).double().numpy()


@pytest.mark.parametrize("capture", [by_engine, by_reference])
@pytest.mark.parametrize(("level", "k"), [(0.0, 1), (0.2, 1), (0.0, 3)])
def test_rows_and_pixels_share_the_variance(capture, level, k):
    frame = capture(level, k) - level
    rows, pixels = ROW**2 * READ / k, (1 - ROW**2) * READ / k**2 + SHOT * level / k**2
    sampling = 5 * math.sqrt(2 / HEIGHT)
    within = frame.var(axis=2, ddof=1).mean(axis=1)
    np.testing.assert_allclose(within, pixels, rtol=0.02)
    means = frame.mean(axis=2)
    covariance = np.cov(means)
    expected = np.kron(np.eye(2), np.full((2, 2), rows)) + np.eye(4) * pixels / WIDTH
    np.testing.assert_allclose(covariance, expected, atol=sampling * expected[0, 0])
    if k == 1:  # the noise level function is that of a sensor pixel
        np.testing.assert_allclose(frame.var(), READ + SHOT * level, rtol=sampling)
    elsewhere = frame - means[..., None]
    found = (elsewhere**4).mean() / (elsewhere**2).mean() ** 2 - 3
    share = (1 - ROW**2) * READ / k**2 / pixels  # fourth cumulants: shot noise has hardly any
    assert found == pytest.approx(kurtosis(-0.05) / k**2 * share**2, abs=0.15)


def test_more_is_added_where_a_blur_has_left_less() -> None:
    """Half of the frame is behind a disc of the bank's, which averages the source's noise."""
    source, half = NoiseLevelFunction((0.0,) * 4, (0.6 * READ,) * 4), WIDTH // 2
    layout = Layout((torch.arange(WIDTH) >= half).float().expand(HEIGHT, WIDTH))
    light = torch.full((4, HEIGHT, WIDTH), 0.2)
    blur = {"defocus": 4.0, "layout": layout, "tolerance": 0.0}
    body = replace(camera(), nlf_by_iso={100.0: NoiseLevelFunction((0.0,) * 4, (READ,) * 4)})
    scene = PreparedScene(light, BASE, body, source, **blur)
    frame = scene.expose([BASE], seed=5, noise="sensor")[0].double()
    sharp, soft = (float(part.var()) for part in (frame[..., :half], frame[..., half:]))
    assert sharp == pytest.approx(0.4 * READ, rel=0.1)
    left = 0.6 * (disc_kernel(4.0) ** 2).sum()  # rows stay as they are
    assert soft == pytest.approx((0.4 * ROW**2 + (1 - left) * (1 - ROW**2)) * READ, rel=0.1)


def test_off_it_changes_no_bit_and_every_output_shows_the_same_frame() -> None:
    known, light = camera(), torch.rand(4, 9, 70, generator=torch.Generator().manual_seed(0)) * 1.1
    plain = replace(known, read_noise_by_iso={})
    scenes = [PreparedScene(light, BASE, body, ZERO) for body in (known, plain)]
    for noise in ("exact", "bank"):
        first, second = (scene.expose([BASE], noise=noise) for scene in scenes)
        assert torch.equal(first, second)
    drawn = [
        ReferenceCamera(body).record(light, 100.0, torch.Generator().manual_seed(1))
        for body in (known, plain)
    ]
    assert torch.equal(*drawn)
    simulated = CameraSimulator().simulate(scenes[0], BASE, seed=3, noise="sensor").data
    assert torch.equal(simulated, scenes[0].expose([BASE], seed=3, noise="sensor")[0])
    ((_, transitions),) = scenes[0].transitions([BASE])
    signals, numbers = torch.empty(1, 4, 9, 70), np.empty((1, 4, 9, 70), np.uint16)
    given = {"keys": np.array([7], np.uint64), "read_noise": ReadNoises.of([ReadNoise(ROW, -0.05)])}
    both = {"signals": signals, "numbers": numbers}
    ((low, high),) = record(transitions, known, **both, count=True, **given)
    np.testing.assert_array_equal(numbers, np.rint(signals.numpy() * SPAN + 3000))
    assert (low, high) == ((signals <= 2**-10).sum(), (signals >= 1 - 1e-6).sum())
    assert record(transitions, known, count=True, **given).tolist() == [[low, high]]
    codes = np.empty((1, 4, 9, 70), np.uint8)
    assert record(transitions, known, codes=codes, **given).tolist() == [[0, 0]]
    np.testing.assert_array_equal(codes, encode_observation(signals))
    assert record(transitions, known, signals=signals, **given).tolist() == [[0, 0]]


@pytest.mark.parametrize("shape", [-0.2, -0.05, 0.0, 0.13491, 0.3, 1.0])
def test_the_table_of_tails_is_that_of_quantiles(shape: float) -> None:
    """Between its points, as far as draws reach: two words of 32 bits give 6.66."""
    (_, (table,)), z = nlfs.tail_tables((ReadNoise(0.1, shape),)), np.linspace(0.0, 6.66, 9001)
    expected = np.array([-quantile(p, shape) for p in norm.cdf(-z)]) / math.sqrt(moment(shape, 2))
    found = np.interp(z, np.arange(len(table)) / nlfs.TAIL_STEPS, table)
    assert np.abs((found - expected) / (1.0 + np.abs(expected))).max() < 1e-5


@pytest.mark.parametrize("size", [(9, 70), (150, 4), (300, 250)])  # of two pieces, of row blocks
@pytest.mark.parametrize("bands", [False, True])
@pytest.mark.parametrize("noise", ["exact", "bank", "sensor"])
def test_the_kernel_records_what_its_steps_do(size, bands, noise):
    """Read noise of several kinds, sources with noise, shares of it, and light of rows."""
    rng, body, isos = np.random.default_rng(1), get_camera("canon_70d"), [100, 400, 400, 3200, 9999]
    light = torch.from_numpy(rng.uniform(-0.02, 1.2, (5, 4, *size))).float()
    share = torch.from_numpy(rng.random(size)).float()
    exposures = [(0.5, body.nlf(iso / 2), body.nlf(iso)) for iso in isos]
    exposures[4] = (0.5, ZERO, body.nlf(isos[4]))
    kinds = ReadNoises.of(list(map(body.read_noise, isos, (1, 1, 4, 2, 2))))
    gains = np.float32(rng.uniform(0.2, 1.8, (5, size[0])))
    gains[1] = 1.0  # it is the same alone, without bands
    table, frames = exposure_table(*exposures), np.empty((3, 5, 4, *size), np.uint16)
    lights = Transitions(list(light), table, [None, None, share, share, None])
    one = Transitions([light[1]], table[1:2])
    keys = noise_keys(rng.integers(99, size=5), 3)
    for i, known in enumerate((lights, replace(lights, light=light), one)):
        some = slice(5) if i < 2 else slice(1, 2)
        given = {"read_noise": kinds.part(some) if noise == "sensor" else None, "noise": noise}
        given["row_gain"] = gains if bands and i < 2 else None
        record(known, body, keys=keys[some], numbers=frames[i, some], **given)
    difference = np.abs(np.subtract(*frames[:2], dtype=np.int64))
    assert difference.max() <= 1
    assert (difference > 0).sum() <= 3 + 1e-4 * difference.size
    np.testing.assert_array_equal(frames[2, 1], frames[0, 1])


def test_what_is_not_calibrated_is_refused() -> None:
    z6, light = get_camera("nikon_z6"), torch.zeros(4, 8, 8)
    for call in (
        lambda: PreparedScene(light, BASE, z6, ZERO).expose([BASE], noise="sensor"),
        lambda: ReferenceCamera(z6, sensor_noise=True),
    ):
        with pytest.raises(ValueError, match="nikon_z6"):
            call()
    for wrong, message in (
        *(((row, 0.0), "`row`") for row in (1.0, -0.01)),
        *(((0.1, shape), "`shape`") for shape in (-0.25, 1.01)),
    ):
        with pytest.raises(ValueError, match=message):
            ReadNoise(*wrong)


# -- keys, the bank and exact draws ----------------------------------------------------------------
STEP, MASK = 0x9E3779B97F4A7C15, 2**64 - 1


def mixed(word: int) -> int:
    """The finaliser of splitmix64."""
    word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9 & MASK
    word = (word ^ word >> 27) * 0x94D049BB133111EB & MASK
    return word ^ word >> 31


def bits(number: float) -> int:
    return int(struct.unpack("<Q", struct.pack("<d", number))[0])


def key_of(seed: int, *numbers: float) -> int:
    key = mixed(seed + STEP & MASK)
    for number in numbers:
        key = mixed((key ^ bits(number)) + STEP & MASK)
    return key


of_sweep = functools.partial(sweep_keys, states=[])


def test_keys_are_those_of_splitmix64_and_of_each_setting_of_a_sweep() -> None:
    """The first two outputs that its authors publish for the seed 1234567."""
    keys = noise_keys(np.array([1234567, 1234567 + STEP], np.uint64))
    assert keys.tolist() == [6457827717110365317, 3203168211198807973]
    given = [(100, 1 / 64, 4.0), (200, 1 / 64, 4.0), (100, 1 / 32, 4.0), (100, 1 / 64, 5.6)]
    states = [CameraSettings(*values) for values in given]
    for seed in (7, np.int64(8), MASK):  # the last is the largest
        keys = sweep_keys(seed, states)
        assert keys.tolist() == [key_of(int(seed), *values) for values in given]
    assert len(sweep_keys(7, [])) == 0


def test_bad_seeds_are_named() -> None:
    makes = of_sweep, noise_generator, noise_keys
    bad = [*itertools.product(makes, (-1, 1.5, "1", None)), (of_sweep, 2**64)]
    for make, seed in (*bad, (of_sweep, True), (noise_generator, True)):
        with pytest.raises(ValueError, match=r"`seeds?`"):
            make(seed)


def test_the_bank_is_every_quantile_once_in_a_fixed_order() -> None:
    bank = generator.noise_bank()
    assert (bank.shape, bank.dtype, bank.flags.writeable) == ((2**20 + 256,), np.float32, False)
    np.testing.assert_array_equal(bank[2**20 :], bank[:256])
    quantiles = stats.norm.ppf((np.arange(2**20) + 0.5) / 2**20)
    np.random.default_rng(20210616).shuffle(quantiles)
    np.testing.assert_allclose(bank[: 2**20], quantiles, rtol=1e-6)


@pytest.mark.parametrize("shape", [(2, 3, 200), (4, 1, 1)])
def test_frames_and_single_normals_are_looked_up_in_it(shape: tuple[int, int, int]) -> None:
    key, bank = key_of(5, 2.0), generator.noise_bank()
    size, turn = shape[1] * shape[2], 0
    for plane in generator.frame_normals(key, shape, "bank").reshape(shape[0], size):
        for start in range(0, size, 256):
            turn += 1
            word = mixed(key + turn * STEP & MASK)
            values = bank[word % 2**16 * 16 :][: min(256, size - start)]
            np.testing.assert_array_equal(plane[start : start + 256], values * (-1) ** (word >> 63))
    words = [mixed((key ^ 0x5851F42D4C957F2D) + turn * STEP & MASK) for turn in (1, 2, 3)]
    expected = [float(bank[word % 2**20]) * (-1) ** (word >> 63) for word in words]
    assert generator.single_normals(np.array([key], np.uint64), 3).tolist() == [expected]


@pytest.mark.parametrize(
    "vector",  # counter, key and words, from the test vectors of Random123 (Salmon et al. 2011)
    """
    00000000 00000000 00000000 00000000 00000000 00000000 6627e8d5 e169c58d bc57ac4c 9b00dbd8
    ffffffff ffffffff ffffffff ffffffff ffffffff ffffffff 408f276d 41c83b0e a20bc7c6 6d5451fd
    243f6a88 85a308d3 13198a2e 03707344 a4093822 299f31d0 d16cfe09 94fdcceb 5001e420 24126ea1
    """.strip().splitlines(),
)
def test_words_are_those_of_philox(vector: str) -> None:
    *given, first, second, third, fourth = (int(word, 16) for word in vector.split())
    assert philox(*map(np.uint32, given)) == (first, second, third, fourth)


def test_normals_are_the_transform_of_the_words() -> None:
    """Box and Muller in float64: the length from the first word of a pair, the angle from the
    second, of which the sign, one bit that swaps sine and cosine, and an angle up to pi / 4."""
    key, blocks = 0x0123456789ABCDEF, 50
    by_torch = generator._drawn_by_torch(torch.tensor([[key]]), blocks).numpy()
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
    wanted = np.stack([sign * radius * first, sign * radius * second], axis=2)
    for found in (drawn_normals(key, (1, blocks, BLOCK)), by_torch):
        # The length is that of a float32: near 0, where it is the root of 1 - u, to 1e-4.
        error = np.abs(found.reshape(wanted.shape) - wanted)
        assert error.max() < 2e-4
        assert error[:, :, 0][radius > 0.1].max() < 3e-6
    whole, part = (drawn_normals(5, (2, 1, 2 * BLOCK - left)) for left in (0, 37))
    np.testing.assert_array_equal(part, whole[..., :-37])  # frames end inside a block


@pytest.mark.parametrize("key", [(), (100.0, 1 / 64), (1 / 64, 100.0), (0.0,), (-0.0,)])
@pytest.mark.parametrize("seed", [0, 7, np.int64(7)])
def test_generators_are_seeded_by_numpys_mixture_of_the_key(seed: int, key: tuple) -> None:
    words = [int(seed), *map(bits, key)]
    (state,) = np.random.SeedSequence(words).generate_state(1, np.uint64)
    assert noise_generator(seed, *key).initial_seed() == int(state) // 2
