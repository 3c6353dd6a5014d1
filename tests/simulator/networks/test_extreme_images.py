"""Networks on images that they never saw: flat, tiny, black, blinding; random weights."""

from __future__ import annotations

import pytest
import torch

from benchmarks import paper_baselines as paper_baselines  # presets pc and dl
from simulator.networks.weights import BUILDERS, build_modules

SIZES = ((1, 1), (2, 3), (17, 1), (16, 19))
#: Black, negative, ordinary, saturated, blinding.
LEVELS = (0.0, -0.07, 2.0**-14, 0.2, 1.0, 1e4)


@pytest.mark.parametrize("preset", [*BUILDERS])
@torch.inference_mode()
def test_flat_tiny_and_blinding_images_stay_finite(preset: str) -> None:
    torch.manual_seed(0)
    modules = build_modules(preset).eval()
    for size in SIZES:
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
