"""The fused kernel against the steps of `simulator.capture.sensor`, and hand-made numbers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ae_env.observation import encode_observation
from simulator.camera import CameraProfile, get_camera, list_cameras
from simulator.capture.exposure import Exposure, exposure_table
from simulator.capture.kernels import record_frames, sensor_table
from simulator.capture.sensor import Transitions, clip_and_quantise, record, record_stepwise
from simulator.noise.generator import Noise, frame_normals, noise_keys
from simulator.noise.noise_level_function import NoiseLevelFunction

Z6 = get_camera("nikon_z6")
CLEAN = NoiseLevelFunction.zero()


def random_light(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed)) * 1.5 - 0.01


def reference(light: torch.Tensor, exposure: Exposure, normals: torch.Tensor) -> torch.Tensor:
    """The capture in float64, from the formulas of the noise top-up: numbers before rounding.

    Rounding will add 1/12, which is part of the target's noise.
    """
    x = (light.double() * exposure.ratio).clamp(-1e6, 1e6)
    source, target = exposure.source_noise, exposure.target

    def variance(nlf: NoiseLevelFunction) -> torch.Tensor:
        shot, read = (torch.tensor(v, dtype=torch.float64) for v in (nlf.shot, nlf.read))
        return read[:, None, None] + shot[:, None, None] * x.clamp(min=0.0)

    share = exposure.remaining_variance
    left = 1.0 if share is None else share.double()
    rounding = 1.0 / (12.0 * torch.tensor(Z6.span, dtype=torch.float64)[:, None, None] ** 2)
    missing = (variance(target) - left * variance(source) - rounding).clamp(min=0.0)
    return in_numbers(x + missing.sqrt() * normals.double()).clamp(0.0, Z6.white_level)


def in_numbers(signal: torch.Tensor) -> torch.Tensor:
    """Digital numbers of `signal` (4, H, W), in float64 and not rounded."""
    span, black = (torch.tensor(v, dtype=torch.float64) for v in (Z6.span, Z6.black_level))
    return signal.double() * span[:, None, None] + black[:, None, None]


@pytest.mark.parametrize("size", [(1, 1), (37, 53), (16, 16), (300, 500)])
@pytest.mark.parametrize("noisy_source", [False, True])
@pytest.mark.parametrize("blurred", [False, True])
@pytest.mark.parametrize("kind", ["exact", "bank"])
def test_captures_are_those_of_the_reference(
    size: tuple[int, int], noisy_source: bool, blurred: bool, kind: Noise
) -> None:
    """By the fused kernel, and by the steps one by one; planes of up to 150,000 samples."""
    light = random_light(4, *size)
    light[:, 0, :3] = torch.tensor([-1e30, 1e30, 3e38])[: size[1]]
    before = light.clone()
    exposure = Exposure(
        ratio=0.4,
        source=Z6.nlf(1600) if noisy_source else CLEAN,
        target=Z6.nlf(400),
        remaining_variance=random_light(*size, seed=1).clamp(0.0, 1.0) if blurred else None,
    )
    keys = noise_keys(5, 3)
    normals = torch.from_numpy(frame_normals(int(keys[0]), (4, *size), kind))
    exact = reference(light, exposure, normals)
    transitions, frames = Transitions.of([light], [exposure]), torch.empty(2, 4, *size)
    counts = record(transitions, Z6, keys=keys, noise=kind, signals=frames[:1], count=True)
    record_stepwise(transitions.before_rounding(Z6), Z6, keys, kind, frames[1:])
    for frame in frames:
        numbers = in_numbers(frame)
        assert float((numbers - numbers.round()).abs().max()) < 0.005  # float32 of 14 bits: 0.001
        # The nearest number, where float32 may be off by a hundredth of one before it rounds.
        assert float((numbers.round() - exact).abs().max()) <= 0.51
    clipped = [(frames[0] <= 2.0**-10).sum(), (frames[0] >= 1.0 - 1e-6).sum()]
    assert counts.tolist() == [[int(number) for number in clipped]]
    assert torch.equal(light, before)


@pytest.mark.parametrize(
    "body",
    [
        *map(get_camera, list_cameras()),
        *(
            CameraProfile("x", "RGGB", black, white, 16)  # type: ignore[arg-type]
            for black in ((0.0,) * 4, (64.5,) * 4, (3.0, 7.5, 0.0, 60.0))
            for white in (255.0, 65535.0)
        ),
    ],
    ids=str,
)
def test_every_digital_number_is_written_exactly(body: CameraProfile) -> None:
    numbers = np.arange(int(body.white_level) + 1)
    black, span = np.array(body.black_level)[:, None], np.array(body.span)[:, None]
    light = torch.from_numpy(((numbers - black) / span).astype(np.float32)).contiguous()
    outputs = {
        "codes": np.empty((1, 4, len(numbers)), np.uint8),
        "numbers": np.empty((1, 4, len(numbers)), np.uint16),
        "signals": np.empty((1, 4, len(numbers)), np.float32),
    }
    table = exposure_table([Exposure(1.0, CLEAN, CLEAN)])
    counts = record_frames([light[:, None]], table, body, **outputs)
    quantised = clip_and_quantise(light[:, None], body)[:, 0]
    np.testing.assert_array_equal(outputs["numbers"][0], np.tile(numbers, (4, 1)))
    np.testing.assert_array_equal(outputs["signals"][0], quantised.numpy())
    codes = np.sqrt((quantised.double().numpy().clip(-1 / 1024) + 1 / 1024) / (1 + 1 / 1024)) * 255
    np.testing.assert_allclose(outputs["codes"][0], codes, rtol=0, atol=0.5 + 1e-4)
    low, high = (quantised <= 2.0**-10).sum(), (quantised >= 1.0 - 1e-6).sum()
    assert counts.tolist() == [[int(low), int(high)]]


@pytest.mark.parametrize("kind", ["exact", "bank"])
def test_a_frame_is_the_same_alone_in_a_batch_and_on_any_number_of_threads(kind: Noise) -> None:
    """Planes of more than 65,536 samples, which are worked on in two pieces."""
    lights = [random_light(4, 250, 265, seed=i) for i in range(3)]
    exposures = [Exposure(0.6 * (i + 1), CLEAN, Z6.nlf(400 * 4**i)) for i in range(3)]
    keys, table = (
        noise_keys(np.arange(3), 2),
        Transitions.of(lights, exposures).before_rounding(Z6).table,
    )
    for threads in (1, 3):
        codes, signals = np.empty((3, 4, 66250), np.uint8), np.empty((3, 4, 66250), np.float32)
        outputs = {"codes": codes, "signals": signals}
        counts = record_frames(lights, table, Z6, keys=keys, noise=kind, **outputs, threads=threads)
        for i, light in enumerate(lights):
            alone = torch.empty(1, *light.shape)
            transitions = Transitions.of([light], [exposures[i]])
            drawn = {"keys": keys[i : i + 1], "noise": kind}
            assert not record(transitions, Z6, **drawn, signals=alone).any()  # not counted
            np.testing.assert_array_equal(signals[i], alone.reshape(4, -1).numpy())
            np.testing.assert_array_equal(codes[i], encode_observation(alone[0]).reshape(4, -1))
            clipped = [(alone <= 2.0**-10).sum(), (alone >= 1.0 - 1e-6).sum()]
            assert counts[i].tolist() == [int(number) for number in clipped]
    assert counts[1:, 1].min() > 10_000
    assert record_frames(lights, table, Z6, count=False).tolist() == [[0, 0]] * 3


def test_tables_hold_what_is_missing() -> None:
    source, target = Z6.nlf(800), Z6.nlf(1600)
    (table,) = exposure_table([Exposure(2.0, source, target)])
    assert table[0].tolist() == [2.0] * 4
    np.testing.assert_allclose(table[1], np.subtract(target.shot, np.multiply(source.shot, 2)))
    np.testing.assert_allclose(table[2], np.subtract(target.read, np.multiply(source.read, 4)))
    np.testing.assert_allclose(table[4], np.multiply(source.read, 4), rtol=1e-6)
    span, black, low, high, white = sensor_table(Z6)[:, 0].tolist()
    assert (span, black, low, high, white) == (14512.0, 1008.0, 1022.0, 15520.0, 15520.0)
