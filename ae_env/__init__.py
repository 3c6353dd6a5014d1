"""A Gymnasium environment for camera auto-exposure on simulated raw sensor data.

Importing it registers the tasks, such as ``ae_env/AutoExposure-v0``, and loads nothing heavy.
"""

from importlib.util import find_spec
from pathlib import Path

import lazy_loader

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

# A name of the stub is loaded when it is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

register_envs()
