"""A Gymnasium environment for camera auto-exposure on simulated raw sensor data.

Importing it registers ``ae_env/AutoExposure-v0`` and loads nothing heavy.
"""

from __future__ import annotations

import importlib
from typing import Any

from ae_env.registration import register_envs

_EXPORTS = {
    "AutoExposureEnv": "env",
    "AutoExposureVectorEnv": "vector_env",
    "ExposureGrid": "grid",
    "Scene": "scenes",
    "ScoreTables": "scorers.score_table",
    "contact_sheet": "rendering",
    "decode_observation": "observation",
    "list_presets": "utils.presets",
    "list_scorers": "scorers",
    "load_preset": "utils.presets",
    "load_scenes": "scenes",
    "make_scorer": "scorers",
    "register_scorer": "scorers",
}
__all__ = sorted(_EXPORTS)
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(importlib.import_module(f"ae_env.{_EXPORTS[name]}"), name)
    raise AttributeError(f"module 'ae_env' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, *globals()]


register_envs()
