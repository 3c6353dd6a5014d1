"""Makes the environments known to Gymnasium, and keeps their specs honest."""

from __future__ import annotations

import json
from dataclasses import fields
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

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


class InProcessSpec(EnvSpec):
    """Spec of an environment with an argument, such as a callable, that JSON cannot hold."""

    def to_json(self) -> str:
        """Refuses, naming the argument.

        Raises:
            ValueError: Always.
        """
        for name, value in self.kwargs.items():
            if not _is_json(value):
                raise ValueError(
                    f"`{name}` (={value!r}) works in this process only and cannot be written as "
                    f"JSON: give its name instead, as in {name}='package.module:attribute'"
                )
        return super().to_json()


class SpecProperty:
    """Mixin for the environments: their ``spec`` says clearly why it cannot become JSON."""

    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """What Gymnasium made the environment from; None if it was constructed directly."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None and not _is_json(spec.kwargs):
            known = {f.name: getattr(spec, f.name) for f in fields(spec) if f.init}
            spec = InProcessSpec(**known)
        self._spec = spec


def _is_json(value: Any) -> bool:
    try:
        json.dumps(value)
    except (TypeError, ValueError):
        return False
    return True
