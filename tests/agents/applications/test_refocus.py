from dataclasses import replace

import numpy as np
import pytest
import torch

from agents.applications.refocus import refocus
from simulator import (
    CameraSettings,
    CameraSimulator,
    Lens,
    NoiseLevelFunction,
    RawImage,
    get_camera,
)

NO_NOISE = NoiseLevelFunction((1e-12,) * 4, (1e-12,) * 4)
#: Pixel pitch such that packed pixels are 10 um.
CAMERA = replace(get_camera("nikon_z6"), pixel_pitch_um=5.0)
LENS = Lens(0.05, 2.0)
SETTINGS = CameraSettings(100, 1 / 64, 5.6)


def make_raw(light: torch.Tensor) -> RawImage:
    """A raw of this light, of a sensor without noise."""
    return RawImage(light, SETTINGS, CAMERA.with_nlf(100, NO_NOISE), nlf=NO_NOISE)


@pytest.fixture(scope="module")
def simulator() -> CameraSimulator:
    return CameraSimulator(device="cpu")


def disc_area(f_number: float, depth: float) -> float:
    """Packed pixels in the disc that the larger aperture adds to the blur at f/5.6, in theory."""
    # c = f^2 / N (1/s - 1/z) / (1 - f/s); marked 5.6 stands for 4 sqrt 2, 1.4 for sqrt 2.
    exact = {5.6: 2**2.5, 1.4: 2**0.5}
    discs = [
        0.05**2 / exact[n] * abs(1 / 2 - 1 / depth) / (1 - 0.05 / 2) / 10e-6
        for n in (f_number, 5.6)
    ]
    return np.pi / 4 * (discs[0] ** 2 - discs[1] ** 2)


def test_a_light_behind_the_focus_becomes_a_disc_that_keeps_its_energy(simulator) -> None:
    dark = 160.0 / CAMERA.span[0]  # whole digital numbers: rounding errors would add up
    light = torch.full((4, 161, 161), dark)
    light[:, 80, 80] = dark + 0.89
    raw = make_raw(light)
    out = refocus(raw, 1.4, depth=np.full((161, 161), 2.2), lens=LENS, simulator=simulator)
    disc = out.data[1, 68:93, 68:93].double() - dark
    assert out.settings.f_number == 1.4
    assert out.settings.exposure_time == pytest.approx(1 / 64 / 16)
    np.testing.assert_allclose(float(disc.sum()), 0.89, rtol=0.01)
    area = disc_area(1.4, 2.2)
    offset = torch.arange(25).double() - 12
    # A disc of area A has the second moment A / (4 pi) along each axis.
    for profile in (disc.sum(dim=0), disc.sum(dim=1)):
        moment = float((profile * offset**2).sum() / profile.sum())
        np.testing.assert_allclose(moment, area / (4 * np.pi), rtol=0.02)
    assert out.metadata["depth"] == "given"
    assert out.metadata["largest_disc_px"] == pytest.approx(np.sqrt(area / np.pi * 4), rel=1e-6)


def test_no_light_of_what_is_behind_falls_on_what_is_in_focus(simulator) -> None:
    light = torch.full((4, 64, 96), 0.8)
    light[:, :, :48] = 0.02
    depth = np.full((128, 192), 20.0)  # at the pitch of the sensor
    depth[:, :96] = 2.0
    out = refocus(make_raw(light), 1.4, depth=depth, lens=LENS, simulator=simulator)
    assert out.data[:, :, :48].equal(light[:, :, :48])  # kept bit by bit
    # Nor does the dark thing in front darken the wall behind it.
    np.testing.assert_allclose(out.data[:, :, 48:].numpy(), 0.8, atol=0.03)


def test_what_is_before_the_focus_spreads_over_what_is_sharp(simulator) -> None:
    light = torch.full((4, 64, 96), 0.8)
    light[:, :, :48] = 0.02
    depth = np.full((64, 96), 2.0)
    depth[:, :48] = 1.8
    out = refocus(make_raw(light), 1.4, depth=depth, lens=LENS, simulator=simulator).data
    profile = out[0, 32].numpy()
    assert profile[49] < 0.6
    assert profile[45] > 0.1
    np.testing.assert_allclose(profile[-8:], 0.8, rtol=1e-6)


def test_the_source_s_own_aperture_changes_nothing(simulator) -> None:
    light = torch.rand(4, 32, 40, generator=torch.Generator().manual_seed(0)) * 0.5
    out = refocus(
        make_raw(light), 5.6, depth=np.full((32, 40), 9.0), lens=LENS, simulator=simulator
    )
    assert out.data.equal(light)
    assert out.settings == SETTINGS


def test_what_is_blurred_has_the_noise_of_the_sensor() -> None:
    light = torch.full((4, 128, 128), 0.2)
    raw = RawImage(light, CameraSettings(6400, 1 / 64, 5.6), CAMERA)
    out = refocus(
        raw,
        1.4,
        depth=np.full((128, 128), 9.0),
        lens=LENS,
        simulator=CameraSimulator(device="cpu"),
        seed=1,
    )
    nlf = CAMERA.nlf(6400)
    for plane in range(4):
        expected = nlf.shot[plane] * 0.2 + nlf.read[plane]
        np.testing.assert_allclose(float(out.data[plane].var()), expected, rtol=0.05)


def test_a_sharp_picture_of_unknown_depth_stays_as_it_is() -> None:
    rng = torch.Generator().manual_seed(0)
    light = (torch.rand(4, 96, 96, generator=rng) * 0.5).round(decimals=1) + 0.05
    out = refocus(make_raw(light), 1.4, simulator=CameraSimulator.from_pretrained(device="cpu"))
    assert out.metadata["depth"] == "estimated"
    assert out.data.equal(light)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"f_number": 8.0}, "`f_number` .=8. must be at most that of the raw, 5.6"),
        ({"depth": np.ones((32, 40))}, "`depth` must come with both"),
        ({"lens": LENS}, "`lens` must come with both"),
        ({"depth": np.ones((40, 32)), "lens": LENS}, r"shape \(40, 32\)\) must be \(32, 40\)"),
        ({"depth": np.full((32, 40), 0.04), "lens": LENS}, "above the focal length"),
        ({"depth": np.full((32, 40), np.nan), "lens": LENS}, "above the focal length"),
    ],
)
def test_bad_arguments(simulator, arguments, message: str) -> None:
    raw = make_raw(torch.full((4, 32, 40), 0.1))
    with pytest.raises(ValueError, match=message):
        refocus(raw, **{"f_number": 1.4, "simulator": simulator, **arguments})


def test_an_unknown_pixel_pitch(simulator) -> None:
    camera = replace(CAMERA, pixel_pitch_um=None)
    raw = replace(make_raw(torch.full((4, 32, 40), 0.1)), camera=camera)
    with pytest.raises(ValueError, match="pixel pitch"):
        refocus(raw, 1.4, depth=np.full((32, 40), 9.0), lens=LENS, simulator=simulator)
