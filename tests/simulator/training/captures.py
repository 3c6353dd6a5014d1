"""A small dataset in the layout of the paper's, photographed by the reference camera."""

import csv
from pathlib import Path

from simulator import CameraSettings, RawImage
from simulator.reference.camera import BodyError, ReferenceCamera
from simulator.training.paper_dataset import PARAMETERS, packed_camera, write_packed_sequence
from tests.simulator.training.scenes import scene

#: All expose a white card to 0.17 to 0.66 of sensor white.
SETTINGS = (
    CameraSettings(100, 1 / 16, 8),
    CameraSettings(1600, 1 / 256, 8),
    CameraSettings(400, 1 / 64, 5.6),
    CameraSettings(200, 1 / 8, 16),
)


def write_dataset(folder: Path, *, sequences: int = 3, size: int = 32, body: int = 1) -> Path:
    """Writes ``camera_params.csv`` and ``scene_NNN/NAME.npy`` as the authors' script does."""
    camera = packed_camera("nikon_z6")
    reference = ReferenceCamera(camera, body=BodyError.draw(camera, body))
    rows: list[list[str]] = []
    for number in range(sequences):
        photographed = scene(f"s{number}", size=size, seed=number)
        raws = [
            RawImage(reference.capture(photographed, s, seed=number).sample, s, camera)
            for s in SETTINGS
        ]
        own = folder / f"scene_{number:03d}"
        write_packed_sequence(own, raws)
        with (own / PARAMETERS).open(newline="") as stream:
            head, *captures = csv.reader(stream)
        rows += [*([head] if not rows else []), *captures]
        (own / PARAMETERS).unlink()
    with (folder / PARAMETERS).open("w", newline="") as stream:
        csv.writer(stream).writerows(rows)
    return folder
