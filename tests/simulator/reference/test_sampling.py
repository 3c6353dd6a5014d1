"""The sensor samples: the lens's blur, one place for each plane, averages of neighbours."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from simulator.camera import BayerPattern
from simulator.reference.camera import average_planes, lens_blur, sample_mosaic


@pytest.mark.parametrize("sigma", [0.0, 0.3, 0.5, 1.2])
def test_the_lens_is_scipys_gaussian(sigma: float) -> None:
    light = np.random.default_rng(0).random((3, 21, 34), dtype=np.float32)
    reach = max(1, int(np.ceil(3 * sigma)))
    expected = gaussian_filter(light, (0, sigma, sigma), mode="nearest", radius=(0, reach, reach))
    found = lens_blur(torch.from_numpy(light), sigma).numpy()
    np.testing.assert_allclose(found, expected if sigma else light, atol=2e-7)


@pytest.mark.parametrize("cfa", BayerPattern)
def test_a_point_lands_in_the_plane_of_its_colour_and_place(cfa: BayerPattern) -> None:
    """The letters of the pattern say which: RGGB has red at (0, 0), green at (0, 1) and (1, 0)."""
    seen: list[str] = []
    for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
        for index, colour in enumerate("RGB"):
            light = torch.zeros(3, 6, 8)
            light[index, 2 + row, 4 + column] = 1.0
            planes = sample_mosaic(light, cfa)
            letter = cfa.name[2 * row + column]
            assert float(planes.sum()) == (letter == colour)
            if letter == colour:
                plane = "RGGB"[int(planes.flatten(1).sum(dim=1).argmax())]
                assert plane == colour
                assert planes[:, 1, 2].sum() == 1.0
                seen.append(letter)
    assert "".join(seen) == cfa.name
    odd = torch.rand(3, 7, 9)
    assert torch.equal(sample_mosaic(odd, cfa), sample_mosaic(odd[:, :6, :8], cfa))


def test_planes_are_averaged_one_by_one() -> None:
    planes = torch.rand(4, 13, 17, generator=torch.Generator().manual_seed(0))
    assert average_planes(planes, 1) is planes
    expected = planes[:, :12, :15].reshape(4, 4, 3, 5, 3).mean(dim=(2, 4))
    torch.testing.assert_close(average_planes(planes, 3), expected)
