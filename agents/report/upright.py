"""Developed pictures as they are looked at: upright, with square pixels."""

from __future__ import annotations

import numpy as np
import torch
from PIL import Image

from simulator import RawImage
from simulator.raw.develop import quarter_turns


def upright_picture(raw: RawImage, srgb: torch.Tensor) -> Image.Image:
    """`srgb` (3, H, W) uint8, a picture of `raw`, turned as its camera was held.

    Where the sensor's pixels are not square, it grows along their longer side: none is left out.
    """
    picture = Image.fromarray(srgb.permute(1, 2, 0).cpu().numpy())
    aspect = raw.metadata.get("pixel_aspect", 1.0)
    if aspect != 1.0:
        size = round(picture.width * max(aspect, 1)), round(picture.height / min(aspect, 1))
        picture = picture.resize(size, Image.Resampling.BICUBIC)
    upright = np.rot90(np.asarray(picture), quarter_turns(raw))
    return Image.fromarray(np.ascontiguousarray(upright))
