"""The transfer benchmark: its measures against numbers worked out by hand, and a tiny run."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ae_env.options import EnvOptions
from ae_env.scenes.load import simulate_source_raw
from ae_env.scorers.score_table import ScoreTable
from benchmarks import transfer
from benchmarks.transfer import agents, tables
from benchmarks.transfer.report import verdicts
from benchmarks.transfer.worlds import HIGH_ISO, WORLDS, TableSet, TransferPlan, World, has_weights

TINY = TransferPlan(
    scenes="bundled:small",
    worlds=("truth", "compact-iso1600"),
    agents=("regression",),
    seeds=(0,),
    frames=128,
    episodes=1,
    judged_scenes=4,
    tables=(
        TableSet("balanced", 3, ("EXP", "compact"), (6400,), (-3, 3), ("native",)),
        TableSet("shadows", 2, ("compact",), (100,), (0,), ("box",)),
    ),
)


def test_an_error_is_that_of_the_term_that_makes_it() -> None:
    """Score a^2 b: a part wrong where the other is 0 makes no error."""
    parts = {"a": np.array([0.5, 1.0]), "b": np.array([0.0, 0.5])}
    predicted = {"a": np.array([0.9, 0.8]), "b": np.array([0.1, 0.5])}
    true, table = (ScoreTable(np.zeros(2), np.zeros(2), own) for own in (parts, predicted))
    found = tables.errors(table, true, lambda own: own["a"] ** 2 * own["b"])["terms"]
    assert found == pytest.approx({"a": 0.5 * (0.5 - 0.32), "b": 0.5 * 0.025})


def test_errors_of_a_table_by_hand() -> None:
    """Ranks 1 3 2 against 1 2 3: 1 - 6 * 2 / (3 * 8) = 0.5; the state chosen has 0.5, not 0.9.

    The fourth state is one that the scene does not allow.
    """
    allowed = np.array([True, True, True, False])
    predicted, true, flat = (
        ScoreTable(np.array(own), np.zeros(4), {"term": np.array(own) / 2.0}, allowed)
        for own in ([0.2, 0.9, 0.5, 1.0], [0.1, 0.5, 0.9, 0.0], [0.5, 0.5, 0.5, 0.1])
    )
    found = tables.errors(predicted, true, lambda parts: 2.0 * parts["term"])
    wanted = {"rank_correlation": 0.5, "regret": 0.4, "absolute_error": 0.3}
    assert found == pytest.approx({**wanted, "terms": pytest.approx({"term": 0.3})})
    assert tables.errors(flat, true, lambda parts: parts["term"])["rank_correlation"] == 0.0


def test_tables_are_averaged_over_source_groups_and_compared_in_pairs() -> None:
    """Groups a, a, b: the mean of (0.1 + 0.3) / 2 and 0.4 is 0.3; EXP has 0.05 more everywhere."""
    measured = []
    for group, regret in (("a", 0.1), ("a", 0.3), ("b", 0.4)):
        for name, more in (("EXP", 0.05), ("compact", 0.0)):
            row: dict[str, Any] = {"simulator": name, "group": group, "regret": regret + more}
            row |= {"rank_correlation": 1.0, "absolute_error": 0.0, "ms": 2.0, "saturated": 0.5}
            measured.append(row | {"terms": {"noise": 0.1, "shadows": regret}})
    exp, compact = tables.summary(measured)
    assert (exp["regret"], compact["regret"]) == pytest.approx((0.35, 0.3))
    assert "regret_to_exp" not in exp
    assert compact["regret_to_exp"] == pytest.approx(-0.05)
    assert compact["terms"] == pytest.approx({"noise": 0.1, "shadows": 0.3})
    assert (compact["worst_term"], compact["num_groups"]) == ("shadows", 2)


def test_the_drop_by_hand() -> None:
    """20 groups, span 1: 0.8 in the truth, 0.7 and 0.6 (two seeds) in compact, 0.5 in EXP."""
    scores = {"truth": [0.8], "EXP": [0.5], "compact": [0.7, 0.6]}
    gains = {("ppo", w): np.tile(np.array(own)[:, None], 20) for w, own in scores.items()}
    truth, exp, row = (agents.comparison(gains, np.ones(20), "ppo", world) for world in scores)
    assert row["normalised_score"] == pytest.approx(0.65)
    assert row["by_seed"] == pytest.approx([0.7, 0.6])
    assert (row["drop"], row["more_than_exp"], exp["drop"]) == pytest.approx((0.15, 0.15, 0.3))
    assert row["drop_ci95"] == pytest.approx([0.1, 0.2])  # both seeds the one, or the other
    assert "drop" not in truth
    assert "more_than_exp" not in exp


def test_what_was_asked_for_is_answered() -> None:
    common: dict[str, Any] = {"agent": "ppo", "simulator": "compact"}
    every = common | {"high_iso": False, "drop": 0.01, "drop_ci95": [0.0, 0.02]}
    high = common | {"high_iso": True, "more_than_exp": 0.02, "more_than_exp_ci95": [-0.01, 0.05]}
    rows = [every, high, high | {"more_than_exp_ci95": [0.001, 0.05]}]
    assert [row["met"] for row in verdicts(rows)] == [True, False, True]
    assert next(verdicts([every]))["measured"] == "+0.010 [+0.000, +0.020]"


def test_sources_of_high_iso_differ_from_others_in_nothing_else() -> None:
    options: dict[str, Any] = {"split": "test", "resolution": 64, "simulator": None}
    plain = EnvOptions(scenes="bundled:small", **options).load_scenes()
    world = World("EXP", high_iso=True).options("bundled:small")
    found = EnvOptions.from_kwargs({**options, **world}).load_scenes()
    isos = [scene.reference.iso for scene in found]
    assert HIGH_ISO[0] <= min(isos) < 2500.0 < max(isos) <= HIGH_ISO[1]
    for scene, truth in zip(found, plain, strict=True):
        again = simulate_source_raw(truth, iso=scene.reference.iso)
        assert (scene.content, scene.reference) == (again.content, again.reference)


def test_worlds_differ_in_the_source_only() -> None:
    jobs = agents.training_jobs(TransferPlan(), Path("unused"))
    assert {world for _, world in jobs} == {name for name in WORLDS if has_weights(name)}
    cards: dict[str, dict[str, Any]] = {}
    for (agent, _), own in jobs.items():
        for seed, job in enumerate(own):
            card = job.config.card()
            for name in ("source", "simulator", "scenes"):
                card["environment"].pop(name, None)
            assert card["training"].pop("seed") == seed
            assert card == cards.setdefault(agent, card)
    with pytest.raises(ValueError, match="`worlds`"):
        TransferPlan(worlds=("EXP",))


@pytest.mark.slow
def test_a_tiny_run_trains_judges_predicts_and_trains_nothing_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transfer, "RUNS", tmp_path / "runs")
    out, folder = tmp_path / "out", tmp_path / "agents"
    transfer.run(out, part="agents", plan=TINY, folder=folder)
    trained = {path: path.stat().st_mtime_ns for path in folder.glob("*.safetensors")}
    assert len(trained) == 2
    page = (out / "transfer.md").read_text()
    assert "| `compact-iso1600`" in page
    assert "<!-- tables -->\nNot measured in this run." in page
    transfer.run(out, plan=TINY, folder=folder)
    assert {path: path.stat().st_mtime_ns for path in trained} == trained
    page = (out / "transfer.md").read_text()
    assert "| ISO 6400, -3 EV |" in page
    assert "### `shadows`, frames averaged" in page
