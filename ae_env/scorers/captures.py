"""What a scorer is, and `Captures`: the facts about the images that it scores.

Captures are described for any batch of frames, or for every state of a scene at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from functools import cached_property, wraps
from typing import Any, Literal, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch

from ae_env.scenes.ladder import Ladder
from ae_env.scenes.scene import Scene
from simulator.camera import CameraProfile
from simulator.capture.columns import plan_captures
from simulator.capture.limits import MAX_DISC_PX
from simulator.capture.prepared_scene import MAX_IMAGE_SPEED, PreparedScene
from simulator.capture.sensor import Transitions
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.optics.discs import DIAMETERS
from simulator.optics.motion import ALONG_ROWS, Movement, path_length
from simulator.radiance.incident_light import LIKELY
from simulator.settings import CameraSettings
from simulator.utils.checks import check_number, check_type
from simulator.utils.compute import kernel, parallel_ranges

#: In place of `Layout.shares` where all pixels have the same blur.
_ALIKE = np.array([[-1.0], [0.0], [1.0]])
_WIDEST = DIAMETERS[-1]
_WORTH_A_THREAD = 256  # captures
_CPU = torch.device("cpu")
Fact = TypeVar("Fact")
ColourMatrix = tuple[tuple[float, float, float], ...]
Domain = Literal["raw", "srgb"]
#: Input that decides a score: ``"image"``, the recorded image with its noise; ``"light"``, the
#: noise-free light on the sensor; ``"blur"``, also (or only) the extent of the blur, which changes
#: from episode to episode. The last two have a closed form and need no noise seeds; in static light
#: they are computed once per episode.
DependsOn = Literal["image", "light", "blur"]


@runtime_checkable
class Scorer(Protocol):
    """Rates images between 0 and 1; higher is better.

    It has ``domain``, ``"raw"`` or ``"srgb"``, and may have ``depends_on``, by default
    ``"image"``. Called with images (B, C, H, W) in [0, 1] (C = 4 for raw, 3 for sRGB) and the
    `Captures` they come from, it returns (B,) in [0, 1]. With ``depends_on`` ``"light"`` or
    ``"blur"`` it reads the captures only and is called with ``images=None``.
    """

    domain: Domain  #: kind of image that it is called with, ``"raw"`` or ``"srgb"``

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,) of the images."""


class PixelBlur(NamedTuple):
    """Blur of B captures whose pixels differ in it, (B, K) float64 each."""

    levels: torch.Tensor  # extents that pixels of a capture have [pixel of the frame]
    shares: torch.Tensor  # shares of the pixels that have them; they sum to 1


def _fact(work_out: Callable[[Any], Fact]) -> cached_property[Fact]:
    """A property that is worked out once; tensors are on its device and count writes always."""

    @wraps(work_out)
    def placed(captures: Any) -> Any:
        found = work_out(captures)
        return found.to(captures.device) if torch.is_tensor(found) else found

    return cached_property(torch.inference_mode(False)(placed))


@dataclass(frozen=True, eq=False)
class Captures:
    """The facts about a batch of B captures besides their pixels, worked out when they are read."""

    settings: Sequence[CameraSettings]  #: of each capture, B long
    nlf: Sequence[NoiseLevelFunction]  #: of a native sensor pixel at the settings, B long
    _shown: ShownScenes
    _which: np.ndarray  # (B,) scene of each capture among those
    _log2_exposure: np.ndarray  # (B,) of the settings
    _gain: np.ndarray  # (B,) light relative to the scenes' own
    _moves: Sequence[np.ndarray]  # see `ShownScenes.blur`
    #: (B, H) float64, light of each row relative to the frame's mean, which is in `ratio` and
    #: `proper_ev`: the bands of flickering light. None where all rows have the same.
    row_gain: torch.Tensor | None = None
    #: Noise that the source of each capture has, of a native pixel, B long; None where all come
    #: from light without noise.
    source_noise: Sequence[NoiseLevelFunction] | None = None
    noisy: bool = True  #: whether the captures have noise
    prnu: float = 0.0  #: `CameraProfile.prnu`, of native pixels
    device: torch.device = _CPU  #: where all tensors are, and the images

    def __len__(self) -> int:
        return len(self.settings)

    def __getstate__(self) -> dict[str, Any]:
        """For copies and pickles, which have the scenes of the captures, but no others."""
        shown = ShownScenes(self._scenes, self._shown.captures)
        return {**vars(self), "_shown": shown, "_which": np.arange(len(self))}

    def cpu(self) -> Captures:
        """The same captures with all tensors on the CPU."""
        rows = None if self.row_gain is None else self.row_gain.cpu()
        return replace(self, row_gain=rows, device=_CPU)

    @cached_property
    def _scenes(self) -> Sequence[Scene]:
        return [self._shown[scene] for scene in self._which.tolist()]

    @cached_property
    def _light(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        return self._shown.light(self._which)

    @_fact
    def _blur(self) -> tuple[np.ndarray, PixelBlur | None, np.ndarray]:
        return self._shown.blur(self._which, *self._moves, pixels=True)

    @_fact
    def ratio(self) -> torch.Tensor:
        """(B,) float64, exposure ratio from the scene's reference settings to the capture."""
        stops = (self._log2_exposure - self._light[0]).tolist()
        return torch.from_numpy(np.array([2.0**stop for stop in stops]) * self._gain)

    @_fact
    def proper_ev(self) -> torch.Tensor:
        """(B,) float64, EV100 of the right exposure; the mean of `likely_ev` if it is unknown."""
        return torch.from_numpy(self._light[1] + np.log2(self._gain))

    @_fact
    def likely_ev(self) -> torch.Tensor | None:
        """(B, K) float64, EV100s that are equally likely right; None where all light is known."""
        likely = self._light[2]
        return None if likely is None else torch.from_numpy(likely + np.log2(self._gain)[:, None])

    @_fact
    def blur_px(self) -> torch.Tensor:
        """(B,) float64, extent of all blur [pixel of the frame]; root mean square over pixels."""
        return torch.from_numpy(self._blur[0])

    @property
    def pixel_blur(self) -> PixelBlur | None:
        """How many pixels have which extent of blur; None where all have `blur_px`."""
        spread = self._blur[1]
        return spread and PixelBlur(*(values.to(self.device) for values in spread))

    @_fact
    def scene_light(self) -> torch.Tensor:
        """(B, 4, H, W) linear light of the scenes at their reference settings, a copy."""
        first, count = self._scenes[0], len(self._scenes)
        if all(scene is first for scene in self._scenes):
            return first.clean_light.clone().expand(count, -1, -1, -1)
        return torch.stack([scene.clean_light for scene in self._scenes])

    @property
    def scene_ids(self) -> Sequence[str]:
        """The scene of each capture, B long."""
        return [scene.scene_id for scene in self._scenes]

    @property
    def ladders(self) -> Sequence[Ladder | None]:
        """The codes that are drawn into the scene of each capture, B long."""
        return [scene.ladder for scene in self._scenes]

    @_fact
    def white_balance(self) -> torch.Tensor:
        """(B, 3) gains of R, G, B."""
        gains = [scene.white_balance for scene in self._scenes]
        return torch.tensor(gains, dtype=torch.float32, device=_CPU)

    @property
    def colour_matrices(self) -> Sequence[ColourMatrix | None]:
        """XYZ (D65) to camera RGB of each scene's light, 3 x 3, B long; None where unknown."""
        return [scene.camera.colour_matrix for scene in self._scenes]

    @_fact
    def light(self) -> torch.Tensor:
        """(B, 4, H, W) noise-free signal at the settings, before blur and clip; white is 1."""
        light = self.scene_light * self.ratio.to(self.scene_light.dtype)[:, None, None, None]
        if self.row_gain is None:
            return light
        return light * self.row_gain.to(light.dtype)[:, None, :, None]

    def noise_variance(self, signal: torch.Tensor) -> torch.Tensor:
        """Variance of a native pixel's noise in the captures, at the recorded `signal`.

        The camera's own at the settings, or the source's where it has more; and what pixels differ
        by. `signal` is (B, 4, ...), at least 0, white is 1.
        """
        variance = torch.zeros_like(signal)
        if not self.noisy:
            return variance
        for noises in (self.nlf, self.source_noise or ()):
            if noises:
                shape = (len(self), 4, *[1] * (signal.ndim - 2))
                shot = torch.tensor([n.shot for n in noises]).reshape(shape).to(signal)
                read = torch.tensor([n.read for n in noises]).reshape(shape).to(signal)
                variance = variance.maximum(signal * shot + read)
        return variance + (self.prnu * signal).square() if self.prnu else variance

    @_fact
    def ev100(self) -> torch.Tensor:
        """(B,) float64, EV100 of the settings, with the effective f-numbers."""
        return torch.tensor([-s.log2_exposure for s in self.settings], dtype=torch.float64)

    @property
    def frame_height(self) -> int:
        """Height of the packed frame [pixel]."""
        return self._scenes[0].light.shape[-2]


def prepare_scene(
    scene: Scene,
    camera: CameraProfile,
    *,
    speed: float = 0.0,
    defocus: float = 0.0,
    movement: Movement = ALONG_ROWS,
) -> PreparedScene:
    """`scene` as `camera` sees it in an episode; a `ValueError` if a number is out of range.

    `speed` is the image's [frame heights per second], `defocus` the blur diameter at f/4 of what is
    least in focus [pixel of a 64-pixel frame]; `movement` has directions, and the subject's own.
    """
    widest = 64.0 * max(1.0, MAX_DISC_PX / scene.light.shape[-2])
    check_number("speed", speed, 0.0, MAX_IMAGE_SPEED, more=" frame heights per second")
    check_number("defocus", defocus, 0.0, widest, more=" pixels of a 64-pixel frame")
    check_type("movement", movement, Movement)
    prepared = scene.prepared.changed(camera=camera)
    return in_episode(prepared, speed=speed, defocus=defocus, movement=movement)


def in_episode(
    prepared: PreparedScene, *, speed: float, defocus: float, movement: Movement
) -> PreparedScene:
    """A scene's `prepared` in an episode; the arguments are those of `prepare_scene`."""
    pixels = defocus * prepared.light.shape[-2] / 64.0
    return prepared.changed(image_speed=speed, defocus=pixels, movement=movement)


def source_noises(
    prepared: PreparedScene, states: Sequence[CameraSettings], gain: float | np.ndarray
) -> list[NoiseLevelFunction] | None:
    """`Captures.source_noise` of captures of `prepared` in the light `gain`, one or (S,)."""
    if prepared.nlf.is_zero:
        return None
    gains = np.broadcast_to(gain, len(states))
    planned = plan_captures(prepared, states, gains)
    lights = [prepared.light] * len(states)
    averaged = Transitions(lights, planned.table, planned.shares).averaged_table()
    noises = averaged[:, 3:].astype(float) * prepared.box_factor**2
    return [NoiseLevelFunction(shot, read) for shot, read in noises.tolist()]


@kernel()
def lacking_facts(scenes, defocus, movements, own, ends):  # type: ignore[no-untyped-def]
    """The captures (K,) whose scenes `ShownScenes` knows too little about."""
    found, count = np.empty(len(scenes), np.int64), 0
    for i in range(len(scenes)):
        differ = defocus[i] != 0.0 or movements[i, 2] != 0.0
        if np.isnan(own[0, scenes[i]]) or (differ and ends[1, scenes[i]] == 0):
            found[count] = i
            count += 1
    return found[:count]


@kernel()
def _fill_levels(begin, end, frames, moves, shown, found):  # type: ignore[no-untyped-def]
    """`PixelBlur` of captures `begin` to `end`, where `levels` and `shares` have memory for it.

    See `ShownScenes` for the columns of scenes that are `shown`. Of what is `found`, `blur` (B,)
    become the root mean squares over the pixels, `sharpness` the means of `Sharpness`.
    """
    (scenes, states, lenses), (speeds, defocus, movements) = frames, moves
    (own, sorts, ends), (levels, shares, blur, sharpness) = shown, found
    for i in range(begin, end):
        scene, (time, f_number) = scenes[i], lenses[states[i]]
        height, differ = own[2, scene], defocus[i] != 0.0 or movements[i, 2] != 0.0
        disc = defocus[i] * (4.0 / f_number) * height / 64.0
        scenes_own = own[0, scene] * max(1.0, own[1, scene] / f_number)
        # The others' if that is 0.
        whole = math.hypot(math.hypot(speeds[i] * time * height, disc), scenes_own)
        direction, turn, angle = movements[i, 0], movements[i, 1] * time, movements[i, 3]
        drift, extent = movements[i, 2] * time, speeds[i] * time
        x, y = drift * math.cos(angle), drift * math.sin(angle)
        rest = (extent * height) ** 2 + scenes_own**2
        apart = (path_length(extent, direction, turn, x, y) * height) ** 2 + scenes_own**2
        squares = sharp = 0.0
        first, last = (ends[0, scene], ends[1, scene]) if differ else (0, 1)
        for sort in range(first, last):
            circle = min(disc * sorts[0, sort], _WIDEST)  # as in the frame
            moved = apart if sorts[1, sort] > 0.0 and drift > 0.0 else rest
            alike = sorts[0, sort] < 0.0
            level = whole if alike else math.sqrt(circle * circle + moved)
            squares += sorts[2, sort] * level**2
            sharp += sorts[2, sort] / (1.0 + (level * (64.0 / height)) ** 2)
            if levels.size:
                levels[i, sort - first], shares[i, sort - first] = level, sorts[2, sort]
        blur[i], sharpness[i] = math.sqrt(squares), sharp


class SceneCaptures:
    """Describes captures of a scene at the states of a grid, of which it knows all that it can.

    For `noisy` see `Captures`.
    """

    def __init__(
        self, camera: CameraProfile, states: Sequence[CameraSettings], *, noisy: bool = True
    ) -> None:
        self.camera, self.states, self.noisy = camera, list(states), noisy
        self._nlf = camera.nlfs(states)
        #: (S, 2) exposure times and effective f-numbers.
        self.lenses = np.array([(s.exposure_time, s.effective_f_number) for s in states])
        self._log2_exposures = np.array([s.log2_exposure for s in states])

    def of(
        self,
        scenes: Sequence[Scene] | ShownScenes,
        states: np.ndarray | None = None,
        *,
        which: np.ndarray | None = None,
        speed: np.ndarray,
        defocus: np.ndarray,
        movements: np.ndarray | None = None,
        gain: np.ndarray,
        row_gain: np.ndarray | None = None,
        source_noise: Sequence[NoiseLevelFunction] | None = None,
        device: torch.device | None = None,
    ) -> Captures:
        """Captures of a scene each, all (B,) long.

        Args:
            scenes: Scene of each capture, or scenes of which `which` (B,) has the indices.
            states: (B,) of the grid; None for one capture at each.
            speed, defocus: (B,) each, see `prepare_scene`.
            movements: (B, 4) numbers of each `Movement`, in its order; None for along the rows.
            gain: (B,) light relative to the scenes' own.
            row_gain: (B, H) light of each row relative to that; None where all rows have the same.
            source_noise, device: See `Captures`.
        """
        if not isinstance(scenes, ShownScenes):  # some are shown often
            _, first, which = np.unique([*map(id, scenes)], return_index=True, return_inverse=True)
            scenes = ShownScenes([scenes[i] for i in first], self)
        assert which is not None
        states = np.arange(len(self.states)) if states is None else states
        movements = np.zeros((len(which), 4)) if movements is None else movements
        device, indices = device or _CPU, states.tolist()
        rows = None if row_gain is None else torch.from_numpy(row_gain).to(device)
        settings, nlf = [self.states[i] for i in indices], [self._nlf[i] for i in indices]
        # Copies: facts that are worked out later must not depend on what the caller does meanwhile.
        moves = [*map(np.array, (states, speed, defocus, movements))]
        own = np.array(which), self._log2_exposures[states], np.array(gain), moves
        more: Any = rows, source_noise, self.noisy, self.camera.prnu, device
        return Captures(settings, nlf, scenes, *own, *more)

    def describe(
        self,
        scene: Scene,
        prepared: PreparedScene,
        part: slice = slice(None),
        gain: float | np.ndarray = 1.0,
        row_gain: np.ndarray | None = None,
    ) -> Captures:
        """Captures of some of the states, `part`, of a scene that is `prepared` as in the episode.

        For `gain` and `row_gain` see `ScoreTables.table`.
        """
        states = np.arange(len(self.states))[part]
        gains = np.broadcast_to(gain, len(self.states))[part]
        return self.of(
            [scene] * len(states),
            states,
            **_moves(scene, prepared, len(states)),
            gain=gains,
            row_gain=None if row_gain is None else row_gain[part],
            source_noise=source_noises(prepared, self.states[part], gains),
        )

    def sharpness(self, scene: Scene, prepared: PreparedScene) -> np.ndarray:
        """Scores (S,) of `Sharpness` at all states; see `describe`."""
        count = len(self.states)
        moves = _moves(scene, prepared, count)
        return ShownScenes([scene], self).blur(np.zeros(count, int), np.arange(count), **moves)[2]


def _moves(scene: Scene, prepared: PreparedScene, count: int) -> dict[str, Any]:
    """How `count` captures of a scene that is `prepared` move, as `SceneCaptures.of` takes it."""
    # In steps of a 64-pixel frame, as episodes state it: to the bit as there.
    defocus = np.full(count, prepared.defocus * 64.0 / scene.light.shape[-2])
    movements = np.tile(np.array(astuple(prepared.movement)), (count, 1))
    speed = np.full(count, prepared.image_speed)
    return {"speed": speed, "defocus": defocus, "movements": movements}


class ShownScenes:
    """What captures take of many scenes; it becomes columns when a scene is first shown.

    `captures` are those of the states.
    """

    def __init__(self, scenes: Sequence[Scene], captures: SceneCaptures) -> None:
        self._scenes, self.captures = scenes, captures
        # Of each, once it is known: the blur of its own map, the f-number of that, and the height.
        self._own = np.full((3, len(scenes)), np.nan)
        # `Layout.shares` of scenes, one behind the other, and where those of each are.
        self._sorts, self._ends = _ALIKE, np.zeros((2, len(scenes)), np.int64)
        # Exposure of the references, EV100 that is right, and all that are likely.
        self._light = np.full((2, len(scenes)), np.nan)
        self._likely = np.zeros((len(scenes), LIKELY))

    def __getitem__(self, scene: int) -> Scene:
        return self._scenes[scene]

    def light(self, scenes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """(B,) log2 of the exposures of the references of `scenes` (B,), and their `ev100`.

        Also (B, K) their `IncidentLight.right_ev100`, None where each has one alone.
        """
        if (new := np.isnan(self._light[0, scenes])).any():
            for index in np.unique(scenes[new]).tolist():
                scene = self._scenes[index]
                self._light[:, index] = scene.reference.log2_exposure, scene.ev100
                self._likely[index] = scene.incident_light.right_ev100
        reference, ev100 = self._light[:, scenes]
        likely = self._likely[scenes]
        return reference, ev100, likely if (likely[:, 0] != likely[:, -1]).any() else None

    def blur(
        self,
        scenes: np.ndarray,
        states: np.ndarray,
        speed: np.ndarray,
        defocus: np.ndarray,
        movements: np.ndarray,
        *,
        pixels: bool = False,
    ) -> tuple[np.ndarray, PixelBlur | None, np.ndarray]:
        """Blur of captures of `scenes` (B,), by their indices; see `SceneCaptures.of`.

        Returns:
            `Captures.blur_px`; `Captures.pixel_blur`, None unless asked for by `pixels`; and the
            scores (B,) of `Sharpness`.
        """
        if len(new := lacking_facts(scenes, defocus, movements, self._own, self._ends)):
            self._add(np.unique(scenes[new]), np.unique(scenes[_differ(defocus, movements)]))
        levels = shares = np.empty((0, 0))
        if pixels and (apart := _differ(defocus, movements)).any():
            first, last = self._ends[:, scenes] * apart
            levels, shares = np.zeros((2, len(scenes), (last - first).max()))
        blur, scores = np.empty((2, len(scenes)))
        frames, moves = (scenes, states, self.captures.lenses), (speed, defocus, movements)
        fixed = frames, moves, (self._own, self._sorts, self._ends), (levels, shares, blur, scores)
        parallel_ranges(lambda a, b: _fill_levels(a, b, *fixed), len(blur), least=_WORTH_A_THREAD)
        if not levels.size:
            return blur, None, scores
        return blur, PixelBlur(torch.from_numpy(levels), torch.from_numpy(shares)), scores

    def _add(self, scenes: np.ndarray, differ: np.ndarray) -> None:
        """Learns about `scenes`; pixels of captures of those of `differ` do so in their blur."""
        for index in scenes.tolist():
            scene = self._scenes[index]
            reference, height = scene.reference.effective_f_number, scene.light.shape[-2]
            self._own[:, index] = scene.own_blur(math.inf), reference, height
        scenes = differ[self._ends[1, differ] == 0]
        layouts = [self._scenes[index].layout for index in scenes.tolist()]
        parts = [_ALIKE if layout is None else layout.shares for layout in layouts]
        ends = self._sorts.shape[1] + np.cumsum([0] + [part.shape[1] for part in parts])
        self._ends[:, scenes] = ends[:-1], ends[1:]
        self._sorts = np.concatenate([self._sorts, *parts], axis=1)


def _differ(defocus: np.ndarray, movements: np.ndarray) -> np.ndarray:
    """(B,) whether pixels of captures may differ in their blur."""
    return np.asarray((defocus != 0.0) | (movements[:, 2] != 0.0))
