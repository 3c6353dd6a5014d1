"""Rewards that are tasks: the ladder of codes over EV, ISO and motion, and a trained agent."""

from __future__ import annotations

from dataclasses import replace

from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.scene import Split
from simulator import CameraProfile

#: Ladders that are drawn into each view of the training places.
DRAWS = 4


def training_scenes(split: Split, camera: CameraProfile, resolution: int) -> list[Scene]:
    return [
        replace(scene, scene_id=f"{scene.scene_id}-{seed}")
        for seed in range(DRAWS)
        for scene in load_scenes(
            f"polyhaven?codes={seed}", split, camera=camera, resolution=resolution
        )
    ]
