"""Captures in columns: how each is exposed, in a batch of scenes or in a sweep of one.

`plan_frames` is `simulator.capture.decision.decide` for many scenes without noise of their own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.capture import decision
from simulator.capture.blurred_frames import BLUR, LAYOUT, Layout
from simulator.capture.sensor import exposure_table
from simulator.capture.statistics import BINS, curvature
from simulator.optics.motion import Path, path_length
from simulator.settings import CameraSettings
from simulator.utils.compute import kernel

if TYPE_CHECKING:
    from simulator.capture.prepared_scene import PreparedScene

_MOVES = ("defocus", "speed", "direction", "turn", "subject_speed", "subject_direction")
#: All of a scene that the exposure of a capture depends on; see `PreparedScene`.
SCENE = np.dtype(
    [
        *((n, "f8") for n in ("log2_reference", "gain", "tolerance", *_MOVES)),
        ("targets", "i8"),  # which noise of the camera its captures have
        ("rest", "i8"),  # the scene that it shows at rest or in motion
        *LAYOUT,  # with the subject, whether it moves or not
    ]
)
#: The blurs that `plan_frames` decides on.
BLURS = ("defocus", "motion_blur", "vignetting")
#: How a scene is out of focus and moves: `PreparedScene.defocus`, `image_speed` and `movement`.
MOVES = np.dtype([(name, "f8") for name in _MOVES])
#: All of a state that the exposure of a capture depends on.
STATE = np.dtype([(name, "f8") for name in ("log2_exposure", "time", "f_number")])


def state_columns(states: Sequence[CameraSettings]) -> np.ndarray:
    """(S,) `STATE`."""
    numbers = [(s.log2_exposure, s.exposure_time, s.effective_f_number) for s in states]
    return np.array(numbers, STATE)


def noise_columns(camera: CameraProfile, states: Sequence[CameraSettings], box: int) -> np.ndarray:
    """(S, 2, 4) shot and read noise of captures, `box` squared sensor pixels averaged."""
    return np.array([(nlf.shot, nlf.read) for nlf in camera.nlfs(states)]) * (1.0 / box**2)


def fits_columns(scene: PreparedScene, states: np.ndarray) -> bool:
    """Whether `plan_frames` can plan a scene at `STATE` (S,): without noise or aperture of its own.

    Discs that are too wide do not fit: `decide` raises an error for these.
    """
    widest = widest_defocus(scene, states)
    return scene.nlf.is_zero and scene.aperture_blur is None and scene.defocus <= widest


def widest_defocus(scene: PreparedScene, states: np.ndarray) -> float:
    """The largest `PreparedScene.defocus` whose disc is not too wide at `STATE` (S,)."""
    most = max(*scene.light.shape[-2:], decision.MAX_DISC_PX)
    return float(most * states["f_number"].min() / 4.0)


def statistics_column(scene: PreparedScene) -> np.ndarray:
    """The `LightStatistics.columns` of a scene, which take a pass over its pixels; 0 if unused."""
    if scene.defocus or scene.image_speed or scene.movement.subject_speed:
        return scene.statistics.columns
    return np.zeros((4, 4, BINS))


def scene_column(scene: PreparedScene, targets: int, rest: int) -> tuple[Any, ...]:
    """The `SCENE` of a scene."""
    movement = scene.movement
    return (
        *(scene.reference.log2_exposure, scene.gain, scene.tolerance),
        *(scene.defocus, scene.image_speed, movement.direction, movement.turn),
        *(movement.subject_speed, movement.subject_direction, targets, rest),
        *layout_column(scene.layout, subject=True),
    )


def vignetting_column(scene: PreparedScene, states: Sequence[CameraSettings]) -> np.ndarray:
    """(S,) uintp addresses of the vignetting of captures, 0 for none; the lens keeps its maps."""
    if scene.lens is None:
        return np.zeros(len(states), np.uintp)
    return np.array([_address(scene.vignetting(s.effective_f_number)) for s in states], np.uintp)


def _address(array: np.ndarray | None) -> int:
    return 0 if array is None else array.ctypes.data


def blur_column(exposure: decision.Exposure) -> tuple[Any, ...]:
    """The `BLUR` of an exposure."""
    path, own = exposure.path or Path(exposure.motion_px), exposure.subject_path
    drift = (0.0, 0.0) if own is None else own[3:]
    numbers = exposure.defocus_px, exposure.motion_px, exposure.path is None
    layout = layout_column(exposure.layout, own is not None)
    return (*numbers, *path[:3], *drift, *layout, _address(exposure.vignetting))


def layout_column(layout: Layout | None, subject: bool) -> tuple[int, ...]:
    """The `LAYOUT` of a layout, 0 where there is none, or none of its `subject`."""
    arrays = () if layout is None else layout.arrays[: 4 if subject else 2]
    found = [array.__array_interface__["data"][0] for array in arrays] + [0] * (4 - len(arrays))
    return (*found[:2], arrays[1].size if arrays else 0, *found[2:])


@kernel(fastmath={"contract"})
def plan_frames(first, last, known, camera, given, made):  # type: ignore[no-untyped-def]
    """Plans frames `first` to `last` of those that are `given`, and fills in columns.

    Args:
        first, last: Frames to plan.
        known: `SCENE` of all scenes, `LightStatistics.columns` and `vignetting_column` of those at
            rest.
        camera: `STATE`, (T, S, 2, 4) shot and read noise of its captures, height of the frames
            [pixel], and (4,) what each of `BLURS` that runs adds to the modules, and what is always
            added.
        given: (K,) scenes, rows of the columns, and light relative to the scene's own.
        made: The columns: (N,) `BLUR`, (N, 5, 4) of `exposure_table`, (N,) error of the blurs that
            are left out, and (N,) modules, as sums.
    """
    (scenes, statistics, vignetting), (states, targets, height, bits) = known, camera
    (indices, rows, gains), (blurs, table, error, modules) = given, made
    extents, errors, runs = np.zeros(3), np.empty(3), np.empty(3, np.bool_)
    for k in range(first, last):
        row, at = rows[k], rows[k] % len(states)
        scene, state, blur = scenes[indices[k]], states[at], blurs[row]
        target, time = targets[scene.targets, at], state.time
        ratio = 2.0 ** (state.log2_exposure - scene.log2_reference)
        ratio = min(scene.gain * gains[k] * ratio, decision.RATIO_LIMIT)
        mask = scene.mask if scene.subject_speed > 0.0 else np.uintp(0)  # of a subject that moves
        drift = scene.subject_speed * time * height if mask else 0.0
        blur.extent = moved = scene.speed * time * height
        blur.direction, blur.turn = scene.direction, scene.turn * time
        blur.streaks = scene.direction == 0.0 and scene.turn == 0.0 and not mask
        blur.drift_x = drift * math.cos(scene.subject_direction)
        blur.drift_y = drift * math.sin(scene.subject_direction)
        own = path_length(moved, blur.direction, blur.turn, blur.drift_x, blur.drift_y)
        moved = max(moved, own)
        extents[1], extents[2] = scene.defocus * 4.0 / state.f_number, moved
        disc = line = math.inf
        if scene.tolerance > 0.0 and extents[1] + moved > 0.0:
            disc, line = curvature(statistics[scene.rest], ratio, target)
            line = line if blur.streaks else decision.STREAK_TO_DISC * disc
        decision.weigh_blurs(extents, disc, line, 0.0, scene.tolerance, errors, runs)
        blur.defocus_px = extents[1] if runs[1] else 0.0
        blur.motion_px = moved if runs[2] else 0.0
        blur.diameter, blur.sorts = scene.diameter, scene.sorts
        blur.num_sorts, blur.mask, blur.behind = scene.num_sorts, mask, scene.behind
        blur.vignetting = vignetting[scene.rest, at]
        modules[row] = bits[3] + runs[1] * bits[0] + runs[2] * bits[1]
        modules[row] += (blur.vignetting > 0) * bits[2]
        left_out = 0.0
        for i in range(1, 3):
            if not runs[i]:
                left_out += errors[i] * errors[i]
        error[row] = math.sqrt(left_out)
        for plane in range(4):
            table[row, 0, plane] = ratio
            table[row, 1, plane], table[row, 2, plane] = target[0, plane], target[1, plane]
            table[row, 3, plane] = table[row, 4, plane] = 0.0


def plan_sweep(
    scene: PreparedScene, states: Sequence[CameraSettings], gains: np.ndarray, *, noise: bool
) -> tuple[Sequence[decision.Origin], np.ndarray, np.ndarray, Sequence[torch.Tensor | None] | None]:
    """Captures of one scene at S states, in light (S,) relative to its own; see `decide`.

    Returns:
        The origins of their light, `BLUR` (S,), (S, 5, 4) of `exposure_table`, and the
        `Exposure.remaining_variance`, None in place of all where the source has no noise.
    """
    # One state alone is decided on in less time than it takes to call a kernel.
    if len(states) < 2 or not fits_columns(scene, columns := state_columns(states)):
        pairs = zip(states, gains.tolist(), strict=True)
        exposures = [decision.decide(scene, state, noise=noise, gain=gain) for state, gain in pairs]
        blurs = np.array([*map(blur_column, exposures)], BLUR)
        shares = [exposure.remaining_variance for exposure in exposures]
        return [e.origin for e in exposures], blurs, exposure_table(exposures), shares
    count, rows, height = len(states), np.arange(len(states)), scene.light.shape[-2]
    made = np.zeros(count, BLUR), np.empty((count, 5, 4), np.float32), np.empty(count), 0 * rows
    own = np.array([scene_column(scene, 0, 0)], SCENE), statistics_column(scene)[None]
    known = *own, vignetting_column(scene, states)[None]
    targets = noise_columns(scene.camera, states, scene.box_factor)[None]
    camera = columns, targets, height, np.zeros(4, int)
    plan_frames(0, count, known, camera, (0 * rows, rows, gains.astype(float)), made)
    return [(None, None)] * count, made[0], made[1], None
