"""Draws of new episodes: scene, start state, motion, defocus, seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.special import ndtri

from ae_env.episodes.scene_facts import SceneFacts
from ae_env.options import EnvOptions
from ae_env.scenes.scene import Scene
from simulator.utils.checks import check_integer, did_you_mean

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
#: Names that a reset may choose, and their names in errors; frames count up to `MAX_FRAME`.
OPTIONS = ("scene", "state", "frame")
_OPTION = tuple(f"options[{name!r}]" for name in OPTIONS)
MAX_FRAME = 2**31 - 1
#: Uniform numbers that an episode is made of.
_NUMBERS = 12
#: Those have so many different values.
_VALUES = 2.0**53


class Draws:
    """Draws episodes.

    Args:
        options: The environment's arguments.
        scenes: Scenes that episodes choose from; of sequences, the first frames.
        facts: What is known of them.
    """

    def __init__(self, options: EnvOptions, scenes: Sequence[Scene], facts: SceneFacts) -> None:
        self._options, self._facts = options, facts
        self._ids, self._num_states = facts.scene_ids, facts.allowed.shape[1]
        self._index = {scene_id: i for i, scene_id in enumerate(self._ids)}
        if options.in_sequences:  # which have a name of their own
            self._index |= {s.sequence: i for i, s in enumerate(scenes) if s.sequence}
        # Only recorded scenes forbid states. Those that one allows come first in its row, in order.
        self._starts = np.argsort(~facts.allowed, axis=1, kind="stable")
        self._num_starts = facts.allowed.sum(axis=1)

    def draw(
        self,
        rngs: Sequence[np.random.Generator],
        chosen: Sequence[Mapping[str, Any]] | None = None,
    ) -> dict[str, np.ndarray]:
        """K episodes as columns, each of its own generator.

        The draws do not depend on what is chosen, which only replaces them.

        Args:
            rngs: K generators; each gives the same count of numbers for every episode.
            chosen: For each the ``scene``, ``state`` and ``frame`` that it shall have.

        Returns:
            (K,) arrays by the names of `ae_env.episodes.state.Episode`.

        Raises:
            ValueError: If there is no such scene, state or frame.
        """
        given = [self._chosen(options) for options in chosen or ()]  # refused before any draw
        uniforms = np.array([rng.random(_NUMBERS) for rng in rngs]).T
        which, start, moving, speed, defocus, phase, seed, *motion = uniforms
        scene = (which * len(self._ids)).astype(np.int64)
        frame = np.zeros(len(rngs), np.int64)
        for i, (wanted_scene, _, wanted_frame) in enumerate(given):
            scene[i] = scene[i] if wanted_scene is None else wanted_scene
            frame[i] = frame[i] if wanted_frame is None else wanted_frame
        self._facts.look_at(scene)
        state = self._starts[scene, (start * self._num_starts[scene]).astype(np.int64)]
        for i, (_, wanted_state, _) in enumerate(given):
            state[i] = state[i] if wanted_state is None else wanted_state
        discs = np.exp(DEFOCUS_SIGMA * ndtri(defocus)) * DEFOCUS_MEDIAN
        discs = _fixed_or_drawn(
            self._options.depth, np.minimum(np.maximum(discs, DEFOCUS_MIN), DEFOCUS_MAX)
        )
        return {
            "scene": scene,
            "state": state,
            **self._motion(scene, moving, speed, *motion),
            "defocus": discs,
            "focus_drive": np.hypot(discs, self._own_blur(scene)),
            "phase": phase,
            "noise_seed": (seed * _VALUES).astype(np.int64),
            "frame": frame,
        }

    def _motion(
        self,
        scene: np.ndarray,
        moving: np.ndarray,
        speed: np.ndarray,
        direction: np.ndarray,
        turn: np.ndarray,
        apart: np.ndarray,
        subject_speed: np.ndarray,
        subject_direction: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """Columns of the motion in `scene` (K,), from K uniform numbers each."""
        speeds = self._facts.median_speed[scene]
        shake, own = (np.exp(SPEED_SIGMA * ndtri(u)) for u in (speed, subject_speed))
        # Either may rest where both could move: a camera on a tripod, a subject that waits.
        moves = moving >= STATIC_SHARE
        subject_moves = moves & self._facts.has_subject[scene] & (apart < SUBJECT_SHARE)
        shakes = moves & ~(subject_moves & (apart < ALONE_SHARE))
        if self._options.motion != "random":  # one speed of the whole image
            subject_moves = np.zeros(len(scene), bool)
        return {
            "speed": _fixed_or_drawn(self._options.motion, shakes * shake * speeds),
            "direction": 2.0 * math.pi * direction,
            "turn": TURN_SIGMA * ndtri(turn),
            "subject_speed": subject_moves * own * speeds,
            "subject_direction": 2.0 * math.pi * subject_direction,
        }

    def _own_blur(self, scene: np.ndarray) -> np.ndarray:
        """(K,) blur that scenes bring themselves, at f/4 [pixel of a 64-pixel frame]."""
        return self._facts.own_blur[scene] * 64.0 / self._options.resolution

    def _chosen(self, options: Mapping[str, Any]) -> tuple[int | None, int | None, int | None]:
        """Scene, state and frame that the options of a reset ask for; None where they do not."""
        scene, state, frame = (options.get(name) for name in OPTIONS)
        return (
            None if scene is None else self._scene(scene),
            None if state is None else check_integer(_OPTION[1], state, 0, self._num_states - 1),
            None if frame is None else check_integer(_OPTION[2], frame, 0, MAX_FRAME),
        )

    def _scene(self, wanted: Any) -> int:
        if isinstance(wanted, str) and wanted in self._index:
            return self._index[wanted]
        hint = did_you_mean(wanted, self._ids) if isinstance(wanted, str) else ""
        rule = f", or a scene id, such as {self._ids[0]!r}{hint}"
        return check_integer(_OPTION[0], wanted, 0, len(self._ids) - 1, more=rule)


def check_options(options: Any, *more: str) -> dict[str, Any]:
    """The options of a reset as a dictionary of its own.

    Args:
        options: The options of `reset`: None or a mapping.
        more: Names that are allowed beside those of `OPTIONS`.

    Raises:
        ValueError: If there is another name, or it is no mapping.
    """
    known = [*OPTIONS, *more]
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise ValueError(f"`options` (={options!r}) must be None or a dictionary with {known}")
    for name in options:
        if name not in known:
            raise ValueError(
                f"`options` has {name!r}; it may have {known}{did_you_mean(name, known)}"
            )
    return dict(options)


def _fixed_or_drawn(option: str | float, drawn: np.ndarray) -> np.ndarray:
    """`drawn` for ``"random"``, 0 for every other word, or the number itself."""
    if option == "random":
        return drawn
    return np.full(len(drawn), 0.0 if isinstance(option, str) else float(option))
