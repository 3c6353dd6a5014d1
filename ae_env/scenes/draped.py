"""Real and procedural pictures draped over procedural depth.

Dead leaves have texture everywhere; real pictures also have smooth surfaces with sharp edges, and a
map of defocus that was trained on leaves alone takes the smooth ones for blurred. A picture that is
in focus throughout, laid over a depth of its own, shows what defocus does to such surfaces.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import torch

from ae_env.scenes.depth import FOCAL_LENGTH, draw_depth, lens_and_depth
from ae_env.scenes.reference import FOCUS_CYCLE, packed_pitch, sharpened
from simulator.camera import CameraProfile
from simulator.reference import DRAPED, Lens, ReferenceScene


def draped_scenes(
    scenes: Iterable[ReferenceScene], camera: CameraProfile, *, copies: int = 2, seed: int = 0
) -> Iterator[ReferenceScene]:
    """`copies` of each scene without depth, each over another depth, in its source group.

    Photographs are left out: they have defocus of their own, and nobody knows how much.

    Args:
        scenes: What to drape; those with depth, and photographs, are passed over.
        camera: Whose pixels blur is stated in.
        copies: Depths per scene; every third has everything in focus.
        seed: Of the depths.
    """
    number = 0
    for given in scenes:
        if given.depth is not None or given.kind == "photograph":
            continue
        scene = sharpened(given)
        for copy in range(copies):
            focus = FOCUS_CYCLE[number % len(FOCUS_CYCLE)]
            number += 1
            rng = np.random.default_rng([zlib.crc32(scene.scene_id.encode()), seed, copy])
            height, width = scene.light.shape[1:]
            drawn = draw_depth(rng, max(height, width), focus)
            blur = drawn.blur[:height, :width]
            distance, depth = lens_and_depth(blur, drawn.far, packed_pitch(camera))
            yield replace(
                scene,
                scene_id=f"{scene.scene_id}-draped-{copy}",
                kind=DRAPED,
                depth=torch.from_numpy(depth),
                lens=Lens(FOCAL_LENGTH, distance),
            )
