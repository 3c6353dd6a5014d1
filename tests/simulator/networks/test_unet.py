"""The U-Net against a NumPy transcription, its published size, and sizes that do not halve."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.ndimage
import torch
from torch import nn

from simulator.networks.unet import UNet, convolution, halve, resize_to

SIZES = [(16, 16), (1, 1), (1, 7), (5, 3), (17, 33)]


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def small(seed: int = 0) -> UNet:
    torch.manual_seed(seed)
    return UNet(widths=(4, 6, 8))


def test_parameter_count_of_the_published_widths() -> None:
    """Weights 9 * in * out and biases of each convolution, from a table of (in, out)."""
    table = [
        *((8, 32), (32, 32), (32, 64), (64, 64), (64, 128), (128, 128)),
        *((128, 256), (256, 256), (256, 512), (512, 512)),
        *((768, 256), (256, 256), (384, 128), (128, 128), (192, 64), (64, 64), (96, 32), (32, 32)),
        (32, 4),
    ]
    expected = sum(9 * i * o + o for i, o in table)
    assert expected == 7_849_220
    assert sum(p.numel() for p in UNet().parameters()) == expected


@pytest.mark.parametrize("size", SIZES)
def test_any_size(size: tuple[int, int]) -> None:
    result = UNet(widths=(2, 2, 2, 2, 2))(normal(2, 8, *size))
    assert result.shape == (2, 4, *size)
    assert result.isfinite().all()


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


def test_pooling_keeps_the_last_row_and_column() -> None:
    x = torch.arange(15.0).reshape(1, 1, 3, 5)
    assert halve(x)[0, 0].tolist() == [[6, 8, 9], [11, 13, 14]]
    assert resize_to(halve(x), x).shape == x.shape


def test_flat_raw_has_a_flat_residual() -> None:
    """Zero-padded borders would put a frame around it."""
    residual = small()(torch.full((1, 8, 9, 12), 0.3))
    assert float(residual.detach().std(dim=(2, 3)).max()) < 1e-6
    assert convolution(1, 1)(torch.zeros(1, 1, 1, 1)).shape == (1, 1, 1, 1)


def test_starts_near_no_change() -> None:
    """A new network of full depth neither drowns the raw nor has lost the signal on the way."""
    torch.manual_seed(0)
    residual = UNet()(torch.cat([normal(1, 4, 32, 32).abs() * 0.2, torch.zeros(1, 4, 32, 32)], 1))
    assert 1e-3 < float(residual.detach().std()) < 0.1


def test_every_parameter_learns() -> None:
    net = small()
    net(normal(2, 8, 11, 6)).abs().mean().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().sum() > 0, name


def test_same_seed_same_network() -> None:
    x = normal(1, 8, 6, 6)
    assert torch.equal(small(3)(x), small(3)(x))
    assert not torch.equal(small(3)(x), small(4)(x))


@pytest.mark.parametrize("widths", [(), (8,), (8, 0), (8, 4.0)])
def test_widths_are_checked(widths: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="`widths`"):
        UNet(widths=widths)
