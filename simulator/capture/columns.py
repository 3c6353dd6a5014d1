"""Captures in columns: how each is exposed, in a batch of scenes or in a sweep of one.

`plan_frames` decides which steps each takes from the light of its scene to the sensor, and predicts
its errors; `simulator.capture.plan.SimulationPlan` shows why.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.capture.blurred_frames import BLUR, LAYOUT, Layout
from simulator.capture.limits import MAX_DISC_PX, RATIO_LIMIT
from simulator.capture.statistics import (
    BINS,
    LEVELS,
    ROUNDING,
    DenoisedLight,
    blur_change,
    curvature,
    excess_error,
    hidden_highlights,
    network_error,
    relative_level,
    variance_beyond,
)
from simulator.noise.noise_level_function import VARIANCE_LIMIT
from simulator.optics import discs
from simulator.optics.motion import path_length, taps_of
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
#: Networks of a scene, at most.
NETWORKS = 3
#: The noise of a light, and all that the errors depend on which it makes; see `PreparedScene`.
NOISE = np.dtype(
    [
        ("source", "f8", (2, 4)),  # shot and read noise
        ("clipped", "f8", 2),  # `PreparedScene.clipped_light`
        ("bins", "f8", (4, 4, BINS)),  # `LightStatistics.bins` without differences
        # Of the networks: `LightStatistics.columns` of what they have denoised, and
        # `ResidualStatistics.columns`, 0 where the error was not measured.
        ("denoised", "f8", (NETWORKS, 4, 4, BINS)),
        ("residuals", "f8", (NETWORKS, 4, 4, LEVELS)),
        # Of the `ApertureBlur`: its f-number, 0 for none, and the mean square of its diameters.
        *((n, "f8") for n in ("f_number", "mean_square")),
        # How many networks there are, whether the aperture blur needs one, whether there is any
        # noise, and which of the above is known; no bools: every element is aligned.
        *((n, "i8") for n in ("networks", "needs_network", "noisy", "known", "knows_residuals")),
        ("knows_denoised", "i8", NETWORKS),
    ]
)
#: The steps that `plan_frames` decides on, in the order of their bits.
STEPS = ("noise_reduction", "aperture", "defocus", "motion_blur", "vignetting")
#: The errors of a capture, in units of the target's noise: of leaving out each of the first four
#: steps, and, of what runs and of what is not known, those that `SimulationPlan.errors` names.
ERRORS = (*STEPS[:4], "network", "clipped highlights", "unknown depth", "ISO", "rounding")
_NETWORK, _CLIPPED, _DEPTH, _ISO, _ROUNDING = range(4, 9)
#: Errors of the estimated map of defocus: the blur that it cannot see [pixel of diameter], and the
#: factor by which what a blurred picture changes when it is blurred again understates what it would
#: change if it were sharpened.
MISSED_BLUR, KEPT_BLUR_ERROR = 0.7, 3.0
#: Relative error of the noise's standard deviation for each stop of ISO beyond the calibration:
#: without their last ISOs the Z6's table is off by 0.03 to 0.05, the 70D's by 0.17 to 0.25.
EXTRAPOLATION_ERROR = 0.1
#: Second moment of a streak over that of a disc of the same extent, per axis: (1/12) / (1/16).
STREAK_TO_DISC = 4.0 / 3.0
#: In place of an address of `Transitions.remaining_variance`: of a map that is to be made.
TO_BE_MADE = 1
#: In place of modules: what `add_networks` has to add before a capture can be planned, the
#: residuals, or from the next lower number on what each of the networks has denoised.
LACKING = -1
#: How a scene is out of focus and moves: `PreparedScene.defocus`, `image_speed` and `movement`.
MOVES = np.dtype([(name, "f8") for name in _MOVES])
#: All of a state that the exposure of a capture depends on.
STATE = np.dtype([(n, "f8") for n in ("log2_exposure", "time", "f_number", "extrapolation_error")])


def state_columns(camera: CameraProfile, states: Sequence[CameraSettings]) -> np.ndarray:
    """(S,) `STATE`."""
    errors = [EXTRAPOLATION_ERROR * abs(n.extrapolation) for n in camera.nlfs(states)]
    numbers = [(s.log2_exposure, s.exposure_time, s.effective_f_number) for s in states]
    return np.array([(*own, e) for own, e in zip(numbers, errors, strict=True)], STATE)


def noise_columns(camera: CameraProfile, states: Sequence[CameraSettings], box: int) -> np.ndarray:
    """(S, 2, 4) shot and read noise of captures, `box` squared sensor pixels averaged."""
    return np.array([(nlf.shot, nlf.read) for nlf in camera.nlfs(states)]) * (1.0 / box**2)


def check_disc(defocus: float, f_number: float, shape: tuple[int, ...]) -> None:
    """A `ValueError` unless frames (..., H, W) may have the disc of a `defocus` at `f_number`."""
    diameter, most = defocus * 4.0 / f_number, max(*shape[-2:], MAX_DISC_PX)
    if diameter > most:
        raise ValueError(
            f"`defocus` (={defocus!r} pixel at f/4) makes a disc of {diameter:.4g} pixel at "
            f"f/{f_number:.3g}: it must be at most {most:g} pixel, as wide as the frame "
            f"({MAX_DISC_PX:g} on smaller ones)"
        )


def statistics_column(scene: PreparedScene) -> np.ndarray:
    """The `LightStatistics.columns` of a scene, which take a pass over its pixels; 0 if unused."""
    moves = scene.image_speed or scene.movement.subject_speed
    if scene.defocus or moves or scene.aperture_blur is not None:
        return scene.statistics.columns
    return np.zeros((4, 4, BINS))


def opening_column(scene: PreparedScene, states: np.ndarray) -> np.ndarray:
    """(S,) diameters of the blur that opening the aperture adds at `STATE` (S,) [pixel]."""
    blur, numbers = scene.aperture_blur, states["f_number"].tolist()
    return np.array([0.0 if blur is None else blur.extent(f_number) for f_number in numbers])


def noise_column(scene: PreparedScene, states: np.ndarray, *, errors: bool) -> np.ndarray:
    """The `NOISE` of a scene for `STATE` (S,), which takes a pass over its pixels.

    `add_networks` adds to it. Without `errors`, what does not decide on steps is left out.
    """
    found, blur = np.zeros((), NOISE), scene.aperture_blur
    found["source"] = scene.nlf.shot, scene.nlf.read
    if not scene.nlf.is_zero:
        found["noisy"], found["networks"] = True, len(scene.denoised_lights)
        found["needs_network"] = blur is not None and blur.needs_denoised
    if errors or found["networks"]:  # else nothing is decided by it
        found["known"], found["bins"] = True, scene.statistics.bins[:4]
    if errors:
        found["clipped"] = scene.clipped_light
    if errors and blur is not None:
        found["f_number"] = blur.f_number
        if states["f_number"].max() > blur.f_number:  # else no map need be estimated for it
            found["mean_square"] = blur.mean_square_diameter
    return found


def add_networks(found: np.ndarray, scene: PreparedScene, lacking: Iterable[int]) -> None:
    """Adds what is `LACKING` to the `NOISE` of a scene; a network runs for it."""
    for number in {*lacking}:
        if number == LACKING:
            found["knows_residuals"] = True
            for place, network in enumerate(scene.denoised_lights):
                if network.residual is not None:
                    residuals = scene.blurred_light.residuals.columns(network.residual)
                    found["residuals"][place] = residuals
        else:
            place = LACKING - number - 1
            found["denoised"][place] = scene.denoised_lights[place].statistics.columns
            found["knows_denoised"][place] = True


def scene_column(scene: PreparedScene, targets: int, rest: int) -> tuple[Any, ...]:
    """The `SCENE` of a scene."""
    movement = scene.movement
    return (
        *(scene.reference.log2_exposure, scene.gain, scene.tolerance),
        *(scene.defocus, scene.image_speed, movement.direction, movement.turn),
        *(movement.subject_speed, movement.subject_direction, targets, rest),
        *layout_column(scene.layout),
    )


def vignetting_column(scene: PreparedScene, states: Sequence[CameraSettings]) -> np.ndarray:
    """(S,) uintp addresses of the vignetting of captures, 0 for none; the lens keeps its maps."""
    maps = [scene.vignetting(s.effective_f_number) for s in states]
    return np.array([0 if gains is None else gains.ctypes.data for gains in maps], np.uintp)


def layout_column(layout: Layout | None) -> tuple[int, ...]:
    """The `LAYOUT` of a layout, 0 where there is none, or no subject."""
    arrays = () if layout is None else layout.arrays
    found = [array.__array_interface__["data"][0] for array in arrays] + [0] * (4 - len(arrays))
    return (*found[:2], arrays[1].size if arrays else 0, *found[2:])


@kernel(fastmath={"contract"})
def plan_frames(first, last, known, noises, camera, given, made):  # type: ignore[no-untyped-def]
    """Plans frames `first` to `last` of those that are `given`, and fills in columns.

    Args:
        first, last: Frames to plan.
        known: `SCENE` of all scenes; of those at rest `LightStatistics.columns`,
            `vignetting_column` and `opening_column`.
        noises: `NOISE` of scenes at rest; None where none has any, and no errors are asked for.
        camera: `STATE`, (T, S, 2, 4) shot and read noise of its captures, height and width of the
            frames [pixel], (7,) what each of `STEPS` that runs adds to the modules, and what is
            always added for clean and for noisy light, and the tables of `remaining_energy`.
        given: (K,) scenes, rows of the columns, and light relative to the scene's own; and whether
            captures are wanted, or light without noise.
        made: The columns: (N,) `BLUR`, (N, 5, 4) of `Transitions.table`, (N,) error of all that is
            left out or not known, but for `opening_errors`, (N,) excess variance, NaN where it
            differs between pixels, (N,) addresses of `Transitions.remaining_variance`, 0 for none,
            (N,) modules, as sums, or what is `LACKING`, and (N, 12) or none at all, each of
            `ERRORS`, and the extents of aperture, defocus and motion blur [pixel].
    """
    (scenes, statistics, vignetting, openings), states = known, camera[0]
    targets, size, bits, tables = camera[1:]
    (indices, rows, gains, wanted), (blurs, table, error, excess, shares, modules) = given, made[:6]
    extents, errors, runs = np.zeros(3), np.empty(len(ERRORS)), np.empty(3, np.bool_)
    source = np.empty((2, 4))
    for k in range(first, last):
        row, at = rows[k], rows[k] % len(states)
        scene, state, blur = scenes[indices[k]], states[at], blurs[row]
        target = targets[scene.targets, at]
        ratio = 2.0 ** (state.log2_exposure - scene.log2_reference)
        ratio = min(scene.gain * gains[k] * ratio, RATIO_LIMIT)
        _set_motion(scene, state.time, size[0], blur)
        extents[0] = openings[scene.rest, at]
        extents[1], extents[2] = scene.defocus * 4.0 / state.f_number, blur.motion_px
        missing, network = 0.0, 0
        errors[:] = 0.0
        if noises is not None and noises[scene.rest].known:
            noise = noises[scene.rest], ratio, target, scene.tolerance, statistics[scene.rest, 2]
            network, missing = _weigh_noise(noise, state, wanted, extents[0] > 0.0, errors)
        disc = line = math.inf
        shows = extents[1] + extents[2] > 0.0 or 0.0 < extents[0] < math.inf
        if scene.tolerance > 0.0 and shows:  # else no network runs for it
            starts = noises, network, scene.rest, statistics
            disc, line, network = _bound_blurs(*starts, ratio, target)
            line = line if blur.streaks else STREAK_TO_DISC * disc
        _weigh_blurs(extents, disc, line, missing, scene.tolerance, errors[1:4], runs)
        blur.defocus_px = extents[1] if runs[1] else 0.0
        blur.motion_px = extents[2] if runs[2] else 0.0
        blur.diameter, blur.sorts = scene.diameter, scene.sorts
        blur.num_sorts, blur.behind = scene.num_sorts, scene.behind
        blur.vignetting = vignetting[scene.rest, at]
        modules[row] = bits[5] + (blur.vignetting > 0) * bits[4]
        square = 0.0 if network else errors[0] * errors[0]
        for i in range(1, len(errors)):
            if i < _NETWORK:
                modules[row] += runs[i - 1] * bits[i]
            if i >= _NETWORK or not runs[i - 1]:
                square += errors[i] * errors[i]
        error[row] = math.sqrt(square)
        if len(made[6]):
            made[6][row, : len(ERRORS)], made[6][row, len(ERRORS) :] = errors, extents
        excess[row], shares[row], source[:] = 0.0, 0, 0.0
        if noises is not None and noises[scene.rest].noisy:
            modules[row] += bits[6] - bits[5] + network * bits[0]
            if network == 0:
                apart = blur.diameter > 0 and (runs[1] or (runs[2] and blur.mask > 0))
                shares[row] = np.uintp(TO_BE_MADE) if apart or runs[0] else blur.vignetting
                energy = 1.0 if apart else remaining_energy(blur, size, tables)
                own = noises[scene.rest]
                _expose(own.source, ratio, energy, source)
                excess[row] = _mean_excess(own.bins, ratio, source, target, shares[row] > 0)
        for plane in range(4):
            table[row, 0, plane] = ratio
            for kind in range(2):
                table[row, 1 + kind, plane] = target[kind, plane] - source[kind, plane]
                table[row, 3 + kind, plane] = source[kind, plane]
        if network < 0:
            modules[row] = network


@kernel()
def _bound_blurs(noises, network, rest, statistics, ratio, target):  # type: ignore[no-untyped-def]
    """`curvature` of the light that a capture starts from; its network, or what is `LACKING`."""
    if noises is not None and network > 0:
        own = noises[rest]
        if not own.knows_denoised[network - 1]:
            return math.inf, math.inf, LACKING - network
        disc, line = curvature(own.denoised[network - 1], ratio, target)
    else:
        disc, line = curvature(statistics[rest], ratio, target)
    return disc, line, network


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
def _weigh_noise(noise, state, wanted, opens, errors):  # type: ignore[no-untyped-def]
    """The network, from 1 on, whose light a capture starts from, 0 for none, or `LACKING`.

    It is the cheapest within the tolerance, or else the one with the least error; where the
    aperture `opens` and its blur works on no other light, always the last. Also the error that
    counts where blurs are weighed. Fills in the `errors` that noise makes, and those of what is not
    known. `noise` ends with the Laplacians of `LightStatistics.columns`.
    """
    own, ratio, target, tolerance, laplacians = noise
    bins, network, error = own.bins, 0, math.inf
    if wanted:
        left = excess_error(bins[0], bins[1:3], ratio, own.source, target)
    else:
        exposed = np.empty((2, 4))
        _expose(own.source, ratio, 1.0, exposed)
        left = math.sqrt(variance_beyond(bins[0], bins[3], ratio, exposed, target, 0.0))
    must = own.networks > 0 and own.needs_network > 0 and opens
    weighs = must or (own.networks > 0 and left > tolerance)
    if weighs and not own.knows_residuals:
        return LACKING, 0.0
    for number in range(own.networks if weighs else 0):
        found = own.residuals[number]
        light = found[2], found[3], ratio, own.source, target
        made = network_error(found[0], found[1], *light, wanted)
        if must or made < error:
            network, error = number + 1, made
        if made <= tolerance and not must:
            break
    if network == 0 or (left <= error and not must):
        network, error = 0, left
    errors[0], errors[_NETWORK] = left, error if network else 0.0
    errors[_CLIPPED] = hidden_highlights(ratio, target, own.clipped[0], own.clipped[1])
    errors[_ISO] = wanted * state.extrapolation_error
    errors[_ROUNDING] = ROUNDING * relative_level(bins[0], bins[3], ratio, target)
    if own.f_number != 0.0 and own.f_number != state.f_number:
        change = blur_change(bins[0], bins[3], laplacians, ratio, own.source, target, wanted)
        wide = own.f_number / state.f_number
        if wide <= 1.0:  # what a smaller aperture would sharpen stays blurred
            errors[_DEPTH] = KEPT_BLUR_ERROR * change * own.mean_square * (1.0 - wide * wide)
        else:
            errors[_DEPTH] = change * MISSED_BLUR**2 * (wide * wide - 1.0)
    return network, error if own.networks > 0 and error <= tolerance else 0.0


@kernel()
def _weigh_blurs(  # type: ignore[no-untyped-def]
    extents, disc, row, missing_noise, tolerance, errors, runs
):
    """Which of aperture, defocus and motion blur run, and the error of leaving each out, (3,) each.

    `extents` (3,) are in pixels, inf where it is not known; `disc` and `row` are the `curvature` of
    the light. Noise that stays, `missing_noise`, widens a pixel's distribution, blur that is
    missing shifts it: squares add. Several missing blurs shift it the same way and add up; the
    error of each is what it adds to the square, so that the root of the sum of squares of all
    errors is right for any set of steps.
    """
    missing_blur = 0.0
    for i in range(3):
        errors[i], runs[i], extent = 0.0, False, extents[i]
        if extent == 0.0:
            continue
        error = math.inf
        if extent < math.inf:
            error = (row if i == 2 else disc) * extent * extent
        together = missing_blur + error
        runs[i] = not math.hypot(missing_noise, together) <= tolerance
        if error:
            errors[i] = math.sqrt(error * (together + missing_blur))
        if not runs[i]:
            missing_blur = together


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
def _mean_excess(bins, ratio, source, target, differs):  # type: ignore[no-untyped-def]
    """The excess variance of exposed noise of a `source`; NaN where it `differs` between pixels."""
    exceeds = False
    for kind in range(2):
        for plane in range(4):
            exceeds |= source[kind, plane] > target[kind, plane]
    if not exceeds:
        return 0.0
    excess = variance_beyond(bins[0], bins[3], ratio, source, target, 1.0)
    return math.nan if differs and excess > 0.0 else excess


@kernel()
def _expose(source, ratio, energy, out):  # type: ignore[no-untyped-def]
    """A source's noise (2, 4) on the target's scale, of which blurs leave the share `energy`."""
    for kind in range(2):
        exposed = ratio if kind == 0 else ratio * ratio
        for plane in range(4):
            out[kind, plane] = min(source[kind, plane] * exposed, VARIANCE_LIMIT) * energy


def blur_tables() -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """The tables of `remaining_energy`."""
    return discs.disc_correlations(), discs.radius_table()


#: The light of a scene that a capture starts from: which network has denoised it, and the
#: effective f-number that it is opened to; None for neither.
Origin = tuple[DenoisedLight | None, float | None]


class Planned(NamedTuple):
    """How S captures of one scene are made, in columns; see `plan_frames`."""

    origins: list[Origin]
    blurs: np.ndarray  # (S,) `BLUR`
    table: np.ndarray  # (S, 5, 4) of `Transitions.table`
    shares: list[torch.Tensor | None]  # of `Transitions.remaining_variance`
    details: np.ndarray  # (S, 12) `ERRORS`, and extents of aperture, defocus and motion [pixel]


def plan_captures(
    scene: PreparedScene,
    states: Sequence[CameraSettings],
    gains: np.ndarray | None = None,
    *,
    noise: bool = True,
    errors: bool = False,
) -> Planned:
    """Captures of a scene at S states, in light (S,) relative to its own, or without `noise`.

    Without `errors`, only those that decide on steps are worked out, the others are 0. A
    `ValueError` where a disc is too wide.
    """
    columns, count, rows = state_columns(scene.camera, states), len(states), np.arange(len(states))
    check_disc(scene.defocus, columns["f_number"].min().item(), scene.light.shape)
    blurs, table, modules = np.zeros(count, BLUR), np.empty((count, 5, 4), np.float32), 0 * rows
    made = blurs, table, *np.empty((2, count)), np.zeros(count, np.uintp), modules
    details = np.zeros((count, len(ERRORS) + 3))
    own = np.array([scene_column(scene, 0, 0)], SCENE), statistics_column(scene)[None]
    known = *own, vignetting_column(scene, states)[None], opening_column(scene, columns)[None]
    counts = errors or not scene.nlf.is_zero
    noises = noise_column(scene, columns, errors=errors)[None] if counts else None
    targets = noise_columns(scene.camera, states, scene.box_factor)[None]
    bits = np.array([1, NETWORKS + 1, 0, 0, 0, 0, 0])  # of noise reduction and aperture alone
    camera = columns, targets, tuple(scene.light.shape[-2:]), bits, blur_tables()
    given = 0 * rows, rows, np.ones(count) if gains is None else gains.astype(float), bool(noise)
    plan_frames(0, count, known, noises, camera, given, (*made, details))
    while (modules < 0).any():
        assert noises is not None
        add_networks(noises[0], scene, modules[modules < 0].tolist())
        plan_frames(0, count, known, noises, camera, given, (*made, details))
    networks, numbers = (None, *scene.denoised_lights), columns["f_number"].tolist()
    opens, which = (found.tolist() for found in np.divmod(modules, NETWORKS + 1))
    each = zip(which, opens, numbers, strict=True)
    origins = [(networks[network], number if opened else None) for network, opened, number in each]
    left: list[torch.Tensor | None] = [None] * count
    for i in np.flatnonzero(made[4]).tolist():
        fixed = scene.layout, scene.vignetting(numbers[i]), origins[i][1]
        left[i] = scene.blurred_light.remaining_variance(blurs[i], *fixed)
    return Planned(origins, blurs, table, left, details)
