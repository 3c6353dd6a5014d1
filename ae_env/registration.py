"""Makes the environments known to Gymnasium."""

from __future__ import annotations

import gymnasium as gym

ENV_IDS = ("ae_env/AutoExposure-v0",)


def register_envs() -> None:
    """Registers every id once; calling it again changes nothing."""
    if ENV_IDS[0] in gym.registry:
        return
    gym.register(
        id=ENV_IDS[0],
        entry_point="ae_env.env:AutoExposureEnv",
        vector_entry_point="ae_env.vector_env:AutoExposureVectorEnv",
        max_episode_steps=8,
    )
