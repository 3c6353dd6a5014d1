"""The exposure and the aperture module, and all networks on images that they never saw."""

import itertools
import math

import numpy as np
import pytest
import scipy.ndimage
import torch
from torch import Tensor

from benchmarks import paper_baselines as paper_baselines  # presets pc and dl
from simulator import CameraSettings, get_camera
from simulator.networks.aperture_module import (
    BLUR_FACTOR,
    DEAD_ZONE,
    LARGEST,
    ApertureModule,
    AperturePreset,
    DefocusMap,
    added_blur,
    band_features,
    dead_zone,
    is_defocused,
    to_diameter,
    usable_defocus,
)
from simulator.networks.exposure_module import OVER_EXPOSED, ExposureModule, LinearFit
from simulator.networks.weights import BUILDERS, build_modules
from simulator.optics.discs import disc_blur
from simulator.optics.thin_lens import Lens
from simulator.reference.camera import BodyError, ReferenceCamera, ReferenceScene
from simulator.reference.sequences import Sequence
from simulator.settings import exposure_ratio
from simulator.training.data import ReferencePairs
from simulator.training.losses import ExposureLoss


def test_it_starts_as_the_plain_ratio() -> None:
    raw = torch.rand(2, 4, 3, 5, generator=torch.Generator().manual_seed(0)) * 3 - 0.1
    module, ratio = ExposureModule(), torch.tensor([4.0, 0.5])
    assert module.is_identity
    assert torch.equal(module(raw, ratio), raw * ratio.view(2, 1, 1, 1))
    assert torch.equal(module(raw[0], 8.0), raw[0] * 8)  # not clipped either
    for parameter in ("w", "b"):  # either ends the identity
        changed = ExposureModule().requires_grad_(False)
        getattr(changed, parameter).view(-1)[-1] += 1e-5
        assert not changed.is_identity


def test_the_fit_is_numpys_least_squares_on_noisy_captures_and_adds_up() -> None:
    """Captures that follow the model w = 1.03; a part of the targets is over-exposed."""
    rng = np.random.default_rng(0)
    source, ratio = rng.random((3, 4, 12, 10)), np.array([0.25, 1.7, 0.6])[:, None, None, None]
    b = np.array([0.002, -0.001, 0.003, -0.004])[:, None, None]
    target = 1.03 * ratio * (source + b) + rng.normal(0.0, 0.02, source.shape)
    used = (source <= OVER_EXPOSED) & (target <= OVER_EXPOSED)
    assert 0.7 < used.mean() < 0.95  # both kinds are there
    shifts = [np.eye(4)[plane][:, None, None] * np.ones_like(source) for plane in range(4)]
    columns = [(ratio * column)[used] for column in (source, *shifts)]
    (w, *v), *_ = np.linalg.lstsq(np.stack(columns, axis=1), target[used], rcond=None)
    source, target, ratio = map(torch.from_numpy, (source, target, ratio[:, 0, 0, 0]))
    fit = LinearFit()
    fit.add(source[:2], target[:2], ratio[:2])
    fit.add(source[2:], target[2:], ratio[2:])
    module = fit.solve()
    assert float(module.w) == pytest.approx(w, rel=1e-6)
    assert module.b.tolist() == pytest.approx([x / w for x in v], abs=1e-7)
    source[:, 3:] = 1.0  # a plane without pixels
    fit = LinearFit()
    fit.add(source, target, ratio)
    with pytest.raises(ValueError, match="every plane"):
        fit.solve()


def test_gradient_descent_and_closed_form_find_the_bodys_error() -> None:
    """Reference captures f/8 -> f/4 at ratio 8. The stop f/4 lets 5 % more light through, and the
    black level b0 is off: w = 1.05, and (x - b0) w r + b0 = w r (x + b) at b = b0 / (w r) - b0."""
    camera = get_camera("nikon_z6")
    source, target = CameraSettings(100, 1 / 64, 8), CameraSettings(200, 1 / 64, 4)
    black = (0.002, -0.0015, 0.001, -0.002)
    body = BodyError(transmission={target.aperture_stop: 0.05}, black_offset=black)
    rng = np.random.default_rng(0)
    light = torch.from_numpy(rng.uniform(0.01, 0.1, (4, 48, 48)).astype(np.float32))
    scene = ReferenceScene("flat", "flat", "test", light, source)
    pairs = ReferencePairs(
        [Sequence(scene, (source, target))], ReferenceCamera(camera, body=body), "exposure"
    )
    pairs.pairs = [pair for pair in pairs.pairs if pair.source == 0]
    ratio = exposure_ratio(source, target)
    assert ratio == 8.0
    truth = [b / (1.05 * ratio) - b for b in black]

    fit = LinearFit()
    batches = [pairs.batch(step, 4, 48) for step in range(3)]
    for batch in batches:
        fit.add(batch.source, batch.sample, batch.ratio)
    closed = fit.solve()
    assert float(closed.w) == pytest.approx(1.05, abs=2e-3)
    assert closed.b.tolist() == pytest.approx(truth, abs=1.5e-4)

    module = ExposureModule()
    loss = ExposureLoss(module)
    optimiser = torch.optim.Adam(module.parameters(), lr=5e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 300)
    for step in range(300):
        optimiser.zero_grad()
        loss(batches[step % 3])["loss"].backward()
        optimiser.step()
        schedule.step()
    assert float(module.w.detach()) == pytest.approx(float(closed.w), abs=2e-3)
    assert module.b.tolist() == pytest.approx(closed.b.tolist(), abs=2e-4)


# -- the aperture ----------------------------------------------------------------------------------


def picture(*size: int) -> Tensor:
    values = np.random.default_rng(0).random((2, 4, *size), dtype=np.float32)
    return torch.from_numpy(values) * 5.0


def module(preset: AperturePreset = "compact") -> ApertureModule:
    torch.manual_seed(1)
    made = ApertureModule(preset).eval().requires_grad_(False)
    if preset == "paper":
        made.network.tail.weight.mul_(10)
    return made


def with_map(diameter: float) -> ApertureModule:
    """A module that finds the same circle of confusion everywhere, before the dead zone."""
    made = module()
    made.network.tail.weight.zero_()
    made.network.tail.bias.fill_(np.log(diameter + 0.3))
    return made


F4, F8, F11 = (torch.full((2,), f) for f in (4.0, 8.0, 8 * 2**0.5))


@pytest.mark.parametrize("preset", ["compact", "paper"])
def test_only_the_images_that_open_change(preset: AperturePreset) -> None:
    image = picture(16, 19)
    made = with_map(4.0) if preset == "compact" else module("paper")
    for target in (F8, 2 * F8):
        assert torch.equal(made(image, torch.full_like(image, 0.01), F8, target), image)
    output = made(image, torch.zeros_like(image), F8, torch.tensor([4.0, 16.0]))
    assert not torch.allclose(output[0], image[0], atol=1e-3)
    assert torch.equal(output[1], image[1])


def test_dead_zone_by_hand() -> None:
    diameter = torch.tensor([0.0, 0.3, 0.5, 1.3, 5.0])
    expected = [0.0, 0.0, 0.0, 1.2, np.sqrt(25 - 0.25)]  # 5, 12, 13 over ten
    assert dead_zone(diameter, 0.5).tolist() == pytest.approx(expected, abs=1e-6)
    assert float(dead_zone(torch.tensor(DEAD_ZONE))) == 0.0


def test_a_known_map_is_blurred_by_what_the_wider_aperture_adds() -> None:
    """3 px at f/8, less the dead zone z: 9 - z^2 squared, times a factor squared; f/4 adds 2^2 - 1
        times that. A point
    becomes a spot of second moment d^2 / 16 per axis."""
    image = torch.zeros(2, 4, 41, 41)
    image[..., 20, 20] = 1.0
    output = with_map(3.0)(image, torch.zeros_like(image), F8, F4).double().numpy()
    squared = BLUR_FACTOR**2 * (9 - DEAD_ZONE**2) * 3
    offsets = np.arange(41) - 20
    moments = (output.sum(-1) * offsets**2).sum(-1)
    np.testing.assert_allclose(output.sum((-2, -1)), 1.0, atol=1e-5)
    np.testing.assert_allclose(moments, squared / 16, rtol=5e-3)


def test_the_paper_preset_commutes_with_exposure() -> None:
    """Its input is divided, its residual multiplied by one scalar."""
    image, made = picture(16, 16), module("paper")
    expected = made(image, torch.zeros_like(image), F11, F4)
    assert (expected - image).abs().mean() > 1e-2
    for factor in (2.0**-10, 2.0**10):
        result = made(image * factor, torch.zeros_like(image), F11, F4)
        torch.testing.assert_close(result, expected * factor, rtol=1e-4, atol=1e-4 * factor)


@pytest.mark.parametrize(("source", "target"), [(11.0, 4.0), (8.0, 5.6), (16.0, 4.0)])
def test_added_blur_is_the_thin_lens(source: float, target: float) -> None:
    """Squared diameters add: blur at the source and what is added make the blur at the target."""
    lens = Lens(focal_length=0.05, focus_distance=2.0)
    depth = np.array([0.7, 1.5, 2.0, 5.0, np.inf])
    at_source, at_target = (
        np.abs(lens.circle_of_confusion(depth, f)) / 11.8e-6 for f in (source, target)
    )
    added = added_blur(torch.from_numpy(at_source), source, target).numpy()
    np.testing.assert_allclose(np.hypot(at_source, added), at_target, rtol=1e-6, atol=1e-12)
    for same_or_closed in (source, 2 * source):
        assert not added_blur(torch.from_numpy(at_source), source, same_or_closed).any()


def test_a_picture_in_focus_is_not_touched_by_a_stray_estimate() -> None:
    """A twentieth of the detail must be blurred: 4 % of the pixels do not count, 50 % do."""
    generator = torch.Generator().manual_seed(0)
    image = 0.5 + 0.1 * torch.rand(2, 4, 50, 50, generator=generator)
    diameter = torch.full((2, 50, 50), 0.3)
    diameter[0, :2] = 6.0  # 4 %
    diameter[1, :25] = 6.0
    assert is_defocused(diameter, image).tolist() == [0.0, 1.0]
    trusted = usable_defocus(diameter, image)
    assert float(trusted[0].max()) == 0.0
    assert float(trusted[1].max()) == pytest.approx(BLUR_FACTOR * (6.0**2 - DEAD_ZONE**2) ** 0.5)


@pytest.mark.parametrize("spread", [0.2, 1.0, 3.0])
def test_defocus_is_judged_at_the_weighted_quantile(spread: float) -> None:
    """Against NumPy's sort of all pixels, weights from SciPy's windows."""
    random = np.random.default_rng(3)
    image = torch.from_numpy(random.uniform(0.2, 1.0, (3, 4, 30, 37)).astype(np.float32))
    image[:, :, :, :20] = 0.5 + 0.05 * (image[:, :, :, :20] - 0.5)
    centre = np.array([1.6, 1.9, 2.3]).reshape(3, 1, 1) - spread
    diameter = (centre + spread * random.random((3, 30, 37))).clip(0).astype(np.float32)
    expected = []
    for picture, values in zip(image.double().numpy(), diameter, strict=True):
        grey = picture.mean(axis=0)
        mean = scipy.ndimage.uniform_filter(grey, 9, mode="nearest")
        square = scipy.ndimage.uniform_filter((grey - mean) ** 2, 9, mode="nearest")
        weight = np.minimum(square / mean**2, 0.05).ravel()
        order = np.argsort(values.ravel())
        share = np.cumsum(weight[order]) / weight.sum()
        level = values.ravel()[order][np.searchsorted(share, 0.95)]
        expected.append(float(np.clip((level - 1.7) / (2.2 - 1.7), 0, 1)))
    found = is_defocused(torch.from_numpy(diameter), image)
    np.testing.assert_allclose(found.numpy(), expected, atol=0.01)


# The map of the circle of confusion


def test_exposure_does_not_matter() -> None:
    torch.manual_seed(3)
    network = DefocusMap(width=8).eval().requires_grad_(False)
    network.tail.weight.mul_(20.0)  # random, yet far from constant
    image = 0.1 + torch.rand(2, 4, 24, 30)
    deviation = torch.full_like(image, 0.01)
    expected = network(image, deviation)
    assert float(expected.std()) > 0.05
    for factor in (2.0**-6, 8.0, 1024.0):  # only the tiny constant floor rounds differently
        result = network(factor * image, factor * deviation)
        torch.testing.assert_close(result, expected, atol=1e-4, rtol=0)


def test_diameters_are_in_range_and_invert_the_logarithm() -> None:
    diameters = torch.tensor([0.0, 0.5, 3.0, 11.9])
    torch.testing.assert_close(to_diameter(torch.log(diameters + 0.3)), diameters)
    extremes = to_diameter(torch.tensor([-1e4, 1e4, 88.0]))
    assert extremes.tolist() == [0.0, LARGEST, LARGEST]


def test_the_noise_of_four_planes_averages() -> None:
    """The floor is the variance of their mean: a quarter of one plane's, measured."""
    field = torch.from_numpy(np.random.default_rng(2).normal(0, 0.01, (1, 4, 200, 200))).float()
    deviation = torch.full_like(field, 0.01)
    noise_plane = band_features(field, deviation)[:, 8]
    # Bands 0 - 1.5 - 3 - 5.5 - 10 px of white noise: their energies, from the kernels' own pixels.
    kernel = torch.zeros(41, 41)
    kernel[20, 20] = 1.0
    discs = [disc_blur(kernel, d) for d in (0.0, 1.5, 3.0, 5.5, 10.0)]
    energy = sum(float((a - b).square().sum()) for a, b in itertools.pairwise(discs))
    expected = 1.0 + 0.3 * math.log(1 / (1 + energy))
    assert float(noise_plane[..., 20:-20, 20:-20].mean()) == pytest.approx(expected, abs=0.01)


# -- flat, tiny, black and blinding images ---------------------------------------------------------

IMAGE_SIZES = ((1, 1), (17, 2))
#: Black, negative, saturated, blinding.
LEVELS = (0.0, -0.07, 1.0, 1e4)


@pytest.mark.parametrize("preset", [*BUILDERS])
@torch.inference_mode()
def test_flat_tiny_and_blinding_images_stay_finite(preset: str) -> None:
    torch.manual_seed(0)
    modules = build_modules(preset).eval()
    for size in IMAGE_SIZES:
        flat = torch.stack([torch.full((4, *size), level) for level in LEVELS])
        for images in (flat, flat + 0.05 * torch.randn(flat.shape)):
            if "baseline" in modules:
                parameters = torch.tensor([0.0, -6.0, 2.0, 3.0, -9.0, 1.0]).expand(len(images), -1)
                outputs = [modules["baseline"](images, parameters)]
            else:
                shot, f = torch.full((len(images), 4), 1e-4), torch.full((len(images),), 8.0)
                deviation = torch.full_like(images, 0.01)
                torch.nn.init.normal_(modules["noise"].network.tail.weight)
                outputs = [modules["noise"](images, shot, shot * 0.01)]
                if "aperture" in modules:
                    outputs.append(modules["aperture"](images, deviation, f, f / 2))
            for output in outputs:
                assert output.shape == images.shape
                assert torch.isfinite(output).all()
