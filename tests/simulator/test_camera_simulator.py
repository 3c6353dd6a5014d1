"""The simulator: sources, seeds, limits; with networks, what it prepares, and its stages."""

import copy
import functools
import itertools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from simulator import CameraSettings, CameraSimulator, RawImage, exposure_ratio, get_camera
from simulator.camera import CameraProfile
from simulator.capture.blurred_light import MapApertureBlur, NetworkApertureBlur
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.statistics import Residual
from simulator.networks.exposure_module import ExposureModule
from simulator.networks.weights import save_modules
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.optics.discs import added_blur
from simulator.reference.reference_camera import ReferenceCamera, lens_blur, sample_mosaic
from simulator.training.scenes import detail_pictures, reference_scenes
from tests.strategies import SEEDS, cameras, mosaics, prepared, settings_within

Z6 = get_camera("nikon_z6")
BASE = CameraSettings(100, 1 / 64, 4)
TARGET = CameraSettings(400, 1 / 64, 5.6)
ZERO = NoiseLevelFunction.zero()


@pytest.fixture
def simulator() -> CameraSimulator:
    assert CameraSimulator().device.type == ("cuda" if torch.cuda.is_available() else "cpu")
    return CameraSimulator(device="cpu")


def picture(height: int = 16, width: int = 20, scale: float = 1.0, seed: int = 0) -> torch.Tensor:
    values = np.random.default_rng(seed).random((4, height, width), dtype=np.float32)
    return torch.from_numpy(values) * scale


@pytest.mark.parametrize("scene", [{}, {"image_speed": 0.5, "defocus": 1.5}])
def test_simulating_is_preparing_and_capturing(simulator: CameraSimulator, scene: dict) -> None:
    raw = RawImage(picture(), BASE, Z6)
    state = torch.random.get_rng_state()
    frame = simulator.simulate(raw, TARGET, seed=11, **scene).data
    assert torch.equal(simulator.prepare(raw, **scene).capture(TARGET, 11)[0], frame)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert not torch.equal(simulator.simulate(raw, TARGET, seed=12, **scene).data, frame)


def test_simulate_keeps_what_is_known(simulator: CameraSimulator) -> None:
    data = picture(10, 10, 0.5)
    data[2, :3, 1:] = 1.0
    known = {"white_balance": (2.0, 1.0, 1.5), "box_factor": 3}
    raw = RawImage(data, BASE, Z6, **known, metadata={"path": "a.nef"})
    prepared = simulator.prepare(raw)
    assert torch.equal(prepared.light, data)
    assert prepared.saturated.nonzero().tolist() == [[r, c] for r in range(3) for c in range(1, 10)]
    assert prepared.nlf == raw.noise
    out = simulator.simulate(raw, TARGET, seed=3)
    assert (out.settings, out.camera) == (TARGET, Z6)
    for made in (prepared, out):
        assert {name: getattr(made, name) for name in known} == known
    assert out.noise.shot[1] == pytest.approx(3.09620813305867e-05 / 9)
    origin = {"path": "a.nef", "simulated_from": "ISO 100, 1/64 s, f/4", "seed": 3}
    assert out.metadata == {**origin, "excess_noise": 0.0, "clipped_source": 0.27}
    assert simulator.plan(raw, TARGET).clipped_source == 0.27
    assert raw.metadata == {"path": "a.nef"}


def test_prepared_scenes_and_scenes_stay_what_they_are(simulator: CameraSimulator) -> None:
    prepared = PreparedScene(picture(), BASE, Z6, ZERO, image_speed=0.5, defocus=2.0, tolerance=0.0)
    for source in (prepared, SimpleNamespace(prepared=prepared)):
        found = simulator.prepare(source)
        assert found.blurred_light is prepared.blurred_light
        assert (found.image_speed, found.defocus, found.tolerance) == (0.5, 2.0, 0.0)
        still = simulator.prepare(source, image_speed=0.0)
        assert (still.image_speed, still.defocus) == (0.0, 2.0)
        assert simulator.prepare(source, defocus=1.0).image_speed == 0.5


def test_an_uncalibrated_camera_uses_the_raws_own_noise(simulator: CameraSimulator) -> None:
    unknown = CameraProfile("unknown", "RGGB", 64.0, 1023, 10)
    own = NoiseLevelFunction((1e-4,) * 4, (1e-6,) * 4)
    raw = RawImage(picture(), BASE, unknown, nlf=own)
    out = simulator.simulate(raw, CameraSettings(200, 1 / 64, 4))
    assert out.noise.shot == pytest.approx((2e-4,) * 4)
    assert out.noise.read == pytest.approx((4e-6,) * 4)
    assert simulator.plan(raw, CameraSettings(200, 1 / 64, 4)).extrapolated
    with pytest.raises(ValueError, match="no noise calibration"):
        simulator.simulate(RawImage(picture(), BASE, unknown), BASE)


def test_bad_input_is_named(simulator: CameraSimulator) -> None:
    raw, wide = RawImage(picture(), BASE, Z6), CameraSettings(100, 1, 1)
    prepared, depths = simulator.prepare(raw), ("near", "unknown")  # the latter needs networks
    bad = [("image_speed", True), ("defocus", math.nan), ("tolerance", None)]
    calls = [(f"`{k}`", simulator.prepare, (raw,), {k: v}) for k, v in bad]
    calls += [("`depth`", simulator.prepare, (raw,), {"depth": depth}) for depth in depths]
    calls += [("`tolerance`", simulator.plan, (raw, BASE), {"tolerance": None})]
    calls += [("`source`", simulator.simulate, (raw.data, BASE), {})]
    calls += [("`seed`", simulator.simulate, (raw, BASE), {"seed": -1})]
    calls += [("`settings`", simulator.simulate, (raw, 3), {})]
    # A disc may be as wide as the frame.
    calls += [("`defocus`", simulator.simulate, (raw, wide), {"defocus": 200.0})]
    calls += [("no noise module", simulator.denoise, (prepared,), {})]
    calls += [("no aperture module", simulator.estimate_defocus, (prepared,), {})]
    calls += [("no noise module", simulator.stages, (raw, BASE), {})]
    wrong = [("device", "tpu9"), ("precision", "float16"), ("preset", "tiny")]
    calls += [(f"`{k}`", CameraSimulator, (), {"device": "cpu", k: v}) for k, v in wrong]
    for message, call, arguments, options in calls:
        with pytest.raises(ValueError, match=message):
            call(*arguments, **options)


def test_a_noisy_source_is_stated_in_the_result(simulator: CameraSimulator) -> None:
    """ISO 6400 exposed at ISO 100: what remains is the source's noise, and the raw must say so."""
    raw = RawImage(torch.full((4, 8, 8), 0.5), CameraSettings(6400, 1 / 64, 4), Z6)
    stated, (noisy, clean) = simulator.simulate(raw, BASE).noise, map(Z6.nlf, (6400, 100))
    assert stated.shot == pytest.approx(np.maximum(np.array(noisy.shot) / 64, clean.shot))
    assert stated.read == pytest.approx(np.maximum(np.array(noisy.read) / 64**2, clean.read))


SOURCE = CameraSettings(6400, 1 / 64, 8)
CLEANER = CameraSettings(100, 1, 8)
OPENER = CameraSettings(6400, 1 / 256, 4)


def noisy_raw(height: int = 18, width: int = 21) -> RawImage:
    data = np.random.default_rng(0).uniform(0.02, 0.5, (4, height, width)).astype(np.float32)
    return RawImage(torch.from_numpy(data), SOURCE, Z6)


def with_networks(preset="compact"):
    torch.manual_seed(0)
    made = CameraSimulator(preset, device="cpu")
    if preset == "compact":
        torch.nn.init.normal_(made.noise.network.tail.weight, std=0.02)
        made.aperture.network.tail.bias.fill_(1.2)  # about 3 px, well above the dead zone
    return made


@pytest.fixture(scope="module")
def compact() -> CameraSimulator:
    return with_networks()


@pytest.fixture(scope="module")
def paper() -> CameraSimulator:
    return with_networks("paper")


@pytest.mark.parametrize("preset", ["compact", "paper"])
def test_preparing_runs_each_network_once(preset, request, monkeypatch):
    made, calls = request.getfixturevalue(preset), []
    for name in ("denoise", "estimate_defocus"):
        real = getattr(made, name)
        monkeypatch.setattr(made, name, lambda *p, n=name, r=real: calls.append(n) or r(*p))
    assert made.prepare(noisy_raw()).aperture_blur is None
    prepared = made.prepare(noisy_raw(), depth="unknown")
    kind = MapApertureBlur if preset == "compact" else NetworkApertureBlur
    assert isinstance(prepared.aperture_blur, kind)
    assert prepared.aperture_blur.f_number == 8.0
    assert made.prepare(prepared).aperture_blur is prepared.aperture_blur  # as `simulate` does
    assert not calls
    for settings in (CLEANER, SOURCE, OPENER, CLEANER):
        assert made.simulate(prepared, settings).data.isfinite().all()
    assert calls == ["denoise", "estimate_defocus"][: 2 if preset == "compact" else 1]
    (denoised,) = prepared.denoised_lights
    assert (denoised.name, denoised.operations) == (preset, 18 * 21 * made.noise.operations)
    assert denoised.seconds() > 0
    assert not torch.equal(denoised.light, prepared.light)
    if preset == "paper":
        with pytest.raises(ValueError, match="must be 'compact' to have a defocus map"):
            made.estimate_defocus(prepared)


def test_saturated_and_black_parts_need_no_network(compact, monkeypatch):
    """Clipped parts stay; the rest is as with the whole frame denoised, but for its wide mean."""
    data = noisy_raw(360, 640).data.clone()
    data[:, :320, :560], data[:, 336:, :] = 1.0, 0.0
    source = RawImage(data, SOURCE, Z6)
    everywhere, tolerant = (compact.prepare(source, tolerance=t) for t in (0.0, 0.1))
    network, real, seen = compact.noise.network, compact.noise.network.uncorrected, []

    def counted(image: torch.Tensor, *rest: torch.Tensor) -> torch.Tensor:
        seen.append(image[0, 0].numel())
        return real(image, *rest)

    monkeypatch.setattr(network, "uncorrected", counted)
    expected, result = compact.denoise(everywhere), compact.denoise(tolerant)
    assert seen[0] == 360 * 640
    assert sum(seen[1:]) < 0.9 * seen[0]
    clipped, light = torch.zeros(360, 640, dtype=torch.bool), tolerant.light
    clipped[:288, :528] = clipped[336:] = True  # less the rim, whose estimate falls towards white
    torch.testing.assert_close(result[:, clipped], 1.8 * data[:, clipped])  # lamp, or black
    off, change = ((a - expected)[:, ~clipped].std() for a in (result, light))
    assert 0 < float(off) < 0.25 * float(change)
    assert not torch.equal(expected[:, clipped], data[:, clipped])
    tolerant = replace(tolerant, denoised_lights=everywhere.denoised_lights)
    found = [compact.estimate_defocus(prepared) for prepared in (everywhere, tolerant)]
    assert float(found[1][:272, :512].max()) == 0.0  # no disc of 32 px reaches anything from here
    torch.testing.assert_close(found[1][~clipped], found[0][~clipped], rtol=0, atol=1e-3)


def test_bfloat16_is_close_to_float32(compact: CameraSimulator) -> None:
    half = CameraSimulator("compact", device="cpu", precision="bfloat16")
    half.noises, raw = compact.noises, noisy_raw()
    for tolerance, error in ((0.1, 0.012), (0.01, 0.0)):  # 0.012 of its own noise is more than 0.01
        plans = [s.plan(raw, SOURCE, noise=False, tolerance=tolerance) for s in (compact, half)]
        exact, rounded = (plan.denoised.light for plan in plans)
        assert torch.equal(exact, rounded) is (error == 0.0)
        assert (exact - rounded).abs().mean() < 0.02 * (exact - raw.data).abs().mean()
        assert plans[1].errors["rounding"] == pytest.approx(error, rel=0.01, abs=1e-3)


def test_tolerance_picks_the_network(compact: CameraSimulator) -> None:
    """On a flat field, where the noise would be an error of 7, networks err by 0.5 and 0.2."""
    made, source = CameraSimulator("nano", device="cpu"), torch.full((4, 16, 16), 0.2)
    torch.nn.init.normal_(made.noise.network.tail.weight)
    compact_alone = CameraSimulator(device="cpu")
    compact_alone.noises = (copy.deepcopy(compact.noise),)
    made.noises += compact_alone.noises
    raw = RawImage(source, SOURCE, Z6)
    ratio = exposure_ratio(SOURCE, CLEANER)
    variances = [np.array(n.read) + np.array(n.shot) * 0.2 for n in map(Z6.nlf, (6400, 100))]
    unit = math.sqrt((variances[0] * ratio**2 / variances[1]).mean())  # of the source's noise
    for noise, error in zip(made.noises, (0.5, 0.2), strict=True):
        tables = np.array([0.0, 1.0]), np.full(2, (error / unit) ** 2), np.zeros(2)
        noise.residual = Residual(*tables, 1.0)
    for tolerance, name in ((0.0, "compact"), (0.3, "compact"), (0.6, "nano"), (20.0, None)):
        plan = made.plan(raw, CLEANER, tolerance=tolerance)
        assert plan.network == name
        error = {"nano": 0.5, "compact": 0.2, None: 0.0}[name]
        assert plan.errors["network"] == pytest.approx(error, rel=1e-4)
        frame = made.simulate(raw, CLEANER, tolerance=tolerance).data
        alone = compact_alone.simulate(raw, CLEANER, tolerance=0.0).data
        assert torch.equal(frame, alone) is (tolerance == 0.0)


def test_only_the_paper_clips_after_the_exposure(compact, paper):
    target = CameraSettings(6400, 1 / 8, 8)  # eight times the light
    assert compact.stages(noisy_raw(), target).exposed.max() > 2
    exposed = paper.stages(noisy_raw(), target).exposed
    assert float(exposed.max()) == 1.0
    torch.testing.assert_close(exposed, (noisy_raw().data * 8).clamp(0, 1))


@pytest.fixture(scope="module")
def corrected() -> CameraSimulator:
    made = with_networks()
    made.exposure.w.fill_(1.25)
    made.exposure.b.fill_(0.01)
    return made


def test_the_correction_reaches_light_and_noise_once(corrected: CameraSimulator) -> None:
    source, wanted = noisy_raw(), 1.25 * (noisy_raw().data + 0.01)
    prepared = corrected.prepare(source)
    torch.testing.assert_close(prepared.light, wanted)
    torch.testing.assert_close(corrected.stages(source, SOURCE).exposed, wanted)
    assert torch.equal(corrected.prepare(prepared).light, prepared.light)
    nlf = Z6.nlf(6400)
    assert prepared.nlf.shot == pytest.approx([1.25 * s for s in nlf.shot])
    assert prepared.nlf.read == pytest.approx([1.25**2 * r for r in nlf.read])
    frames = [corrected.simulate(s, CLEANER, seed=1).data for s in (source, prepared)]
    assert torch.equal(*frames)


def test_pretrained_weights_and_their_correction(corrected, tmp_path):
    made = corrected
    parts = {"exposure": made.exposure, "noise": made.noise, "aperture": made.aperture}
    save_modules(tmp_path / "net", torch.nn.ModuleDict(parts), "compact", {})
    plain = CameraSimulator.from_pretrained(tmp_path / "net", device="cpu")
    assert plain.exposure.is_identity
    assert torch.equal(plain.prepare(noisy_raw()).light, noisy_raw().data)
    body = CameraSimulator.from_pretrained(tmp_path / "net", device="cpu", body_correction=True)
    assert isinstance(body.exposure, ExposureModule)
    for settings in (CLEANER, OPENER):
        expected = made.simulate(noisy_raw(), settings, seed=2, depth="unknown").data
        result = body.simulate(noisy_raw(), settings, seed=2, depth="unknown").data
        assert torch.equal(result, expected)


@pytest.mark.parametrize("depth", ["far", "unknown"])
def test_tolerance_nought_forgets_what_another_one_left_out(compact, depth):
    """A saturated quarter needs no network at tolerance 0.1; the full run denoises it, too."""
    data = noisy_raw(96, 96).data.clone()
    data[:, :48, :48] = 1.0
    source = RawImage(data, SOURCE, Z6)
    prepared = compact.prepare(source, depth=depth)
    prepared.capture(CLEANER)
    shared = compact.simulate(prepared, CLEANER, tolerance=0.0)
    full = compact.simulate(source, CLEANER, tolerance=None, depth=depth)
    torch.testing.assert_close(shared.data, full.data, rtol=0, atol=1.01 / 14512)
    with pytest.raises(ValueError, match="`noise`"):
        compact.simulate(source, CLEANER, tolerance=None, noise="bank")
    with pytest.raises(TypeError, match="defocs"):
        compact.simulate(source, CLEANER, tolerance=None, defocs=5)


@given(mosaics(cameras()), settings_within(), SEEDS, st.sampled_from(["exact", "bank"]))
def test_simulating_the_own_settings_changes_nothing(mosaic, settings, seed, noise):
    """A raw has its noise already: numbers come back, a saturated one (a bound) maybe as white;
    noise-free light comes back as it is."""
    camera, numbers = mosaic
    raw = RawImage.from_mosaic(numbers, settings, camera)
    again = CameraSimulator(device="cpu").simulate(raw, settings, seed=seed, noise=noise)
    kept, back = ~raw.saturated, RawImage.from_mosaic(again.to_mosaic(), settings, camera)
    assert torch.equal(back.data[:, kept], raw.data[:, kept])
    assert (back.data >= raw.data).all()
    assert torch.equal(prepared(raw.data, settings, camera).expected(settings), raw.data)


# -- the full run of one transition, and that tolerance 0 gives the same light and frames ----------

#: Cleaner, noisier, closing and opening; ratios that are no powers of two.
TARGETS = [(400, 1 / 3, 8), (25600, 1 / 50, 8), (400, 1 / 70, 11), (1600, 1 / 60, 4)]
TARGETS = [CameraSettings(*values) for values in (*TARGETS, (400, 1 / 4000, 2.8))] + [SOURCE]
SCENES = [{}, {"depth": "unknown"}, {"image_speed": 2e-3, "defocus": 0.02}]
SCENES += [{"depth": "unknown", "image_speed": 0.6, "defocus": 1.7}]


@pytest.mark.parametrize("noise", [True, False])
@pytest.mark.parametrize("scene", SCENES)
def test_tolerance_nought_equals_the_full_run(compact, scene, noise):
    source = replace(noisy_raw(26, 31), nlf=None if noise else ZERO)
    prepared = compact.prepare(source, tolerance=0, **scene)
    for target in TARGETS:
        stages = compact.stages(source, target, seed=3, **{"depth": "far", **scene})
        expected = prepared.expected(target)
        scale = float(stages.light.abs().max())
        torch.testing.assert_close(expected, stages.light, rtol=0, atol=3e-6 * scale)
        full = compact.simulate(source, target, seed=3, tolerance=None, **scene)
        assert torch.equal(full.data, stages.capture)
        frame = compact.simulate(source, target, seed=3, tolerance=0, **scene)
        assert frame.noise == full.noise
        assert frame.metadata == full.metadata
        if noise and "noise_reduction" not in prepared.plan(target).modules:
            continue  # noise that is topped up has the same distribution, but is another draw
        numbers = [(f.data.double() * 14512).round() for f in (full, frame)]
        difference = (numbers[0] - numbers[1]).abs()
        assert difference.max() <= 1
        assert difference.mean() < 2e-2  # a number that is nearly halfway


def test_the_full_run_has_the_pattern_of_the_sensor_once(compact: CameraSimulator) -> None:
    """Gains that differ by 2 %: those of the capture, unless the source's are in its light."""
    body = replace(get_camera("nikon_z6"), prnu=0.02, nlf_by_iso={100.0: ZERO}, segments=())
    settings, light = CameraSettings(100, 1 / 60, 4), torch.full((4, 64, 64), 0.5)
    for nlf, spread in ((ZERO, 0.02), (NoiseLevelFunction((1e-6,) * 4, (1e-8,) * 4), 0.0)):
        source = PreparedScene(light, settings, body, nlf)
        frame = compact.stages(source, settings, depth="far").capture
        assert float(frame.std() / frame.mean()) == pytest.approx(
            spread, rel=0.03, abs=4e-3
        )  # of the network


def test_the_gain_of_a_prepared_scene_is_a_part_of_the_exposure(compact: CameraSimulator) -> None:
    prepared = replace(compact.prepare(noisy_raw()), gain=3.0)
    assert torch.equal(compact.stages(prepared, SOURCE).exposed, prepared.light * 3.0)
    prepared = compact.prepare(prepared, tolerance=0)
    light = compact.stages(prepared, SOURCE, depth="far").light
    torch.testing.assert_close(prepared.expected(SOURCE), light, rtol=0, atol=1e-5)


# -- the weights that come with the package do what their card and the documentation say ---------


@pytest.fixture(scope="module")
def pretrained() -> CameraSimulator:
    return CameraSimulator.from_pretrained("large", device="cpu")


@functools.cache
def held_out() -> dict[str, torch.Tensor]:
    """(3, 4, 96, 96) light of a mean of 1 of each kind, sampled through the mosaic."""
    drawn: dict[str, list[torch.Tensor]] = {}
    for picture in detail_pictures("test", data=None, drawn=3):
        light = sample_mosaic(lens_blur(picture.light[:, :192, :192]))
        drawn.setdefault(picture.kind, []).append(light / light.mean())
    return {kind: torch.stack(lights) for kind, lights in drawn.items()}


def denoised(pretrained, size, light, iso, camera):
    """Light with noise drawn by NumPy, before and after a network."""
    rng, nlf = np.random.default_rng(0), get_camera(camera).nlf(iso)
    shot, read = (np.array(v)[:, None, None] for v in (nlf.shot, nlf.read))
    drawn = rng.poisson(light.numpy() / shot) * shot + rng.normal(size=light.shape) * np.sqrt(read)
    noisy = torch.from_numpy(drawn.clip(max=1)).float()
    noise = (torch.tensor([v]).expand(len(light), 4) for v in (nlf.shot, nlf.read))
    return noisy, pretrained.noises[size](noisy, *noise)


def gains_db(pretrained, size, light, iso, camera):
    """Error before over that after denoising, of each picture."""
    errors = (x - light.clamp(max=1.0) for x in denoised(pretrained, size, light, iso, camera))
    before, after = (e.square().mean(dim=(1, 2, 3)) for e in errors)
    return 10.0 * torch.log10(before / after)


@pytest.mark.parametrize("camera", ["nikon_z6", "canon_70d"])
def test_denoising_of_detail(pretrained: CameraSimulator, camera: str) -> None:
    """Dead leaves in dim light at ISO 6400; the mean gain over detail of the trial was 6 dB."""
    light = 2.0**-6 * held_out()["leaves"]
    gains = [float(gains_db(pretrained, s, light, 6400, camera).mean()) for s in range(3)]
    assert gains[1] > 3.0
    assert gains[0] > 1.0
    assert gains[2] > gains[1] > gains[0]


@pytest.mark.parametrize("size", range(3), ids=["nano", "compact", "large"])
def test_no_network_does_harm(pretrained: CameraSimulator, size: int) -> None:
    """Each condition on one picture of each kind, in turn."""
    isos, levels = (400, 6400, 16000), (2.0**-6, 2.0**-3, 0.5)
    for (i, iso), (j, level) in itertools.product(enumerate(isos), enumerate(levels)):
        light = torch.stack([lights[(i + j) % 3] for lights in held_out().values()])
        gains = gains_db(pretrained, size, level * light, iso, "canon_70d")
        assert float(gains.min()) > -0.1, (iso, level)


@pytest.mark.parametrize("size", range(3), ids=["nano", "compact", "large"])
def test_a_flat_field_keeps_its_mean(pretrained: CameraSimulator, size: int) -> None:
    """To 0.2 %, at every ISO that was calibrated; greens that differ by 3 % stay apart."""
    tint = torch.tensor([0.5, 1.0, 1.03, 0.7])[None, :, None, None].expand(1, 4, 96, 96)
    for iso, level in zip(Z6.nlf_by_iso, itertools.cycle((0.02, 0.2)), strict=False):
        frames = denoised(pretrained, size, level * tint, iso, "nikon_z6")
        before, after = (frame.double().mean(dim=(0, 2, 3)) for frame in frames)
        assert float((after / before - 1).abs().max()) < 0.002, (iso, level)


def test_opening_blurs_what_is_out_of_focus_and_only_that(pretrained: CameraSimulator) -> None:
    """Half of the error of exposing alone where the circle of confusion is 3 pixels or more."""
    body = ReferenceCamera(Z6)
    scenes = [s for s in reference_scenes("test", Z6, number=10, size=96) if s.kind == "depth"]
    before = after = 0.0
    for scene in scenes:
        # An incident-light meter says log2(N^2 / t) - log2(ISO / 100) = log2(E / 2.5).
        time = 2.0 ** -CameraSettings(100, 1.0, 11).log2_exposure * 2.5 / scene.illuminance
        source, target = CameraSettings(100, time, 11), CameraSettings(100, time / 8, 4)
        raw = RawImage(body.capture(scene, source, seed=1).sample, source, Z6)
        truth = body.capture(scene, target, seed=2).mean
        used = (body.blur_diameter(scene, 11) >= 3.0) & (truth < 0.5).all(0)
        used &= (raw.data < 0.5).all(0)
        used[:11] = used[-11:] = used[:, :11] = used[:, -11:] = False
        if used.any():
            opened = pretrained.prepare(raw, depth="unknown").expected(target)
            before += float((raw.data - truth)[:, used].square().sum())
            after += float((opened - truth)[:, used].square().sum())
    assert math.sqrt(after / before) < 0.5


def test_a_sharp_picture_stays_sharp(pretrained: CameraSimulator) -> None:
    """White noise of contrast 20 % has all of its detail at one pixel: nothing is defocused."""
    generator = torch.Generator().manual_seed(0)
    data = 0.2 + 0.04 * torch.randn(4, 64, 64, generator=generator)
    raw = RawImage(data, CameraSettings(100, 1 / 64, 11), Z6)
    prepared = pretrained.prepare(raw, depth="unknown")
    diameter = pretrained.estimate_defocus(prepared)
    assert float(added_blur(diameter, 11.0, 4.0).median()) == 0.0
