"""Scorers of pictures, against SciPy, scikit-image, Keras, published numbers and by hand."""

import hashlib
import math
import pickle
import sys
from dataclasses import replace
from importlib.util import find_spec
from itertools import pairwise

import h5py
import numpy as np
import pytest
import scipy.ndimage
import scipy.signal
import skimage.data
import torch
from safetensors.torch import save_file
from scipy.ndimage import gaussian_filter
from skimage.color import rgb2gray
from skimage.measure import shannon_entropy

import examples.convert_nima as convert_nima
from ae_env.scenes import Scene, reference_settings
from ae_env.scorers import defects as defect_signs
from ae_env.scorers import make_scorer, measures
from ae_env.scorers.defects import DEFECTS, KNOTS, mapped, severity
from ae_env.scorers.fidelity import likeness, reference_pictures
from ae_env.scorers.learnt import PUBLISHED, Classifier, NimaMobileNet, read_network
from ae_env.utils.user_files import UserCodeError
from benchmarks import defects as benchmark
from simulator import CameraSettings, NoiseLevelFunction, incident_ev100
from simulator.raw.develop import srgb_encode
from tests.ae_env import scorer_images
from tests.ae_env.scorer_images import CAMERA, GRID, captures_of, make_captures, random_pictures


def _levels(count: int = 3, height: int = 40, width: int = 60) -> np.ndarray:
    """8-bit grey levels (B, H, W)."""
    return np.round(255.0 * random_pictures(count, height, width)[:, 0].double().numpy())


def _sobel(picture: np.ndarray) -> np.ndarray:
    x, y = (scipy.ndimage.sobel(picture, axis=axis, mode="nearest") for axis in (1, 0))
    return np.hypot(x, y)


KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]])  # Immerkaer's


def _shim_pixels(picture: np.ndarray) -> np.ndarray:
    m = _sobel(picture) / math.sqrt(2 * 16 * 255**2)
    response = np.log(1000 * np.maximum(m - 0.06, 0) + 1) / np.log(1000 * (1 - 0.06) + 1)
    return np.where(m >= 0.06, response, 0.0)


def test_shim_is_the_mean_of_the_logarithmic_response() -> None:
    levels = _levels()
    expected = [_shim_pixels(picture).mean() for picture in levels]
    assert min(expected) > 0.05
    got = measures.shim_gradient(torch.from_numpy(levels / 255.0))
    np.testing.assert_allclose(got.numpy(), expected, rtol=1e-6)


def test_zhang_is_the_weighted_mean_of_sorted_squared_gradients() -> None:
    levels = _levels(height=21, width=33)
    kernel = np.array([[3, 0, -3], [10, 0, -10], [3, 0, -3]]) / 32
    expected = []
    for picture in levels:
        x, y = (scipy.ndimage.convolve(picture, k, mode="nearest") for k in (kernel, kernel.T))
        ordered = sorted((x**2 + y**2).ravel())
        size, n = len(ordered), int(0.7 * len(ordered))
        weights = []
        for i in range(size):
            angle = math.pi / 2 * i / (n - 1)
            if i >= n:
                angle = math.pi / 2 - math.pi / 2 * (i - n + 1) / (size - n)
            weights.append(math.sin(angle) ** 5)
        expected.append(np.dot(weights, ordered) / sum(weights))
    got = measures.zhang_gradient(torch.from_numpy(levels / 255.0))
    np.testing.assert_allclose(got.numpy(), expected, rtol=1e-6)
    pictures = torch.from_numpy(levels[:, None] / 255.0).float().expand(-1, 3, -1, -1)
    scores = make_scorer("zhang").parts["zhang"](pictures, None)
    np.testing.assert_allclose(scores, np.array(expected) / (np.array(expected) + 256), rtol=1e-4)


def _shin(picture: np.ndarray) -> float:
    """The metric in the words of the paper, for sizes that 10 divides."""
    height, width = picture.shape
    response = _shim_pixels(picture)
    rows, columns = height // 10, width // 10
    cells = [
        response[rows * i : rows * (i + 1), columns * j : columns * (j + 1)].mean()
        for i in range(10)
        for j in range(10)
    ]
    gradient = 2 * np.mean(cells) / np.std(cells, ddof=1)
    entropy = shannon_entropy(np.round(picture)) / 8
    squared = _sobel(picture) ** 2
    flat = squared <= np.sort(squared.ravel())[round(0.1 * picture.size) - 1]
    used = flat & (picture >= 15) & (picture <= 235)
    response = np.abs(scipy.ndimage.convolve(picture, KERNEL, mode="nearest"))
    noise = math.sqrt(math.pi / 2) / (6 * used.sum()) * response[used].sum()
    return 0.4 * gradient + 0.6 * entropy - 0.4 * noise


def test_shin_weighs_even_detail_and_entropy_against_noise() -> None:
    # Not whole levels, of which many gradients would tie at the percentile.
    levels = 255.0 * random_pictures(3, 40, 60)[:, 0].double().numpy()
    expected = np.array([_shin(picture) for picture in levels])
    got = measures.shin_metric(torch.from_numpy(levels / 255.0))
    np.testing.assert_allclose(got.numpy(), expected, rtol=1e-6)
    pictures = torch.from_numpy(levels[:, None] / 255.0).float().expand(-1, 3, -1, -1)
    scores = make_scorer("shin").parts["shin"](pictures, None)
    mapped = np.where(expected > 0, 1 - 0.5 / (1 + expected), 0.5 / (1 - np.minimum(expected, 0)))
    np.testing.assert_allclose(scores, mapped, atol=1e-2)  # a level may round the other way


def test_snr_and_dynamic_range_by_hand() -> None:
    light = 0.1 * np.exp(np.random.default_rng(0).normal(0.0, 2.0, (4, 6, 5)))
    states = [CameraSettings(*s) for s in ((100, 1 / 64, 4), (6400, 1 / 64, 4), (400, 1 / 4000, 4))]
    expected = []
    for state in states:
        nlf = CAMERA.nlf(state.iso)
        shot, read = (np.array(v)[:, None, None] for v in (nlf.shot, nlf.read))
        x = light * (state.exposure_time * 64) * (state.iso / 100)
        decibels = 10 * np.log10(np.minimum(x, 1.0) ** 2 / (shot * x + read))
        expected.append(decibels.clip(0.0, 50.0).mean() / 50.0)
    scores = make_scorer("snr")(None, captures_of(light, states))
    np.testing.assert_allclose(scores.numpy(), expected, rtol=1e-5)
    assert make_scorer("snr").closed_form
    # The 11th and 991st of 1001 greens, each the mean of G1 and G2, from the noise floor on.
    read, shot = (9.0, 2e-6, 6e-6, 9.0), (9.0, 1e-3, 3e-3, 9.0)
    floor = 0.5 * (2e-3 + math.sqrt(4e-6 + 4 * 4e-6))  # of the greens' means, 2e-3 and 4e-6
    none, noisy = NoiseLevelFunction.zero(), NoiseLevelFunction(shot, read)
    stops = math.log2(9e3) * 0.98
    for darkest, time, nlf, wanted in (
        (1e-4, 1 / 64, none, stops / 14),
        (1e-4, 1 / 64, noisy, math.log2(0.9 * 9e3**-0.01 / floor) / 14),
        # Four stops more: white at 1.
        (1e-4, 1 / 4, none, (stops - math.log2(0.9 * 9e3**-0.01 * 16)) / 14),
        (1e-9, 1 / 64, none, 1.0),  # 29 stops are more than 14
    ):
        green = np.random.default_rng(0).permutation(np.geomspace(darkest, 0.9, 1001))
        light = np.stack([green * 0 + 50.0, 1.5 * green, 0.5 * green, green * 0])[:, None]
        captures = replace(captures_of(light, [CameraSettings(100, time, 4)]), nlf=[nlf])
        found = make_scorer("dynamic_range")(None, captures).item()
        assert found == pytest.approx(wanted, rel=1e-5)


def test_blind_sigma_is_immerkaers() -> None:
    luma = random_pictures(3, 20, 31)[:, 0].double()
    expected = []
    for picture in 255.0 * luma.numpy():
        response = np.abs(scipy.signal.convolve2d(picture, KERNEL, mode="valid"))
        expected.append(math.sqrt(math.pi / 2) / (6 * 29 * 18) * response.sum())
    np.testing.assert_allclose(measures.immerkaer_sigma(luma).numpy(), expected, rtol=1e-9)
    rows, columns = np.mgrid[0:200, 0:220]
    slope = 60.0 + 0.3 * rows + 0.2 * columns  # straight slopes leave nothing
    noisy = slope + 5.0 * np.random.default_rng(2).normal(size=slope.shape)
    found = measures.immerkaer_sigma(torch.from_numpy(np.stack([noisy, slope]) / 255.0)).tolist()
    assert found == pytest.approx([5.0, 0.0], rel=0.02, abs=1e-9)
    pictures = torch.from_numpy(noisy / 255.0).float().expand(1, 3, -1, -1)
    score = make_scorer("blind_noise").parts["blind_noise"](pictures, None).item()
    assert score == pytest.approx(1 / (1 + 5.0 / 10), rel=0.03)


def _score(name: str, images: torch.Tensor) -> list[float]:
    return next(iter(make_scorer(name).parts.values()))(images, None).tolist()


def test_mid_grey_takes_the_mean_of_linear_luminance() -> None:
    pictures = random_pictures(3, 40, 50)[:, :3]
    encoded = pictures.numpy().astype(np.float64)
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    means = [rgb2gray(p.transpose(1, 2, 0)).mean() for p in linear]  # 0.2125, 0.7154, 0.0721
    expected = [2.0 ** -abs(math.log2(mean / 0.18)) for mean in means]
    np.testing.assert_allclose(_score("mid_grey", pictures), expected, rtol=2e-3)


def test_clipping_counts_samples_of_all_planes_and_well_exposedness_is_mertens_product() -> None:
    raw = torch.full((2, 4, 2, 5), 0.5)  # 40 samples each
    raw[0, 0, 0, :3] = 1.0
    raw[0, 3, 1, :2] = 0.0
    raw[1, 1, 0, 0] = 2.0**-9  # the black end itself
    raw[1, 2, 0, 0] = 2.0**-8
    raw[1, 2, 1, 0] = 16382 / 16383  # the code below white
    assert _score("clipping", raw) == pytest.approx([1 - 5 / 40, 1 - 1 / 40])
    pictures = random_pictures(2, 7, 5)[:, :3]
    weights = np.exp(-((pictures.double().numpy() - 0.5) ** 2) / (2 * 0.2**2))
    expected = weights.prod(axis=1).mean(axis=(1, 2))
    assert _score("well_exposedness", pictures) == pytest.approx(expected.tolist(), rel=1e-5)


def test_entropy_is_that_of_the_grey_levels() -> None:
    rng = np.random.default_rng(1)
    codes = np.stack([rng.integers(0, top, (31, 29)) for top in (2, 17, 200, 256)])
    luma = torch.from_numpy(codes / 255.0)
    expected = [shannon_entropy(picture, base=2) for picture in codes]
    np.testing.assert_allclose(measures.histogram_entropy(luma).numpy(), expected, rtol=1e-9)
    for bad in (torch.zeros(2, 3), torch.zeros(1, 2, 3, dtype=torch.uint8)):
        with pytest.raises(ValueError, match="`luma`"):
            measures.histogram_entropy(bad)
    every = torch.arange(256.0).reshape(1, 16, 16) / 255.0
    assert _score("entropy", every[:, None].expand(-1, 3, -1, -1)) == pytest.approx([1.0])


@pytest.fixture(scope="module")
def rendered() -> dict[str, torch.Tensor]:
    """Pictures (L, 3, H, W) of a photograph with each defect at its severities."""
    picture = torch.from_numpy(skimage.data.astronaut()).permute(2, 0, 1) / 255.0
    light = measures.srgb_decode(picture)
    scene = Scene.from_radiance(light, CAMERA, illuminance=1e3, scene_id="astronaut").resized(128)
    generator = torch.Generator().manual_seed(3)
    return {name: benchmark.render(scene, name, generator) for name in DEFECTS}


@pytest.mark.parametrize("defect", DEFECTS)
def test_severity_rises_with_the_defect(defect: str, rendered: dict[str, torch.Tensor]) -> None:
    found = severity(defect, rendered[defect])
    # Of a picture that was a little too dark or bright to begin with, the first steps mend that.
    assert bool((found.diff() >= (-0.05 if defect == "exposure" else -1e-6)).all())
    assert float(found[-1] - found[0]) > (0.35 if defect == "exposure" else 0.5)
    low, high = (-1.0, 1.0) if defect == "saturation" else (0.0, 1.0)
    assert low <= float(found.min()) <= float(found.max()) <= high


def test_white_share_missing_highlights_and_veil_by_hand() -> None:
    pictures = torch.full((2, 3, 10, 10), 0.3)
    pictures[0, :, :3] = 1.0
    pictures[1, :, 0, :2] = 0.75  # 2 of 100 pixels: the 99th percentile
    assert defect_signs.white_share(pictures).tolist() == pytest.approx([0.3, 0.0])
    assert defect_signs.missing_highlights(pictures).tolist() == pytest.approx([0.0, 0.25])
    # A veil is the airlight over the mean.
    linear = torch.zeros(1, 3, 10, 10)
    linear[:, :, 5:] = 0.5
    hazy = 0.6 * linear + 0.4 * 0.5
    found = defect_signs.veil(srgb_encode(torch.cat([linear, hazy]))).tolist()
    assert found == pytest.approx([0.0, 0.2 / 0.35], abs=1e-5)


def test_colour_cast_in_stops_and_colourfulness_of_hasler_and_suesstrunk() -> None:
    grey = torch.rand(1, 1, 21, 19, generator=torch.Generator().manual_seed(1)) * 0.3 + 0.05
    gains = torch.tensor([2.0**0.6, 1.0, 2.0**-0.8])[None, :, None, None]
    picture = srgb_encode(grey * gains)
    picture[:, :, :4] = torch.tensor([1.0, 0.0, 0.0])[:, None, None]  # a red object
    assert defect_signs.colour_cast(picture).item() == pytest.approx(1.0, abs=1e-4)
    pictures = random_pictures(3)[:, :3]
    expected = []
    for picture in 255.0 * pictures.double().numpy():
        red, green, blue = picture
        rg, yb = red - green, 0.5 * (red + green) - blue
        spread, mean = np.hypot(rg.std(), yb.std()), np.hypot(rg.mean(), yb.mean())
        expected.append(spread + 0.3 * mean)
    np.testing.assert_allclose(defect_signs.colourfulness(pictures), expected, rtol=1e-5)


def test_blur_effect_is_cretes() -> None:
    grey = skimage.data.camera()[100:260:2, 150:350:2] / 255.0
    pictures = [scipy.ndimage.gaussian_filter(grey, sigma) for sigma in (0.0, 1.0, 3.0)]
    expected = []
    for picture in pictures:
        sides = []
        for axis in (0, 1):
            wide = scipy.ndimage.uniform_filter1d(picture, 9, axis=axis, mode="nearest")
            sharp, blurred = (np.abs(np.diff(p, axis=axis)) for p in (picture, wide))
            sides.append(1 - np.maximum(sharp - blurred, 0).sum() / sharp.sum())
        expected.append(max(sides))
    images = torch.from_numpy(np.stack(pictures)).float()[:, None].expand(-1, 3, -1, -1)
    found = defect_signs.blur_effect(images)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert defect_signs.blur_effect(torch.full((1, 3, 8, 8), 0.5)).item() == 1.0


@pytest.mark.parametrize("name", list(KNOTS))
def test_maps_are_monotone_and_interpolate(name: str) -> None:
    x, y = np.array(KNOTS[name]).T
    assert (np.diff(x) > 0).all()
    assert (np.diff(y) >= 0).all()
    signs = np.linspace(x[0] - 1.0, x[-1] + 1.0, 101)
    found = mapped(name, torch.from_numpy(signs)).numpy()
    np.testing.assert_allclose(found, np.interp(signs, x, y), atol=1e-12)


def test_the_defect_score_is_one_less_the_worst_and_the_mean() -> None:
    scorer = make_scorer("defects")
    values = [0.9, 0.2, 0.6, 1.0, 0.4, 0.5]
    names = [f"analytic_{defect}" for defect in DEFECTS]
    expected = 0.75 * 0.2 + 0.25 * sum(values) / 6
    for full in (np.full, torch.full):
        scores = {name: full((2, 3), v) for name, v in zip(names, values, strict=True)}
        np.testing.assert_allclose(scorer.combine(scores), np.full((2, 3), expected), rtol=1e-6)


def lab(lightness: float, a: float = 0.0, b: float = 0.0, size: int = 16) -> np.ndarray:
    return np.broadcast_to(np.array([lightness, a, b]), (size, size, 3)).copy()


def test_colour_is_the_published_difference_and_structure_that_of_even_lightness():
    """Pairs of Sharma, Wu and Dalal 2005, table 1, of equal lightness: even areas, structure 1."""
    for first, second, difference in (
        ((2.6772, -79.7751), (0.0, -82.7485), 2.0425),
        ((-1.3802, -84.2814), (0.0, -82.7485), 1.0000),
        ((2.5, 0.0), (0.0, -2.5), 4.3065),
    ):
        found = likeness(lab(50.0, *first), lab(50.0, *second))
        assert found == pytest.approx(math.sqrt(math.exp(-difference / 10)), abs=1e-5)
    # Without variance SSIM is (2 m n + c) / (m^2 + n^2 + c), c = (0.01 * 100)^2.
    found, m, n = likeness(lab(40.0), lab(60.0)), 40.0, 60.0
    structure = (2 * m * n + 1.0) / (m * m + n * n + 1.0)
    # CIEDE2000 of greys is |dL| / S_L, S_L = 1 + 0.015 (L - 50)^2 / sqrt(20 + (L - 50)^2), L = 50.
    assert found == pytest.approx(math.sqrt(math.exp(-2.0) * structure), rel=1e-6)


def test_what_a_camera_does_costs():
    scorer, scene = make_scorer("fidelity"), scorer_images.random_scene(illuminance=1000.0)
    state = CameraSettings(100, 2.0 ** -(math.log2(1000 / 2.5) - 4), 4)
    captures = make_captures(scene, [state] * 5)
    (ideal,) = reference_pictures(captures, [0])
    rng = np.random.default_rng(0)
    noisy = (ideal + 0.05 * torch.from_numpy(rng.normal(size=ideal.shape)).float()).clamp(0, 1)
    blurred = torch.from_numpy(gaussian_filter(ideal.numpy(), (0, 1.5, 1.5)))
    brighter = (ideal * 1.3).clamp(0, 1)
    tinted = ideal * torch.tensor([1.0, 0.9, 0.8])[:, None, None]
    pictures = torch.stack([ideal, noisy, blurred, brighter, tinted])
    perfect, *others = scorer.parts["fidelity"](pictures, captures).tolist()
    assert perfect == pytest.approx(1.0, abs=1e-9)
    assert all(0.0 < score < 0.95 for score in others)
    assert scorer.parts["fidelity"](1.0 - pictures[:1], make_captures(scene, [state]))[0] < 0.3


EV = incident_ev100(1000.0)
needs_opencv = pytest.mark.skipif(find_spec("cv2") is None, reason="needs the extra cv")


def _scene(light: np.ndarray, name: str = "test") -> Scene:
    return scorer_images.make_scene(np.repeat(light[None], 4, axis=0), scene_id=name)


def _camera_man(size: int = 128) -> np.ndarray:
    return 0.6 * (skimage.data.camera()[: 4 * size : 4, : 4 * size : 4] / 255.0) ** 2.2


def test_the_reference_is_the_right_exposure_without_noise() -> None:
    """Whatever the state, and a grey card under incident light is 18 % grey in it."""
    scene = _scene(np.full((40, 40), 0.18 * 0.6635))
    captures = make_captures(scene, [GRID[i] for i in (0, 30, 63)])
    pictures = reference_pictures(captures, [0, 1, 2])
    # sRGB of 18 %: 1.055 * 0.18 ** (1 / 2.4) - 0.055.
    np.testing.assert_allclose(pictures.numpy(), 0.4614, atol=2e-3)


@needs_opencv
def test_a_perfect_capture_finds_all_again() -> None:
    scene = _scene(_camera_man())
    captures = make_captures(scene, [reference_settings(EV)] * 4)
    light = captures.light.clamp(0.0, 1.0)
    generator = torch.Generator().manual_seed(0)
    noisy = (light + 0.05 * torch.randn(light.shape, generator=generator)).clamp(0.0, 1.0)
    blurred = torch.nn.functional.avg_pool2d(light, 5, stride=1, padding=2)
    shifted = light.roll(12, dims=3)  # all are found, none at its place
    images = torch.stack([light[0], noisy[1], blurred[2], shifted[3]])
    perfect, with_noise, with_blur, elsewhere = make_scorer("matches")(images, captures).tolist()
    assert perfect == 1.0
    assert 0.0 < with_noise < 0.9
    assert 0.0 < with_blur < 0.9
    assert elsewhere < 0.1
    keypoints = make_scorer("keypoints")(images, captures)
    assert keypoints[2] < keypoints[0] < keypoints[1]  # noise is taken for corners


@needs_opencv
def test_each_capture_is_compared_with_its_own_scene() -> None:
    first, second = _scene(_camera_man(), "a"), _scene(_camera_man()[::-1].copy(), "a")
    scenes = [first, second, first, second]
    captures = make_captures(scenes, [reference_settings(EV)] * 4)
    scores = make_scorer("matches")(captures.light.clamp(0.0, 1.0), captures)
    assert scores.tolist() == [1.0] * 4  # though the two have one name
    swapped = make_scorer("matches")(captures.light[[1, 0, 3, 2]].clamp(0.0, 1.0), captures)
    assert float(swapped.max()) < 0.3


@needs_opencv
@pytest.mark.parametrize("name", ["keypoints", "matches"])
@pytest.mark.parametrize("size", [(1, 1), (37, 64)])
def test_any_frame_is_scored(name: str, size: tuple[int, int]) -> None:
    light = np.full(size, 0.1)
    captures = make_captures(_scene(light), [GRID[20]] * 3)
    images = torch.zeros(3, 4, *size)
    images[1] = 1.0
    images[2] = torch.rand(4, *size)
    scores = make_scorer(name)(images, captures)
    assert scores[:2].tolist() == [0.0, 0.0]
    assert 0.0 <= float(scores[2]) <= 1.0
    assert torch.equal(scores, make_scorer(name)(images, captures))


# -- learnt: NIMA against Keras with the same random weights, and classifiers from files -----------

#: Mean ratings that Keras 3.15 gives to `pictures_of_keras` with `weights_of_keras`, by
#: ``MobileNet((224, 224, 3), include_top=False, pooling="avg", weights=None)`` and a dense layer of
#: ten with a softmax; ``predict(2 * pictures - 1) @ np.arange(1, 11)``.
MEANS_OF_KERAS = np.array([8.475087, 8.796729, 8.662664])
WIDTHS = [32, 64, 128, 128, 256, 256, *[512] * 6, 1024, 1024]


def pictures_of_keras() -> torch.Tensor:
    rng = np.random.default_rng(1)
    pictures = rng.random((3, 224, 224, 3)) * np.array([1.0, 0.2, 1.0])[:, None, None, None]
    pictures[2] = np.linspace(0.0, 1.0, 224)[None, :, None] ** np.array([0.5, 1.0, 2.0])
    return torch.from_numpy(pictures.astype(np.float32)).permute(0, 3, 1, 2)


def weights_of_keras() -> dict[tuple[str, str], np.ndarray]:
    """Random ones by layer and array, in Keras' shapes."""
    kernels: dict[str, tuple[int, ...]] = {"conv1": (3, 3, 3, 32)}
    for i, (inputs, outputs) in enumerate(pairwise(WIDTHS), start=1):
        kernels |= {f"conv_dw_{i}": (3, 3, inputs, 1), f"conv_pw_{i}": (1, 1, inputs, outputs)}
    rng, weights = np.random.default_rng(0), {}
    for layer, shape in [*kernels.items(), ("dense_1", (1024, 10))]:
        # He's scale, or the signal dies in the depth.
        fan = math.prod(shape[:2] if "dw" in layer else shape[:-1])
        gain = 24.0 if layer == "dense_1" else 2.0
        weights[layer, "kernel"] = rng.normal(0.0, math.sqrt(gain / fan), shape)
        if layer == "dense_1":
            weights[layer, "bias"] = rng.normal(0.1, 0.3, 10)
            continue
        channels = shape[2] if "dw" in layer else shape[3]
        for array in ("gamma", "beta", "moving_mean", "moving_variance"):
            positive = array in ("gamma", "moving_variance")
            drawn = rng.uniform(0.7, 1.6, channels) if positive else rng.normal(0.1, 0.3, channels)
            weights[f"{layer}_bn", array] = drawn
    return weights


def test_a_converted_file_scores_as_keras_does(tmp_path, monkeypatch):
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "cache"))
    for name in ("nima_aesthetic", "nima_technical"):
        with pytest.raises(ValueError, match=rf"AE_ENV_{name.upper()}.*{PUBLISHED[name]}"):
            make_scorer(name)
    weights, old, whole = tmp_path / "weights.h5", "{0}/{0}/{1}:0", "model_weights/{0}/{0}/{1}"
    # As `save_weights` of Keras 2 and `save` of Keras 3 name them.
    with h5py.File(weights, "w") as first, h5py.File(tmp_path / "whole.h5", "w") as second:
        for (layer, array), values in weights_of_keras().items():
            depthwise = "_dw_" in layer and array == "kernel"
            own = "depthwise_kernel" if depthwise else array
            first[old.format(layer, own)] = values.astype(np.float32)
            second[whole.format(layer, array)] = values.astype(np.float32)
    content = weights.read_bytes()
    blob = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
    monkeypatch.setitem(convert_nima.PUBLISHED, "nima_technical", blob)
    convert_nima.main(str(weights))  # as if published: into the cache folder
    with pytest.raises(SystemExit, match="name"):
        convert_nima.main(str(tmp_path / "whole.h5"))
    convert_nima.main(str(tmp_path / "whole.h5"), str(tmp_path / "new" / "mine.safetensors"))
    monkeypatch.setenv("AE_ENV_NIMA_AESTHETIC", str(tmp_path / "new" / "mine.safetensors"))
    pictures = pictures_of_keras()
    for name in ("nima_aesthetic", "nima_technical"):
        scorer = make_scorer(name).parts[name]
        scores = scorer(pictures, None)
        np.testing.assert_allclose(scores.numpy(), (MEANS_OF_KERAS - 1.0) / 9.0, atol=2e-5)
    alone = torch.cat([scorer(p[None], None) for p in pictures])
    torch.testing.assert_close(alone, scores, rtol=0.0, atol=1e-6)
    for size in (1, 300):  # any picture is resized
        score = scorer(torch.full((1, 3, size, size + 1), 0.5), None)
        assert 0.0 < float(score) < 1.0


def test_other_files_are_refused(tmp_path):
    with h5py.File(tmp_path / "other.hdf5", "w") as file:
        file["conv1_bn/conv1_bn/gamma:0"] = np.zeros(64)
    with pytest.raises(ValueError, match="gamma:0"):
        convert_nima.convert(tmp_path / "other.hdf5", tmp_path / "out.safetensors")
    assert [path.name for path in tmp_path.iterdir()] == ["other.hdf5"]
    weights = {k: v for k, v in NimaMobileNet().state_dict().items() if "num_batches" not in k}
    assert sum(values.numel() for values in weights.values()) == 3_239_114  # as Keras counts
    bias = weights.pop("head.bias")
    file = tmp_path / "damaged.safetensors"
    for damaged in ({}, {"head.bias": torch.zeros(11)}, {"head.bias": bias * torch.nan}):
        save_file({**weights, **damaged}, file)
        with pytest.raises(ValueError, match=r"`file`(.|\n)*head.bias"):
            read_network(file)
    with pytest.raises(ValueError, match="`file`"):
        read_network(tmp_path / "nothing.safetensors")


MEAN, STD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])


def write_network(path, batch="batch", size="side", *, softmax=False):
    """Three classes: the logits are the means of red, green and blue."""
    onnx = pytest.importorskip("onnx")
    node, info = onnx.helper.make_node, onnx.helper.make_tensor_value_info
    nodes = [node("GlobalAveragePool", ["x"], ["m"]), node("Flatten", ["m"], ["logits"])]
    if softmax:
        nodes.append(node("Softmax", ["logits"], ["shares"]))
    given = info("x", onnx.TensorProto.FLOAT, [batch, 3, size, size])
    found = info("shares" if softmax else "logits", onnx.TensorProto.FLOAT, [batch, 3])
    graph = onnx.helper.make_graph(nodes, "means", [given], [found])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.save(model, str(path))
    return path


def flat_pictures(count: int = 5, height: int = 36, width: int = 48) -> torch.Tensor:
    colours = np.random.default_rng(0).random((count, 3, 1, 1)).astype(np.float32)
    return torch.from_numpy(colours).expand(count, 3, height, width).contiguous()


def confidences(images: torch.Tensor) -> np.ndarray:
    logits = (images.double().mean(dim=(2, 3)).numpy() - MEAN) / STD
    powers = np.exp(logits)
    return powers.max(axis=1) / powers.sum(axis=1)


@pytest.mark.parametrize("batch", ["batch", 1, 2], ids=str)
@pytest.mark.parametrize("softmax", [False, True], ids=["logits", "probabilities"])
def test_the_confidence_is_the_largest_probability(tmp_path, monkeypatch, batch, softmax):
    file = write_network(tmp_path / "a.onnx", batch, 32, softmax=softmax)
    monkeypatch.setenv("AE_ENV_CLASSIFIER", str(file))
    scorer = make_scorer("classifier").parts["classifier"]
    assert scorer.size == 32  # the file's own
    images = flat_pictures()
    scores = scorer(images, None)
    np.testing.assert_allclose(scores.numpy(), confidences(images), rtol=1e-5)
    again = pickle.loads(pickle.dumps(scorer))(images[:1], None)
    np.testing.assert_allclose(again.numpy(), confidences(images[:1]), rtol=1e-5)


def test_a_callable_sees_normalised_squares() -> None:
    seen = []

    def network(x: torch.Tensor) -> np.ndarray:
        seen.append(x)
        return x.numpy().mean(axis=(2, 3))

    images = flat_pictures(20)
    scores = Classifier(network, size=24)(images, None)
    np.testing.assert_allclose(scores.numpy(), confidences(images), rtol=1e-5)
    assert {x.shape[1:] for x in seen} == {(3, 24, 24)}
    expected = (images.mean(dim=(2, 3)).numpy() - MEAN) / STD
    np.testing.assert_allclose(torch.cat(seen)[:, :, 0, 0].numpy(), expected, rtol=1e-4)
    assert seen[0].dtype == torch.float32
    own = Classifier(torch.nn.Flatten().eval(), size=1, mean=(0, 0, 0), std=(0.5, 0.5, 0.5))
    powers = np.exp(images.mean(dim=(2, 3)).numpy() / 0.5)
    expected = powers.max(axis=1) / powers.sum(axis=1)
    np.testing.assert_allclose(own(images, None).numpy(), expected, rtol=1e-4)


def test_what_is_no_classifier_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    with pytest.raises(ValueError, match=r"AE_ENV_CLASSIFIER=FILE"):
        make_scorer("classifier")
    (tmp_path / "classifier.onnx").write_text("no network")
    with pytest.raises(ValueError, match=r"classifier.onnx'\) cannot be read"):
        make_scorer("classifier")
    fixed = write_network(tmp_path / "fixed.onnx", size=32)
    for model, arguments, name in (
        *((fixed, {"size": 224}, "size"), (fixed, {"std": (0, 1, 1)}, "std")),
        *((b"file.onnx", {}, "model"), (torch.nn.Dropout(), {}, "model")),  # in training mode
    ):
        with pytest.raises(ValueError, match=f"`{name}`"):
            Classifier(model, **arguments)
    for network in (lambda x: "a cat", lambda x: x.mean(dim=(1, 2, 3))[:, None], lambda x: 1 / 0):
        with pytest.raises(UserCodeError, match=r"returned|the classifier raised ZeroDivision"):
            Classifier(network)(flat_pictures(2), None)
    other = write_network(tmp_path / "other.onnx", batch=1)  # not read before
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"pip install 'ae-env\[onnx\]'"):
        Classifier(other)
