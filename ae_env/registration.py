"""Registration with Gymnasium, and the parts of it that both environments need."""

from __future__ import annotations

import functools
import inspect
import json
from collections.abc import Callable
from dataclasses import fields
from typing import Any, ParamSpec

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from ae_env.utils.checks import did_you_mean

P = ParamSpec("P")
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


def names_nearest(init: Callable[P, None]) -> Callable[P, None]:
    """Decorates a constructor: its error for an unknown argument proposes the nearest name.

    The error stays Python's own `TypeError` with its wording, which Gymnasium's consumers look for.
    """
    known = [name for name in inspect.signature(init).parameters if name != "self"]

    @functools.wraps(init)
    def checked(*args: P.args, **kwargs: P.kwargs) -> None:
        for name in kwargs:
            if name not in known:
                raise TypeError(
                    f"{init.__qualname__}() got an unexpected keyword argument {name!r}"
                    f"{did_you_mean(name, known)} (arguments: {', '.join(known)})"
                )
        init(*args, **kwargs)

    return checked


class InProcessSpec(EnvSpec):
    """Spec of an environment with an argument, such as a callable, that JSON cannot hold."""

    def to_json(self) -> str:
        """Raises, and names the argument.

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
    """Mixin for the environments: their ``spec`` says why it cannot become JSON."""

    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """Spec that Gymnasium made the environment from; None if it was constructed directly."""
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
