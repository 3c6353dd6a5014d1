"""Light behind apertures and in motion, cached within bounds; captures in batches."""

import functools
import math
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate

from simulator import CameraSettings, NoiseLevelFunction, PreparedScene, exposure_ratio, get_camera
from simulator.capture import batch as batch_module
from simulator.capture import blurred_frames
from simulator.capture.batch import MODULES, CaptureBatch
from simulator.capture.blurred_frames import BlurredFrames, Layout
from simulator.capture.blurred_light import BlurredLight, MapApertureBlur, NetworkApertureBlur
from simulator.capture.columns import MOVES, noise_columns, plan_captures
from simulator.capture.plan import noise_balances
from simulator.capture.sensor import record
from simulator.capture.statistics import DenoisedLight, Residual
from simulator.networks.aperture_module import ApertureModule
from simulator.noise.generator import noise_keys
from simulator.optics.discs import DIAMETERS, DiscBank, added_blur, disc_blur, disc_kernel
from simulator.optics.motion import Movement, Path, motion_blur, path_blur, path_taps
from simulator.optics.vignetting import Vignetting
from simulator.utils.tiles import make_tiles
from tests.simulator.tables import streak_kernel

Z6 = get_camera("nikon_z6")
ZERO = NoiseLevelFunction.zero()


# -- opening the aperture ---------------------------------------------------------------------


def light(seed=0):
    values = np.random.default_rng(seed).random((4, 24, 24), dtype=np.float32)
    return torch.from_numpy(values)


def aperture_blur(diameter: float = 2.0 / math.sqrt(3)) -> MapApertureBlur:
    """At f/4 the default adds exactly 2 px, a disc of the bank, to a picture at f/8."""
    assert 2.0 in DIAMETERS
    return MapApertureBlur(light(), torch.full((24, 24), diameter), 8.0)


def test_each_light_is_blurred_by_its_own_bank_and_cached() -> None:
    made, kernel = aperture_blur(), torch.zeros(9, 9)
    for denoised in (None, DenoisedLight(light(1)), DenoisedLight(light(2))):
        result = made.opened(4.0, denoised)
        expected = disc_blur(light() if denoised is None else denoised.light, 2.0)
        torch.testing.assert_close(result, expected, atol=1e-5, rtol=0)
        assert made.opened(4.0, denoised) is result
        assert not torch.equal(made.opened(5.6, denoised), result)
    kernel[4, 4] = 1.0
    energy = disc_blur(kernel, 2.0).square().sum()
    remaining = made.remaining_variance(4.0)
    torch.testing.assert_close(remaining, energy.expand(24, 24), rtol=1e-5, atol=0)


def test_a_lamp_of_any_brightness_stays_finite() -> None:
    opened = []
    for lamp in (0.0, 1e30):
        scene = light()
        scene[:, 12, 12] = lamp
        made = MapApertureBlur(scene, torch.full((24, 24), 3.0), 8.0)
        opened.append(made.opened(4.0, None))
    assert bool(opened[1].isfinite().all())
    # A disc's 6 px away nothing of the lamp arrives, and nothing of the shadows is lost.
    torch.testing.assert_close(opened[1][:, 3, 3], opened[0][:, 3, 3])


def test_the_papers_network_runs_once_per_f_number_on_the_denoised_light() -> None:
    torch.manual_seed(0)
    module = ApertureModule("paper").eval().requires_grad_(False)
    module.network.tail.weight.mul_(10)
    made = NetworkApertureBlur(DenoisedLight(light()), module, 8.0)
    assert made.needs_denoised
    assert made.extent(4.0) == math.inf
    assert made.extent(8.0) == made.extent(11.0) == 0.0
    assert made.remaining_variance(4.0) is None
    result = made.opened(4.0)
    assert made.opened(4.0, DenoisedLight(light())) is result  # it has its own
    f_source, f_target = torch.tensor([8.0]), torch.tensor([4.0])
    image = light()[None]
    expected = module(image, torch.zeros_like(image), f_source, f_target)[0]
    assert torch.equal(result, expected)
    assert not torch.equal(result, light())


@pytest.mark.parametrize("size", [(1, 40), (40, 1), (35, 91), (150, 133)])
@pytest.mark.parametrize("tile", [32, 768])
def test_tiles_have_no_seams_and_what_is_in_focus_is_copied(size, tile, monkeypatch):
    generator = torch.Generator().manual_seed(2)
    image = torch.rand(4, *size, generator=generator) * 3
    diameter = 12 * torch.rand(size, generator=generator)
    diameter[: size[0] // 2, : 2 * size[1] // 3] = 0.0
    smaller = functools.partial(make_tiles, tile=tile)
    monkeypatch.setattr("simulator.capture.blurred_light.make_tiles", smaller)
    made = MapApertureBlur(image, diameter, 8.0)
    for f_number in (5.6, 2.8):
        result = made.opened(f_number, None)
        whole = DiscBank(image).blurred(added_blur(diameter, 8.0, f_number))
        torch.testing.assert_close(result, whole, rtol=0, atol=3e-6)
        assert torch.equal(result[:, diameter == 0], image[:, diameter == 0])
        assert not torch.equal(result, image) or min(size) == 1


# -- uniform blur in sweeps -------------------------------------------------------------------

LIGHT = torch.rand(4, 24, 20, generator=torch.Generator().manual_seed(0))
CLEAN = DenoisedLight(LIGHT * 0.5)


@pytest.mark.parametrize("denoised", [False, True])
def test_disc_then_streak(denoised: bool) -> None:
    source = CLEAN.light if denoised else LIGHT
    blurred_light, blur = BlurredLight(LIGHT, ZERO, None), np.zeros(1, blurred_frames.BLUR)
    given = [(CLEAN if denoised else None, None)], blur, (None, None)
    assert blurred_light.lights(*given)[0] is source  # what needs no blur is not copied
    blur["defocus_px"], blur["motion_px"], blur["streaks"] = 2.0, 3.0, True
    expected = motion_blur(disc_blur(source, 2.0), 3.0)
    (found,) = blurred_light.lights(*given)
    assert torch.equal(found, expected)
    assert blurred_light.lights(*given)[0] is found  # made once


def test_noise_that_opening_and_motion_leave() -> None:
    opens = MapApertureBlur(LIGHT, torch.full((24, 20), 2.0), 8.0)
    alone = opens.remaining_variance(4.0)
    blur = np.zeros(1, blurred_frames.BLUR)
    left = BlurredLight(LIGHT, Z6.nlf(800), opens).remaining_variance
    assert torch.equal(left(blur[0], None, None, 4.0), alone)
    blur["motion_px"], blur["streaks"] = 3.0, True
    energy = np.square(streak_kernel(3.0)).sum().item()
    moved = (alone / energy).clamp(max=1.0)
    torch.testing.assert_close(left(blur[0], None, None, 4.0), moved, rtol=1e-5, atol=0)


# -- scenes with a layout, in motion ------------------------------------------------------------

REFERENCE = CameraSettings(800, 1 / 64, 4)
SIZE = 32
SCENE = torch.rand(4, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
MOVEMENT = Movement(0.6, 2.0, subject_speed=0.4, subject_direction=2.0)
SLOW = CameraSettings(100, 1 / 2, 8)


SLOW_RATIO = 1.0  # three stops less gain, five more light, two less through the aperture
SHAKE = Path(0.3 * 0.5 * SIZE, 0.6, 2.0 * 0.5)
DRIFT = 0.4 * 0.5 * SIZE
OWN = SHAKE._replace(drift_x=DRIFT * math.cos(2.0), drift_y=DRIFT * math.sin(2.0))


def _layout() -> Layout:
    """Halves in and out of focus, and a subject across them."""
    defocus = torch.zeros(SIZE, SIZE)
    defocus[:, SIZE // 2 :] = 1.0
    subject = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    subject[10:20, 12:24] = True
    return Layout(defocus, subject)


def _prepared(noisy=False, **fields):
    nlf = Z6.nlf(800) if noisy else ZERO
    given = {"layout": _layout(), "movement": MOVEMENT, "tolerance": 0.0, **fields}
    return PreparedScene(SCENE, REFERENCE, Z6, nlf, **given)


def test_without_a_subject_the_frame_moves_as_a_whole() -> None:
    whole = Layout(torch.zeros(SIZE, SIZE))
    (blur,) = plan_captures(_prepared(layout=whole, image_speed=0.3), [SLOW]).blurs
    assert [blur[n].item() for n in ("extent", "direction", "turn", "mask")] == [*SHAKE[:3], 0]
    assert blur["motion_px"] == pytest.approx(0.3 * 0.5 * SIZE)
    found = _prepared(layout=None, image_speed=0.3).expected(SLOW)
    torch.testing.assert_close(found, path_blur(SCENE, path_taps(SHAKE, SIZE, SIZE)))
    along_rows = _prepared(layout=None, movement=Movement(subject_speed=2.0), image_speed=0.3)
    plain = PreparedScene(SCENE, REFERENCE, Z6, ZERO, image_speed=0.3)
    assert torch.equal(plain.expected(SLOW), along_rows.expected(SLOW))
    assert plan_captures(along_rows, [SLOW]).blurs["streaks"].all()


@pytest.mark.parametrize("defocus", [0.0, 5.0])
@pytest.mark.parametrize("speed", [0.0, 0.5])
@pytest.mark.parametrize("movement", [MOVEMENT, Movement(0.6, 2.0), Movement()])
def test_noise_that_blur_leaves(defocus: float, speed: float, movement: Movement) -> None:
    """The variance of blurred white noise, over many draws."""
    scene = _prepared(noisy=True, defocus=defocus, image_speed=speed, movement=movement)
    _, (blur,), (table,), (left,), _ = plan_captures(scene, [SLOW])
    share = table[3].item(0) / (SLOW_RATIO * Z6.nlf(800).shot[0])
    share = torch.full((SIZE, SIZE), share) if left is None else share * left
    draws = torch.randn(600, SIZE, SIZE, generator=torch.Generator().manual_seed(3))
    blurred = []
    for planes in draws.reshape(-1, 4, SIZE, SIZE):
        made = PreparedScene(planes, REFERENCE, Z6, ZERO, tolerance=0.0)
        same = replace(made, defocus=defocus, image_speed=speed, movement=movement)
        same = replace(same, layout=scene.layout)
        blurred.append(same.expected(SLOW))
    measured = torch.cat(blurred).double().square().mean(dim=0)
    ratio = (measured / share)[6:-6, 6:-6]  # replicated borders average less
    assert float(ratio.min()) > 0.75
    if blur["mask"] and speed + movement.subject_speed > 0.0:
        # What continues behind the subject repeats pixels, and their noise with them.
        assert float(ratio.mean()) < 1.25
        ratio = ratio[:, :4]
    assert float(ratio.median()) == pytest.approx(1.0, abs=0.06)  # of the draws
    assert float(ratio.quantile(0.95)) < 1.2


def test_whole_captures_by_hand() -> None:
    """Defocus, then the background along its path, then the subject along its own, by SciPy."""
    layout = _layout()
    scene = _prepared(defocus=2.0 * DIAMETERS[5], image_speed=0.3)
    sharp = SCENE.double().numpy()
    soft = disc_blur(SCENE.double(), DIAMETERS[5]).numpy()
    light = np.where(layout.defocus.numpy() > 0.0, soft, sharp)

    def kernel(path):
        taps, reach = path_taps(path, SIZE, SIZE), 16
        dense = np.zeros((2 * reach + 1, 2 * reach + 1))
        np.add.at(dense, (taps.rows + reach, taps.columns + reach), taps.weights)
        return dense

    shake, own = kernel(SHAKE), kernel(OWN)
    mask, behind = layout.subject.numpy(), layout.behind.numpy()
    cover = correlate(mask.astype(float), own, mode="nearest")
    found = scene.expected(SLOW)
    for plane, result in zip(light, found, strict=True):
        wanted = (1.0 - cover) * correlate(plane.ravel()[behind], shake, mode="nearest")
        wanted += correlate(mask * plane, own, mode="nearest")
        np.testing.assert_allclose(result, wanted, atol=2e-5)
    assert math.isclose(cover.sum(), mask.sum(), rel_tol=1e-5)


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("most_bytes", [2**30, 0])
def test_many_images_are_scipys_correlation(threads, most_bytes, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    shape, blurs = (4, 21, 40), np.zeros(7, blurred_frames.BLUR)
    blurs["defocus_px"], blurs["streaks"] = (48.0, 0.0, 3.3, 8.0, 1e-4, 2.0, 0.7), True
    blurs["motion_px"] = (5.0, 5.0, 0.0, 17.0, 1e-7, 90.0, 0.4)
    blurs["streaks"][1], blurs["extent"][1] = False, 5.0  # a path along the rows: the same
    lights = list(torch.rand(7, *shape, generator=torch.Generator().manual_seed(0)))
    lights[1][2, 7, 9] = lights[2][0, 3, 4] = 1e30  # clipped first
    lights[3][1, 5, 6], atol = -1e30, {1: 3000.0, 2: 300.0, 3: 300.0}
    frames = BlurredFrames(9, 2, most_bytes)
    for used in (np.arange(7), np.array([5, 2]), np.arange(4)):
        some = frames.places([lights[i] for i in used])
        made, planned = frames.plan(used + 1, 0 * used, blurs[used], some, used)
        frames.run(planned)
        for i, found in zip(used, frames.at(made), strict=True):
            rtol, clipped = 2e-4 if i == 0 else 1e-5, lights[i].double().clamp(-1e9, 1e9).numpy()
            weights = disc_kernel(blurs["defocus_px"][i])[None]
            wanted = correlate(clipped, weights, mode="nearest")
            streak = streak_kernel(blurs["motion_px"][i])[None, None]
            wanted = correlate(wanted, streak, mode="nearest")
            np.testing.assert_allclose(found, wanted, rtol, atol=atol.get(int(i), 0.0))


# -- batches ---------------------------------------------------------------------------------------

STATES = [CameraSettings(iso, time, 4) for iso in (100, 6400) for time in (1 / 500, 1 / 8)]
STATES += [CameraSettings(400, 1 / 30, 8), CameraSettings(204800, 1 / 30, 2)]
LIGHTS = [
    torch.rand(4, 24, 20, generator=torch.Generator().manual_seed(i)) * 2.0 for i in range(10)
]
SCENES, LENS = np.arange(10), Vignetting("test", (2.0, 8.0), ((-0.75, 0.0, 0.0), (-0.2, 0.0, 0.0)))
KEYS = noise_keys(SCENES, SCENES + 5)


def prepared(index: int) -> PreparedScene:
    """Two at rest, one that moves, one also out of focus, one that moves and whose aperture opens,
    two with a layout and a subject that moves; three of these without noise, as are the first and
    third. A network denoised the second, and parts of it are clipped. Three are behind a lens."""
    light, noisy = LIGHTS[index], index not in (0, 2) and index < 7
    index = {7: 3, 8: 5, 9: 6}.get(index, index)
    changes = {"image_speed": 0.3} if index in (2, 3) else {}
    if index == 1:
        network = DenoisedLight(0.9 * light, residual=Residual.alike(0.2))
        changes |= {"denoised_lights": (network,), "saturated": light.amax(dim=0) > 1.9}
        changes |= {"image_speed": 0.02, "defocus": 0.1, "tolerance": 0.3}
    if index == 3:
        changes |= {"defocus": 2.0, "movement": Movement(0.6, 2.0)}
    if index == 4:
        found = torch.full((24, 20), 1.0)
        changes |= {"aperture_blur": MapApertureBlur(light, found, 4.0), "image_speed": 0.1}
    if index in (1, 4, 6):
        changes["lens"] = LENS
    if index > 4:
        rows, columns = torch.arange(24)[:, None], torch.arange(20)
        subject = (abs(rows - 12) < 5) & (abs(columns - 8) < 5)
        changes["layout"] = Layout((columns >= 10).float().expand(24, 20).contiguous(), subject)
        changes["movement"] = Movement(0.6, 2.0, subject_speed=0.4, subject_direction=2.0)
        changes |= {"defocus": 3.0} | ({"image_speed": 0.2} if index == 5 else {})
    nlf = Z6.nlf(800) if noisy else NoiseLevelFunction.zero()
    return PreparedScene(light, REFERENCE, Z6, nlf, **changes)


def made(noise="bank", *, light_bytes=2**30, scenes=prepared, camera=Z6, **known):
    known |= {"noise": noise, "light_bytes": light_bytes}
    return CaptureBatch(scenes, 10, STATES, camera, **known)


def defocused(rest, defocus):
    """`moved` of a batch: scenes at `rest` (10,) that others show out of focus, -1 for none."""

    def moved(indices):
        moves = np.zeros(len(indices), MOVES)
        moves["defocus"] = defocus[indices]
        return rest[indices], moves

    return moved


def photographed(batch, states, gains=(1.0,) * 10, **options):
    """Frames of all scenes, and their statistics."""
    chosen, frames = np.broadcast_to(states, 10), np.empty((10, 4, 24, 20), np.float32)
    batch.prepare(SCENES, chosen, np.array(gains))
    return frames, batch.record(SCENES, chosen, SCENES, SCENES + 5, signals=frames, **options)


def alone(scene, state, gain, key, noise="bank"):
    """Its capture, the samples that are clipped, and the excess of its noise."""
    frame, states = torch.empty(1, 4, 24, 20), STATES[state : state + 1]
    if key is None:  # the light has no pattern of the sensor
        scene = scene.changed(camera=Z6)
    ((_, found),) = scene.transitions(states, gain=np.array([gain]))
    nlf, ratio = Z6.nlf(states[0].iso), gain * exposure_ratio(REFERENCE, states[0])
    np.testing.assert_allclose(found.table[0, 0], ratio, rtol=1e-6)
    noises, atol = found.table[0, 1:3] + found.table[0, 3:], 1e-6 * found.table[0, 3:].max()
    np.testing.assert_allclose(noises, [nlf.shot, nlf.read], 1e-6, atol)
    shares = found.remaining_variance or [None]
    fixed = shares, found.table, noise_columns(Z6, states, 1)
    excess, _ = noise_balances([found.light[0]], *fixed)
    keys = None if key is None else np.array([key], np.uint64)
    counts = record(found, Z6, keys=keys, noise=noise, signals=frame, count=True)
    return frame[0].numpy(), counts[0], excess.item()


@pytest.mark.parametrize("noise", ["bank", "exact", None])
@pytest.mark.parametrize("light_bytes", [2**30, 0])
def test_frames_are_those_of_each_scene_alone(noise, light_bytes, monkeypatch):
    monkeypatch.setattr(blurred_frames, "_LARGE", light_bytes)  # at 0, rows are shared out
    # All that a scene needs at once, or each kind of pass on threads that share rows.
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2 if light_bytes else 61)
    camera = Z6 if light_bytes else replace(Z6, prnu=0.02)
    shown = [replace(prepared(i), camera=camera) for i in range(10)]
    scenes, rng, seen = Mock(side_effect=shown.__getitem__), np.random.default_rng(0), set()
    batch = made(noise, light_bytes=light_bytes, scenes=scenes, camera=camera)
    for _ in range(12):
        states, gains = rng.integers(len(STATES), size=10), rng.choice([1e-6, 0.25, 1.0, 3.0], 10)
        frames, found = photographed(batch, states, gains)
        for i in range(10):
            key = None if noise is None else int(KEYS[i])
            wanted, counts, excess = alone(shown[i], states[i], gains[i], key, noise or "bank")
            np.testing.assert_array_equal(frames[i], wanted)
            clipped = found.clipped_low[i], found.clipped_high[i]
            assert clipped == tuple(counts / wanted.size)
            assert clipped == ((wanted <= 2.0**-10).mean(), (wanted == 1.0).mean())
            scene = shown[i].changed(gain=gains[i], camera=camera if noise else Z6)
            modules = [*scene.plan(STATES[states[i]]).modules]
            assert modules.pop() == "clip_and_quantise"
            modules += ["noise"] * ("noise" not in modules)
            assert MODULES[found.modules[i]] == "+".join(modules if noise else modules[:-1])
            seen |= set(modules)
            excess = excess if noise else 0.0
            assert found.excess_variance[i] == pytest.approx(excess, rel=0.05, abs=1e-9)
            seen |= {"excess"} if excess > 0.1 and "aperture" in modules else set()
            if not shown[i].nlf.is_zero:  # without noise, the error is that of the light alone
                plan = scene.plan(STATES[states[i]], noise=bool(noise))
                assert found.predicted_error[i] == pytest.approx(plan.predicted_error)
    assert seen >= {"noise_reduction", "aperture", "defocus", "motion_blur", "vignetting"}
    assert sorted(call.args[0] for call in scenes.call_args_list) == list(range(10))
    assert noise is None or seen >= {"noise", "excess"}


@pytest.mark.parametrize("noise", [True, False])
def test_a_sweep_is_planned_as_each_state_alone(noise) -> None:
    family = tuple(
        DenoisedLight(functools.partial(torch.clone, LIGHTS[i]), residual=Residual.alike(error))
        for i, error in enumerate((0.4, 0.2, 0.05))
    )
    opens = NetworkApertureBlur(family[2], lambda image, *_: 0.9 * image, 4.0)
    scenes = [replace(prepared(1), denoised_lights=family, tolerance=0.1 * i) for i in range(4)]
    plan_captures(scenes[3], STATES[-1:])
    assert not any(network.shape for network in family)  # none has run: the target is noisier
    scenes += [replace(scene, aperture_blur=opens) for scene in scenes]
    for scene in (*map(prepared, range(10)), *scenes):
        sweep = plan_captures(scene, STATES, np.full(6, 0.5), noise=noise)
        for i, state in enumerate(STATES):
            alone = plan_captures(scene, [state], np.full(1, 0.5), noise=noise)
            for name in ("blurs", "table", "details"):
                np.testing.assert_array_equal(getattr(sweep, name)[i], getattr(alone, name)[0])
            assert [sweep.origins[i]] == alone.origins
            shares = sweep.shares[i], *alone.shares
            assert shares[0] is shares[1] is None or torch.equal(*shares)


def test_wide_discs_and_frames_that_others_ask_for(monkeypatch) -> None:
    """NumPy makes wide discs, before the frames; light that was never asked for is made later."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    scene = prepared(0).changed(defocus=50.0)
    batch = made(scenes=lambda index: scene)
    for states in (0, 1):
        batch.prepare(SCENES, np.full(10, 4), np.ones(10))  # and no `record`
        frames, _ = photographed(batch, states)
        for i, frame in enumerate(frames):
            wanted, *_ = alone(scene, states, 1.0, int(KEYS[i]))
            np.testing.assert_array_equal(frame, wanted)


def test_forgotten_scenes_are_asked_for_again() -> None:
    calls: list[int] = []
    batch = made(scenes=lambda index: calls.append(index) or prepared(index))
    first, again, _ = photographed(batch, 1)[0], photographed(batch, 1)[0], photographed(batch, 4)
    assert sorted(calls) == list(range(10))
    batch.forget(np.array([3]))
    after, _ = photographed(batch, 1)
    assert calls[10:] == [3]
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(after, first)


@pytest.mark.parametrize("threads", [2, 61])
@pytest.mark.parametrize(
    "stage", ["photograph", "noise_balances", "opening_errors", "plan_passes", "_forgetting"]
)
def test_an_interrupted_batch_is_made_again(stage, threads, monkeypatch) -> None:
    """While light is blurred, once it is, while frames are planned, once memory is taken, and just
    before planned light is made, with the frames or, for many threads, before them."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    stage = "_run" if stage == "photograph" and threads == 61 else stage
    noise = None if stage in ("photograph", "_run", "_forgetting") else "bank"
    modules = {"plan_passes": blurred_frames, "_forgetting": CaptureBatch, "_run": BlurredFrames}
    module = modules.get(stage, batch_module)
    batch, calls, original = made(noise), [], getattr(module, stage)
    changed = 5 if stage == "opening_errors" else 1
    broken = 4 if stage == "_forgetting" else changed
    photographed(batch, 0), photographed(batch, changed)

    def fail(*args, **kwargs):
        calls.append(args)
        if stage == "_forgetting" and len(calls) == 1:  # of `prepare`
            return original(*args)
        if stage == "plan_passes":
            original(*args)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module, stage, fail)
        with pytest.raises(KeyboardInterrupt):
            photographed(batch, broken, [3.0] * 10)
    for given in ((broken, [3.0] * 10), (changed,), (0,)):
        expected, _ = photographed(made(noise), *given)
        np.testing.assert_array_equal(photographed(batch, *given)[0], expected)


@pytest.mark.parametrize("case", ["clean", "interrupted", "two lights"])
def test_discs_are_made_once_for_all_that_show_a_scene(case, monkeypatch) -> None:
    """Where a network has denoised the light of some of them, these share no disc."""
    still, kinds = {"image_speed": 0.0, "movement": Movement()}, list[int]()
    scene = prepared(8).changed(defocus=2.0, **still)
    if case == "two lights":
        networks = (DenoisedLight(0.5 * scene.light, residual=Residual.alike(0.01)),)
        scene = replace(scene, nlf=Z6.nlf(800), denoised_lights=networks)
    shown, run = [scene.changed(defocus=2.0 + i) for i in range(10)], BlurredFrames.run
    chosen = np.array([1, 2] * 5), np.full(10, 5), np.array([2, 1] * 5)
    wanted = [[alone(shown[i], s[i], 1.0, int(KEYS[i]))[0] for i in range(10)] for s in chosen]

    def counted(frames, planned):
        kinds.extend(planned.passes["kind"])
        if case == "interrupted" and len(kinds) == len(planned.passes):
            raise KeyboardInterrupt
        run(frames, planned)

    monkeypatch.setattr(BlurredFrames, "run", counted)
    moved = defocused(np.where(SCENES, 0, -1), 2.0 + SCENES)
    batch = made(scenes=lambda _: scene, moved=moved)
    if case == "interrupted":
        with pytest.raises(KeyboardInterrupt):
            batch.prepare(SCENES[1:], chosen[0][1:], np.ones(9))
    for states, expected in zip(chosen, wanted, strict=True):
        np.testing.assert_array_equal(photographed(batch, states)[0], expected)
        batch.forget(SCENES[1:])
    times = {"clean": 1, "interrupted": 2}.get(case, math.inf)
    assert 0 < kinds.count(blurred_frames.LEVEL) <= times * (len(DIAMETERS) - 1)


@pytest.mark.parametrize("device", [None, torch.device("cpu")])
def test_discs_of_scenes_that_are_not_shown_make_room(device) -> None:
    """A frame has 7.5 KiB: the light of one scene with all its discs fits, that of two does not."""
    scene, rest = prepared(8).changed(image_speed=0.0, movement=Movement()), np.full(10, -1)
    moved = defocused(rest, np.full(10, scene.defocus))
    known = {"light_bytes": 16 * 7680, "moved": moved, "device": device}
    batch = made(None, scenes=lambda _: scene, **known)
    wanted, own = scene.expected(STATES[1]).clamp(0.0, 1.0), np.array([9])
    for rest[9] in range(9):
        frame = torch.empty(1, 4, 24, 20)
        batch.prepare(own, own - 8, np.ones(1))
        batch.record(own, own - 8, own, own, images=frame)
        torch.testing.assert_close(frame[0], wanted, atol=1e-3, rtol=0)
        batch.forget(own)
    assert not batch._frames.is_full


def test_an_interrupt_while_the_noise_of_averages_is_new(monkeypatch) -> None:
    def scene(index: int) -> PreparedScene:
        return replace(prepared(0), box_factor=1 + index % 2)

    expected, _ = photographed(made("exact", scenes=scene), 0)
    batch, original = made("exact", scenes=scene), batch_module.columns.noise_columns

    def fail(camera, states, box):
        if box == 2:
            raise KeyboardInterrupt
        return original(camera, states, box)

    with monkeypatch.context() as patch:
        patch.setattr(batch_module.columns, "noise_columns", fail)
        with pytest.raises(KeyboardInterrupt):
            photographed(batch, 0)
    np.testing.assert_array_equal(photographed(batch, 0)[0], expected)


def test_a_disc_that_is_too_wide_at_any_state_is_refused_at_the_first_frame() -> None:
    widest = 512.0 * min(state.effective_f_number for state in STATES) / 4.0
    narrowest = max(range(len(STATES)), key=lambda i: STATES[i].effective_f_number)
    photographed(made(scenes=lambda index: prepared(0).changed(defocus=widest)), narrowest)
    with pytest.raises(ValueError, match="`defocus`"):
        photographed(made(scenes=lambda i: prepared(0).changed(defocus=1.01 * widest)), narrowest)


def test_light_that_nothing_moves_is_cached_once_behind_a_lens() -> None:
    scene = replace(prepared(0), lens=LENS, movement=Movement(0.6, 2.0), image_speed=1e-9)
    slow, fast = (CameraSettings(100, time, 2.8) for time in (1 / 50, 1 / 100))
    ((_, found),) = scene.transitions([slow, fast])
    assert found.light[0] is found.light[1]
