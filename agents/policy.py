"""The interface of a policy, and how a name such as ``matrix:P?compensation=-1`` becomes one."""

from __future__ import annotations

import difflib
import importlib
import inspect
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from numpy.typing import NDArray

from ae_env.utils.user_files import find_attribute, load_from_file
from simulator.utils.checks import did_you_mean

if TYPE_CHECKING:
    import gymnasium as gym

    from ae_env.grid import ExposureGrid
    from simulator.camera import CameraProfile

Observations = Mapping[str, NDArray[Any]]

#: Light meters that weigh pixels or zones.
CLASSIC_METERS = ("average", "centre_weighted", "matrix", "spot")
#: All light meters; those after the classic ones look at the histogram or at gradients.
METERS = (*CLASSIC_METERS, "highlight_weighted", "skewness", "entropy", "shim", "zhang")
#: The programs that nothing has to be learnt for, and all.
MANUAL_PROGRAMS = ("P", "A", "S", "M")
PROGRAMS = (*MANUAL_PROGRAMS, "tuned", "tuned_blind")
#: A controller with a meter of its own, modelled on a camera's.
RPI_AGC = "rpi_agc"
#: Agents that come with the package: the training seeds of ``ae-env bench agents``.
PRETRAINED = Path(__file__).parent / "pretrained"
PRETRAINED_SEEDS = (0, 1, 2)
#: What follows the colon in the name of an agent that was trained for `AutoExposureVideo-v0`.
VIDEO = "video"
#: Forecasters of light that come with the package, and what asks for them.
FORECASTERS, LEARNT = str(PRETRAINED / "forecaster-*"), "learnt"

_RECORDED = "recorded"
#: Module and class by name; imported when the policy is made.
_SIMPLE = {
    "best_fixed": ("agents.baselines", "BestFixed"),
    "random": ("agents.baselines", "Random"),
}
#: The oracle, and what it may know.
_ORACLE, _KNOWN = "oracle", ("last_frame", "clairvoyant")
_LEARNT = {
    "ppo": ("agents.learning.ppo", "PPOPolicy"),
    "regression": ("agents.learning.regression", "RegressionPolicy"),
}
_WITH_WEIGHTS = {**_LEARNT, "bracket": ("agents.bracketing.learnt", "LearntBracket")}
#: Policies of `ExposureBracket-v0`; `bracket` alone or with a path is the learnt one.
_BRACKET = "bracket"
_BRACKETS = {"fixed": "FixedBracket", "hasinoff": "Hasinoff", "planned": "Planner"}
#: Where options begin: a question mark before a slash of a path is a part of the path.
_OPTIONS = re.compile(r"\?(?![^=]*/)")
_FRACTION = re.compile(r"\s*([+-]?\d+(?:\.\d+)?)\s*/\s*(\d+(?:\.\d+)?)\s*")


@dataclass(frozen=True)
class BracketLimits:
    """What the frames of an episode of `ExposureBracket-v0` may take together.

    Args:
        budget: Time [s].
        max_frames: How many there may be.
        box_factor: Photosites averaged a side into one pixel, which the noise depends on.
    """

    budget: float
    max_frames: int
    box_factor: int


@dataclass(frozen=True)
class PolicyContext:
    """The camera that a policy drives.

    Args:
        grid: The exposure states; an action is an index into it.
        camera: The camera body.
        observation_space: Observation of a single environment (a `Dict` with ``raw``,
            ``settings`` and, where the camera has them, ``sensors``).
        frame_rate: Frames per second.
        delays: Frames after the next until a decision's ISO, exposure time and aperture are in
            effect.
        bracket: Limits of a bracket; None for tasks without one.
    """

    grid: ExposureGrid
    camera: CameraProfile
    observation_space: gym.spaces.Dict
    frame_rate: float = 30.0
    delays: tuple[int, int, int] = (0, 0, 0)
    bracket: BracketLimits | None = None

    @classmethod
    def from_envs(cls, envs: gym.vector.VectorEnv[Any, Any, Any]) -> PolicyContext:
        """The context of the environments that `envs` runs."""
        base: Any = envs.unwrapped
        limits = None
        if hasattr(base, "budget"):
            limits = BracketLimits(base.budget, base.max_frames, base.scenes[0].box_factor)
        space = base.single_observation_space
        return cls(base.grid, base.camera, space, delays=base.delays, bracket=limits)

    @property
    def has_sensors(self) -> bool:
        """Whether the observation tells image speed and defocus spread."""
        return "sensors" in self.observation_space.spaces


class Policy:
    """Base class of everything that chooses exposures, for a batch of cameras at once.

    A policy is causal: `act` sees the frames so far and nothing else. Override `reset` (call it
    through `super`) and `act`; override `fit` where the policy has something to learn from the
    training scenes. Per-camera memory lives in arrays of length `num_envs`.

    Args:
        context: The camera, the grid and the observation.
    """

    #: Only a privileged policy's `act` gets ``info=`` as well; its scores are upper bounds.
    privileged: bool = False
    #: Frames a policy takes for one decision (a bracketing policy takes more).
    captures_per_decision: float = 1.0

    def __init__(self, context: PolicyContext) -> None:
        self.context = context
        self.num_envs = 0
        self.name = type(self).__name__

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forget the past: the next observations begin new episodes of `num_envs` cameras."""
        self.num_envs = num_envs

    def check_reset(self, observations: Observations) -> None:
        """Raises a `ValueError` unless `reset` was called for as many cameras as are observed."""
        count = len(observations["raw"])
        if count != self.num_envs:
            raise ValueError(
                f"policy {self.name!r} keeps {self.num_envs} cameras in mind, `observations` are "
                f"of {count}: call reset(num_envs) first"
            )

    def act(
        self, observations: Observations, action_masks: NDArray[np.bool_] | None = None
    ) -> NDArray[np.int64]:
        """Choose the next frame's state for each camera.

        Args:
            observations: Arrays with a leading axis of `num_envs`.
            action_masks: ``(num_envs, len(grid))``, False where a state is not allowed.

        Returns:
            Indices into the grid, int64, shape ``(num_envs,)``.
        """
        raise NotImplementedError(f"{type(self).__name__} must implement `act`")

    def fit(self, envs: gym.vector.VectorEnv[Any, Any, Any], seed: int = 0) -> None:
        """Learn from the training scenes of `envs`; called once, before evaluation."""


def masked_argmax(
    utility: NDArray[np.floating], action_masks: NDArray[np.bool_] | None
) -> NDArray[np.int64]:
    """Index of the highest allowed utility per row, ties to the lower index.

    >>> masked_argmax(np.array([[1.0, 3.0, 2.0]]), np.array([[True, False, True]]))
    array([2])
    """
    if action_masks is not None:
        utility = np.where(action_masks, utility, -np.inf)
    best: NDArray[np.int64] = np.argmax(utility, axis=-1).astype(np.int64)
    return best


# -- names ----------------------------------------------------------------------------------------


def list_policies() -> list[str]:
    """Names of the built-in policies that need no file."""
    metering = [f"{m}:{p}" for m in METERS for p in PROGRAMS]
    oracles = [f"{_ORACLE}:{knows}" for knows in _KNOWN]
    agc = [f"{RPI_AGC}:{p}" for p in MANUAL_PROGRAMS]
    video = [f"{agent}:{VIDEO}" for agent in _LEARNT]
    return sorted([*_SIMPLE, *_LEARNT, *video, *oracles, *metering, *agc])


def is_metering(name: str) -> bool:
    """Whether `name`, with or without a program and options, is that of a metering policy.

    >>> is_metering("spot?compensation=1"), is_metering("rpi_agc:A"), is_metering("random")
    (True, True, False)
    """
    return split_options(name)[0].partition(":")[0] in (*METERS, RPI_AGC)


def training_seeds(name: str) -> list[str]:
    """The names under which `make_policy` knows the training seeds of a learnt agent.

    Args:
        name: ``"ppo"``, ``"regression"`` or ``"bracket"`` for all seeds that come with the package;
            ``"ppo:video"`` or ``"regression:video"`` for those of `AutoExposureVideo-v0`;
            ``"ppo:runs/ppo-*"`` for the files that match; anything else stands for itself. Options
            of the name are those of each; with ``ensemble=true`` they decide together, as one.

    Raises:
        ValueError: If no file matches a pattern.

    >>> [name.rpartition("-")[2] for name in training_seeds("ppo")], training_seeds("spot:P")
    (['0', '1', '2'], ['spot:P'])
    """
    base, mark, options = str(name).partition("?")
    head, _, tail = base.partition(":")
    if (
        head not in _WITH_WEIGHTS
        or is_ensemble(name)
        or (tail not in ("", VIDEO) and "*" not in tail)
    ):
        return [name]
    files = weight_files(_shipped(head, tail) + "*" if tail in ("", VIDEO) else tail)
    if not files:
        raise ValueError(f"`policy` (={name!r}): no .safetensors file fits {tail!r}")
    return [f"{head}:{file}{mark}{options}" for file in files]


def is_ensemble(name: str) -> bool:
    """Whether `name` asks for all trainings of a learnt agent as one agent."""
    return split_options(name)[1].get("ensemble") is True


def weight_files(pattern: str) -> list[str]:
    """Names, without suffix, of the .safetensors files that fit `pattern`, sorted."""
    path = Path(pattern).expanduser()
    found = sorted(path.parent.glob(f"{path.name.removesuffix('.safetensors')}.safetensors"))
    return [str(file.with_suffix("")) for file in found]


def _shipped(head: str, tail: str) -> str:
    """The beginning of the names of weights that come with the package."""
    return str(PRETRAINED / (f"{tail}-{head}-" if tail else f"{head}-"))


def split_class(base: str) -> tuple[str, str]:
    """Head and tail of a policy's name without options: around the colon before a class.

    >>> split_class("matrix:P"), split_class("C:/my.py:Mine"), split_class("random")
    (('matrix', 'P'), ('C:/my.py', 'Mine'), ('random', ''))
    """
    head, _, tail = base.rpartition(":") if ".py:" in base else base.partition(":")
    return head, tail


def split_options(name: str) -> tuple[str, dict[str, Any]]:
    """A policy's name without its options, and the options.

    Args:
        name: A name, or a name, ``?`` and options ``key=value`` with ``&`` between them. Values are
            YAML scalars; a fraction such as ``1/60`` is a number too.

    Raises:
        ValueError: If `name` is not a text, an option has no value or a value that is no scalar, or
            one is given twice.

    >>> split_options("centre_weighted:P?compensation=-1&shutter_cap=1/50")
    ('centre_weighted:P', {'compensation': -1, 'shutter_cap': 0.02})
    >>> split_options("ppo:runs/mine")
    ('ppo:runs/mine', {})
    """
    if not isinstance(name, str):
        raise ValueError(f"`policy` (={name!r}) must be a name, such as 'matrix:P'")
    # A folder may have a question mark in its name, a class may not.
    mark = _OPTIONS.search(name, max(name.find(".py:"), 0))
    if mark is None:
        return name, {}
    start = mark.start()
    options: dict[str, Any] = {}
    for part in name[start + 1 :].split("&"):
        key, equals, text = part.partition("=")
        key = key.strip()
        if not equals or not key.isidentifier():
            raise ValueError(
                f"`policy` (={name!r}): options are written name?key=value&key=value, not {part!r}"
            )
        if key in options:
            raise ValueError(f"`policy` (={name!r}): option {key!r} is given twice")
        options[key] = _scalar(name, key, text)
    return name[:start], options


def _scalar(name: str, key: str, text: str) -> Any:
    fraction = _FRACTION.fullmatch(text)
    if fraction and float(fraction[2]) > 0:
        return float(fraction[1]) / float(fraction[2])
    try:
        # No alias can be in it: "&", which an anchor begins with, ends an option.
        value = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError):
        value = {}
    if isinstance(value, str):
        try:  # YAML 1.1 takes 1e-3 for a text
            value = float(value)
        except ValueError:
            return value
    if not (value is None or isinstance(value, bool | int | float)):
        raise ValueError(f"`policy` (={name!r}): option {key!r} (={text!r}) must be a YAML scalar")
    return value


# -- from a name to a policy ----------------------------------------------------------------------


def make_policy(
    name: str, context: PolicyContext, *, device: str = "cpu", **options: Any
) -> Policy:
    """The policy called `name`.

    Args:
        name: ``"random"``, ``"best_fixed"``; ``"oracle"``, alone or with what it knows, such as
            ``"oracle:clairvoyant"``; a meter and a program such as
            ``"centre_weighted:P"`` (the program defaults to P); ``"rpi_agc"``, alone or with a
            program; ``"recorded:FOLDER"``; ``"regression"`` and ``"ppo"``, the
            agents that come with the package, ``"regression:video"`` and ``"ppo:video"``, those for
            `AutoExposureVideo-v0`, or ``"regression:PATH"`` and ``"ppo:PATH"`` with weights of
            one's own; for `ExposureBracket-v0` ``"bracket:fixed"``, ``"bracket:hasinoff"``,
            ``"bracket:planned"``, and ``"bracket"`` or ``"bracket:PATH"``, the learnt one;
            ``"package.module:Class"`` or ``"path/to/file.py:Class"`` for a policy of one's own.
            Options may follow: ``"centre_weighted:P?compensation=-1&damping=0.5"``.
        context: The camera.
        device: Torch device of a learnt agent's network.
        options: Passed to the class, with those of the name.

    Raises:
        ValueError: If there is no such policy, its file cannot be loaded (the cause is chained),
            the class found is not a policy or does not take an option.
    """
    base, named = split_options(name)
    for key in options:
        if key in named:
            raise ValueError(f"`policy` (={name!r}): option {key!r} is given twice")
    options |= named
    head, tail = split_class(base)
    fixed: dict[str, Any] = {}  # arguments that the name itself gives
    if head.endswith(".py"):
        cls = load_from_file(head, tail, f"`policy` (={name!r})", example="MyPolicy")
    elif head in _SIMPLE and not tail:
        cls = _import(*_SIMPLE[head])
    elif head == _ORACLE and tail in ("", *_KNOWN):
        cls = _import("agents.baselines", "Oracle")
        fixed = {"knows": tail} if tail else {}
    elif head in METERS and tail in ("", *PROGRAMS):
        cls = _import("agents.metering.metering_policy", "MeteringPolicy")
        fixed = {"meter": head, "program": tail or "P"}
    elif head == RPI_AGC and tail in ("", *MANUAL_PROGRAMS):
        cls = _import("agents.metering.rpi_agc", "RpiAgc")
        fixed = {"program": tail or "P"}
    elif head == _RECORDED:
        cls = _import("agents.baselines", "Recorded")
        fixed = {"path": tail}
    elif head == _BRACKET and tail in _BRACKETS:
        cls = _import("agents.bracketing.policies", _BRACKETS[tail])
    elif head in _WITH_WEIGHTS:
        cls = _import(*_WITH_WEIGHTS[head])
        options = _with_weights(name, head, tail, device, options)
    elif tail and head not in (*METERS, *_SIMPLE, RPI_AGC, _ORACLE):
        cls = _class_in_module(head, tail, name)
    else:
        raise ValueError(_unknown(base))
    policy = _construct(cls, _as_written(name), context, options, fixed)
    if named:
        policy.name = name
    return policy


def _as_written(name: str) -> str:
    """`name` for messages: agents that come with the package are known by no path."""
    base, mark, options = str(name).partition("?")
    head, _, tail = base.partition(":")
    for kind in ("", VIDEO):
        if head in _WITH_WEIGHTS and tail.startswith(_shipped(head, kind)):
            return f"{head}{f':{kind}' if kind else ''}{mark}{options}"
    return name


def _import(module: str, name: str) -> Any:
    return getattr(importlib.import_module(module), name)


def _with_weights(
    name: str, head: str, tail: str, device: str, options: dict[str, Any]
) -> dict[str, Any]:
    """`options` of a learnt agent with its weights, where no network is given."""
    together = options.get("ensemble") is True
    if "*" in tail and not together:
        raise ValueError(
            f"`policy` (={name!r}) is a pattern, so several agents: it is for evaluations; "
            "`training_seeds` lists the names of the single ones"
        )
    if "network" in options:
        return options
    weights = tail
    if tail in ("", VIDEO):
        weights = f"{_shipped(head, tail)}{'*' if together else PRETRAINED_SEEDS[0]}"
    return {"weights": weights, "device": device, **options}


def _class_in_module(module: str, name: str, policy: str) -> Any:
    if not all(part.isidentifier() for part in module.split(".")):
        raise ValueError(_unknown(policy))
    try:
        loaded = importlib.import_module(module)
    except Exception as error:  # the user's module runs, and may raise anything
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing is not None and (module == missing or module.startswith(f"{missing}.")):
            raise ValueError(f"{_unknown(policy)} (there is no module {missing!r})") from None
        raise ValueError(_broken(policy, f"{module} cannot be imported", error)) from error
    return find_attribute(loaded, name, f"`policy` (={policy!r})")


def _construct(
    cls: Any, name: str, context: PolicyContext, options: dict[str, Any], fixed: dict[str, Any]
) -> Policy:
    """A `cls` with `options` of the caller's and those that the name has `fixed`."""
    if not inspect.isclass(cls):
        raise ValueError(f"`policy` (={name!r}) must name a class")
    missing = [m for m in ("reset", "act") if not callable(getattr(cls, m, None))]
    if not missing and issubclass(cls, Policy) and cls.act is Policy.act:
        missing = ["act"]
    if missing:
        methods = " and ".join(f"`{m}`" for m in missing)
        raise ValueError(
            f"`policy` (={name!r}): {cls.__name__} is not a policy, it has no {methods}; "
            "derive it from agents.Policy"
        )
    _check_task(cls, name, context)
    _check_options(cls, name, options, fixed)
    options = {**fixed, **options}
    try:
        inspect.signature(cls).bind(context, **options)
    except TypeError as error:
        raise ValueError(
            f"`policy` (={name!r}): {cls.__name__} does not take (context"
            f"{''.join(f', {key}=' for key in options)}): {error}"
        ) from None
    try:
        policy: Policy = cls(context, **options)
    except Exception as error:  # a user's constructor may raise anything
        if not cls.__module__.startswith("agents."):
            message = _broken(name, f"{cls.__name__} cannot be made", error)
            raise ValueError(message) from error
        if isinstance(error, ValueError) and "?" in name:
            raise ValueError(f"`policy` (={name!r}): {error}") from error
        if str(error).startswith("`weights`"):  # which the name gave
            raise type(error)(f"`policy` (={name!r}): {error}") from error
        raise  # our own errors say which argument is wrong
    return policy


def _check_task(cls: Any, name: str, context: PolicyContext) -> None:
    """Raises a `ValueError` if `cls` is one of ours for single frames and the task is brackets."""
    if context.bracket is None or not cls.__module__.startswith("agents."):
        return
    if not cls.__module__.startswith("agents.bracketing.") and cls.__name__ != "Random":
        kinds = ", ".join(f"{_BRACKET}:{kind}" for kind in _BRACKETS)
        raise ValueError(
            f"`policy` (={name!r}) is not for ae_env/ExposureBracket-v0: take random, {_BRACKET}, "
            f"{kinds} or one of your own"
        )


def _check_options(cls: Any, name: str, options: dict[str, Any], fixed: dict[str, Any]) -> None:
    """Raises a `ValueError` if `cls` does not take one of the `options`."""
    parameters = list(inspect.signature(cls).parameters.values())[1:]  # the first is the context
    if any(p.kind is p.VAR_KEYWORD for p in parameters):
        return
    known = [p.name for p in parameters if p.kind is not p.VAR_POSITIONAL and p.name not in fixed]
    for option in options:
        if option not in known:
            takes = f"it takes {', '.join(known)}" if known else "it takes none"
            raise ValueError(
                f"`policy` (={name!r}): {cls.__name__} does not take the option {option!r}; "
                f"{takes}{did_you_mean(option, known)}"
            )


def _unknown(name: str) -> str:
    known = [*METERS, RPI_AGC, *list_policies(), *(f"{t}:PATH" for t in (*_LEARNT, _RECORDED))]
    known += [_BRACKET, *(f"{_BRACKET}:{kind}" for kind in _BRACKETS)]
    near = difflib.get_close_matches(str(name), known, n=1, cutoff=0.5)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return (
        f"`policy` (={name!r}) must be one of {', '.join((*_SIMPLE, _ORACLE))}; a meter "
        f"({', '.join(METERS)}), alone or with a program ({', '.join(f':{p}' for p in PROGRAMS)}); "
        f"{RPI_AGC}, alone or with {', '.join(f':{p}' for p in MANUAL_PROGRAMS)}; "
        f"{_RECORDED}:FOLDER; regression or ppo, alone or with :{VIDEO} or :PATH; {_BRACKET}, "
        f"alone or with {', '.join(f':{kind}' for kind in _BRACKETS)} or :PATH; "
        f"package.module:Class or path.py:Class{hint}"
    )


def _broken(policy: str, what: str, error: BaseException) -> str:
    return f"`policy` (={policy!r}): {what}: {type(error).__name__}: {error}"
