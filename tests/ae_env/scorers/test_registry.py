"""Scorers from files, from other packages and from pyiqa, and the list of them all."""

from __future__ import annotations

import pickle
import sys
import types
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch

import ae_env  # noqa: F401, registers the environment
from ae_env.scorers import list_scorers, make_scorer, registry
from ae_env.scorers.composite import CompositeScorer
from ae_env.scorers.registry import ScorerRow, describe_scorers

ID = "ae_env/AutoExposure-v0"
SMALL = {"scenes": "bundled:small", "split": "test", "resolution": 36}
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
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.py").write_text(module)
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[ae_env.scorers]\n{entries}\n")


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One package that works, and one with three entry points that do not."""
    folder = tmp_path / "site"
    _install(folder, "their_scores", MINE, "their_level = their_scores:Level")
    broken = "broken = broken_scores:Mine\ngone = not_there:Mine\nends = broken_scores_2:Mine"
    _install(folder, "broken_scores", "raise OSError('no licence')", broken)
    (folder / "broken_scores_2.py").write_text("raise SystemExit(3)")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)


@pytest.mark.usefixtures("packages")
def test_a_real_entry_point_works_beside_broken_ones() -> None:
    assert {"their_level", "broken", "gone", "ends", "balanced"} <= set(list_scorers())
    images = torch.full((2, 4, 5, 5), 0.25)
    scorer = make_scorer({"their_level": 1.0})
    assert scorer.parts["their_level"](images, None).tolist() == [0.25, 0.25]  # type: ignore[arg-type]
    for name, cause in (("broken", "no licence"), ("gone", "not_there"), ("ends", "SystemExit: 3")):
        with pytest.raises(ValueError, match=rf"`scorer` \(='{name}'\) cannot be loaded.*{cause}"):
            make_scorer(name)
    assert make_scorer("noise").closed_form
    sys.modules.pop("their_scores", None)


@pytest.mark.usefixtures("packages")
def test_the_list_tells_of_each_scorer() -> None:
    rows = {row.name: row for row in describe_scorers()}
    assert list(rows) == list_scorers()
    level = ScorerRow("their_level", "raw", "image", "", "Level of the *frame*.", "their_scores")
    assert rows["their_level"] == level
    assert rows["broken"].error == "OSError: no licence"
    assert rows["gone"].error == "ModuleNotFoundError: No module named 'not_there'"
    assert rows["ends"].error == "SystemExit: 3"
    assert rows["balanced"].depends_on == "blur"
    assert (rows["balanced"].domain, rows["defects"].domain) == ("raw", "srgb")
    assert rows["noise"].depends_on == "light"
    assert rows["nima_technical"].needs == "weights: AE_ENV_NIMA_TECHNICAL"
    assert rows["keypoints"].needs == "extra cv"
    for row in rows.values():
        if row.package == "ae-env":
            assert not row.error
            assert row.domain in ("raw", "srgb")
            assert row.summary.endswith(".")
    sys.modules.pop("their_scores", None)


def test_one_of_several_parts_sees_what_they_see(monkeypatch: pytest.MonkeyPatch) -> None:
    class Mixed(CompositeScorer):
        """All of it."""

        def __init__(self) -> None:
            super().__init__({name: make_scorer(name) for name in ("entropy", "clipping", "snr")})

    monkeypatch.setitem(registry._REGISTRY, "mixed", Mixed)
    assert {row.name: row.domain for row in describe_scorers()}["mixed"] == "raw, srgb"


def test_the_spec_of_an_environment_goes_to_other_processes(tmp_path: Path) -> None:
    """As docs/scorers.md says of a scorer from a file, whose class no other process knows."""
    (tmp_path / "my_scorer.py").write_text(MINE)
    env = gym.make(ID, scorer=f"{tmp_path}/my_scorer.py:Level", **SMALL)
    content = pickle.dumps(env.spec)
    for name in [name for name in sys.modules if name.startswith("ae_env_user_")]:
        del sys.modules[name]
    other = gym.make(pickle.loads(content))
    rewards = [(e.reset(seed=0), e.step(5))[1][1] for e in (env, other)]
    assert rewards[0] == rewards[1] > 0.0


def test_only_the_self_contained(monkeypatch: pytest.MonkeyPatch) -> None:
    names = list_scorers(self_contained=True)
    assert {"balanced", "noise"} <= set(names) < set(list_scorers())
    needy = {"brisque", "keypoints", "matches", "nima_aesthetic", "nima_technical", "niqe"}
    assert not needy & set(names)
    for name in names:
        make_scorer(name)


def test_a_file_works_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "mine too"
    folder.mkdir()
    (folder / "my_scorer.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    by_relative = make_scorer("mine too/my_scorer.py:Level")
    monkeypatch.chdir(folder)
    assert list(by_relative.parts) == ["Level"]
    mixed = make_scorer({f"{folder}/my_scorer.py:Level": 3.0, "noise": 1.0})
    assert mixed.weights == {"Level": 0.75, "noise": 0.25}
    assert type(mixed.parts["Level"]) is type(make_scorer("my_scorer.py:Level").parts["Level"])
    with pytest.raises(ValueError, match=r"`scorer` \(='my_scorer.py:Levle'\).*did you mean 'Lev"):
        make_scorer("my_scorer.py:Levle")
    with pytest.raises(ValueError, match=r"must name a class of the file: 'my_scorer.py:MyScore'"):
        make_scorer("my_scorer.py")
    with pytest.raises(ValueError, match=r"`scorer` \(='no.py:Level'\): there is no file 'no.py'"):
        make_scorer({"no.py:Level": 1.0})
    with pytest.raises(ValueError, match=r"must be callable"):
        make_scorer("my_scorer.py:torch")


def test_scores_of_a_file_are_kept_only_if_it_has_a_version(tmp_path: Path) -> None:
    file = tmp_path / "my_scorer.py"
    prints = []
    for version in ("", "    version = 1\n", "    version = 2\n"):
        file.write_text(MINE + version)
        prints.append(registry.scorer_fingerprint(make_scorer(f"{file}:Level")))
    assert prints[0] is None
    assert prints[1] not in (None, prints[2])


class FakeMetric:
    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        assert images.shape[1] == 3
        return 100.0 * images.mean(dim=(1, 2, 3))[:, None]


@pytest.fixture
def pyiqa(monkeypatch: pytest.MonkeyPatch) -> None:
    """A module with pyiqa's interface: a factory of metrics that state their range."""
    metrics = {
        "musiq": FakeMetric(metric_mode="NR", lower_better=False, score_range="~0, ~100"),
        "niqe": FakeMetric(metric_mode="NR", lower_better=True, score_range="-50.0, 150"),
        "lpips": FakeMetric(metric_mode="FR", lower_better=True, score_range="0, 1"),
        "open": FakeMetric(metric_mode="NR", lower_better=True, score_range="0, inf"),
        "old": FakeMetric(metric_mode="NR"),
    }
    module = types.ModuleType("pyiqa")

    def create_metric(name: str, device: torch.device) -> FakeMetric:
        assert device.type == "cpu"
        return metrics[name]

    module.create_metric = create_metric  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "pyiqa", module)


@pytest.mark.usefixtures("pyiqa")
def test_metrics_of_pyiqa_are_mapped_to_their_range() -> None:
    images = torch.tensor([0.0, 0.25, 1.0])[:, None, None, None].expand(3, 3, 4, 4)
    higher = make_scorer("pyiqa:musiq")
    assert list(higher.parts) == ["musiq"]
    assert higher.parts["musiq"](images, None).tolist() == [0.0, 0.25, 1.0]  # type: ignore[arg-type]
    lower = make_scorer({"pyiqa:niqe": 0.5, "noise": 0.5}).parts["niqe"]
    assert lower(images, None).tolist() == [0.75, 0.625, 0.25]  # type: ignore[arg-type]
    assert lower.domain == "srgb"
    for name, message in (
        ("lpips", "needs no reference"),
        ("open", r"'0, inf', which must be two finite numbers"),
        ("old", "None, which must be two finite"),
        ("nothing", "KeyError: 'nothing'"),
    ):
        with pytest.raises(ValueError, match=rf"`scorer` \(='pyiqa:{name}'\).*{message}"):
            make_scorer(f"pyiqa:{name}")


def test_pyiqa_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyiqa", None)
    with pytest.raises(ImportError, match=r"pyiqa:musiq.*non-commercial.*pip install pyiqa"):
        make_scorer("pyiqa:musiq")
