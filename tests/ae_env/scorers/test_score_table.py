"""Score tables: expectations over noise, their errors, the oracle, and terms from frames' codes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from ae_env.grid import ExposureGrid
from ae_env.observation import encode_observation
from ae_env.scenes import Scene
from ae_env.scorers import CompositeScorer, make_scorer
from ae_env.scorers.captures import prepare_scene, source_noises
from ae_env.scorers.score_table import ScoreTables
from ae_env.scorers.term_scores import TermScores
from ae_env.scorers.terms import Highlights, Noise
from simulator.capture.prepared_scene import Layout
from simulator.capture.sensor import clip_and_quantise
from simulator.optics.motion import Movement
from tests.ae_env.scorer_images import CAMERA, GRID, Own, make_captures, make_scene

SMALL = ExposureGrid((100, 1600), (1 / 500, 1 / 30), (4, 8))


def _scene() -> Scene:
    return make_scene(0.12 * np.exp(np.random.default_rng(0).normal(0.0, 1.0, (4, 40, 40))), 640.0)


def _flat(value: float) -> Scene:
    return make_scene(np.full((4, 40, 40), value), 640.0)


def _light(scene: Scene, grid: ExposureGrid) -> np.ndarray:
    """What the states record of light that `scene.reference` records as 1."""
    return 2.0 ** (np.array([s.log2_exposure for s in grid]) - scene.reference.log2_exposure)


def _tables(scorer: Any = "balanced", **options: Any) -> ScoreTables:
    given = {"grid": SMALL, "camera": CAMERA, "scorer": make_scorer(scorer), **options}
    return ScoreTables(**given)


def test_standard_error_is_that_of_the_sensor_noise() -> None:
    scene, grid = _flat(0.3), ExposureGrid((100,), (1 / 1000, 1 / 250), (4,))
    first_pixel = Own(lambda images, _: images[:, 1, 0, 0])
    table = _tables(first_pixel, grid=grid, noise_seeds=400).table(scene)
    nlf, light = CAMERA.nlf(100), 0.3 * _light(scene, grid)
    sigma = np.sqrt(nlf.read[1] + nlf.shot[1] * light)
    # The spread of 400 normals is known to 1 / sqrt(2 * 399) = 3.5 %; quantisation adds a bit.
    np.testing.assert_allclose(table.standard_error, sigma / np.sqrt(400), rtol=0.13)
    clean = _tables(first_pixel, grid=grid, noise=False).table(scene)
    np.testing.assert_allclose(clean.mean, light, atol=1e-4)
    assert clean.standard_error == pytest.approx(0.0)


def test_mixed_scorer_averages_only_what_is_noisy() -> None:
    noise = make_scorer("noise").parts["noise"]
    scorer = CompositeScorer({"mean": Own(), "noise": noise})
    table = _tables(scorer, noise_seeds=4).table(_scene())
    closed = _tables("noise").table(_scene())
    assert (table.standard_error > 0).all()
    assert (closed.standard_error == 0).all()
    np.testing.assert_array_equal(table.parts["noise"], closed.parts["noise"])
    np.testing.assert_allclose(table.mean, 0.5 * (table.parts["mean"] + table.parts["noise"]))
    first, second = (_tables(Own(), noise_seeds=1).table(_scene()) for _ in range(2))
    np.testing.assert_array_equal(first.mean, second.mean)
    assert np.isnan(first.standard_error).all()  # unknown from one seed
    for name, value in (("noise_seeds", 0), ("tolerance", -1.0)):
        with pytest.raises(ValueError, match=f"`{name}`"):
            _tables(**{name: value})


def test_oracle_is_the_best_state_and_ties_go_to_the_lower_iso() -> None:
    table = _tables().table(_scene())
    assert table.mean[table.oracle] == table.mean.max()
    assert (table.mean.shape, table.mean.dtype) == ((8,), np.float64)
    assert set(table.parts) == {"brightness", "highlights", "shadows", "noise", "sharpness"}
    # Under `brightness` alone all states of one EV are alike: ISO 100 at 1/25 s equals ISO 400
    # at 1/100 s and ISO 1600 at 1/400 s; times that are no powers of two round differently.
    grid = ExposureGrid((100, 400, 1600), (1 / 400, 1 / 100, 1 / 25), (4, 8))
    for ev100 in np.arange(2.0, 16.0, 0.37):
        scene = replace(_scene(), illuminance=2.5 * 2.0**ev100)
        best = _tables("brightness", grid=grid).table(scene)
        alike = np.flatnonzero(best.mean > best.mean.max() - 1e-7)
        assert best.oracle == alike[0]


def test_bands_count_whatever_form_the_gain_has() -> None:
    scene, rows = _flat(0.05), np.full((8, 40), 1.9)
    rows[:, 20:] = 0.1
    # Half of the rows each: the standard deviation is half the distance, 2.124 stops.
    banding = 1.0 / (1.0 + (np.log2(1.9 / 0.1) / 2.0 / 0.1) ** 2)
    for gain in (1.0, 0.5, np.ones(8)):
        table = _tables("banding").table(scene, gain=gain, row_gain=rows)
        np.testing.assert_allclose(table.mean, banding, rtol=1e-6)
    top = Own(lambda images, _: images[:, :, :20].mean(dim=(1, 2, 3)))
    grid = ExposureGrid((100,), (1 / 500, 1 / 250), (4,))
    for noise, gain in ((False, 1.0), (True, np.ones(2))):
        tables = _tables(top, grid=grid, noise=noise)
        found = tables.table(scene, gain=gain, row_gain=rows[:2]).mean
        np.testing.assert_allclose(found, 0.05 * 1.9 * _light(scene, grid), atol=1e-3)


TERMS = dict.fromkeys(("brightness", "highlights", "shadows", "noise", "sharpness"), 1.0)
NOTHING = np.zeros((64, 2, 4))


def _wide(seed: int = 0, size: int = 40, **fields: Any) -> Scene:
    """18 stops, some black and some negative pixels, a size that no block divides."""
    light = 2.0 ** np.random.default_rng(seed).uniform(-14, 4, (4, size, size))
    light[:, 0, :5], light[:, 1, :5] = 0.0, -0.01
    return make_scene(light, 640.0, scene_id=f"test-{seed}", **fields)


def _noisy(size: int = 40) -> Scene:
    """A raw of ISO 6400: what lacks light for its target is noisier than it should be."""
    return _wide(size=size, nlf=CAMERA.nlf(6400))


@pytest.mark.parametrize("size", [40, 67])
@pytest.mark.parametrize("make", [_wide, lambda size: _noisy(size)])
@pytest.mark.parametrize("scorer", [TERMS, {"balanced": 0.7, "banding": 0.3}])
def test_scores_of_frames_are_those_of_the_terms(scorer: Any, make: Any, size: int) -> None:
    scene, made = make(size=size), make_scorer(scorer)
    prepared = prepare_scene(scene, CAMERA, speed=0.1, defocus=1.0)
    images = prepared.expose(GRID.states, seed=3)
    noises = source_noises(prepared, GRID.states, np.ones(64))
    captures = make_captures([scene] * 64, list(GRID), 0.1, 1.0)
    captures = replace(captures, source_noise=noises)
    source_noise = NOTHING if noises is None else np.array([[n.shot, n.read] for n in noises])
    assert source_noise.any() == (not scene.noise_free)
    scores = TermScores(made, CAMERA, GRID.states, noise=True)
    means = scores.measured(encode_observation(images).numpy(), np.arange(64), source_noise)
    wanted = made.score_parts(images.clamp(0.0, 1.0), captures)
    for name, found in scores.score(means, captures).items():
        np.testing.assert_allclose(found, wanted[name], atol=1e-6, err_msg=name)


@pytest.mark.parametrize("make", [_wide, _noisy])
@pytest.mark.parametrize("blurred", [False, True])
def test_tables_are_the_means_over_many_captures(make: Any, blurred: bool) -> None:
    """To within five standard errors of 40 captures, and what a mean's noise leaves.

    Where no noise is added, a pixel may be so close to the next code that it counts in part.
    """
    one_pixel = 1.0 / 40**2 / Highlights.scale
    scene, made = make(), make_scorer("balanced")
    blur = {"speed": 0.3, "defocus": 2.0} if blurred else {}
    table = ScoreTables(GRID, CAMERA, made).table(scene, **blur)
    prepared = prepare_scene(scene, CAMERA, **blur)
    captures = make_captures([scene] * 64, list(GRID), **blur)
    captures = replace(captures, source_noise=source_noises(prepared, GRID.states, np.ones(64)))
    drawn: dict[str, list[np.ndarray]] = {name: [] for name in [*made.parts, "score"]}
    for seed in range(40):
        images = prepared.expose(GRID.states, seed=seed).clamp_(0.0, 1.0)
        scores = {n: s.numpy() for n, s in made.score_parts(images, captures).items()}
        for name, values in [*scores.items(), ("score", made.totals(scores))]:
            drawn[name].append(values)
    for name, values in drawn.items():
        found = table.mean if name == "score" else table.parts[name]
        error = np.std(values, axis=0, ddof=1) / np.sqrt(40)
        off = np.abs(np.mean(values, axis=0) - found) - 5.0 * error
        assert (off < (one_pixel if name == "highlights" else 1e-3)).all(), name


class OwnNoise(Noise):
    """A user's: it is averaged over captures, and reads the noise that is stated of them."""


def test_the_noise_that_is_stated_is_that_of_the_capture() -> None:
    """Of a noisy source whose blur, a different one at each pixel, averages its noise."""
    rng = np.random.default_rng(2)
    layout = Layout(torch.from_numpy(rng.random((40, 40)).astype(np.float32)))
    scene = replace(_noisy(), layout=layout)
    blur: dict[str, Any] = {"speed": 0.5, "defocus": 8.0, "movement": Movement(1.0, 2.0)}
    found, wanted = (
        ScoreTables(GRID, CAMERA, CompositeScorer({"noise": part})).table(scene, **blur).mean
        for part in (OwnNoise(), Noise())
    )
    np.testing.assert_allclose(found, wanted, atol=0.01)


def test_without_noise_the_table_is_the_frame() -> None:
    scene, made = _wide(), make_scorer("balanced")
    table = ScoreTables(GRID, CAMERA, made, noise=False).table(scene, speed=0.1)
    prepared = prepare_scene(scene, CAMERA, speed=0.1)
    images = clip_and_quantise(prepared.expected_sweep(GRID.states), CAMERA).clamp_(0.0, 1.0)
    captures = replace(make_captures([scene] * 64, list(GRID), 0.1), noisy=False)
    wanted = made(images, captures)
    np.testing.assert_allclose(table.mean, wanted, atol=1e-6)


def test_bands_have_light_of_their_own() -> None:
    """Half of the rows at twice the light: the means are those of both halves."""
    light, rows = _wide().light, np.ones((64, 40))
    rows[:, 20:] = 2.0
    light[:, 20:] = light[:, :20]
    scene, parts = make_scene(light.numpy(), 640.0), {"highlights", "shadows", "noise"}
    tables = ScoreTables(GRID, CAMERA, make_scorer(dict.fromkeys(parts, 1.0)))
    both, once, twice = (
        tables.table(scene, gain=gain, row_gain=row_gain).parts
        for gain, row_gain in ((1.0, rows), (1.0, None), (2.0, None))
    )
    for name in parts:
        halves = np.stack([once[name], twice[name]])
        exponential = name != "noise"  # of a mean
        wanted = np.sqrt(halves.prod(axis=0)) if exponential else halves.mean(axis=0)
        np.testing.assert_allclose(both[name], wanted, atol=1e-5, err_msg=name)


def test_a_term_with_a_scale_of_its_own_has_it() -> None:
    plain, other = Highlights(), Highlights()
    other.scale = 0.3  # the square root of the score
    first, second = (
        ScoreTables(GRID, CAMERA, CompositeScorer({"a": part})).table(_wide()).mean
        for part in (plain, other)
    )
    np.testing.assert_allclose(second, np.sqrt(first), atol=0.01)
