"""Score tables: expectations over noise, their standard errors, the oracle, the cache."""

from __future__ import annotations

import gc
import logging
import weakref
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ae_env.episodes.core import EpisodeCore
from ae_env.grid import ExposureGrid
from ae_env.options import EnvOptions
from ae_env.scenes import Scene, reference_settings
from ae_env.scorers import CompositeScorer, make_scorer
from ae_env.scorers.fused import FusedScores
from ae_env.scorers.protocol import Captures
from ae_env.scorers.score_table import ScoreTables, prepare_scene
from ae_env.scorers.terms import Highlights
from simulator import get_camera
from simulator.capture.prepared_scene import PreparedScene
from simulator.utils.cache import DiskCache

CAMERA = get_camera("nikon_z6")
SMALL = ExposureGrid((100, 1600), (1 / 500, 1 / 30), (4, 8))


def _scene(seed: int = 0, **fields: Any) -> Scene:
    rng = np.random.default_rng(seed)
    light = 0.12 * np.exp(rng.normal(0.0, 1.0, (4, 40, 40)))
    return Scene.from_array(
        torch.from_numpy(light.astype(np.float32)),
        reference_settings(8.0),
        CAMERA,
        scene_id="test",
        illuminance=640.0,
        **fields,
    )


def _tables(scorer: Any = "balanced", **options: Any) -> ScoreTables:
    return ScoreTables(options.pop("grid", SMALL), CAMERA, make_scorer(scorer), **options)


class FirstPixel:
    """Reads one pixel in the middle of the range: its noise is that of the sensor."""

    domain = "raw"

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        return images[:, 1, 0, 0]


class MeanSignal:
    domain = "raw"

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        return images.mean(dim=(1, 2, 3))


def test_closed_form_has_no_error() -> None:
    table = _tables().table(_scene(), speed=0.2, defocus=1.0)
    np.testing.assert_array_equal(table.standard_error, 0.0)
    assert table.mean.shape == (8,)
    assert table.mean.dtype == np.float64
    assert set(table.parts) == {"brightness", "highlights", "shadows", "noise", "sharpness"}


def test_average_over_noise_is_the_noise_free_signal() -> None:
    """Mid-range flat light: noise is symmetric there, so a mean of pixels must come out exact."""
    scene = replace(_scene(), light=torch.full((4, 40, 40), 0.2))
    grid = ExposureGrid((100, 200), (1 / 500,), (4, 5.6))
    table = _tables(MeanSignal(), grid=grid, noise_seeds=64).table(scene)
    prepared = prepare_scene(scene, CAMERA)
    for state, mean, error in zip(grid, table.mean, table.standard_error, strict=True):
        light = 0.2 * 2.0 ** (state.log2_exposure - scene.reference.log2_exposure)
        assert float(prepared.expected(state).mean()) == pytest.approx(light, rel=1e-6)
        assert abs(mean - light) < 5 * error + 1 / 15_520  # quantised to digital numbers


def test_standard_error_is_that_of_the_sensor_noise() -> None:
    scene = replace(_scene(), light=torch.full((4, 40, 40), 0.3))
    grid = ExposureGrid((100,), (1 / 1000, 1 / 250), (4,))
    seeds = 400
    table = _tables(FirstPixel(), grid=grid, noise_seeds=seeds).table(scene)
    nlf = CAMERA.nlf(100)
    for state, error in zip(grid, table.standard_error, strict=True):
        light = 0.3 * 2.0 ** (state.log2_exposure - scene.reference.log2_exposure)
        sigma = np.sqrt(nlf.read[1] + nlf.shot[1] * light)
        # The spread of 400 normals is known to 1 / sqrt(2 * 399) = 3.5 %; quantisation adds a bit.
        assert error == pytest.approx(sigma / np.sqrt(seeds), rel=0.13)


def test_common_noise_makes_one_seed_repeatable_and_its_error_unknown() -> None:
    first = _tables(MeanSignal(), noise_seeds=1).table(_scene())
    second = _tables(MeanSignal(), noise_seeds=1).table(_scene())
    np.testing.assert_array_equal(first.mean, second.mean)
    assert np.isnan(first.standard_error).all()


def test_mixed_scorer_averages_only_what_is_noisy() -> None:
    scorer = CompositeScorer({"mean": MeanSignal(), "noise": make_scorer("noise").parts["noise"]})
    table = _tables(scorer, noise_seeds=4).table(_scene())
    assert (table.standard_error > 0).all()
    np.testing.assert_array_equal(
        table.parts["noise"], _tables("noise").table(_scene()).parts["noise"]
    )
    np.testing.assert_allclose(table.mean, 0.5 * (table.parts["mean"] + table.parts["noise"]))


def test_oracle_is_the_best_state_and_ties_go_to_the_lower_iso() -> None:
    table = _tables().table(_scene())
    assert table.mean[table.oracle] == table.mean.max()
    # Under `brightness` alone all states of one EV are alike: ISO 100 at 1/25 s equals ISO 400
    # at 1/100 s and ISO 1600 at 1/400 s; times that are no powers of two round differently.
    grid = ExposureGrid((100, 400, 1600), (1 / 400, 1 / 100, 1 / 25), (4, 8))
    for ev100 in np.arange(2.0, 16.0, 0.37):
        scene = replace(_scene(), illuminance=2.5 * 2.0**ev100)
        best = _tables("brightness", grid=grid, use_cache=False).table(scene)
        alike = np.flatnonzero(best.mean > best.mean.max() - 1e-7)
        assert best.oracle == alike[0]


def test_more_light_is_like_a_longer_exposure() -> None:
    """Twice the light at 1/500 s is that of 1/250 s, to a score that sees only light."""
    scene = _scene()
    grid = ExposureGrid((100,), (1 / 500, 1 / 250), (4,))
    plain = _tables(grid=grid).table(scene)
    brighter = _tables(grid=grid).table(scene, gain=2.0)
    assert brighter.mean[0] == pytest.approx(plain.mean[1], rel=1e-6)


def _files(cache: Path) -> list[Path]:
    return sorted((cache / "score_tables").glob("*"))


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    return tmp_path


def test_second_time_comes_from_the_cache(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = _scene()
    first = _tables().table(scene, speed=0.2, defocus=1.5)
    assert len(_files(cache)) == 1
    monkeypatch.setattr(FusedScores, "means", None)  # would fail if it were called again
    second = _tables().table(scene, speed=0.2, defocus=1.5)
    np.testing.assert_array_equal(first.mean, second.mean)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut", b"not a table"])
def test_a_damaged_file_is_made_anew(
    cache: Path, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    scene = _scene()
    expected = _tables().table(scene).mean
    (path,) = _files(cache)
    path.write_bytes(content)
    with caplog.at_level(logging.WARNING):
        np.testing.assert_array_equal(_tables().table(scene).mean, expected)
    assert "made again" in caplog.text
    np.testing.assert_array_equal(_tables().table(scene).mean, expected)
    assert len(_files(cache)) == 1


@pytest.mark.parametrize(
    "change",
    [
        lambda means: means[:-1],
        lambda means: means.reshape(-1),
        lambda means: means * float("nan"),
        lambda means: torch.where(means == means.max(), float("inf"), means),
    ],
)
def test_a_table_of_a_wrong_shape_or_without_numbers_is_made_again(
    cache: Path, change: Callable[[torch.Tensor], torch.Tensor]
) -> None:
    """The file is whole, and its digest is that of its content: only the content cannot be."""
    expected, disk = _tables().table(_scene()).mean, DiskCache(cache)
    key = _files(cache)[0].stem
    stored = disk.get("score_tables", key)
    assert stored is not None
    disk.put("score_tables", key, stored | {"means": change(stored["means"])})
    np.testing.assert_array_equal(_tables().table(_scene()).mean, expected)
    mended = disk.get("score_tables", key)
    assert mended is not None
    assert torch.equal(mended["means"], stored["means"])


def test_key_changes_with_everything_that_changes_the_scores(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = _scene()
    counts = []

    def use(tables: ScoreTables, scene: Scene = scene) -> None:
        tables.table(scene)
        counts.append(len(_files(cache)))

    use(_tables())
    use(_tables())  # nothing changed
    use(_tables(grid=ExposureGrid((100,), (1 / 500,), (4,))))
    use(ScoreTables(SMALL, get_camera("canon_70d"), make_scorer("balanced")))
    scaled = CAMERA.with_nlf(100, CAMERA.nlf(100).scaled(2.0))
    use(ScoreTables(SMALL, scaled, make_scorer("balanced")))  # the same name, other noise
    use(_tables({"highlights": 1.0, "noise": 1.0}))
    use(_tables(), replace(scene, light=scene.light * 1.5))
    use(_tables(), replace(scene, reference=reference_settings(9.0)))
    use(_tables(), replace(scene, illuminance=None))
    other = make_scorer("highlights")
    use(ScoreTables(SMALL, CAMERA, other))
    strict = Highlights()
    strict.scale = 0.05
    use(ScoreTables(SMALL, CAMERA, CompositeScorer({"highlights": strict})))
    use(_tables(), replace(scene, white_balance=(2.0, 1.0, 1.5)))
    use(_tables(), replace(scene, scene_id="another"))
    noisy = replace(scene, nlf=CAMERA.nlf(100))
    use(_tables(), replace(noisy, denoised=scene.light * 0.9))
    use(_tables(), replace(noisy, denoised=scene.light * 0.8))  # by other weights
    use(_tables(), replace(scene, defocus_map=torch.full((40, 40), 2.0)))
    calibrated = {100: CAMERA.nlf(100), 6400: CAMERA.nlf(6400)}
    plain = replace(CAMERA, nlf_by_iso=calibrated, segments=())
    use(ScoreTables(SMALL, plain, make_scorer("balanced")))
    use(ScoreTables(SMALL, replace(plain, segments=(800,)), make_scorer("balanced")))
    assert counts == [1, 1, *range(2, 18)]


def test_scores_in_memory_are_bounded_and_keep_no_scene_alive(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    class Own(Highlights):
        def __call__(self, images: Any, captures: Captures) -> torch.Tensor:
            made.append(len(captures))
            return super().__call__(images, captures)

    each = 8 * len(SMALL) + 1000  # one part, and what an entry takes itself
    monkeypatch.setattr("ae_env.scorers.score_table.MEMORY_BYTES", 3 * each)
    tables, scene = _tables(Own(), use_cache=False), _scene()
    for gain in (3.0, 2.0, 4.0, 3.0, 8.0):  # 8 takes the place of 2
        tables.table(scene, gain=gain)
        assert tables._light_parts.nbytes <= 3 * each
    assert len(made) == 4
    for gain in (3.0, 4.0, 8.0):
        tables.table(scene, gain=gain)
    assert len(made) == 4
    tables.table(scene, gain=2.0)
    assert len(made) == 5

    gone = weakref.ref(scene)
    del scene
    gc.collect()
    assert gone() is None
    for seed in range(4):  # new scenes may get the old one's id, but never its scores
        expected = _tables(Own(), use_cache=False).table(_scene(seed)).mean
        np.testing.assert_array_equal(tables.table(_scene(seed)).mean, expected)


def test_a_folder_that_cannot_be_written_is_not_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    expected = _tables(use_cache=False).table(_scene()).mean
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "file"))
    with caplog.at_level(logging.WARNING):
        np.testing.assert_array_equal(_tables().table(_scene()).mean, expected)
    assert "could not be cached" in caplog.text


def test_class_constants_enter_the_key(cache: Path) -> None:
    """A subclass that only changes a constant is another scorer."""

    class Strict(Highlights):
        version = 1
        scale = 0.05

    scene = _scene()
    mild = ScoreTables(SMALL, CAMERA, CompositeScorer({"highlights": Highlights()})).table(scene)
    strict = ScoreTables(SMALL, CAMERA, CompositeScorer({"highlights": Strict()})).table(scene)
    assert (strict.mean < mild.mean).any()
    assert len(_files(cache)) == 2


def test_scorers_with_state_that_cannot_be_keyed_are_not_cached(cache: Path) -> None:
    scorer = Highlights()
    scorer.network = torch.nn.Linear(2, 2)  # type: ignore[attr-defined]
    table = ScoreTables(SMALL, CAMERA, CompositeScorer({"highlights": scorer})).table(_scene())
    assert np.isfinite(table.mean).all()
    assert _files(cache) == []


def test_noise_seeds_must_be_positive() -> None:
    with pytest.raises(ValueError, match="`noise_seeds`"):
        _tables(noise_seeds=0)


def test_a_scorer_of_ones_own_is_not_kept_on_disk_unless_it_has_a_version() -> None:
    """What a scorer closes over cannot be hashed: a changed constant must not find old scores."""

    def constant(value: float) -> Any:
        def score(images: Any, captures: Any) -> torch.Tensor:
            return torch.full((len(captures),), value)

        score.domain, score.depends_on = "raw", "light"  # type: ignore[attr-defined]
        return score

    scene, grid, camera = _scene(), ExposureGrid((100,), (1 / 100,), (4,)), get_camera("nikon_z6")
    for value in (0.2, 0.9):
        table = ScoreTables(grid, camera, make_scorer(constant(value))).table(scene)
        assert table.mean == pytest.approx(value)


def test_bands_count_whatever_form_the_gain_has() -> None:
    scene = replace(_scene(), light=torch.full((4, 40, 40), 0.05), saturated=None)
    rows = np.full((8, 40), 1.9)
    rows[:, 20:] = 0.1
    # Half of the rows each: the standard deviation is half the distance, 2.124 stops.
    banding = 1.0 / (1.0 + (np.log2(1.9 / 0.1) / 2.0 / 0.1) ** 2)
    for gain in (1.0, 0.5, np.ones(8)):
        table = _tables("banding").table(scene, gain=gain, row_gain=rows)
        np.testing.assert_allclose(table.mean, banding, rtol=1e-6)

    def top(images: torch.Tensor, captures: Captures) -> torch.Tensor:
        return images[:, :, :20].mean(dim=(1, 2, 3))

    top.domain = "raw"  # type: ignore[attr-defined]
    grid = ExposureGrid((100,), (1 / 500, 1 / 250), (4,))
    for noise in (False, True):
        tables = _tables(top, grid=grid, noise=noise, use_cache=False)
        found = tables.table(scene, row_gain=rows[:2]).mean
        stops = [s.log2_exposure - scene.reference.log2_exposure for s in grid]
        np.testing.assert_allclose(found, 0.05 * 1.9 * 2.0 ** np.array(stops), atol=1e-3)


def test_without_noise_the_expected_score_is_that_of_the_noise_free_capture() -> None:
    def spread(images: torch.Tensor, captures: Any) -> torch.Tensor:
        return images.std(dim=(1, 2, 3)).clamp(0.0, 1.0)

    spread.domain = "raw"  # type: ignore[attr-defined]
    flat = torch.full((4, 36, 36), 0.2)
    scene = replace(_scene(), light=flat, saturated=None)
    grid, camera = ExposureGrid((6400,), (1 / 1000,), (4,)), get_camera("nikon_z6")
    clean = ScoreTables(grid, camera, make_scorer(spread), noise=False).table(scene)
    noisy = ScoreTables(grid, camera, make_scorer(spread)).table(scene)
    assert clean.mean == pytest.approx(0.0, abs=1e-4)
    assert clean.standard_error == pytest.approx(0.0)
    assert noisy.mean > 1e-3


def test_captures_that_are_scored_have_the_tolerance_that_was_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = set()
    expose = PreparedScene.expose

    def exposed(prepared: PreparedScene, *args: Any, **kwargs: Any) -> torch.Tensor:
        seen.add(prepared.tolerance)
        return expose(prepared, *args, **kwargs)

    monkeypatch.setattr(PreparedScene, "expose", exposed)
    _tables(MeanSignal(), tolerance=0.025).table(_scene(), speed=0.2)
    assert seen == {0.025}
    with pytest.raises(ValueError, match="`tolerance`"):
        _tables(tolerance=-1.0)
    options = EnvOptions(
        scenes="bundled:small", resolution=36, scorer=MeanSignal(), tolerance=0.375
    )
    assert EpisodeCore(options, 1).tables.tolerance == 0.375
