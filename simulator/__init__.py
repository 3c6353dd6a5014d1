"""Light and sensors: what a raw photograph becomes at other camera settings."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from simulator.camera import BayerPattern as BayerPattern
    from simulator.camera import CameraProfile as CameraProfile
    from simulator.camera import get_camera as get_camera
    from simulator.camera import list_cameras as list_cameras
    from simulator.camera_simulator import CameraSimulator as CameraSimulator
    from simulator.capture.plan import SimulationPlan as SimulationPlan
    from simulator.capture.prepared_scene import PreparedScene as PreparedScene
    from simulator.noise.noise_level_function import NoiseLevelFunction as NoiseLevelFunction
    from simulator.optics.thin_lens import Lens as Lens
    from simulator.optics.thin_lens import defocus as defocus
    from simulator.raw.develop import develop as develop
    from simulator.raw.develop import render_srgb as render_srgb
    from simulator.raw.dng import write_dng as write_dng
    from simulator.raw.image import RawImage as RawImage
    from simulator.raw.noise_estimation import estimate_nlf as estimate_nlf
    from simulator.raw.read import RawFileError as RawFileError
    from simulator.raw.read import read_raw as read_raw
    from simulator.settings import CameraSettings as CameraSettings
    from simulator.settings import exposure_ratio as exposure_ratio
    from simulator.settings import incident_ev100 as incident_ev100
    from simulator.settings import sensor_signal as sensor_signal

#: Version of the three packages, which are installed together.
__version__ = "0.2.0"

#: Module of each public name; loaded when the name is first used, so that importing is fast.
_MODULES = {
    "camera": ["BayerPattern", "CameraProfile", "get_camera", "list_cameras"],
    "camera_simulator": ["CameraSimulator"],
    "capture.plan": ["SimulationPlan"],
    "capture.prepared_scene": ["PreparedScene"],
    "noise.noise_level_function": ["NoiseLevelFunction"],
    "optics.thin_lens": ["Lens", "defocus"],
    "raw.develop": ["develop", "render_srgb"],
    "raw.dng": ["write_dng"],
    "raw.image": ["RawImage"],
    "raw.noise_estimation": ["estimate_nlf"],
    "raw.read": ["RawFileError", "read_raw"],
    "settings": ["CameraSettings", "exposure_ratio", "incident_ev100", "sensor_signal"],
}

__all__ = sorted(name for names in _MODULES.values() for name in names)


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            value = getattr(importlib.import_module(f"simulator.{module}"), name)
            globals()[name] = value  # found directly from now on
            return value
    raise AttributeError(f"module 'simulator' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
