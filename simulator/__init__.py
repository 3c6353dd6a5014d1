"""Light and sensors: what a raw photograph becomes at other camera settings."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

_EXPORTS = {
    "BayerPattern": "camera",
    "CameraProfile": "camera",
    "CameraSettings": "settings",
    "CameraSimulator": "camera_simulator",
    "PreparedScene": "capture.prepared_scene",
    "NoiseLevelFunction": "camera",
    "RawImage": "raw.image",
    "SimulationPlan": "capture.plan",
    "develop": "raw.develop",
    "estimate_nlf": "raw.noise_estimation",
    "exposure_ratio": "settings",
    "get_camera": "camera",
    "incident_ev100": "settings",
    "list_cameras": "camera",
    "read_raw": "raw.read",
    "render_srgb": "raw.develop",
    "sensor_signal": "settings",
    "write_dng": "raw.dng",
}
__all__ = sorted(_EXPORTS)

if TYPE_CHECKING:
    from simulator.camera import BayerPattern as BayerPattern
    from simulator.camera import CameraProfile as CameraProfile
    from simulator.camera import NoiseLevelFunction as NoiseLevelFunction
    from simulator.camera import get_camera as get_camera
    from simulator.camera import list_cameras as list_cameras
    from simulator.camera_simulator import CameraSimulator as CameraSimulator
    from simulator.capture.plan import SimulationPlan as SimulationPlan
    from simulator.capture.prepared_scene import PreparedScene as PreparedScene
    from simulator.raw.develop import develop as develop
    from simulator.raw.develop import render_srgb as render_srgb
    from simulator.raw.dng import write_dng as write_dng
    from simulator.raw.image import RawImage as RawImage
    from simulator.raw.noise_estimation import estimate_nlf as estimate_nlf
    from simulator.raw.read import read_raw as read_raw
    from simulator.settings import CameraSettings as CameraSettings
    from simulator.settings import exposure_ratio as exposure_ratio
    from simulator.settings import incident_ev100 as incident_ev100
    from simulator.settings import sensor_signal as sensor_signal


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(importlib.import_module(f"simulator.{_EXPORTS[name]}"), name)
    raise AttributeError(f"module 'simulator' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, *globals()]
