"""The exposure module: its formula, and its two fits, against a body whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from simulator import CameraSettings, get_camera
from simulator.networks.exposure_module import OVER_EXPOSED, ExposureModule, LinearFit
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
