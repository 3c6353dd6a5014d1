"""Scenes between runs: float16 light in the cache folder, the other fields beside it.

Layouts take a byte a pixel: defocus in 127 steps, and a bit for the subject.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import torch

from ae_env.scenes.scene import Scene
from simulator.camera import CameraProfile
from simulator.capture.layout import Layout
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.radiance.procedural import NATIVE_SIZE
from simulator.settings import CameraSettings
from simulator.utils.cache import disk_cache

logger = logging.getLogger(__name__)

_FIELDS = (
    *("scene_id", "group", "illuminance", "white_balance", "kind", "hard", "median_speed"),
    *("box_factor", "source", "sampled"),
)
#: Steps of a stored layout's defocus.
_STEPS = 127


def cached_scenes(
    key: str, make: Callable[[], Iterable[Scene]], camera: CameraProfile, resolution: int | None
) -> list[Scene]:
    """Scenes without noise of `camera`, from the cache where they have been made before.

    All of them have a layout, or none.

    Args:
        key: Of all that they depend on (`simulator.utils.cache.cache_key`).
        make: Makes them, all of one size.
        camera: In whose colours they are.
        resolution: Packed pixels a side; None for `NATIVE_SIZE`.
    """
    loaded = stored_scenes(key, camera, resolution)
    if loaded is None:
        loaded = [rounded(scene) for scene in make()]
        store_scenes(key, loaded)
    return loaded


def stored_scenes(key: str, camera: CameraProfile, resolution: int | None) -> list[Scene] | None:
    """Those in the cache, None if there are none; arguments as of `cached_scenes`."""
    return _from_tensors(disk_cache().get(key), camera, resolution)


def store_scenes(key: str, scenes: list[Scene]) -> None:
    """Puts scenes, `rounded`, into the cache; see `cached_scenes`."""
    if scenes:
        disk_cache().put(key, _to_tensors(scenes))


def rounded(scene: Scene) -> Scene:
    """The scene rounded as in the cache, so that a cached run equals a fresh one."""
    layout = None if scene.layout is None else _from_bytes(_to_bytes(scene.layout))
    light = scene.light.clamp(max=65504.0).half().float()
    return replace(scene, light=light, layout=layout)


def _to_bytes(layout: Layout) -> torch.Tensor:
    """(H, W) uint8: the defocus, and 128 where the subject is."""
    found = (layout.defocus * _STEPS).round().byte()
    return found if layout.subject is None else found + 128 * layout.subject.byte()


def _from_bytes(stored: torch.Tensor) -> Layout:
    return Layout((stored % 128).float() / _STEPS, stored >= 128)


def _to_tensors(scenes: list[Scene]) -> dict[str, torch.Tensor]:
    rows = []
    for scene in scenes:
        row = {name: getattr(scene, name) for name in _FIELDS}
        reference = scene.reference
        rows.append(
            row | {"reference": (reference.iso, reference.exposure_time, reference.f_number)}
        )
    text = np.frombuffer(json.dumps(rows).encode(), np.uint8)
    light = torch.stack([scene.light for scene in scenes]).half()
    layouts = [_to_bytes(scene.layout) for scene in scenes if scene.layout is not None]
    tensors = {"light": light, "rows": torch.from_numpy(text.copy())}
    return tensors | ({"layouts": torch.stack(layouts)} if layouts else {})


def _from_tensors(
    tensors: dict[str, torch.Tensor] | None, camera: CameraProfile, resolution: int | None
) -> list[Scene] | None:
    """The scenes of `_to_tensors`; None if there are none, or they cannot be those asked for."""
    if tensors is None:
        return None
    try:
        rows, light = json.loads(tensors["rows"].numpy().tobytes()), tensors["light"]
        side = NATIVE_SIZE if resolution is None else resolution
        if light.shape != (len(rows), 4, side, side):
            raise ValueError(f"{len(rows)} scenes of {side} x {side} have light {light.shape}")
        stored = tensors.get("layouts")
        layouts = [None] * len(rows) if stored is None else map(_from_bytes, stored)
        return [  # `Scene` checks the values
            Scene(
                light=own.float(),
                reference=CameraSettings(*row.pop("reference")),
                camera=camera,
                nlf=NoiseLevelFunction.zero(),
                layout=layout,
                **row,
            )
            for row, own, layout in zip(rows, light, layouts, strict=True)
        ]
    except (ValueError, KeyError, TypeError) as error:
        logger.warning("the cached scenes are damaged (%s) and are made again", error)
        return None
