"""What the calibration finds of networks whose errors are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from simulator import get_camera
from simulator.capture.statistics import Residual
from simulator.networks.noise_module import NoiseModule, variance_map
from simulator.training.data import DetailCrops, DetailPicture
from simulator.training.train import calibrate

Z6 = get_camera("nikon_z6")


class Known(NoiseModule):
    """Leaves a share of the noise's deviation on a flat field, and shifts it by another."""

    def __init__(self, left: float, shift: Callable[[int], float]) -> None:
        super().__init__("nano")
        self.left, self.shift, self.calls = left, shift, 0

    def forward(self, noisy: Tensor, shot: Tensor, read: Tensor) -> Tensor:
        mean = noisy.mean(dim=(0, 2, 3), keepdim=True).expand_as(noisy)
        sigma = variance_map(mean, shot, read).sqrt()
        self.calls += 1
        return mean + self.left * (noisy - mean) + self.shift(self.calls) * sigma


@pytest.fixture(autouse=True)
def small_crops(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simulator.training.train._SIDE", 32)
    monkeypatch.setattr("simulator.training.train._CROPS", 64)


def found(left: float, shift: Callable[[int], float]) -> Residual:
    picture = DetailPicture("a", "a", "mosaic", torch.full((4, 64, 64), 0.5))
    return calibrate(Known(left, shift), DetailCrops([picture], [Z6]))


@pytest.mark.parametrize(("left", "shift"), [(0.5, 0.0), (0.0, 0.3), (0.8, -0.2)])
def test_noise_that_is_left_and_a_shift(left: float, shift: float) -> None:
    """Squares of the two shares; single crops are as all of them are."""
    residual = found(left, lambda _: shift)
    assert residual.wiener_error[0] == 0.0
    seen = residual.wiener_error <= 0.006
    np.testing.assert_allclose(residual.variance[seen], left**2, rtol=0.03, atol=1e-3)
    np.testing.assert_allclose(residual.bias[seen], shift**2, rtol=0.05, atol=2e-3)
    assert 1.0 <= residual.spread < 1.05
    assert Residual.from_card(residual.to_card()).spread == pytest.approx(residual.spread, abs=1e-3)


def test_the_bound_holds_for_nine_crops_of_ten() -> None:
    """The second half of 64 crops is worse: half of it by three times, a twentieth by nine."""
    residual = found(
        0.0, lambda call: 0.1 if call <= 32 or call % 2 else 0.9 if call % 20 == 0 else 0.3
    )
    assert residual.bias[0] == pytest.approx(0.01, rel=0.1)
    assert residual.spread == pytest.approx(3.0, rel=0.05)
