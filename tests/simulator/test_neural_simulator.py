"""The simulator with networks: what it prepares, its stages, and which weights it takes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch

from simulator import CameraSettings, CameraSimulator, RawImage, camera_simulator, get_camera
from simulator.capture.aperture_blur import MapApertureBlur, NetworkApertureBlur
from simulator.networks.exposure_module import ExposureModule
from simulator.networks.weights import save_modules
from simulator.utils.tiles import in_tiles

Z6 = get_camera("nikon_z6")
SOURCE = CameraSettings(6400, 1 / 64, 8)
CLEANER = CameraSettings(100, 1, 8)
OPENER = CameraSettings(6400, 1 / 256, 4)


def raw(height: int = 18, width: int = 21) -> RawImage:
    data = np.random.default_rng(0).uniform(0.02, 0.5, (4, height, width)).astype(np.float32)
    return RawImage(torch.from_numpy(data), SOURCE, Z6)


def simulator(preset: Literal["compact", "paper"] = "compact") -> CameraSimulator:
    torch.manual_seed(0)
    made = CameraSimulator(preset, device="cpu")
    if preset == "compact":
        made.noise.network.tail.weight.mul_(3)
        made.aperture.network.tail.bias.fill_(1.2)  # about 3 px, well above the dead zone
    return made


@pytest.fixture(scope="module")
def compact() -> CameraSimulator:
    return simulator()


@pytest.fixture(scope="module")
def paper() -> CameraSimulator:
    return simulator("paper")


# Preparation


def test_preparing_denoises_once(compact: CameraSimulator, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    denoise = compact.denoise
    monkeypatch.setattr(compact, "denoise", lambda prepared: calls.append(1) or denoise(prepared))
    prepared = compact.prepare(raw())
    for settings in (CLEANER, SOURCE, OPENER):
        compact.simulate(prepared, settings)
    assert len(calls) == 1
    assert prepared.denoised is not None
    assert not torch.equal(prepared.denoised.light, prepared.light)


def test_a_source_without_noise_needs_no_network(compact: CameraSimulator) -> None:
    clean = replace(compact.prepare(raw()), nlf=Z6.nlf(100).zero(), denoised=None)
    assert compact.prepare(clean).denoised is None


def test_without_networks_nothing_is_denoised() -> None:
    plain = CameraSimulator(device="cpu")
    assert plain.prepare(raw()).denoised is None
    with pytest.raises(ValueError, match="there is no noise module"):
        plain.denoise(plain.prepare(raw()))
    with pytest.raises(ValueError, match="there is no aperture module"):
        plain.estimate_defocus(plain.prepare(raw()))
    with pytest.raises(ValueError, match=r"`depth` \(='unknown'\) needs an aperture module"):
        plain.prepare(raw(), depth="unknown")
    with pytest.raises(ValueError, match="there are no modules to run"):
        plain.stages(raw(), CLEANER)


def test_depth_must_be_known(compact: CameraSimulator) -> None:
    with pytest.raises(
        ValueError, match=r"`depth` \(='near'\) must be one of \['far', 'unknown'\]"
    ):
        compact.prepare(raw(), depth="near")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("preset", "kind"), [("compact", MapApertureBlur), ("paper", NetworkApertureBlur)]
)
def test_unknown_depth_prepares_an_opening(preset, kind, request) -> None:
    made = request.getfixturevalue(preset)
    assert made.prepare(raw()).aperture_blur is None
    prepared = made.prepare(raw(), depth="unknown")
    assert isinstance(prepared.aperture_blur, kind)
    assert prepared.aperture_blur.f_number == 8.0
    assert (
        made.prepare(prepared).aperture_blur is prepared.aperture_blur
    )  # simulate() prepares again
    assert made.simulate(prepared, OPENER).data.isfinite().all()


def test_frames_are_denoised_and_mapped_in_tiles(
    compact: CameraSimulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More than one tile gives what one gives, whatever the tile."""
    prepared = compact.prepare(raw(170, 131))
    defocus = compact.estimate_defocus(prepared)
    assert defocus.shape == (170, 131)

    small = partial(in_tiles, tile=64)

    monkeypatch.setattr(camera_simulator, "in_tiles", small)
    assert prepared.denoised is not None
    torch.testing.assert_close(
        compact.denoise(prepared), prepared.denoised.light, atol=1e-4, rtol=0
    )
    torch.testing.assert_close(compact.estimate_defocus(prepared), defocus, atol=1e-3, rtol=0)


def test_saturated_and_black_parts_need_no_network(
    compact: CameraSimulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was clipped stays as it is, all else is as with the whole frame through the networks."""
    data = raw(320, 400).data.clone()
    data[:, :192, :256], data[:, 256:, :] = 1.0, 0.0
    source = RawImage(data, SOURCE, Z6)
    everywhere, tolerant = (compact.prepare(source, tolerance=t) for t in (0.0, 0.1))
    seen = []
    forward = compact.noise.forward
    monkeypatch.setattr(
        compact.noise,
        "forward",
        lambda x, *noise: seen.append(x[0, 0].numel()) or forward(x, *noise),
    )
    expected, result = compact.denoise(everywhere), compact.denoise(tolerant)
    assert seen[0] == 320 * 400
    assert sum(seen[1:]) < 0.8 * seen[0]
    clipped = torch.zeros(320, 400, dtype=torch.bool)
    clipped[:192, :256] = clipped[256:] = True
    assert torch.equal(result[:, clipped], data[:, clipped])
    torch.testing.assert_close(result[:, ~clipped], expected[:, ~clipped], rtol=0, atol=1e-4)
    assert not torch.equal(expected[:, clipped], data[:, clipped])
    tolerant = replace(tolerant, denoised=everywhere.denoised)
    found = [compact.estimate_defocus(prepared) for prepared in (everywhere, tolerant)]
    assert float(found[1][:176, :240].max()) == 0.0  # no disc of 32 px reaches anything from here
    near = ~clipped
    torch.testing.assert_close(found[1][near], found[0][near], rtol=0, atol=1e-3)


def test_the_papers_aperture_has_no_map(paper: CameraSimulator) -> None:
    with pytest.raises(ValueError, match="must be 'compact' to have a defocus map"):
        paper.estimate_defocus(paper.prepare(raw()))


def test_bfloat16_is_close_to_float32(compact: CameraSimulator) -> None:
    half = CameraSimulator("compact", device="cpu", precision="bfloat16")
    half.noise, half.aperture = compact.noise, compact.aperture
    exact, rounded = (s.denoise(s.prepare(raw())) for s in (compact, half))
    assert rounded.dtype == torch.float32
    assert not torch.equal(exact, rounded)
    assert (exact - rounded).abs().mean() < 0.02 * (exact - raw().data).abs().mean()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"precision": "float16"}, r"`precision` \(='float16'\)"),
        ({"device": "tpu9"}, r"`device` \(='tpu9'\)"),
        ({"preset": "tiny"}, r"`preset` \(='tiny'\)"),
    ],
)
def test_bad_arguments(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CameraSimulator(**{"device": "cpu", **arguments})


# Stages


def test_stages_follow_one_another(compact: CameraSimulator) -> None:
    source, target = raw(), CameraSettings(100, 1 / 4, 4)
    stages = compact.stages(source, target, seed=5)
    assert torch.equal(stages.exposed, source.data)  # 1/64 of the ISO, 16 x the time, 4 x the area
    assert not torch.equal(stages.denoised, stages.exposed)
    assert not torch.equal(stages.opened, stages.denoised)
    # The output's noise: the target's around the last stage, whole digital numbers.
    numbers = stages.capture.double() * 14512 + 1008
    assert (numbers - numbers.round()).abs().max() < 1e-2
    nlf = Z6.nlf(100)
    read, shot = (torch.tensor(v)[:, None, None] for v in (nlf.read, nlf.shot))
    error = (stages.capture - stages.opened) / (read + shot * stages.opened.clamp(min=0)).sqrt()
    inside = (stages.opened < 0.95) & (stages.opened > 0)
    assert float(error[inside].std()) == pytest.approx(1.0, abs=0.1)
    assert torch.equal(stages.capture, compact.stages(source, target, seed=5).capture)
    assert not torch.equal(stages.capture, compact.stages(source, target, seed=6).capture)


def test_compact_stages_agree_with_the_prepared_prepared_scene(compact: CameraSimulator) -> None:
    """Denoise, expose = expose, denoise: one preparation serves every target."""
    source = raw()
    prepared = compact.prepare(source, depth="unknown")
    for target in (CLEANER, CameraSettings(100, 1 / 16, 8), CameraSettings(100, 1 / 4, 4)):
        stages = compact.stages(source, target)
        expected = prepared.expected(target)
        scale = float(expected.abs().max())
        torch.testing.assert_close(stages.opened, expected, rtol=0, atol=1e-4 * scale)


def test_only_the_paper_clips_after_the_exposure(
    compact: CameraSimulator, paper: CameraSimulator
) -> None:
    target = CameraSettings(6400, 1 / 8, 8)  # eight times the light
    assert compact.stages(raw(), target).exposed.max() > 2
    exposed = paper.stages(raw(), target).exposed
    assert float(exposed.max()) == 1.0
    torch.testing.assert_close(exposed, (raw().data * 8).clamp(0, 1))


@pytest.mark.parametrize("preset", ["compact", "paper"])
def test_a_smaller_aperture_leaves_the_picture_as_denoised(preset, request) -> None:
    stages = request.getfixturevalue(preset).stages(raw(), CameraSettings(6400, 1 / 64, 11))
    assert torch.equal(stages.opened, stages.denoised)


# The body's correction


def corrected() -> CameraSimulator:
    made = simulator()
    with torch.no_grad():
        made.exposure.w.fill_(1.25)
        made.exposure.b.fill_(0.01)
    return made


def test_the_correction_reaches_light_and_noise_once() -> None:
    made, source = corrected(), raw()
    prepared = made.prepare(source)
    torch.testing.assert_close(prepared.light, 1.25 * (source.data + 0.01))
    again = made.prepare(prepared)
    assert torch.equal(again.light, prepared.light)
    nlf = Z6.nlf(6400)
    assert prepared.nlf.shot == pytest.approx([1.25 * s for s in nlf.shot])
    assert prepared.nlf.read == pytest.approx([1.25**2 * r for r in nlf.read])
    frames = [made.simulate(s, CLEANER, seed=1).data for s in (source, prepared)]
    assert torch.equal(*frames)


def test_the_correction_in_the_stages() -> None:
    stages = corrected().stages(raw(), SOURCE)
    torch.testing.assert_close(stages.exposed, 1.25 * (raw().data + 0.01))


def test_pretrained_weights_and_their_correction(tmp_path: Path) -> None:
    made = corrected()
    parts = {"exposure": made.exposure, "noise": made.noise, "aperture": made.aperture}
    save_modules(tmp_path / "net", torch.nn.ModuleDict(parts), "compact", {})
    plain = CameraSimulator.from_pretrained(tmp_path / "net", device="cpu")
    assert plain.exposure.is_identity
    assert torch.equal(plain.prepare(raw()).light, raw().data)
    body = CameraSimulator.from_pretrained(tmp_path / "net", device="cpu", body_correction=True)
    assert isinstance(body.exposure, ExposureModule)
    for settings in (CLEANER, OPENER):
        expected = made.simulate(raw(), settings, seed=2, depth="unknown").data
        result = body.simulate(raw(), settings, seed=2, depth="unknown").data
        assert torch.equal(result, expected)


@pytest.mark.parametrize("depth", ["far", "unknown"])
def test_tolerance_nought_forgets_what_another_one_left_out(
    compact: CameraSimulator, depth: str
) -> None:
    """A saturated quarter needs no network at tolerance 0.1; the full run denoises it, too."""
    data = raw(96, 96).data.clone()
    data[:, :48, :48] = 1.0
    source = RawImage(data, SOURCE, Z6)
    prepared = compact.prepare(source, depth=depth)  # type: ignore[arg-type]
    prepared.capture(CLEANER)
    shared = compact.simulate(prepared, CLEANER, tolerance=0.0)
    full = compact.simulate(source, CLEANER, tolerance=None, depth=depth)
    torch.testing.assert_close(shared.data, full.data, rtol=0, atol=1.01 / 14512)
