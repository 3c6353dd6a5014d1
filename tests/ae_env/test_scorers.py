"""The scorers against the published formulas, their composition, registry and errors."""

from __future__ import annotations

import sys
import types
from importlib.metadata import EntryPoint
from typing import Any

import numpy as np
import pytest
import scipy.optimize
import torch

from ae_env.grid import ExposureGrid
from ae_env.scenes import Scene, reference_settings
from ae_env.scorers import CompositeScorer, list_scorers, make_scorer, register_scorer, registry
from ae_env.scorers.captures import describe_captures
from ae_env.scorers.protocol import Captures, Scorer
from ae_env.scorers.score_table import ScoreTables
from simulator import CameraSettings, NoiseLevelFunction, get_camera, incident_ev100

CAMERA = get_camera("nikon_z6")
GRID = ExposureGrid.default()


def _scene(light: np.ndarray, illuminance: float | None = 1000.0, **fields: Any) -> Scene:
    reference = reference_settings(incident_ev100(illuminance or 1000.0))
    return Scene.from_array(
        torch.from_numpy(light.astype(np.float32)),
        reference,
        CAMERA,
        scene_id="test",
        illuminance=illuminance,
        **fields,
    )


def _random_scene(seed: int = 0, **fields: Any) -> Scene:
    rng = np.random.default_rng(seed)
    return _scene(0.12 * np.exp(rng.normal(0.0, 1.2, (4, 40, 40))), **fields)


def _captures(scene: Scene, states: list[CameraSettings], speed: float, defocus: float) -> Captures:
    count = len(states)
    return describe_captures(
        [scene] * count,
        states,
        CAMERA,
        speed=np.full(count, speed),
        defocus=np.full(count, defocus),
        gain=np.ones(count),
    )


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
    fh = _sigmoid(np.log2(x) / 0.12).max(axis=0).mean()
    fs = _sigmoid(-(np.log2(x) + 9) / 0.5).mean()
    snr = np.minimum(x, 1) / np.sqrt(shot * x + read)
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
    scene = _random_scene(illuminance=illuminance)
    states = [GRID[i] for i in (0, 13, 22, 37, 42, 63)]
    captures = _captures(scene, states, speed, defocus)
    expected = [_by_the_formulas(scene, state, speed, defocus) for state in states]
    for name in ("brightness", "highlights", "shadows", "noise", "sharpness", "balanced"):
        scorer = make_scorer(name)
        scores = scorer(None, captures)
        assert scores.dtype == torch.float64
        assert scorer.closed_form
        wanted = [scores_of_state[name] for scores_of_state in expected]
        np.testing.assert_allclose(scores.numpy(), wanted, rtol=2e-4, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("value", [1e-9, 1e4])
def test_black_and_white_frames_score_below_a_twentieth(value: float) -> None:
    captures = _captures(_scene(np.full((4, 40, 40), value)), list(GRID.states), 0.0, 0.0)
    scores = make_scorer("balanced")(None, captures)
    parts = make_scorer("balanced").score_parts(None, captures)
    blown = -0.15 * parts["highlights"].log()
    blocked = -0.20 * parts["shadows"].log()
    extreme = torch.maximum(blown, blocked) >= 0.98
    assert extreme.sum() >= 60
    assert scores[extreme].max() < 0.05


def test_zero_light_and_huge_light_stay_finite() -> None:
    light = np.zeros((4, 40, 40))
    light[:, :20] = 1e8
    captures = _captures(_scene(light), list(GRID.states), 100.0, 8.0)
    for name in ("brightness", "highlights", "shadows", "noise", "sharpness", "balanced"):
        scores = make_scorer(name)(None, captures)
        assert bool(torch.isfinite(scores).all())
        assert 0 <= float(scores.min()) <= float(scores.max()) <= 1


def _sweep(name: str, states: list[CameraSettings], **blur: float) -> np.ndarray:
    captures = _captures(_random_scene(), states, blur.get("speed", 0.0), blur.get("defocus", 0.0))
    return make_scorer(name)(None, captures).numpy()


def test_scores_go_the_way_a_photographer_expects() -> None:
    longer = [CameraSettings(100, 2.0**-i, 4) for i in range(12, 0, -1)]
    assert (np.diff(_sweep("highlights", longer)) <= 0).all()
    assert (np.diff(_sweep("shadows", longer)) >= 0).all()
    assert (np.diff(_sweep("noise", longer[:-2])) > 0).all()  # the last two are mostly white
    assert (np.diff(_sweep("sharpness", longer, speed=0.2)) < 0).all()
    brightness = _sweep("brightness", longer)
    best = brightness.argmax()
    assert (np.diff(brightness[: best + 1]) > 0).all()
    assert (np.diff(brightness[best:]) < 0).all()


def test_gain_and_aperture_have_their_price() -> None:
    faster = [CameraSettings(100 * 2**i, 1 / 8 / 2**i, 8) for i in range(4)]  # one brightness
    assert (np.diff(_sweep("noise", faster)) < 0).all()
    assert (np.diff(_sweep("balanced", faster)) < 0).all()
    opened = [CameraSettings(100, 1 / 64, f_number) for f_number in (11, 8, 5.6, 4)]
    assert (np.diff(_sweep("sharpness", opened, defocus=2.0)) < 0).all()


def test_noise_is_that_of_the_sensors_own_pixels() -> None:
    """Box-averaging must not make ISO free: the same light scores the same at any box factor."""
    states = list(GRID.states)
    plain = make_scorer("noise")(None, _captures(_random_scene(), states, 0.0, 0.0))
    boxed = make_scorer("noise")(None, _captures(_random_scene(box_factor=31), states, 0.0, 0.0))
    assert torch.equal(plain, boxed)


class Mean:
    domain = "raw"

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        return images.mean(dim=(1, 2, 3))


class Picture:
    domain = "srgb"

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        assert images.shape[1] == 3
        return images.amax(dim=(1, 2, 3))


def _images(count: int = 3) -> torch.Tensor:
    return torch.rand(count, 4, 40, 40, generator=torch.Generator().manual_seed(0))


def test_a_mapping_is_the_weighted_mean() -> None:
    captures = _captures(_random_scene(), [GRID[i] for i in (3, 20, 50)], 0.1, 1.0)
    mixed = make_scorer({"noise": 3.0, "highlights": 1.0})
    expected = 0.75 * make_scorer("noise")(None, captures)
    expected += 0.25 * make_scorer("highlights")(None, captures)
    torch.testing.assert_close(mixed(None, captures), expected)
    assert mixed.closed_form
    assert mixed.depends_on == "light"
    assert make_scorer("balanced").depends_on == "blur"


def test_callables_see_the_view_they_ask_for(monkeypatch: pytest.MonkeyPatch) -> None:
    captures = _captures(_random_scene(), [GRID[20]] * 3, 0.0, 0.0)
    images = _images()
    scorer = make_scorer(Mean())
    assert not scorer.closed_form
    torch.testing.assert_close(scorer(images, captures), images.mean(dim=(1, 2, 3)).double())
    scores = CompositeScorer({"raw": Mean(), "picture": Picture()}).score_parts(images, captures)
    assert 0 < float(scores["picture"].min()) <= 1
    # Nothing is developed where nobody asks for sRGB.
    monkeypatch.setattr("ae_env.scorers.composite.develop", None)
    make_scorer(Mean())(images, captures)
    with pytest.raises(ValueError, match="needs `images`"):
        make_scorer(Mean())(None, captures)


@pytest.fixture
def clean_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))


@pytest.mark.usefixtures("clean_registry")
def test_registered_scorers_work_by_name() -> None:
    register_scorer("mean_signal")(Mean)
    register_scorer("mean_signal")(Mean)  # a notebook cell run twice
    assert "mean_signal" in list_scorers()
    assert list(make_scorer("mean_signal").parts) == ["mean_signal"]
    assert list(make_scorer({"mean_signal": 1, "noise": 1}).parts) == ["mean_signal", "noise"]
    with pytest.raises(ValueError, match="built-in"):
        register_scorer("noise")(Mean)
    with pytest.raises(ValueError, match="identifier"):
        register_scorer("my score")


def test_scorers_of_other_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    module = types.ModuleType("some_package")
    module.Mean = Mean  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "some_package", module)
    point = EntryPoint("outside", "some_package:Mean", registry.ENTRY_POINT_GROUP)
    monkeypatch.setattr(registry, "entry_points", lambda group: [point])
    assert "outside" in list_scorers()
    assert list(make_scorer("outside").parts) == ["outside"]
    assert isinstance(make_scorer("some_package:Mean").parts["Mean"], Mean)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("balancd", "did you mean 'balanced'"),
        ("no_such_module:Thing", "cannot be loaded: "),
        ("ae_env.scorers.terms:Nothing", "cannot be loaded: "),
        ("math:pi", "must be callable"),
        ({}, "weights"),
        ({"noise": 0.0}, "must all be > 0"),
        ({"noise": float("nan")}, "must all be > 0"),
        (lambda images, captures: None, "must be 'raw' or 'srgb'"),
        (3, "name, a mapping of weights or a callable"),
    ],
)
def test_bad_scorers_are_refused(spec: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_scorer(spec)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (torch.zeros(2), r"must return a tensor \(3,\)"),
        (0.5, "must return a tensor"),
        (torch.tensor([0.0, 0.5, 1.5]), r"rule is \[0, 1\]"),
        (torch.tensor([0.0, 0.5, float("nan")]), r"rule is \[0, 1\]"),
    ],
)
def test_bad_scores_are_refused(returned: Any, message: str) -> None:
    class Bad:
        domain = "raw"

        def __call__(self, images: torch.Tensor, captures: Captures) -> Any:
            return returned

    captures = _captures(_random_scene(), [GRID[20]] * 3, 0.0, 0.0)
    with pytest.raises(ValueError, match=message):
        make_scorer(Bad())(_images(), captures)


def test_built_in_scorers_satisfy_the_protocol() -> None:
    for name in ("balanced", "brightness", "highlights", "shadows", "noise", "sharpness"):
        assert name in list_scorers()
        assert isinstance(make_scorer(name), Scorer)
        assert all(isinstance(part, Scorer) for part in make_scorer(name).parts.values())


def test_noise_level_of_a_noisy_source_does_not_enter_the_score() -> None:
    nlf = NoiseLevelFunction((1e-4,) * 4, (1e-6,) * 4)
    clean, noisy = _random_scene(), _random_scene(nlf=nlf)
    first = ScoreTables(GRID, CAMERA, make_scorer("balanced"), use_cache=False).table(clean)
    second = ScoreTables(GRID, CAMERA, make_scorer("balanced"), use_cache=False).table(noisy)
    np.testing.assert_array_equal(first.mean, second.mean)
