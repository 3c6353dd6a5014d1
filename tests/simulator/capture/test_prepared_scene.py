"""Which light a capture starts from, and that its noise is the target's in every case."""

import itertools
import math
import weakref
from dataclasses import replace
from functools import partial
from random import Random

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from simulator import CameraSettings, NoiseLevelFunction, PreparedScene, get_camera
from simulator.capture import columns, prepared_scene
from simulator.capture.blurred_frames import Layout
from simulator.capture.blurred_light import MapApertureBlur, NetworkApertureBlur
from simulator.capture.sensor import clip_and_quantise
from simulator.capture.statistics import DenoisedLight
from simulator.reference.thin_lens import Lens
from tests.strategies import SEEDS, USUAL_SETTINGS, cameras, lights, settings_within
from tests.strategies import prepared as any_prepared

Z6 = get_camera("nikon_z6")
LOW, HIGH = CameraSettings(100, 1 / 64, 8), CameraSettings(6400, 1 / 64, 8)
SIDE = 128


def flat(level):
    return torch.full((4, SIDE, SIDE), level)


def recorded(level, nlf, seed=0):
    """A flat field with the noise of `nlf`, drawn by NumPy."""
    rng = np.random.default_rng(seed)
    deviation = [math.sqrt(r + s * level) for r, s in zip(nlf.read, nlf.shot, strict=True)]
    planes = [rng.normal(level, d, (SIDE, SIDE)) for d in deviation]
    return torch.from_numpy(np.stack(planes).astype(np.float32))


def expected_variance(level: float, nlf: NoiseLevelFunction) -> np.ndarray:
    return np.array(nlf.read) + np.array(nlf.shot) * level


def variance(frame):
    """Per plane; of 16,384 pixels, so within 4 * sqrt(2 / 16384) = 4.4 %."""
    return frame.double().flatten(1).var(dim=1).numpy()


TOLERANCE = 4 * math.sqrt(2) / SIDE
ROUNDING = 1 / 12 / 14512**2  # variance of whole digital numbers


def prepared(level=0.2, reference=HIGH, **changes):
    nlf = Z6.nlf(reference.iso)
    denoised = (DenoisedLight(flat(level)),)
    made = PreparedScene(recorded(level, nlf), reference, Z6, nlf, denoised_lights=denoised)
    return replace(made, **changes)


@pytest.mark.parametrize(
    ("reference", "target", "denoised"),
    [
        (HIGH, CameraSettings(100, 1.0, 8), True),  # 64 times the noise that is wanted
        (CameraSettings(100, 1.0, 8), HIGH, False),
        (HIGH, HIGH, False),  # a network must not touch what is exact already
    ],
)
def test_denoised_light_is_used_where_the_source_is_noisier(reference, target, denoised):
    source = prepared(reference=reference)
    planned = columns.plan_captures(source, [target])
    assert (planned.origins[0][0] is not None) is denoised
    assert planned.table[0, 3:].any() != denoised
    assert torch.equal(source.blurred_light.source(planned.origins[0]), flat(0.2)) is denoised
    frame, excess = source.capture(target, 3)
    assert excess == source.plan(target).excess_noise == 0.0
    wanted = expected_variance(0.2, Z6.nlf(target.iso)) + ROUNDING
    np.testing.assert_allclose(variance(frame), wanted, rtol=TOLERANCE)
    assert source.output_noise(target) == Z6.nlf(target.iso)


@pytest.mark.parametrize(("tolerance", "denoised"), [(0.13, False), (0.12, True), (0.0, True)])
def test_light_without_noise_takes_none_of_the_sources(tolerance: float, denoised: bool) -> None:
    """ISO 100 to 6400, both with the same read-noise-free NLF per gain: 1/8 of its deviation."""
    shot = {iso: NoiseLevelFunction((iso * 1e-6,) * 4, (0.0,) * 4) for iso in (100, 6400)}
    body = replace(Z6, nlf_by_iso=shot, segments=())
    low, high = CameraSettings(100, 1.0, 8), CameraSettings(6400, 1 / 64, 8)
    noisy, clean = flat(0.2) + 1e-3, DenoisedLight(flat(0.2))
    fields = {"denoised_lights": (clean,), "tolerance": tolerance}
    source = PreparedScene(noisy, low, body, body.nlf(100), **fields)
    assert source.plan(high).network is None  # the target's noise hides it
    assert torch.equal(source.expected(high), clean.light if denoised else noisy)
    plan = source.plan(high, noise=False)
    assert ("noise_reduction" in plan.modules) is denoised
    assert plan.errors["left out"] == pytest.approx(0.0 if denoised else 1 / 8)


def test_noise_is_compared_with_the_averaged_sensors() -> None:
    """A box-averaged source has the target's noise divided by k^2 as well: nothing to remove."""
    nlf = Z6.nlf(6400).scaled(1 / 16)
    assert not prepared(nlf=nlf, box_factor=4).plan(HIGH).network
    assert prepared(nlf=Z6.nlf(6400), box_factor=4).plan(HIGH).network


def with_detail(source: PreparedScene) -> PreparedScene:
    """A chequered corner of 8 pixels: a blur of flat light would be left out."""
    board = torch.zeros(SIDE, SIDE)
    board[:8:2, :8:2] = board[1:8:2, 1:8:2] = 0.1
    denoised = tuple(DenoisedLight(d.light + board) for d in source.denoised_lights)
    return replace(source, light=source.light + board, denoised_lights=denoised)


def with_aperture_blur(source: PreparedScene, diameter: float) -> PreparedScene:
    found, f_number = torch.full((SIDE, SIDE), diameter), source.reference.effective_f_number
    return replace(source, aperture_blur=MapApertureBlur(source.light, found, f_number))


@pytest.mark.parametrize("diameter", [0.8, 2.0, 6.0])
@pytest.mark.parametrize("level", [0.02, 0.2])
def test_noise_that_the_blur_removed_is_topped_up(diameter: float, level: float) -> None:
    """f/8 to f/4 at the same exposure and ISO: what blur takes of the noise is added again."""
    source = with_aperture_blur(with_detail(prepared(level)), diameter)
    target = CameraSettings(6400, 1 / 256, 4)
    planned = columns.plan_captures(source, [target])
    assert (planned.table[:, 0] == 1.0).all()
    assert planned.origins == [(None, 4.0)]
    blurred = variance(source.expected(target)[:, 16:-16, 16:-16])
    assert (blurred < 0.75 * expected_variance(level, Z6.nlf(6400))).all()  # it did remove some
    frame, excess = source.capture(target, 9)
    assert excess == 0.0
    wanted = expected_variance(level, Z6.nlf(6400)) + ROUNDING
    inner = frame[:, 16:, 16:]
    np.testing.assert_allclose(variance(inner), wanted, rtol=1.6 * TOLERANCE)
    assert inner.double().mean() == pytest.approx(level, rel=0.01)


def test_the_papers_network_always_opens_denoised_light() -> None:
    light = flat(0.2)[:, :16, :16]
    cheap, clean = DenoisedLight(light), DenoisedLight(light)
    small = PreparedScene(light, HIGH, Z6, Z6.nlf(6400), denoised_lights=(cheap, clean))
    source = replace(small, aperture_blur=NetworkApertureBlur(clean, pytest.fail, 8.0))
    planned = columns.plan_captures(source, [CameraSettings(6400, 1 / 256, 4)])
    assert planned.origins == [(clean, 4.0)]  # by the best network
    assert planned.shares == [None]
    assert source.plan(HIGH).network is None


@pytest.mark.parametrize("factor", [0.98, 1.02])
@pytest.mark.parametrize("blur", ["defocus", "motion_blur"])
def test_blur_of_a_wave_by_hand(blur: str, factor: float) -> None:
    """A wave of 16 pixels, blurred by 0.4 pixel, against noise of 1e-3: half the second moment
    times its Laplacian, root mean square."""
    t = 2 * math.pi / 16
    light = 0.3 + 0.1 * torch.cos(t * (torch.arange(SIDE, dtype=torch.float64) + 0.5)).float()
    moment = 0.4**2 / (16 if blur == "defocus" else 12)
    error = moment / 2 * (2 - 2 * math.cos(t)) * 0.1 / 2**0.5 / 1e-3
    noise, settings = NoiseLevelFunction((0.0,) * 4, (1e-6,) * 4), CameraSettings(100, 1 / 64, 8)
    camera = replace(Z6, nlf_by_iso={100.0: noise}, segments=())
    made = PreparedScene(light.expand(4, SIDE, SIDE), settings, camera, NoiseLevelFunction.zero())
    scene = {"defocus": 0.8} if blur == "defocus" else {"image_speed": 0.4 * 64 / SIDE}
    planned = columns.plan_captures(replace(made, tolerance=factor * error, **scene), [settings])
    (found,) = planned.details[:, columns.ERRORS.index(blur)]
    assert found == pytest.approx(error, rel=1e-4)
    (applied,) = planned.blurs["defocus_px" if blur == "defocus" else "motion_px"]
    assert applied == (pytest.approx(0.4) if factor < 1 else 0.0)


def test_copies_share_what_is_known_of_the_light() -> None:
    source = prepared()
    other = replace(source, gain=2.0, tolerance=0.0, image_speed=1.0)
    assert other.blurred_light is source.blurred_light
    assert replace(source, aperture_blur=None, denoised_lights=()).statistics is source.statistics
    brighter = replace(source, light=source.light * 2, denoised_lights=())
    assert brighter.statistics.light is brighter.light
    assert brighter.blurred_light is not source.blurred_light
    assert source != replace(source)  # by identity


# Sweeps


@pytest.mark.parametrize("noise", ["exact", "bank"])
def test_light_of_all_states_may_be_too_large_to_be_held_at_once(noise, monkeypatch):
    source = with_aperture_blur(with_detail(prepared(image_speed=0.2, defocus=2.0)), 2.0)
    values = itertools.product((100, 6400), (1 / 500, 1 / 8), (4, 16))
    states = list(itertools.starmap(CameraSettings, values))
    sweep = source.expose(states, seed=4, noise=noise)
    monkeypatch.setattr(prepared_scene, "_TOGETHER_BYTES", 0)
    assert torch.equal(source.expose(states, seed=4, noise=noise), sweep)


def test_a_stream_takes_states_one_by_one_and_keeps_no_frame() -> None:
    taken: list[CameraSettings] = []
    frames = prepared().stream(taken.append(state) or state for state in (LOW, HIGH))
    assert not taken
    frame = next(frames)
    assert taken == [LOW]
    kept = weakref.ref(frame)
    del frame
    assert kept() is None
    assert len(list(frames)) == 1


def test_light_of_each_state_and_of_each_row() -> None:
    """Flickering light: half of it in one state, and in the lower rows of the other."""
    source = prepared(nlf=NoiseLevelFunction.zero(), denoised_lights=(), light=flat(0.2))
    gain, rows = np.array([0.5, 1.0]), np.ones((2, SIDE))
    rows[1, 64:] = 0.25
    wanted = [[0.2 / 64 / 2, 0.2 / 64 / 2], [0.2, 0.05]]
    source = replace(source, reference=HIGH)
    found = source.expose([LOW, HIGH], noise=None, gain=gain, row_gain=rows)
    rounding = 0.5 / float(source.camera.span[0])
    np.testing.assert_allclose(found[:, 0, [0, -1], 0], wanted, atol=1.001 * rounding)
    (clean,) = source.expose([LOW], noise=None)
    assert torch.equal(clean, clip_and_quantise(source.expected(LOW), source.camera))
    for name in ("gain", "row_gain"):
        for wrong in (np.ones(3), np.full(2, -1.0), np.full((2, SIDE), math.nan), 2.0):
            with pytest.raises(ValueError, match=rf"(?s)`{name}` .* must be an array \(2,"):
                source.expose([LOW, HIGH], **{name: wrong})
    frames = source.expose([LOW, HIGH], gain=gain, row_gain=rows)
    for state, frame in enumerate(frames):
        halves = frame[:, :64].mean(), frame[:, 64:].mean()
        np.testing.assert_allclose(halves, wanted[state], rtol=0.01)


def test_frames_are_written_where_they_are_wanted() -> None:
    place = torch.full((3, 4, SIDE, SIDE), -7.0)
    frames = prepared().expose([LOW, HIGH], seed=3, out=place[1:])
    assert frames.data_ptr() == place[1:].data_ptr()
    source = prepared(reference=LOW, gain=1 / 64)  # to which noise is added
    for default in (source.capture(HIGH)[0], source.expose([HIGH])[0]):
        assert torch.equal(default, source.expose([HIGH], seed=0)[0])
        assert not torch.equal(default, source.expose([HIGH], seed=1)[0])
    assert torch.equal(frames, prepared().expose([LOW, HIGH], seed=3))
    assert bool((place[0] == -7.0).all())
    assert prepared().expose([]).shape == (0, 4, SIDE, SIDE)
    own = prepared()  # whose light is not overwritten
    with pytest.raises(ValueError, match="`out`"):
        own.expose([HIGH], out=own.light[None])


def test_bad_scenes_and_sweeps_are_refused():
    scenes = {"light": [torch.zeros(3, 8, 8), torch.full((4, 8, 8), math.nan)]}
    scenes |= {"layout": [Layout(torch.zeros(8, 8))], "image_speed": [-1.0, 1000.1]}
    scenes |= {"tolerance": [math.inf], "defocus": [math.nan, 513.0]}
    scenes |= {"gain": [-1.0, "1", None, math.inf, math.nan]}
    four = (DenoisedLight(flat(0.2)),) * 4
    scenes |= {"denoised_lights": [(DenoisedLight(torch.zeros(4, 8, 8)),), four, torch.zeros(4)]}
    outs = [torch.empty(2, 4, SIDE, SIDE), torch.empty(1, 4, SIDE, SIDE, dtype=torch.float64)]
    outs += [torch.empty(1, 4, SIDE, 2 * SIDE)[..., ::2]]
    outs += [torch.empty(1, 4, SIDE, SIDE, requires_grad=True)]
    sweeps = {"states": [[HIGH, 3]], "noise": ["none"], "out": outs}
    for name, value in ((n, v) for n, values in (scenes | sweeps).items() for v in values):
        call = prepared if name in scenes else partial(prepared().expose, states=[HIGH])
        with pytest.raises(ValueError, match=f"`{name}`"):
            call(**{name: value})


# Layouts


def _layout(size: int = 12) -> Layout:
    rng = np.random.default_rng(0)
    defocus = torch.from_numpy(rng.random((size, size)).astype(np.float32))
    return Layout(defocus, torch.from_numpy(rng.random((size, size)) < 0.3))


def test_behind_the_subject_is_the_nearest_background() -> None:
    layout = _layout()
    mask, behind = layout.subject.numpy(), layout.behind.numpy()
    y, x = np.nonzero(~mask)
    for row, column in zip(*np.nonzero(mask), strict=True):
        at = divmod(int(behind[row, column]), 12)
        nearest = np.hypot(y - row, x - column).min()
        assert not mask[at]
        assert np.hypot(at[0] - row, at[1] - column) == pytest.approx(nearest)
    assert (behind[~mask] == np.flatnonzero(~mask)).all()


def test_a_depth_gives_the_circles_of_a_thin_lens() -> None:
    depth = torch.rand(9, 9, generator=torch.Generator().manual_seed(0)) * 5.0 + 0.5
    circles = Lens(0.05, 1.7).circle_of_confusion(depth, 4.0).abs()
    layout = Layout.from_depth(depth, 1.7, in_focus=0.2)
    torch.testing.assert_close(layout.defocus, circles / circles.max(), rtol=1e-4, atol=1e-5)
    assert torch.equal(layout.subject, layout.defocus <= 0.2)


def test_averages_and_windows() -> None:
    layout = _layout()
    small = layout.cut(slice(0, 8), slice(2, 10)).averaged(4)
    tile = slice(4, 8), slice(2, 6)
    assert float(small.defocus[1, 0]) == pytest.approx(float(layout.defocus[tile].mean()))
    wanted = bool(layout.subject[tile].double().mean() > 0.5)
    assert (False if small.subject is None else bool(small.subject[1, 0])) == wanted
    halves = torch.tensor([[True, False, True, True]] * 2)  # a half is not most of it
    assert Layout(torch.zeros(2, 4), halves).averaged(2).subject.tolist() == [[False, True]]
    for everywhere in (False, True):  # nothing and everything are no subject
        assert Layout(torch.zeros(4, 4), torch.full((4, 4), everywhere)).subject is None


@pytest.mark.parametrize("name", ["plan", "capture", "expected", "output_noise"])
def test_one_capture_names_what_is_wrong(name: str) -> None:
    call = getattr(prepared(), name)
    wrong = {"plan": {"noise": ["exact", None, 1]}, "capture": {"noise": [None, "none"]}}
    wrong |= {"expected": {"gain": ["2", None, -1.0, math.nan, np.ones(1)]}}
    for argument, values in wrong.get(name, {}).items():
        for value in values:
            with pytest.raises(ValueError, match=f"`{argument}`"):
                call(LOW, **{argument: value})
    with pytest.raises(ValueError, match="`settings`"):
        call("x")


def test_errors_name_the_argument() -> None:
    zeros, ones = torch.zeros(4, 4), torch.ones(4, 4)
    for defocus in ([[0.0]], torch.zeros(3, 4, 4), 1.5 * ones, torch.nan * ones):
        with pytest.raises(ValueError, match="`defocus`"):
            Layout(defocus)
    for subject in (zeros, torch.zeros(4, 5, dtype=torch.bool), [[True]]):
        with pytest.raises(ValueError, match="`subject`"):
            Layout(zeros, subject)
    bad = {"depth": (zeros, 1.0, 0.1), "distance": (ones, 0.0, 0.1), "in_focus": (ones, 1.0, 1.01)}
    for name, (depth, distance, in_focus) in bad.items():
        with pytest.raises(ValueError, match=f"`{name}`"):
            Layout.from_depth(depth, distance, in_focus=in_focus)


ANY_SETTINGS = settings_within()
STATES = st.lists(st.one_of(ANY_SETTINGS, USUAL_SETTINGS), min_size=1, max_size=5)
FIELDS = [{}, {"image_speed": 0.5}, {"defocus": 3.0, "tolerance": 0.0}]
FIELDS += [{"gain": gain} for gain in (0.0, 1e39)]
DARKEST, BRIGHTEST = CameraSettings(1e-3, 1e-9, 1024), CameraSettings(1e8, 1e5, 0.5)
SCENES = (lights(), cameras(), ANY_SETTINGS, STATES, st.sampled_from(FIELDS), st.booleans())


# A variance beyond float32.
@example(torch.zeros(4, 1, 1), Z6, DARKEST, [BRIGHTEST], FIELDS[-1], True, 0, "exact", Random(0))
@given(*SCENES, SEEDS, st.sampled_from(["exact", "bank"]), st.randoms(use_true_random=False))
def test_a_frame_is_the_same_alone_in_a_sweep_and_in_any_order(
    light, camera, reference, states, fields, is_noisy, seed, noise, random
):
    nlf = camera.nlf(reference.iso) if is_noisy else None
    source = any_prepared(light, reference, camera, nlf, **fields)
    sweep = source.expose(states, seed=seed, noise=noise)
    span = torch.tensor(camera.pedestal)[:, None, None]
    assert bool(((sweep >= -span * (1 + 1e-6) - 1e-6) & (sweep <= 1)).all())
    order = random.sample(range(len(states)), len(states))
    permuted = source.expose([states[i] for i in order], seed=seed, noise=noise)
    assert torch.equal(permuted, sweep[order])
    streamed = list(source.stream(states, seed=seed, noise=noise))
    fresh = any_prepared(light, reference, camera, nlf, **fields)
    for state, frame, in_stream in zip(states, sweep, streamed, strict=True):
        again, excess = fresh.capture(state, seed, noise=noise)
        assert torch.equal(again, frame)
        assert 0.0 <= excess < math.inf
        assert torch.equal(in_stream, frame)
        assert torch.isfinite(fresh.expected(state)).all()
        plan = fresh.plan(state)
        assert 0.0 <= plan.excess_noise < math.inf
        assert 0.0 <= plan.predicted_error <= plan.error_bound  # no NaN
        assert len(plan.explain().splitlines()) == 3
