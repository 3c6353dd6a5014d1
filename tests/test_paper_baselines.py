"""The two baselines against their papers' tables and PyTorch's own layers."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from benchmarks.paper_baselines import (
    AdaptiveNorm,
    DecoupledNet,
    GeneratedConvolution,
    ParameterConcatenation,
    edge_map,
    scaled_parameters,
)
from simulator.networks.weights import build_modules, load_modules, save_modules

_SOURCES = torch.tensor([[0.0, -7.0, 3.5], [7.3, -13.0, 2.0], [2.0, -5.0, 2.5]])
_TARGETS = torch.tensor([[6.0, -10.0, 2.0], [0.0, 2.0, 4.5], [3.0, -6.0, 2.5]])
PARAMETERS = torch.cat([_SOURCES, _TARGETS], dim=1)


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("make", [ParameterConcatenation, DecoupledNet])
def test_batch_of_different_parameters_equals_single_runs(make):
    net = make(width=6).eval().double()
    for module in net.modules():  # running statistics that differ from a single image's
        if isinstance(module, AdaptiveNorm):
            nn.init.constant_(module.normalised, 0.5)
            module.norm.running_mean.normal_()
    images = normal(3, 4, 9, 7).double()
    alone = [net(images[i : i + 1], PARAMETERS[i : i + 1]) for i in range(3)]
    torch.testing.assert_close(net(images, PARAMETERS), torch.cat(alone))
    with pytest.raises(ValueError, match="`parameters`"):
        net(images, PARAMETERS[:1])


def test_scaled_parameters() -> None:
    """ISO 100, 1/8000 s is the origin; the paper's whole range is positive and of order one."""
    extremes = torch.tensor([[0.0, -12.97, 2.0, 7.33, 2.0, 4.46]])
    expected = [[0.0, 0.00375, 0.25, 0.91625, 1.875, 0.5575]]
    torch.testing.assert_close(scaled_parameters(extremes, normal(1, 1)), torch.tensor(expected))


def test_trained_baselines_come_back(tmp_path: Path) -> None:
    # CAN32 of Chen et al. 2017, six more inputs; 7 numbers a weight of 20 convolutions, 19 norms.
    for preset, parameters in (("pc", 77_046), ("dl", 4_884_288)):
        modules = build_modules(preset)
        assert sum(p.numel() for p in modules.parameters()) == parameters
        save_modules(tmp_path / preset, modules, preset, {})
        loaded, card = load_modules(tmp_path / preset)
        assert (list(loaded), card["preset"]) == (["baseline"], preset)


def test_adaptive_normalisation() -> None:
    """lambda * x + mu * BN(x): over the batch in training, with running statistics after it."""
    norm = AdaptiveNorm(3).double()
    x = normal(2, 3, 4, 5).double() * 2 + 1
    assert torch.equal(norm(x), x)  # lambda = 1, mu = 0
    nn.init.constant_(norm.identity, 0.3)
    nn.init.constant_(norm.normalised, 2.0)
    mean = x.mean(dim=(0, 2, 3), keepdim=True)
    deviation = (x.var(dim=(0, 2, 3), keepdim=True, correction=0) + 1e-3).sqrt()
    torch.testing.assert_close(norm(x), 0.3 * x + 2.0 * (x - mean) / deviation)
    norm.eval()
    norm.norm.running_mean.fill_(0.5)
    norm.norm.running_var.fill_(4.0 - 1e-3)
    torch.testing.assert_close(norm(x), 0.3 * x + 2.0 * (x - 0.5) / 2.0)


def test_receptive_field_of_the_published_table() -> None:
    """513 pixels (Chen et al. 2017, table 1)."""
    net = ParameterConcatenation(width=1).eval()
    for parameter in net.parameters():
        nn.init.ones_(parameter)  # positive, lest contributions cancel
    image = torch.ones(1, 4, 1, 701, requires_grad=True)
    net(image, torch.zeros(1, 6))[0, 0, 0, 350].backward()
    assert image.grad is not None
    reached = image.grad[0, 0, 0].nonzero().flatten()
    assert (int(reached[0]), int(reached[-1])) == (350 - 256, 350 + 256)


@pytest.mark.parametrize("options", [{}, {"stride": 2}, {"dilation": 4}, {"upsample": True}])
def test_generated_convolution_is_each_sample_s_own(options: dict[str, int]) -> None:
    torch.manual_seed(0)
    layer = GeneratedConvolution(5, 5, **options).double()  # type: ignore[arg-type]
    x = normal(3, 5, 7, 6).double()
    parameters = scaled_parameters(PARAMETERS, x)
    result = layer(x, parameters)
    for i in range(3):
        flat = layer.generator.weight @ parameters[i] + layer.generator.bias
        one = x[i : i + 1]
        if layer.upsample:
            expected = F.conv_transpose2d(one, flat.reshape(5, 5, 4, 4), stride=2, padding=1)
        else:
            padded = {"padding": options.get("dilation", 1), **options}
            expected = F.conv2d(one, flat.reshape(5, 5, 3, 3), **padded)
        torch.testing.assert_close(result[i : i + 1], expected)


def test_edge_map() -> None:
    """A ramp of slope 1 along the rows: two differences of 1 inside, one at the ends, over 4."""
    ramp = torch.arange(4.0).expand(1, 4, 3, 4)
    assert edge_map(ramp)[0, 0].tolist() == [[0.25, 0.5, 0.5, 0.25]] * 3
    assert torch.equal(edge_map(ramp.mT), edge_map(ramp).mT)
    assert edge_map(torch.ones(1, 4, 1, 1)).item() == 0.0
