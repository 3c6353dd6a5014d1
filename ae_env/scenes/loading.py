"""`load_scenes`: from what a user names to a list of scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ae_env.scenes.bundled import Split, bundled_scenes
from ae_env.scenes.scene import Crop, Scene
from simulator.camera import CameraProfile


def load_scenes(
    spec: str | Path | Sequence[Scene] | Mapping[str, Any],
    split: Split = "train",
    *,
    camera: CameraProfile,
    resolution: int | None = 64,
    crop: Crop = "box",
) -> list[Scene]:
    """The scenes that `spec` names."""
    if split not in ("train", "test", "all"):
        raise ValueError(f"`split` (={split!r}) must be 'train', 'test' or 'all'")
    if spec in ("bundled", "bundled:small"):
        return bundled_scenes(split, camera, resolution, crop, small=spec == "bundled:small")
    if isinstance(spec, Sequence) and not isinstance(spec, str):
        return [scene.resized(resolution, crop) for scene in spec]
    raise ValueError(f"`scenes` (={spec!r}) is not known")
