"""Scenes loaded small, and the files that tests make: radiance maps, and recorded grids.

The grids are photographed by the reference camera and written in the three layouts.
"""

import csv
import functools

import numpy as np
import pytest
from PIL import ExifTags, Image

from ae_env.grid import ExposureGrid
from ae_env.scenes import load_scenes
from simulator import CameraSettings, RawImage, get_camera, write_dng
from simulator.raw.develop import develop
from simulator.reference.reference_camera import ReferenceCamera
from tests.simulator.training.scenes import scene

#: Eight states over seven stops; at the middle ones a white card is at about half of white.
GRID = ExposureGrid((100, 1600), (1 / 1000, 1 / 125), (4, 8))


def load(spec, split="all", resolution=16, **options):
    """Scenes of `spec`, which is a path where there are `options`."""
    camera, spec = get_camera("nikon_z6"), {"path": spec, **options} if options else spec
    return load_scenes(spec, split, camera=camera, resolution=resolution)


def write_hdr(path, seed=0, image=None):
    """`image` (H, W, 3), or a random one, as a Radiance file; its folder is made."""
    cv2 = pytest.importorskip("cv2")
    path.parent.mkdir(parents=True, exist_ok=True)
    if image is None:
        image = np.random.default_rng(seed).uniform(0.1, 4.0, (20, 24, 3))
    path.write_bytes(cv2.imencode(".hdr", image[..., ::-1].astype(np.float32))[1].tobytes())


def write_exr(path, image, compression="ZIP"):
    """`image` (H, W, 3) or, grey, (H, W) as OpenEXR."""
    openexr = pytest.importorskip("OpenEXR")
    header = {"compression": getattr(openexr, f"{compression}_COMPRESSION")}
    header["type"] = openexr.scanlineimage
    image = np.ascontiguousarray(np.broadcast_to(np.atleast_3d(image), (*image.shape[:2], 3)))
    with openexr.File(header, {"RGB": image.astype(np.float32)}) as file:
        file.write(str(path))


@functools.lru_cache
def capture(settings: CameraSettings, seed: int = 0, size: int = 40) -> RawImage:
    """A capture of the scene `seed`, `size` packed pixels a side."""
    camera = get_camera("nikon_z6")
    photographed = scene(f"s{seed}", size=size, seed=seed)
    sample = ReferenceCamera(camera).capture(photographed, settings, seed).sample
    return RawImage(sample, settings, camera)


def write_picture(path, settings, seed=0, *, exif=()):
    """The developed capture as a JPEG or PNG; of its settings, those named stand in its EXIF."""
    rgb = develop(capture(settings, seed).data[None].clamp(0.0, 1.0))[0]
    picture = Image.fromarray((rgb * 255.0).round().byte().permute(1, 2, 0).numpy())
    tags = {
        "iso": (ExifTags.Base.ISOSpeedRatings, int(settings.iso)),
        "exposure_time": (ExifTags.Base.ExposureTime, settings.exposure_time),
        "f_number": (ExifTags.Base.FNumber, settings.f_number),
    }
    stated = Image.Exif()
    stated.get_ifd(ExifTags.IFD.Exif).update(tags[name] for name in exif)
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.save(path, exif=stated)


def write_raws(folder, grid=tuple(GRID), seed=0):
    """One scene: a DNG for each state, which its EXIF states."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, settings in enumerate(grid):
        write_dng(folder / f"IMG_{number:04d}.dng", capture(settings, seed))


def write_states(folder, seeds=(0, 1), grid=GRID):
    """As ImageNet-ES: ``l1/param_3/CLASS/PICTURE.JPEG``, and its table of the states."""
    names = {seed: f"n{seed:08d}/val_{seed}.JPEG" for seed in seeds}
    rows = []
    for number, settings in enumerate(grid, start=1):
        time = '0"4' if settings.exposure_time == 0.4 else f"1/{round(1 / settings.exposure_time)}"
        rows.append([0, f"{number}.0", f"{settings.iso:.0f}", time, f"f{settings.f_number:.1f}"])
        for seed, name in names.items():
            write_picture(folder / "l1" / f"param_{number}" / name, settings, seed)
    with (folder / "grid-options-2x2x2.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([["", "idx", "iso", "ss", "aperture"], *rows])


def write_video(folder, frames=3, times=("1-1000s", "1-250s", "1-60s")):
    """Stacks of video: ``SCENE/frame_0002/1-60s.png`` at ISO 400 and f/4, every frame another."""
    for frame in range(frames):
        for time in times:
            top, bottom = time.removesuffix("s").split("-")
            settings = CameraSettings(400, float(top) / float(bottom), 4)
            write_picture(folder / "street" / f"frame_{frame:04d}" / f"{time}.png", settings, frame)
