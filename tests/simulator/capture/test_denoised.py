"""Light that a network denoises: worked out once, when it is first read."""

from __future__ import annotations

import pickle

import pytest
import torch

from simulator.capture.denoised import Denoised

LIGHT = torch.rand(4, 6, 5, generator=torch.Generator().manual_seed(0))


def test_the_network_runs_once_when_it_is_needed() -> None:
    calls: list[int] = []
    lazy = Denoised(lambda: calls.append(1) or LIGHT, name="nano", operations=3, everywhere=False)  # type: ignore[func-returns-value]
    moved = lazy.to(torch.device("cpu"))
    assert lazy.shape is None
    assert not calls
    again = pickle.loads(pickle.dumps(moved))
    for made in (moved, lazy, again):
        assert torch.equal(made.light, LIGHT)
        assert torch.equal(made.statistics.light, LIGHT)
        assert (made.name, made.operations, made.everywhere) == ("nano", 3, False)
        assert made.shape == LIGHT.shape
        assert made.to(torch.device("cpu")) is made
    assert calls == [1]
    with pytest.raises(ValueError, match="`denoised`"):
        Denoised(LIGHT[:3])
