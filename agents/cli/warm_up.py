"""``ae-env warm-up``: what a first run would wait for, done beforehand."""

from __future__ import annotations

from typing import Any

from agents.cli.console import console, progress_bars

#: Environments whose first frames need all compiled code between them.
_CASES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("AutoExposure-v0", {}),
    ("AutoExposure-v0", {"observation": "statistics"}),
    ("AutoExposure-v0", {"observation": "linear", "lighting": "flicker"}),
    ("AutoExposure-v0", {"observation": "dn", "noise": "exact"}),
    ("AutoExposure-v0", {"noise": "sensor", "camera": "canon_5d4", "scenes": "bundled:small"}),
    ("AutoExposure-v0", {"split": "test", "source": "raw"}),
    ("AutoExposureVideo-v0", {}),
    ("ExposureBracket-v0", {}),
)


def warm_up() -> None:
    """Compile the simulator and draw the bundled scenes, as a container's build would.

    Both are kept: the code beside the sources or in NUMBA_CACHE_DIR, the scenes in AE_ENV_CACHE.

    Example: `ae-env warm-up`
    """
    import gymnasium as gym
    import numpy as np

    with progress_bars() as progress, progress("warming up") as task:
        for done, (name, arguments) in enumerate(_CASES):
            task(done, len(_CASES), ", ".join([name, *map(str, arguments.values())]))
            envs = gym.make_vec(f"ae_env:ae_env/{name}", num_envs=16, **arguments)
            list(envs.unwrapped.scenes)  # type: ignore[attr-defined]  # draws every one
            envs.reset(seed=0)
            for _ in range(4):
                envs.step(np.arange(16))
            envs.close()
        task(len(_CASES), len(_CASES))
    console.print("try next: ae-env quickstart")
