"""Noisy captures of test scenes, and the truth at other settings.

All scenes but those that constants are calibrated on are of the test split, photographed by a
reference camera without hidden errors, so that what is measured is the simulator and not one body.
The simulator is not told their depth.
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

from torch import Tensor

from ae_env import ExposureGrid
from benchmarks.harness import cropped, data_root
from simulator import CameraSettings, RawImage, get_camera, incident_ev100
from simulator.camera_simulator import Depth
from simulator.reference.camera import ReferenceCamera, ReferenceScene
from simulator.training.scenes import Split, reference_scenes

#: Height and width [packed pixel].
Size = tuple[int, int]

CAMERA = "nikon_z6"
SIZES: tuple[Size, ...] = ((128, 128), (512, 768))
#: The settings that a source is taken with: ISO and exposure relative to incident light [EV], in
#: turn. At f/8 half of the 64 states open the aperture, a quarter keep it and a quarter close it.
SOURCES = ((1600, -1.0), (6400, 0.0), (400, -2.0), (100, 0.0), (6400, -2.0), (400, 0.0))
SOURCE_F_NUMBER = 8.0
#: States whose exposure is this near to the incident light's [EV] are compared: beyond, a frame is
#: nearly black or nearly white whatever the method.
FAIR_EXPOSURE = 3.0
GRID = ExposureGrid.default()
#: How many scenes of each kind make a set, procedural groups to choose from, and what is drawn of
#: them to have a size [pixel].
_SETS: dict[Size, tuple[dict[str, int], int, int]] = {
    (128, 128): ({"depth": 4, "flat": 2, "photograph": 2, "radiance": 4}, 12, 256),
    (512, 768): ({"depth": 1}, 2, 768),
}
_ALL_GROUPS = 32


@dataclass(frozen=True, eq=False)
class Trial:
    """One scene, photographed."""

    scene: ReferenceScene
    source: CameraSettings
    camera: ReferenceCamera

    @property
    def depth(self) -> Depth:
        """What the simulator is told: all is in focus, or nothing is known."""
        return "far" if self.scene.depth is None else "unknown"

    def raw(self, seed: int) -> RawImage:
        """A noisy capture of the scene with the source's settings."""
        return RawImage(self.sample(self.source, seed), self.source, self.camera.camera)

    def mean(self, settings: CameraSettings) -> Tensor:
        """(4, H, W) the camera's record at `settings` without noise, clipped."""
        light = self._light(settings.f_number)
        signal = self.camera.expose(light, self.scene.reference, settings)
        return self.camera.clip(signal, settings.iso)

    def sample(self, settings: CameraSettings, seed: int) -> Tensor:
        """(4, H, W) its record with noise."""
        light = self._light(settings.f_number)
        return self.camera.capture(self.scene, settings, seed, light=light).sample

    @functools.cached_property
    def _light(self) -> Callable[[float], Tensor]:
        return functools.cache(lambda f_number: self.camera.blurred_light(self.scene, f_number))

    def states(self, number: int | None = None) -> tuple[CameraSettings, ...]:
        """States of the grid within `FAIR_EXPOSURE`: `number` of them evenly spread, or all.

        Trials start at different states, so that they do not all ask for the same.
        """
        assert self.scene.illuminance is not None
        ev = incident_ev100(self.scene.illuminance)
        fair = [s for s in GRID if abs(ev + s.log2_exposure) <= FAIR_EXPOSURE]
        if number is None or number >= len(fair):
            return tuple(fair)
        first = zlib.crc32(self.scene.scene_id.encode()) % len(fair)
        return tuple(fair[(first + i * len(fair) // number) % len(fair)] for i in range(number))


@functools.cache
def trials(size: Size) -> tuple[Trial, ...]:
    """The scenes of a size, the kinds taken in turn, with sources of different ISO."""
    counts, groups, drawn = _SETS[size]
    return _in_turn(_scenes(size, groups, drawn), counts)


@functools.cache
def all_trials(split: Split = "test") -> tuple[Trial, ...]:
    """All scenes of a split, 128 x 128, with sources of different ISO."""
    kinds = _scenes((128, 128), _ALL_GROUPS, 256, split)
    return _in_turn(kinds, {kind: len(own) for kind, own in kinds.items()})


def source_settings(scene: ReferenceScene, iso: float, error: float) -> CameraSettings:
    """Settings at f/8 that expose a scene by `error` EV more than an incident-light meter says."""
    assert scene.illuminance is not None
    unit = CameraSettings(iso, 1.0, SOURCE_F_NUMBER)
    stops = -incident_ev100(scene.illuminance) - unit.log2_exposure + error
    return replace(unit, exposure_time=2.0**stops)


def _in_turn(kinds: dict[str, list[ReferenceScene]], counts: dict[str, int]) -> tuple[Trial, ...]:
    """As many scenes of each kind as there are and as are asked for, one of each kind in turn."""
    columns = [kinds[kind][:count] for kind, count in counts.items()]
    chosen = [c[i] for i in range(max(counts.values())) for c in columns if i < len(c)]
    camera = ReferenceCamera(get_camera(CAMERA))
    return tuple(
        Trial(scene, source_settings(scene, *SOURCES[i % len(SOURCES)]), camera)
        for i, scene in enumerate(chosen)
    )


def _scenes(
    size: Size, groups: int, drawn: int, split: Split = "test"
) -> dict[str, list[ReferenceScene]]:
    """Scenes of exactly `size` by kind."""
    profile = get_camera(CAMERA)
    found = reference_scenes(split, profile, number=groups, size=drawn, data=data_root())
    kinds: dict[str, list[ReferenceScene]] = {
        kind: [] for kind in ("depth", "flat", "photograph", "radiance")
    }
    for scene in found:
        if min(scene.size) >= min(size) and max(scene.size) >= max(size):
            known = scene.kind if scene.kind in kinds else "flat"
            kinds[known].append(cropped(scene, *size))
    kinds["radiance"] = list({s.group: s for s in kinds["radiance"]}.values())  # one view each
    return kinds
