"""Captures that several benchmarks take or compare, and what their errors are measured in."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from simulator import CameraProfile
from simulator.reference.camera import ReferenceScene

#: PSNR of two images that are the same, or nearer than this [dB].
LARGEST_PSNR = 80.0


def psnr(estimate: Tensor, truth: Tensor, peak: float = 1.0) -> float:
    """PSNR over all planes [dB], at most `LARGEST_PSNR`."""
    error = float((estimate.double() - truth.double()).square().mean()) / peak**2
    return LARGEST_PSNR if error <= 0 else min(LARGEST_PSNR, -10.0 * math.log10(error))


def clipped(image: Tensor, camera: CameraProfile) -> Tensor:
    """`image` (..., 4, H, W) within what a capture can show: [-pedestal, 1]."""
    pedestal = torch.tensor(camera.pedestal).to(image)[:, None, None]
    return torch.maximum(image, -pedestal).clamp(max=1.0)


def recorded(signal: Tensor, camera: CameraProfile) -> Tensor:
    """`signal` (..., 4, H, W) in whole digital numbers of the camera, 1 at white."""
    span, black = (torch.tensor(v)[:, None, None] for v in (camera.span, camera.black_level))
    numbers = (signal * span + black).round().clamp(0.0, camera.white_level)
    return (numbers - black) / span


def cropped(scene: ReferenceScene, height: int, width: int) -> ReferenceScene:
    """The middle `height` x `width` packed pixels of a scene, or all of one that is smaller."""
    top, left = (max(0, n - size) // 2 for n, size in zip(scene.size, (height, width), strict=True))
    rows, columns = (
        slice(scene.pitch * first, scene.pitch * (first + n))
        for first, n in ((top, height), (left, width))
    )
    window = (..., rows, columns)
    depth = None if scene.depth is None else scene.depth[window]
    return replace(scene, light=scene.light[window].contiguous(), depth=depth)
