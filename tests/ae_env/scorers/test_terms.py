"""The terms against the published formulas, and score tables against many captures."""

import copy
import math
from dataclasses import astuple, replace

import numpy as np
import pytest
import scipy.optimize
import scipy.special
import scipy.stats
import torch
from scipy.integrate import quad

from ae_env.grid import ExposureGrid
from ae_env.observation import encode_observation
from ae_env.scorers import CompositeScorer, make_scorer
from ae_env.scorers.captures import SceneCaptures, prepare_scene, source_noises
from ae_env.scorers.score_table import ScoreTables
from ae_env.scorers.term_scores import TermScores
from ae_env.scorers.terms import Balanced, Highlights, Noise, Shadows, Sharpness
from simulator import NoiseLevelFunction
from simulator.capture.blurred_frames import Layout
from simulator.capture.sensor import clip_and_quantise
from simulator.optics.motion import Movement
from tests.ae_env.scorer_images import CAMERA, GRID, Own, make_captures, make_scene, random_scene


def _by_the_formulas(scene, state, speed, defocus):
    """The scores of one state, in float64 and in the notation of the formulas."""

    def effective(settings):  # recorded f-numbers are rounded
        return 2.0 ** (round(6 * np.log2(settings.f_number)) / 6)

    def exposure(settings):
        return settings.exposure_time * settings.iso / effective(settings) ** 2

    alpha = exposure(state) / exposure(scene.reference)
    x = scene.light.numpy().astype(np.float64) * alpha
    height = x.shape[1]
    ev_state = np.log2(effective(state) ** 2 / state.exposure_time) - np.log2(state.iso / 100)
    # An average meter brings the mean of the recorded green to 0.12; the right exposure is within
    # 1.5 EV of its own.
    green = scene.light.numpy()[1:3].astype(np.float64).mean(axis=0)
    factor = scipy.optimize.brentq(
        lambda f: np.minimum(green * f, 1.0).mean() - 0.12, 1e-6, 1e6, xtol=1e-14
    )
    metered = ev_state + np.log2(alpha / factor)
    if scene.illuminance is None:  # 16 equally likely values of a normal distribution
        known = scene.incident_light
        likely = known.ev100 + known.spread * scipy.stats.norm.ppf((np.arange(16) + 0.5) / 16)
    else:
        likely = np.log2(scene.illuminance / 2.5)
    e = np.clip(likely, metered - 1.5, metered + 1.5) - ev_state
    nlf = CAMERA.nlf(state.iso)
    shot, read = (np.array(v)[:, None, None] for v in (nlf.shot, nlf.read))
    # What an 8-bit code of the recorded value says of it.
    code = np.round(255 * np.sqrt((x.clip(max=1) + 2**-10) / (1 + 2**-10)))
    y = np.where(code > 8, (code / 255) ** 2 * (1 + 2**-10) - 2**-10, 0.0)
    fh = (code == 255).any(axis=0).mean()
    fs = scipy.special.expit(-(np.log2(y.clip(min=2**-40)) + 9) / 0.5).mean()
    snr = y / np.sqrt(shot * y + read)
    disc = 4 * defocus * height / 64 / effective(state)
    blur = np.hypot(speed * height * state.exposure_time, disc)
    terms = {
        "brightness": np.exp(-(np.sqrt(1 + e**2) - 1)).mean(),
        "highlights": np.exp(-fh / 0.15),
        "shadows": np.exp(-fs / 0.20),
        "noise": (snr**1.5 / (snr**1.5 + 18**1.5)).mean(),
        "sharpness": 1 / (1 + (blur / (height / 64)) ** 2),
    }
    weights = {"brightness": 0.3, "highlights": 0.15, "shadows": 0.1, "noise": 0.2}
    weights["sharpness"] = 0.25
    product = np.prod([terms[name] ** weight for name, weight in weights.items()])
    return {**terms, "balanced": (1 - fh**4) * (1 - fs**4) * product}


@pytest.mark.parametrize("illuminance", [1000.0, None])
@pytest.mark.parametrize(("speed", "defocus"), [(0.0, 0.0), (0.3, 1.7)])
def test_scores_follow_the_formulas(illuminance, speed, defocus):
    scene = random_scene(illuminance=illuminance)
    states = [GRID[i] for i in (0, 13, 22, 37, 42, 63)]
    captures = make_captures(scene, states, speed, defocus)
    images = captures.light.clamp(0.0, 1.0)
    expected = [_by_the_formulas(scene, state, speed, defocus) for state in states]
    for name in ("brightness", "highlights", "shadows", "noise", "sharpness", "balanced"):
        scorer = make_scorer(name)
        scores = scorer(images, captures)
        assert scores.dtype == torch.float64
        wanted = [scores_of_state[name] for scores_of_state in expected]
        np.testing.assert_allclose(scores.numpy(), wanted, rtol=2e-4, atol=1e-6, err_msg=name)


class Faults(Balanced):
    """`Balanced` of both faults alone, in another order."""

    def __init__(self):
        CompositeScorer.__init__(self, {"shadows": Shadows(), "highlights": Highlights()})


@pytest.mark.parametrize("kind", [np.array, torch.tensor, float])
def test_balanced_finds_its_faults_by_name(kind):
    scores = {"highlights": 0.3, "shadows": 0.6}
    shares = -0.15 * math.log(0.3), -0.2 * math.log(0.6)
    expected = math.prod(1 - share**4 for share in shares) * math.sqrt(0.3 * 0.6)
    found = Faults().combine({name: kind(score) for name, score in scores.items()})
    assert float(found) == pytest.approx(expected, rel=1e-6)
    found = Faults().combine(scores | {"shadows": np.full((2, 3), 0.6)})  # of different shapes
    np.testing.assert_allclose(found, np.full((2, 3), expected), rtol=1e-12)


def test_noise_is_that_of_the_cameras_own_pixels() -> None:
    """Box-averaging does not make ISO free: only a frame's values are less noisy."""
    tables = ScoreTables(GRID, CAMERA, make_scorer("noise"))
    for source in (NoiseLevelFunction.zero(), CAMERA.nlf(6400)):
        wanted, found = (
            tables.table(random_scene(box_factor=k, nlf=source.scaled(1 / k**2))).mean
            for k in (1, 31)
        )
        np.testing.assert_allclose(found, wanted, atol=0.01)


def test_noise_is_a_half_at_a_signal_to_noise_ratio_of_18() -> None:
    """With read noise alone SNR = x / sqrt(read), with shot noise alone sqrt(x / shot)."""
    captures = make_captures(make_scene(np.full((4, 40, 40), 0.5)), [GRID[0]] * 4)
    images, nothing = torch.ones(4, 4, 40, 40), (0.0,) * 4
    read, shot = (lambda v: NoiseLevelFunction(nothing, (v,) * 4)), 18.0**-2
    noises = [read(18.0**-2), read(18.0**-2 / 16), read(0.0), read(18.0**-2 / 16)]
    noises[2] = NoiseLevelFunction((shot,) * 4, nothing)
    captures = replace(captures, nlf=noises)
    wanted = [0.5, 8 / 9, 0.5, 8 / 9]  # 4^1.5 = 8
    assert make_scorer("noise")(images, captures).tolist() == pytest.approx(wanted, rel=1e-5)
    # A source that brings more noise than the settings have, or less.
    captures = replace(captures, source_noise=[read(18.0**-2 / 100)] * 3 + [read(18.0**-2)])
    wanted[3] = 0.5
    assert make_scorer("noise")(images, captures).tolist() == pytest.approx(wanted, rel=1e-5)
    captures = replace(captures, noisy=False)
    assert make_scorer("noise")(images, captures).tolist() == pytest.approx([1.0] * 4)
    black = images * torch.tensor([0.0, -2e-4, -9e-4, 0.0])[:, None, None, None]
    assert make_scorer("noise")(black, captures).tolist() == [0.0] * 4  # no signal, and no noise


def test_bands_by_hand() -> None:
    """Half of the rows at 1.2 of the light, half at 0.8; brightness is the mean over the rows."""
    captures = make_captures(make_scene(np.full((4, 40, 40), 0.1)), [GRID[0]])
    assert make_scorer("banding")(None, captures).item() == 1.0
    spread = 0.5 * math.log2(1.2 / 0.8)
    rows = torch.tensor([1.2, 0.8], dtype=torch.float64).repeat_interleave(20)[None]
    captures = replace(captures, row_gain=rows)
    vars(captures)["proper_ev"] = captures.ev100 + 1.0
    found = make_scorer("banding")(None, captures).item()
    assert found == pytest.approx(1 / (1 + (spread / 0.1) ** 2))
    errors = [1 + math.log2(1.2), 1 + math.log2(0.8)]
    wanted = sum(math.exp(1 - math.sqrt(1 + e * e)) for e in errors) / 2
    assert make_scorer("brightness")(None, captures).item() == pytest.approx(wanted)
    for stops in range(20):  # beside frames that flicker, the rows of one that does not are alike
        pair = [replace(captures, row_gain=gains) for gains in (None, torch.ones_like(rows))]
        vars(pair[0])["proper_ev"] = vars(pair[1])["proper_ev"] = captures.ev100 + 0.1 * stops
        assert torch.equal(*(make_scorer("brightness")(None, one) for one in pair))
    dark = replace(captures, row_gain=torch.tensor([[1.0, 0.0]]).double())  # between pulses
    assert 0.0 < make_scorer("banding")(None, dark).item() < 1e-4


SIZE = 40
MOVEMENT = Movement(0.3, 4.0, subject_speed=0.5, subject_direction=2.5)
BLUR_GRID = ExposureGrid((100, 800), (1 / 100, 1 / 4), (4, 8))


def laid_out(name="laid-out"):
    rng = np.random.default_rng(1)
    layout = Layout(
        torch.from_numpy(rng.random((SIZE, SIZE)).astype(np.float32)),
        torch.from_numpy(rng.random((SIZE, SIZE)) < 0.4),
    )
    light = np.full((4, SIZE, SIZE), 0.12)
    return make_scene(light, 640.0, scene_id=name, layout=layout)


def _wanted(scene, speed, defocus, movement):
    """Mean sharpness of every state, pixel by pixel and by quadrature of the subject's path."""
    own = movement.subject_speed * np.exp(1j * movement.subject_direction)

    def velocity(time: float) -> float:
        return abs(speed * np.exp(1j * (movement.direction + movement.turn * time)) + own)

    found = []
    for state in BLUR_GRID:
        motion = np.full((SIZE, SIZE), speed * state.exposure_time)
        motion[scene.layout.subject] = quad(velocity, 0.0, state.exposure_time)[0]
        disc = scene.layout.defocus.numpy() * defocus * 4.0 / state.effective_f_number / 64.0
        found.append((1.0 / (1.0 + 64.0**2 * (motion**2 + disc**2))).mean())
    return np.array(found)


@pytest.mark.parametrize("defocus", [0.0, 6.0])
@pytest.mark.parametrize("movement", [MOVEMENT, Movement(1.0, -3.0)])
def test_sharpness_is_the_mean_over_the_pixels(defocus: float, movement: Movement) -> None:
    tables = ScoreTables(BLUR_GRID, CAMERA, make_scorer("balanced"))
    table = tables.table(laid_out(), speed=0.2, defocus=defocus, movement=movement)
    wanted = _wanted(laid_out(), 0.2, defocus, movement)
    np.testing.assert_allclose(table.parts["sharpness"], wanted, rtol=2e-3)


def test_the_extent_is_the_root_mean_square() -> None:
    scene, tables = laid_out(), ScoreTables(BLUR_GRID, CAMERA, make_scorer("balanced"))
    prepared = prepare_scene(scene, CAMERA, defocus=5.0)
    captures = tables.term_scores.captures.describe(scene, prepared)
    wanted = 5.0 * SIZE / 64.0 * float(scene.layout.defocus.double().square().mean().sqrt())
    assert captures.blur_px[0] == pytest.approx(wanted, rel=2e-3)
    # Discs end where the frame has them end: 64 of 256 packed pixels at f/4, the bank's has 32.
    light, layout = np.full((4, 256, 256), 0.12), Layout(torch.ones(256, 256))
    sharp = tables.table(make_scene(light, 640.0, layout=layout), defocus=16.0).parts["sharpness"]
    np.testing.assert_allclose(sharp, 1.0 / (1.0 + (32.0 / 256.0 * 64.0) ** 2), rtol=1e-2)


@pytest.mark.parametrize("layout", [True, False])
@pytest.mark.parametrize("movement", [MOVEMENT, Movement(1.0, -3.0)])
def test_sharpness_of_all_states_at_once_is_that_of_each_capture(layout, movement):
    """To the bit: rewards must not depend on how many states were scored together."""
    scene = laid_out() if layout else replace(laid_out(), layout=None)
    tables = ScoreTables(BLUR_GRID, CAMERA, make_scorer("balanced"))
    moves = {"speed": 0.2, "defocus": 6.0, "movement": movement}
    prepared = prepare_scene(scene, CAMERA, **moves)
    found = tables.term_scores.closed_form_terms(scene, prepared, "blur")
    for index, state in enumerate(BLUR_GRID):
        numbers = {"speed": np.array([0.2]), "defocus": np.array([6.0]), "gain": np.ones(1)}
        numbers["movements"] = np.array([astuple(movement)])
        capture = copy.deepcopy(SceneCaptures(CAMERA, [state]).of([scene], **numbers))
        assert Sharpness()(None, capture).item() == found["sharpness"][index]


SMALL = ExposureGrid((100, 1600), (1 / 500, 1 / 30), (4, 8))


def _scene():
    return make_scene(0.12 * np.exp(np.random.default_rng(0).normal(0.0, 1.0, (4, 40, 40))), 640.0)


def _flat(value):
    return make_scene(np.full((4, 40, 40), value), 640.0)


def _light(scene, grid):
    """What the states record of light that `scene.reference` records as 1."""
    return 2.0 ** (np.array([s.log2_exposure for s in grid]) - scene.reference.log2_exposure)


def _tables(scorer="balanced", **options):
    given = {"grid": SMALL, "camera": CAMERA, "scorer": make_scorer(scorer), **options}
    return ScoreTables(**given)


def test_standard_error_is_that_of_the_sensor_noise() -> None:
    scene, grid = _flat(0.3), ExposureGrid((100,), (1 / 1000, 1 / 250), (4,))
    first_pixel = Own(lambda images, _: images[:, 1, 0, 0])
    table = _tables(first_pixel, grid=grid, noise_seeds=400).table(scene)
    nlf, light = CAMERA.nlf(100), 0.3 * _light(scene, grid)
    sigma = np.sqrt(nlf.read[1] + nlf.shot[1] * light)
    # The spread of 400 normals is known to 1 / sqrt(2 * 399) = 3.5 %; quantisation adds a bit.
    np.testing.assert_allclose(table.standard_error, sigma / np.sqrt(400), rtol=0.13)
    clean = _tables(first_pixel, grid=grid, noise=False).table(scene)
    np.testing.assert_allclose(clean.mean, light, atol=1e-4)
    assert clean.standard_error == pytest.approx(0.0)


def test_mixed_scorer_averages_only_what_is_noisy() -> None:
    noise = make_scorer("noise").parts["noise"]
    scorer = CompositeScorer({"mean": Own(), "noise": noise})
    table = _tables(scorer, noise_seeds=4).table(_scene())
    closed = _tables("noise").table(_scene())
    assert (table.standard_error > 0).all()
    assert (closed.standard_error == 0).all()
    np.testing.assert_array_equal(table.parts["noise"], closed.parts["noise"])
    np.testing.assert_allclose(table.mean, 0.5 * (table.parts["mean"] + table.parts["noise"]))
    first, second = (_tables(Own(), noise_seeds=1).table(_scene()) for _ in range(2))
    np.testing.assert_array_equal(first.mean, second.mean)
    assert np.isnan(first.standard_error).all()  # unknown from one seed
    for name, value in (("noise_seeds", 0), ("tolerance", -1.0)):
        with pytest.raises(ValueError, match=f"`{name}`"):
            _tables(**{name: value})


def test_ties_go_to_the_lower_iso() -> None:
    # Under `brightness` alone all states of one EV are alike: ISO 100 at 1/25 s equals ISO 400
    # at 1/100 s and ISO 1600 at 1/400 s; times that are no powers of two round differently.
    grid = ExposureGrid((100, 400, 1600), (1 / 400, 1 / 100, 1 / 25), (4, 8))
    for ev100 in (5.7, 9.3, 12.1):
        lit = replace(_scene(), illuminance=2.5 * 2.0**ev100)
        best = _tables("brightness", grid=grid).table(lit)
        assert best.oracle == np.flatnonzero(best.mean > best.mean.max() - 1e-7)[0]


def test_bands_count_whatever_form_the_gain_has() -> None:
    scene, rows = _flat(0.05), np.full((2, 40), 1.9)
    rows[:, 20:] = 0.1
    top = Own(lambda images, _: images[:, :, :20].mean(dim=(1, 2, 3)))
    grid = ExposureGrid((100,), (1 / 500, 1 / 250), (4,))
    for noise, gain in ((False, 1.0), (True, np.ones(2))):
        tables = _tables(top, grid=grid, noise=noise)
        found = tables.table(scene, gain=gain, row_gain=rows).mean
        np.testing.assert_allclose(found, 0.05 * 1.9 * _light(scene, grid), atol=1e-3)


TERMS = dict.fromkeys(("brightness", "highlights", "shadows", "noise", "sharpness"), 1.0)
NOTHING = np.zeros((64, 2, 4))


def _wide(seed=0, size=40, **fields):
    """18 stops, some black and some negative pixels, a size that no block divides."""
    light = 2.0 ** np.random.default_rng(seed).uniform(-14, 4, (4, size, size))
    light[:, 0, :5], light[:, 1, :5] = 0.0, -0.01
    return make_scene(light, 640.0, scene_id=f"test-{seed}", **fields)


def _noisy(size=40):
    """A raw of ISO 6400: what lacks light for its target is noisier than it should be."""
    return _wide(size=size, nlf=CAMERA.nlf(6400))


@pytest.mark.parametrize("size", [40, 67])
@pytest.mark.parametrize("make", [_wide, lambda size: _noisy(size)])
@pytest.mark.parametrize("scorer", [TERMS, {"balanced": 0.7, "banding": 0.3}])
def test_scores_of_frames_are_those_of_the_terms(scorer, make, size):
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


@pytest.mark.parametrize("make", [_wide, _noisy])
@pytest.mark.parametrize("blurred", [False, True])
def test_tables_are_the_means_over_many_captures(make, blurred):
    """To within five standard errors of 40 captures, and what a mean's noise leaves.

    Where no noise is added, a pixel may be so close to the next code that it counts in part.
    """
    one_pixel = 1.0 / 40**2 / Highlights.scale
    scene, made = make(), make_scorer("balanced")
    blur = {"speed": 0.3, "defocus": 2.0} if blurred else {}
    table = ScoreTables(GRID, CAMERA, made).table(scene, **blur)
    prepared, some = prepare_scene(scene, CAMERA, **blur), np.arange(0, 64, 3)
    states = [GRID[i] for i in some]
    captures = make_captures([scene] * len(some), states, **blur)
    captures = replace(captures, source_noise=source_noises(prepared, states, np.ones(len(some))))
    drawn: dict[str, list[np.ndarray]] = {name: [] for name in [*made.parts, "score"]}
    for seed in range(40):
        images = prepared.expose(states, seed=seed).clamp_(0.0, 1.0)
        scores = {n: s.numpy() for n, s in made.score_parts(images, captures).items()}
        for name, values in [*scores.items(), ("score", made.totals(scores))]:
            drawn[name].append(values)
    for name, values in drawn.items():
        found = (table.mean if name == "score" else table.parts[name])[some]
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
    blur = {"speed": 0.5, "defocus": 8.0, "movement": Movement(1.0, 2.0)}
    found, wanted = (
        ScoreTables(GRID, CAMERA, CompositeScorer({"noise": part})).table(scene, **blur).mean
        for part in (OwnNoise(), Noise())
    )
    np.testing.assert_allclose(found, wanted, atol=0.01)


def test_without_noise_the_table_is_the_frame() -> None:
    scene, made = _wide(), make_scorer("balanced")
    table = ScoreTables(GRID, CAMERA, made, noise=False).table(scene, speed=0.1)
    prepared = prepare_scene(scene, CAMERA, speed=0.1)
    light = torch.stack([prepared.expected(state) for state in GRID.states])
    images = clip_and_quantise(light, CAMERA).clamp_(0.0, 1.0)
    captures = replace(make_captures([scene] * 64, list(GRID), 0.1), noisy=False)
    wanted = made(images, captures)
    np.testing.assert_allclose(table.mean, wanted, atol=1e-6)


def test_bands_have_light_of_their_own() -> None:
    """Half of the rows at twice the light: the means are those of both halves."""
    light, rows = _wide().light, np.ones((64, 40))
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


def test_terms_and_composites_of_ones_own() -> None:
    plain, other = Highlights(), Highlights()
    other.scale = 0.3  # the square root of the score
    first, second = (
        ScoreTables(GRID, CAMERA, CompositeScorer({"a": part})).table(_wide()).mean
        for part in (plain, other)
    )
    np.testing.assert_allclose(second, np.sqrt(first), atol=0.01)

    class Mine(CompositeScorer):
        def __call__(self, images, captures):
            return torch.full((len(captures),), 0.25)

    scorer = CompositeScorer({"mine": Mine({"noise": Noise()}), "noise": Noise()})
    table = ScoreTables(SMALL, CAMERA, scorer).table(_scene())
    np.testing.assert_array_equal(table.parts["mine"], 0.25)
    assert np.ptp(table.parts["noise"]) > 0.1
