"""Radiance maps that the tests of scenes write, and scenes loaded small."""

from pathlib import Path

import numpy as np
import pytest

from ae_env.scenes import Scene, load_scenes
from simulator import get_camera


def load(
    spec: object, split: str = "all", resolution: int | None = 16, **options: object
) -> list[Scene]:
    """Scenes of `spec`, which is a path where there are `options`."""
    camera, spec = get_camera("nikon_z6"), {"path": spec, **options} if options else spec
    return load_scenes(spec, split, camera=camera, resolution=resolution)


def write_hdr(path: Path, seed: int = 0, height: int = 20, width: int = 24) -> None:
    """A random Radiance file; its folder is made."""
    cv2 = pytest.importorskip("cv2")
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.random.default_rng(seed).uniform(0.1, 4.0, (height, width, 3)).astype(np.float32)
    path.write_bytes(cv2.imencode(".hdr", image)[1].tobytes())


def write_exr(path: Path, image: np.ndarray, compression: str = "ZIP") -> None:
    """`image` (H, W, 3) or, grey, (H, W) as OpenEXR."""
    openexr = pytest.importorskip("OpenEXR")
    header = {"compression": getattr(openexr, f"{compression}_COMPRESSION")}
    header["type"] = openexr.scanlineimage
    image = np.ascontiguousarray(np.broadcast_to(np.atleast_3d(image), (*image.shape[:2], 3)))
    with openexr.File(header, {"RGB": image.astype(np.float32)}) as file:
        file.write(str(path))
