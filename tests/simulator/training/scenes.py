"""Tiny scenes to train on, and a small dataset of them in the layout of the paper's."""

import numpy as np
import torch

from examples.write_sequences import write_packed_sequence
from simulator import CameraSettings, RawImage
from simulator.reference.reference_camera import BodyError, ReferenceCamera, ReferenceScene
from simulator.reference.thin_lens import Lens
from simulator.training.paper_dataset import packed_camera

#: 640 lux is EV100 8: a white card gives 0.663 of sensor white here.
LUX = 640.0
REFERENCE = CameraSettings(100, 1 / 16, 4)

#: All expose a white card to 0.17 to 0.66 of sensor white.
SETTINGS = ((100, 1 / 16, 8), (1600, 1 / 256, 8), (400, 1 / 64, 5.6), (200, 1 / 8, 16))
SETTINGS = tuple(CameraSettings(*values) for values in SETTINGS)


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


def write_dataset(folder, *, sequences=3, size=32):
    """Writes ``scene_NNN/NAME.npy`` and a table beside them."""
    camera = packed_camera("nikon_z6")
    body = ReferenceCamera(camera, body=BodyError.draw(camera, 1))
    for number in range(sequences):
        shown = scene(f"s{number}", size=size, seed=number)
        captures = [body.capture(shown, settings, seed=number) for settings in SETTINGS]
        raws = [RawImage(capture.sample, capture.settings, camera) for capture in captures]
        write_packed_sequence(folder / f"scene_{number:03d}", raws)
    return folder
