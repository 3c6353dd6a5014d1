"""Blind noise estimation against noise that was put in, at the built-in cameras' levels."""

import itertools

import numpy as np
import pytest
import skimage.data
from scipy.ndimage import gaussian_filter

from simulator import NoiseLevelFunction, estimate_nlf, get_camera, read_raw

LEVELS = (0.02, 0.1, 0.18, 0.5)


def ramp() -> np.ndarray:
    course = np.linspace(0.0, 1.0, 384) ** 2
    return np.stack([np.broadcast_to(0.002 + k * course, (256, 384)) for k in (0.6, 0.9, 0.9, 0.5)])


def patches() -> np.ndarray:
    row = np.repeat([0.01, 0.05, 0.2, 0.5], 50)
    return np.broadcast_to(row, (4, 200, 200))


def photograph(name: str, *, soft: bool = True) -> np.ndarray:
    """A photograph in linear light, a little softer than the pixel grid, as planes of one raw."""
    encoded = getattr(skimage.data, name)() / 255.0
    if not soft:
        return np.moveaxis(encoded[::2, ::2] ** 2.2, -1, 0)[[0, 1, 1, 2]]
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    planes = np.moveaxis(linear * [0.5, 1.0, 0.65], -1, 0)[[0, 1, 1, 2]]
    return gaussian_filter(planes, (0, 1, 1))


def with_noise(light: np.ndarray, nlf: NoiseLevelFunction, seed: int) -> np.ndarray:
    """Gaussian noise of the NLF's variance, clipped with a pedestal and quantised to 14 bits."""
    rng = np.random.default_rng(seed)
    shot, read = (np.array(v)[:, None, None] for v in (nlf.shot, nlf.read))
    noisy = light + np.sqrt(shot * light + read) * rng.standard_normal(light.shape)
    return np.round(np.clip(noisy, -0.065, 1.0) * 15000) / 15000


def worst_ratio(estimate: NoiseLevelFunction, truth: NoiseLevelFunction) -> tuple[float, float]:
    """Lowest and highest variance, estimated over true, over `LEVELS`, plane-averaged truth."""
    shot, read = np.mean(truth.shot), np.mean(truth.read)
    ratios = [(estimate.read[0] + estimate.shot[0] * x) / (read + shot * x) for x in LEVELS]
    return min(ratios), max(ratios)


SHARP = photograph("astronaut", soft=False)


@pytest.mark.parametrize(
    ("light", "camera", "iso", "least", "most"),
    [
        (ramp(), "nikon_z6", 12800, 0.88, 1.12),
        (ramp(), "canon_70d", 100, 0.88, 1.12),
        (patches(), "nikon_z6", 12800, 0.88, 1.12),
        (patches(), "canon_70d", 100, 0.88, 1.12),
        (np.tile(ramp(), (1, 6, 4)), "canon_70d", 800, 0.9, 1.1),  # so large that it is sampled
        (SHARP, "canon_70d", 800, 0.9, 3.0),  # no level is smooth, and the bound is the docs'
        *((photograph("astronaut"), "canon_70d", iso, 0.80, 1.25) for iso in (100, 6400)),
        *((photograph("coffee"), "canon_70d", iso, 0.80, 1.25) for iso in (100, 6400)),
    ],
)
def test_noise_that_was_put_in_is_found(light, camera, iso, least, most):
    nlf = get_camera(camera).nlf(iso)
    low, high = worst_ratio(estimate_nlf(with_noise(light, nlf, seed=1)), nlf)
    assert least < low <= high < most


def test_clipped_half_does_not_count():
    nlf = get_camera("canon_70d").nlf(1600)
    sides = np.full((4, 256, 200), 1.2), np.zeros((4, 256, 90))
    noisy = with_noise(np.concatenate([ramp(), *sides], axis=2), nlf, seed=4)
    for clipped in (noisy, np.maximum(noisy, 0.0)):  # with a pedestal, and without one
        low, high = worst_ratio(estimate_nlf(clipped), nlf)
        assert 0.85 < low <= high < 1.15


def test_dark_frame_is_read_noise_and_grey_card_is_right_at_its_level():
    rng = np.random.default_rng(6)
    noise = rng.standard_normal((4, 128, 128))
    dark = estimate_nlf(1e-3 * noise)
    assert dark.read[0] + 1e-3 * dark.shot[0] == pytest.approx(1e-6, rel=0.15)
    card = estimate_nlf(0.3 + 1e-2 * noise)
    assert card.read == (0.0,) * 4
    assert 0.3 * card.shot[0] == pytest.approx(1e-4, rel=0.1)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (np.zeros((3, 32, 32)), r"`data` \(shape"),
        (np.full((4, 32, 32), np.nan), "finite"),
        (np.random.default_rng(0).random((4, 8, 8)), "unclipped blocks"),
        (np.ones((4, 64, 64)), "0 unclipped blocks"),
    ],
)
def test_bad_input(data, words):
    with pytest.raises(ValueError, match=words):
        estimate_nlf(data)


@pytest.mark.real_data
def test_real_raws_of_one_camera_agree(data_dir):
    """Shot noise is the camera's, whatever the subject; a chart's patches are the reference."""
    folder = data_dir / "canon_crw_cc0"
    raws = {n: read_raw(folder / f"CRW_{n}.CRW") for n in ("0101", "0105", "0113", "0118")}
    shots = [raw.noise.shot[1] for raw in raws.values()]
    assert max(shots) / min(shots) < 1.15
    nlf = raws["0101"].noise
    # Neutral patches of the ColorChecker, a quadratic surface taken out, variance by least squares.
    y, x = np.mgrid[-1:1:24j, -1:1:24j]
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1).reshape(-1, 6)
    ratios = []
    for left, plane in itertools.product((165, 320, 475), range(4)):
        patch = raws["0101"].data[plane, 610:634, left : left + 24].double().numpy()
        _, (squares,), *_ = np.linalg.lstsq(design, patch.ravel(), rcond=None)
        variance = squares / (patch.size - 6)
        ratios.append(variance / (nlf.read[plane] + nlf.shot[plane] * patch.mean()))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)
