"""Scorers by name, from files, from other packages and from pyiqa, and the list of them all."""

import sys
import types
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ae_env.scenes import Scene
from ae_env.scorers import CompositeScorer, list_scorers, make_scorer, register_scorer, registry
from ae_env.scorers.captures import Captures
from ae_env.scorers.defects import DEFECTS
from ae_env.scorers.registry import ScorerRow, describe_scorers, scorer_fingerprint
from ae_env.scorers.score_table import TIE, ScoreTables
from ae_env.scorers.terms import Noise
from simulator import NoiseLevelFunction
from tests.ae_env.scorer_images import CAMERA, random_pictures
from tests.strategies import LIGHT, USUAL_SETTINGS, grids, lights

MINE = '''
import torch

class Level:
    """Level of the *frame*.

    More of it.
    """

    domain = "raw"

    def __call__(self, images, captures):
        return images.mean(dim=(1, 2, 3)).clamp(0, 1)
'''


def _install(folder: Path, name: str, module: str, entries: str) -> None:
    """A package as pip leaves it: its module, and metadata with entry points."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / f"{name}.py").write_text(module)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[ae_env.scorers]\n{entries}\n")


def test_a_real_entry_point_works_and_is_listed_beside_broken_ones(tmp_path, monkeypatch):
    _install(tmp_path, "their_scores", MINE, "their_level = their_scores:Level")
    broken = "broken = broken_scores:Mine\ngone = not_there:Mine\nends = broken_scores_2:Mine"
    _install(tmp_path, "broken_scores", "raise OSError('no licence')", broken)
    (tmp_path / "broken_scores_2.py").write_text("raise SystemExit(3)")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    images = torch.full((2, 4, 5, 5), 0.25)
    scorer = make_scorer({"their_level": 1.0})
    assert scorer.parts["their_level"](images, None).tolist() == [0.25, 0.25]
    rows = {row.name: row for row in describe_scorers()}
    assert list(rows) == list_scorers()
    level = ScorerRow("their_level", "raw", "image", "", "Level of the *frame*.", "their_scores")
    assert rows["their_level"] == level
    errors = {"broken": "OSError: no licence", "ends": "SystemExit: 3"}
    errors["gone"] = "ModuleNotFoundError: No module named 'not_there'"
    for name, error in errors.items():
        assert rows[name].error == error
        with pytest.raises(ValueError, match=rf"`scorer` \(='{name}'\) cannot be loaded.*{error}"):
            make_scorer(name)
    assert (rows["balanced"].domain, rows["defects"].domain) == ("raw", "srgb")
    assert (rows["balanced"].depends_on, rows["noise"].depends_on) == ("image", "image")
    assert rows["nima_technical"].needs == "weights: AE_ENV_NIMA_TECHNICAL"
    assert rows["keypoints"].needs == "extra cv"
    assert {name for name, row in rows.items() if row.error} == set(errors)
    sys.modules.pop("their_scores", None)


def test_a_file_works_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "mine too"
    folder.mkdir()
    (folder / "my_scorer.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    relative = make_scorer("mine too/my_scorer.py:Level")
    monkeypatch.chdir(folder)
    mixed = make_scorer({f"{folder}/my_scorer.py:Level": 3.0, "noise": 1.0})
    assert mixed.weights == {"Level": 0.75, "noise": 0.25}
    assert type(mixed.parts["Level"]) is type(relative.parts["Level"])
    for spec, message in (
        ("my_scorer.py:Levle", r"`scorer` \(='my_scorer.py:Levle'\).*did you mean 'Lev"),
        ({"no.py:Level": 1.0}, r"`scorer` \(='no.py:Level'\): there is no file 'no.py'"),
        ("my_scorer.py:torch", "must be callable"),
    ):
        with pytest.raises(ValueError, match=message):
            make_scorer(spec)


class FakeMetric:
    """A metric of pyiqa, which states its range."""

    def __init__(self, mode: str, lower: bool | None, score_range: str | None) -> None:
        self.metric_mode, self.lower_better, self.score_range = mode, lower, score_range

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        assert images.shape[1] == 3
        return 100.0 * images.mean(dim=(1, 2, 3))[:, None]


def test_metrics_of_pyiqa_are_mapped_to_their_range(monkeypatch: pytest.MonkeyPatch) -> None:
    metrics = {
        "musiq": FakeMetric("NR", False, "~0, ~100"),
        "niqe": FakeMetric("NR", True, "-50.0, 150"),
        "lpips": FakeMetric("FR", True, "0, 1"),
        "open": FakeMetric("NR", True, "0, inf"),
        "old": FakeMetric("NR", None, None),
    }
    module: Any = types.ModuleType("pyiqa")
    module.create_metric = lambda name, device: metrics[name]
    monkeypatch.setitem(sys.modules, "pyiqa", module)
    images = torch.tensor([0.0, 0.25, 1.0])[:, None, None, None].expand(3, 3, 4, 4)
    higher = make_scorer("pyiqa:musiq")
    assert list(higher.parts) == ["musiq"]
    assert higher.parts["musiq"](images, None).tolist() == [0.0, 0.25, 1.0]
    lower = make_scorer({"pyiqa:niqe": 0.5, "noise": 0.5}).parts["niqe"]
    assert lower(images, None).tolist() == [0.75, 0.625, 0.25]
    assert lower.domain == "srgb"
    for name, message in (
        *(("lpips", "needs no reference"), ("open", "two finite"), ("old", "two finite")),
        ("nothing", "KeyError: 'nothing'"),
    ):
        with pytest.raises(ValueError, match=rf"`scorer` \(='pyiqa:{name}'\).*{message}"):
            make_scorer(f"pyiqa:{name}")
    monkeypatch.setitem(sys.modules, "pyiqa", None)
    with pytest.raises(ImportError, match=r"pyiqa:musiq.*non-commercial.*pip install pyiqa"):
        make_scorer("pyiqa:musiq")


def test_registered_scorers_work_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))
    register_scorer("mean_signal")(Constant)
    register_scorer("mean_signal")(Constant)  # a notebook cell run twice
    assert "mean_signal" in list_scorers()
    assert list(make_scorer({"mean_signal": 1, "noise": 1}).parts) == ["mean_signal", "noise"]
    with pytest.raises(ValueError, match="built-in"):
        register_scorer("noise")(Constant)
    with pytest.raises(ValueError, match="identifier"):
        register_scorer("my score")


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("balancd", "did you mean 'balanced'"),
        ("no_such_module:Thing", "cannot be loaded: "),
        ("ae_env.scorers.terms:Nothing", "cannot be loaded: "),
        ("math:pi", "must be callable"),
        ({}, "must map one name or more"),
        (lambda images, captures: None, "must be 'raw' or 'srgb'"),
        (3, "name, a mapping of weights or a callable"),
    ],
)
def test_bad_scorers_are_refused(spec: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_scorer(spec)


class Constant:
    domain, depends_on = "raw", "light"

    def __init__(self, value: float = 0.5, version: int | None = None) -> None:
        self.value = value
        if version is not None:
            self.version = version

    def __call__(self, images: Any, captures: Captures) -> torch.Tensor:
        return torch.full((len(captures),), self.value)


def test_scorers_inside_of_others_enter_the_key() -> None:
    def nested(value: float, version: int | None = None, deeper: bool = False) -> str | None:
        inner = CompositeScorer({"p": Constant(value, version)})
        inner = CompositeScorer({"in": inner}) if deeper else inner
        return scorer_fingerprint(CompositeScorer({"in": inner, "noise": Noise()}))

    assert nested(0.2) is nested(0.2, deeper=True) is None  # its text may change unnoticed
    kinds = [(0.2, 1), (0.8, 1), (0.2, 2), (0.2, 1, True)]
    assert len({nested(*kind) for kind in kinds}) == 4
    assert nested(0.2, 1) == nested(0.2, 1)


IMAGE_SCORERS = ["mid_grey", "clipping", "well_exposedness", "entropy", "shim", "zhang", "shin"]
IMAGE_SCORERS += ["blind_noise", *(f"analytic_{defect}" for defect in DEFECTS)]


@pytest.mark.parametrize("name", IMAGE_SCORERS)
def test_any_picture_has_a_score_alone_and_in_a_batch(name: str) -> None:
    scorer = make_scorer(name).parts[name]
    channels = 3 if scorer.domain == "srgb" else 4
    pictures = random_pictures()[:, :channels].contiguous()
    before = pictures.clone()
    scores = scorer(pictures, None)
    assert torch.equal(pictures, before)
    assert (scores.shape, scores.dtype) == ((5,), torch.float64)
    assert torch.equal(scores, scorer(pictures, None))
    alone = torch.cat([scorer(picture[None], None) for picture in pictures])
    torch.testing.assert_close(alone, scores, rtol=0.0, atol=1e-6)
    for height, width in ((1, 1), (1, 7), (2, 2), (3, 1), (5, 9), (13, 11), (36, 36)):
        extremes = torch.zeros(3, channels, height, width)
        extremes[1] = 1.0
        extremes[2] = random_pictures(1, height, width)[:, :channels]
        values = scorer(extremes, None)
        assert bool(((values >= 0.0) & (values <= 1.0)).all()), (height, width)


@settings(max_examples=12)  # each of all scorers
@given(
    lights(LIGHT.map(abs)),
    USUAL_SETTINGS,
    grids(),
    st.sampled_from([None, 1e-3, 640.0, 1e6]),
    st.booleans(),
    st.sampled_from([0.0, 1e-3, 1.0, 100.0]),
    st.sampled_from([0.0, 1.0, 25.0]),
    st.sampled_from([1.0, 2.0**-20, 2.0**20]),
)
def test_scores_are_shares_and_the_oracle_has_the_highest(
    light, reference, grid, illuminance, is_noisy, speed, defocus, gain
):
    if float((light[1:3] > 0).double().mean()) <= 0.2:
        illuminance = illuminance or 640.0  # no exposure is right for a black frame
    nlf = CAMERA.nlf(reference.iso) if is_noisy else NoiseLevelFunction.zero()
    scene = Scene.from_array(
        light, reference, CAMERA, scene_id="any", nlf=nlf, illuminance=illuminance
    )
    for name in list_scorers(self_contained=True):
        tables = ScoreTables(grid, CAMERA, make_scorer(name))
        table = tables.table(scene, speed=speed, defocus=defocus, gain=gain)
        for values in (table.mean, *table.parts.values()):
            assert values.shape == (len(grid),)
            assert bool(((values >= 0.0) & (values <= 1.0)).all())
        best = table.mean.max()
        assert table.mean[table.oracle] >= best - TIE
        assert bool((table.mean[: table.oracle] < best - TIE).all())
