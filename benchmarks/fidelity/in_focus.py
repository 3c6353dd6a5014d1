"""Pictures in focus whose depth is not told: opening the aperture may not change them.

Views into radiance maps, photographs and recorded mosaics of the test split that are in focus
throughout, photographed at ISO 100 and f/8 by the reference camera and opened to f/4. The change is
that of the noise-free light against the same with ``depth="far"``, root mean square in units of the
source's noise.
"""

from __future__ import annotations

import numpy as np

from benchmarks.fidelity.models import equal_exposure
from benchmarks.harness import Row, cropped, data_root, table
from simulator import CameraSimulator, RawImage, get_camera
from simulator.noise.noise_level_function import noise_variance
from simulator.reference.reference_camera import ReferenceCamera
from simulator.training.scenes import mosaic_scenes, reference_scenes

ISO, F_SOURCE, F_TARGET = 100, 8.0, 4.0
#: Height and width [packed pixel], at most.
SIZE = 160
#: Change that was asked for, and the share of the pictures that shall stay below it.
ASKED, ASKED_SHARE = 0.1, 0.95
#: Its letters are blurred over five pixels.
_OUT_OF_FOCUS = "CRW_0118"
_SHARE = f"""pictures = {{pictures}} | change by less than {ASKED:g} of the noise = {{small:.1%}} |
asked = {{asked:.0%}}"""


def measure(seed: int, quick: bool) -> list[Row]:
    simulator = CameraSimulator.from_pretrained(device="cpu", cache=None)
    camera, data, rows = get_camera("nikon_z6"), data_root(), []
    scenes = list(reference_scenes("test", camera, number=0, data=data))
    if data is not None:
        scenes += mosaic_scenes("test", camera, data)
    sharp = (scene for scene in scenes if scene.depth is None and scene.in_focus)
    chosen = [scene for scene in sharp if scene.scene_id != _OUT_OF_FOCUS]
    for number, scene in enumerate(chosen[:: 8 if quick else 1]):
        scene = cropped(scene, SIZE, SIZE)
        source, target = (equal_exposure(scene.reference, ISO, f) for f in (F_SOURCE, F_TARGET))
        sample = ReferenceCamera(camera).capture(scene, source, seed + number).sample
        raw = RawImage(sample, source, camera)
        unknown = simulator.prepare(raw, depth="unknown").expected(target)
        far = simulator.prepare(raw, depth="far").expected(target)
        variance = noise_variance(far.clamp(min=0.0), raw.noise)
        change = float(((unknown - far).square() / variance).double().mean().sqrt())
        row: Row = {"part": "in focus", "picture": scene.scene_id, "kind": scene.kind}
        rows.append(row | {"change": change})
    return rows


def tables(rows: list[Row]) -> dict[str, str]:
    small = np.mean([row["change"] < ASKED for row in rows])
    share = {"pictures": len(rows), "small": small, "asked": ASKED_SHARE}
    most = sorted(rows, key=lambda row: -row["change"])[:8]
    columns = "picture = {picture} | kind = {kind} | change [noise] = {change:.2f}"
    return {"in-focus": table([share], _SHARE), "most-changed": table(most, columns)}
