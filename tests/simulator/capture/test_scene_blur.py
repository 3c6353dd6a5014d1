"""Scenes with a layout in motion: captures against sums by hand, their noise, and batches."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate

from simulator import CameraSettings, NoiseLevelFunction, PreparedScene, get_camera
from simulator.capture.batch import CaptureBatch
from simulator.capture.layout import Layout
from simulator.capture.scene_blur import remaining_noise, scene_light
from simulator.optics.blur import disc_blur
from simulator.optics.disc_bank import DIAMETERS
from simulator.optics.motion_path import Movement, path_blur, path_taps

Z6 = get_camera("nikon_z6")
REFERENCE = CameraSettings(800, 1 / 64, 4)
SIZE = 32
LIGHT = torch.rand(4, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
MOVEMENT = Movement(0.6, 2.0, subject_speed=0.4, subject_direction=2.0)
SLOW = CameraSettings(100, 1 / 2, 8)


def _layout() -> Layout:
    """Halves in and out of focus, and a subject across them."""
    defocus = torch.zeros(SIZE, SIZE)
    defocus[:, SIZE // 2 :] = 1.0
    subject = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    subject[10:20, 12:24] = True
    return Layout(defocus, subject)


def _prepared(noisy: bool = False, **fields: Any) -> PreparedScene:
    nlf = Z6.nlf(800) if noisy else NoiseLevelFunction.zero()
    given = {"layout": _layout(), "movement": MOVEMENT, "tolerance": 0.0, **fields}
    return PreparedScene(LIGHT, REFERENCE, Z6, nlf, **given)


def test_only_what_is_out_of_focus_is_blurred() -> None:
    """A disc of the bank's at f/8, which is no blend of two."""
    light = _prepared(defocus=2.0 * DIAMETERS[6], movement=Movement()).expected(SLOW)
    ratio = _prepared().exposure(SLOW).ratio
    torch.testing.assert_close(light[..., :16], LIGHT[..., :16] * ratio)
    wanted = disc_blur(LIGHT.double(), DIAMETERS[6])[..., 16:].float() * ratio
    torch.testing.assert_close(light[..., 16:], wanted, rtol=1e-4, atol=1e-5 * ratio)


def test_without_a_subject_the_frame_moves_as_a_whole() -> None:
    whole = Layout(torch.zeros(SIZE, SIZE))
    exposure = _prepared(layout=whole, image_speed=0.3).exposure(SLOW)
    path = MOVEMENT.path(0.3, 0.5, SIZE)
    assert (exposure.path, exposure.subject_path, exposure.layout) == (path, None, None)
    assert exposure.motion_px == pytest.approx(0.3 * 0.5 * SIZE)
    found = _prepared(layout=None, image_speed=0.3).expected(SLOW)
    wanted = path_blur(LIGHT, path_taps(path, SIZE, SIZE)) * exposure.ratio
    torch.testing.assert_close(found, wanted)


def test_the_largest_extent_decides() -> None:
    """On a tripod only the subject moves: 0.4 frame heights a second."""
    still = _prepared(movement=replace(MOVEMENT, turn=0.0))
    assert still.exposure(SLOW).motion_px == pytest.approx(0.4 * 0.5 * SIZE)
    assert not still.exposure(SLOW).is_uniform
    light = still.expected(SLOW) / still.exposure(SLOW).ratio
    assert torch.equal(light[:, :, :4], LIGHT[:, :, :4])  # far from it all stays as it is
    assert not torch.allclose(light[:, 12:18, 14:22], LIGHT[:, 12:18, 14:22], atol=0.05)


def test_a_movement_along_the_rows_changes_nothing() -> None:
    plain = PreparedScene(LIGHT, REFERENCE, Z6, NoiseLevelFunction.zero(), image_speed=0.3)
    same = _prepared(layout=None, movement=Movement(subject_speed=2.0), image_speed=0.3)
    assert torch.equal(plain.expected(SLOW), same.expected(SLOW))
    assert same.exposure(SLOW).is_uniform


def test_layouts_must_fit() -> None:
    with pytest.raises(ValueError, match="`layout`"):
        _prepared(layout=Layout(torch.zeros(8, 8)))


@pytest.mark.parametrize("defocus", [0.0, 5.0])
@pytest.mark.parametrize("speed", [0.0, 0.5])
@pytest.mark.parametrize("movement", [MOVEMENT, Movement(0.6, 2.0), Movement()])
def test_noise_that_blur_leaves(defocus: float, speed: float, movement: Movement) -> None:
    """The variance of blurred white noise, over many draws."""
    scene = _prepared(noisy=True, defocus=defocus, image_speed=speed, movement=movement)
    exposure = scene.exposure(SLOW)
    if exposure.is_uniform:
        assert exposure.remaining_variance is None
        return
    energy, left = remaining_noise(exposure, SIZE, SIZE)
    share = torch.full((SIZE, SIZE), energy) if left is None else left * energy
    draws = torch.randn(600, SIZE, SIZE, generator=torch.Generator().manual_seed(3))
    blurred = []
    for planes in draws.reshape(-1, 4, SIZE, SIZE):
        made = PreparedScene(planes, REFERENCE, Z6, NoiseLevelFunction.zero(), tolerance=0.0)
        same = replace(made, defocus=defocus, image_speed=speed, movement=movement)
        same = replace(same, layout=scene.layout)
        blurred.append(same.blurred_light.blurred(exposure))
    measured = torch.cat(blurred).double().square().mean(dim=0)
    ratio = (measured / share)[6:-6, 6:-6]  # replicated borders average less
    assert float(ratio.min()) > 0.75
    if exposure.subject_path is not None:
        # What continues behind the subject repeats pixels, and their noise with them.
        assert float(ratio.mean()) < 1.25
        ratio = ratio[:, :4]
    assert float(ratio.median()) == pytest.approx(1.0, abs=0.06)  # of the draws
    assert float(ratio.quantile(0.95)) < 1.2


@pytest.mark.parametrize("movement", [MOVEMENT, Movement(0.6), Movement()])
def test_light_without_a_cache_is_the_same(movement: Movement) -> None:
    scene = _prepared(defocus=3.0, image_speed=0.2, movement=movement)
    assert torch.equal(scene_light(LIGHT, scene.exposure(SLOW)), scene.expected(SLOW))


@pytest.mark.parametrize("cache_light", [True, False])
@pytest.mark.parametrize("noisy", [True, False])
def test_batches_have_the_light_of_sweeps(cache_light: bool, noisy: bool) -> None:
    scenes = [
        _prepared(noisy, defocus=3.0, image_speed=0.2),
        _prepared(noisy, defocus=3.0, movement=Movement(subject_speed=0.5)),
        _prepared(noisy, image_speed=0.2, layout=None),
        _prepared(noisy, defocus=4.0, image_speed=0.2, layout=None),
        _prepared(noisy, defocus=3.0, image_speed=0.2, movement=Movement()),
        _prepared(noisy),
        _prepared(noisy, defocus=3.0, tolerance=0.1),
    ]
    states = [CameraSettings(iso, t, n) for iso in (100, 6400) for t in (0.5, 1e-3) for n in (4, 8)]
    batch = CaptureBatch(
        scenes.__getitem__, len(scenes), states, Z6, noise="bank", cache_light=cache_light
    )
    indices, rng = np.arange(len(scenes)), np.random.default_rng(0)
    for step in range(8):
        if step % 2 == 0:
            chosen = rng.integers(len(states), size=len(scenes))
        gain = (1.0, 1e-6)[step % 2]  # in little light, blur is left out where it may be
        frames = np.empty((len(scenes), 4, SIZE, SIZE), np.float32)
        batch.prepare(indices, chosen, np.full(len(scenes), gain))
        found = batch.record(indices, chosen, indices, indices, signals=frames)
        assert np.isfinite(found.excess_variance).all()
        for i, scene in enumerate(scenes):
            exposure, row = (
                scene.exposure(states[chosen[i]], gain=gain),
                i * len(states) + chosen[i],
            )
            light = scene.blurred_light.blurred(exposure)
            assert torch.equal(batch._rows.light[row], light)
            left, expected = batch._rows.remaining_variance[row], exposure.remaining_variance
            assert (left is None) == (expected is None)
            assert expected is None or torch.equal(left, expected.float())


def test_whole_captures_by_hand() -> None:
    """Defocus, then the background along its path, then the subject along its own, by SciPy."""
    layout = _layout()
    scene = _prepared(defocus=2.0 * DIAMETERS[5], image_speed=0.3)
    sharp = LIGHT.double().numpy()
    soft = disc_blur(LIGHT.double(), DIAMETERS[5]).numpy()
    light = np.where(layout.defocus.numpy() > 0.0, soft, sharp)

    def kernel(path: Any) -> np.ndarray:
        taps, reach = path_taps(path, SIZE, SIZE), 16
        dense = np.zeros((2 * reach + 1, 2 * reach + 1))
        np.add.at(dense, (taps.rows + reach, taps.columns + reach), taps.weights)
        return dense

    shake = kernel(MOVEMENT.path(0.3, 0.5, SIZE))
    own = kernel(MOVEMENT.subject_path(0.3, 0.5, SIZE))
    mask, behind = layout.subject.numpy(), layout.behind.numpy()
    cover = correlate(mask.astype(float), own, mode="nearest")
    found = scene.expected(SLOW) / scene.exposure(SLOW).ratio
    for plane, result in zip(light, found, strict=True):
        wanted = (1.0 - cover) * correlate(plane.ravel()[behind], shake, mode="nearest")
        wanted += correlate(mask * plane, own, mode="nearest")
        np.testing.assert_allclose(result, wanted, atol=2e-5)
    assert math.isclose(cover.sum(), mask.sum(), rel_tol=1e-5)
