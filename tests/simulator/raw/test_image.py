import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from simulator import CameraProfile, CameraSettings, NoiseLevelFunction, RawImage, get_camera
from simulator.raw.image import pack_mosaic, unpack_mosaic
from tests.strategies import cameras, mosaics

SETTINGS = CameraSettings(100, 1 / 64, 4.0)
BLACK = (64.0, 60.25, 59.5, 63.0)  # R, G1, G2, B


def camera(cfa: str = "RGGB", black: tuple[float, ...] | float = BLACK) -> CameraProfile:
    return CameraProfile("bench", cfa, black, 4095, 12)


@given(mosaics(cameras()), st.booleans(), st.booleans())
def test_packing_and_unpacking_invert(mosaic, odd, as_float):
    profile, numbers = mosaic
    given_numbers = np.pad(numbers, ((0, odd), (0, odd))).astype(float if as_float else np.uint16)
    packed = pack_mosaic(given_numbers, profile)
    assert packed.shape == (4, numbers.shape[0] // 2, numbers.shape[1] // 2)
    np.testing.assert_array_equal(unpack_mosaic(packed, profile), numbers)
    raw = RawImage.from_mosaic(given_numbers, SETTINGS, profile)
    np.testing.assert_array_equal(raw.to_mosaic(), numbers)
    first = len(numbers) // 4  # a part of the rows
    np.testing.assert_array_equal(unpack_mosaic(packed, profile, first), numbers[2 * first :])
    for plane, letter in enumerate("RGGB"):  # each plane is where the camera says
        row, column = profile.cfa.offsets[plane]
        assert profile.cfa.value[2 * row + column] == letter
        wanted = (numbers[row::2, column::2] - profile.black_level[plane]) / profile.span[plane]
        np.testing.assert_array_equal(packed[plane].numpy(), wanted.astype(np.float32))


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize("dtype", [np.uint16, np.int32, np.float32, ">u2"])
def test_any_layout_of_a_mosaic_is_packed_alike(cfa, dtype):
    whole = np.random.default_rng(4).integers(0, 4096, (300, 40)).astype(dtype)
    visible = whole[3:295, 5:34]  # odd columns, more rows than are converted at a time
    plain = pack_mosaic(np.array(visible.tolist(), np.uint16), camera(cfa))
    for each in (visible, np.array(visible.T, order="C").T):
        assert torch.equal(pack_mosaic(each, camera(cfa)), plain)


def test_unpack_clips_to_the_sensor_and_rounds():
    data = torch.tensor([-9.0, 9.0, 0.4 / 4031, 0.6 / 4031]).reshape(4, 1, 1)
    numbers = unpack_mosaic(data, camera(black=64))
    assert numbers.tolist() == [[0, 4095], [64, 65]]


@pytest.mark.parametrize("shape", [(4,), (1, 8), (8, 1), (2, 2, 2), (0, 4)])
def test_bad_mosaic(shape):
    with pytest.raises(ValueError, match="`mosaic`"):
        pack_mosaic(np.zeros(shape, np.uint16), camera())


BAD = {
    "data": [
        torch.zeros(3, 4, 4),
        torch.zeros(4, 4),
        torch.zeros(4, 0, 4),
        torch.full((4, 2, 2), math.nan),
        torch.full((4, 2, 2), 1e300, dtype=torch.float64),  # beyond float32
    ],
    "white_balance": [(1.0, 1.0), *((1.0, v, 1.0) for v in (0.0, -1.0, math.nan))],
    "camera": ["nikon_z6"],
    "settings": [(100, 0.01)],
    "nlf": [(1e-4, 1e-6)],
    "box_factor": [0, 1.5],
}


@pytest.mark.parametrize(("name", "value"), [(n, v) for n, values in BAD.items() for v in values])
def test_bad_arguments(name, value):
    usual = {"data": torch.zeros(4, 2, 2), "settings": SETTINGS, "camera": camera()}
    with pytest.raises(ValueError, match=f"`{name}`"):
        RawImage(**(usual | {name: value}))


def test_noise_is_the_files_own_before_the_cameras():
    z6, data = get_camera("nikon_z6"), torch.zeros(4, 2, 2)
    assert RawImage(data, SETTINGS, z6).noise.shot[1] == pytest.approx(7.47234302281224e-06)
    own = NoiseLevelFunction((1e-3,) * 4, (1e-6,) * 4)
    assert RawImage(data, SETTINGS, z6, nlf=own).noise == own
    assert RawImage(data.double(), SETTINGS, z6).data.dtype == torch.float32
    averaged = RawImage(data, SETTINGS, z6, nlf=own, box_factor=4)
    assert averaged.noise.shot == pytest.approx((1e-3 / 16,) * 4)
    assert averaged.noise.read == pytest.approx((1e-6 / 16,) * 4)
    with pytest.raises(ValueError, match="no noise calibration"):
        _ = RawImage(data, SETTINGS, camera()).noise


@pytest.mark.parametrize("rows", [1, 127, 300])
def test_saturated_pixels_of_frames_in_shares(rows):
    """Each plane has a limit of its own; NumPy marks the same pixels."""
    limits = [1 - 0.5 / (4095 - black) for black in BLACK]
    levels = np.random.default_rng(6).uniform(0.9995, 1.0001, (4, 9, rows)).astype(np.float32)
    data = levels.transpose(0, 2, 1)  # not in the order of memory
    expected = np.any(data >= np.array(limits, np.float32)[:, None, None], axis=0)
    assert 0 < expected.mean() < 1
    raw = RawImage(torch.from_numpy(data), SETTINGS, camera())
    np.testing.assert_array_equal(raw.saturated, expected)
