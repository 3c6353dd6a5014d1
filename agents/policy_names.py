"""Names of policies: how ``matrix:P?compensation=-1`` or ``my.py:Mine`` becomes a policy."""

import importlib
import inspect
import re
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import yaml

from ae_env.utils.user_files import find_attribute, load_from_file
from agents.policy import Policy, PolicyContext
from simulator.utils.checks import did_you_mean
from simulator.utils.config_file import MAX_LENGTH

#: Light meters: those that weigh pixels or zones, and all; others look at histograms or gradients.
CLASSIC_METERS = ("average", "centre_weighted", "matrix", "spot")
METERS = (*CLASSIC_METERS, "highlight_weighted", "skewness", "entropy", "shim", "zhang")
#: The programs that nothing has to be learnt for, and all.
MANUAL_PROGRAMS = ("P", "A", "S", "M")
PROGRAMS = (*MANUAL_PROGRAMS, "tuned", "tuned_blind")
#: Agents that come with the package, a file for each training seed.
PRETRAINED = Path(__file__).parent / "pretrained"
#: Forecasters of light that come with the package, and the word that asks for them.
FORECASTERS, LEARNT = str(PRETRAINED / "forecaster-*"), "learnt"

#: The learnt agents, and classes whose names take a file after the colon, with the
#: argument that it is.
LEARNT_AGENTS = ("ppo", "regression")
WITH_FILE = {
    "ppo": ("agents.learning.ppo:PPOPolicy", "weights"),
    "regression": ("agents.learning.regression:RegressionPolicy", "weights"),
    "recorded": ("agents.baselines:Recorded", "path"),
}
#: Files of the agents that come with the package, without ``-SEED``.
_SHIPPED = {
    f"{agent}{task}": f"{PRETRAINED}/{prefix}{agent}"
    for task, prefix in (("", ""), (":video", "video-"))
    for agent in LEARNT_AGENTS
}
#: The built-in policies: class, imported when a policy is made, and arguments that the name gives.
_POLICIES: dict[str, tuple[str, dict[str, Any]]] = {
    "random": ("agents.baselines:Random", {}),
    "best_fixed": ("agents.baselines:BestFixed", {}),
    "oracle:last_frame": ("agents.baselines:Oracle", {"knows": "last_frame"}),
    "oracle:clairvoyant": ("agents.baselines:Oracle", {"knows": "clairvoyant"}),
    **{f"rpi_agc:{p}": ("agents.metering.rpi_agc:RpiAgc", {"program": p}) for p in MANUAL_PROGRAMS},
    **{
        f"{m}:{p}": ("agents.metering.metering_policy:MeteringPolicy", {"meter": m, "program": p})
        for m in METERS
        for p in PROGRAMS
    },
    **{
        name: (WITH_FILE[name.partition(":")[0]][0], {"weights": f"{file}-0"})
        for name, file in _SHIPPED.items()
    },
}
#: Likewise of `ExposureBracket-v0`.
_BRACKETS: dict[str, tuple[str, dict[str, Any]]] = {
    "bracket": ("agents.bracketing.policies:Planner", {"blur": True}),
    "bracket:planned": ("agents.bracketing.policies:Planner", {"blur": False}),
    "bracket:fixed": ("agents.bracketing.policies:FixedBracket", {}),
    "bracket:hasinoff": ("agents.bracketing.policies:Hasinoff", {}),
}
#: What shorter names stand for.
_SHORT = {"oracle": "oracle:last_frame", "rpi_agc": "rpi_agc:P", **{m: f"{m}:P" for m in METERS}}
#: What the built-in policies do, as `ae-env policies` lists them.
ABOUT = {
    "random": "a random allowed state for every frame; scores 0 by definition",
    "best_fixed": "the state with the best mean score on the training scenes",
    "oracle": "privileged: the best state for the light of the last frame",
    "oracle:clairvoyant": "privileged: the best state for the light of the frames to come",
    "average": "meter: the mean of the frame",
    "centre_weighted": "meter: 75 % in a circle of half the frame's height, 25 % around it",
    "spot": "meter: a central circle of 4 % of the area",
    "matrix": "meter: 5 x 5 zones, corrected for the brightest 2 % of the pixels",
    "highlight_weighted": "meter: puts the brightest 1 % at 0.9 of white",
    "skewness": "meter: makes the histogram symmetric about an 18 % card",
    "entropy": "meter: seeks the highest entropy of the histogram",
    "shim": "meter: seeks most gradient information (Shim et al. 2014)",
    "zhang": "meter: seeks the highest soft percentile of the gradient (Zhang et al. 2017)",
    "METER:P": "program, the default: a shutter and aperture without blur, then a low gain",
    "METER:A": "program: f/8; then a shutter without blur, then the lowest ISO",
    "METER:S": "program: 1/125 s; then the lowest ISO",
    "METER:M": "program: f/8 and 1/125 s; the ISO follows the meter",
    "METER:tuned": "program: the best state on training scenes for the EV, motion and defocus",
    "METER:tuned_blind": "program: the same for the EV alone",
    "rpi_agc": "libcamera's AGC of the Raspberry Pi; also with :A, :S and :M",
    "regression": "trained agent: predicts the score of every state; regression:PATH is yours",
    "ppo": "trained agent: PPO; ppo:PATH is yours",
    "regression:video": "the same for AutoExposureVideo-v0",
    "ppo:video": "PPO for AutoExposureVideo-v0, with the last twelve readings",
    "recorded:FOLDER": "frame k takes the state nearest to raw k of a folder",
    "bracket": "ExposureBracket-v0: plans again after each frame, and counts blur",
    "bracket:planned": "likewise, without blur",
    "bracket:fixed": "likewise: the metered exposure, and steps above and below it",
    "bracket:hasinoff": "likewise: the largest worst-case SNR (Hasinoff et al. 2010)",
}
#: Where options begin: a question mark before a slash of a path is a part of the path.
_OPTIONS = re.compile(r"\?(?![^=]*/)")


def list_policies() -> list[str]:
    """Names of the built-in policies of single frames that need no file."""
    return sorted(_POLICIES)


def default_options(name: str) -> dict[str, Any]:
    """Options that may follow the built-in policy called `name`, and their defaults."""
    known = _parameters(*_find(name, name))
    return {key: p.default for key, p in known.items() if key not in ("network", "device")}


def is_metering(name: str) -> bool:
    """Whether `name` is that of a metering policy.

    >>> is_metering("spot?compensation=1"), is_metering("rpi_agc:A"), is_metering("random")
    (True, True, False)
    """
    return split_options(name)[0].partition(":")[0] in (*METERS, "rpi_agc")


def training_seeds(name: str) -> list[str]:
    """The names under which `make_policy` knows the training seeds of a learnt agent.

    ``"ppo"`` or ``"regression"``, alone or with ``":video"``, stands for all seeds of the package,
    ``"ppo:runs/ppo-*"`` for the files that match (if none, a `ValueError`), any other for itself.

    >>> [name.rpartition("-")[2] for name in training_seeds("ppo")], training_seeds("spot:P")
    (['0', '1', '2'], ['spot:P'])
    """
    base, _ = split_options(name)
    head, _, tail = base.partition(":")
    if (agent := base.removesuffix(":")) in _SHIPPED:
        pattern = f"{_SHIPPED[agent]}-*"
    elif head in LEARNT_AGENTS and "*" in tail:
        pattern = tail
    else:
        return [name]
    if not (files := weight_files(pattern)):
        raise _refusal(name, f": no .safetensors file fits {pattern!r}")
    return [f"{head}:{file}{name[len(base) :]}" for file in files]


def weight_files(pattern: str) -> list[str]:
    """Names, without suffix, of the .safetensors files that fit `pattern`, sorted."""
    path = Path(pattern).expanduser()
    found = sorted(path.parent.glob(f"{path.name.removesuffix('.safetensors')}.safetensors"))
    return [str(file.with_suffix("")) for file in found]


def split_class(base: str) -> tuple[str, str]:
    """Head and tail of a policy's name without options: around the colon before a class.

    >>> split_class("matrix:P"), split_class("C:/my.py:Mine"), split_class("random")
    (('matrix', 'P'), ('C:/my.py', 'Mine'), ('random', ''))
    """
    head, _, tail = base.rpartition(":") if ".py:" in base else base.partition(":")
    return head, tail


def split_options(name: str) -> tuple[str, dict[str, Any]]:
    """A policy's name without its options, and the options.

    They are ``key=value`` after a ``?`` with ``&`` between them, as in a URL. Values are YAML
    scalars; a fraction such as ``1/60`` is a number too. A `ValueError` if an option has no value
    or a value that is no scalar, or is given twice.

    >>> split_options("centre_weighted:P?compensation=-1&shutter_cap=1/50")
    ('centre_weighted:P', {'compensation': -1, 'shutter_cap': 0.02})
    """
    if not isinstance(name, str):
        raise _refusal(name, " must be a name, such as 'matrix:P'")
    # A folder may have a question mark in its name, a class may not.
    mark = _OPTIONS.search(name, max(name.find(".py:"), 0))
    if mark is None:
        return name, {}
    query = name[mark.end() :].replace("+", "%2B")  # a plus is a sign here, not a space
    options: dict[str, Any] = {}
    try:
        pairs = parse_qsl(query or "&", keep_blank_values=True, strict_parsing=True)
    except ValueError as error:
        raise _refusal(name, f": options are name?key=value&key=value: {error}") from None
    for key, text in pairs:
        if key.strip() in options:
            raise _refusal(name, f": option {key!r} is given twice")
        options[key.strip()] = _scalar(name, key, text)
    return name[: mark.start()], options


def _scalar(name: str, key: str, text: str) -> Any:
    try:
        value = yaml.safe_load(text) if len(text) <= MAX_LENGTH else {}
    except (yaml.YAMLError, ValueError, RecursionError):
        value = {}
    if isinstance(value, str):
        numerator, slash, denominator = value.partition("/")
        try:  # YAML 1.1 takes 1/60 and 1e-3 for texts
            return float(numerator) / (float(denominator) if slash else 1.0)
        except (ValueError, ZeroDivisionError):
            return value
    if not (value is None or isinstance(value, bool | int | float)):
        raise _refusal(name, f": option {key!r} (={text!r}) must be a YAML scalar")
    return value


def make_policy(
    name: str, context: PolicyContext, *, device: str = "cpu", **options: Any
) -> Policy:
    """The policy called `name`.

    A `ValueError` if there is no such policy, its file cannot be loaded (the cause is chained), the
    class found is not a policy or does not take an option.

    Args:
        name: One of `list_policies`, where a meter's program defaults to P; ``"recorded:FOLDER"``;
            ``"regression:PATH"`` or ``"ppo:PATH"``, weights of one's own; ``"bracket"``,
            ``"bracket:planned"``, ``"bracket:fixed"`` or ``"bracket:hasinoff"`` for
            `ExposureBracket-v0`; ``"package.module:Class"`` or ``"path/to/file.py:Class"``. Options
            may follow: ``"centre_weighted:P?compensation=-1&damping=0.5"``.
        context: The camera that it drives, see `PolicyContext.from_envs`.
        device: Torch device of a learnt agent's network.
        options: Passed to the class, with those of the name.
    """
    base, named = split_options(name)
    base = base.removesuffix(":")
    for key in set(options) & set(named):
        raise _refusal(name, f": option {key!r} is given twice")
    cls, fixed = _find(name, base)
    options |= named
    if "weights" in fixed:
        fixed = {} if "network" in options else {**fixed, "device": device}
    _check_class(name, cls, context)
    _check_options(name, cls, options, fixed)
    try:
        policy: Policy = cls(context, **fixed, **options)
    except Exception as error:  # a user's constructor may raise anything
        if not cls.__module__.startswith("agents."):
            text = f": {cls.__name__} cannot be made: {type(error).__name__}: {error}"
            raise _refusal(name, text) from error
        if not isinstance(error, ValueError | FileNotFoundError):
            raise
        kind = ValueError if isinstance(error, ValueError) else FileNotFoundError
        raise kind(*_refusal(name, f": {error}").args) from error
    if named:
        policy.name = name
    return policy


def check_policy(name: str) -> None:
    """Raises a `ValueError` unless there is a policy called `name` that takes its options."""
    base, options = split_options(one := training_seeds(name)[0])
    cls, fixed = _find(one, base.removesuffix(":"))
    if inspect.isclass(cls):
        _check_options(one, cls, options, fixed)


def _find(name: str, base: str) -> tuple[Any, dict[str, Any]]:
    """The class of a policy, and the arguments that `base`, the `name` without options, gives."""
    found = (_POLICIES | _BRACKETS).get(_SHORT.get(base, base))
    head, tail = split_class(base)
    if found is None and head in WITH_FILE:
        path, argument = WITH_FILE[head]
        if "*" in tail and argument == "weights":
            raise _refusal(name, " is a pattern, so several agents: `training_seeds` lists them")
        found = path, {argument: tail}
    if found is not None:
        module, _, cls = found[0].partition(":")
        return getattr(importlib.import_module(module), cls), found[1]
    if head.endswith(".py"):
        return load_from_file(head, tail, f"`policy` (={name!r})", example="MyPolicy"), {}
    built_in = {known.partition(":")[0] for known in (*_POLICIES, *_BRACKETS)}
    if head in built_in or not all(part.isidentifier() for part in (*head.split("."), tail)):
        raise _refusal(name, _known(base, head))
    try:
        loaded = importlib.import_module(head)
    except Exception as error:  # the user's module runs, and may raise anything
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing is not None and f"{head}.".startswith(f"{missing}."):
            text = _known(base, head)
            text += "" if head in text else f" (there is no module {missing!r})"
            raise _refusal(name, text) from None
        text = f": {head} cannot be imported: {type(error).__name__}: {error}"
        raise _refusal(name, text) from error
    return find_attribute(loaded, tail, f"`policy` (={name!r})"), {}


def _check_class(name: str, cls: Any, context: PolicyContext) -> None:
    if not inspect.isclass(cls):
        raise _refusal(name, " must name a class")
    own = [(m, getattr(cls, m, None)) for m in ("reset", "act")]
    if missing := [m for m, found in own if not callable(found) or found is Policy.act]:
        text = f": {cls.__name__} is not a policy, it has no {' and '.join(missing)}"
        raise _refusal(name, f"{text}; derive it from agents.Policy")
    of_frames = cls.__module__.startswith("agents.") and cls.__name__ != "Random"
    if context.bracket is not None and of_frames and "agents.bracketing." not in cls.__module__:
        others = f"random, {', '.join(_BRACKETS)} or one of your own"
        raise _refusal(name, f" is not for ae_env/ExposureBracket-v0: take {others}")


def _check_options(name: str, cls: Any, options: dict[str, Any], fixed: dict[str, Any]) -> None:
    known = _parameters(cls, fixed)
    if any(p.kind is p.VAR_KEYWORD for p in known.values()):
        return
    for option in set(options) - set(known):
        takes = [one for one in known if one not in ("network", "device")]  # a name gives neither
        text = f"{option!r}; it takes {', '.join(takes) or 'none'}{did_you_mean(option, takes)}"
        raise _refusal(name, f": {cls.__name__} does not take the option {text}")


def _parameters(cls: Any, fixed: dict[str, Any]) -> dict[str, inspect.Parameter]:
    """Those of a policy's class by name, without the context and what its name has `fixed`."""
    found = list(inspect.signature(cls).parameters.values())[1:]
    return {p.name: p for p in found if p.kind is not p.VAR_POSITIONAL and p.name not in fixed}


def _known(base: str, head: str) -> str:
    """What a name may be, for an error about the unknown `base`, which begins with `head`."""
    if head in (*METERS, "rpi_agc"):
        known = [f"{head}:{p}" for p in (PROGRAMS if head in METERS else MANUAL_PROGRAMS)]
        return f" must be one of {', '.join(known)}{did_you_mean(base, known, cutoff=0.9)}"
    files = [f"{head}:{argument.upper()}" for head, (_, argument) in WITH_FILE.items()]
    path = re.search(r"[./\\]", head)  # which no built-in name has
    names = [*_SHORT, *_POLICIES, *files, *_BRACKETS]
    hint = did_you_mean(base, names, cutoff=0.6 if path else 0.5)
    own = "package.module:Class or path.py:Class"
    if path:
        return f": there is no module and no Python file {head!r}; one of your own is {own}{hint}"
    return f" must be one that `ae-env policies` lists, {own}{hint}"


def _refusal(policy: Any, text: str) -> ValueError:
    for agent, file in _SHIPPED.items() if isinstance(policy, str) else ():
        own = rf"{agent.partition(':')[0]}:{re.escape(file)}-\d+(?=\?|$)"
        policy = re.sub(f"^{own}", agent, policy)  # without the path
    return ValueError(f"`policy` (={policy!r}){text}")
