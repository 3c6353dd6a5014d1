"""Pictures in focus whose depth is not told: opening the aperture may not change them.

The middle of every picture of the test split that looks sharp all over, photographed at ISO 100 and
f/8 by the reference camera and opened to f/4; recorded mosaics are taken as they are. The change is
that of the noise-free light against the same with `depth="far"`, root mean square in units of the
source's noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ae_env.scenes.pictures import detail_pictures
from benchmarks.harness import Row, data_root, table
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera
from simulator.noise.generator import noise_generator
from simulator.noise.noise_level_function import noise_variance
from simulator.reference.reference_camera import ReferenceCamera
from simulator.reference.sampling import lens_blur, sample_mosaic
from simulator.training.crops import DetailPicture

CAMERA = "nikon_z6"
SOURCE = CameraSettings(100, 1 / 64, 8)
TARGET = CameraSettings(100, 1 / 256, 4)
#: Side of the crops [packed pixel].
SIZE = 160
#: Change that was asked for, and the share of the pictures that shall stay below it.
ASKED, ASKED_SHARE = 0.1, 0.95
#: Photographs whose middle is partly out of focus, told by eye.
SHALLOW = (
    "buddiesofbudgie_fragrant-chamomile",
    "elementary_Pablo_Garcia_Saldana",
    "elementary_victor-svistunov-233897-KB",
    "getsolus_Twigonometry",
)
_KINDS = ("radiance", "photograph", "mosaic")


def measure(seed: int, quick: bool) -> list[Row]:
    """One row per picture."""
    simulator = CameraSimulator.from_pretrained(device="cpu", cache=None)
    chosen = [
        picture
        for picture in detail_pictures("test", data=data_root(), drawn=0)
        if picture.kind in _KINDS
        and picture.name not in SHALLOW
        and min(picture.light.shape[1:]) >= SIZE * (1 if picture.kind == "mosaic" else 2)
    ]
    return [
        {"part": "in focus", "picture": picture.name, "kind": picture.kind}
        | {"change": _change(simulator, _photographed(picture, seed + number))}
        for number, picture in enumerate(chosen[:: 8 if quick else 1])
    ]


def _photographed(picture: DetailPicture, seed: int) -> RawImage:
    """The middle of a picture as it was recorded, or recorded with half of white as its highlights.

    A recorded mosaic has a noise of its own, which is stated.
    """
    camera, mosaic = get_camera(CAMERA), picture.kind == "mosaic"
    side = SIZE if mosaic else 2 * SIZE
    top, left = ((n - side) // 4 * 2 for n in picture.light.shape[1:])
    light = picture.light[:, top : top + side, left : left + side]
    if mosaic:
        return replace(RawImage(light, SOURCE, camera), nlf=picture.nlf)
    light = sample_mosaic(lens_blur(light))
    exposed = light * (0.5 / max(float(light.quantile(0.99)), 1e-9))
    noisy = ReferenceCamera(camera).record(exposed, SOURCE.iso, noise_generator(seed, 0xF0C5))
    return RawImage(noisy, SOURCE, camera)


def _change(simulator: CameraSimulator, raw: RawImage) -> float:
    unknown, far = (simulator.prepare(raw, depth=d).expected(TARGET) for d in ("unknown", "far"))
    variance = noise_variance(far.clamp(min=0.0), raw.noise)
    return float(((unknown - far).square() / variance).double().mean().sqrt())


def section(rows: list[Row]) -> list[str]:
    """The share that stays, and the pictures that change most."""
    changes = np.array([row["change"] for row in rows])
    if not len(changes):
        return ["Without the real files there is no such picture."]
    most = sorted(rows, key=lambda row: -row["change"])[:8]
    return [
        f"{len(rows)} held-out pictures at ISO 100, f/8 opened to f/4, depth unknown: "
        f"{np.mean(changes < ASKED):.0%} change by less than {ASKED:g} of the noise (asked "
        f"{ASKED_SHARE:.0%}); left out, being partly out of focus: {', '.join(SHALLOW)}. Those "
        "that change most:",
        table(most, {"picture": "{picture}", "kind": "{kind}", "change [noise]": "{change:.2f}"}),
    ]
