"""What tells the scores of one scorer on disk from those of another."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ae_env.grid import ExposureGrid
from ae_env.scenes import Scene, reference_settings
from ae_env.scorers import CompositeScorer, make_scorer
from ae_env.scorers.protocol import Captures
from ae_env.scorers.registry import scorer_fingerprint
from ae_env.scorers.score_table import ScoreTables
from ae_env.scorers.terms import Noise
from simulator import get_camera

CAMERA = get_camera("nikon_z6")
SMALL = ExposureGrid((100, 1600), (1 / 500, 1 / 30), (4, 8))


class Constant:
    domain, depends_on = "raw", "light"

    def __init__(self, value: float, version: int | None = None) -> None:
        self.value = value
        if version is not None:
            self.version = version

    def __call__(self, images: Any, captures: Captures) -> torch.Tensor:
        return torch.full((len(captures),), self.value)


def test_scorers_inside_of_others_enter_the_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nested(value: float, version: int | None = None, deeper: bool = False) -> CompositeScorer:
        inner = CompositeScorer({"p": Constant(value, version)})
        inner = CompositeScorer({"in": inner}) if deeper else inner
        return CompositeScorer({"in": inner, "noise": Noise()})

    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    scene = Scene.from_array(
        torch.full((4, 40, 40), 0.2), reference_settings(8.0), CAMERA, scene_id="flat"
    )
    noise = ScoreTables(SMALL, CAMERA, make_scorer("noise")).table(scene).mean
    for value in (0.2, 0.8):
        for version in (None, 1):  # neither finds the scores of the other value
            table = ScoreTables(SMALL, CAMERA, nested(value, version)).table(scene)
            np.testing.assert_allclose(table.mean, (value + noise) / 2, atol=1e-6)
    assert scorer_fingerprint(nested(0.2)) is scorer_fingerprint(nested(0.2, deeper=True)) is None
    kinds = [(0.2, 1), (0.8, 1), (0.2, 2), (0.2, 1, True)]
    assert len({scorer_fingerprint(nested(*kind)) for kind in kinds}) == 4
    assert scorer_fingerprint(nested(0.2, 1)) == scorer_fingerprint(nested(0.2, 1))
