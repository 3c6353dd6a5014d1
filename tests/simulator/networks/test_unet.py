"""The two U-Nets against transcriptions of their papers in NumPy and PyTorch's own layers."""

import numpy as np
import pytest
import scipy.ndimage
import torch
import torch.nn.functional as F
from torch import nn

from simulator.networks.unet import (
    F_NUMBER_UNIT,
    ApertureNorm,
    AttentionUNet,
    SkipAttention,
    UNet,
    halve,
    instance_norm,
    resize_to,
)

PAIR = torch.tensor([[11.0, 4.0]])


def normal(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize("kind", [UNet, AttentionUNet])
@pytest.mark.parametrize(
    ("widths", "size"),
    [((2,) * 5, (1, 1)), ((2,) * 5, (1, 7)), ((2,) * 5, (17, 33)), ((4, 6, 8), (11, 6))],
)
def test_any_size_and_every_parameter_learns(kind, widths, size):
    torch.manual_seed(0)
    net = kind(widths=widths).double()
    inputs = (normal(2, 8, *size),)
    if kind is AttentionUNet:
        inputs = normal(2, 4, *size), torch.tensor([[11.0, 4.0], [8.0, 5.6]])
    result = net(*inputs)
    assert result.shape == (2, 4, *size)
    assert result.isfinite().all()
    result.square().mean().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert len(widths) == 5 or parameter.grad.abs().sum() > 0, name


def numpy_convolution(x: np.ndarray, layer: nn.Conv2d) -> np.ndarray:
    assert layer.bias is not None
    weight, bias = layer.weight.detach().numpy(), layer.bias.detach().numpy()
    return np.stack(
        [
            sum(
                scipy.ndimage.correlate(plane, kernel, mode="nearest")
                for plane, kernel in zip(x, kernels, strict=True)
            )
            + b
            for kernels, b in zip(weight, bias, strict=True)
        ]
    )


def numpy_double(x: np.ndarray, axis: int) -> np.ndarray:
    """Bilinear upsampling by two: quarters and three quarters of neighbours, borders repeated."""
    x = np.moveaxis(x, axis, 0)
    before = np.concatenate([x[:1], x[:-1]])
    after = np.concatenate([x[1:], x[-1:]])
    doubled = np.stack([0.75 * x + 0.25 * before, 0.75 * x + 0.25 * after], axis=1)
    return np.moveaxis(doubled.reshape(-1, *x.shape[1:]), 0, axis)


def test_against_a_numpy_transcription() -> None:
    """Brooks et al. 2019 written down once more: order of layers, slope, pooling, skips."""
    torch.manual_seed(0)
    net = UNet(widths=(3, 4)).double()
    for parameter in net.parameters():  # biases too, so that a missing one would show
        nn.init.normal_(parameter, std=0.3)
    layers = iter([m for m in net.modules() if isinstance(m, nn.Conv2d)])

    def two_convolutions(x: np.ndarray) -> np.ndarray:
        for _ in range(2):
            x = numpy_convolution(x, next(layers))
            x = np.maximum(x, 0.2 * x)
        return x

    image = np.random.default_rng(0).normal(size=(8, 6, 4))
    fine = two_convolutions(image)
    pooled = fine.reshape(3, 3, 2, 2, 2).max(axis=(2, 4))
    coarse = two_convolutions(pooled)
    upsampled = numpy_double(numpy_double(coarse, 1), 2)
    decoded = two_convolutions(np.concatenate([upsampled, fine]))
    expected = numpy_convolution(decoded, next(layers))
    result = net(torch.from_numpy(image)[None])[0].detach().numpy()
    np.testing.assert_allclose(result, expected, rtol=1e-10, atol=1e-12)


def test_borders() -> None:
    """Pooling keeps the last row and column; zero-padding would put a frame around flat raws."""
    x = torch.arange(15.0).reshape(1, 1, 3, 5)
    assert halve(x)[0, 0].tolist() == [[6, 8, 9], [11, 13, 14]]
    assert resize_to(halve(x), x).shape == x.shape
    residual = UNet(widths=(4, 6, 8))(torch.full((1, 8, 9, 12), 0.3))
    assert float(residual.detach().std(dim=(2, 3)).max()) < 1e-6


# Instance normalisation


def test_values_and_gradients_of_torch_instance_norm() -> None:
    x = (normal(2, 3, 5, 7) * 0.3 + 2.0).requires_grad_()
    scale, shift = normal(3, seed=1).requires_grad_(), normal(3, seed=2).requires_grad_()
    weight = normal(2, 3, 5, 7, seed=3)
    ours = instance_norm(x, scale.expand(2, -1), shift.expand(2, -1))
    theirs = F.instance_norm(x, weight=scale, bias=shift, eps=1e-5)
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)
    gradients = [torch.autograd.grad((y * weight).sum(), (x, scale, shift)) for y in (ours, theirs)]
    torch.testing.assert_close(*gradients, rtol=1e-9, atol=1e-9)


# The attention U-Net


def attention(width: int = 8) -> SkipAttention:
    torch.manual_seed(0)
    return SkipAttention(width, width // 2).double()


def test_channel_attention_needs_only_the_f_numbers() -> None:
    """The paper's branch, literally: 1 x 1 convolution (with a bias), A, average, excitation."""
    module = attention()
    skip, gate = normal(2, 8, 5, 6) * 3 + 1, normal(2, 8, 5, 6, seed=1) - 2
    aperture = torch.tensor([[1.4, 0.5], [2.0, 0.7]], dtype=torch.float64)
    torch.manual_seed(1)
    convolutions = [nn.Conv2d(8, 8, 1).double() for _ in range(2)]
    scales = [nn.Linear(2, 8).double() for _ in range(2)]
    shifts = [nn.Linear(2, 8).double() for _ in range(2)]
    with torch.no_grad():  # what the network learns is the sum of the two branches' w_m and b_m
        module.average.weight.copy_(shifts[0].weight + shifts[1].weight)
        module.average.bias.copy_(shifts[0].bias + shifts[1].bias)
    joint = sum(
        scale(aperture)[:, :, None, None] * F.instance_norm(convolution(x))
        + shift(aperture)[:, :, None, None]
        for x, convolution, scale, shift in zip(
            (skip, gate), convolutions, scales, shifts, strict=True
        )
    )
    assert isinstance(joint, torch.Tensor)
    literal = module.excite(F.adaptive_avg_pool2d(joint, 1).flatten(1))
    short = module.channel_attention(aperture)
    torch.testing.assert_close(short, literal, rtol=0, atol=1e-13)
    assert (short[0] - short[1]).abs().max() > 1e-3  # and it does depend on them


def test_spatial_attention_and_rescaling() -> None:
    """sigmoid(A(conv(relu(A(conv(F_l)) + A(conv(F_r)))))), one map for all channels."""
    module = attention()
    skip, gate = normal(1, 8, 5, 6), normal(1, 8, 5, 6, seed=1)
    aperture = PAIR.double() / F_NUMBER_UNIT

    def transformed(x: torch.Tensor, layer: nn.Module) -> torch.Tensor:
        assert isinstance(layer.convolution, nn.Conv2d)
        assert layer.convolution.bias is None
        assert isinstance(layer.norm, ApertureNorm)
        scale, shift = layer.norm.affine(aperture)[0].chunk(2)
        x = torch.einsum("oi,bihw->bohw", layer.convolution.weight[:, :, 0, 0], x)
        return F.instance_norm(x, weight=scale, bias=shift, eps=1e-5)

    joint = F.relu(transformed(skip, module.from_skip) + transformed(gate, module.from_gate))
    beta_s = torch.sigmoid(transformed(joint, module.to_map))
    assert beta_s.shape == (1, 1, 5, 6)
    torch.testing.assert_close(module.spatial_attention(skip, gate, aperture), beta_s)
    beta_c = module.channel_attention(aperture)
    expected = torch.stack([skip[0, c] * beta_s[0, 0] * beta_c[0, c] for c in range(8)])[None]
    torch.testing.assert_close(module(skip, gate, aperture), expected)


def test_a_flat_image_has_a_flat_residual_of_the_f_numbers_alone() -> None:
    """Rounding errors of 1e-7, multiplied by 300 at each normalisation, once made pictures."""
    torch.manual_seed(0)
    net = AttentionUNet()
    with torch.inference_mode():
        residual = net(torch.full((1, 4, 33, 40), 0.99), PAIR)
        reference = net(torch.zeros(1, 4, 1, 1), PAIR)
    torch.testing.assert_close(residual, reference.expand_as(residual), rtol=0, atol=1e-6)
