"""The plan's predicted error against the measured one; and what is left out.

The error of a capture is the distance of distributions, given the scene: per pixel the mean m and
the standard deviation s over source and target noise, as
``sqrt(mean((dm)^2 + (ds)^2) / s_target^2)``, the 2-Wasserstein distance of two normal distributions
in units of the target's noise, between what is simulated and what the reference camera records. The
scene is photographed several times. The noise that is added last is known in closed form and not
drawn. What the finite number of photographs adds to a square is subtracted: from dm by the usual
correction, from ds by multiplying the differences of two halves of the photographs. Pixels that are
white in the scene, and within the noise white in the captures, count as equal.

Scenes are photographed by a reference camera without hidden errors, so that what is measured is the
simulator and not one body. The simulator is not told their depth.
"""

import functools
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ae_env import ExposureGrid
from benchmarks.harness import Row, cropped
from benchmarks.isolated import timed
from benchmarks.work_precision.methods import DEFAULT, TOLERANCES, simulator
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera, incident_ev100
from simulator.camera_simulator import Depth
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import missing_variance
from simulator.noise.noise_level_function import NoiseLevelFunction, noise_variance
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene
from simulator.training.scenes import (
    FURTHER_MAPS,
    Split,
    map_scenes,
    radiance_files,
    reference_scenes,
)
from simulator.utils.files import data_folder

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
        signal = self.camera.expose(self._light(settings.f_number), self.scene.reference, settings)
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
    kinds["radiance"] += _further_maps(split)
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
    sources = [source_settings(s, *SOURCES[i % len(SOURCES)]) for i, s in enumerate(chosen)]
    return tuple(Trial(*own, camera) for own in zip(chosen, sources, strict=True))


def _scenes(
    size: Size, groups: int, drawn: int, split: Split = "test"
) -> dict[str, list[ReferenceScene]]:
    """Scenes of exactly `size` by kind."""
    profile = get_camera(CAMERA)
    found = reference_scenes(split, profile, number=groups, size=drawn, data=data_folder())
    names = ("depth", "flat", "photograph", "radiance")
    kinds: dict[str, list[ReferenceScene]] = {kind: [] for kind in names}
    for scene in found:
        if min(scene.size) >= min(size) and max(scene.size) >= max(size):
            known = scene.kind if scene.kind in kinds else "flat"
            kinds[known].append(cropped(scene, *size))
    kinds["radiance"] = list({s.group: s for s in kinds["radiance"]}.values())  # one view each
    return kinds


def _further_maps(split: Split) -> list[ReferenceScene]:
    """Views into maps that no network was trained on: those of its split, too, calibrate bounds."""
    splits: tuple[Split, ...] = (split,) if split == "test" else ("train", "validation")
    data = data_folder()
    found = [f for s in splits for f in radiance_files(data, s, FURTHER_MAPS)] if data else []
    return [scene for file in found for scene in map_scenes(*file, get_camera(CAMERA), 128)]


# -- the plan -------------------------------------------------------------------------------------

#: Photographs of each scene, and fair states of it; a third as many are any others of the grid.
DRAWS, FAIR = 8, 12
#: One state in so many is tried with every tolerance.
_EVERY = 5
#: Standard deviations are pooled over squares of this side [pixel].
_WINDOW = 9


def bound(seed: int, split: Split, share: int, shares: int, quick: bool) -> list[Row]:
    """One row per scene, state and tolerance, of every `shares`-th scene from `share` on.

    Every state is tried with the default tolerance, some of the test split with all of them.
    """
    own, rows = simulator("large"), []
    known = trials((128, 128))[:3] if quick else all_trials(split)
    tried = TOLERANCES if split == "test" else (DEFAULT,)
    for number, trial in list(enumerate(known))[share::shares]:
        raws = [trial.raw(seed + 100 * number + i) for i in range(DRAWS)]
        prepared = _prepared(own, raws, trial, tried)
        for position, settings in enumerate(_states(trial, number)[:: FAIR if quick else 1]):
            truth, target = trial.mean(settings), raws[0].camera.nlf(settings.iso)
            wanted = noise_variance(truth, target)
            for tolerance in (DEFAULT,) if position % _EVERY else tried:
                plan = prepared[tolerance][0].plan(settings)
                pairs = [_before_noise(one, settings) for one in prepared[tolerance]]
                light, added = (torch.stack(own) for own in zip(*pairs, strict=True))
                # No difference shows in what is white in the scene and, within noise, in captures.
                white = (truth > 1.0 - 1e-6) & (light.mean(dim=0) >= 1.0 - wanted.sqrt())
                shows = torch.where(white, torch.inf, wanted)
                row: Row = {"part": "bound", "split": split, "kind": trial.scene.kind}
                row |= {"scene": trial.scene.scene_id, "place": trial.scene.group}
                row |= {"source": str(trial.source), "settings": str(settings)}
                row |= {"tolerance": tolerance}
                row |= {"network": plan.network, "errors": dict(plan.errors)}
                row |= {"predicted": plan.predicted_error, "bound": plan.error_bound}
                rows.append(row | {"measured": distance(light, added, truth, wanted, shows)})
    return rows


def _states(trial: Trial, number: int) -> list[CameraSettings]:
    """Fair states of the `number`-th scene, and some of the others, after every third of them."""
    rest = [s for s in GRID if s not in trial.states()]
    found = list(trial.states(FAIR))
    if rest:
        for i in range(FAIR // 3):
            place = (7 * number + i * len(rest) * 3 // FAIR) % len(rest)
            found.insert(4 * i + 3, rest[place])
    return found


def _prepared(
    own: CameraSimulator, raws: Sequence[RawImage], trial: Trial, tolerances: Sequence[float]
) -> dict[float, list[PreparedScene]]:
    """The photographs prepared for each tolerance; positive ones share the networks' runs."""

    def made(tolerance: float) -> list[PreparedScene]:
        return [own.prepare(raw, depth=trial.depth, tolerance=tolerance) for raw in raws]

    shared = made(TOLERANCES[1])
    return {t: [replace(p, tolerance=t) for p in shared] if t else made(t) for t in tolerances}


def _before_noise(prepared: PreparedScene, settings: CameraSettings) -> tuple[Tensor, Tensor]:
    """Light (4, H, W) of a planned capture, and the variance that is added to it."""
    ((_, found),) = prepared.transitions([settings])
    # What is white is white, however bright: its neighbours' noise is pooled with it.
    light = (found.light[0] * found.table[0, 0, 0].item()).clamp_(max=1.0)
    (share,), rows = found.remaining_variance or [None], found.table[0, 1:, :, None, None]
    return light, missing_variance(light, torch.from_numpy(rows), share).clamp(min=0.0)


def distance(light: Tensor, added: Tensor, truth: Tensor, wanted: Tensor, shows: Tensor) -> float:
    """Distance of captures to those of mean `truth` and variance `wanted`, in units of `shows`.

    The captures are draws (N, 4, H, W) of one scene: `light` before its last noise is drawn, and
    the variance `added` by that. Deviations are pooled over a neighbourhood.
    """

    def apart(half: slice) -> Tensor:
        variance = _variance(light[half].double()) + added[half].double().mean(dim=0)
        return _pooled(variance).sqrt() - _pooled(wanted).sqrt()

    error = light.double() - truth
    spread = _variance(error) / shows
    means = error.mean(dim=0).square() / shows - spread / len(light)
    product = apart(slice(0, None, 2)) * apart(slice(1, None, 2))
    square = float((means + product / shows).mean())
    return max(0.0, square) ** 0.5


def _pooled(variance: Tensor) -> Tensor:
    """Means over squares: with a few draws a pixel's own variance is too uncertain."""
    padded = F.pad(variance.double()[None], (_WINDOW // 2,) * 4, mode="reflect")
    return F.avg_pool2d(padded, _WINDOW, stride=1)[0].clamp(min=0.0)


def _variance(draws: Tensor) -> Tensor:
    """Variance over the first dimension; torch's own takes twenty times as long there."""
    return (draws - draws.mean(dim=0)).square_().sum(dim=0) / (len(draws) - 1)


# -- what is left out -----------------------------------------------------------------------------

#: Scenes of a kind, runs of each sweep, and states of a full run that are timed of each scene.
SCENES, REPEATS, FULL_STATES = 3, 5, 8
_ORDINARY = ("dead_leaves", "indoor", "photograph")
#: By kind of scene: what is photographed, ISO and exposure relative to incident light [EV] of the
#: source, None for the scene's own clean light, and what the simulator is told. The close-up's disc
#: is given at f/4 [pixel], the speed of what moves in frame heights per second.
KINDS: dict[str, tuple[Sequence[str], tuple[float, float] | None, dict[str, Any]]] = {
    "radiance map": (("radiance",), None, {"depth": "unknown"}),
    "clean raw": (("photograph",), (100, 0.0), {"depth": "unknown"}),
    "noisy raw": (_ORDINARY, (6400, -2.0), {"depth": "unknown"}),
    "flat scene": (("dead_leaves", "indoor", "radiance"), (400, 0.0), {"depth": "far"}),
    "close-up, disc known": (_ORDINARY, (400, 0.0), {"defocus": 4.0}),
    "close-up, depth unknown": (("depth",), (400, 0.0), {"depth": "unknown"}),
    "moving scene": (_ORDINARY, (400, 0.0), {"image_speed": 0.125}),
}


def left_out(kind: str, seed: int, quick: bool) -> Row:
    """Share of the 64 states that run each module, and the time of a sweep, of a kind of scene."""
    own, names, (scenes, taken, stated) = simulator("compact"), dict[str, float](), KINDS[kind]
    known = [t for t in all_trials() if t.scene.kind in scenes]
    known = known or [t for t in all_trials() if t.scene.depth is None]
    predicted, times, every = [], [], []
    examples = [_source(t, taken, seed) for t in known[: 1 if quick else SCENES]]
    for source in examples:
        prepared: Any = partial(own.prepare, source, tolerance=DEFAULT, **stated)
        for plan in map(prepared().plan, GRID):
            for step in plan.steps:
                share = int(step.runs) / (len(examples) * len(GRID))
                names[step.name] = names.get(step.name, 0.0) + share
            predicted.append(plan.predicted_error)
        some = [GRID[(i * len(GRID) // FULL_STATES + i) % len(GRID)] for i in range(FULL_STATES)]
        for _ in range(1 if quick else REPEATS):
            times.append(timed(lambda p=prepared: p().expose(GRID)))  # type: ignore[misc]
            full_run = partial(own.simulate, source, tolerance=None, **stated)
            every += [timed(partial(full_run, settings)) for settings in some]
    sweep, full = 1e3 * float(np.median(times)), 1e3 * float(np.mean(every)) * len(GRID)
    row = {"part": "left_out", "kind": kind, "scenes": len(examples), "share": names}
    row |= {"predicted_mean": float(np.mean(predicted)), "predicted_largest": max(predicted)}
    return row | {"ms_per_sweep": sweep, "full_ms_per_sweep": full, "times": full / sweep}


def _source(trial: Trial, taken: tuple[float, float] | None, seed: int) -> RawImage | PreparedScene:
    if taken is not None:
        return replace(trial, source=source_settings(trial.scene, *taken)).raw(seed)
    scene, clean = trial.scene, NoiseLevelFunction.zero()
    light = trial.camera.blurred_light(replace(scene, depth=None), SOURCE_F_NUMBER)  # in focus
    return PreparedScene(light, scene.reference, trial.camera.camera, clean)
