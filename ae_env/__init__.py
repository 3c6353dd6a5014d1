"""A Gymnasium environment for camera auto-exposure on simulated raw sensor data.

Importing it registers the tasks, such as ``ae_env/AutoExposure-v0``, and loads nothing heavy.
"""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ae_env.registration import register_envs


def _check_simulator() -> None:
    """The packages that are installed together have common names: whose it is is checked."""
    own, spec = Path(__file__).resolve().parents[1] / "simulator", find_spec("simulator")
    found = None if spec is None else next(iter(spec.submodule_search_locations or ()), spec.origin)
    if found is None or Path(found).resolve() != own:
        raise ImportError(
            f"ae-env needs its own package 'simulator' ({own}), but Python finds {found}: "
            "rename the other one, or take its folder off sys.path (PYTHONPATH, the working folder)"
        )


_check_simulator()

from simulator import __version__ as __version__  # noqa: E402  (checked first)

if TYPE_CHECKING:
    from ae_env import lighting as lighting
    from ae_env import wrappers as wrappers
    from ae_env.env import AutoExposureEnv as AutoExposureEnv
    from ae_env.grid import ExposureGrid as ExposureGrid
    from ae_env.lighting import FlickerLighting as FlickerLighting
    from ae_env.lighting import LensCapLighting as LensCapLighting
    from ae_env.lighting import Lighting as Lighting
    from ae_env.lighting import MovingLighting as MovingLighting
    from ae_env.lighting import RampLighting as RampLighting
    from ae_env.lighting import ScheduleLighting as ScheduleLighting
    from ae_env.lighting import SineLighting as SineLighting
    from ae_env.lighting import StepLighting as StepLighting
    from ae_env.lighting import TunnelLighting as TunnelLighting
    from ae_env.lighting import make_lighting as make_lighting
    from ae_env.observation import decode_observation as decode_observation
    from ae_env.observation import decode_sensors as decode_sensors
    from ae_env.observation import decode_settings as decode_settings
    from ae_env.rendering import contact_sheet as contact_sheet
    from ae_env.scenes import Scene as Scene
    from ae_env.scenes import load_scenes as load_scenes
    from ae_env.scorers import Captures as Captures
    from ae_env.scorers import CompositeScorer as CompositeScorer
    from ae_env.scorers import Scorer as Scorer
    from ae_env.scorers import list_scorers as list_scorers
    from ae_env.scorers import make_scorer as make_scorer
    from ae_env.scorers import register_scorer as register_scorer
    from ae_env.scorers.score_table import ScoreTable as ScoreTable
    from ae_env.scorers.score_table import ScoreTables as ScoreTables
    from ae_env.tasks import AutoExposureVideoEnv as AutoExposureVideoEnv
    from ae_env.tasks import AutoExposureVideoVectorEnv as AutoExposureVideoVectorEnv
    from ae_env.tasks import ExposureBracketEnv as ExposureBracketEnv
    from ae_env.tasks import ExposureBracketVectorEnv as ExposureBracketVectorEnv
    from ae_env.utils.user_files import UserCodeError as UserCodeError
    from ae_env.utils.user_files import list_presets as list_presets
    from ae_env.utils.user_files import load_preset as load_preset
    from ae_env.vector_env import AutoExposureVectorEnv as AutoExposureVectorEnv
    from ae_env.wrappers import ContinuousActions as ContinuousActions
    from ae_env.wrappers import ControlActions as ControlActions
    from ae_env.wrappers import RelativeActions as RelativeActions
    from ae_env.wrappers import VectorContinuousActions as VectorContinuousActions
    from ae_env.wrappers import VectorControlActions as VectorControlActions
    from ae_env.wrappers import VectorRelativeActions as VectorRelativeActions

#: Public names by module; those of `_MODULES` are modules themselves.
_NAMES_BY_MODULE = {
    "env": "AutoExposureEnv",
    "grid": "ExposureGrid",
    "lighting": (
        "FlickerLighting LensCapLighting Lighting MovingLighting RampLighting ScheduleLighting "
        "SineLighting StepLighting TunnelLighting make_lighting"
    ),
    "observation": "decode_observation decode_sensors decode_settings",
    "rendering": "contact_sheet",
    "scenes": "Scene load_scenes",
    "scorers": "Captures CompositeScorer Scorer list_scorers make_scorer register_scorer",
    "scorers.score_table": "ScoreTable ScoreTables",
    "tasks": (
        "AutoExposureVideoEnv AutoExposureVideoVectorEnv ExposureBracketEnv "
        "ExposureBracketVectorEnv"
    ),
    "utils.user_files": "UserCodeError list_presets load_preset",
    "vector_env": "AutoExposureVectorEnv",
    "wrappers": (
        "ContinuousActions ControlActions RelativeActions VectorContinuousActions "
        "VectorControlActions VectorRelativeActions"
    ),
}
_EXPORTS = {name: module for module, names in _NAMES_BY_MODULE.items() for name in names.split()}
_MODULES = ("lighting", "wrappers")
__all__ = sorted((*_EXPORTS, *_MODULES))


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(importlib.import_module(f"ae_env.{_EXPORTS[name]}"), name)
    if name in _MODULES:
        return importlib.import_module(f"ae_env.{name}")
    raise AttributeError(f"module 'ae_env' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


register_envs()
