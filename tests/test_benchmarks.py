"""The benchmarks: their harness, measures against closed forms, and short runs as one command."""

import importlib
import json

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image
from scipy.ndimage import map_coordinates
from torch import nn

pytest.importorskip("cv2")

from ae_env.options import EnvOptions
from ae_env.scenes.load import simulate_source_raw
from ae_env.scorers.score_table import ScoreTable
from agents.cli.main import BENCHMARKS
from agents.learning import training as learning
from agents.report.plots import pareto_front
from benchmarks import emva, features, harness, paper, recorded, transfer
from benchmarks import paper_baselines as baselines
from benchmarks.denoising import anscombe, inverse_anscombe
from benchmarks.features import training
from benchmarks.harness import Part, Report, benchmark, pivot, rounded, table
from benchmarks.transfer import agents, tables
from benchmarks.transfer.agents import TableSet, TransferPlan, World
from benchmarks.work_precision.plans import distance
from simulator import NoiseLevelFunction, exposure_ratio, get_camera
from simulator.networks.weights import build_modules
from simulator.training.paper_dataset import split_dataset
from simulator.training.scenes import detail_split
from tests.ae_env.scene_files import GRID, capture, write_raws
from tests.simulator.training.scenes import scene as photographed
from tests.simulator.training.scenes import write_dataset

# -- the harness ----------------------------------------------------------------------------------


@pytest.fixture
def benchmarks_here(tmp_path, monkeypatch):
    """A folder; parts of benchmarks run in this process, and keep their results there."""

    def run(part):
        return json.loads(json.dumps(part.task(**part.arguments)))

    monkeypatch.setattr(Part, "run", run)
    monkeypatch.setattr(harness, "RUNS", tmp_path / "runs" / "bench")
    return tmp_path


def lines_of(text: str) -> list[str]:
    return text.replace(" ", "").splitlines()[0:1] + text.replace(" ", "").splitlines()[2:]


def test_tables_and_numbers() -> None:
    row = {"ms": 1.234, "none": None, "deep": {"a": [3]}, "name": "a|b", "ok": True}
    row |= {"bold": "**x**"}
    text = table([row], "name = {name} | empty = {none} | ms = {ms:.1f} ms | deep = {deep[a][0]}")
    assert lines_of(text) == ["|name|ms|deep|", "|a\\|b|1.2ms|3|"]
    assert lines_of(table([row], "ok = {ok} | b = {bold:md}")) == ["|ok|b|", "|yes|**x**|"]
    rows = [{"iso": i, "camera": c, "x": i + len(c)} for i, c in ((1, "a"), (1, "bb"), (2, "bb"))]
    wanted = ["|ISO|a|bb|", "|1|2|3|", "|2||4|"]
    assert lines_of(pivot(rows, "ISO = {iso}", "{camera}", "{x}")) == wanted
    given = {"a": [1 / 3, float("nan"), 10**9], "b": True, "c": 1.23456789e-12}
    assert rounded(given) == {"a": [0.333333, None, 10**9], "b": True, "c": 1.23457e-12}


def test_a_run_that_was_stopped_continues(tmp_path, monkeypatch):
    calls = []

    def once(part):
        calls.append(part.arguments)
        if len(calls) == 2:
            raise RuntimeError("stopped")
        return dict(part.arguments)

    def task(name: str, seed: int) -> None: ...

    monkeypatch.setattr(Part, "run", once)
    monkeypatch.setattr(harness, "RUNS", tmp_path / "runs")
    parts = [Part(name, task, {"name": name}) for name in ("first", "second", "third")]
    run = benchmark(
        "mine",
        lambda *_: parts,
        lambda results, meta: Report([*results.values()], {"numbers": "text"}),
    )
    with pytest.raises(RuntimeError, match="stopped"):
        run(tmp_path)
    run(tmp_path)
    first, second, third = ({"name": n, "seed": 0} for n in ("first", "second", "third"))
    assert calls == [first, second, second, third]
    result = json.loads((tmp_path / "mine.json").read_text())
    assert result["rows"] == [first, second, third]
    assert {"command", "commit", "seed", "date", "machine", "versions"} <= result["meta"].keys()
    page = (tmp_path / "mine.md").read_text()
    assert "<!-- origin -->\n`ae-env bench mine`" in page
    assert "<!-- numbers -->\ntext\n<!-- end -->" in page
    assert list((tmp_path / "runs" / "mine").rglob("*.*")) == []  # the next run measures again


def test_every_benchmark_of_the_command_is_there() -> None:
    for name in BENCHMARKS:
        module = "fidelity" if name == "simulator" else name
        assert callable(importlib.import_module(f"benchmarks.{module}").run)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("paper",), "ae-env bench paper FOLDER"),
        (("paper", "none"), "none must be an existing folder"),
        (("paper", "runs"), "must hold a camera_params.csv"),
        (("paper", "data", "--weights", "none.safetensors"), "there is no none.json"),
        (("ptc", "data"), "data is for emva and paper and recorded only"),
        (("ptc", "--weights", "a"), "`--weights` (='a')"),
        (("emva", "runs"), "runs must hold .npz of cameras"),
        (("recorded", "none"), "`scenes` (='recorded:"),
        (("recorded", "runs"), "`scenes` (='recorded:runs')"),
    ],
)
def test_errors_before_any_work(ae_env, benchmarks_here, arguments, named):
    (benchmarks_here / "runs").mkdir()
    write_dataset(benchmarks_here / "data")
    code, _, error = ae_env("bench", *arguments, "--out", "here")
    assert (code, error.strip().count("\n")) == (2, 0), error
    assert named in error
    assert {path.name for path in benchmarks_here.iterdir()} == {"data", "runs"}


def test_a_camera_of_counted_photons(benchmarks_here):
    """12 bits, 0.2 DN an electron, 60 % of photons, 2 DN of dark noise, 1 % of PRNU, 3 e-/ns."""
    rng, size, (gain, efficiency, dark, black) = np.random.default_rng(0), 64, (0.2, 0.6, 2.0, 100)
    photons = np.append(np.linspace(0.0, 40_000.0, 21), 50_000.0)
    times = np.append(np.arange(21.0), 5.0)  # the last is of another measurement

    gains = 1.0 + 0.01 * rng.standard_normal((size, size))

    def pairs(light):
        rate, collected = (x[:, None, None, None] for x in (efficiency * light, 3.0 * times))
        electrons = rng.poisson(rate * gains + collected, (22, 2, size, size))
        noisy = black + gain * electrons + dark * rng.standard_normal(electrons.shape)
        return np.clip(np.rint(noisy), 0, 4095).astype(np.uint16)

    light = {"bright_photons": photons, "bright_exposure_ns": times}
    np.savez(benchmarks_here / "mine.npz", bright=pairs(photons), dark=pairs(0 * photons), **light)
    emva.run(benchmarks_here / "out", folder=benchmarks_here)
    (row,) = json.loads((benchmarks_here / "out" / "emva.json").read_text())["rows"]
    known = [gain, 100 * efficiency, (dark**2 + 1 / 12) ** 0.5, dark / gain]
    for kind in ("real", "simulated"):
        found = row[kind]
        assert [*found["estimate"].values()][:4] == pytest.approx(known, rel=0.02)
        assert found["signal"][10] == pytest.approx(gain * efficiency * photons[10], rel=1e-3)
        assert max(map(abs, [*found["estimate"].values()][6:8])) < 0.2  # linear [%]
        assert found["estimate"]["PRNU1288"] == pytest.approx(1.0, rel=0.05)
        dark_current = 3e9 * (kind == "real")  # its mean is subtracted
        assert found["estimate"]["u_I_mean"] == pytest.approx(dark_current, rel=0.05, abs=2e8)
        assert found["estimate"]["u_p_sat"] == pytest.approx(3995 / gain / efficiency, abs=2001)
    assert len(row["real"]["signal"]) == 21
    camera = get_camera(f"emva:{benchmarks_here}/mine.npz?prnu=0.1")
    assert (camera.prnu, camera.dark_current) == (0.1, pytest.approx(3e9, rel=0.05))


# -- measures -------------------------------------------------------------------------------------


def test_the_front_of_time_and_error() -> None:
    ms, db = (dict(zip("abcd", v, strict=True)) for v in ((1, 2, 3, 4), (30, 35, 34, 35.004)))
    assert pareto_front(ms, db, 0.01) == ["a", "b"]


@pytest.mark.parametrize(("shift", "spread"), [(0.5, 1.5), (0.0, 0.8), (2.0, 1.0)])
def test_the_distance_of_two_normal_distributions(shift: float, spread: float) -> None:
    """Of N(m + 0.01 shift, 0.01 spread) and N(m, 0.01), half of the variance being added last."""
    generator, half = torch.Generator().manual_seed(0), (0.01 * spread) ** 2 / 2
    drawn = torch.randn(16, 4, 96, 96, generator=generator) * half**0.5
    draws = 0.2 + 0.01 * shift + drawn, torch.full_like(drawn, half)
    truth, variance = torch.full((4, 96, 96), 0.2), torch.full((4, 96, 96), 1e-4)
    expected = (shift**2 + (spread - 1.0) ** 2) ** 0.5
    assert distance(*draws, truth, variance, variance) == pytest.approx(expected, rel=0.02)


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


def test_the_noise_of_two_real_captures_is_told(tmp_path):
    """The ceiling, worked out from the calibration, against two captures of one light."""
    write_raws(tmp_path / "a")
    (scene,) = recorded._of_folder(str(tmp_path))
    everywhere = torch.ones(scene.light.shape[1:]).bool()
    body = recorded.ReferenceCamera(scene.camera)
    for state, settings in enumerate(GRID):
        again = body.capture(photographed("s0", size=40, seed=0), settings, seed=99).sample
        error = (again - capture(settings, 0).data).double().square().mean()
        ceiling = recorded._ceiling(scene, GRID, state, everywhere)
        assert ceiling == pytest.approx(-10.0 * np.log10(float(error)), abs=0.3)
    # Variances of 4 and 1 (of 1e-6), and a mean that is 2e-3 off: 2 and 1 of the real deviation.
    ceiling, error = (-10.0 * np.log10(v * 1e-6) for v in (2.0, 4.0 + 1.0 + 4.0))
    assert recorded._distance(error, ceiling, 3e-6) == pytest.approx(5.0**0.5)
    assert recorded._distance(ceiling, ceiling, 0.0) == pytest.approx(0.0, abs=1e-6)


# -- local features -------------------------------------------------------------------------------


def test_measures_of_matches_that_are_known() -> None:
    """20 of 40 points are 2.5 pixels off to the right, under a shift by (4, -3)."""
    descriptors = torch.eye(40)
    grid = np.stack(np.meshgrid(np.arange(20.0, 140, 20), np.arange(20.0, 140, 18)), -1)
    first = grid.reshape(-1, 2)[:40]
    shift = np.array([[1.0, 0.0, 4.0], [0.0, 1.0, -3.0], [0.0, 0.0, 1.0]])
    second = first + np.array([4.0, -3.0])
    second[:20, 0] += 2.5
    a, b = (training.Features(torch.from_numpy(p), descriptors) for p in (first, second))
    half, exact = features.measures(a, b, shift), features.measures(b, b, np.eye(3))
    assert half["repeatability"] == 0.5
    assert [half[f"accuracy_{k}"] for k in (1, 2, 3, 4, 5)] == [0.5, 0.5, 1.0, 1.0, 1.0]
    assert (exact["repeatability"], exact["matches"]) == (1.0, 40)
    assert exact["corner_error"] < 0.01
    none = features.measures(training.Features(a.points[:0], descriptors[:0]), b, shift)
    assert none["repeatability"] == none["accuracy_5"] == 0.0
    assert none["corner_error"] == float("inf")


def test_views_of_a_picture_agree_under_their_homography() -> None:
    """Light that is linear in x and y: its value at a place is known in both views."""
    y, x = torch.meshgrid(torch.arange(800.0), torch.arange(800.0), indexing="ij")
    source = training.Source("ramp", "ramp", torch.stack([x, y, x + y]) / 1600.0)
    # Private: the light of a pair is nowhere else before it is noisy.
    scenes, homography = features._views(source, np.random.default_rng(3))
    places = np.array([[60.0, 70.0], [90.0, 80.0], [75.0, 100.0]])
    both = (places, training.mapped(places, homography))
    for channel in (0, 1):  # photosites are half as far apart as the pixels of a homography
        one, other = (
            map_coordinates(scene.light[channel].numpy(), 2.0 * at[:, ::-1].T + 0.5, order=1)
            for scene, at in zip(scenes, both, strict=True)
        )
        assert one == pytest.approx(other, abs=0.5 / 1600)


def test_features_are_trained_judged_and_reported(ae_env, benchmarks_here, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "RUNS", tmp_path / "runs" / "bench")
    monkeypatch.setattr(training, "QUICK_STEPS", 1)
    monkeypatch.setattr(features, "TIMED", (80,))
    monkeypatch.setattr(features, "median_seconds", lambda call, **_: 1e-3)  # each is called once
    monkeypatch.setenv("AE_ENV_DATA", str(tmp_path))
    (tmp_path / "photo_pool").mkdir()
    names = [f"drawn{number}" for number in range(100)]
    split = {s: [n for n in names if detail_split(n) == s] for s in ("train", "validation", "test")}
    for name in (*split["train"][:2], *split["validation"][:1], *split["test"][:2]):
        blocks = np.random.default_rng(0).integers(0, 255, (24, 32, 3)).astype(np.uint8)
        picture = Image.fromarray(blocks).resize((512, 384), Image.Resampling.NEAREST)
        picture.save(tmp_path / "photo_pool" / f"{name}.png")
    code, _, error = ae_env("bench", "features", "--quick", "--out", "results")
    assert (code, error) == (0, "")
    rows = json.loads((tmp_path / "results" / "features.json").read_text())["rows"]
    means = {(r["arm"], *r["gaps"]) for r in rows if r["part"] == "mean"}
    assert means >= {(arm, gap) for arm in training.AUGMENTATIONS for gap in (0.0, 4.0)}
    assert "| **ours, in full** " in (tmp_path / "results" / "features.md").read_text()
    assert training.train("full", 0, 1, 4)[1] == training.train("full", 0, 1, 4)[1]  # kept


# -- recorded grids and the paper's layout ---------------------------------------------------------


def test_a_recorded_grid_of_ones_own(ae_env, benchmarks_here):
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
    frames, row = torch.stack([capture(s).data for s in GRID]).double(), rows["a", "scaled"]
    source = int((frames[:, 1:3].mean(dim=(1, 2, 3)) - 0.12).abs().argmin())
    assert row["source_state"] == str(GRID[source])
    assert float(frames[source].max()) < 0.8  # so that all of it is known, and compared
    errors = []
    for state, settings in enumerate(GRID):
        if state != source:
            scaled = (frames[source] * exposure_ratio(GRID[source], settings)).clamp(max=1.0)
            errors.append(-10.0 * np.log10(float((scaled - frames[state]).square().mean())))
    assert row["known_share"] == 1.0
    assert row["psnr_db"] == pytest.approx(np.median(errors), abs=0.3)  # the pedestal clips
    assert row["psnr_all_db"] == row["psnr_db"] == row["psnr_expected_db"]
    # The simulated frames have the noise of real ones, at the cost of PSNR against noisy ones.
    simulated = rows["a", "simulated"]
    assert simulated["noise_error_stops"] < row["noise_error_stops"]
    assert simulated["psnr_expected_db"] > simulated["psnr_db"]
    assert all(0.0 <= own["oracle_regret"] < 0.2 for own in rows.values())
    page = (benchmarks_here / "results" / "recorded.md").read_text()
    assert "|grid|tworealcaptures|" in page.replace(" ", "")
    assert "boreal" not in page


def test_the_papers_table_in_one_command(ae_env, benchmarks_here, monkeypatch):
    monkeypatch.setattr(paper, "WEIGHTS", benchmarks_here / "runs" / "paper")
    monkeypatch.setattr(paper, "TRAINED", ("paper", "pc"))
    monkeypatch.setattr(paper, "QUICK_STAGE", {"steps": 1, "batch": 1, "crop": 16})
    write_dataset(benchmarks_here / "data")
    code, _, error = ae_env("bench", "paper", "data", "--quick", "--out", "results")
    assert (code, error) == (0, "")
    rows = json.loads((benchmarks_here / "results" / "paper.json").read_text())["rows"]
    means = {(r["group"], r["preset"], r["method"]): r for r in rows if "group" in r}
    networks = [(p, m) for p in ("paper", "compact") for m in ("EXP", "NS", "Full")]
    networks.append(("pc", "PC"))
    assert {key[1:] for key in means if key[0] == "all"} == set(networks)
    for key in networks:
        parts = [m["pairs"] for k, m in means.items() if k[1:] == key and k[0] != "all"]
        assert sum(parts) == means["all", *key]["pairs"] == 6
    page = (benchmarks_here / "results" / "paper.md").read_text()
    assert "|EXP`paper`|" in page.replace(" ", "")
    assert "36.10 / 0.923" in page  # what the paper publishes
    # The exposure of w = 1, b = 0 by hand, on the pairs that were measured.
    _, held_out = split_dataset(benchmarks_here / "data")
    captures = {str(c.settings): c for c in held_out[0].captures}
    for row in (r for r in rows if (r["preset"], r["method"]) == ("compact", "EXP")):
        if "source" in row:
            source, target = captures[row["source"]], captures[row["target"]]
            scale = 2.0 ** (target.settings.log2_exposure - source.settings.log2_exposure)
            pictures = [np.load(c.file).astype(float) for c in (source, target)]
            wrong = np.minimum(pictures[0] * scale, 1.0) - np.minimum(pictures[1], 1.0)
            assert row["psnr_db"] == pytest.approx(-10.0 * np.log10((wrong**2).mean()), abs=0.02)
    # Given weights are measured instead of what would be trained.
    (mine,) = (benchmarks_here / "runs" / "paper").glob("paper-*/*.safetensors")
    parts = paper.parts(0, True, benchmarks_here / "data", mine)
    assert [part.arguments["name"] for part in parts] == [str(mine), "compact"]


# -- the paper's baselines, against their papers' tables and PyTorch's layers ----------------------

#: Log2 of ISO / 100, exposure time and f-number, of the source and then of the target.
PARAMETERS = torch.tensor(
    [[0, -7, 3.5, 6, -10, 2], [7.3, -13, 2, 0, 2, 4.5], [2, -5, 2.5, 3, -6, 2.5]]
)


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("make", [baselines.ParameterConcatenation, baselines.DecoupledNet])
def test_batch_of_different_parameters_equals_single_runs(make):
    net = make(width=6).eval().double()
    for module in net.modules():  # running statistics that differ from a single image's
        if isinstance(module, baselines.AdaptiveNorm):
            nn.init.constant_(module.normalised, 0.5)
            module.norm.running_mean.normal_()
    images = normal(3, 4, 9, 7).double()
    alone = [net(images[i : i + 1], PARAMETERS[i : i + 1]) for i in range(3)]
    torch.testing.assert_close(net(images, PARAMETERS), torch.cat(alone))


def test_baselines_have_as_many_parameters_as_published():
    # CAN32 of Chen et al. 2017, six more inputs; 7 numbers a weight of 20 convolutions, 19 norms.
    for preset, parameters in (("pc", 77_046), ("dl", 4_884_288)):
        modules = build_modules(preset)
        assert sum(p.numel() for p in modules.parameters()) == parameters


def test_adaptive_normalisation() -> None:
    """lambda * x + mu * BN(x): over the batch in training, with running statistics after it."""
    norm = baselines.AdaptiveNorm(3).double()
    x = normal(2, 3, 4, 5).double() * 2 + 1
    assert torch.equal(norm(x), x)  # lambda = 1, mu = 0
    nn.init.constant_(norm.identity, 0.3)
    nn.init.constant_(norm.normalised, 2.0)
    mean = x.mean(dim=(0, 2, 3), keepdim=True)
    deviation = (x.var(dim=(0, 2, 3), keepdim=True, correction=0) + 1e-3).sqrt()
    torch.testing.assert_close(norm(x), 0.3 * x + 2.0 * (x - mean) / deviation)
    norm.eval()
    norm.norm.running_mean.fill_(0.5)
    norm.norm.running_var.fill_(4.0 - 1e-3)
    torch.testing.assert_close(norm(x), 0.3 * x + 2.0 * (x - 0.5) / 2.0)


def test_receptive_field_of_the_published_table() -> None:
    """513 pixels (Chen et al. 2017, table 1)."""
    net = baselines.ParameterConcatenation(width=1).eval()
    for parameter in net.parameters():
        nn.init.ones_(parameter)  # positive, lest contributions cancel
    image = torch.ones(1, 4, 1, 701, requires_grad=True)
    net(image, torch.zeros(1, 6))[0, 0, 0, 350].backward()
    reached = image.grad[0, 0, 0].nonzero().flatten()
    assert (int(reached[0]), int(reached[-1])) == (350 - 256, 350 + 256)


@pytest.mark.parametrize("options", [{}, {"stride": 2}, {"dilation": 4}, {"upsample": True}])
def test_generated_convolution_is_each_sample_s_own(options: dict[str, int]) -> None:
    torch.manual_seed(0)
    layer = baselines.GeneratedConvolution(5, 5, **options).double()
    x = normal(3, 5, 7, 6).double()
    parameters = baselines.scaled_parameters(PARAMETERS, x)
    result = layer(x, parameters)
    for i in range(3):
        flat = layer.generator.weight @ parameters[i] + layer.generator.bias
        one = x[i : i + 1]
        if layer.upsample:
            expected = F.conv_transpose2d(one, flat.reshape(5, 5, 4, 4), stride=2, padding=1)
        else:
            padded = {"padding": options.get("dilation", 1), **options}
            expected = F.conv2d(one, flat.reshape(5, 5, 3, 3), **padded)
        torch.testing.assert_close(result[i : i + 1], expected)


def test_edge_map() -> None:
    """A ramp of slope 1 along the rows: two differences of 1 inside, one at the ends, over 4."""
    ramp = torch.arange(4.0).expand(1, 4, 3, 4)
    assert baselines.edge_map(ramp)[0, 0].tolist() == [[0.25, 0.5, 0.5, 0.25]] * 3
    assert torch.equal(baselines.edge_map(ramp.mT), baselines.edge_map(ramp).mT)
    assert baselines.edge_map(torch.ones(1, 4, 1, 1)).item() == 0.0


# -- transfer -------------------------------------------------------------------------------------

TINY = TransferPlan(
    scenes="bundled:small",
    worlds=("truth", "compact-iso1600"),
    agents=("regression",),
    seeds=(0,),
    frames=8,
    episodes=1,
    judged_scenes=4,
    tables=(
        TableSet("balanced", 2, ("EXP", "compact"), (6400,), (-3, 3), ("native",)),
        TableSet("shadows", 2, ("compact",), (100,), (0,), ("box",)),
    ),
)


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
    # Score a^2 b: a part wrong where the other is 0 makes no error.
    parts = {"a": np.array([0.5, 1.0]), "b": np.array([0.0, 0.5])}
    wrong = {"a": np.array([0.9, 0.8]), "b": np.array([0.1, 0.5])}
    true, predicted = (ScoreTable(np.zeros(2), np.zeros(2), own) for own in (parts, wrong))
    terms = tables.errors(predicted, true, lambda own: own["a"] ** 2 * own["b"])["terms"]
    assert terms == pytest.approx({"a": 0.5 * (0.5 - 0.32), "b": 0.5 * 0.025})


def test_tables_are_averaged_over_source_groups_and_compared_in_pairs() -> None:
    """Groups a, a, b: the mean of (0.1 + 0.3) / 2 and 0.4 is 0.3; EXP has 0.05 more everywhere."""
    measured = []
    for group, regret in (("a", 0.1), ("a", 0.3), ("b", 0.4)):
        for name, more in (("EXP", 0.05), ("compact", 0.0)):
            row = {"simulator": name, "group": group, "regret": regret + more}
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


def test_sources_of_high_iso_differ_from_others_in_nothing_else() -> None:
    options = {"split": "test", "resolution": 64, "simulator": None}
    plain = EnvOptions(scenes="bundled:small", **options).load_scenes()
    world = World("EXP", high_iso=True).options("bundled:small")
    found = EnvOptions.from_kwargs({**options, **world}).load_scenes()
    isos = [scene.reference.iso for scene in found]
    assert agents.HIGH_ISO[0] <= min(isos) < 2500.0 < max(isos) <= agents.HIGH_ISO[1]
    for scene, truth in zip(found[:4], plain, strict=False):
        again = simulate_source_raw(truth, iso=scene.reference.iso)
        assert (scene.content, scene.reference) == (again.content, again.reference)


def load_small_config(path):
    return learning.load_config(path).model_copy(update={"num_envs": 4})


def train_here(jobs: list[learning.TrainingJob]) -> None:
    for job in jobs:
        assert not learning.is_trained(job.config, job.out)
        learning.train_agent(job.config, job.out)


def test_a_tiny_transfer_trains_judges_and_predicts(benchmarks_here, monkeypatch):
    monkeypatch.setattr(agents, "QUICK", TINY)
    monkeypatch.setattr(agents, "RUNS", benchmarks_here / "runs" / "bench")
    monkeypatch.setattr(agents, "load_config", load_small_config)
    monkeypatch.setattr(agents, "train_in_parallel", train_here)  # processes take seconds to start
    out, folder = benchmarks_here / "out", benchmarks_here / "runs" / "bench_transfer_quick"
    transfer.run(out, part="agents", quick=True)
    page = (out / "transfer.md").read_text()
    assert "| `compact-iso1600`" in page
    assert "<!-- tables -->\nNot measured in this run." in page
    again = [job for own in agents.training_jobs(TINY, folder).values() for job in own]
    assert [learning.is_trained(job.config, job.out) for job in again] == [True] * 2
    transfer.run(out, part="tables", quick=True)
    page = (out / "transfer.md").read_text()
    assert "| ISO 6400, -3 EV |" in page
    assert "### `shadows`, frames averaged" in page
