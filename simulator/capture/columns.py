"""Captures in columns: how each is exposed, in a batch of scenes or in a sweep of one.

`plan_frames` is `simulator.capture.decision.decide` for many scenes, with the errors and the excess
of noise of `simulator.capture.plan`.
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
from simulator.capture.statistics import (
    BINS,
    LEVELS,
    ROUNDING,
    curvature,
    excess_error,
    hidden_highlights,
    network_error,
    relative_excess_variance,
    relative_level,
)
from simulator.noise.noise_level_function import VARIANCE_LIMIT
from simulator.optics import discs
from simulator.optics.motion import Path, path_length, taps_of
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
#: The noise of a light, and what errors depend on that it makes; see `PreparedScene`.
NOISE = np.dtype(
    [
        ("source", "f8", (2, 4)),  # shot and read noise
        ("clipped", "f8", 2),  # `PreparedScene.clipped_light`
        ("bins", "f8", (4, 4, BINS)),  # `LightStatistics.noise_columns`
        # Of the light that a network has denoised, if any: `LightStatistics.columns` and
        # `ResidualStatistics.columns`, 0 where its error was not measured.
        ("denoised", "f8", (4, 4, BINS)),
        ("residual", "f8", (4, 4, LEVELS)),
        ("has_network", "i8"),  # no bool: every element is aligned
        ("noisy", "i8"),  # whether there is any noise
    ]
)
#: The steps that `plan_frames` decides on, in the order of their bits.
STEPS = ("noise_reduction", "defocus", "motion_blur", "vignetting")
#: How a scene is out of focus and moves: `PreparedScene.defocus`, `image_speed` and `movement`.
MOVES = np.dtype([(name, "f8") for name in _MOVES])
#: All of a state that the exposure of a capture depends on.
STATE = np.dtype([(n, "f8") for n in ("log2_exposure", "time", "f_number", "extrapolation_error")])


def state_columns(camera: CameraProfile, states: Sequence[CameraSettings]) -> np.ndarray:
    """(S,) `STATE`."""
    errors = [decision.EXTRAPOLATION_ERROR * abs(n.extrapolation) for n in camera.nlfs(states)]
    numbers = [(s.log2_exposure, s.exposure_time, s.effective_f_number) for s in states]
    return np.array([(*own, e) for own, e in zip(numbers, errors, strict=True)], STATE)


def noise_columns(camera: CameraProfile, states: Sequence[CameraSettings], box: int) -> np.ndarray:
    """(S, 2, 4) shot and read noise of captures, `box` squared sensor pixels averaged."""
    return np.array([(nlf.shot, nlf.read) for nlf in camera.nlfs(states)]) * (1.0 / box**2)


def fits_columns(scene: PreparedScene, states: np.ndarray, *, noise: bool) -> bool:
    """Whether `plan_frames` can plan captures of a scene at `STATE` (S,), with `noise`.

    It has no aperture to open. Noise of its light is in captures, which neither a layout nor a lens
    averages differently from pixel to pixel, and at most one network, which has run, removes it.
    Discs that are too wide do not fit: `decide` raises an error for these.
    """
    if scene.aperture_blur is not None or scene.defocus > widest_defocus(scene, states):
        return False
    networks, alike = scene.denoised_lights, scene.layout is None and scene.lens is None
    known = len(networks) < 2 and all(n.shape and n.rounding is None for n in networks)
    return scene.nlf.is_zero or (noise and alike and known)


def widest_defocus(scene: PreparedScene, states: np.ndarray) -> float:
    """The largest `PreparedScene.defocus` whose disc is not too wide at `STATE` (S,)."""
    most = max(*scene.light.shape[-2:], decision.MAX_DISC_PX)
    return float(most * states["f_number"].min() / 4.0)


def statistics_column(scene: PreparedScene) -> np.ndarray:
    """The `LightStatistics.columns` of a scene, which take a pass over its pixels; 0 if unused."""
    if scene.defocus or scene.image_speed or scene.movement.subject_speed:
        return scene.statistics.columns
    return np.zeros((4, 4, BINS))


def noise_column(scene: PreparedScene) -> np.ndarray:
    """The `NOISE` of a scene that `fits_columns`, which takes a pass over its pixels."""
    found = np.zeros((), NOISE)
    if scene.nlf.is_zero:
        return found
    found["source"], found["clipped"] = (scene.nlf.shot, scene.nlf.read), scene.clipped_light
    found["bins"], found["noisy"] = scene.statistics.noise_columns, True
    for network in scene.denoised_lights:
        found["denoised"], found["has_network"] = network.statistics.columns, True
        if network.residual is not None:
            found["residual"] = scene.blurred_light.residuals.columns(network.residual)
    return found


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
def plan_frames(first, last, known, noises, camera, given, made):  # type: ignore[no-untyped-def]
    """Plans frames `first` to `last` of those that are `given`, and fills in columns.

    Args:
        first, last: Frames to plan.
        known: `SCENE` of all scenes, `LightStatistics.columns` and `vignetting_column` of those at
            rest.
        noises: `NOISE` of scenes at rest; None where none has any.
        camera: `STATE`, (T, S, 2, 4) shot and read noise of its captures, height and width of the
            frames [pixel], (6,) what each of `STEPS` that runs adds to the modules, and what is
            always added for clean and for noisy light, and the tables of `remaining_energy`.
        given: (K,) scenes, rows of the columns, and light relative to the scene's own.
        made: The columns: (N,) `BLUR`, (N, 5, 4) of `exposure_table`, (N,) error of all that is
            left out or not known, (N,) excess variance, and (N,) modules, as sums.
    """
    (scenes, statistics, vignetting), (states, targets, size, bits, tables) = known, camera
    (indices, rows, gains), (blurs, table, error, excess, modules) = given, made
    extents, errors, runs = np.zeros(3), np.empty(3), np.empty(3, np.bool_)
    for k in range(first, last):
        row, at = rows[k], rows[k] % len(states)
        scene, state, blur = scenes[indices[k]], states[at], blurs[row]
        target = targets[scene.targets, at]
        ratio = 2.0 ** (state.log2_exposure - scene.log2_reference)
        ratio = min(scene.gain * gains[k] * ratio, decision.RATIO_LIMIT)
        _set_motion(scene, state.time, size[0], blur)
        extents[1], extents[2] = scene.defocus * 4.0 / state.f_number, blur.motion_px
        missing = square = 0.0
        denoises = False
        if noises is not None and noises[scene.rest].noisy:
            own = noises[scene.rest]
            denoises, missing, square = _weigh_noise(own, ratio, target, scene.tolerance)
            square += state.extrapolation_error**2
        disc = line = math.inf
        if scene.tolerance > 0.0 and extents[1] + extents[2] > 0.0:
            if noises is not None and denoises:
                disc, line = curvature(noises[scene.rest].denoised, ratio, target)
            else:
                disc, line = curvature(statistics[scene.rest], ratio, target)
            line = line if blur.streaks else decision.STREAK_TO_DISC * disc
        decision.weigh_blurs(extents, disc, line, missing, scene.tolerance, errors, runs)
        blur.defocus_px = extents[1] if runs[1] else 0.0
        blur.motion_px = extents[2] if runs[2] else 0.0
        blur.diameter, blur.sorts = scene.diameter, scene.sorts
        blur.num_sorts, blur.behind = scene.num_sorts, scene.behind
        blur.vignetting = vignetting[scene.rest, at]
        modules[row] = bits[4] + runs[1] * bits[1] + runs[2] * bits[2]
        modules[row] += (blur.vignetting > 0) * bits[3]
        for i in range(1, 3):
            if not runs[i]:
                square += errors[i] * errors[i]
        error[row], excess[row] = math.sqrt(square), 0.0
        for plane in range(4):
            table[row, 0, plane] = ratio
            table[row, 1, plane], table[row, 2, plane] = target[0, plane], target[1, plane]
            table[row, 3, plane] = table[row, 4, plane] = 0.0
        if noises is not None and noises[scene.rest].noisy:
            modules[row] += bits[5] - bits[4] + denoises * bits[0]
            if not denoises:
                energy = remaining_energy(blur, size, tables)
                own = noises[scene.rest]
                excess[row] = _add_source(own, ratio, energy, target, table[row])


@kernel()
def _set_motion(scene, time, height, blur):  # type: ignore[no-untyped-def]
    """Sets how the image moves in an exposure of a `time` [s], whether that shows or not."""
    blur.mask = scene.mask if scene.subject_speed > 0.0 else np.uintp(0)  # of one that moves
    drift = scene.subject_speed * time * height if blur.mask else 0.0
    blur.extent = scene.speed * time * height
    blur.direction, blur.turn = scene.direction, scene.turn * time
    blur.streaks = scene.direction == 0.0 and scene.turn == 0.0 and not blur.mask
    blur.drift_x = drift * math.cos(scene.subject_direction)
    blur.drift_y = drift * math.sin(scene.subject_direction)
    own = path_length(blur.extent, blur.direction, blur.turn, blur.drift_x, blur.drift_y)
    blur.motion_px = max(blur.extent, own)


@kernel()
def _weigh_noise(own, ratio, target, tolerance):  # type: ignore[no-untyped-def]
    """Whether a capture starts from denoised light; see `decision` and `plan.predict_errors`.

    Also the error that counts where blurs are weighed, and the square of all errors that noise and
    clipped highlights make.
    """
    bins, network = own.bins, own.residual
    left = excess_error(bins[0], bins[1:3], ratio, own.source, target)
    made = math.inf
    if own.has_network:
        light = network[2], network[3], ratio, own.source, target
        made = network_error(network[0], network[1], *light, True)
    denoises = left > tolerance and not left <= made
    error = made if denoises else left
    hidden = hidden_highlights(ratio, target, own.clipped[0], own.clipped[1])
    rounding = ROUNDING * relative_level(bins[0], bins[3], ratio, target)
    missing = error if own.has_network and error <= tolerance else 0.0
    return denoises, missing, error * error + hidden * hidden + rounding * rounding


@kernel()
def remaining_energy(blur, size, tables):  # type: ignore[no-untyped-def]
    """Share of white noise's variance that a `BLUR` without a layout leaves of frames of a `size`.

    `tables` are `discs.disc_correlations` and `discs.radius_table`.
    """
    if blur.motion_px == 0.0 and blur.defocus_px == 0.0:
        return 1.0
    if blur.motion_px == 0.0 or blur.streaks:
        return discs.kernel_energy(blur.motion_px, blur.defocus_px, *tables[1])
    moved = blur.extent, blur.direction, blur.turn, blur.drift_x, blur.drift_y
    return discs.path_energy(taps_of(*moved, *size), blur.defocus_px, tables[0])


@kernel()
def _add_source(own, ratio, energy, target, table):  # type: ignore[no-untyped-def]
    """Completes the `table` (5, 4) with a source's noise; the excess variance."""
    source, exceeds = np.empty((2, 4)), False
    for kind in range(2):
        exposed = ratio if kind == 0 else ratio * ratio
        for plane in range(4):
            source[kind, plane] = min(own.source[kind, plane] * exposed, VARIANCE_LIMIT) * energy
            exceeds |= source[kind, plane] > target[kind, plane]
            table[1 + kind, plane] = target[kind, plane] - source[kind, plane]
            table[3 + kind, plane] = source[kind, plane]
    if not exceeds:
        return 0.0
    return relative_excess_variance(own.bins[0], own.bins[3], ratio, source, target)


def blur_tables() -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """The tables of `remaining_energy`."""
    return discs.disc_correlations(), discs.radius_table()


def plan_sweep(
    scene: PreparedScene, states: Sequence[CameraSettings], gains: np.ndarray, *, noise: bool
) -> tuple[Sequence[decision.Origin], np.ndarray, np.ndarray, Sequence[torch.Tensor | None] | None]:
    """Captures of one scene at S states, in light (S,) relative to its own; see `decide`.

    Returns:
        The origins of their light, `BLUR` (S,), (S, 5, 4) of `exposure_table`, and the
        `Exposure.remaining_variance`, None in place of all where the source has no noise.
    """
    # One state alone is decided on in less time than it takes to call a kernel.
    known = len(states) > 1 and fits_columns(
        scene, columns := state_columns(scene.camera, states), noise=noise
    )
    if not known:
        pairs = zip(states, gains.tolist(), strict=True)
        exposures = [decision.decide(scene, state, noise=noise, gain=gain) for state, gain in pairs]
        blurs = np.array([*map(blur_column, exposures)], BLUR)
        shares = [exposure.remaining_variance for exposure in exposures]
        return [e.origin for e in exposures], blurs, exposure_table(exposures), shares
    count, rows = len(states), np.arange(len(states))
    blurs, table, modules = np.zeros(count, BLUR), np.empty((count, 5, 4), np.float32), 0 * rows
    made = blurs, table, *np.empty((2, count)), modules
    own = np.array([scene_column(scene, 0, 0)], SCENE), statistics_column(scene)[None]
    light = *own, vignetting_column(scene, states)[None]
    noises = None if scene.nlf.is_zero else noise_column(scene)[None]
    targets = noise_columns(scene.camera, states, scene.box_factor)[None]
    bits = np.arange(6) == 0  # of noise reduction alone
    camera = columns, targets, tuple(scene.light.shape[-2:]), 1 * bits, blur_tables()
    plan_frames(0, count, light, noises, camera, (0 * rows, rows, gains.astype(float)), made)
    origins = [(network, None) for network in (None, *scene.denoised_lights)]
    return [origins[denoises] for denoises in modules.tolist()], blurs, table, None
