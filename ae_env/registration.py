"""Registration with Gymnasium, and the parts of it that both environments need."""

import json
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

#: The tasks: the name that their classes begin with, for one episode ``...Env`` and for many
#: ``...VectorEnv``, and the actions after which an episode is truncated; None where it ends itself.
TASKS: dict[str, tuple[str, int | None]] = {
    "ae_env/AutoExposure-v0": ("AutoExposure", 8),
    "ae_env/AutoExposureVideo-v0": ("AutoExposureVideo", 96),
    "ae_env/ExposureBracket-v0": ("ExposureBracket", None),
}


def register_envs() -> None:
    """Registers every id once; calling it again changes nothing."""
    for name, (begin, steps) in TASKS.items():
        if name not in gym.registry:
            gym.register(
                id=name,
                entry_point=f"ae_env:{begin}Env",
                vector_entry_point=f"ae_env:{begin}VectorEnv",
                max_episode_steps=steps,
            )


class InProcessSpec(EnvSpec):
    """Spec of an environment with an argument, such as a callable, that JSON cannot hold."""

    def to_json(self) -> str:
        """Raises a `ValueError` that names the argument."""
        for name, value in self.kwargs.items():
            if not is_json(value):
                raise ValueError(
                    f"`{name}` (={value!r}) works in this process only and cannot be written as "
                    f"JSON: give its name instead, as in {name}='package.module:attribute'"
                )
        return super().to_json()


def is_json(value: Any) -> bool:
    """Whether JSON can hold `value`."""
    try:
        json.dumps(value)
    except (TypeError, ValueError):
        return False
    return True
