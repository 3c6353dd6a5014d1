"""Running episodes: how they are drawn, what their scenes are like, and where each is now."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ae_env.episodes.lookup import nearest_recorded
from ae_env.grid import ExposureGrid
from ae_env.lighting import Lighting, RollingShutter
from ae_env.options import RANDOM_LENS, EnvOptions
from ae_env.scenes.folder import sequence_bounds
from ae_env.scenes.scene import Scene, SceneSet
from simulator.camera import CameraProfile
from simulator.noise.generator import noise_keys, normals_above
from simulator.optics.motion import Movement
from simulator.optics.vignetting import RANDOM_LENSES, Vignetting, random_lens
from simulator.utils.checks import check_integer, check_key, did_you_mean

#: Share of the episodes in which nothing moves.
STATIC_SHARE = 1.0 / 3.0
#: Standard deviation of the natural logarithm of the image speed.
SPEED_SIGMA = 1.3
#: Median and spread of the blur diameter at f/4 [pixel of a 64-pixel frame], and its least value.
DEFOCUS_MEDIAN, DEFOCUS_SIGMA, DEFOCUS_MIN, DEFOCUS_MAX = 1.0, 0.9, 0.1, 8.0
#: Share of the moving episodes in which the subject moves on its own, in some of them alone.
SUBJECT_SHARE, ALONE_SHARE = 0.5, 0.15
#: Standard deviation of the rate at which the direction of the shake turns [rad/s].
TURN_SIGMA = math.pi
#: Names that a reset may choose; frames count up to `MAX_FRAME`.
OPTIONS = ("scene", "state", "frame")
MAX_FRAME = 2**31 - 1
#: Uniform numbers that an episode is made of, and how many values each has.
_NUMBERS, _VALUES = 12, 2.0**53


@dataclass(frozen=True)
class Episode:
    """One scene being photographed, at one moment."""

    scene: int  # index of the scene
    state: int  # current exposure state
    speed: float  # of the image [frame heights per second]
    direction: float  # of the image's motion when a shutter opens [rad], 0 along the rows
    turn: float  # rate at which that turns [rad/s]
    subject_speed: float  # own speed of the scene's subject [frame heights per second]
    subject_direction: float  # of that [rad]
    defocus: float  # blur diameter at f/4 of what is least in focus [pixel of a 64-pixel frame]
    focus_drive: float  # blur at f/4 that the focus drive reports [pixel of a 64-pixel frame]
    phase: float  # of a periodic lighting, in [0, 1)
    noise_seed: int  # of noise that differs from frame to frame
    frame: int = 0  # number of the current frame

    @property
    def movement(self) -> Movement:
        """Directions of the image's motion, and the subject's own."""
        return Movement(self.direction, self.turn, self.subject_speed, self.subject_direction)

    @property
    def moves(self) -> dict[str, Any]:
        """Arguments of `ae_env.scorers.captures.prepare_scene` that blur depends on."""
        return {"speed": self.speed, "defocus": self.defocus, "movement": self.movement}


_FIELDS = tuple(field.name for field in fields(Episode))
_COLUMNS = (*_FIELDS, "begun", "light_index", "previous", "pending", "image_mean")


class Episodes:
    """The episodes of n environments, as columns: a batch takes what it needs of them at once.

    Facts of scenes that are drawn on demand are known once an episode shows them. A `ValueError` if
    a scene was made for another number of states.

    Args:
        options, count: The environment's arguments, and n.
        scenes: Those of `options` where they are loaded already; of sequences, all frames.

    Attributes:
        static: Whether the light never changes.
        at_rest: Whether nothing moves, all is in focus and lenses are as in the scenes.
        allowed: (scenes, S) bool, the states that each allows.
        box_factor: (scenes,) `Scene.box_factor`.
        begun: (n,) bool, whether there is an episode.
        light_index: (n,) int64, under which what is worked out for its frames is looked up: the
            index of its scene where all episodes that show it at rest share that, else one of its
            own, behind those of the scenes.
        previous: (n,) int64, state in the frame before; -1 in the first.
        pending: (n, longest delay + 1) int64, actions that are not wholly in effect yet and the
            last that is, the oldest first.
        image_mean: (n,) mean code of the latest frame / 255, where a cost needs it.

    The others, (n,) each, are those of `Episode`.
    """

    def __init__(
        self, options: EnvOptions, count: int, scenes: Sequence[Scene] | None = None
    ) -> None:
        self.options = options
        self.grid: ExposureGrid = options.make_grid()
        self.camera: CameraProfile = options.make_camera()
        self.lighting: Lighting = options.make_lighting()
        self._lens = options.make_lens()
        self.static = type(self.lighting) is Lighting
        still = options.motion in ("none", 0.0) and options.depth in ("far", 0.0)
        self.at_rest = still and options.lens is None
        self.scenes = options.scenes_on_demand() if scenes is None else SceneSet.of(scenes)
        # With one delay of all controls a state needs not be put together.
        self._delays = options.delays if len(set(options.delays)) > 1 else options.delays[:1]
        self.scene, self.state, self.noise_seed, self.frame = np.zeros((4, count), np.int64)
        self.speed, self.defocus, self.focus_drive, self.phase = np.zeros((4, count))
        self.movements = np.zeros((count, 4))  # of each the numbers of its `Movement`, in its order
        movement = self.movements.T
        self.direction, self.turn, self.subject_speed, self.subject_direction = movement
        self.begun = np.zeros(count, bool)
        self.light_index, self.previous = np.zeros((2, count), np.int64)
        self.pending = np.zeros((count, max(options.delays) + 1), np.int64)
        self.image_mean = options.placed(np.full(count, np.nan))
        self._learn_about_scenes()
        # The states that a scene allows come first in its row, in order.
        self._starts = np.argsort(~self.allowed, axis=1, kind="stable")
        self._num_starts = self.allowed.sum(axis=1)
        # (scenes, S) state that is shown where another is asked for; None where each can be.
        self._shown_state: np.ndarray | None = None
        if options.recorded is not None:
            self._shown_state = np.stack([nearest_recorded(s, self.grid) for s in self.scenes])

    def _learn_about_scenes(self) -> None:
        count = len(self.scenes)
        self.allowed = np.ones((count, len(self.grid)), bool)
        self._median_speed, self._own_blur = np.zeros((2, count))
        self._has_subject, self.has_map, self._known = np.zeros((3, count), bool)
        self.illuminance_spread = np.zeros(count)
        self.box_factor = np.ones(count, np.int64)
        self.scene_ids = self.scenes.scene_ids
        self._ensure_loaded(np.array(self.scenes.loaded, np.int64))
        # First and last frame of the sequence that each scene is a frame of.
        self._bounds: tuple[np.ndarray, np.ndarray] | None = None
        self._firsts = np.arange(count)
        if self.options.in_sequences:
            self._bounds = sequence_bounds(self.scenes)
            self._firsts = np.unique(self._bounds[0])
        self._ids = [self.scene_ids[i] for i in self._firsts]
        self._index = {scene_id: i for i, scene_id in enumerate(self._ids)}
        if self._bounds is not None:  # sequences have a name of their own
            named = enumerate(self.first_scenes)
            self._index |= {scene.sequence: i for i, scene in named if scene.sequence}

    @property
    def first_scenes(self) -> Sequence[Scene]:
        """Scenes that episodes draw from: of a sequence, its first frame."""
        if self._bounds is None:
            return self.scenes
        return [self.scenes[i] for i in self._firsts.tolist()]

    def _ensure_loaded(self, indices: np.ndarray) -> None:
        """Loads the scenes `indices` and learns their facts: they are about to be shown."""
        if self._known[indices].all():
            return
        new = np.unique(indices[~self._known[indices]]).tolist()
        self.scenes.load(new)  # several at once: on several threads
        for index in new:
            scene = self.scenes[index]
            if scene.allowed is not None:
                if len(scene.allowed) != len(self.grid):
                    raise ValueError(
                        f"`allowed` of scene {scene.scene_id!r} (length {len(scene.allowed)}) must "
                        f"have one entry for each of the {len(self.grid)} states of `grid`"
                    )
                self.allowed[index] = scene.allowed
            self._median_speed[index] = scene.median_speed
            self._own_blur[index] = scene.own_blur(4.0)
            self.illuminance_spread[index] = scene.incident_light.spread
            layout = scene.layout
            self._has_subject[index] = layout is not None and layout.subject is not None
            self.has_map[index] = scene.defocus_map is not None
            self.box_factor[index] = scene.box_factor
            self._known[index] = True

    def draw(
        self,
        rngs: Sequence[np.random.Generator],
        options: Sequence[Mapping[str, Any]] | None = None,
    ) -> dict[str, np.ndarray]:
        """K episodes as columns (K,) by the names of `Episode`.

        The draws do not depend on what is chosen, which only replaces them. A `ValueError` if there
        is no such scene, state or frame.

        Args:
            rngs: K generators; each gives the same count of numbers for every episode.
            options: For each the ``scene``, ``state`` and ``frame`` that it shall have.
        """
        chosen = [self._chosen(one) for one in options or ()]  # errors come before any draw
        uniforms = np.array([rng.random(_NUMBERS) for rng in rngs]).T
        which, start, moving, speed, defocus, phase, seed, direction, turn, *own = uniforms
        apart, subject_speed, subject_direction = own
        place = (which * len(self._firsts)).astype(np.int64)
        frame = np.zeros(len(rngs), np.int64)
        for i, one in enumerate(chosen):
            place[i], frame[i] = one.get("scene", place[i]), one.get("frame", 0)
        scene = self._firsts[place]
        self._ensure_loaded(scene)
        state = self._starts[scene, (start * self._num_starts[scene]).astype(np.int64)]
        for i, one in enumerate(chosen):
            state[i] = one.get("state", state[i])
        drawn = np.stack([defocus, speed, subject_speed, turn])
        drawn = 0.0 * drawn if self.at_rest else normals_above(drawn)  # at rest none is used
        discs = np.exp(DEFOCUS_SIGMA * drawn[0]) * DEFOCUS_MEDIAN
        discs = np.minimum(np.maximum(discs, DEFOCUS_MIN), DEFOCUS_MAX)
        discs = _fixed_or_drawn(self.options.depth, discs)
        own_blur = self._own_blur[scene] * 64.0 / self.options.resolution
        # Either may rest where both could move: a camera on a tripod, a subject that waits.
        moves = moving >= STATIC_SHARE
        subject_moves = moves & self._has_subject[scene] & (apart < SUBJECT_SHARE)
        shakes = moves & ~(subject_moves & (apart < ALONE_SHARE))
        if self.options.motion != "random":  # one speed of the whole image
            subject_moves = np.zeros(len(scene), bool)
        median = self._median_speed[scene]
        shake, subject = np.exp(SPEED_SIGMA * drawn[1:3])
        return {
            "scene": self._shown_at(scene, frame),
            "state": state,
            "speed": _fixed_or_drawn(self.options.motion, shakes * shake * median),
            "direction": 2.0 * math.pi * direction,
            "turn": TURN_SIGMA * drawn[3],
            "subject_speed": subject_moves * subject * median,
            "subject_direction": 2.0 * math.pi * subject_direction,
            "defocus": discs,
            "focus_drive": np.hypot(discs, own_blur),
            "phase": phase,
            "noise_seed": (seed * _VALUES).astype(np.int64),
            "frame": frame,
        }

    def _chosen(self, options: Mapping[str, Any]) -> dict[str, int]:
        """The entries of the options of a reset as integers."""
        found = {name: options[name] for name in OPTIONS if options.get(name) is not None}
        limits = {"scene": len(self._ids), "state": self.allowed.shape[1], "frame": MAX_FRAME + 1}
        for name, value in found.items():
            rule = ""
            if name == "scene":
                if isinstance(value, str) and value in self._index:
                    value = self._index[value]
                hint = did_you_mean(value, self._ids) if isinstance(value, str) else ""
                rule = f", or a scene id, such as {self._ids[0]!r}{hint}"
            most = limits[name] - 1
            found[name] = check_integer(f"options[{name!r}]", value, 0, most, more=rule)
        return found

    def begin(self, env_indices: np.ndarray, drawn: Mapping[str, np.ndarray]) -> None:
        """Puts the episodes `drawn`, columns of `Episode`, into `env_indices`."""
        for name in _FIELDS:
            getattr(self, name)[env_indices] = drawn[name]
        self.previous[env_indices] = -1
        self.pending[env_indices] = self.state[env_indices, None]
        self.image_mean[env_indices] = np.nan
        self._show_recorded(env_indices)
        self._set_light_index(env_indices)

    def act(self, env_indices: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Advances the episodes of `env_indices` by one frame, each with its action.

        Returns those that show another scene now, the next of their sequence.
        """
        self.previous[env_indices] = self.state.take(env_indices)
        if self.pending.shape[1] > 1:
            self.pending[env_indices, :-1] = self.pending[env_indices, 1:]
        self.pending[env_indices, -1] = actions
        in_effect = [self.pending[env_indices, -1 - delay] for delay in self._delays]
        mixed = in_effect[0] if len(in_effect) == 1 else self.grid.mixed(*in_effect)
        self.state[env_indices] = mixed
        self.frame[env_indices] += 1
        changed = env_indices[:0]
        if self._bounds is not None:
            now = self._shown_at(self.scene[env_indices], self.frame[env_indices])
            changed = env_indices[now != self.scene[env_indices]]
            self.scene[env_indices] = now
            self._set_light_index(changed)
        self._show_recorded(env_indices)
        return changed

    def _show_recorded(self, env_indices: np.ndarray) -> None:
        """Replaces a state that was not recorded by the nearest one that was."""
        if self._shown_state is not None:
            wanted = self.scene[env_indices], self.state[env_indices]
            self.state[env_indices] = self._shown_state[wanted]

    def _shown_at(self, scenes: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Scenes that the sequences of `scenes` show in `frames`; the last one stays."""
        if self._bounds is None:
            return scenes
        first, last = self._bounds
        return np.minimum(first[scenes] + frames, last[scenes])

    def _set_light_index(self, env_indices: np.ndarray) -> None:
        """Sets `light_index`: episodes at rest share the light of their scene."""
        scenes = self.scene[env_indices]
        own = len(self.scenes) + env_indices
        if self.static:
            moves = self.speed[env_indices] > 0.0
            moves |= self.subject_speed[env_indices] > 0.0
            moves |= self.defocus[env_indices] > 0.0
            apart = moves | self.has_map[scenes] | (self.options.lens is not None)
            own = np.where(apart, own, scenes)
        self.light_index[env_indices] = own

    def columns(self) -> dict[str, np.ndarray]:
        """All columns by name; what the episodes are, and where."""
        return {name: getattr(self, name) for name in _COLUMNS}

    def resume(self, columns: Mapping[str, np.ndarray]) -> None:
        """Continues where `columns`, of another process, are."""
        for name, values in columns.items():
            getattr(self, name)[:] = values
        begun = np.flatnonzero(self.begun)
        self._ensure_loaded(self.scene[begun])
        self._set_light_index(begun)

    def __getitem__(self, env_index: int) -> Episode:
        return Episode(**{name: getattr(self, name).item(env_index) for name in _FIELDS})

    def lens(self, env_index: int) -> Vignetting | None:
        """Lens of an episode; a function of its seed where it is drawn."""
        if self.options.lens != RANDOM_LENS:
            return self._lens
        seed = self.noise_seed[env_index : env_index + 1]
        return random_lens(int(noise_keys(seed, 0.5)[0] % RANDOM_LENSES))

    def gains(
        self, env_indices: np.ndarray, exposure_times: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Light of exposures (B,) [s] in current frames, relative to that of the frames' scenes.

        And (B, R) that of each row relative to the frame's, or None (`Lighting.rows`).
        """
        frames, times, phases = self.frame[env_indices], exposure_times, self.phase[env_indices]
        if not self.lighting.within_frame:
            each = zip(frames.tolist(), times.tolist(), phases.tolist(), strict=True)
            return np.array([self.lighting.gain(*one) for one in each]), None
        gains = np.empty(len(env_indices))
        rows = np.empty((len(env_indices), self.options.resolution))
        factors = self.box_factor[self.scene[env_indices]]
        for factor in np.unique(factors):
            at = np.flatnonzero(factors == factor)
            shutter = RollingShutter(rows.shape[1], self.camera.row_time, 2 * int(factor))
            gains[at], rows[at] = self.lighting.batch(frames[at], times[at], phases[at], shutter)
        return gains, rows if (rows != 1.0).any() else None

    def gains_by_state(self, env_index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """`gains` (S,) and (S, R) of all states in one environment."""
        times, states = np.unique([s.exposure_time for s in self.grid], return_inverse=True)
        gains, rows = self.gains(np.full(len(times), env_index), times)
        return gains[states], None if rows is None else rows[states]


def check_options(options: Any, *more: str) -> dict[str, Any]:
    """The options of a reset, None or a mapping of names in `OPTIONS` and `more`, as a dict."""
    known = (*OPTIONS, *more)
    if not isinstance(options, Mapping | None):
        raise ValueError(f"`options` (={options!r}) must be None or a dictionary with {known}")
    for name in options or {}:
        check_key("options", name, known)
    return dict(options or {})


def _fixed_or_drawn(option: str | float, drawn: np.ndarray) -> np.ndarray:
    """`drawn` for ``"random"``, 0 for every other word, or the number itself."""
    if option == "random":
        return drawn
    return np.full(len(drawn), 0.0 if isinstance(option, str) else float(option))
