"""One capture by the fused kernel against the steps one by one, and the balance of its noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from simulator.camera import get_camera
from simulator.capture import kernels
from simulator.capture.exposure import Exposure
from simulator.capture.sensor import (
    Transitions,
    add_noise,
    clip_and_quantise,
    exposed_light,
    noise_balance,
    record,
)
from simulator.noise.generator import FrameNoise, Noise
from simulator.noise.noise_level_function import NoiseLevelFunction

Z6 = get_camera("nikon_z6")
SPAN = 14512


def recorded(
    light: torch.Tensor, exposure: Exposure, key: int, noise: Noise = "exact"
) -> torch.Tensor:
    """One frame (4, H, W) by the fused kernel."""
    frame, keys = torch.empty(1, *light.shape), np.array([key], np.uint64)
    record(Transitions.of([light], [exposure]), Z6, keys=keys, noise=noise, signals=frame)
    return frame[0]


@pytest.mark.parametrize("noisy_source", [False, True])
@pytest.mark.parametrize("blurred_noise", [False, True])
@pytest.mark.parametrize("iso", [100, 6400])
def test_recording_equals_the_steps_one_by_one(
    iso: float, noisy_source: bool, blurred_noise: bool
) -> None:
    """Within one digital number, where float32 decides a tie the other way."""
    rng = np.random.default_rng(0)
    light = torch.from_numpy(rng.normal(0.3, 0.4, (4, 96, 96)).astype(np.float32))
    light[:, 0] = torch.tensor([-1e30, 1e30, 3e38, 0.0]).repeat(24)
    source = Z6.nlf(400) if noisy_source else NoiseLevelFunction.zero()
    remaining = torch.rand(96, 96, generator=torch.Generator().manual_seed(1))
    exposure = Exposure(
        1.3, source, Z6.nlf(iso), motion_px=3.0, remaining_variance=remaining if blurred_noise else None
    )
    frame = recorded(light, exposure, 3)
    signal = exposed_light(light, exposure)
    noisy, _ = add_noise(signal[None], [exposure], [FrameNoise(3)])
    expected = clip_and_quantise(noisy[0], Z6)
    difference = ((frame - expected).double() * SPAN).abs().round()
    assert difference.max() <= 1
    assert float((difference > 0).double().mean()) <= 1e-4


def test_noise_from_the_bank_is_what_the_bank_reads() -> None:
    light = torch.full((4, 40, 50), 0.2)
    exposure = Exposure(1.0, NoiseLevelFunction.zero(), Z6.nlf(800))
    frame = recorded(light, exposure, 12345, "bank")
    noisy, _ = add_noise(light[None], [exposure], [FrameNoise(12345, "bank")])
    difference = ((frame - clip_and_quantise(noisy[0], Z6)).double() * SPAN).abs().round()
    assert difference.max() <= 1
    assert float((difference > 0).double().mean()) <= 1e-4


@pytest.mark.parametrize("iso", [100, 400, 6400])
@pytest.mark.parametrize("blurred_noise", [False, True])
def test_balance_of_noise_pixel_by_pixel(iso: float, blurred_noise: bool) -> None:
    rng = np.random.default_rng(0)
    light = rng.normal(0.2, 0.3, (4, 20, 20))
    share = rng.random((20, 20)) if blurred_noise else np.ones((20, 20))
    exposure = Exposure(
        2.0,
        Z6.nlf(800),
        Z6.nlf(iso),
        remaining_variance=torch.from_numpy(share.astype(np.float32)) if blurred_noise else None,
    )
    balance = noise_balance(torch.from_numpy(light.astype(np.float32)), exposure)
    first, second = Z6.nlf(800), Z6.nlf(iso)
    (shot1, read1), (shot2, read2) = (
        (np.array(n.shot)[:, None], np.array(n.read)[:, None]) for n in (first, second)
    )
    signal = 2.0 * np.maximum(light, 0.0)
    given = share * (4 * read1[..., None] + 2 * shot1[..., None] * signal)
    wanted = read2[..., None] + shot2[..., None] * signal
    beyond = np.maximum(given - wanted, 0.0)
    assert balance.relative_excess_variance == pytest.approx((beyond / wanted).mean(), rel=1e-4, abs=1e-7)
    assert balance.excess_variance == pytest.approx(beyond.mean(), rel=1e-4, abs=1e-12)
    assert balance.lacks_noise == bool((wanted > given).any())


def test_a_source_without_noise_lacks_all_of_it() -> None:
    zero = NoiseLevelFunction.zero()
    light = torch.full((4, 4, 4), 0.5)
    balance = noise_balance(light, Exposure(1.0, zero, Z6.nlf(100)))
    assert (balance.relative_excess_variance, balance.excess_variance, balance.lacks_noise) == (0.0, 0.0, True)
    assert not noise_balance(light, Exposure(1.0, zero, zero)).lacks_noise


@pytest.mark.parametrize("source", [100, 6400])
def test_noise_is_made_only_where_the_source_lacks_some(
    source: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []
    original = kernels.record_frames

    def watched(*args: Any, keys: Any, **options: Any) -> Any:
        made.append(keys)
        return original(*args, keys=keys, **options)

    monkeypatch.setattr(kernels, "record_frames", watched)
    light = torch.full((4, 8, 8), 0.2)
    exposure = Exposure(1.0, Z6.nlf(source), Z6.nlf(100))
    recorded(light, exposure, 3)
    recorded(light, Exposure(1.0, Z6.nlf(source), Z6.nlf(12800)), 3)
    assert [keys is None for keys in made] == [True, False]
