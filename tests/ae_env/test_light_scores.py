"""Closed forms by a fused kernel, against the scorers that are written in torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from ae_env.captures import describe_captures
from ae_env.grid import ExposureGrid
from ae_env.light_scores import LightScores
from ae_env.scenes import Scene, reference_settings
from ae_env.score_table import ScoreTables
from ae_env.scorers import CompositeScorer, make_scorer
from ae_env.scorers.protocol import Captures
from ae_env.scorers.terms import Noise
from simulator import get_camera

CAMERA = get_camera("nikon_z6")
GRID = ExposureGrid.default()
TERMS = dict.fromkeys(("brightness", "highlights", "shadows", "noise", "sharpness"), 1.0)


def _scene(seed: int = 0, size: int = 40) -> Scene:
    """18 stops, some black and some negative pixels, a size that no block divides."""
    light = 2.0 ** np.random.default_rng(seed).uniform(-14, 4, (4, size, size))
    light[:, 0, :5], light[:, 1, :5] = 0.0, -0.01
    return Scene.from_array(
        light.astype(np.float32),
        reference_settings(8.0),
        CAMERA,
        scene_id=f"test-{seed}",
        illuminance=640.0,
    )


def _captures(scenes: list[Scene], rows: np.ndarray | None, gain: float = 1.0) -> Captures:
    states = [GRID[(7 * i) % 64] for i in range(len(scenes))]
    count = len(scenes)
    return describe_captures(
        scenes,
        states,
        CAMERA,
        speed=np.full(count, 0.1),
        defocus=np.ones(count),
        gain=np.full(count, gain),
        row_gain=rows,
    )


@pytest.mark.parametrize("size", [40, 67])
@pytest.mark.parametrize("bands", [False, True])
@pytest.mark.parametrize("scorer", [TERMS, {"balanced": 0.7, "banding": 0.3}])
def test_scores_are_those_of_the_terms(scorer: Any, bands: bool, size: int) -> None:
    made, rng = make_scorer(scorer), np.random.default_rng(1)
    one, other = _scene(0, size), _scene(1, size)
    scenes = [one] * 5 + [other] * 3 + [one]
    rows = np.exp(rng.normal(0.0, 1.0, (9, size))) if bands else None
    scores = LightScores(made)
    assert set(scores.parts) == set(made.parts)
    for gain in (2.0**-64, 2.0**-20, 0.7, 1.0, 30.0, 2.0**64):
        captures = _captures(scenes, rows, gain)
        wanted = made.score_parts(None, captures)
        for name, found in scores.scores(scenes, captures).items():
            np.testing.assert_allclose(found, wanted[name], atol=1e-6, err_msg=f"{name} {gain}")


def test_scorers_of_ones_own_are_called() -> None:
    class Strict(Noise):
        def __call__(self, images: Any, captures: Captures) -> torch.Tensor:
            return super().__call__(images, captures) ** 2

    tables = ScoreTables(GRID, CAMERA, CompositeScorer({"strict": Strict(), "noise": Noise()}))
    assert set(tables.light_scores.parts) == {"noise"}
    parts = tables.table(_scene(), gain=3.0).parts
    np.testing.assert_allclose(parts["strict"], parts["noise"] ** 2, atol=1e-6)


def test_another_scene_of_the_same_id_is_not_taken_for_it() -> None:
    scores = LightScores(make_scorer("noise"))
    for seed in range(5):  # each may get the memory, and so the id(), of the one before
        scene = _scene(seed)
        captures = _captures([scene], None, 2.0)
        wanted = make_scorer("noise").score_parts(None, captures)["noise"]
        found = scores.scores([scene], captures)["noise"]
        np.testing.assert_allclose(found, wanted, atol=1e-6)
        del scene, captures


@pytest.mark.parametrize("gain", [0.3, 2.0])
def test_tables_of_changed_light_are_those_of_a_scene_with_that_light(gain: float) -> None:
    """What the whole table says, against another scene in its own light."""
    from dataclasses import replace

    scene = _scene()
    lit = replace(scene, light=scene.light * gain, illuminance=640.0 * gain)
    tables = ScoreTables(GRID, CAMERA, make_scorer("balanced"), use_cache=False)
    changed = tables.table(scene, speed=0.2, defocus=1.0, gain=gain)
    wanted = tables.table(lit, speed=0.2, defocus=1.0)
    np.testing.assert_allclose(changed.mean, wanted.mean, atol=1e-6)
    assert changed.oracle == wanted.oracle
