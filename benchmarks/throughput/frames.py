"""Raws of any size to time the simulator on: dead leaves under uneven light, with sensor noise."""

from __future__ import annotations

import functools

import numpy as np
import torch

from ae_env.scenes.dead_leaves import dead_leaves
from simulator import CameraSettings, RawImage, get_camera
from simulator.optics.blur import disc_blur

CAMERA = "nikon_z6"
#: Side of the picture that is repeated, mirrored, over a larger frame [packed pixel].
_TILE = 512
#: Diameter of the circle of confusion where it is out of focus [packed pixel].
_DEFOCUS = 4.0


@functools.cache
def _tile(seed: int) -> np.ndarray:
    """(4, T, T): in focus on the left, out of focus on the right."""
    red, green, blue = dead_leaves(np.random.default_rng(seed), _TILE)
    light = torch.from_numpy(np.stack([red * 0.5, green, green, blue * 0.6]))  # a sensor's, roughly
    light[..., _TILE // 2 :] = disc_blur(light, _DEFOCUS)[..., _TILE // 2 :]
    return light.numpy()


def noisy_raw(
    height: int,
    width: int,
    *,
    settings: CameraSettings | None = None,
    seed: int = 0,
) -> RawImage:
    """A raw (4, height, width) as a Nikon Z6 records it, with its noise, in whole numbers.

    Args:
        height: Packed pixels.
        width: Packed pixels.
        settings: Which noise it carries; by default ISO 400.
        seed: Of the picture and its noise.
    """
    settings = settings or CameraSettings(400, 1 / 64, 8.0)
    camera = get_camera(CAMERA)
    noise, rng = camera.nlf(settings.iso), np.random.default_rng(seed)
    data = np.empty((4, height, width), np.float32)
    rows, columns = _mirrored(height), _mirrored(width)
    slope = np.linspace(0.4, 1.6, width, dtype=np.float32)  # brighter to the right
    for plane in range(4):
        for top in range(0, height, _TILE):  # little more memory than the raw itself
            part = data[plane, top : top + _TILE]
            part[:] = _tile(seed)[plane][rows[top : top + _TILE]][:, columns] * slope
            part += np.sqrt(
                part * np.float32(noise.shot[plane]) + np.float32(noise.read[plane])
            ) * rng.standard_normal(part.shape, dtype=np.float32)
            span, black = np.float32(camera.span[plane]), np.float32(camera.black_level[plane])
            part[:] = (np.clip(np.rint(part * span + black), 0, camera.white_level) - black) / span
    return RawImage(torch.from_numpy(data), settings, camera)


def _mirrored(count: int) -> np.ndarray:
    index = np.arange(count) % (2 * _TILE)
    return np.where(index < _TILE, index, 2 * _TILE - 1 - index)
