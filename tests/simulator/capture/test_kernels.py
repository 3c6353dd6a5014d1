"""The fused kernel against the steps of `simulator.capture.sensor`, and hand-made numbers."""

from __future__ import annotations

import itertools
import subprocess
import sys

import numpy as np
import pytest
import torch

from ae_env.observation import encode_observation
from simulator.camera import CameraProfile, get_camera, list_cameras
from simulator.capture.exposure import Exposure, exposure_table
from simulator.capture.kernels import record_frames, sensor_table
from simulator.capture.sensor import Transitions, clip_and_quantise, record
from simulator.noise.generator import Noise, frame_normals, noise_keys
from simulator.noise.noise_level_function import NoiseLevelFunction

Z6 = get_camera("nikon_z6")
CLEAN = NoiseLevelFunction.zero()


def random_light(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed)) * 1.5 - 0.01


def captured(
    light: torch.Tensor,
    exposure: Exposure,
    camera: CameraProfile = Z6,
    key: int | None = None,
    kind: Noise = "exact",
) -> torch.Tensor:
    """One frame (4, H, W)."""
    frame = torch.empty(1, *light.shape)
    keys = None if key is None else np.array([key], np.uint64)
    record(Transitions.of([light], [exposure]), camera, keys=keys, noise=kind, signals=frame)
    return frame[0]


def reference(light: torch.Tensor, exposure: Exposure, normals: torch.Tensor) -> torch.Tensor:
    """The capture in float64, from the formulas of the noise top-up: numbers before rounding."""
    x = (light.double() * exposure.ratio).clamp(-1e6, 1e6)
    source, target = exposure.source_noise, exposure.target

    def variance(nlf: NoiseLevelFunction) -> torch.Tensor:
        shot, read = (torch.tensor(v, dtype=torch.float64) for v in (nlf.shot, nlf.read))
        return read[:, None, None] + shot[:, None, None] * x.clamp(min=0.0)

    share = exposure.remaining_variance
    left = 1.0 if share is None else share.double()
    missing = (variance(target) - left * variance(source)).clamp(min=0.0)
    return in_numbers(x + missing.sqrt() * normals.double()).clamp(0.0, Z6.white_level)


def in_numbers(signal: torch.Tensor) -> torch.Tensor:
    """Digital numbers of `signal` (4, H, W), in float64 and not rounded."""
    span, black = (torch.tensor(v, dtype=torch.float64) for v in (Z6.span, Z6.black_level))
    return signal.double() * span[:, None, None] + black[:, None, None]


@pytest.mark.parametrize("size", [(1, 1), (5, 3), (37, 53), (16, 16), (128, 128), (300, 500)])
@pytest.mark.parametrize("noisy_source", [False, True])
@pytest.mark.parametrize("blurred", [False, True])
@pytest.mark.parametrize("kind", ["exact", "bank"])
def test_captures_are_those_of_the_reference(
    size: tuple[int, int], noisy_source: bool, blurred: bool, kind: Noise
) -> None:
    light = random_light(4, *size)
    exposure = Exposure(
        ratio=0.4,
        source=Z6.nlf(1600) if noisy_source else CLEAN,
        target=Z6.nlf(400),
        remaining_variance=random_light(*size, seed=1).clamp(0.0, 1.0) if blurred else None,
    )
    key = int(noise_keys(5, 3)[0])
    normals = torch.from_numpy(frame_normals(key, (4, *size), kind))
    numbers = in_numbers(captured(light, exposure, key=key, kind=kind))
    assert float((numbers - numbers.round()).abs().max()) < 0.005  # float32 holds 14 bits to 0.001
    # The nearest number, where float32 may be off by a hundredth of one before it rounds.
    rounding = (numbers.round() - reference(light, exposure, normals)).abs()
    assert float(rounding.max()) <= 0.51


@pytest.mark.parametrize("camera", list_cameras())
def test_every_digital_number_is_written_exactly(camera: str) -> None:
    body = get_camera(camera)
    numbers = np.arange(int(body.white_level) + 1)
    black, span = np.array(body.black_level)[:, None], np.array(body.span)[:, None]
    light = torch.from_numpy(((numbers - black) / span).astype(np.float32)).contiguous()
    outputs = {
        "codes": np.empty((1, 4, len(numbers)), np.uint8),
        "numbers": np.empty((1, 4, len(numbers)), np.uint16),
        "signals": np.empty((1, 4, len(numbers)), np.float32),
    }
    counts = record_frames(
        [light[:, None]],
        exposure_table([Exposure(1.0, CLEAN, CLEAN)]),
        body,
        **outputs,
    )
    quantised = clip_and_quantise(light[:, None], body)[:, 0]
    np.testing.assert_array_equal(outputs["numbers"][0], np.tile(numbers, (4, 1)))
    np.testing.assert_array_equal(outputs["signals"][0], quantised.numpy())
    np.testing.assert_array_equal(outputs["codes"][0], encode_observation(quantised).numpy())
    low, high = (quantised <= 2.0**-10).sum(), (quantised >= 1.0 - 1e-6).sum()
    assert counts.tolist() == [[int(low), int(high)]]


@pytest.mark.parametrize("kind", ["exact", "bank"])
def test_a_frame_is_the_same_alone_in_a_batch_and_on_any_number_of_threads(kind: Noise) -> None:
    lights = [random_light(4, 70, 90, seed=i) for i in range(5)]
    isos = (100, 400, 1600, 6400, 400)
    exposures = [Exposure(0.1 * (i + 1), CLEAN, Z6.nlf(iso)) for i, iso in enumerate(isos)]
    keys, frames = noise_keys(np.arange(5), 2), []
    for threads in (1, 2, 3):
        codes = np.empty((5, 4, 6300), np.uint8)
        table = exposure_table(exposures)
        drawn = {"keys": keys, "noise": kind}
        record_frames(lights, table, Z6, **drawn, codes=codes, threads=threads)
        frames.append(codes)
    for i, (light, exposure) in enumerate(zip(lights, exposures, strict=True)):
        frame = captured(light, exposure, key=int(keys[i]), kind=kind)
        alone = encode_observation(frame)
        for codes in frames:
            np.testing.assert_array_equal(codes[i], alone.reshape(4, -1).numpy())


def test_tables_hold_what_is_missing() -> None:
    source, target = Z6.nlf(800), Z6.nlf(1600)
    (table,) = exposure_table([Exposure(2.0, source, target)])
    assert table[0].tolist() == [2.0] * 4
    np.testing.assert_allclose(table[1], np.subtract(target.shot, np.multiply(source.shot, 2)))
    np.testing.assert_allclose(table[2], np.subtract(target.read, np.multiply(source.read, 4)))
    np.testing.assert_allclose(table[4], np.multiply(source.read, 4), rtol=1e-6)
    span, black, low, high, white = sensor_table(Z6)[:, 0].tolist()
    assert (span, black, low, high, white) == (14512.0, 1008.0, 1022.0, 15520.0, 15520.0)


def test_black_level_may_be_zero_or_odd() -> None:
    for black, white in itertools.product((0.0, 64.5), (255.0, 65535.0)):
        body = CameraProfile("x", "RGGB", (black,) * 4, white, 16)  # type: ignore[arg-type]
        light = random_light(4, 9, 9)
        found = captured(light, Exposure(1.0, CLEAN, CLEAN), body)
        assert torch.equal(found, clip_and_quantise(light, body))


def test_packages_import_neither_torch_nor_numba() -> None:
    code = "import sys, ae_env, simulator; print({'torch', 'numba'} & set(sys.modules))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "set()"
