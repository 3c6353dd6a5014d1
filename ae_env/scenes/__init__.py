"""Scenes, which the camera photographs: bundled ones, folders of raws and of radiance maps."""

from ae_env.scenes.load import SceneSpec, load_scenes
from ae_env.scenes.scene import Scene
from simulator.radiance.light import MEAN_SIGNAL, WHITE_SIGNAL, reference_settings

__all__ = ["MEAN_SIGNAL", "WHITE_SIGNAL", "Scene", "SceneSpec", "load_scenes", "reference_settings"]
