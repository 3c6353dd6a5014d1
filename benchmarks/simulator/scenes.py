"""Held-out scenes that the parts photograph, and what their errors are measured in."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from ae_env.scenes.reference_scenes import reference_scenes
from simulator import CameraProfile, get_camera
from simulator.reference.reference_camera import ReferenceScene

#: Called with what is being measured and the share of the part that is done.
Progress = Callable[[str, float], None]
#: Procedural groups of the test split, size of its scenes and of crops of them [packed pixel];
#: scenes without depth, photographs apart, are half the size.
FULL, QUICK = (64, 256, 128), (6, 128, 64)
#: PSNR of two images that are the same, or nearer than this [dB].
LARGEST_PSNR = 80.0


def data_root() -> Path | None:
    """The folder of real files that ``AE_ENV_DATA`` names; None where there is none."""
    folder = Path(os.environ.get("AE_ENV_DATA", "../shared/data"))
    return folder if folder.is_dir() else None


@functools.cache
def held_out_scenes(camera: str, *, quick: bool) -> tuple[ReferenceScene, ...]:
    """The test split: procedural groups, photographs and, where present, radiance maps."""
    profile, folder = get_camera(camera), data_root()
    number, size, _ = QUICK if quick else FULL
    return tuple(reference_scenes("test", profile, number=number, size=size, radiance=folder))


def cropped(scene: ReferenceScene, size: int) -> ReferenceScene:
    """The middle `size` x `size` pixels of a scene, or all of one that is smaller."""
    top, left = (max(0, n - size) // 2 for n in scene.light.shape[1:])
    window = (..., slice(top, top + size), slice(left, left + size))
    depth = None if scene.depth is None else scene.depth[window]
    return replace(scene, light=scene.light[window], depth=depth)


def psnr(estimate: Tensor, truth: Tensor, peak: float = 1.0) -> float:
    """PSNR over all planes [dB], at most `LARGEST_PSNR`."""
    error = float((estimate.double() - truth.double()).square().mean()) / peak**2
    return LARGEST_PSNR if error <= 0 else min(LARGEST_PSNR, -10.0 * math.log10(error))


def clipped(image: Tensor, camera: CameraProfile) -> Tensor:
    """`image` (4, H, W) within what a capture can show: [-pedestal, 1]."""
    pedestal = torch.tensor(camera.pedestal).to(image)[:, None, None]
    return torch.maximum(image, -pedestal).clamp(max=1.0)
