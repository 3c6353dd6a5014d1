"""Arguments of the environment, checked in one place."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from ae_env.grid import ExposureGrid
from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.networks import (
    DEFAULT_SIMULATOR,
    SceneNetworks,
    check_weights,
    without_noise,
)
from ae_env.scenes.scene import Resize
from ae_env.scorers import CompositeScorer, make_scorer
from simulator.cache import LruCache
from simulator.camera import CameraProfile, get_camera
from simulator.tolerance import DEFAULT_TOLERANCE, check_tolerance

#: Smallest frame that the default networks of the common libraries take.
MIN_RESOLUTION = 36
COSTS = ("flicker", "switch")
DEPTHS = ("random", "far", "unknown")
NOISES = ("bank", "exact")


@dataclass(frozen=True)
class EnvOptions:
    """Arguments of `AutoExposureEnv` and `AutoExposureVectorEnv`; see there for their meaning."""

    scenes: Any = "bundled"
    split: str = "train"
    grid: Any = "default"
    scorer: Any = "balanced"
    costs: Mapping[str, float] = field(default_factory=dict)
    observation: str = "uint8"
    sensors: bool = True
    resolution: int = 64
    crop: str = "box"
    motion: str | float = "random"
    depth: str | float = "random"
    lighting: Any = "static"
    delay: int = 0
    camera: Any = "nikon_z6"
    simulator: str | None = DEFAULT_SIMULATOR
    noise: bool | str = True
    tolerance: float = DEFAULT_TOLERANCE
    reward: str = "capture"
    with_oracle: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.scenes, str) and not self.scenes:
            raise ValueError("`scenes` (='') must name scenes, such as 'bundled' or a folder")
        _one_of("split", self.split, ("train", "test", "all"))
        _one_of("observation", self.observation, ("uint8", "linear", "dn"))
        _one_of("crop", self.crop, ("box", "native"))
        _one_of("reward", self.reward, ("capture", "expected"))
        if not isinstance(self.noise, bool):  # True is "bank"
            _one_of("noise", self.noise, NOISES)
        check_tolerance(self.tolerance)
        if not _is_integer(self.resolution):
            raise ValueError(f"`resolution` (={self.resolution!r}) must be an integer")
        if not MIN_RESOLUTION <= self.resolution <= 4096:
            raise ValueError(
                f"`resolution` (={self.resolution}) must be in [{MIN_RESOLUTION}, 4096]: the "
                "default CNNs of RL libraries take no smaller image"
            )
        for name, words in (("motion", ("random", "none")), ("depth", DEPTHS)):
            value = getattr(self, name)
            if isinstance(value, str):
                _one_of(name, value, words)
            elif isinstance(value, bool) or not 0.0 <= float(value) < 1e3:
                raise ValueError(
                    f"`{name}` (={value!r}) must be one of {list(words)} or in [0, 1000)"
                )
        if self.depth == "unknown" and self.simulator is None:
            raise ValueError(
                "`depth` (='unknown') needs the networks that find a scene's defocus: give "
                f"`simulator`, such as {DEFAULT_SIMULATOR!r}"
            )
        if self.simulator is not None:
            check_weights(self.simulator)
        if not _is_integer(self.delay) or not 0 <= self.delay <= 16:
            raise ValueError(f"`delay` (={self.delay!r}) must be an integer in [0, 16] frames")
        for name, weight in self.costs.items():
            _one_of("costs", name, COSTS)
            if not 0.0 <= float(weight) < float("inf"):
                raise ValueError(f"`costs[{name!r}]` (={weight!r}) must be finite and >= 0")

    @classmethod
    def from_kwargs(cls, kwargs: Mapping[str, Any]) -> EnvOptions:
        """Options from keyword arguments; an unknown one is refused with the nearest name."""
        known = [f.name for f in fields(cls)]
        for name in kwargs:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                hint = f"; did you mean `{near[0]}`?" if near else ""
                raise ValueError(f"unknown argument `{name}`: the arguments are {known}{hint}")
        return cls(**kwargs)

    def make_grid(self) -> ExposureGrid:
        """The exposure grid."""
        return ExposureGrid.from_spec(self.grid)

    def make_camera(self) -> CameraProfile:
        """The camera body."""
        return self.camera if isinstance(self.camera, CameraProfile) else get_camera(self.camera)

    def make_scorer(self) -> CompositeScorer:
        """The scorer."""
        return make_scorer(self.scorer)

    def load_scenes(self) -> list[Scene]:
        """The scenes of the split at this resolution; kept for the next environment like this."""
        camera = self.make_camera()
        finds_defocus = self.depth == "unknown"
        key = (
            repr(self.scenes),
            self.split,
            camera,  # its colours and levels, too
            self.resolution,
            self.crop,
            finds_defocus,
        )
        by_name = isinstance(self.scenes, str) and ":" not in self.scenes.removeprefix("bundled:")
        # Weights in a file of one's own may be others next time.
        kept = by_name and (not finds_defocus or self.simulator == DEFAULT_SIMULATOR)
        known = _LOADED.get(key) if kept else None
        if known is not None:
            return list(known)
        networks = None if self.simulator is None else SceneNetworks(self.simulator)
        resize: Resize = Scene.resized
        if networks is not None and finds_defocus:
            resize = networks.resized
        scenes = load_scenes(
            self.scenes,
            self.split,  # type: ignore[arg-type]
            camera=camera,
            resolution=self.resolution,
            crop=self.crop,  # type: ignore[arg-type]
            resize=resize,
        )
        if not scenes:
            raise ValueError(f"`scenes` (={self.scenes!r}) has none in split {self.split!r}")
        scenes = [self._prepared(scene, networks) for scene in scenes]
        if kept and self.scenes.startswith("bundled"):
            _LOADED.put(key, list(scenes), sum(scene.light.nbytes for scene in scenes))
        return scenes

    def _prepared(self, scene: Scene, networks: SceneNetworks | None) -> Scene:
        if self.depth != "unknown" and scene.defocus_map is not None:
            scene = replace(scene, defocus_map=None)
        if networks is not None:
            scene = networks.denoised(scene)
        return scene if self.noise else without_noise(scene)


#: Bundled scenes by what they were made for; at most so many bytes of light.
_LOADED: LruCache[list[Scene]] = LruCache(2**30)


def _is_integer(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _one_of(name: str, value: Any, known: tuple[str, ...]) -> None:
    if value not in known:
        near = difflib.get_close_matches(str(value), known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"`{name}` (={value!r}) must be one of {list(known)}{hint}")
