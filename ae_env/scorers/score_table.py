"""Expected scores of every exposure state of a scene.

``q(s)`` is the expectation, over noise, of the score of a capture at state s. Where a part of the
scorer has that in closed form it is used (of the terms that are measured on frames, to the first
order: see `ae_env.scorers.terms`); other parts are averaged over common noise seeds, with
their standard error.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from ae_env.grid import ExposureGrid
from ae_env.observation import encode_observation
from ae_env.scenes.scene import Scene
from ae_env.scorers.captures import SceneCaptures
from ae_env.scorers.composite import CompositeScorer, is_own
from ae_env.scorers.protocol import Captures, DependsOn, reads_pixels
from ae_env.scorers.terms import Sharpness, TermScores
from simulator.camera import CameraProfile
from simulator.capture.exposure import DEFAULT_TOLERANCE, check_tolerance
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import Transitions, clip_and_quantise
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.optics.motion import ALONG_ROWS, Movement
from simulator.settings import CameraSettings
from simulator.utils.checks import check_integer

#: Memory for cached descriptions of captures [byte]: some 1000 scenes at 64 states.
_MEMORY_BYTES = 2**26
#: Memory for the blurred light of one table [byte].
_LIGHT_BYTES = 2**25
#: States whose pixels are looked at at once: more only spends time in memory paging.
_CHUNK = 16
#: Scores closer than this are equal: rounding moves them by 1e-8, noise seeds by 1e-5.
TIE = 1e-7


@dataclass(frozen=True)
class ScoreTable:
    """Expected scores of S states.

    Args:
        mean: (S,) float64, q of each state.
        standard_error: (S,) float64, 0 where the closed form was used.
        parts: (S,) float64 of each part of the scorer.
        allowed: (S,) bool, states that the scene allows; None for all of them.
    """

    mean: np.ndarray
    standard_error: np.ndarray
    parts: dict[str, np.ndarray]
    allowed: np.ndarray | None = None

    @property
    def nbytes(self) -> int:
        """Memory that the table takes [byte], about."""
        return sum(a.nbytes for a in (self.mean, self.standard_error, *self.parts.values()))

    @cached_property
    def oracle(self) -> int:
        """The best state that is allowed; ties go to the lower index, that is the lower ISO.

        States of equal exposure score alike but for the rounding of their settings: a tie is
        whatever comes within `TIE` of the best.
        """
        mean = self.mean if self.allowed is None else np.where(self.allowed, self.mean, -np.inf)
        return int(np.argmax(mean >= mean.max() - TIE))


def prepare_scene(
    scene: Scene,
    camera: CameraProfile,
    *,
    speed: float = 0.0,
    defocus: float = 0.0,
    movement: Movement = ALONG_ROWS,
) -> PreparedScene:
    """`scene` as `camera` sees it in an episode.

    Args:
        scene: The scene.
        camera: The body that takes the captures.
        speed: Image speed [frame heights per second].
        defocus: Blur diameter at f/4 [pixel of a 64-pixel frame], of what is least in focus.
        movement: Directions of the image's motion, and the subject's own.
    """
    prepared = replace(scene.prepared, camera=camera)
    return in_episode(prepared, speed=speed, defocus=defocus, movement=movement)


def in_episode(
    prepared: PreparedScene,
    *,
    speed: float = 0.0,
    defocus: float = 0.0,
    movement: Movement = ALONG_ROWS,
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
    found = []
    for state, own in zip(states, np.broadcast_to(gain, len(states)).tolist(), strict=True):
        exposure = prepared.exposure(state, gain=own)
        left = exposure.remaining_variance
        share = prepared.box_factor**2 * (1.0 if left is None else float(left.mean()))
        found.append(exposure.source_noise.scaled(share))
    return found


class ScoreTables:
    """Score tables of scenes under one scorer, camera and grid.

    Args:
        grid: The states.
        camera: The body that takes the captures.
        scorer: The scorer that rates them.
        noise_seeds: Captures per state that the parts without a closed form are averaged over.
        noise: Whether the captures that are scored are noisy.
        tolerance: How far the captures that are scored may be off, see `PreparedScene.tolerance`.

    Attributes:
        term_scores: The parts that are measured on a frame, with an expectation in closed form.
        torch_terms: All other parts, which torch evaluates; None if there are none.
    """

    def __init__(
        self,
        grid: ExposureGrid,
        camera: CameraProfile,
        scorer: CompositeScorer,
        *,
        noise_seeds: int = 2,
        noise: bool = True,
        tolerance: float = DEFAULT_TOLERANCE,
    ) -> None:
        check_integer("noise_seeds", noise_seeds, 1)
        self.grid, self.camera, self.scorer = grid, camera, scorer
        self.noise, self.noise_seeds = noise, noise_seeds if noise else 1
        check_tolerance(tolerance)
        self.tolerance = tolerance
        # Scorers of one's own get a copy of the light, lest they write to the scene.
        self._captures = SceneCaptures(camera, _MEMORY_BYTES, copies=is_own(scorer))
        self.term_scores = TermScores(scorer, camera, grid.states, noise=noise)
        self.torch_terms = scorer.subset(set(scorer.parts) - set(self.term_scores.parts))

    @property
    def closed_form(self) -> bool:
        """Whether every part's expectation has a closed form, so that no noise is drawn for it."""
        return self.torch_terms is None or self.torch_terms.closed_form

    def table(
        self,
        scene: Scene,
        *,
        speed: float = 0.0,
        defocus: float = 0.0,
        movement: Movement = ALONG_ROWS,
        gain: float | np.ndarray = 1.0,
        row_gain: np.ndarray | None = None,
        prepared: PreparedScene | None = None,
    ) -> ScoreTable:
        """Expected scores of all states of `scene` in an episode.

        Args:
            scene: The scene.
            speed: See `prepare_scene`.
            defocus: See `prepare_scene`.
            movement: See `prepare_scene`.
            gain: Light relative to the scene's own; (S,) where it depends on the state, as in
                flickering light.
            row_gain: (S, H) light of each row relative to that, see `Captures`.
            prepared: The scene in this episode, where that is at hand, in place of the three above.
        """
        if prepared is None:
            prepared = prepare_scene(
                scene, self.camera, speed=speed, defocus=defocus, movement=movement
            )
            prepared = prepared.changed(tolerance=self.tolerance)
        parts = self.closed_form_terms(scene, prepared, gain=gain, row_gain=row_gain)
        if scene.recorded is not None:
            return self._recorded_table(scene, prepared, parts)
        if self.term_scores.parts:
            captures = None
            if self.term_scores.reads_captures:
                captures = self._described(scene, prepared, slice(None), gain, row_gain)
            means = self._expected_means(prepared, gain, row_gain)
            parts |= self.term_scores.score(means, captures)
        error = np.zeros(len(self.grid))
        if self.closed_form:
            mean = self.scorer.totals(parts)
        else:
            samples = self._samples(scene, prepared, gain, row_gain)
            totals = self.scorer.totals({**parts, **samples})  # (seeds, S)
            mean = totals.mean(axis=0)
            if self.noise_seeds > 1:
                error = totals.std(axis=0, ddof=1) / np.sqrt(self.noise_seeds)
            elif self.noise:
                error = np.full(len(self.grid), np.nan)  # one sample has no standard error
            parts |= {name: values.mean(axis=0) for name, values in samples.items()}
        parts = {name: parts[name] for name in self.scorer.parts}
        return ScoreTable(mean, error, parts, scene.allowed)

    def _recorded_table(
        self, scene: Scene, prepared: PreparedScene, parts: dict[str, np.ndarray]
    ) -> ScoreTable:
        """Scores of the captures that there are; 0 where there is none.

        Args:
            scene: With `Scene.recorded`.
            prepared: Its merged light.
            parts: Scores of the parts that look at no frame.
        """
        frames, allowed = scene.recorded, scene.allowed
        assert frames is not None
        assert allowed is not None
        for part in _slices(len(self.grid), _CHUNK):
            states = np.arange(len(self.grid))[part]
            captures = self._described(scene, prepared, part, 1.0, None)
            found: dict[str, np.ndarray] = {}
            if self.term_scores.parts:
                codes = encode_observation(frames[part]).numpy()
                means = self.term_scores.measured(codes, states, np.zeros((len(states), 2, 4)))
                found |= self.term_scores.score(means, captures)
            if self.torch_terms is not None and not self.torch_terms.closed_form:
                shown = frames[part].clamp(0.0, 1.0)
                scored = self.torch_terms.score_parts(shown, captures, ("image",))
                found |= {name: values.numpy() for name, values in scored.items()}
            for name, values in found.items():
                parts.setdefault(name, np.zeros(len(self.grid)))[part] = values
        mean = np.where(allowed, self.scorer.totals(parts), 0.0)
        shown_parts = {name: np.where(allowed, parts[name], 0.0) for name in self.scorer.parts}
        return ScoreTable(mean, np.zeros(len(self.grid)), shown_parts, allowed)

    def closed_form_terms(
        self,
        scene: Scene,
        prepared: PreparedScene,
        *,
        gain: float | np.ndarray = 1.0,
        row_gain: np.ndarray | None = None,
        kinds: tuple[DependsOn, ...] = ("light", "blur"),
    ) -> dict[str, np.ndarray]:
        """Scores (S,) of those parts that look at no frame but depend on `kinds`; see `table`."""
        torch_terms = self.torch_terms
        names = [] if torch_terms is None else torch_terms.names(*kinds)
        if torch_terms is None or not names:
            return {}
        if all(type(torch_terms.parts[name]) is Sharpness for name in names):  # reads nothing else
            return dict.fromkeys(names, self._sharpness(scene, prepared))
        looks = any(reads_pixels(torch_terms.parts[name]) for name in names)
        chunks = []
        for part in _slices(len(self.grid), _CHUNK if looks else len(self.grid)):
            captures = self._described(scene, prepared, part, gain, row_gain)
            scores = torch_terms.score_parts(None, captures, kinds)
            chunks.append({name: values.numpy() for name, values in scores.items()})
        return {name: np.concatenate([c[name] for c in chunks]) for name in names}

    def _sharpness(self, scene: Scene, prepared: PreparedScene) -> np.ndarray:
        """Scores (S,) of `Sharpness`, worked out for the few states that differ in blur."""
        blur, alike = self._captures.blur(scene, self.grid.states, **_blurs(prepared))
        return Sharpness.of(blur, scene.light.shape[-2])[alike].numpy()

    def _described(
        self,
        scene: Scene,
        prepared: PreparedScene,
        part: slice,
        gain: float | np.ndarray,
        row_gain: np.ndarray | None,
    ) -> Captures:
        """Facts of the captures of the states `part` of the grid."""
        states = self.grid.states[part]
        if isinstance(gain, np.ndarray):
            gain = gain[part]
        return self._captures.describe(
            scene,
            states,
            **_blurs(prepared),
            gain=gain,
            row_gain=None if row_gain is None else row_gain[part],
            source_noise=source_noises(prepared, states, gain),
            noisy=self.noise,
        )

    def _expected_means(
        self, prepared: PreparedScene, gain: float | np.ndarray, row_gain: np.ndarray | None
    ) -> np.ndarray:
        """`TermScores.expected` of all states, (S, 3)."""
        gains = np.broadcast_to(gain, len(self.grid)).tolist()
        prepared = prepared.changed(blurred_light=prepared.blurred_light.copy(_LIGHT_BYTES))
        exposures = [
            prepared.exposure(state, noise=self.noise, gain=factor)
            for state, factor in zip(self.grid, gains, strict=True)
        ]
        groups: dict[tuple[Any, ...], list[int]] = {}
        for state, exposure in enumerate(exposures):
            groups.setdefault(exposure.blur, []).append(state)
        means = np.empty((len(self.grid), 3))
        for states in groups.values():  # one light after the other: large frames fill the memory
            light = prepared.blurred_light.blurred(exposures[states[0]])
            found = [exposures[state] for state in states]
            transitions = Transitions.of([light] * len(states), found)
            boxes = np.full(len(states), prepared.box_factor)
            rows = None if row_gain is None else row_gain[states]
            means[states] = self.term_scores.expected(transitions, np.array(states), boxes, rows)
        return means

    def _samples(
        self,
        scene: Scene,
        prepared: PreparedScene,
        gain: float | np.ndarray,
        row_gain: np.ndarray | None,
    ) -> dict[str, np.ndarray]:
        """Scores (seeds, S) of the parts without a closed form, on common noise seeds."""
        assert self.torch_terms is not None
        gains = np.broadcast_to(gain, len(self.grid))
        names = self.torch_terms.names("image")
        samples = {name: np.zeros((self.noise_seeds, len(self.grid))) for name in names}
        for part in _slices(len(self.grid), _CHUNK):
            states, rows = self.grid.states[part], None if row_gain is None else row_gain[part]
            light: Any = {"gain": gains[part], "row_gain": rows}
            captures = self._described(scene, prepared, part, gain, row_gain)
            for seed, images in enumerate(self._images(prepared, states, **light)):
                for name, values in self.torch_terms.score_parts(
                    images, captures, ("image",)
                ).items():
                    samples[name][seed, part] = values.numpy()
        return samples

    def _images(
        self, prepared: PreparedScene, states: Sequence[CameraSettings], **light: Any
    ) -> Iterable[torch.Tensor]:
        """Captures (S, 4, H, W) in [0, 1] of `states`, one of each for every noise seed."""
        if not self.noise:
            signals = prepared.expected_sweep(states, **light)
            yield clip_and_quantise(signals, self.camera).clamp_(0.0, 1.0)
            return
        for seed in range(self.noise_seeds):
            yield prepared.expose(states, seed=seed, **light).clamp_(0.0, 1.0)


def _blurs(prepared: PreparedScene) -> dict[str, Any]:
    """What the blur of captures depends on, as arguments of `SceneCaptures`."""
    return {
        "speed": prepared.image_speed,
        "defocus": prepared.defocus * 64.0 / prepared.light.shape[-2],
        "movement": prepared.movement,
    }


def _slices(count: int, size: int) -> list[slice]:
    return [slice(i, min(i + size, count)) for i in range(0, count, size)]
