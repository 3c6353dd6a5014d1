"""What the methods are tried on: noisy captures of test scenes, and the truth at other settings.

All scenes are of the test split, photographed by a reference camera without hidden errors, so that
what is measured is the simulator and not one body. The simulator is not told their depth.
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ae_env.grid import ExposureGrid
from ae_env.scenes.depth import FOCAL_LENGTH, draw_depth, lens_and_depth
from ae_env.scenes.reference_scenes import reference_scenes
from benchmarks.simulator.scenes import cropped, data_root
from simulator import CameraSettings, RawImage, get_camera
from simulator.reference.reference_camera import DRAPED, Lens, ReferenceCamera, ReferenceScene
from simulator.reference.sequences import exposure_error
from simulator.settings import incident_ev100

#: Height and width [packed pixel].
Size = tuple[int, int]

CAMERA = "nikon_z6"
SIZES: tuple[Size, ...] = ((64, 64), (128, 128), (256, 256), (512, 768))
#: The settings that a source is taken with: ISO and exposure relative to incident light [EV], in
#: turn. At f/8 half of the 64 states open the aperture, a quarter keep it and a quarter close it.
SOURCES = ((1600, -1.0), (6400, 0.0), (400, -2.0), (100, 0.0), (6400, -2.0), (400, 0.0))
SOURCE_F_NUMBER = 8.0
#: States whose exposure is this near to the incident light's [EV] are compared: beyond, a frame is
#: nearly black or nearly white whatever the method.
FAIR_EXPOSURE = 3.0
GRID = ExposureGrid.default()
#: How many scenes of each kind make a set, by size: those that can be had so large.
_SETS: dict[Size, dict[str, int]] = {
    (64, 64): {"depth": 4, "flat": 2, "photograph": 2, "radiance": 2, DRAPED: 2},
    (128, 128): {"depth": 4, "flat": 2, "photograph": 2, "radiance": 2, DRAPED: 2},
    (256, 256): {"depth": 3, "flat": 1, "photograph": 2},
    (512, 768): {"depth": 3},
}
#: Procedural groups to choose from, and what is drawn of them to have a size [pixel].
_GROUPS = {(64, 64): 12, (128, 128): 12, (256, 256): 8, (512, 768): 4}
_ALL_GROUPS = 32
_DRAWN = {(64, 64): 256, (128, 128): 256, (256, 256): 512, (512, 768): 768}


@dataclass(frozen=True, eq=False)
class Trial:
    """One scene, photographed.

    Args:
        scene: What is photographed.
        source: Settings of the source.
        camera: The body.
    """

    scene: ReferenceScene
    source: CameraSettings
    camera: ReferenceCamera

    @property
    def size(self) -> Size:
        """Height and width [packed pixel]."""
        height, width = self.scene.light.shape[1:]
        return height, width

    def raw(self, seed: int) -> RawImage:
        """A noisy capture of the scene with the source's settings."""
        capture = self.camera.capture(
            self.scene, self.source, seed, light=self._blurred_light(self.source.f_number)
        )
        return RawImage(capture.sample, self.source, self.camera.camera)

    def mean(self, settings: CameraSettings) -> Tensor:
        """(4, H, W) what the camera would record at `settings` without noise, clipped."""
        light = self._blurred_light(settings.f_number)
        signal = self.camera.expose(light, self.scene.reference, settings)
        return self.camera.clip(signal, settings.iso)

    def sample(self, settings: CameraSettings, seed: int) -> Tensor:
        """(4, H, W) what it would record."""
        light = self._blurred_light(settings.f_number)
        return self.camera.capture(self.scene, settings, seed, light=light).sample

    def _blurred_light(self, f_number: float) -> Tensor:
        return self._kept(f_number)

    @functools.cached_property
    def _kept(self) -> functools._lru_cache_wrapper[Tensor]:
        return functools.cache(lambda f_number: self.camera.blurred_light(self.scene, f_number))

    def states(self, number: int | None = None) -> tuple[CameraSettings, ...]:
        """States of the grid within `FAIR_EXPOSURE`: `number` of them evenly spread, or all.

        Neighbouring trials start at different states, so that they do not all ask for the same.
        """
        fair = [s for s in GRID if abs(self._error(s)) <= FAIR_EXPOSURE]
        if number is None or number >= len(fair):
            return tuple(fair)
        first = zlib.crc32(self.scene.scene_id.encode()) % len(fair)
        return tuple(fair[(first + i * len(fair) // number) % len(fair)] for i in range(number))

    def _error(self, settings: CameraSettings) -> float:
        assert self.scene.illuminance is not None
        return exposure_error(self.scene.illuminance, settings)


@functools.cache
def trials(size: Size, number: int | None = None) -> tuple[Trial, ...]:
    """The scenes of a size, the kinds taken in turn, with sources of different ISO.

    Args:
        size: One of `SIZES`.
        number: The first so many; None for all.
    """
    camera = ReferenceCamera(get_camera(CAMERA))
    chosen = _in_turn(_scenes(size), _SETS[size])[:number]
    return tuple(
        Trial(scene, source_settings(scene, *SOURCES[i % len(SOURCES)]), camera)
        for i, scene in enumerate(chosen)
    )


@functools.cache
def test_trials(*, quick: bool) -> tuple[Trial, ...]:
    """All test scenes of 128 x 128 with sources of different ISO; few of them if `quick`."""
    if quick:
        return trials((128, 128), 3)
    kinds = _scenes((128, 128), groups=_ALL_GROUPS)
    camera = ReferenceCamera(get_camera(CAMERA))
    scenes = _in_turn(kinds, {kind: len(own) for kind, own in kinds.items()})
    return tuple(
        Trial(scene, source_settings(scene, *SOURCES[i % len(SOURCES)]), camera)
        for i, scene in enumerate(scenes)
    )


def source_settings(scene: ReferenceScene, iso: float, error: float) -> CameraSettings:
    """Settings at f/8 that expose a scene by `error` EV more than an incident-light meter says."""
    assert scene.illuminance is not None
    unit = CameraSettings(iso, 1.0, SOURCE_F_NUMBER)
    stops = -incident_ev100(scene.illuminance) - unit.log2_exposure + error
    return replace(unit, exposure_time=2.0**stops)


def _scenes(size: Size, groups: int | None = None) -> dict[str, list[ReferenceScene]]:
    """Scenes of exactly `size` by kind."""
    profile, height, width = get_camera(CAMERA), *size
    found = reference_scenes(
        "test",
        profile,
        number=_GROUPS[size] if groups is None else groups,
        size=_DRAWN[size],
        radiance=data_root(),
    )
    kinds: dict[str, list[ReferenceScene]] = {"depth": [], "flat": [], "photograph": []}
    kinds |= {"radiance": [], DRAPED: []}
    for scene in found:
        if min(scene.light.shape[1:]) < min(size) or max(scene.light.shape[1:]) < max(size):
            continue
        known = scene.kind if scene.kind in kinds else "flat"
        kinds[known].append(_window(scene, height, width))
    one_view_each = {s.group: s for s in kinds["radiance"]}
    kinds["radiance"] = list(one_view_each.values())
    kinds[DRAPED] = [_draped(scene) for scene in reversed(kinds["radiance"])]
    in_focus: list[ReferenceScene] = []
    blurred: list[ReferenceScene] = []
    for scene in kinds["depth"]:
        extent = ReferenceCamera(profile).blur_diameter(scene, SOURCE_F_NUMBER).max()
        (blurred if float(extent) > 1.0 else in_focus).append(scene)
    kinds["depth"] = [s for pair in zip(blurred, in_focus, strict=False) for s in pair]
    kinds["depth"] += [s for s in (*blurred, *in_focus) if s not in kinds["depth"]]
    return kinds


def _window(scene: ReferenceScene, height: int, width: int) -> ReferenceScene:
    """The middle `height` x `width` pixels."""
    square = cropped(scene, max(height, width))
    top = (square.light.shape[1] - height) // 2
    left = (square.light.shape[2] - width) // 2
    window = (..., slice(top, top + height), slice(left, left + width))
    depth = None if square.depth is None else square.depth[window]
    return replace(square, light=square.light[window].contiguous(), depth=depth)


def _draped(scene: ReferenceScene) -> ReferenceScene:
    """A sharp square picture over a procedural depth, out of focus at the back or in front."""
    rng = np.random.default_rng(zlib.crc32(scene.scene_id.encode()))
    drawn = draw_depth(rng, scene.light.shape[-1], "back")
    pitch = 2e-6 * (get_camera(CAMERA).pixel_pitch_um or 0.0)
    distance, depth = lens_and_depth(drawn.blur, drawn.far, pitch)
    return replace(
        scene,
        scene_id=f"{scene.scene_id}-draped",
        kind=DRAPED,
        depth=torch.from_numpy(depth),
        lens=Lens(FOCAL_LENGTH, distance),
    )


def _in_turn(
    kinds: dict[str, list[ReferenceScene]], counts: dict[str, int]
) -> Sequence[ReferenceScene]:
    """As many scenes of each kind as there are and as are asked for, one of each kind in turn."""
    columns: Iterable[list[ReferenceScene]] = [kinds[k][:count] for k, count in counts.items()]
    longest = max(counts.values())
    return [column[i] for i in range(longest) for column in columns if i < len(column)]
