"""The terms against the published formulas and hand-checked values."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.optimize
import torch

from ae_env.scenes import Scene
from ae_env.scorers import make_scorer
from ae_env.scorers.captures import Scorer, reads_pixels
from ae_env.scorers.score_table import ScoreTables
from ae_env.scorers.terms import depends_on
from simulator import CameraSettings, NoiseLevelFunction
from tests.ae_env.scorer_images import CAMERA, GRID, make_captures, make_scene, random_scene


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 * (1.0 + np.tanh(0.5 * x))


def _by_the_formulas(
    scene: Scene, state: CameraSettings, speed: float, defocus: float
) -> dict[str, float]:
    """The scores of one state, in float64 and in the notation of the formulas."""

    def effective(settings: CameraSettings) -> float:  # recorded f-numbers are rounded
        return 2.0 ** (round(6 * np.log2(settings.f_number)) / 6)

    def exposure(settings: CameraSettings) -> float:
        return settings.exposure_time * settings.iso / effective(settings) ** 2

    alpha = exposure(state) / exposure(scene.reference)
    x = scene.light.numpy().astype(np.float64) * alpha
    height = x.shape[1]
    ev_state = np.log2(effective(state) ** 2 / state.exposure_time) - np.log2(state.iso / 100)
    if scene.illuminance is None:  # the EV at which the recorded green has a mean of 0.12
        green = scene.light.numpy()[1:3].astype(np.float64).mean(axis=0)
        factor = scipy.optimize.brentq(
            lambda f: np.minimum(green * f, 1.0).mean() - 0.12, 1e-6, 1e6, xtol=1e-14
        )
        e = np.log2(alpha / factor)
    else:
        e = np.log2(scene.illuminance / 2.5) - ev_state
    nlf = CAMERA.nlf(state.iso)
    shot, read = (np.array(v)[:, None, None] for v in (nlf.shot, nlf.read))
    # What an 8-bit code of the recorded value says of it.
    code = np.round(255 * np.sqrt((x.clip(max=1) + 2**-10) / (1 + 2**-10)))
    y = np.where(code > 8, (code / 255) ** 2 * (1 + 2**-10) - 2**-10, 0.0)
    fh = (code == 255).any(axis=0).mean()
    fs = _sigmoid(-(np.log2(y.clip(min=2**-40)) + 9) / 0.5).mean()
    snr = y / np.sqrt(shot * y + read)
    blur = np.hypot(
        speed * height * state.exposure_time, 4 * defocus * height / 64 / effective(state)
    )
    terms = {
        "brightness": np.exp(-(np.sqrt(1 + e**2) - 1)),
        "highlights": np.exp(-fh / 0.15),
        "shadows": np.exp(-fs / 0.20),
        "noise": (snr**1.5 / (snr**1.5 + 18**1.5)).mean(),
        "sharpness": 1 / (1 + (blur / (height / 64)) ** 2),
    }
    weights = {"brightness": 0.3, "highlights": 0.15, "shadows": 0.1, "noise": 0.2}
    weights["sharpness"] = 0.25
    product = np.prod([terms[name] ** weight for name, weight in weights.items()])
    return {**terms, "balanced": (1 - fh**4) * (1 - fs**4) * product}


@pytest.mark.parametrize("illuminance", [1000.0, None])
@pytest.mark.parametrize(("speed", "defocus"), [(0.0, 0.0), (0.3, 1.7)])
def test_scores_follow_the_formulas(
    illuminance: float | None, speed: float, defocus: float
) -> None:
    scene = random_scene(illuminance=illuminance)
    states = [GRID[i] for i in (0, 13, 22, 37, 42, 63)]
    captures = make_captures(scene, states, speed, defocus)
    images = captures.light.clamp(0.0, 1.0)
    expected = [_by_the_formulas(scene, state, speed, defocus) for state in states]
    for name in ("brightness", "highlights", "shadows", "noise", "sharpness", "balanced"):
        scorer = make_scorer(name)
        scores = scorer(images, captures)
        assert scores.dtype == torch.float64
        wanted = [scores_of_state[name] for scores_of_state in expected]
        np.testing.assert_allclose(scores.numpy(), wanted, rtol=2e-4, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("value", [1e-9, 1e4])
def test_black_and_white_frames_score_below_a_twentieth(value: float) -> None:
    captures = make_captures(make_scene(np.full((4, 40, 40), value)), list(GRID))
    images = captures.light.clamp(0.0, 1.0)
    assert make_scorer("balanced")(images, captures).sort().values[59] < 0.05  # of 64


def _table(scene: Scene, scorer: str = "balanced", **options: Any) -> np.ndarray:
    return ScoreTables(GRID, CAMERA, make_scorer(scorer), **options).table(scene).mean


def test_noise_is_that_of_the_cameras_own_pixels() -> None:
    """Box-averaging does not make ISO free: only a frame's values are less noisy."""
    wanted, found = (_table(random_scene(box_factor=k), "noise") for k in (1, 31))
    np.testing.assert_allclose(found, wanted, atol=0.01)


def test_values_by_hand() -> None:
    """Flat frames at white and at black, and a stop, 0.1 stop of bands, b0 of blur."""
    state = GRID[0]
    captures = make_captures(make_scene(np.full((4, 40, 40), 0.25)), [state] * 3)
    images = torch.tensor([1.0, 0.0, 0.25])[:, None, None, None].expand(3, 4, 40, 40)
    ev = captures.ev100
    captures = replace(captures, proper_ev=ev + torch.tensor([0.0, 1.0, -2.0]))
    captures = replace(captures, blur_px=torch.tensor([0.0, 40 / 64, 3 * 40 / 64]).double())
    expected = {
        "brightness": [1.0, math.exp(1 - math.sqrt(2)), math.exp(1 - math.sqrt(5))],
        "highlights": [math.exp(-1.0 / 0.15), 1.0, 1.0],
        "shadows": [1.0, math.exp(-1.0 / 0.2), 1.0],
        "sharpness": [1.0, 0.5, 0.1],
        "banding": [1.0, 1.0, 1.0],
    }
    for name, wanted in expected.items():
        found = make_scorer(name)(images, captures).tolist()
        assert found == pytest.approx(wanted, rel=2e-5, abs=1e-6), name


def test_noise_is_a_half_at_a_signal_to_noise_ratio_of_18() -> None:
    """With read noise alone SNR = x / sqrt(read), with shot noise alone sqrt(x / shot)."""
    captures = make_captures(make_scene(np.full((4, 40, 40), 0.5)), [GRID[0]] * 4)
    images, nothing = torch.ones(4, 4, 40, 40), (0.0,) * 4
    read, shot = (lambda v: NoiseLevelFunction(nothing, (v,) * 4)), 18.0**-2
    noises = [read(18.0**-2), read(18.0**-2 / 16), read(0.0), read(18.0**-2 / 16)]
    noises[2] = NoiseLevelFunction((shot,) * 4, nothing)
    captures = replace(captures, nlf=noises)
    wanted = [0.5, 8 / 9, 0.5, 8 / 9]
    assert make_scorer("noise")(images, captures).tolist() == pytest.approx(wanted, rel=1e-5)
    # A source that brings more noise than the settings have, or less.
    captures = replace(captures, source_noise=[read(18.0**-2 / 100)] * 3 + [read(18.0**-2)])
    wanted[3] = 0.5
    assert make_scorer("noise")(images, captures).tolist() == pytest.approx(wanted, rel=1e-5)
    captures = replace(captures, noisy=False)
    assert make_scorer("noise")(images, captures).tolist() == pytest.approx([1.0] * 4)


def test_bands_by_hand() -> None:
    """Half of the rows at 1.2 of the light, half at 0.8; brightness is the mean over the rows."""
    captures = make_captures(make_scene(np.full((4, 40, 40), 0.1)), [GRID[0]])
    rows = torch.tensor([1.2, 0.8], dtype=torch.float64).repeat_interleave(20)[None]
    captures = replace(captures, row_gain=rows, proper_ev=captures.ev100 + 1.0)
    spread = 0.5 * math.log2(1.2 / 0.8)
    assert make_scorer("banding")(None, captures).item() == pytest.approx(
        1 / (1 + (spread / 0.1) ** 2)
    )
    errors = [1 + math.log2(1.2), 1 + math.log2(0.8)]
    wanted = sum(math.exp(1 - math.sqrt(1 + e * e)) for e in errors) / 2
    assert make_scorer("brightness")(None, captures).item() == pytest.approx(wanted)
    dark = replace(captures, row_gain=torch.tensor([[1.0, 0.0]]).double())  # between pulses
    assert 0.0 < make_scorer("banding")(None, dark).item() < 1e-4


def test_terms_say_what_they_read() -> None:
    for name in ("brightness", "highlights", "shadows", "noise", "sharpness", "banding"):
        part = make_scorer(name).parts[name]
        assert (part.domain, isinstance(part, Scorer)) == ("raw", True)
        measured = name in ("highlights", "shadows", "noise")
        settled = "blur" if name == "sharpness" else "light"
        assert depends_on(part) == ("image" if measured else settled)
        assert reads_pixels(part) == measured
