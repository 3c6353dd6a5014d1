"""Simulated states against the captures of a small recorded grid, in one command."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import recorded
from simulator import exposure_ratio
from tests.ae_env.recorded_files import GRID, capture, write_raws
from tests.simulator.training.scenes import scene as photographed


def test_a_grid_of_ones_own(ae_env, benchmarks_here: Path) -> None:
    write_raws(benchmarks_here / "grid" / "a")
    write_raws(benchmarks_here / "grid" / "b", tuple(GRID)[:-1], seed=1)
    code, _, error = ae_env("bench", "recorded", "grid", "--quick")  # into ./results
    assert (code, error.partition("WARNING")[0]) == (0, "")
    result = json.loads((benchmarks_here / "results" / "recorded.json").read_text())
    assert result["meta"]["command"] == "ae-env bench recorded grid --quick"
    rows = {(row["scene"], row["method"]): row for row in result["rows"]}
    assert set(rows) == {(s, m) for s in "ab" for m in ("simulated", "scaled")}
    assert [rows[s, "scaled"]["states"] for s in "ab"] == [8, 7]
    # Scaled by hand: the source is the state whose green is nearest to a mean of 0.12.
    frames = torch.stack([capture(s).data for s in GRID]).double()
    source = int((frames[:, 1:3].mean(dim=(1, 2, 3)) - 0.12).abs().argmin())
    assert rows["a", "scaled"]["source_state"] == str(GRID[source])
    assert float(frames[source].max()) < 0.8  # so that all of it is known, and compared
    errors = []
    for state, settings in enumerate(GRID):
        if state != source:
            scaled = (frames[source] * exposure_ratio(GRID[source], settings)).clamp(max=1.0)
            errors.append(-10.0 * np.log10(float((scaled - frames[state]).square().mean())))
    row = rows["a", "scaled"]
    assert row["known_share"] == 1.0
    assert row["psnr_db"] == pytest.approx(np.median(errors), abs=0.3)  # the pedestal clips
    assert row["psnr_all_db"] == row["psnr_db"] == row["psnr_expected_db"]
    # The simulated frames have the noise of real ones, at the cost of PSNR against noisy ones.
    simulated = rows["a", "simulated"]
    assert simulated["noise_error_stops"] < row["noise_error_stops"]
    assert simulated["psnr_expected_db"] > simulated["psnr_db"]
    for own in rows.values():
        assert 0.0 <= own["oracle_regret"] < 0.2
    page = (benchmarks_here / "results" / "recorded.md").read_text()
    assert "|grid|tworealcaptures|" in page.replace(" ", "")
    assert "boreal" not in page


def test_the_noise_of_two_real_captures_is_told(tmp_path: Path) -> None:
    """The ceiling, worked out from the calibration, against two captures of one light."""
    write_raws(tmp_path / "a")
    (scene,) = recorded._of_folder(str(tmp_path))
    everywhere = torch.ones(scene.light.shape[1:], dtype=torch.bool)
    for state, settings in enumerate(GRID):
        other = capture(settings, 0).data
        again = (
            recorded.ReferenceCamera(scene.camera)
            .capture(photographed("s0", size=40, seed=0), settings, seed=99)
            .sample
        )
        error = -10.0 * np.log10(float((again - other).double().square().mean()))
        ceiling = recorded._ceiling(scene, GRID, state, everywhere)
        assert ceiling == pytest.approx(error, abs=0.3)
