"""Against colour-demosaicing, an independent implementation, and hand-computed pixels."""

import warnings

import numpy as np
import pytest
import torch

from simulator.camera import BayerPattern
from simulator.raw.demosaic import demosaic_half, demosaic_malvar

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # its own imports warn about optional packages
    from colour_demosaicing import demosaicing_CFA_Bayer_Malvar2004

PATTERNS = [p.value for p in BayerPattern]


def pack(mosaic: np.ndarray, pattern: str) -> torch.Tensor:
    """(2H, 2W) float mosaic to (1, 4, H, W), by the letters of the pattern alone."""
    red, blue = pattern.index("R"), pattern.index("B")
    tiles = [mosaic[i // 2 :: 2, i % 2 :: 2] for i in (red, red ^ 1, blue ^ 1, blue)]
    return torch.from_numpy(np.stack(tiles))[None]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 5e-7)])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_malvar_equals_colour_demosaicing_in_the_interior(pattern, dtype, tolerance):
    mosaic = np.random.default_rng(1).random((22, 34))
    packed = pack(mosaic, pattern).to(dtype)
    ours = demosaic_malvar(packed, pattern)
    assert ours.dtype == dtype
    batch = demosaic_malvar(torch.cat([packed.flip(3), packed]), pattern)
    assert torch.equal(batch[1:], ours)  # each image by itself
    theirs = demosaicing_CFA_Bayer_Malvar2004(mosaic, pattern)
    difference = ours[0].permute(1, 2, 0).double().numpy() - theirs
    assert np.abs(difference[2:-2, 2:-2]).max() < tolerance


@pytest.mark.parametrize("size", [(4, 4), (4, 10), (6, 4), (8, 12)])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_malvar_border_is_that_of_a_mirrored_mosaic(pattern, size):
    mosaic = np.random.default_rng(2).random(size)
    ours = demosaic_malvar(pack(mosaic, pattern), pattern)[0].permute(1, 2, 0).numpy()
    mirrored = np.pad(mosaic, 4, mode="reflect")
    theirs = demosaicing_CFA_Bayer_Malvar2004(mirrored, pattern)[4:-4, 4:-4]
    np.testing.assert_allclose(ours, theirs, atol=1e-14)


def test_half_is_one_pixel_per_tile():
    rgb = demosaic_half(torch.arange(2 * 4 * 2 * 3.0).reshape(2, 4, 2, 3))
    assert rgb.shape == (2, 3, 2, 3)
    assert rgb[1, :, 0, 2].tolist() == [26.0, 35.0, 44.0]  # of 26, 32, 38, 44


@pytest.mark.parametrize(
    ("packed", "pattern", "message"),
    [
        (torch.zeros(4, 8, 8), "RGGB", r"`packed` \(shape"),
        (torch.zeros(1, 3, 8, 8), "RGGB", r"`packed` \(shape"),
        (torch.zeros(1, 4, 1, 8), "RGGB", "at least 2 x 2"),
        (torch.zeros(1, 4, 2, 2), "RGBG", "one of RGGB, BGGR, GRBG, GBRG"),
        (torch.zeros(1, 4, 2, 2, dtype=torch.uint8), "RGGB", "floating point"),
    ],
)
def test_what_cannot_be_interpolated_is_refused(packed, pattern, message):
    calls = [lambda: demosaic_malvar(packed, pattern), lambda: demosaic_half(packed)]
    for call in calls if "shape" in message else calls[:1]:
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_malvar_on_the_gpu_is_not_rounded():
    packed = torch.rand(2, 4, 9, 8, generator=torch.Generator().manual_seed(0))
    on_gpu = demosaic_malvar(packed.cuda(), "GBRG").cpu()
    torch.testing.assert_close(on_gpu, demosaic_malvar(packed, "GBRG"), atol=3e-7, rtol=0)
