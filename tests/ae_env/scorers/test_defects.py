"""Signs of photographic defects, their maps to severities, and the defect score."""

import numpy as np
import pytest
import scipy.ndimage
import skimage.data
import torch

from ae_env.scenes import Scene
from ae_env.scorers import defects as defect_signs
from ae_env.scorers import make_scorer
from ae_env.scorers.defects import DEFECTS, KNOTS, SIGNS, Defects, mapped, severity
from ae_env.scorers.measures import srgb_decode
from benchmarks import defects as benchmark
from simulator.raw.develop import srgb_encode
from tests.ae_env.scorer_images import CAMERA, random_pictures

MEASURES = [f"analytic_{defect}" for defect in DEFECTS]


@pytest.fixture(scope="module")
def rendered() -> dict[str, torch.Tensor]:
    """Pictures (L, 3, H, W) of a photograph with each defect at its severities."""
    picture = torch.from_numpy(skimage.data.astronaut()).permute(2, 0, 1) / 255.0
    scene = Scene.from_radiance(srgb_decode(picture), CAMERA, scene_id="astronaut").resized(128)
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


def test_white_share_and_missing_highlights_by_hand() -> None:
    pictures = torch.full((2, 3, 10, 10), 0.3)
    pictures[0, :, :3] = 1.0
    pictures[1, :, 0, :2] = 0.75  # 2 of 100 pixels: the 99th percentile
    assert defect_signs.white_share(pictures).tolist() == pytest.approx([0.3, 0.0])
    assert defect_signs.missing_highlights(pictures).tolist() == pytest.approx([0.0, 0.25])


def test_colour_cast_is_the_length_of_the_gains_in_stops() -> None:
    grey = torch.rand(1, 1, 21, 19, generator=torch.Generator().manual_seed(1)) * 0.3 + 0.05
    gains = torch.tensor([2.0**0.6, 1.0, 2.0**-0.8])[None, :, None, None]
    picture = srgb_encode(grey * gains)
    picture[:, :, :4] = torch.tensor([1.0, 0.0, 0.0])[:, None, None]  # a red object
    assert defect_signs.colour_cast(picture).item() == pytest.approx(1.0, abs=1e-4)


def test_colourfulness_is_hasler_and_suesstrunks() -> None:
    pictures = random_pictures(3)[:, :3]
    expected = []
    for picture in 255.0 * pictures.double().numpy():
        red, green, blue = picture
        rg, yb = red - green, 0.5 * (red + green) - blue
        spread, mean = np.hypot(rg.std(), yb.std()), np.hypot(rg.mean(), yb.mean())
        expected.append(spread + 0.3 * mean)
    np.testing.assert_allclose(defect_signs.colourfulness(pictures), expected, rtol=1e-5)


def test_veil_is_the_airlight_over_the_mean() -> None:
    linear = torch.zeros(1, 3, 10, 10)
    linear[:, :, 5:] = 0.5
    hazy = 0.6 * linear + 0.4 * 0.5
    found = defect_signs.veil(srgb_encode(torch.cat([linear, hazy]))).tolist()
    assert found == pytest.approx([0.0, 0.2 / 0.35], abs=1e-5)


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
    assert -1.0 <= y[0] <= y[-1] <= 1.0
    assert y[0] >= 0.0 or name == "saturation"
    signs = np.linspace(x[0] - 1.0, x[-1] + 1.0, 101)
    found = mapped(name, torch.from_numpy(signs)).numpy()
    np.testing.assert_allclose(found, np.interp(signs, x, y), atol=1e-12)
    assert set(SIGNS) == set(KNOTS)


def test_the_defect_score_is_one_less_the_worst_and_the_mean() -> None:
    scorer = make_scorer("defects")
    assert isinstance(scorer, Defects)
    assert list(scorer.parts) == MEASURES
    values = [0.9, 0.2, 0.6, 1.0, 0.4, 0.5]
    scores = {name: np.full((2, 3), v) for name, v in zip(MEASURES, values, strict=True)}
    expected = 0.75 * 0.2 + 0.25 * sum(values) / 6
    np.testing.assert_allclose(scorer.combine(scores), np.full((2, 3), expected))
    tensors = {name: torch.from_numpy(score) for name, score in scores.items()}
    torch.testing.assert_close(scorer.combine(tensors), torch.full((2, 3), expected).double())
