"""Brightness, clipping and histogram scorers, against hand arithmetic and other libraries."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from skimage.color import rgb2gray
from skimage.measure import shannon_entropy

from ae_env.scorers import make_scorer
from ae_env.scorers.measures import histogram_entropy
from simulator import CameraSettings, NoiseLevelFunction
from tests.ae_env.scorer_images import captures_of, random_pictures


def _score(name: str, images: torch.Tensor) -> list[float]:
    return next(iter(make_scorer(name).parts.values()))(images, None).tolist()


def _encoded(linear: float) -> float:
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055


@pytest.mark.parametrize(
    ("linear", "score"), [(0.18, 1.0), (0.36, 0.5), (0.09, 0.5), (0.0018, 0.01), (1.0, 0.18)]
)
def test_mid_grey_is_halved_by_every_stop(linear: float, score: float) -> None:
    picture = torch.full((1, 3, 4, 5), _encoded(linear))
    assert _score("mid_grey", picture) == pytest.approx([score], rel=1e-4)


def test_mid_grey_takes_the_mean_of_linear_luminance() -> None:
    pictures = random_pictures(3, 40, 50)[:, :3]
    encoded = pictures.numpy().astype(np.float64)
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    means = [rgb2gray(p.transpose(1, 2, 0)).mean() for p in linear]  # 0.2125, 0.7154, 0.0721
    expected = [2.0 ** -abs(math.log2(mean / 0.18)) for mean in means]
    np.testing.assert_allclose(_score("mid_grey", pictures), expected, rtol=2e-3)


def test_clipping_counts_samples_of_all_planes() -> None:
    raw = torch.full((2, 4, 2, 5), 0.5)  # 40 samples each
    raw[0, 0, 0, :3] = 1.0
    raw[0, 3, 1, :2] = 0.0
    raw[1, 1, 0, 0] = 2.0**-9  # the black end itself
    raw[1, 2, 0, 0] = 2.0**-8
    raw[1, 2, 1, 0] = 16382 / 16383  # the code below white
    assert _score("clipping", raw) == pytest.approx([1 - 5 / 40, 1 - 1 / 40])


def test_dynamic_range_by_hand() -> None:
    """The 11th and 991st of 1001 greens, each the mean of G1 and G2, from the noise floor on."""
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


def test_well_exposedness_is_mertens_product() -> None:
    pictures = random_pictures(2, 7, 5)[:, :3]
    weights = np.exp(-((pictures.double().numpy() - 0.5) ** 2) / (2 * 0.2**2))
    expected = weights.prod(axis=1).mean(axis=(1, 2))
    assert _score("well_exposedness", pictures) == pytest.approx(expected.tolist(), rel=1e-5)


def test_entropy_is_that_of_the_grey_levels() -> None:
    rng = np.random.default_rng(1)
    codes = np.stack([rng.integers(0, top, (31, 29)) for top in (2, 17, 200, 256)])
    luma = torch.from_numpy(codes / 255.0)
    expected = [shannon_entropy(picture, base=2) for picture in codes]
    np.testing.assert_allclose(histogram_entropy(luma).numpy(), expected, rtol=1e-9)
    every = torch.arange(256.0).reshape(1, 16, 16) / 255.0
    assert _score("entropy", every[:, None].expand(-1, 3, -1, -1)) == pytest.approx([1.0])


def test_bad_luma_is_refused() -> None:
    with pytest.raises(ValueError, match=r"`luma` \(=\(2, 3\)"):
        histogram_entropy(torch.zeros(2, 3))
    with pytest.raises(ValueError, match="floating point"):
        histogram_entropy(torch.zeros(1, 2, 3, dtype=torch.uint8))
