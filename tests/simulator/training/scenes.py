"""Tiny scenes to train on."""

import numpy as np
import torch

from simulator import CameraSettings
from simulator.optics.thin_lens import Lens
from simulator.reference.camera import ReferenceScene

#: 640 lux is EV100 8: a white card gives 0.663 of sensor white here.
LUX = 640.0
REFERENCE = CameraSettings(100, 1 / 16, 4)


def scene(name: str = "a", *, size: int = 32, depth: bool = True, seed: int = 0) -> ReferenceScene:
    """Blocks of random reflectance, one half of them behind the plane in focus."""
    rng = np.random.default_rng(seed)
    blocks = rng.uniform(0.03, 0.9, (4, size // 4, size // 4)).repeat(4, 1).repeat(4, 2)
    distance = np.where(np.arange(size) < size // 2, 2.0, 8.0) * np.ones((size, 1))
    return ReferenceScene(
        scene_id=name,
        group=name,
        kind="depth" if depth else "flat",
        light=torch.from_numpy((0.663 * blocks).astype(np.float32)),
        reference=REFERENCE,
        depth=torch.from_numpy(distance.astype(np.float32)) if depth else None,
        lens=Lens(focal_length=0.035, focus_distance=2.0),
        illuminance=LUX,
    )
