"""Terms from the codes of frames, and their expectations, against the terms in torch."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from ae_env.observation import encode_observation
from ae_env.scenes import Scene
from ae_env.scorers import CompositeScorer, make_scorer
from ae_env.scorers.captures import prepare_scene, source_noises
from ae_env.scorers.score_table import ScoreTables
from ae_env.scorers.term_scores import TermScores
from ae_env.scorers.terms import Highlights, Noise, Shadows
from simulator.capture.prepared_scene import Layout
from simulator.capture.sensor import clip_and_quantise
from simulator.optics.motion import Movement
from tests.ae_env.environments import make_env
from tests.ae_env.scorer_images import CAMERA, GRID, Own, make_captures, make_scene

TERMS = dict.fromkeys(("brightness", "highlights", "shadows", "noise", "sharpness"), 1.0)
NOTHING = np.zeros((64, 2, 4))


def _scene(seed: int = 0, size: int = 40, **fields: Any) -> Scene:
    """18 stops, some black and some negative pixels, a size that no block divides."""
    light = 2.0 ** np.random.default_rng(seed).uniform(-14, 4, (4, size, size))
    light[:, 0, :5], light[:, 1, :5] = 0.0, -0.01
    return make_scene(light, 640.0, scene_id=f"test-{seed}", **fields)


def _noisy(size: int = 40) -> Scene:
    """A raw of ISO 6400: what lacks light for its target is noisier than it should be."""
    return _scene(size=size, nlf=CAMERA.nlf(6400))


@pytest.mark.parametrize("size", [40, 67])
@pytest.mark.parametrize("make", [_scene, lambda size: _noisy(size)])
@pytest.mark.parametrize("scorer", [TERMS, {"balanced": 0.7, "banding": 0.3}])
def test_scores_of_frames_are_those_of_the_terms(scorer: Any, make: Any, size: int) -> None:
    scene, made = make(size=size), make_scorer(scorer)
    prepared = prepare_scene(scene, CAMERA, speed=0.1, defocus=1.0)
    images = prepared.expose(GRID.states, seed=3)
    noises = source_noises(prepared, GRID.states, np.ones(64))
    captures = make_captures([scene] * 64, list(GRID), 0.1, 1.0)
    captures = replace(captures, source_noise=noises)
    source_noise = NOTHING if noises is None else np.array([[n.shot, n.read] for n in noises])
    assert source_noise.any() == (not scene.noise_free)
    scores = TermScores(made, CAMERA, GRID.states, noise=True)
    means = scores.measured(encode_observation(images).numpy(), np.arange(64), source_noise)
    wanted = made.score_parts(images.clamp(0.0, 1.0), captures)
    for name, found in scores.score(means, captures).items():
        np.testing.assert_allclose(found, wanted[name], atol=1e-6, err_msg=name)


@pytest.mark.parametrize("make", [_scene, _noisy])
@pytest.mark.parametrize("blurred", [False, True])
def test_tables_are_the_means_over_many_captures(make: Any, blurred: bool) -> None:
    """To within five standard errors of 40 captures, and what a mean's noise leaves.

    Where no noise is added, a pixel may be so close to the next code that it counts in part.
    """
    one_pixel = 1.0 / 40**2 / Highlights.scale
    scene, made = make(), make_scorer("balanced")
    blur = {"speed": 0.3, "defocus": 2.0} if blurred else {}
    table = ScoreTables(GRID, CAMERA, made).table(scene, **blur)
    prepared = prepare_scene(scene, CAMERA, **blur)
    captures = make_captures([scene] * 64, list(GRID), **blur)
    captures = replace(captures, source_noise=source_noises(prepared, GRID.states, np.ones(64)))
    drawn: dict[str, list[np.ndarray]] = {name: [] for name in [*made.parts, "score"]}
    for seed in range(40):
        images = prepared.expose(GRID.states, seed=seed).clamp_(0.0, 1.0)
        scores = {n: s.numpy() for n, s in made.score_parts(images, captures).items()}
        for name, values in [*scores.items(), ("score", made.totals(scores))]:
            drawn[name].append(values)
    for name, values in drawn.items():
        found = table.mean if name == "score" else table.parts[name]
        error = np.std(values, axis=0, ddof=1) / np.sqrt(40)
        off = np.abs(np.mean(values, axis=0) - found) - 5.0 * error
        assert (off < (one_pixel if name == "highlights" else 1e-3)).all(), name


class OwnNoise(Noise):
    """A user's: it is averaged over captures, and reads the noise that is stated of them."""


def test_the_noise_that_is_stated_is_that_of_the_capture() -> None:
    """Of a noisy source whose blur, a different one at each pixel, averages its noise."""
    rng = np.random.default_rng(2)
    layout = Layout(torch.from_numpy(rng.random((40, 40)).astype(np.float32)))
    scene = replace(_noisy(), layout=layout)
    blur: dict[str, Any] = {"speed": 0.5, "defocus": 8.0, "movement": Movement(1.0, 2.0)}
    found, wanted = (
        ScoreTables(GRID, CAMERA, CompositeScorer({"noise": part})).table(scene, **blur).mean
        for part in (OwnNoise(), Noise())
    )
    np.testing.assert_allclose(found, wanted, atol=0.01)


@pytest.mark.parametrize("lighting", ["static", "sine"])
def test_scorers_of_light_know_whether_there_is_noise(lighting: str) -> None:
    told = Own(
        lambda _, captures: torch.full((len(captures),), float(captures.noisy)), depends_on="light"
    )
    for noise in (False, True):
        env = make_env(scorer=told, noise=noise, lighting=lighting)
        assert env.reset(seed=0)[1]["rewards"]["score"] == noise


def test_without_noise_the_table_is_the_frame() -> None:
    scene, made = _scene(), make_scorer("balanced")
    table = ScoreTables(GRID, CAMERA, made, noise=False).table(scene, speed=0.1)
    prepared = prepare_scene(scene, CAMERA, speed=0.1)
    images = clip_and_quantise(prepared.expected_sweep(GRID.states), CAMERA).clamp_(0.0, 1.0)
    captures = replace(make_captures([scene] * 64, list(GRID), 0.1), noisy=False)
    wanted = made(images, captures)
    np.testing.assert_allclose(table.mean, wanted, atol=1e-6)


def test_bands_have_light_of_their_own() -> None:
    """Half of the rows at twice the light: the means are those of both halves."""
    light, rows = _scene().light, np.ones((64, 40))
    rows[:, 20:] = 2.0
    light[:, 20:] = light[:, :20]
    scene, parts = make_scene(light.numpy(), 640.0), {"highlights", "shadows", "noise"}
    tables = ScoreTables(GRID, CAMERA, make_scorer(dict.fromkeys(parts, 1.0)))
    both, once, twice = (
        tables.table(scene, gain=gain, row_gain=row_gain).parts
        for gain, row_gain in ((1.0, rows), (1.0, None), (2.0, None))
    )
    for name in parts:
        halves = np.stack([once[name], twice[name]])
        exponential = name != "noise"  # of a mean
        wanted = np.sqrt(halves.prod(axis=0)) if exponential else halves.mean(axis=0)
        np.testing.assert_allclose(both[name], wanted, atol=1e-5, err_msg=name)


@pytest.mark.parametrize("on_the_class", [True, False])
def test_constants_are_those_of_the_terms(
    on_the_class: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts: dict[str, Any] = {"highlights": Highlights(), "shadows": Shadows(), "noise": Noise()}
    before = ScoreTables(GRID, CAMERA, CompositeScorer(parts)).table(_scene()).parts
    for name, constant, value in (
        ("highlights", "scale", 0.3),
        ("shadows", "scale", 0.1),
        ("shadows", "depth", 6.0),
        ("shadows", "width", 1.5),
        ("noise", "half_snr", 40.0),
    ):
        part = parts[name]
        if on_the_class or constant == "scale":
            monkeypatch.setattr(type(part) if on_the_class else part, constant, value)
    found = ScoreTables(GRID, CAMERA, CompositeScorer(parts)).table(_scene()).parts
    for name in parts if on_the_class else ("highlights", "shadows"):
        assert np.abs(found[name] - before[name]).max() > 0.02


def test_frames_of_static_and_changing_light_need_no_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """However deep in a mean the terms are: in torch, all states take some 20 times as long."""
    alone = ScoreTables(GRID, CAMERA, make_scorer("balanced"))
    tables = ScoreTables(GRID, CAMERA, make_scorer({"balanced": 0.8, "noise": 0.2}))
    for term in (Highlights, Shadows, Noise):
        monkeypatch.setattr(term, "__call__", None)  # would fail if it were called
    found = tables.table(_scene(), speed=0.1)
    for gain in (1.0, np.ones(64)):
        other = alone.table(_scene(), speed=0.1, gain=gain)
        np.testing.assert_array_equal(found.parts["balanced"], other.mean)
        np.testing.assert_allclose(found.mean, 0.8 * other.mean + 0.2 * other.parts["noise"])


def test_compiled_and_loaded_kernels_agree_to_the_last_bit(compiled_and_loaded: Any) -> None:
    """The first process of a fresh installation compiles; all others load what it cached."""
    code = (
        "import sys, numpy as np; from ae_env.scorers.term_scores import measure_codes\n"
        "rng = np.random.default_rng(0); n = np.float32\n"
        "codes, means = rng.integers(0, 256, (3, 4, 900)).astype(np.uint8), np.empty((3, 3))\n"
        "shares, dark = rng.random((2, 4, 256)).astype(n), rng.random(256).astype(n)\n"
        "measure_codes(0, 3, codes, shares, np.array([0, 1, 1]), dark, means)\n"
        "print(*measure_codes.stats.cache_hits.values(), means.tobytes().hex())\n"
    )
    (compiled,), (hits, loaded) = compiled_and_loaded(code)
    assert (hits, len(loaded)) == ("1", 2 * 72)
    assert loaded == compiled


def test_a_frame_is_scored_as_it_is_shown() -> None:
    """The codes decide: what changes none of them changes no score."""
    images = torch.rand(2, 4, 40, 40, generator=torch.Generator().manual_seed(0))
    rounded = ((encode_observation(images) / 255.0) ** 2 * (1 + 2**-10) - 2**-10).clamp(min=0.0)
    captures = make_captures([_scene()] * 2, [GRID[5], GRID[40]])
    for name in ("highlights", "shadows", "noise"):
        scorer = make_scorer(name)
        assert scorer(images, captures).tolist() == scorer(rounded, captures).tolist()
