"""Composites, and scorers of the user's own that raise, return rubbish, or write to their input."""

import dataclasses
import math
from functools import cached_property
from typing import Any

import numpy as np
import pytest
import torch

from ae_env import AutoExposureEnv, AutoExposureVectorEnv
from ae_env.scorers import Balanced, CompositeScorer, make_scorer
from ae_env.scorers.captures import Captures
from ae_env.utils.user_files import UserCodeError
from tests.ae_env.environments import SMALL
from tests.ae_env.scorer_images import GRID, Own, make_captures, mean_signal, random_scene

#: The fields and the properties worked out from them that a scorer could write to.
TENSORS = [f.name for f in dataclasses.fields(Captures) if "Tensor" in str(f.type)]
TENSORS += [name for name, value in vars(Captures).items() if isinstance(value, cached_property)]


def test_a_mapping_is_the_weighted_mean() -> None:
    captures = make_captures(random_scene(), [GRID[i] for i in (3, 20, 50)], 0.1, 1.0)
    mixed = make_scorer({"brightness": 3.0, "sharpness": 1.0})
    expected = 0.75 * make_scorer("brightness")(None, captures)
    expected += 0.25 * make_scorer("sharpness")(None, captures)
    torch.testing.assert_close(mixed(None, captures), expected)
    assert mixed.closed_form
    assert mixed.depends_on == "blur"
    assert make_scorer("balanced").depends_on == "image"


def test_callables_see_the_view_they_ask_for(monkeypatch: pytest.MonkeyPatch) -> None:
    captures = make_captures(random_scene(), [GRID[20]] * 3)
    images = torch.rand(3, 4, 40, 40)
    scorer = make_scorer(Own())
    assert not scorer.closed_form
    torch.testing.assert_close(scorer(images, captures), images.mean(dim=(1, 2, 3)).double())
    channels = Own(lambda images, _: torch.full((3,), images.shape[1] / 4), "srgb")
    both = CompositeScorer({"raw": Own(), "picture": channels})
    assert both.score_parts(images, captures)["picture"].tolist() == [0.75] * 3
    # Nothing is developed where nobody asks for sRGB.
    monkeypatch.setattr("ae_env.scorers.terms.develop", None)
    make_scorer(Own())(images, captures)
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
def test_rubbish_is_refused(returned: Any) -> None:
    env = AutoExposureEnv(scorer=Own(lambda *_: returned), **SMALL)
    with pytest.raises(UserCodeError, match=r"scorer 'Own' returned "):
        env.reset(seed=0)


@pytest.mark.parametrize("observation", ["uint8", "linear", "dn"])
def test_what_a_scorer_does_to_its_images_is_its_own_affair(observation: str) -> None:
    """Neither the observation nor the other scorers see it."""

    def blacken(images: torch.Tensor, captures: Captures) -> torch.Tensor:
        images.numpy()[:] = 0.0  # past torch's own counting
        return images.new_zeros(len(images))

    def step(scorer: Any) -> Any:
        envs = AutoExposureVectorEnv(3, scorer=scorer, observation=observation, **SMALL)
        envs.reset(seed=0)
        return envs.step(np.array([3, 20, 40]))

    for domain in ("raw", "srgb"):
        frames = []
        for first in (None, blacken):
            parts = {"first": Own(first or mean_signal, domain), "mean": Own(domain=domain)}
            scorer = CompositeScorer(parts)
            frames.append(step(scorer))
        (plain, _, _, _, info), (black, _, _, _, black_info) = frames
        np.testing.assert_array_equal(plain["raw"], black["raw"])
        np.testing.assert_array_equal(info["rewards"]["mean"], black_info["rewards"]["mean"])
    np.testing.assert_array_equal(step(Own(blacken))[0]["raw"], plain["raw"])


@pytest.mark.parametrize("name", TENSORS)
@pytest.mark.parametrize("depends_on", ["image", "light", "blur"])
def test_captures_must_not_be_written_to(name: str, depends_on: str) -> None:
    """The scene, which other environments show too, stays as it is."""

    def write(images: Any, captures: Captures) -> torch.Tensor:
        getattr(captures, name)[0] *= 0.5
        return torch.zeros(len(captures))

    lighting = "flicker" if name == "row_gain" else "static"
    env = AutoExposureEnv(scorer=Own(write, depends_on=depends_on), lighting=lighting, **SMALL)
    before = [scene.clean_light.clone() for scene in env.scenes]
    with pytest.raises(UserCodeError, match="scorer 'Own' changed its `captures` in place"):
        env.reset(seed=0)
    assert all(torch.equal(s.clean_light, b) for s, b in zip(env.scenes, before, strict=True))


def test_misspelt_attributes_are_refused() -> None:
    for scorer, word in (
        (Own(depends_on="imgae"), "imgae"),
        (Own(domain="RGB"), "RGB"),
        (3, "`sc"),
    ):
        with pytest.raises(ValueError, match=word):
            CompositeScorer({"a": scorer})


@pytest.mark.parametrize("kind", [np.array, torch.tensor])
def test_balanced_stays_in_its_range_where_shares_are_rounded_up(kind: Any) -> None:
    highlights = np.exp(-1.0 / 0.15) * (1.0 - np.array([0.0, 1e-16, 1e-15, 1e-12, 1e-9]))
    assert (-0.15 * np.log(highlights) > 1.0).any()  # else this shows nothing
    scores = dict.fromkeys(("brightness", "shadows", "noise", "sharpness"), np.ones(5))
    scores["highlights"] = highlights
    totals = Balanced().combine({name: kind(values) for name, values in scores.items()})
    assert 0.0 <= float(totals.min()) <= float(totals.max()) <= 1.0
    assert Balanced().combine(dict.fromkeys(scores, kind(np.ones(3)))).tolist() == [1.0] * 3


@pytest.mark.parametrize("total", [math.nan, math.inf, -0.1, 1.1])
@pytest.mark.parametrize("part", ["noise", "own"])
def test_a_combination_of_ones_own_is_checked(total: float, part: str) -> None:
    class Mine(CompositeScorer):
        def combine(self, scores: Any) -> Any:
            return scores[part] * 0.0 + total

    parts = {"noise": make_scorer("noise"), "own": Own()}
    env = AutoExposureEnv(scorer=Mine({part: parts[part]}), **SMALL)
    with pytest.raises(UserCodeError, match=r"scorer 'Mine': `combine` returned .* \[0, 1\]"):
        env.reset(seed=0)
