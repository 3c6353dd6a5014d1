"""The exposure, aperture and noise modules, and all networks on images that they never saw."""

import itertools
import math
from typing import get_args

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.ndimage import uniform_filter
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from benchmarks import paper_baselines as paper_baselines  # presets pc and dl
from simulator import get_camera
from simulator.networks import aperture_module, noise_module
from simulator.networks.exposure_module import ExposureModule
from simulator.networks.noise_module import SIZES, Denoiser, NoiseModule, Stabiliser
from simulator.networks.unet import AttentionUNet, SkipAttention, UNet
from simulator.networks.weights import BUILDERS, build_modules
from simulator.optics.discs import disc_blur
from simulator.reference.thin_lens import Lens


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


# -- the aperture ----------------------------------------------------------------------------------


def picture(*size):
    values = np.random.default_rng(0).random((2, 4, *size), dtype=np.float32)
    return torch.from_numpy(values) * 5.0


def module(preset: aperture_module.AperturePreset = "compact") -> aperture_module.ApertureModule:
    torch.manual_seed(1)
    made = aperture_module.ApertureModule(preset).eval().requires_grad_(False)
    if preset == "paper":
        made.network.tail.weight.mul_(10)
    return made


def with_map(diameter: float) -> aperture_module.ApertureModule:
    """A module that finds the same circle of confusion everywhere, before the dead zone."""
    made = module()
    made.network.tail.weight.zero_()
    made.network.tail.bias.fill_(np.log(diameter + 0.3))
    return made


F4, F8, F11 = (torch.full((2,), f) for f in (4.0, 8.0, 8 * 2**0.5))


@pytest.mark.parametrize("preset", ["compact", "paper"])
def test_only_the_images_that_open_change(preset: aperture_module.AperturePreset) -> None:
    image = picture(16, 19)
    made = with_map(4.0) if preset == "compact" else module("paper")
    for target in (F8, 2 * F8):
        assert torch.equal(made(image, torch.full_like(image, 0.01), F8, target), image)
    output = made(image, torch.zeros_like(image), F8, torch.tensor([4.0, 16.0]))
    assert not torch.allclose(output[0], image[0], atol=1e-3)
    assert torch.equal(output[1], image[1])


def test_a_known_map_is_blurred_by_what_the_wider_aperture_adds() -> None:
    """3 px at f/8, less the dead zone z: 9 - z^2 squared, times a factor squared; f/4 adds 2^2 - 1
    times that. A point becomes a spot of second moment d^2 / 16 per axis."""
    image = torch.zeros(2, 4, 41, 41)
    image[..., 20, 20] = 1.0
    output = with_map(3.0)(image, torch.zeros_like(image), F8, F4).double().numpy()
    squared = aperture_module.BLUR_FACTOR**2 * (9 - aperture_module.DEAD_ZONE**2) * 3
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
    added = aperture_module.added_blur(torch.from_numpy(at_source), source, target).numpy()
    np.testing.assert_allclose(np.hypot(at_source, added), at_target, rtol=1e-6, atol=1e-12)
    for closed in (source, 2 * source):
        assert not aperture_module.added_blur(torch.from_numpy(at_source), source, closed).any()


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
        mean = uniform_filter(grey, 9, mode="nearest")
        square = uniform_filter((grey - mean) ** 2, 9, mode="nearest")
        weight = np.minimum(square / mean**2, 0.05).ravel()
        order = np.argsort(values.ravel())
        share = np.cumsum(weight[order]) / weight.sum()
        level = values.ravel()[order][np.searchsorted(share, 0.95)]
        expected.append(float(np.clip((level - 1.7) / (2.2 - 1.7), 0, 1)))
    found = aperture_module.is_defocused(torch.from_numpy(diameter), image)
    np.testing.assert_allclose(found.numpy(), expected, atol=0.01)


def test_exposure_does_not_matter() -> None:
    torch.manual_seed(3)
    network = aperture_module.DefocusMap(width=8).eval().requires_grad_(False)
    network.tail.weight.mul_(20.0)  # random, yet far from constant
    image = 0.1 + torch.rand(2, 4, 24, 30)
    deviation = torch.full_like(image, 0.01)
    expected = network(image, deviation)
    assert float(expected.std()) > 0.05
    for factor in (2.0**-6, 8.0, 1024.0):  # only the tiny constant floor rounds differently
        result = network(factor * image, factor * deviation)
        torch.testing.assert_close(result, expected, atol=1e-4, rtol=0)
    extremes = aperture_module.to_diameter(torch.tensor([-1e4, 1e4, 88.0]))
    assert extremes.tolist() == [0.0] + 2 * [aperture_module.LARGEST]


def test_the_noise_of_four_planes_averages() -> None:
    """The floor is the variance of their mean: a quarter of one plane's, measured."""
    field = torch.from_numpy(np.random.default_rng(2).normal(0, 0.01, (1, 4, 200, 200))).float()
    deviation = torch.full_like(field, 0.01)
    noise_plane = aperture_module.band_features(field, deviation)[:, 8]
    # Bands 0 - 1.5 - 3 - 5.5 - 10 px of white noise: their energies, from the kernels' own pixels.
    kernel = torch.zeros(41, 41)
    kernel[20, 20] = 1.0
    discs = [disc_blur(kernel, d) for d in (0.0, 1.5, 3.0, 5.5, 10.0)]
    energy = sum(float((a - b).square().sum()) for a, b in itertools.pairwise(discs))
    expected = 1.0 + 0.3 * math.log(1 / (1 + energy))
    assert float(noise_plane[..., 20:-20, 20:-20].mean()) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("preset", [*BUILDERS])
@torch.inference_mode()
def test_flat_tiny_and_blinding_images_stay_finite(preset: str) -> None:
    torch.manual_seed(0)
    modules = build_modules(preset).eval()
    levels = torch.tensor([0.0, -0.07, 1.0, 1e4])  # black, negative, saturated, blinding
    for size in ((1, 1), (1, 7), (17, 33)):
        flat = levels[:, None, None, None].expand(-1, 4, *size)
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


# -- the noise module ------------------------------------------------------------------------------

NLF = get_camera("nikon_z6").nlf(6400)
SHOT, READ = torch.tensor([NLF.shot]), torch.tensor([NLF.read])


@pytest.mark.parametrize("preset", get_args(noise_module.Preset))
def test_operations_are_those_that_torch_counts(preset: noise_module.Preset) -> None:
    module = NoiseModule(preset).eval()
    with torch.no_grad(), FlopCounterMode(display=False) as counted:
        module(torch.full((1, 4, 32, 32), 0.1), SHOT, READ)
    assert module.operations == counted.get_total_flops() / 32**2
    assert module.commutes == (preset in SIZES)


@pytest.mark.parametrize("preset", ["nano", "paper"])
def test_the_gate_is_each_images_own_and_changes_no_other(preset):
    module = NoiseModule(preset).eval().requires_grad_(False)
    torch.nn.init.normal_(module.network.tail.weight)
    image = (0.06 * normal(1, 4, 16, 18, dtype=torch.float32)).expand(3, -1, -1, -1)
    factor = torch.tensor([[1.0], [0.0], [2.0]])
    together = module(image, factor * SHOT, factor * READ)
    assert torch.equal(together[1], image[1])
    for i in (0, 2):
        inputs = image[i : i + 1], factor[i] * SHOT, factor[i] * READ
        if preset == "paper":
            level = noise_module.variance_map(*inputs).sqrt()
            expected = inputs[0] + module.network(torch.cat([inputs[0], level], dim=1))
        else:
            expected = module.network(*inputs)
        torch.testing.assert_close(together[i : i + 1], expected, rtol=1e-5, atol=1e-5)
        assert not torch.equal(together[i], image[i])


def stabiliser(shot: float, read: float) -> Stabiliser:
    return Stabiliser.of(torch.full((1, 4), shot), torch.full((1, 4), read))


def flat_field(level=0.2, side=64, seed=0):
    """A flat field with the noise of the Z6 at ISO 6400, drawn by NumPy, (1, 4, side, side)."""
    rng, shape = np.random.default_rng(seed), (1, 4, side, side)
    shot, read = (np.array(v)[:, None, None] for v in (NLF.shot, NLF.read))
    drawn = rng.poisson(level / shot, shape) * shot + rng.normal(size=shape) * np.sqrt(read)
    return torch.from_numpy(drawn.astype(np.float32))


def random_network(size: str = "nano", *, shift: float = 0.0) -> Denoiser:
    made = Denoiser(size).eval().requires_grad_(False)
    torch.nn.init.normal_(made.tail.weight, std=0.1)
    torch.nn.init.constant_(made.tail.bias, shift)
    return made


@pytest.mark.parametrize("read", [1e-9, 1e-6, 1e-3])
@pytest.mark.parametrize("shot", [1e-2, 1e-5, 1e-9, 1e-12, 0.0])
def test_the_generalised_anscombe_transform_exact_for_any_shot(shot: float, read: float) -> None:
    """2 / s (sqrt(s y + c) - sqrt(c)) with c = 3/8 s^2 + r, in double precision; its two terms
    cancel as s goes to 0, where it is y / sigma."""
    y, *noise = map(np.float32, ([0.0, 1e-7, 1e-4, 0.03, 1.0, 50.0], shot, read))
    shot, read = noise
    exact, cancelled = y / np.sqrt(np.float64(read)), 0.0
    if shot > 0:
        slope = np.float64(shot)
        c = 0.375 * slope**2 + read
        exact = 2 / slope * (np.sqrt(slope * y + c) - np.sqrt(c))
        cancelled = 1e-15 * np.sqrt(c) / slope
    found = stabiliser(shot, read).forward(torch.from_numpy(y).expand(1, 4, 1, -1))[0, 0, 0]
    np.testing.assert_allclose(found.double().numpy(), exact, rtol=1e-5, atol=cancelled)


def test_the_inverse() -> None:
    y = torch.tensor([-3.0, -1e-4, 0.0, 1e-6, 0.02, 1.0, 300.0]).expand(1, 4, 1, -1)
    for shot, read in ((1e-3, 1e-6), (1e-6, 1e-3), (1e-4, 0.0), (0.0, 1e-5)):
        made = stabiliser(shot, read)
        torch.testing.assert_close(made.inverse(made.forward(y)), y, rtol=2e-6, atol=1e-9)
    assert float(stabiliser(0.0, 1e-4).linearity[0, 0]) == 1.0
    assert float(stabiliser(1e-2, 1e-12).linearity[0, 0]) < 0.5


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("c", [1 / 83, 0.3, 64.0])
def test_it_commutes_with_exposure(size: str, c: float) -> None:
    """Light c y has the noise (c shot, c^2 read); compared in units of the noise."""
    made, image = random_network(size), flat_field()
    sigma = (READ + SHOT * 0.2).sqrt()[..., None, None]
    after = made(image, SHOT, READ)
    assert float(((after - image) / sigma).std()) > 0.05  # it does something
    brighter = made(c * image, c * SHOT, c * c * READ) / c
    assert float(((brighter - after) / sigma).abs().max()) < 2e-4
    assert float(((brighter - after) / sigma).square().mean().sqrt()) < 3e-5


@pytest.mark.parametrize("level", [0.01, 0.4])
@pytest.mark.parametrize("side", [16, 136, 203])
def test_the_mean_stays_whatever_is_taken(level: float, side: int) -> None:
    """Of a flat field of which a network takes 0.8 standard deviations too much; or gives that in
    one half, which is corrected where it is. Not in training: it must cost something there."""
    made, image = random_network(shift=-0.8), flat_field(level, side)
    torch.nn.init.zeros_(made.tail.weight)
    sigma = (READ + SHOT * level).sqrt()
    kept, trained = (
        (made.train(t)(image, SHOT, READ) - image).mean(dim=(2, 3)) / sigma for t in (False, True)
    )
    assert float(kept.abs().max()) < 1e-4
    assert float(trained.max()) < -0.7
    wide = flat_field(level, 512)[..., :side, :]
    sides = torch.where(torch.arange(512) < 256, -0.8, 0.8) * sigma[..., None]
    wrong = (level + sides)[:, :, None].expand_as(wide)
    error = (made.corrected(wrong, wide, SHOT, READ) - wide) / sigma[..., None, None]
    for part in (error[..., :180], error[..., -180:]):
        assert float(part.mean(dim=(2, 3)).abs().max()) < 0.05


def test_no_pixel_changes_by_more_than_five_standard_deviations() -> None:
    image, made = flat_field(), Stabiliser.of(SHOT, READ)
    for shift in (1e6, -1e6):
        network = random_network(shift=shift)
        far = network.surroundings(image, SHOT, READ)
        changed = made.forward(network.uncorrected(image, far, SHOT, READ)) - made.forward(image)
        torch.testing.assert_close(changed.abs(), torch.full_like(changed, 5.0), rtol=0, atol=1e-3)


# -- the two U-Nets against transcriptions of their papers ----------------------------------------
PAIR = torch.tensor([[11.0, 4.0]])


def normal(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize("kind", [UNet, AttentionUNet])
def test_every_parameter_learns(kind):
    torch.manual_seed(0)
    net = kind(widths=(4, 6, 8)).double()
    inputs = (normal(2, 8, 11, 6),)
    if kind is AttentionUNet:
        inputs = normal(2, 4, 11, 6), torch.tensor([[11.0, 4.0], [8.0, 5.6]])
    net(*inputs).square().mean().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().sum() > 0, name


def test_against_a_transcription() -> None:
    """Brooks et al. 2019 written down once more: order of layers, slope, pooling, skips."""
    torch.manual_seed(0)
    net = UNet(widths=(3, 4)).double()
    for parameter in net.parameters():  # biases too, so that a missing one would show
        nn.init.normal_(parameter, std=0.3)
    parameters = net.parameters()

    def convolved(x):
        return F.conv2d(F.pad(x, (1, 1, 1, 1), "replicate"), next(parameters), next(parameters))

    def level(x):
        return F.leaky_relu(convolved(F.leaky_relu(convolved(x), 0.2)), 0.2)

    fine = level(image := normal(1, 8, 6, 4))
    upsampled = F.interpolate(level(F.max_pool2d(fine, 2)), scale_factor=2, mode="bilinear")
    expected = convolved(level(torch.cat([upsampled, fine], dim=1)))
    torch.testing.assert_close(net(image), expected, rtol=1e-10, atol=1e-12)


def test_channel_attention_needs_only_the_f_numbers() -> None:
    """The paper's branch, literally: 1 x 1 convolution (with a bias), A, average, excitation."""
    torch.manual_seed(0)
    module = SkipAttention(8, 4).double()
    skip, gate = normal(2, 8, 5, 6) * 3 + 1, normal(2, 8, 5, 6, seed=1) - 2
    aperture = torch.tensor([[1.4, 0.5], [2.0, 0.7]], dtype=torch.float64)
    module.average.requires_grad_(False).weight.zero_()
    joint = torch.zeros(())
    for x in (skip, gate):
        layers = nn.Conv2d(8, 8, 1), nn.Linear(2, 8), nn.Linear(2, 8)
        convolution, scale, shift = (layer.double().requires_grad_(False) for layer in layers)
        normalised = F.instance_norm(convolution(x))
        joint = joint + scale(aperture)[:, :, None, None] * normalised
        joint = joint + shift(aperture)[:, :, None, None]
        module.average.weight += shift.weight  # it learns the sum of the branches' w_m and b_m
        module.average.bias += shift.bias
    literal = module.excite(F.adaptive_avg_pool2d(joint, 1).flatten(1))
    short = module.channel_attention(aperture)
    torch.testing.assert_close(short, literal, rtol=0, atol=1e-13)
    assert (short[0] - short[1]).abs().max() > 1e-3  # and it does depend on them
    # The spatial attention is the same as in the released networks, whose test has it.
    expected = skip * module.spatial_attention(skip, gate, aperture) * literal[:, :, None, None]
    torch.testing.assert_close(module(skip, gate, aperture), expected)


def test_a_flat_image_has_a_flat_residual_of_the_f_numbers_alone() -> None:
    """Rounding errors of 1e-7, multiplied by 300 at each normalisation, once made pictures."""
    torch.manual_seed(0)
    net = AttentionUNet()
    with torch.inference_mode():
        residual = net(torch.full((1, 4, 33, 40), 0.99), PAIR)
        reference = net(torch.zeros(1, 4, 1, 1), PAIR)
    torch.testing.assert_close(residual, reference.expand_as(residual), rtol=0, atol=1e-6)
