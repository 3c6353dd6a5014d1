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

from simulator.utils.checks import did_you_mean

P = ParamSpec("P")
#: The tasks: module and class, for one episode and for many, and the actions after which an episode
#: is truncated; None where episodes end by themselves.
TASKS: dict[str, tuple[str, str, int | None]] = {
    "ae_env/AutoExposure-v0": (
        "ae_env.env:AutoExposureEnv",
        "ae_env.vector_env:AutoExposureVectorEnv",
        8,
    ),
    "ae_env/AutoExposureVideo-v0": (
        "ae_env.video:AutoExposureVideoEnv",
        "ae_env.video:AutoExposureVideoVectorEnv",
        96,
    ),
    "ae_env/ExposureBracket-v0": (
        "ae_env.bracket:ExposureBracketEnv",
        "ae_env.bracket:ExposureBracketVectorEnv",
        None,
    ),
}
ENV_IDS = tuple(TASKS)


def register_envs() -> None:
    """Registers every id once; calling it again changes nothing."""
    for name, (entry_point, vector_entry_point, steps) in TASKS.items():
        if name not in gym.registry:
            gym.register(
                id=name,
                entry_point=entry_point,
                vector_entry_point=vector_entry_point,
                max_episode_steps=steps,
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


def with_defaults(init: Callable[..., None], **defaults: Any) -> Callable[..., None]:
    """The constructor `init` with other defaults, for a task that is the same environment.

    Its signature shows them.
    """
    signature = inspect.signature(init)
    parameters = [
        given.replace(default=defaults.get(name, given.default))
        for name, given in signature.parameters.items()
    ]

    @functools.wraps(init)
    def made(self: Any, *args: Any, **kwargs: Any) -> None:
        init(self, *args, **{**defaults, **kwargs})

    made.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    return made


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
