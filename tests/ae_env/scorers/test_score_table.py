"""Score tables: expectations over noise, their standard errors, the oracle, the cache."""

import gc
import weakref
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
from ae_env.scorers.score_table import ScoreTables
from ae_env.scorers.terms import Highlights
from simulator import get_camera
from simulator.capture.prepared_scene import PreparedScene
from simulator.utils.cache import DiskCache
from tests.ae_env.environments import SMALL as ENV
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
        best = _tables("brightness", grid=grid, use_cache=False).table(scene)
        alike = np.flatnonzero(best.mean > best.mean.max() - 1e-7)
        assert best.oracle == alike[0]


def _files(cache: Path) -> list[Path]:
    return list((cache / "score_tables").glob("*"))


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


@pytest.mark.parametrize(
    "change",
    [
        lambda means: means[:-1],
        lambda means: means.reshape(-1),
        lambda means: means * float("nan"),
        lambda means: torch.where(means == means.max(), float("inf"), means),
        b"",
        b"not a table",
    ],
)
def test_a_damaged_table_is_made_again(
    cache: Path, change: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """Bytes that are no file of a table, or a whole file whose content cannot be."""
    expected, disk = _tables().table(_scene()).mean, DiskCache(cache)
    (file,) = _files(cache)
    stored = disk.get("score_tables", file.stem)
    if isinstance(change, bytes):
        file.write_bytes(change)
    else:
        disk.put("score_tables", file.stem, stored | {"means": change(stored["means"])})
    np.testing.assert_array_equal(_tables().table(_scene()).mean, expected)
    assert ("made again" in caplog.text) == isinstance(change, bytes)
    mended = disk.get("score_tables", file.stem)
    assert torch.equal(mended["means"], stored["means"])


def test_key_changes_with_everything_that_changes_the_scores(cache: Path) -> None:
    class Strict(Highlights):
        version = 1
        scale = 0.05

    own, scene = Highlights(), _scene()
    own.scale = 0.1  # a constant of the object, where that of `Strict` is of the class
    noisy = replace(scene, nlf=CAMERA.nlf(100))
    calibrated = {100: CAMERA.nlf(100), 6400: CAMERA.nlf(6400)}
    plain = replace(CAMERA, nlf_by_iso=calibrated, segments=())
    tables = [
        _tables(),
        _tables(grid=ExposureGrid((100,), (1 / 500,), (4,))),
        _tables(camera=get_camera("canon_70d")),
        _tables(camera=CAMERA.with_nlf(100, CAMERA.nlf(100).scaled(2.0))),
        _tables(camera=plain),
        _tables(camera=replace(plain, segments=(800,))),
        _tables({"highlights": 1.0, "noise": 1.0}),
        *(_tables(CompositeScorer({"highlights": s})) for s in (Highlights(), own, Strict())),
    ]
    uses = [(each, scene) for each in [*tables, tables[0]]]  # the first one again
    uses += [(tables[0], replace(scene, **fields)) for fields in (
        {"light": scene.light * 1.5},
        {"reference": reference_settings(9.0)},
        {"illuminance": None},
        {"white_balance": (2.0, 1.0, 1.5)},
        {"scene_id": "another"},
        {"defocus_map": torch.full((40, 40), 2.0)},
    )]  # fmt: skip
    uses += [(tables[0], replace(noisy, denoised=scene.light * x)) for x in (0.9, 0.8)]
    for each, shown in uses:
        each.table(shown)
    assert len(_files(cache)) == len(uses) - 1


def test_scores_in_memory_are_bounded_and_keep_no_scene_alive(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    class Counted(Highlights):
        def __call__(self, images: Any, captures: Captures) -> torch.Tensor:
            made.append(len(captures))
            return super().__call__(images, captures)

    each = 8 * len(SMALL) + 1000  # one part, and what an entry takes itself
    monkeypatch.setattr("ae_env.scorers.score_table.MEMORY_BYTES", 3 * each)
    tables, scene = _tables(Counted(), use_cache=False), _scene()
    for gain, count in zip((3, 2, 4, 3, 8, 3, 4, 8, 2), (1, 2, 3, 3, 4, 4, 4, 4, 5), strict=True):
        tables.table(scene, gain=float(gain))  # 8 takes the place of 2
        assert len(made) == count
        assert tables._light_parts.nbytes <= 3 * each

    gone = weakref.ref(scene)
    del scene
    gc.collect()
    assert gone() is None
    for seed in range(4):  # new scenes may get the old one's id, but never its scores
        expected = _tables(Counted(), use_cache=False).table(_scene(seed)).mean
        np.testing.assert_array_equal(tables.table(_scene(seed)).mean, expected)


def test_a_folder_that_cannot_be_written_is_not_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    expected = _tables(use_cache=False).table(_scene()).mean
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "file"))
    np.testing.assert_array_equal(_tables().table(_scene()).mean, expected)
    assert "could not be cached" in caplog.text


def test_scorers_that_cannot_be_keyed_are_not_cached(cache: Path) -> None:
    """A network is no constant; and what a function closes over cannot be hashed."""
    scorer = Highlights()
    scorer.network = torch.nn.Linear(2, 2)  # type: ignore[attr-defined]
    table = _tables(CompositeScorer({"highlights": scorer})).table(_scene())
    assert np.isfinite(table.mean).all()
    for value in (0.25, 0.75):

        def constant(images: Any, captures: Captures, value: float = value) -> torch.Tensor:
            return torch.full((len(captures),), value)

        constant.domain, constant.depends_on = "raw", "light"  # type: ignore[attr-defined]
        assert _tables(constant).table(_scene()).mean.tolist() == [value] * 8
    assert _files(cache) == []


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
    EpisodeCore(EnvOptions(**ENV, scorer=Own(), tolerance=0.375), 1).tables.table(_scene())
    assert seen == {0.375}
    with pytest.raises(ValueError, match="`tolerance`"):
        _tables(tolerance=-1.0)
