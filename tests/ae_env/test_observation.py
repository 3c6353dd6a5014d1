"""The observation's encodings and their inverses."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from ae_env.observation import (
    PEDESTAL,
    decode_observation,
    decode_sensors,
    decode_settings,
    encode_observation,
    encode_sensors,
    encode_settings,
)


def test_codes_follow_the_formula() -> None:
    p = 1 / 1024
    for x in (-1.0, -p, -0.0005, 0.0, 1e-4, 0.119, 0.5, 1.0, 7.0):
        clipped = min(max(x, -p), 1.0)
        expected = round(255 * math.sqrt((clipped + p) / (1 + p)))
        assert int(encode_observation(torch.tensor([x]))[0]) == expected
    assert p == PEDESTAL


def test_every_code_survives_the_round_trip() -> None:
    codes = np.arange(256, dtype=np.uint8)
    signal = decode_observation(codes)
    assert signal.dtype == np.float32
    np.testing.assert_array_equal(encode_observation(torch.from_numpy(signal)).numpy(), codes)
    assert decode_observation(codes.reshape(4, 8, 8)).shape == (4, 8, 8)


def test_decoding_is_within_half_a_code() -> None:
    x = torch.linspace(-PEDESTAL, 1, 10_001)
    error = np.abs(decode_observation(encode_observation(x).numpy()) - x.numpy())
    step = 2 * np.sqrt((x.numpy() + PEDESTAL) * (1 + PEDESTAL)) / 255 + 1 / 255**2
    assert (error <= 0.5 * step + 1e-6).all()


def test_encoding_leaves_its_input_alone() -> None:
    x = torch.tensor([0.25, 2.0])
    encode_observation(x)
    assert x.tolist() == [0.25, 2.0]


def test_settings_map_fixed_ranges() -> None:
    apex = np.array([[0.0, -5.0, 4.0], [10.0, 15.0, 17.0], [5.0, 5.0, 10.5], [-9.0, 99.0, 4.0]])
    encoded = encode_settings(apex)
    assert encoded.dtype == np.float32
    np.testing.assert_allclose(encoded, [[-1] * 3, [1] * 3, [0] * 3, [-1, 1, -1]], atol=1e-7)
    for got, expected in zip(decode_settings(encoded[:3]), apex[:3].T, strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-6)


def test_ev100_of_the_settings() -> None:
    # f/8, 1/125 s, ISO 400: EV100 = log2(64 * 125) - 2
    apex = np.array([6.0, math.log2(125), math.log2(400 / 3.125)])
    av, tv, sv = decode_settings(encode_settings(apex))
    assert av + tv - (sv - 5) == pytest.approx(math.log2(64 * 125) - 2, abs=1e-5)


def test_sensors_map_logarithms_and_invert() -> None:
    speed, defocus = np.array([0.0, 2.0**-9, 2.0**-3, 8.0]), np.array([0.0625, 1.0, 4.0, 16.0])
    sensors = encode_sensors(speed, defocus, np.zeros((4, 2)))
    np.testing.assert_allclose(sensors[:, 0], [-1, -1, 0, 1], atol=1e-6)
    np.testing.assert_allclose(sensors[:, 1], [-1, 0, 0.5, 1], atol=1e-6)
    again_speed, again_defocus = decode_sensors(sensors)
    np.testing.assert_allclose(again_speed, [0, 0, 0.125, 8], rtol=1e-5)
    np.testing.assert_allclose(again_defocus, defocus, rtol=1e-5)


def test_sensor_noise_is_fifteen_percent() -> None:
    noise = np.random.default_rng(0).standard_normal((20_000, 2))
    sensors = encode_sensors(np.full(20_000, 0.25), np.full(20_000, 1.0), noise)
    for values, truth in zip(decode_sensors(sensors), (0.25, 1.0), strict=True):
        assert np.log(values / truth).std() == pytest.approx(0.15, rel=0.03)
        assert np.log(values / truth).mean() == pytest.approx(0.0, abs=0.005)
