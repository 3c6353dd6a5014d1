"""Benchmarks: the harness, measures against closed forms, whole runs on small data."""

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from agents.cli.main import BENCHMARKS
from benchmarks import harness, paper, recorded
from benchmarks.denoising import anscombe, inverse_anscombe
from benchmarks.harness import Benchmark, FinishedParts, Part, Report, cell, pivot, rounded, table
from benchmarks.throughput import full_frame
from benchmarks.work_precision.plans import _Draws
from benchmarks.work_precision.precision import pareto_front
from simulator import CameraSimulator, NoiseLevelFunction, exposure_ratio
from simulator.networks.weights import build_modules, save_modules
from simulator.training.paper_dataset import split_dataset
from tests.ae_env.recorded_files import GRID, capture, write_raws
from tests.simulator.training.captures import write_dataset
from tests.simulator.training.scenes import scene as photographed


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


# -- the paper's table, on a small dataset in the paper's layout ----------------------------------


@pytest.fixture
def here(benchmarks_here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Parts run in this process, and nothing is written elsewhere."""
    monkeypatch.setattr(paper, "WEIGHTS", tmp_path / "runs" / "paper")
    write_dataset(tmp_path / "data")
    return tmp_path


def test_train_measure_table_in_one_command(ae_env, here: Path) -> None:
    code, _, error = ae_env("bench", "paper", "data", "--quick", "--out", "results")
    assert (code, error) == (0, "")
    result = json.loads((here / "results" / "paper.json").read_text())
    assert result["meta"]["command"] == "ae-env bench paper data --quick"
    rows = result["rows"]
    means = {(r["group"], r["preset"], r["method"]): r for r in rows if "group" in r}
    networks = [("paper", m) for m in ("EXP", "NS", "Full")] + [("pc", "PC"), ("dl", "DL")]
    networks += [("compact", m) for m in ("EXP", "NS", "Full")]
    assert {key[1:] for key in means if key[0] == "all"} == set(networks)
    for key in networks:
        parts = [m["pairs"] for k, m in means.items() if k[1:] == key and k[0] != "all"]
        assert sum(parts) == means["all", *key]["pairs"] == 6
    page = (here / "results" / "paper.md").read_text()
    assert "|EXP`paper`|" in page.replace(" ", "")
    assert "36.10 / 0.923" in page  # what the paper publishes
    with Image.open(here / "results" / "paper.png") as picture:
        assert picture.width > 300
    # The exposure of w = 1, b = 0 by hand, on the pairs that were measured.
    _, held_out = split_dataset(here / "data")
    captures = {str(c.settings): c for c in held_out[0].captures}
    for row in (r for r in rows if (r["preset"], r["method"]) == ("compact", "EXP")):
        if "source" not in row:
            continue
        source, target = captures[row["source"]], captures[row["target"]]
        scale = 2.0 ** (target.settings.log2_exposure - source.settings.log2_exposure)
        pictures = [np.load(c.file).astype(float) for c in (source, target)]
        error = np.minimum(pictures[0] * scale, 1.0) - np.minimum(pictures[1], 1.0)
        decibels = -10.0 * np.log10((error**2).mean())
        assert row["psnr_db"] == pytest.approx(decibels, abs=0.02)


def test_given_weights_are_measured_and_nothing_is_trained(ae_env, here: Path) -> None:
    torch.manual_seed(0)
    save_modules(here / "mine", build_modules("paper"), "paper", {})
    assert CameraSimulator.from_pretrained(here / "mine", device="cpu").noise is not None
    options = ("--quick", "--out", "results", "--weights", "mine.safetensors")
    code, _, error = ae_env("bench", "paper", "data", *options)
    assert (code, error) == (0, "")
    rows = json.loads((here / "results" / "paper.json").read_text())["rows"]
    assert {row["preset"] for row in rows} == {"paper", "compact"}
    assert not (here / "runs" / "paper").exists()


# -- simulated states against the captures of a small recorded grid -------------------------------


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
