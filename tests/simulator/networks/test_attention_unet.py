"""The attention U-Net against the paper's formulas, written with PyTorch's own layers."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from simulator.networks.unet import F_NUMBER_UNIT, ApertureNorm, AttentionUNet, SkipAttention

PAIR = torch.tensor([[11.0, 4.0]])


def normal(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def small(seed: int = 0) -> AttentionUNet:
    torch.manual_seed(seed)
    return AttentionUNet(widths=(4, 6, 8))


def attention(width: int = 8) -> SkipAttention:
    torch.manual_seed(0)
    return SkipAttention(width).double()


def test_parameter_count_of_the_published_widths() -> None:
    """Each normalised convolution: k * k * in * out, no bias, and 6 * out of A (two f-numbers)."""

    def normalised(inputs: int, outputs: int, kernel: int = 3) -> int:
        return kernel * kernel * inputs * outputs + 6 * outputs

    def level(inputs: int, outputs: int) -> int:
        return normalised(inputs, outputs) + normalised(outputs, outputs)

    def skip(c: int) -> int:
        spatial = 2 * normalised(c, c // 2, 1) + normalised(c // 2, 1, 1)
        return spatial + 3 * c + (c * (c // 4) + c // 4) + (c // 4 * c + c)

    encoder = level(6, 32) + level(32, 64) + level(64, 128) + level(128, 256) + level(256, 512)
    upward = sum(normalised(2 * c, c) for c in (256, 128, 64, 32))
    decoder = sum(level(2 * c, c) for c in (256, 128, 64, 32))
    skips = sum(skip(c) for c in (256, 128, 64, 32))
    expected = encoder + upward + decoder + skips + (32 * 4 + 4)
    assert sum(p.numel() for p in AttentionUNet().parameters()) == expected == 8_784_324


@pytest.mark.parametrize("size", [(16, 16), (1, 1), (1, 7), (5, 3), (17, 33)])
def test_any_size(size: tuple[int, int]) -> None:
    net = AttentionUNet(widths=(2, 2, 2, 2, 2))
    result = net(normal(2, 4, *size), PAIR.expand(2, -1))
    assert result.shape == (2, 4, *size)
    assert result.isfinite().all()


def test_normalisation_is_the_paper_s_formula() -> None:
    torch.manual_seed(0)
    norm = ApertureNorm(3).double()
    nn.init.normal_(norm.affine.bias)
    x, aperture = normal(2, 3, 4, 5, dtype=torch.float64), normal(2, 2, dtype=torch.float64)
    result = norm(x, aperture)
    weight, bias = norm.affine.weight, norm.affine.bias
    for i in range(2):
        scale = weight[:3] @ aperture[i] + bias[:3]
        shift = weight[3:] @ aperture[i] + bias[3:]
        expected = F.instance_norm(x[i : i + 1], weight=scale, bias=shift, eps=1e-5)
        torch.testing.assert_close(result[i : i + 1], expected)


@pytest.mark.parametrize("size", [(1, 1), (3, 4), (9, 9)])
def test_normalisation_of_a_flat_map_is_its_bias(size: tuple[int, int]) -> None:
    torch.manual_seed(0)
    norm = ApertureNorm(3)
    result = norm(torch.full((1, 3, *size), 0.7), PAIR / F_NUMBER_UNIT)
    shift = norm.affine(PAIR / F_NUMBER_UNIT)[:, 3:, None, None]
    assert torch.equal(result, shift.expand_as(result))


def test_channel_attention_needs_only_the_f_numbers() -> None:
    """The paper's branch, literally: 1 x 1 convolution (with a bias), A, average, excitation."""
    module = attention()
    skip, gate = normal(2, 8, 5, 6).double() * 3 + 1, normal(2, 8, 5, 6, seed=1).double() - 2
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


@pytest.mark.parametrize("size", [(1, 1), (4, 7)])
def test_channel_attention_full_agrees(size: tuple[int, int]) -> None:
    module = attention()
    draw = [normal(2, 8, *size, seed=i).double() for i in range(2)]
    result = module.channel_attention_full(
        draw[0],
        draw[1],
        aperture := normal(2, 2, seed=2).double(),
        kernels=(normal(8, 8, 1, 1, seed=3).double(), normal(8, 8, 1, 1, seed=4).double()),
        scales=(normal(2, 8, seed=5).double(), normal(2, 8, seed=6).double()),
    )
    torch.testing.assert_close(result, module.channel_attention(aperture), rtol=0, atol=1e-13)


def test_spatial_attention_and_rescaling() -> None:
    """sigmoid(A(conv(relu(A(conv(F_l)) + A(conv(F_r)))))), one map for all channels."""
    module = attention()
    skip, gate = normal(1, 8, 5, 6).double(), normal(1, 8, 5, 6, seed=1).double()
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


def test_f_number_planes_cancel() -> None:
    """As the documentation says: constant planes are a bias in front of a normalisation."""
    net = small().double()
    image = normal(1, 4, 9, 8).double()
    before = net(image, PAIR)
    with torch.no_grad():
        net.encoder[0].first.convolution.weight[:, 4:].normal_(std=10.0)
    torch.testing.assert_close(net(image, PAIR), before, rtol=0, atol=1e-11)


@pytest.mark.parametrize("value", [0.0, 0.1, 0.99])
def test_flat_image_has_a_flat_residual_of_the_f_numbers_alone(value: float) -> None:
    """Rounding errors of 1e-7, multiplied by 300 at each normalisation, once made pictures."""
    torch.manual_seed(0)
    net = AttentionUNet()
    with torch.inference_mode():
        residual = net(torch.full((1, 4, 33, 40), value), PAIR)
        reference = net(torch.zeros(1, 4, 1, 1), PAIR)
    torch.testing.assert_close(residual, reference.expand_as(residual), rtol=0, atol=1e-6)


def test_f_numbers_change_the_residual() -> None:
    net, image = small(), normal(1, 4, 8, 8)
    both = [net(image, torch.tensor([pair])) for pair in ([11.0, 4.0], [4.0, 11.0], [11.0, 8.0])]
    assert (both[0] - both[1]).abs().max() > 1e-4  # the order counts
    assert (both[0] - both[2]).abs().max() > 1e-4


def test_batch_of_different_f_numbers_equals_single_runs() -> None:
    net, images = small().double(), normal(3, 4, 7, 9).double()
    f_numbers = torch.tensor([[11.0, 4.0], [8.0, 5.6], [22.0, 4.0]])
    together = net(images, f_numbers)
    for i in range(3):
        alone = net(images[i : i + 1], f_numbers[i : i + 1])
        torch.testing.assert_close(together[i : i + 1], alone)


def test_every_parameter_learns() -> None:
    net = small().double()
    image, f_numbers = normal(2, 4, 11, 6).double(), torch.tensor([[11.0, 4.0], [8.0, 5.6]])
    net(image, f_numbers).square().mean().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().sum() > 0, name


@pytest.mark.parametrize("size", [(1, 1), (8, 8)])
def test_gradients_of_a_black_image_are_finite(size: tuple[int, int]) -> None:
    net = small()
    net(torch.zeros(1, 4, *size), PAIR).abs().sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in net.parameters())


def test_autocast_keeps_statistics_in_float32() -> None:
    """At this depth; the full one is too sensitive for bfloat16, as its documentation says."""
    net, image = small(), normal(1, 4, 16, 16)
    exact = net(image, PAIR)
    with torch.autocast("cpu", torch.bfloat16):
        rough = net(image, PAIR).float()
    assert (rough - exact).square().mean() < 0.1**2 * exact.var()


def test_same_seed_same_network() -> None:
    x = normal(1, 4, 6, 6)
    assert torch.equal(small(3)(x, PAIR), small(3)(x, PAIR))
    assert not torch.equal(small(3)(x, PAIR), small(4)(x, PAIR))


def test_input_is_checked() -> None:
    with pytest.raises(ValueError, match=r"`f_numbers` \(of shape \(2,\)\) must have shape \(1, 2"):
        small()(normal(1, 4, 4, 4), PAIR[0])
    with pytest.raises(ValueError, match="`widths`"):
        AttentionUNet(widths=(32,))
