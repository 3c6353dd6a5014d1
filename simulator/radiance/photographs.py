"""scikit-image's photographs, unprocessed to scene-linear light.

Only files inside scikit-image's wheel are used: nothing is downloaded, nothing redistributed.
"""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources

import numpy as np
from PIL import Image

from simulator.radiance.light import temperature_tint
from simulator.radiance.procedural import NATIVE_SIZE, Drawing, Range, draw_lux

#: Scenes made of each photograph: crops, mirrored or not, under lights of their own.
SCENES_PER_PHOTOGRAPH = 3
#: Displayed level from which a pixel counts as clipped by the camera that took it.
_CLIPPED = 0.97


@dataclass(frozen=True)
class Photograph:
    """A photograph inside scikit-image's wheel."""

    name: str  # there, and of its source group
    file: str  # in ``skimage/data``
    split: str  # "train" or "test"
    illuminance: Range  # of the light assumed for it [lux]
    tint: Range  # of the light's colour, see `temperature_tint`
    credit: str  # photographer or institution and licence, as scikit-image states them

    @property
    def scene_ids(self) -> list[str]:
        """Names of the scenes made of it."""
        return [f"{self.name}-{index}" for index in range(SCENES_PER_PHOTOGRAPH)]


PHOTOGRAPHS = (
    Photograph(
        "astronaut", "astronaut.png", "train", (30, 3000), (-0.1, 0.5), "NASA, public domain"
    ),
    Photograph("chelsea", "chelsea.png", "test", (20, 5000), (0.0, 0.8), "S. van der Walt, CC0"),
    Photograph("coffee", "coffee.png", "train", (10, 2000), (0.0, 1.1), "R. Michetti, CC0"),
    Photograph("rocket", "rocket.jpg", "test", (100, 20_000), (-0.1, 0.2), "SpaceX, public domain"),
    Photograph("camera", "camera.png", "train", (500, 60_000), (-0.1, 0.2), "L. Varshney, CC0"),
    Photograph("brick", "brick.png", "train", (300, 100_000), (-0.1, 0.3), "CC0Textures, CC0"),
    Photograph("gravel", "gravel.png", "train", (300, 100_000), (-0.1, 0.3), "CC0Textures, CC0"),
    Photograph("grass", "grass.png", "test", (300, 100_000), (-0.1, 0.2), "linolafett, CC0"),
    Photograph(
        *("coins", "coins.png", "test", (20, 2000), (0.0, 0.8)),
        "Brooklyn Museum, no known copyright restrictions",
    ),
)


def photograph_drawings(photograph: Photograph) -> Iterator[Drawing]:
    """The scenes made of one photograph, 256 x 256 pixels each, and the light assumed for them.

    The first is the middle of the picture, the others are cut and mirrored at random (by a seed
    that depends on the name alone).
    """
    rng = np.random.default_rng(zlib.crc32(photograph.name.encode()))
    light = unprocess(read_photograph(photograph.file), rng)
    height, width = light.shape[1:]
    for index in range(SCENES_PER_PHOTOGRAPH):
        top, left = (height - NATIVE_SIZE) // 2, (width - NATIVE_SIZE) // 2
        if index:
            top = int(rng.integers(0, height - NATIVE_SIZE + 1))
            left = int(rng.integers(0, width - NATIVE_SIZE + 1))
        crop = light[:, top : top + NATIVE_SIZE, left : left + NATIVE_SIZE]
        if index and rng.random() < 0.5:
            crop = crop[:, :, ::-1]
        illuminance = draw_lux(rng, *photograph.illuminance)
        tint = temperature_tint(rng.uniform(*photograph.tint))
        yield Drawing(np.ascontiguousarray(crop), illuminance, tint)


def unprocess(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """An 8-bit sRGB photograph as linear light on the reflectance scale.

    1. Dither: uniform noise of one code is added, so that dark areas have no steps.
    2. The inverse of a mild S-shaped tone curve, ``0.5 - sin(asin(1 - 2 y) / 3)`` (Brooks et al.
       2019, Unprocessing images for learned raw denoising, section 3.2).
    3. The inverse sRGB curve (IEC 61966-2-1).
    4. Clipped highlights: where the photograph is at 0.97 of white or above, the light is raised
       by a factor drawn once per photograph from 1 to 2**2.5, fading in between 0.97 and 1.

    `image` is (H, W, 3) or (H, W) uint8; the result (3, H, W) float32, at least 0, 1.0 at the
    photograph's white and above in the highlights.
    """
    colour = image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)
    codes = colour[:, :, :3].transpose(2, 0, 1).astype(np.float64)
    shown = np.clip((codes + rng.uniform(-0.5, 0.5, codes.shape)) / 255.0, 0.0, 1.0)
    flat = 0.5 - np.sin(np.arcsin(1.0 - 2.0 * shown) / 3.0)
    linear = np.where(flat <= 0.04045, flat / 12.92, ((flat + 0.055) / 1.055) ** 2.4)
    blown = np.clip((shown.max(axis=0) - _CLIPPED) / (1.0 - _CLIPPED), 0.0, 1.0) ** 2
    return np.asarray((linear * np.exp2(blown * rng.uniform(0.0, 2.5))).astype(np.float32))


def read_photograph(name: str) -> np.ndarray:
    """The pixels of a picture in ``skimage/data``, by its file name: uint8, (H, W, 3) or (H, W)."""
    file = resources.files("skimage.data").joinpath(name)
    if not file.is_file():
        raise FileNotFoundError(
            f"scikit-image is installed without {name!r} in skimage/data, which the bundled scenes "
            "need; install scikit-image from its wheel (pip install --force-reinstall scikit-image)"
        )
    with file.open("rb") as stream, Image.open(stream) as picture:
        return np.asarray(picture)
