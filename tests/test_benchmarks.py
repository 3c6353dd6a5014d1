"""The harness of the benchmarks: tables, rounding, runs that continue where they were stopped."""

import importlib
import json
from pathlib import Path
from typing import Any

import pytest
import torch

from agents.cli.main import BENCHMARKS
from benchmarks import harness
from benchmarks.denoising import anscombe, inverse_anscombe
from benchmarks.harness import Benchmark, FinishedParts, Part, Report, cell, pivot, rounded, table
from benchmarks.throughput import full_frame
from benchmarks.work_precision.plans import _Draws
from benchmarks.work_precision.precision import pareto_front
from simulator import NoiseLevelFunction


def test_cells_of_missing_values_are_empty_and_pipes_escaped() -> None:
    row = {"ms": 1.234, "none": None, "deep": {"a": [3]}, "name": "a|b"}
    assert cell(row, "{ms:.1f} ms") == "1.2 ms"
    assert (
        cell(row, "{ms:.1f} ± {none:.2f}") == cell(row, "{absent}") == cell(row, "{deep[b]}") == ""
    )
    assert cell(row, "{deep[a][0]}") == "3"
    text = table([row], {"name": "{name}", "empty": "{none}", "ms": lambda r: 2 * r["ms"]})
    assert text.replace(" ", "").splitlines()[0::2] == ["|name|ms|", "|a\\|b|2.468|"]


def test_frames_of_a_throughput_run_with_all_its_parts() -> None:
    """A part of another kind has no file in its name."""
    results = {"paired 1": [], "libraw|a.dng": {"s": 1}, "frame|a.dng|full": {"s": 2}}
    wanted = {"case": "full", "file": "a.dng", "s": 2, "libraw": {"s": 1}}
    assert full_frame.rows(results) == [wanted]


def test_a_pivot_has_a_line_for_each_value_and_gaps_where_there_is_no_row() -> None:
    rows = [{"iso": i, "camera": c, "x": i + len(c)} for i, c in ((1, "a"), (1, "bb"), (2, "bb"))]
    text = pivot(rows, line=("ISO", "{iso}"), columns="{camera}", contents={"": "{x}"})
    assert text.replace(" ", "").splitlines()[0::2] == ["|ISO|a|bb|", "|1|2|3|"]
    assert text.replace(" ", "").splitlines()[3] == "|2||4|"


def test_numbers_keep_six_digits_and_none_for_what_json_cannot_hold() -> None:
    given = {"a": [1 / 3, float("nan"), 10**9], "b": True, "c": 1.23456789e-12}
    assert rounded(given) == {"a": [0.333333, None, 10**9], "b": True, "c": 1.23457e-12}


def test_damaged_parts_of_a_stopped_run_are_measured_again(tmp_path: Path) -> None:
    finished = FinishedParts(tmp_path, 0)
    assert finished.get("part", lambda: [1, 2]) == [1, 2]
    assert finished.get("part", lambda: [3]) == [1, 2]
    assert FinishedParts(tmp_path, 1).get("part", lambda: [4]) == [4]  # of another seed
    for path in tmp_path.iterdir():
        path.write_text("[1, 2")
    assert finished.get("part", lambda: [3]) == [3]
    finished.forget()
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_was_stopped_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []

    def isolated(task: Any, **arguments: Any) -> Any:
        calls.append(arguments["name"])
        if len(calls) == 2:
            raise RuntimeError("stopped")
        return {"name": arguments["name"]}

    monkeypatch.setattr(harness, "isolated", isolated)
    monkeypatch.setattr(harness, "RUNS", tmp_path / "runs")
    benchmark = Benchmark(
        name="mine",
        title="Mine",
        parts=lambda *_: [Part(name, print, {"name": name}) for name in ("first", "second")],
        report=lambda results, meta: Report(list(results.values()), {"numbers": "text"}),
        code=("benchmarks/isolated",),
    )
    with pytest.raises(RuntimeError, match="stopped"):
        benchmark.run(tmp_path)
    benchmark.run(tmp_path)
    assert calls == ["first", "second", "second"]
    result = json.loads((tmp_path / "mine.json").read_text())
    assert result["rows"] == [{"name": "first"}, {"name": "second"}]
    assert {"command", "commit", "seed", "date", "machine", "versions"} <= result["meta"].keys()
    page = (tmp_path / "mine.md").read_text()
    assert page.startswith("# Mine\n\n<!-- origin -->\n`ae-env bench mine`")
    assert "<!-- numbers -->\ntext\n<!-- end -->" in page
    assert list((tmp_path / "runs" / "mine").iterdir()) == []


def test_every_benchmark_of_the_command_can_be_imported_and_names_its_code() -> None:
    for name in BENCHMARKS:
        stem = {"simulator": "fidelity"}.get(name, name.replace("-", "_"))
        module = importlib.import_module(f"benchmarks.{stem}")
        assert callable(module.run)
        for code in module.BENCHMARK.code if hasattr(module, "BENCHMARK") else ():
            path = harness.ROOT / code
            assert path.is_dir() or path.with_suffix(".py").is_file(), code


def test_the_front_of_time_and_error() -> None:
    points = [(1.0, 30.0), (2.0, 35.0), (3.0, 34.0), (4.0, 35.004)]
    assert pareto_front(points) == [True, True, False, False]


@pytest.mark.parametrize(("shift", "spread"), [(0.5, 1.5), (0.0, 0.8), (2.0, 1.0)])
def test_the_distance_of_two_normal_distributions(shift: float, spread: float) -> None:
    """Of N(m + 0.01 shift, 0.01 spread) and N(m, 0.01), half of the variance being added last."""
    generator, half = torch.Generator().manual_seed(0), (0.01 * spread) ** 2 / 2
    drawn = torch.randn(16, 4, 96, 96, generator=generator) * half**0.5
    draws = _Draws(0.2 + 0.01 * shift + drawn, torch.full_like(drawn, half))
    truth, variance = torch.full((4, 96, 96), 0.2), torch.full((4, 96, 96), 1e-4)
    expected = (shift**2 + (spread - 1.0) ** 2) ** 0.5
    assert draws.distance(truth, variance, variance) == pytest.approx(expected, rel=0.02)


def test_the_inverse_anscombe_transform_is_unbiased() -> None:
    """Means of transformed samples of 2 to 200 electrons give the electrons back."""
    generator, electrons = torch.Generator().manual_seed(0), torch.tensor([2.0, 5.0, 30.0, 200.0])
    mean = electrons[:, None, None].expand(4, 400, 400).contiguous() / 1000.0
    samples = torch.poisson(1000.0 * mean, generator=generator) / 1000.0
    samples += 2e-3 * torch.randn(samples.shape, generator=generator)
    nlf = NoiseLevelFunction((1e-3,) * 4, (4e-6,) * 4)
    stable = anscombe(samples.double(), nlf).mean(dim=(1, 2), keepdim=True)
    found = 1000.0 * inverse_anscombe(stable, nlf).flatten()
    assert found.tolist() == pytest.approx(electrons.tolist(), rel=0.02)
