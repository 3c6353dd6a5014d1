"""Closed forms by a fused kernel, against the scorers that are written in torch."""

from typing import Any

import numpy as np
import pytest

from ae_env.scenes import Scene
from ae_env.scorers import CompositeScorer, make_scorer
from ae_env.scorers.fused import FusedScores
from ae_env.scorers.score_table import ScoreTables
from ae_env.scorers.terms import Highlights, Noise, Shadows
from tests.ae_env.scorer_images import CAMERA, GRID, make_captures, make_scene

TERMS = dict.fromkeys(("brightness", "highlights", "shadows", "noise", "sharpness"), 1.0)


def _scene(seed: int = 0, size: int = 40) -> Scene:
    """18 stops, some black and some negative pixels, a size that no block divides."""
    light = 2.0 ** np.random.default_rng(seed).uniform(-14, 4, (4, size, size))
    light[:, 0, :5], light[:, 1, :5] = 0.0, -0.01
    return make_scene(light, 640.0, scene_id=f"test-{seed}")


@pytest.mark.parametrize("size", [40, 67])
@pytest.mark.parametrize("bands", [False, True])
@pytest.mark.parametrize("scorer", [TERMS, {"balanced": 0.7, "banding": 0.3}])
def test_scores_are_those_of_the_terms(scorer: Any, bands: bool, size: int) -> None:
    made, rng = make_scorer(scorer), np.random.default_rng(1)
    one, other = _scene(0, size), _scene(1, size)
    scenes = [one] * 5 + [other] * 3 + [one]
    states = [GRID[7 * i] for i in range(9)]
    rows = np.exp(rng.normal(0.0, 1.0, (9, size))) if bands else None
    scores = FusedScores(made)
    assert set(scores.parts) == set(made.parts)
    for gain in (2.0**-64, 2.0**-20, 0.7, 1.0, 30.0, 2.0**64):
        captures = make_captures(scenes, states, 0.1, 1.0, gain, rows)
        wanted = made.score_parts(None, captures)
        for name, found in scores.scores(captures, scores.means(scenes, captures)).items():
            np.testing.assert_allclose(found, wanted[name], atol=1e-6, err_msg=f"{name} {gain}")


@pytest.mark.parametrize("on_the_class", [True, False])
def test_constants_are_those_of_the_terms(
    on_the_class: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts: dict[str, Any] = {"highlights": Highlights(), "shadows": Shadows(), "noise": Noise()}
    tables = ScoreTables(GRID, CAMERA, CompositeScorer(parts), use_cache=False)
    before = tables.table(_scene()).parts
    for name, constant, value in (
        ("highlights", "scale", 0.3),
        ("highlights", "width", 0.5),
        ("shadows", "scale", 0.1),
        ("shadows", "depth", 6.0),
        ("shadows", "width", 1.5),
        ("noise", "half_snr", 40.0),
    ):
        part = parts[name]
        monkeypatch.setattr(type(part) if on_the_class else part, constant, value)
    made = CompositeScorer(parts)
    found = ScoreTables(GRID, CAMERA, made, use_cache=False).table(_scene()).parts
    captures = make_captures(_scene(), list(GRID))
    for name, wanted in made.score_parts(None, captures).items():
        np.testing.assert_allclose(found[name], wanted, atol=1e-6, err_msg=name)
        assert np.abs(found[name] - before[name]).max() > 0.02


def test_static_and_changing_light_are_scored_by_the_same_kernel(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """However deep in a mean the terms are: in torch, all states take some 20 times as long."""
    scorer = make_scorer({"balanced": 0.8, "noise": 0.2})
    alone = ScoreTables(GRID, CAMERA, make_scorer("balanced"), use_cache=False)
    tables = ScoreTables(GRID, CAMERA, scorer, use_cache=False)
    for term in (Highlights, Shadows, Noise):
        monkeypatch.setattr(term, "__call__", None)  # would fail if it were called
    found = tables.table(_scene(), speed=0.1)
    for gain in (1.0, np.ones(64)):
        other = alone.table(_scene(), speed=0.1, gain=gain)
        np.testing.assert_array_equal(found.parts["balanced"], other.mean)
        np.testing.assert_allclose(found.mean, 0.8 * other.mean + 0.2 * other.parts["noise"])


def test_compiled_and_loaded_kernels_agree_to_the_last_bit(compiled_and_loaded: Any) -> None:
    """The first process of a fresh installation compiles; all others load what it cached."""
    code = (
        "import sys, numpy as np; from ae_env.scorers.fused import fused_means\n"
        "rng = np.random.default_rng(0); n = np.float32\n"
        "light, dark = rng.random((2, 4, 1, 900)).astype(n)\n"
        "means, ratio = np.empty((3, 3)), rng.random((3, 1))\n"
        "fixed = rng.random((1, 900)), ratio.astype(n), ratio.astype(n), ratio\n"
        "noise = np.full((3, 4), 1e-3, n), np.full((3, 4), 1e-6, n), n(76.0)\n"
        "fused_means(0, 3, light, dark, *fixed, *noise, means)\n"
        "print(*fused_means.stats.cache_hits.values(), means.tobytes().hex())\n"
    )
    (compiled,), (hits, loaded) = compiled_and_loaded(code)
    assert (hits, len(loaded)) == ("1", 2 * 72)
    assert loaded == compiled
