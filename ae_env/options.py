"""The arguments of the environments: checked in one place, and made into objects."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from functools import cached_property
from typing import Any, Literal, ParamSpec, TypedDict, get_args

import torch

from ae_env.grid import ExposureGrid
from ae_env.lighting import Lighting, MovingLighting, make_lighting
from ae_env.observation import SETTINGS_RANGES
from ae_env.scenes import Scene, SceneSpec
from ae_env.scenes.load import DEFAULT_SIMULATOR as DEFAULT_SIMULATOR
from ae_env.scenes.load import check_weights, environment_scenes
from ae_env.scenes.recorded import RecordedOptions
from ae_env.scenes.scene import Crop as Crop
from ae_env.scenes.scene import SceneSet
from ae_env.scenes.scene import Split as Split
from ae_env.scorers import CompositeScorer, Scorer, make_scorer
from simulator.camera import CameraProfile, get_camera
from simulator.capture.limits import DEFAULT_TOLERANCE as DEFAULT_TOLERANCE
from simulator.capture.limits import MAX_DISC_PX, check_tolerance
from simulator.capture.prepared_scene import MAX_IMAGE_SPEED
from simulator.optics.vignetting import Vignetting, get_lens
from simulator.utils.checks import (
    check_flag,
    check_integer,
    check_number,
    check_type,
    check_word,
    did_you_mean,
)
from simulator.utils.compute import check_device

#: Smallest frame that the default networks of the common libraries take.
MIN_RESOLUTION = 36
COSTS = ("flicker", "switch")
ObservationKind = Literal["uint8", "linear", "dn", "statistics"]
Motion = Literal["random", "none"]
Depth = Literal["random", "far", "unknown"]
Noise = Literal["bank", "exact", "sensor"]
Reward = Literal["capture", "expected"]
#: What is known of a scene: its light, or one photograph of it.
Source = Literal["light", "raw"]
#: `lens` that every episode draws.
RANDOM_LENS = "random"
#: Longest delay [frame], and the names of what may have its own.
MAX_DELAY, CONTROLS = 16, ("iso", "exposure_time", "f_number")
#: Relative tolerance of the range of settings, because nominal ones are rounded: 1/30 s for 1/32 s.
_ROUNDED = 0.07
#: Highest weight of a cost: scores are in [0, 1].
MAX_COST = 1e6
P = ParamSpec("P")


class EnvArguments(TypedDict, total=False):
    """Arguments of all environments; see `AutoExposureEnv`. The defaults are in `EnvOptions`."""

    scenes: SceneSpec
    split: Split
    grid: ExposureGrid | str | Mapping[str, Iterable[float]] | None
    scorer: str | Mapping[str, float] | Scorer
    costs: Mapping[str, float] | None
    observation: ObservationKind
    sensors: bool
    resolution: int
    crop: Crop
    motion: Motion | float
    depth: Depth | float
    lighting: str | Mapping[str, Any] | Lighting
    delay: int | Mapping[str, int]
    source: Source
    camera: str | CameraProfile
    lens: str | Vignetting | None
    simulator: str | None
    noise: bool | Noise
    tolerance: float
    reward: Reward
    with_oracle: bool
    with_subject: bool
    device: str | None
    blur_memory: float


@dataclass(frozen=True)
class EnvOptions:
    """`EnvArguments` with their defaults, checked; ``costs=None`` is the same as no costs."""

    scenes: SceneSpec = "bundled"
    split: Split = "train"
    grid: ExposureGrid | str | Mapping[str, Iterable[float]] | None = None
    scorer: str | Mapping[str, float] | Scorer = "balanced"
    costs: Mapping[str, float] = field(default_factory=dict)
    observation: ObservationKind = "uint8"
    sensors: bool = True
    resolution: int = 64
    crop: Crop = "box"
    motion: Motion | float = "random"
    depth: Depth | float = "random"
    lighting: str | Mapping[str, Any] | Lighting = "static"
    delay: int | Mapping[str, int] = 0
    source: Source = "light"
    camera: str | CameraProfile = "nikon_z6"
    lens: str | Vignetting | None = None
    simulator: str | None = DEFAULT_SIMULATOR
    noise: bool | Noise = True
    tolerance: float = DEFAULT_TOLERANCE
    reward: Reward = "capture"
    with_oracle: bool = False
    with_subject: bool = False
    device: str | None = None
    blur_memory: float = 512.0

    def __post_init__(self) -> None:
        if self.costs is None:
            object.__setattr__(self, "costs", {})
        if isinstance(self.scenes, str) and not self.scenes:
            raise ValueError("`scenes` (='') must name scenes, such as 'bundled' or a folder")
        kinds = {"split": Split, "observation": ObservationKind, "crop": Crop}
        for name, kind in (kinds | {"reward": Reward, "source": Source}).items():
            check_word(name, getattr(self, name), get_args(kind))
        check_word("noise", self.noise, get_args(Noise), True, False)  # True is "bank"
        for name in ("sensors", "with_oracle", "with_subject"):
            check_flag(name, getattr(self, name))
        check_tolerance(self.tolerance)
        why = ": the default CNNs of RL libraries take no smaller image"
        resolution = check_integer("resolution", self.resolution, MIN_RESOLUTION, 4096, more=why)
        object.__setattr__(self, "resolution", resolution)  # NumPy's integers as an int
        object.__setattr__(self, "delay", checked_delay(self.delay))
        # A blur diameter in pixels of a 64-pixel frame.
        widest = 64.0 * max(1.0, MAX_DISC_PX / resolution)
        for name, words, most in (
            ("motion", get_args(Motion), MAX_IMAGE_SPEED),
            ("depth", get_args(Depth), widest),
        ):
            value = getattr(self, name)
            if isinstance(value, str):
                check_word(name, value, words)
            else:
                check_number(name, value, 0.0, most, more=f", or one of {list(words)}")
        if self.depth == "unknown" and self.simulator is None:
            raise ValueError(
                "`depth` (='unknown') needs the networks that find a scene's defocus: give "
                f"`simulator`, such as {DEFAULT_SIMULATOR!r}"
            )
        if self.simulator is not None:
            check_weights(self.simulator)
        if not isinstance(self.costs, Mapping):
            raise ValueError(f"`costs` (={self.costs!r}) must map some of {COSTS} to weights")
        for name, weight in self.costs.items():
            check_word("costs", name, COSTS)
            check_number(f"costs[{name!r}]", weight, 0.0, MAX_COST)
        check_number("blur_memory", self.blur_memory, 0.0, 2.0**24, more=" MiB")
        if self.device is not None:
            check_type("device", self.device, str, more=", such as 'cuda', or None")
            if check_device(self.device).type == "meta":
                raise ValueError(
                    "`device` (='meta') must be one that holds numbers, such as 'cuda'"
                )
        self.make_lens()
        if self.recorded is not None:
            self._check_recorded()

    def _check_recorded(self) -> None:
        """Real captures have the light, the motion and the noise that they have."""
        defaults: dict[str, tuple[Any, ...]] = {"lighting": ("static",), "source": ("light",)}
        defaults |= {"motion": ("random", "none"), "depth": ("random", "far"), "noise": (True,)}
        defaults |= {"device": (None,), "lens": (None,)}
        for name, allowed in defaults.items():
            value = getattr(self, name)
            if not any(value is word or value == word for word in allowed):
                raise ValueError(
                    f"`{name}` (={value!r}) must be {allowed[0]!r} for recorded scenes: their "
                    "captures are real, nothing of them is simulated (AutoExposure-v0 shows "
                    "recorded videos, too)"
                )
        object.__setattr__(self, "motion", "none")
        object.__setattr__(self, "depth", "far")

    @cached_property
    def recorded(self) -> RecordedOptions | None:
        """The folder of recorded grids, where the scenes are some."""
        return RecordedOptions.of(self.scenes)

    @cached_property
    def torch_device(self) -> torch.device | None:
        """Where torch makes the frames; None where compiled loops make them."""
        return None if self.device is None else check_device(self.device)

    def placed(self, values: Any) -> Any:
        """Numbers as they leave the environment: with a device tensors on it, floats in float32."""
        if self.torch_device is None:
            return values
        tensor = torch.as_tensor(values)
        dtype = torch.float32 if tensor.is_floating_point() else tensor.dtype
        return tensor.to(self.torch_device, dtype)

    @classmethod
    def from_kwargs(cls, kwargs: Mapping[str, Any]) -> EnvOptions:
        """Options from a mapping; a `ValueError` for an unknown one proposes the nearest name."""
        known = [f.name for f in fields(cls)]
        for name in kwargs:
            if name not in known:
                hint = did_you_mean(name, known, "`")
                raise ValueError(f"unknown argument `{name}`: the arguments are {known}{hint}")
        return cls(**kwargs)

    @property
    def delays(self) -> tuple[int, int, int]:
        """Frames until an action's ISO, exposure time and f-number are in effect."""
        if isinstance(self.delay, Mapping):
            iso, time, aperture = (self.delay.get(name, 0) for name in CONTROLS)
            return iso, time, aperture
        return self.delay, self.delay, self.delay

    def make_grid(self) -> ExposureGrid:
        """The exposure grid; by default, of recorded scenes, that of their captures.

        A `ValueError` if an observation's ``settings`` cannot show a value of it.
        """
        if self.recorded is not None and self.grid is None:
            grid = self.recorded.grid
        else:
            grid = ExposureGrid.from_spec("default" if self.grid is None else self.grid)
        aperture, time, speed = SETTINGS_RANGES.tolist()
        bounds = {
            "isos": [3.125 * 2.0**value for value in speed],
            "exposure_times": [2.0**-value for value in reversed(time)],
            "f_numbers": [2.0 ** (value / 2.0) for value in aperture],
        }
        for name, (low, high) in bounds.items():
            for value in getattr(grid, name):
                if not low * (1.0 - _ROUNDED) <= value <= high * (1.0 + _ROUNDED):
                    rule = f"must be in [{low:g}, {high:g}]: the `settings` of an observation show"
                    raise ValueError(f"`grid[{name!r}]` (={value:g}) {rule} no others")
        return grid

    def make_camera(self) -> CameraProfile:
        """The camera body."""
        given = self.camera
        camera = given if isinstance(given, CameraProfile) else get_camera(given)
        if self.noise == "sensor":
            camera.read_noise(100.0)  # raises where there is no such calibration
        return camera if self.recorded is None else self.recorded.camera(camera)

    def make_lens(self) -> Vignetting | None:
        """The lens of all episodes; None for none, or one of its own for each."""
        if isinstance(self.lens, str) and self.lens == RANDOM_LENS:
            return None
        return get_lens(self.lens)

    def make_scorer(self) -> CompositeScorer:
        """The scorer."""
        return make_scorer(self.scorer)

    def make_lighting(self) -> Lighting:
        """The change of the light during an episode; moving light is of the kinds of the split."""
        lighting = self.lighting
        if isinstance(lighting, str) and lighting == MovingLighting.name:
            lighting = {"kind": lighting}
        if isinstance(lighting, Mapping) and lighting.get("kind") == MovingLighting.name:
            lighting = {"kinds": self.split, **lighting}
        return make_lighting(lighting)

    @property
    def in_sequences(self) -> bool:
        """Whether the scenes are frames of sequences, which follow each other in an episode."""
        named = isinstance(self.scenes, Mapping) and "sequence" in self.scenes
        return named or self.recorded is not None

    def load_scenes(self) -> list[Scene]:
        """The scenes of the split at this resolution; of sequences, all frames."""
        return list(self.scenes_on_demand())

    def scenes_on_demand(self) -> SceneSet:
        """Those of `load_scenes`; where they must be drawn first, each when it is needed."""
        return environment_scenes(
            self.recorded or self.scenes,
            self.split,
            camera=self.make_camera(),
            resolution=self.resolution,
            crop=self.crop,
            grid=None if self.recorded is None else self.make_grid(),
            from_raw=self.source == "raw",
            finds_defocus=self.depth == "unknown",
            simulator=self.simulator,
            noise=self.noise,
        )


def takes_env_arguments(
    without: Collection[str] = (), **defaults: Any
) -> Callable[[Callable[P, None]], Callable[P, None]]:
    """Decorates a constructor that passes `EnvArguments` on: its signature shows all of them.

    An unknown one stays Python's own `TypeError` with its wording, which Gymnasium's consumers look
    for; the message proposes the nearest name. The task does not have the arguments `without`;
    `defaults` are other ones than those of `EnvOptions` and of the constructor.
    """

    def decorate(init: Callable[P, None]) -> Callable[P, None]:
        signature = inspect.signature(init)
        own = signature.parameters.values()
        parameters = {p.name: p for p in own if p.kind is not inspect.Parameter.VAR_KEYWORD}
        for each in fields(EnvOptions):
            if each.name not in without:
                default = None if each.default is MISSING else each.default
                kind, hint = inspect.Parameter.KEYWORD_ONLY, EnvArguments.__annotations__[each.name]
                taken = inspect.Parameter(each.name, kind, default=default, annotation=hint)
                parameters.setdefault(each.name, taken)
        for name, default in defaults.items():
            parameters[name] = parameters[name].replace(default=default)
        known = [name for name in parameters if name != "self"]

        @functools.wraps(init)
        def checked(*args: P.args, **kwargs: P.kwargs) -> None:
            for name in kwargs:
                if name not in known:
                    hint = f"{did_you_mean(name, known)} (arguments: {', '.join(known)})"
                    call = f"{type(args[0]).__name__}.__init__()"
                    raise TypeError(f"{call} got an unexpected keyword argument {name!r}{hint}")
            init(*args, **{**defaults, **kwargs})

        shown = signature.replace(parameters=list(parameters.values()))
        checked.__signature__ = shown  # type: ignore[attr-defined]
        return checked

    return decorate


def checked_delay(delay: Any) -> int | dict[str, int]:
    """`delay` with Python's integers, one of all controls where they are equal."""
    if not isinstance(delay, Mapping):
        more = f" frames, or a mapping of them by {list(CONTROLS)}"
        return check_integer("delay", delay, 0, MAX_DELAY, more=more)
    if not delay:
        raise ValueError(f"`delay` (={delay!r}) must name one of {list(CONTROLS)} or more")
    for name in delay:
        check_word("delay", name, CONTROLS)
    given = {
        name: check_integer(f"delay[{name!r}]", frames, 0, MAX_DELAY, more=" frames")
        for name, frames in delay.items()
    }
    alike = {given.get(name, 0) for name in CONTROLS}
    return alike.pop() if len(alike) == 1 else given
