"""Instance normalisation against PyTorch's own, and on the maps that PyTorch's cannot take."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from simulator.networks.unet import FLAT, instance_norm


def normal(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def test_values_and_gradients_of_torch_instance_norm() -> None:
    x = (normal(2, 3, 5, 7) * 0.3 + 2.0).requires_grad_()
    scale, shift = normal(3, seed=1).requires_grad_(), normal(3, seed=2).requires_grad_()
    weight = normal(2, 3, 5, 7, seed=3)
    ours = instance_norm(x, scale.expand(2, -1), shift.expand(2, -1))
    theirs = F.instance_norm(x, weight=scale, bias=shift, eps=1e-5)
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)
    gradients = [torch.autograd.grad((y * weight).sum(), (x, scale, shift)) for y in (ours, theirs)]
    torch.testing.assert_close(*gradients, rtol=1e-9, atol=1e-9)


def test_scale_and_shift_belong_to_their_sample() -> None:
    x, scale, shift = normal(3, 2, 4, 4), normal(3, 2, seed=1), normal(3, 2, seed=2)
    together = instance_norm(x, scale, shift)
    for i in range(3):
        alone = F.instance_norm(x[i : i + 1], weight=scale[i], bias=shift[i], eps=1e-5)
        torch.testing.assert_close(together[i : i + 1], alone)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("size", [(1, 1), (1, 2), (3, 5), (17, 33), (64, 64)])
@pytest.mark.parametrize("value", [0.0, 0.1, -0.37, 3.3, 1000.1])
def test_flat_map_becomes_the_shift(
    dtype: torch.dtype, size: tuple[int, int], value: float
) -> None:
    shift = torch.tensor([[0.25, -1.5]], dtype=dtype)
    x = torch.full((1, 2, *size), value, dtype=dtype)
    result = instance_norm(x, torch.full((1, 2), 100.0, dtype=dtype), shift)
    assert result.dtype == dtype
    assert torch.equal(result, shift[:, :, None, None].expand_as(x))


def test_rounding_of_a_flat_map_is_not_blown_up() -> None:
    x = 0.1 + 2e-7 * normal(1, 1, 8, 8)
    result = instance_norm(x, torch.ones(1, 1), torch.full((1, 1), 0.25))
    assert result.unique().tolist() == [0.25]


def test_map_just_above_the_threshold_is_normalised() -> None:
    x = 3 * FLAT * normal(1, 1, 8, 8)
    ours = instance_norm(x, torch.ones(1, 1), torch.zeros(1, 1))
    torch.testing.assert_close(ours, F.instance_norm(x, eps=1e-5), check_dtype=False)


def test_flat_map_has_finite_gradients() -> None:
    x = torch.full((1, 2, 4, 4), 0.3, requires_grad=True)
    scale = torch.ones(1, 2, requires_grad=True)
    shift = torch.zeros(1, 2, requires_grad=True)
    instance_norm(x, scale, shift).square().sum().backward()
    assert all(t.grad is not None and t.grad.isfinite().all() for t in (x, scale, shift))


def test_a_broken_map_is_not_hidden() -> None:
    x = torch.zeros(1, 1, 2, 2)
    x[0, 0, 0, 0] = torch.nan
    assert instance_norm(x, torch.ones(1, 1), torch.zeros(1, 1)).isnan().all()


def test_statistics_of_half_precision_are_not_half_precise() -> None:
    """256 bfloat16 steps above zero, the mean itself would round by a third of the deviation."""
    x = (1.0 + normal(1, 1, 32, 32) / 64).bfloat16()
    ours = instance_norm(x, torch.ones(1, 1), torch.zeros(1, 1)).double()
    exact = F.instance_norm(x.double(), eps=1e-5)
    torch.testing.assert_close(ours, exact, rtol=2**-8, atol=1e-3)
