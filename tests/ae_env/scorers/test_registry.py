"""Scorers by name, from files, from other packages and of the user's own, and their composites."""

import dataclasses
import math
import sys
from functools import cached_property
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ae_env import AutoExposureEnv, AutoExposureVectorEnv
from ae_env.scenes import Scene
from ae_env.scorers import CompositeScorer, list_scorers, make_scorer, registry
from ae_env.scorers.captures import Captures
from ae_env.scorers.defects import DEFECTS
from ae_env.scorers.registry import ScorerRow, describe_scorers, scorer_fingerprint
from ae_env.scorers.score_table import TIE, ScoreTables
from ae_env.scorers.terms import Noise
from ae_env.utils.user_files import UserCodeError
from simulator import NoiseLevelFunction
from tests.ae_env import scorer_images
from tests.ae_env.environments import SMALL
from tests.ae_env.scorer_images import CAMERA, GRID, Own, make_captures, mean_signal, random_scene
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


def _install(folder, name, module, entries):
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
    mixed = make_scorer({f"{tmp_path}/their_scores.py:Level": 3.0, "noise": 1.0})
    assert mixed.weights == {"Level": 0.75, "noise": 0.25}
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


def test_metrics_of_pyiqa_are_mapped_to_their_range(monkeypatch: pytest.MonkeyPatch) -> None:
    facts = {"musiq": ("NR", False, "~0, ~100")}
    facts |= {"niqe": ("NR", True, "-50.0, 150"), "lpips": ("FR", True, "0, 1")}
    facts |= {"open": ("NR", True, "0, inf"), "old": ("NR", None, None)}

    def create_metric(name: str, device: torch.device) -> Mock:
        known = dict(zip(("metric_mode", "lower_better", "score_range"), facts[name], strict=True))
        return Mock(side_effect=lambda images: 100 * images.mean(dim=(1, 2, 3))[:, None], **known)

    monkeypatch.setitem(sys.modules, "pyiqa", Mock(create_metric=create_metric))
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
    registry.register_scorer("mean_signal")(Constant)
    registry.register_scorer("mean_signal")(Constant)  # a notebook cell run twice
    assert "mean_signal" in list_scorers()
    assert list(make_scorer({"mean_signal": 1, "noise": 1}).parts) == ["mean_signal", "noise"]
    with pytest.raises(ValueError, match="built-in"):
        registry.register_scorer("noise")(Constant)
    with pytest.raises(ValueError, match="identifier"):
        registry.register_scorer("my score")


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("balancd", "did you mean 'balanced'"),
        ("no_such_module:Thing", "cannot be loaded: "),
        ("ae_env.scorers.terms:Nothing", "cannot be loaded: "),
        ("math:pi", "must be callable"),
        ({"no.py:Level": 1.0}, r"`scorer` \(='no.py:Level'\): there is no file 'no.py'"),
        *((wrong, "must map one name or more") for wrong in ({}, {"noise": 10**400})),
        (lambda images, captures: None, "must be 'raw' or 'srgb'"),
        *((Own(depends_on="imgae"), "imgae"), (Own(domain="RGB"), "RGB")),
        (3, "name, a mapping of weights or a callable"),
    ],
)
def test_bad_scorers_are_refused(spec, message):
    with pytest.raises(ValueError, match=message):
        make_scorer(spec)


class Constant:
    domain, depends_on = "raw", "light"

    def __init__(self, value: float = 0.5, version: int | None = None) -> None:
        self.value = value
        if version is not None:
            self.version = version

    def __call__(self, images, captures):
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
    pictures = scorer_images.random_pictures()[:, :channels].contiguous()
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
        extremes[2] = scorer_images.random_pictures(1, height, width)[:, :channels]
        values = scorer(extremes, None)
        assert bool(((values >= 0.0) & (values <= 1.0)).all()), (height, width)


@settings(max_examples=4)  # each of all scorers
@given(lights(LIGHT.map(abs)), USUAL_SETTINGS, grids(), st.data())
def test_scores_are_shares_and_the_oracle_has_the_highest(light, reference, grid, data):
    draws = [[None, 1e-3, 640.0, 1e6], [False, True], [0.0, 1e-3, 1.0, 100.0], [0.0, 1.0, 25.0]]
    draws.append([1.0, 2.0**-20, 2.0**20])
    illuminance, is_noisy, speed, defocus, gain = (data.draw(st.sampled_from(d)) for d in draws)
    if float((light[1:3] > 0).double().mean()) <= 0.2:
        illuminance = illuminance or 640.0  # no exposure is right for a black frame
    nlf = CAMERA.nlf(reference.iso) if is_noisy else NoiseLevelFunction.zero()
    known = {"scene_id": "any", "nlf": nlf, "illuminance": illuminance}
    scene = Scene.from_array(light, reference, CAMERA, **known)
    for name in [row.name for row in describe_scorers() if not row.needs]:
        tables = ScoreTables(grid, CAMERA, make_scorer(name))
        table = tables.table(scene, speed=speed, defocus=defocus, gain=gain)
        for values in (table.mean, *table.parts.values()):
            assert values.shape == (len(grid),)
            assert bool(((values >= 0.0) & (values <= 1.0)).all())
        best = table.mean.max()
        assert table.mean[table.oracle] >= best - TIE
        assert bool((table.mean[: table.oracle] < best - TIE).all())


#: The fields and the properties worked out from them that a scorer could write to.
TENSORS = [f.name for f in dataclasses.fields(Captures) if "Tensor" in str(f.type)]
TENSORS += [n for n, v in vars(Captures).items() if isinstance(v, cached_property) and n[0] != "_"]


def test_a_mapping_is_the_weighted_mean_and_callables_see_the_view_they_ask_for() -> None:
    captures = make_captures(random_scene(), [GRID[i] for i in (3, 20, 50)], 0.1, 1.0)
    mixed = make_scorer({"brightness": 3.0, "sharpness": 1.0})
    expected = 0.75 * make_scorer("brightness")(None, captures)
    expected += 0.25 * make_scorer("sharpness")(None, captures)
    torch.testing.assert_close(mixed(None, captures), expected)
    assert mixed.closed_form
    assert mixed.depends_on == "blur"
    assert make_scorer("balanced").depends_on == "image"
    for wrong in (0.0, -1.0, math.inf, math.nan, "1"):
        with pytest.raises(ValueError, match="`weights`"):
            CompositeScorer({"own": Own()}, {"own": wrong})
    captures = make_captures(random_scene(), [GRID[20]] * 3)
    images = torch.rand(3, 4, 40, 40)
    scorer = make_scorer(Own())
    assert not scorer.closed_form
    torch.testing.assert_close(scorer(images, captures), images.mean(dim=(1, 2, 3)).double())
    channels = Own(lambda images, _: torch.full((3,), images.shape[1] / 4), "srgb")
    both = CompositeScorer({"raw": Own(), "picture": channels})
    assert both.score_parts(images, captures)["picture"].tolist() == [0.75] * 3
    with pytest.raises(ValueError, match="needs `images`"):
        make_scorer(Own())(None, captures)


@pytest.mark.parametrize("depends_on", ["image", "light", "blur"])
def test_a_scorer_that_raises_is_named_with_its_cause(depends_on: str) -> None:
    env = AutoExposureEnv(scorer=Own(lambda *_: 1 / 0, depends_on=depends_on), **SMALL)
    with pytest.raises(UserCodeError, match="scorer 'Own' raised ZeroDivisionError") as caught:
        env.reset(seed=0)
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


@pytest.mark.parametrize(
    "returned",
    [
        *(None, 0.5, [0.5], np.full(1, 0.5), torch.full((1, 1), 0.5), torch.tensor(0.5)),
        *(torch.full((2,), 0.5), torch.full((1,), 0.5 + 0j)),
        *(torch.full((1,), value) for value in (math.nan, math.inf, -0.01, 2)),
    ],
    ids=repr,
)
def test_rubbish_is_refused(returned):
    env = AutoExposureEnv(scorer=Own(lambda *_: returned), **SMALL)
    with pytest.raises(UserCodeError, match=r"scorer 'Own' returned "):
        env.reset(seed=0)


@pytest.mark.parametrize("observation", ["uint8", "linear", "dn"])
def test_what_a_scorer_does_to_its_images_is_its_own_affair(observation: str) -> None:
    def blacken(images: torch.Tensor, captures: Captures) -> torch.Tensor:
        images.numpy()[:] = 0.0  # past torch's own counting
        return images.new_zeros(len(images))

    def step(scorer):
        envs = AutoExposureVectorEnv(3, scorer=scorer, observation=observation, **SMALL)
        envs.reset(seed=0)
        return envs.step(np.array([3, 20, 40]))

    for domain in ("raw", "srgb"):
        (plain, _, _, _, info), (black, _, _, _, black_info) = (
            step(CompositeScorer({"first": Own(first, domain), "mean": Own(domain=domain)}))
            for first in (mean_signal, blacken)
        )
        np.testing.assert_array_equal(plain["raw"], black["raw"])
        np.testing.assert_array_equal(info["rewards.mean"], black_info["rewards.mean"])
    np.testing.assert_array_equal(step(Own(blacken))[0]["raw"], plain["raw"])


@pytest.mark.parametrize("name", TENSORS)
@pytest.mark.parametrize("depends_on", ["image", "light", "blur"])
def test_captures_must_not_be_written_to(name: str, depends_on: str) -> None:
    def write(images, captures):
        with torch.inference_mode(depends_on == "light"):
            getattr(captures, name)[0] *= 0.5
        return torch.zeros(len(captures))

    lighting = "flicker" if name == "row_gain" else "static"
    light = dict(SMALL)
    if name == "likely_ev":
        light["scenes"] = [random_scene(illuminance=None)]
    env = AutoExposureEnv(scorer=Own(write, depends_on=depends_on), lighting=lighting, **light)
    before = [scene.clean_light.clone() for scene in env.scenes]
    with pytest.raises(UserCodeError, match="scorer 'Own' changed its `captures` in place"):
        env.reset(seed=0)
    assert all(torch.equal(s.clean_light, b) for s, b in zip(env.scenes, before, strict=True))


@pytest.mark.parametrize("total", [math.nan, math.inf, -0.1, 1.1])
@pytest.mark.parametrize("part", ["noise", "own"])
def test_a_combination_of_ones_own_is_checked(total: float, part: str) -> None:
    class Mine(CompositeScorer):
        def combine(self, scores):
            return scores[part] * 0.0 + total

    parts = {"noise": make_scorer("noise"), "own": Own()}
    env = AutoExposureEnv(scorer=Mine({part: parts[part]}), **SMALL)
    with pytest.raises(UserCodeError, match=r"scorer 'Mine': `combine` returned .* \[0, 1\]"):
        env.reset(seed=0)
