"""Score tables: expectations over noise, their standard errors, the oracle."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from ae_env.grid import ExposureGrid
from ae_env.scenes import Scene
from ae_env.scorers import CompositeScorer, make_scorer
from ae_env.scorers.score_table import ScoreTables
from simulator.capture.prepared_scene import PreparedScene
from tests.ae_env.environments import make_env
from tests.ae_env.scorer_images import CAMERA, Own, make_scene

SMALL = ExposureGrid((100, 1600), (1 / 500, 1 / 30), (4, 8))


def _scene(seed: int = 0) -> Scene:
    light = 0.12 * np.exp(np.random.default_rng(seed).normal(0.0, 1.0, (4, 40, 40)))
    return make_scene(light, 640.0)


def _flat(value: float) -> Scene:
    return make_scene(np.full((4, 40, 40), value), 640.0)


def _light(scene: Scene, grid: ExposureGrid) -> np.ndarray:
    """What the states record of light that `scene.reference` records as 1."""
    return 2.0 ** (np.array([s.log2_exposure for s in grid]) - scene.reference.log2_exposure)


def _tables(scorer: Any = "balanced", **options: Any) -> ScoreTables:
    given = {"grid": SMALL, "camera": CAMERA, "scorer": make_scorer(scorer), **options}
    return ScoreTables(**given)


def test_average_over_noise_is_the_noise_free_signal() -> None:
    """Mid-range flat light: noise is symmetric there, so a mean of pixels must come out exact."""
    scene, grid = _flat(0.2), ExposureGrid((100, 200), (1 / 500,), (4, 5.6))
    table = _tables(Own(), grid=grid, noise_seeds=64).table(scene)
    light = 0.2 * _light(scene, grid)
    assert (np.abs(table.mean - light) < 5 * table.standard_error + 1 / 15_520).all()  # 1 DN


def test_standard_error_is_that_of_the_sensor_noise() -> None:
    scene, grid = _flat(0.3), ExposureGrid((100,), (1 / 1000, 1 / 250), (4,))
    first_pixel = Own(lambda images, _: images[:, 1, 0, 0])
    table = _tables(first_pixel, grid=grid, noise_seeds=400).table(scene)
    nlf = CAMERA.nlf(100)
    sigma = np.sqrt(nlf.read[1] + nlf.shot[1] * 0.3 * _light(scene, grid))
    # The spread of 400 normals is known to 1 / sqrt(2 * 399) = 3.5 %; quantisation adds a bit.
    np.testing.assert_allclose(table.standard_error, sigma / np.sqrt(400), rtol=0.13)


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
    with pytest.raises(ValueError, match="`noise_seeds`"):
        _tables(noise_seeds=0)


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


def test_without_noise_the_expected_score_is_that_of_the_noise_free_capture() -> None:
    spread, grid = (
        Own(lambda images, _: images.std(dim=(1, 2, 3))),
        ExposureGrid((6400,), (1e-3,), (4,)),
    )
    clean, noisy = (_tables(spread, grid=grid, noise=n).table(_flat(0.2)) for n in (False, True))
    assert clean.mean == pytest.approx(0.0, abs=1e-4)
    assert clean.standard_error == pytest.approx(0.0)
    assert noisy.mean > 1e-3


def test_captures_that_are_scored_have_the_tolerance_that_was_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen, expose = set(), PreparedScene.expose

    def exposed(prepared: PreparedScene, *args: Any, **kwargs: Any) -> torch.Tensor:
        seen.add(prepared.tolerance)
        return expose(prepared, *args, **kwargs)

    monkeypatch.setattr(PreparedScene, "expose", exposed)
    make_env(scorer=Own(), tolerance=0.375).unwrapped.core.task.tables.table(_scene())  # type: ignore[attr-defined]
    assert seen == {0.375}
    with pytest.raises(ValueError, match="`tolerance`"):
        _tables(tolerance=-1.0)
