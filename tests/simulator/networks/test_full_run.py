"""The full run of one transition, and that tolerance 0 gives the same light and frames."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from simulator import CameraSettings, CameraSimulator, NoiseLevelFunction, RawImage, get_camera
from simulator.optics.blur import disc_blur, motion_blur

Z6 = get_camera("nikon_z6")
SOURCE = CameraSettings(1600, 1 / 64, 8)
#: Cleaner, noisier, closing and opening; ratios that are no powers of two.
TARGETS = [
    CameraSettings(100, 1 / 3, 8),
    CameraSettings(6400, 1 / 50, 8),
    CameraSettings(100, 1 / 70, 11),
    CameraSettings(400, 1 / 60, 4),
    CameraSettings(100, 1 / 4000, 2.8),
    SOURCE,
]
SCENES = [
    {},
    {"depth": "unknown"},
    {"depth": "unknown", "image_speed": 0.6, "defocus": 1.7},
    {"image_speed": 2e-3, "defocus": 0.02},
]


def raw(noise: bool = True) -> RawImage:
    rng, nlf = np.random.default_rng(0), Z6.nlf(1600) if noise else NoiseLevelFunction.zero()
    light = 0.05 + 0.4 * rng.random((4, 26, 31))
    shot, read = (np.array(v)[:, None, None] for v in (nlf.shot, nlf.read))
    light += rng.normal(size=light.shape) * np.sqrt(read + shot * light)
    return RawImage(torch.from_numpy(light.astype(np.float32)), SOURCE, Z6, nlf=nlf)


@pytest.fixture(scope="module")
def compact() -> CameraSimulator:
    torch.manual_seed(0)
    made = CameraSimulator("compact", device="cpu")
    torch.nn.init.normal_(made.noise.network.tail.weight, std=0.02)
    made.aperture.network.tail.bias.fill_(1.2)  # about 3 px, well above the dead zone
    return made


@pytest.mark.parametrize("noise", [True, False])
@pytest.mark.parametrize("scene", SCENES)
def test_tolerance_nought_equals_the_full_run(
    compact: CameraSimulator, scene: dict, noise: bool
) -> None:
    source = raw(noise)
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


def test_every_module_runs_for_every_transition(
    compact: CameraSimulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the target is noisier and the source was prepared before."""
    calls = []
    for name in ("noise", "aperture"):
        module = getattr(compact, name)
        real = module.forward
        monkeypatch.setattr(module, "forward", lambda *a, n=name, f=real: calls.append(n) or f(*a))
    prepared = compact.prepare(raw(), depth="unknown")
    calls.clear()
    for source, scene in ((raw(), {"depth": "unknown"}), (prepared, {})):
        compact.simulate(source, CameraSettings(6400, 1 / 64, 8), tolerance=None, **scene)
    assert calls == ["noise", "aperture", "noise", "aperture"]
    calls.clear()
    compact.simulate(raw(), SOURCE, tolerance=None)
    assert calls == ["noise"]
    for ask in (compact.prepare, lambda *a, **k: compact.plan(*a, SOURCE, **k)):
        with pytest.raises(ValueError, match=r"`tolerance` \(=None\) .* ask `simulate`"):
            ask(raw(), tolerance=None)


def test_raws_prepared_scenes_and_scenes_run_alike(compact: CameraSimulator) -> None:
    source, target = raw(), TARGETS[3]
    prepared = compact.prepare(source, image_speed=0.5, defocus=2.0)
    scene = SimpleNamespace(prepared=replace(prepared, denoised_lights=()))
    given = {"image_speed": 0.5, "defocus": 2.0}
    frames = [
        compact.simulate(source, target, tolerance=None, **given).data,
        compact.simulate(prepared, target, tolerance=None).data,
        compact.simulate(scene, target, tolerance=None).data,
    ]
    assert torch.equal(frames[0], frames[1])
    assert torch.equal(frames[0], frames[2])


def test_known_motion_disc_and_gain(compact: CameraSimulator) -> None:
    target = CameraSettings(400, 1 / 8, 5.6)
    stages = compact.stages(raw(), target, image_speed=0.4, defocus=3.0)
    extents = 0.4 / 8 * 26, 3.0 * 4 / 2**2.5
    expected = motion_blur(disc_blur(stages.opened, extents[1]), extents[0])
    torch.testing.assert_close(stages.light, expected)
    still = compact.stages(raw(), target)
    torch.testing.assert_close(still.light, still.opened)
    prepared = replace(compact.prepare(raw()), gain=3.0)  # a part of the exposure
    assert torch.equal(compact.stages(prepared, SOURCE).exposed, prepared.light * 3.0)
    prepared = compact.prepare(prepared, tolerance=0)
    light = compact.stages(prepared, SOURCE, depth="far").light
    torch.testing.assert_close(prepared.expected(SOURCE), light, rtol=0, atol=1e-5)


@pytest.mark.parametrize("scene", [{}, {"image_speed": 0.4, "defocus": 2}])
@pytest.mark.parametrize("noise", [True, False])
def test_without_networks_the_full_run_is_exposure_and_noise(scene: dict, noise: bool) -> None:
    plain = CameraSimulator(device="cpu")
    for target in TARGETS:
        full, exact = (
            plain.simulate(raw(noise), target, seed=5, tolerance=t, **scene) for t in (None, 0)
        )
        assert torch.equal(full.data, exact.data)
        assert full.metadata == exact.metadata


def test_the_tolerance_of_a_prepared_scene_is_kept(compact: CameraSimulator) -> None:
    loose = compact.prepare(raw(), tolerance=100)
    assert [compact.prepare(s).tolerance for s in (loose, raw())] == [100.0, 0.1]
    frames = [compact.simulate(s, TARGETS[0], seed=1).data for s in (loose, raw())]
    assert not torch.equal(*frames)  # as noisy as it was, and denoised
    assert torch.equal(compact.simulate(loose, TARGETS[0], seed=1, tolerance=0.1).data, frames[1])
