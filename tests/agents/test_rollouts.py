"""What policies are fitted on where the scenes of an evaluation are too few to train on."""

from pathlib import Path
from typing import Any

import pytest

from agents.rollouts import fitting_arguments, training_arguments
from tests.ae_env.recorded_files import GRID, write_raws

STATES = {
    "isos": list(GRID.isos),
    "exposure_times": list(GRID.exposure_times),
    "f_numbers": list(GRID.f_numbers),
}


def test_recorded_grids_are_trained_for_on_their_own_states(tmp_path: Path) -> None:
    """The default grid has 64 states, which a policy for eight cannot use."""
    write_raws(tmp_path / "a")
    named = f"recorded:{tmp_path}"
    for spec in (named, {"recorded": str(tmp_path)}):
        assert training_arguments(spec, 36) == ({"scenes": "bundled", "grid": STATES}, True)
    assert training_arguments(str(tmp_path), 36) == ({"scenes": "bundled"}, True)
    assert training_arguments("bundled") == ({"scenes": "bundled"}, False)
    judged = {"scenes": named, "split": "test", "grid": "video"}
    assert fitting_arguments(judged, 36) == {**judged, "scenes": "bundled"}  # what is named stays


def test_a_fitted_policy_is_recorded_and_judged_on_a_recorded_grid(
    ae_env, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    few: tuple[dict[str, Any], bool] = ({"scenes": "bundled:small", "grid": STATES}, True)
    monkeypatch.setattr("agents.rollouts.training_arguments", lambda *_: few)
    write_raws(tmp_path / "grid" / "a")
    (tmp_path / "env.yaml").write_text("{scenes: 'recorded:grid', split: train, resolution: 36}")
    options = ("--env", "env.yaml", "--split", "all", "--episodes", "1")  # no scene to train on
    code, _, error = ae_env("record", "--policy", "average", "-o", "ae/mine-v0", *options)
    assert code == 0, error
    assert minari.load_dataset("ae/mine-v0").total_episodes == 1
    write_raws(tmp_path / "grid" / "b", tuple(GRID)[1:], seed=1)
    policies = ("--policy", "best_fixed", "--policy", "average", "--policy", "oracle")
    code, out, _ = ae_env("evaluate", *policies, *options, "--frames", "2", "--out", "out")
    assert code == 0
    assert (tmp_path / "out" / "results.json").is_file()
    assert "best_fixed" in out
