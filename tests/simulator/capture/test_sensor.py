"""From light to digital numbers: statistics against closed forms, and the kernel against its steps.

Tolerances are sampling errors: five standard errors, computed from the exact fourth moments.
"""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import norm

from ae_env.observation import encode_observation
from simulator.camera import CameraProfile, get_camera, list_cameras
from simulator.capture import sensor
from simulator.capture.plan import noise_balances
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import Transitions, clip_and_quantise, record
from simulator.noise.generator import frame_normals, noise_keys
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.settings import CameraSettings
from tests.simulator.tables import exposure_table
from tests.simulator.z6_noise import z6_noise

ISOS, TIMES = (100, 400, 1600, 6400), (1 / 1000, 1 / 125, 1 / 15, 1 / 2)
STATES = list(itertools.starmap(CameraSettings, itertools.product(ISOS, TIMES, (4, 5.6, 8, 11))))
AREA = {4: 1 / 16, 5.6: 1 / 32, 8: 1 / 64, 11: 1 / 128}  # exact stops of the marked f-numbers
Z6 = get_camera("nikon_z6")
BLACK, WHITE, SPAN = 1008.0, 15520.0, 14512.0
ZERO = NoiseLevelFunction.zero()
ROWS, COLUMNS = 32, 128  # pixels of one flat patch


def balance(light, ratio, source, target, share=None) -> tuple[float, bool]:
    """The excess of noise, and whether any pixel lacks some."""
    noises = np.array([[target.shot, target.read]])
    table = exposure_table((ratio, source, target))
    excess, lacks = noise_balances([light], [share], table, noises)
    return excess.item(), lacks.item()


def exposure_of(settings: CameraSettings) -> float:
    return settings.iso * settings.exposure_time * AREA[settings.f_number]


def recorded_moments(mean: float, variance: float) -> tuple[float, float, float]:
    """Mean, variance and fourth central moment [DN] of Gaussian light on an integer sensor.

    Every digital number n collects the probability of [n - 1/2, n + 1/2]; those beyond the ends
    collect the tails.
    """
    centre, sigma = mean * SPAN + BLACK, math.sqrt(variance) * SPAN
    low = min(max(0.0, math.floor(centre - 9 * sigma)), WHITE)
    high = max(min(WHITE, math.ceil(centre + 9 * sigma)), 0.0)
    values = np.arange(low, high + 1)
    edges = values[:-1] + 0.5
    probability = np.diff(norm.cdf(edges, centre, sigma), prepend=0.0, append=1.0)
    average = float(probability @ values)
    spread = values - average
    return average, float(probability @ spread**2), float(probability @ spread**4)


def assert_moments(samples: np.ndarray, expected: list[tuple[float, float, float]]) -> None:
    """Means and variances of `samples` (N, pixels) within 5 standard errors, alone and together."""
    count = samples.shape[1]
    mean, variance, fourth = np.array(expected).T
    error_mean = np.sqrt(variance / count)
    error_variance = np.sqrt(np.maximum(fourth - variance**2, 0.0) / count)
    for name, off, error in (
        ("mean", samples.mean(1) - mean, error_mean),
        ("variance", samples.var(1, ddof=1) - variance, error_variance),
    ):
        certain = error < 1e-9  # all pixels at white, or at 0
        assert np.abs(off[certain]).max(initial=0.0) < 1e-9, name
        z = off[~certain] / error[~certain]
        assert np.abs(z).max() < 5.0, (name, np.abs(z).argmax(), z)
        assert abs(z.mean()) * math.sqrt(len(z)) < 5.0, (name, z.mean())


def test_noise_free_source_over_all_states() -> None:
    """At five signals from black to white, each state has its camera's mean and variance."""
    reference = CameraSettings(100, 1 / 125, 8)
    levels = np.array([0.0, 0.004, 0.119, 0.5, 0.998])
    samples, expected = [], []
    for state in STATES:
        ratio = exposure_of(state) / exposure_of(reference)
        light = np.repeat(levels / ratio, ROWS).astype(np.float32)  # a flat patch of each
        light = torch.from_numpy(light)[:, None].repeat(4, 1, COLUMNS)
        prepared = PreparedScene(light, reference, Z6, ZERO)
        capture, excess = prepared.capture(state, seed=1)
        assert excess == 0.0
        numbers = capture.double().numpy() * SPAN + BLACK
        assert np.abs(numbers - np.rint(numbers)).max() < 2e-3  # float32 near 15520
        assert numbers.min() >= -2e-3
        assert numbers.max() <= WHITE + 2e-3
        samples.append(np.rint(numbers).reshape(-1, ROWS * COLUMNS))
        shot, read = z6_noise(state.iso)[..., None]
        variance = read + shot * levels - 1.0 / (12.0 * Z6.span[0] ** 2)  # what rounding adds
        for row in variance:
            expected += map(recorded_moments, levels, row)
    assert_moments(np.concatenate(samples), expected)


def test_limits_of_light_and_signal() -> None:
    light = torch.tensor([3e6, -3e6, 3e9, -3e9]).expand(4, 1, 4).contiguous()
    still = CameraSettings(100, 1, 4)
    scene = PreparedScene(light, still, Z6, ZERO, tolerance=0.0)
    assert scene.expected(still)[0, 0].tolist() == [1e6, -1e6, 1e6, -1e6]
    for blur, limit in (({}, 3e3), ({"image_speed": 1e-3}, 1e3), ({"defocus": 1e-3}, 1e3)):
        dark = replace(scene, gain=1e-6, **blur).expected(still)[0, 0]
        expected = [3.0, -3.0, limit, -limit]  # white at every exposure
        np.testing.assert_allclose(dark.numpy(), expected, rtol=1e-4, atol=1e-3)
    assert replace(scene, gain=1e39).plan(still).ratio == 2.0**107


SOURCE = Z6.nlf(400)
PARTS = [replace(SOURCE, read=(0.0,) * 4), replace(SOURCE, shot=(0.0,) * 4)]


@pytest.mark.parametrize("source", [ZERO, SOURCE, *PARTS])
@pytest.mark.parametrize("left", [1.0, 0.5])
@pytest.mark.parametrize("by_torch", [False, True])
def test_bands_come_before_the_noise(source, left, by_torch):
    """Each row's light, and of a noisy source each row's share of its variance, by both ways."""
    light, rows = torch.full((4, 2, 5000), 0.3), np.array([[0.5, 1.5]])
    target, share = Z6.nlf(6400), None if left == 1.0 else torch.full((2, 5000), left)
    transitions = Transitions([light], exposure_table((1.0, source, target)), [share])
    if by_torch:
        transitions = replace(transitions, light=light[None])
    frame, keys = torch.empty(1, 4, 2, 5000), np.array([1], np.uint64)
    record(transitions, Z6, keys=keys, row_gain=rows, signals=frame)
    for row, gain in enumerate(rows[0]):
        wanted = target.read[1] + target.shot[1] * 0.3 * gain
        taken = left * gain * (source.read[1] + source.shot[1] * 0.3 * gain)
        measured = frame[0, 1, row].double()
        assert float(measured.mean()) == pytest.approx(0.3 * gain, abs=5 * (wanted / 5000) ** 0.5)
        assert float(measured.var()) == pytest.approx(wanted - taken, rel=5 * math.sqrt(2 / 5000))


@pytest.mark.parametrize(
    "target",
    [
        *map(Z6.nlf, (100, 400, 6400)),
        NoiseLevelFunction((1e-5,) * 4, (4e-6,) * 4),  # more read noise, less shot noise
        NoiseLevelFunction((5e-4,) * 4, (1e-9,) * 4),  # the other way round
        NoiseLevelFunction(Z6.nlf(800).exposed(2.0).shot, (1e-6,) * 4),  # the same shot noise
        Z6.nlf(800).exposed(2.0),  # the same noise
        NoiseLevelFunction((1e-5, 1e-5, 1e-5, 1e-2), (1e-9, 1e-9, 1e-9, 1e-2)),  # of one plane
    ],
)
@pytest.mark.parametrize("blurred_noise", [False, True])
def test_balance_of_noise_pixel_by_pixel(target: NoiseLevelFunction, blurred_noise: bool) -> None:
    rng = np.random.default_rng(0)
    light = rng.normal(0.2, 0.3, (4, 20, 30))
    share = rng.random((20, 30)) if blurred_noise else np.ones((20, 30))
    remaining = torch.from_numpy(share).float() if blurred_noise else None
    (shot1, read1), (shot2, read2) = (
        [np.array(v)[:, None, None] for v in (n.shot, n.read)] for n in (Z6.nlf(800), target)
    )
    signal = 2.0 * np.maximum(light, 0.0)
    given, wanted = share * (4 * read1 + 2 * shot1 * signal), read2 + shot2 * signal
    beyond = np.maximum(given - wanted, 0.0)
    excess, lacks = balance(torch.from_numpy(light).float(), 2.0, Z6.nlf(800), target, remaining)
    assert excess == pytest.approx((beyond / wanted).mean(), rel=1e-4, abs=1e-7)
    assert lacks == bool((wanted > given).any())


def test_the_averaged_table_has_what_a_blur_leaves_in_the_mean() -> None:
    """A quarter and three quarters are a half: the other half of the source's noise is lacking."""
    source, target, share = Z6.nlf(400), Z6.nlf(6400), torch.full((2, 4), 0.25)
    share[0] = 0.75
    table = exposure_table(*[(1.0, source, target)] * 2)
    transitions = Transitions([torch.zeros(4, 2, 4)] * 2, table, [None, share])
    assert Transitions(transitions.light, transitions.table).averaged_table().shape == (2, 5, 4)
    for table, left in zip(transitions.averaged_table(), (1.0, 0.5), strict=True):
        given, wanted = ([np.array(n.shot), np.array(n.read)] for n in (source, target))
        np.testing.assert_allclose(table[3:], np.multiply(left, given), rtol=1e-6)
        lacking = np.array(wanted) - np.multiply(left, given)
        np.testing.assert_allclose(table[1:3], lacking, rtol=1e-6)


def test_recording_nothing_and_on_other_devices() -> None:
    light, table = torch.empty(4, 2, 3, device="meta"), exposure_table((1.0, ZERO, ZERO))
    assert record(Transitions([], table[:0]), Z6).shape == (0, 2)
    signals, keys = torch.empty(1, 4, 2, 3, device="meta"), np.zeros(1, np.uint64)
    counts = record(Transitions([light], table), Z6, keys=keys, signals=signals)
    assert (tuple(counts.shape), counts.device.type) == ((1, 2), "meta")
    with pytest.raises(ValueError, match="image"):
        record(Transitions([light], table), Z6, keys=keys, image=signals)


def test_balance_where_there_is_no_noise() -> None:
    """A clean source lacks all of it; over a target without any, the excess is finite."""
    light = torch.full((4, 4, 4), 0.5)
    assert balance(light, 1.0, ZERO, Z6.nlf(100)) == (0.0, True)
    assert balance(light, 1.0, ZERO, ZERO) == (0.0, False)
    light[:, 0], shot = 0.0, NoiseLevelFunction((1e-4,) * 4, (0.0,) * 4)  # rows of 0 / 0
    assert balance(light, 1.0, shot, ZERO) == (1e24, False)


# -- the fused kernel -------------------------------------------------------------------------


def random_light(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed)) * 1.5 - 0.01


def reference(light, ratio, source, target, share, normals) -> torch.Tensor:
    """The capture in float64, from the formulas of the noise top-up: numbers before rounding.

    Rounding will add 1/12, which is part of the target's noise.
    """
    x, exposed = (light.double() * ratio).clamp(-1e6, 1e6), source.exposed(ratio)

    def variance(nlf: NoiseLevelFunction) -> torch.Tensor:
        shot, read = (torch.tensor(v, dtype=torch.float64) for v in (nlf.shot, nlf.read))
        return read[:, None, None] + shot[:, None, None] * x.clamp(min=0.0)

    left = 1.0 if share is None else share.double()
    rounding = 1.0 / (12.0 * torch.tensor(Z6.span, dtype=torch.float64)[:, None, None] ** 2)
    missing = (variance(target) - left * variance(exposed) - rounding).clamp(min=0.0)
    return in_numbers(x + missing.sqrt() * normals.double()).clamp(0.0, Z6.white_level)


def in_numbers(signal: torch.Tensor) -> torch.Tensor:
    """Digital numbers of `signal` (4, H, W), in float64 and not rounded."""
    span, black = (torch.tensor(v, dtype=torch.float64) for v in (Z6.span, Z6.black_level))
    return signal.double() * span[:, None, None] + black[:, None, None]


@pytest.mark.parametrize("size", [(1, 1), (37, 53), (16, 16), (300, 500)])
@pytest.mark.parametrize("noisy_source", [False, True])
@pytest.mark.parametrize("blurred", [False, True])
@pytest.mark.parametrize("kind", ["exact", "bank"])
def test_captures_are_those_of_the_reference(size, noisy_source, blurred, kind):
    """By the fused kernel, and by the steps one by one; planes of up to 150,000 samples."""
    light = random_light(4, *size)
    light[:, 0, :3] = torch.tensor([-1e30, 1e30, 3e38])[: size[1]]
    before = light.clone()
    exposure = 0.4, Z6.nlf(1600) if noisy_source else ZERO, Z6.nlf(400)
    share = random_light(*size, seed=1).clamp(0.0, 1.0) if blurred else None
    keys = noise_keys(5, 3)
    normals = torch.from_numpy(frame_normals(int(keys[0]), (4, *size), kind))
    exact = reference(light, *exposure, share, normals)
    transitions = Transitions([light], exposure_table(exposure), [share])
    least = {"linear": -(2.0**-10), "images": 0.0}
    frames, *shown = (
        outputs := {n: torch.empty(2, 4, *size) for n in ("signals", *least)}
    ).values()
    first, second = ({n: out[i : i + 1] for n, out in outputs.items()} for i in range(2))
    counts = record(transitions, Z6, keys=keys, noise=kind, count=True, **first)
    record(replace(transitions, light=light[None]), Z6, keys=keys, noise=kind, **second)
    assert all(map(torch.equal, shown, [frames.clamp(low, 1.0) for low in least.values()]))
    for frame in frames:
        numbers = in_numbers(frame)
        assert float((numbers - numbers.round()).abs().max()) < 0.005  # float32 of 14 bits: 0.001
        # The nearest number, where float32 may be off by a hundredth of one before it rounds.
        assert float((numbers.round() - exact).abs().max()) <= 0.51
    clipped = [(frames[0] <= 2.0**-10).sum(), (frames[0] >= 1.0 - 1e-6).sum()]
    assert counts.tolist() == [[int(number) for number in clipped]]
    assert torch.equal(light, before)


LEVELS = itertools.product(((0.0,) * 4, (64.5,) * 4, (3.0, 7.5, 0.0, 60.0)), (255.0, 65535.0))
BODIES = [CameraProfile("x", "RGGB", black, white, 16) for black, white in LEVELS]


@pytest.mark.parametrize("body", [*map(get_camera, list_cameras()), *BODIES], ids=str)
def test_every_digital_number_is_written_exactly(body: CameraProfile) -> None:
    numbers = np.arange(int(body.white_level) + 1)
    black, span = np.array(body.black_level)[:, None], np.array(body.span)[:, None]
    light = torch.from_numpy(((numbers - black) / span).astype(np.float32)).contiguous()
    kinds = {"codes": np.uint8, "numbers": np.uint16}
    outputs = {name: np.empty((1, 4, len(numbers)), kind) for name, kind in kinds.items()}
    signals = torch.empty(1, 4, len(numbers))
    table = exposure_table((1.0, ZERO, ZERO))
    transition = Transitions([light[:, None]], table)
    counts = record(transition, body, **outputs, signals=signals, count=True)
    quantised = clip_and_quantise(light[:, None], body)[:, 0]
    np.testing.assert_array_equal(outputs["numbers"][0], np.tile(numbers, (4, 1)))
    assert torch.equal(signals[0], quantised)
    codes = np.sqrt((quantised.double().numpy().clip(-1 / 1024) + 1 / 1024) / (1 + 1 / 1024)) * 255
    np.testing.assert_allclose(outputs["codes"][0], codes, rtol=0, atol=0.5 + 1e-4)
    low, high = (quantised <= 2.0**-10).sum(), (quantised >= 1.0 - 1e-6).sum()
    assert counts.tolist() == [[int(low), int(high)]]


@pytest.mark.parametrize("kind", ["exact", "bank"])
def test_a_frame_is_the_same_alone_in_a_batch_and_on_any_number_of_threads(kind, monkeypatch):
    """Planes of more than 65,536 samples, which are worked on in two pieces."""
    lights = [random_light(4, 250, 265, seed=i) for i in range(3)]
    table = exposure_table(*((0.6 * (i + 1), ZERO, Z6.nlf(400 * 4**i)) for i in range(3)))
    keys, transitions = noise_keys(np.arange(3), 2), Transitions(lights, table)
    functions, which = np.random.default_rng(0).random((2, 2, 4, 256)), np.array([1, 0, 1])
    tables, planes = sensor.packed_tables(*functions), np.arange(4)[:, None, None]
    for threads in (1, 3):
        monkeypatch.setattr("torch.get_num_threads", lambda n=threads: n)
        codes, signals = np.empty((3, 4, 250, 265), np.uint8), torch.empty(3, 4, 250, 265)
        means = sensor.CodeMeans.empty(tables, which)
        outputs = {"codes": codes, "signals": signals, "count": True, "means": means}
        counts = record(transitions, Z6, keys=keys, noise=kind, **outputs)
        for i, light in enumerate(lights):
            alone = torch.empty(1, *light.shape)
            one = Transitions([light], table[i : i + 1])
            assert not record(one, Z6, keys=keys[i : i + 1], noise=kind, signals=alone).any()
            assert torch.equal(signals[i], alone[0])
            np.testing.assert_array_equal(codes[i], encode_observation(alone[0]))
            clipped = [(alone <= 2.0**-10).sum(), (alone >= 1.0 - 1e-6).sum()]
            assert counts[i].tolist() == [int(number) for number in clipped]
            wanted = [function[which[i], planes, codes[i]].mean() for function in functions]
            wanted = [(codes[i] == 255).any(axis=0).mean(), *wanted]
            np.testing.assert_allclose(means.means[i], wanted, rtol=0, atol=1e-7)
    assert counts[1:, 1].min() > 10_000


def test_extreme_light_is_recorded_to_half_a_digital_number():
    """Light of 50 stops and as dark as black goes, exposed by 2**-30 to 2**30."""
    light = 2.0 ** np.random.default_rng(0).uniform(-30, 20, (4, 48, 48)).astype(np.float32)
    light[:, 0], light[:, 1] = 0.0, -np.array(Z6.pedestal)[:, None]
    stops = np.array([-30.0, -10.0, -1.0, 0.0, 1.0, 10.0, 30.0])
    states = [CameraSettings(100.0 * 2 ** (s / 2), 2 ** (s / 2), 4.0) for s in stops.tolist()]
    clean = replace(Z6, nlf_by_iso={100.0: ZERO}, segments=())
    scene = PreparedScene(torch.from_numpy(light), CameraSettings(100, 1, 4), clean, ZERO)
    exact = light * 2.0 ** stops[:, None, None, None] * SPAN + BLACK
    off = scene.expose(states).double().numpy() * SPAN + BLACK - exact.clip(0.0, WHITE)
    assert np.abs(off).max() <= 0.5 + 4 * 2.0**-24 * 2**14  # and float32 products of 14 bits
