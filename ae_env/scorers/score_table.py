"""Expected scores of every exposure state of a scene.

``q(s)`` is the expectation, over noise, of the score of a capture at state s. Parts of the scorer
that have it in closed form (to the first order those that are measured on frames, see
`ae_env.scorers.terms`) use it; other parts are averaged over common noise seeds.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from ae_env.grid import ExposureGrid
from ae_env.observation import encode_observation
from ae_env.scenes.scene import Scene
from ae_env.scorers.captures import prepare_scene
from ae_env.scorers.registry import scorer_fingerprint
from ae_env.scorers.term_scores import CHUNK, TermScores, slices
from ae_env.scorers.terms import CompositeScorer
from simulator.camera import CameraProfile
from simulator.capture.limits import DEFAULT_TOLERANCE, check_tolerance
from simulator.capture.prepared_scene import PreparedScene
from simulator.optics.motion import ALONG_ROWS, Movement
from simulator.utils.cache import cache_key, content_digest, disk_cache
from simulator.utils.checks import check_integer

#: Memory for the blurred light of one table [byte].
_LIGHT_BYTES = 2**25
#: Scores closer than this are equal: rounding moves them by 1e-8, noise seeds by 1e-5.
TIE = 1e-7


@dataclass(frozen=True)
class ScoreTable:
    """Expected scores of S states."""

    mean: np.ndarray  #: (S,) float64, q of each state
    standard_error: np.ndarray  #: (S,) float64, 0 where the closed form was used
    parts: dict[str, np.ndarray]  #: (S,) float64 of each part of the scorer
    allowed: np.ndarray | None = None  #: (S,) bool, states that the scene allows; None for all

    @property
    def nbytes(self) -> int:
        """Memory that the table takes [byte], about."""
        return sum(a.nbytes for a in (self.mean, self.standard_error, *self.parts.values()))

    @cached_property
    def oracle(self) -> int:
        """The best allowed state; of those within `TIE` of it, the one of the lowest index and ISO.

        States of equal exposure score alike but for the rounding of their settings.
        """
        mean = self.mean if self.allowed is None else np.where(self.allowed, self.mean, -np.inf)
        return int(np.argmax(mean >= mean.max() - TIE))


class ScoreTables:
    """Score tables of scenes under one scorer, camera and grid.

    Args:
        grid, camera, scorer: The states, the body that takes the captures, and what rates them.
        noise_seeds: Captures per state that the parts without a closed form are averaged over.
        noise: Whether the captures that are scored are noisy.
        tolerance: How far the captures that are scored may be off, see `PreparedScene.tolerance`.
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
        check_tolerance(tolerance)
        self.states, self.camera, self.scorer = grid.states, camera, scorer
        self.noise, self.noise_seeds = noise, noise_seeds if noise else 1
        self.tolerance = tolerance
        #: The scorer's parts, and how each is evaluated.
        self.term_scores = TermScores(scorer, camera, grid.states, noise=noise)

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
            speed, defocus, movement: See `prepare_scene`.
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
        key = self._stored_key(scene, prepared, gain, row_gain)
        stored = None if key is None else disk_cache().get(key)
        if stored is not None:
            return ScoreTable(stored.pop("mean"), stored.pop("error"), stored, scene.allowed)
        table = self._made(scene, prepared, gain, row_gain)
        if key is not None:
            disk_cache().put(key, {"mean": table.mean, "error": table.standard_error} | table.parts)
        return table

    def _stored_key(
        self, scene: Scene, prepared: PreparedScene, gain: Any, rows: Any
    ) -> str | None:
        """Key on the disk of the table of a scorer with ``stored = True``; None for any other."""
        slow = any(getattr(part, "stored", False) for part in self.scorer.parts.values())
        scorer = scorer_fingerprint(self.scorer) if slow and scene.noise_free else None
        if scorer is None or scene.ladder is None:
            return None
        known = scene.content, scene.ladder.facts, scene.ev100, scene.white_balance
        light = *known, scene.box_factor, repr((scene.reference, scene.camera))
        rows = None if rows is None else content_digest({"rows": torch.from_numpy(rows)})
        episode = prepared.image_speed, prepared.defocus, repr(prepared.movement), rows
        own = scorer, self.scorer.weights, repr((self.camera, self.states)), self.tolerance
        noise = self.noise, self.noise_seeds
        return cache_key("score_tables", [light, episode, np.asarray(gain).tolist(), own, noise])

    def _made(self, scene: Scene, prepared: PreparedScene, gain: Any, row_gain: Any) -> ScoreTable:
        """`table`, worked out."""
        terms, count = self.term_scores, len(self.states)
        light: dict[str, Any] = {"gain": gain, "row_gain": row_gain}
        parts = terms.closed_form_terms(scene, prepared, "light", "blur", **light)
        if scene.recorded is not None:
            return self._recorded_table(scene, prepared, parts)
        if terms.parts:
            captures = None
            if terms.reads_captures:
                captures = terms.captures.describe(scene, prepared, **light)
            parts |= terms.score(self._expected_means(prepared, gain, row_gain), captures)
        error = np.zeros(count)
        if terms.closed_form:
            mean = self.scorer.totals(parts)
        else:
            samples = self._samples(scene, prepared, gain, row_gain)
            totals = self.scorer.totals({**parts, **samples})  # (seeds, S)
            mean = totals.mean(axis=0)
            if self.noise_seeds > 1:
                error = totals.std(axis=0, ddof=1) / np.sqrt(self.noise_seeds)
            elif self.noise:
                error = np.full(count, np.nan)  # one sample has no standard error
            parts |= {name: values.mean(axis=0) for name, values in samples.items()}
        parts = {name: parts[name] for name in self.scorer.parts}
        return ScoreTable(mean, error, parts, scene.allowed)

    def _recorded_table(
        self, scene: Scene, prepared: PreparedScene, parts: dict[str, np.ndarray]
    ) -> ScoreTable:
        """Scores of the captures that there are, `Scene.recorded`; 0 where there is none.

        `prepared` is their merged light, `parts` have the scores of those that look at no frame.
        """
        frames, allowed = scene.recorded, scene.allowed
        assert frames is not None
        assert allowed is not None
        terms, count = self.term_scores, len(self.states)
        for part in slices(count, CHUNK):
            states, shown = np.arange(count)[part], frames[scene.frame_of_state[part]]
            captures = terms.captures.describe(scene, prepared, part)
            found: dict[str, np.ndarray] = {}
            if terms.parts:
                means = terms.measured(encode_observation(shown).numpy(), states)
                found = terms.score(means, captures)
            if not terms.closed_form:
                found |= terms.torch_scores(shown.clamp(0.0, 1.0), captures, "image")
            for name, values in found.items():
                parts.setdefault(name, np.zeros(count))[part] = values
        mean = np.where(allowed, self.scorer.totals(parts), 0.0)
        shown_parts = {name: np.where(allowed, parts[name], 0.0) for name in self.scorer.parts}
        return ScoreTable(mean, np.zeros(count), shown_parts, allowed)

    def _expected_means(
        self, prepared: PreparedScene, gain: float | np.ndarray, row_gain: np.ndarray | None
    ) -> np.ndarray:
        """`TermScores.expected` of all states, (S, 3)."""
        prepared = prepared.changed(blurred_light=prepared.blurred_light.copy(_LIGHT_BYTES))
        count = len(self.states)
        gains, means = np.broadcast_to(gain, count), np.empty((count, 3))
        for some, transitions in prepared.transitions(self.states, noise=self.noise, gain=gains):
            states, rows = np.arange(count)[some], None if row_gain is None else row_gain[some]
            boxes = np.full(len(states), prepared.box_factor)
            means[some] = self.term_scores.expected(transitions, states, boxes, rows)
        return means

    def _samples(
        self,
        scene: Scene,
        prepared: PreparedScene,
        gain: float | np.ndarray,
        row_gain: np.ndarray | None,
    ) -> dict[str, np.ndarray]:
        """Scores (seeds, S) of the parts without a closed form, on common noise seeds."""
        terms, gains = self.term_scores, np.broadcast_to(gain, len(self.states))
        chunks = []
        for part in slices(len(self.states), CHUNK):
            states, rows = self.states[part], None if row_gain is None else row_gain[part]
            light: Any = {"gain": gains[part], "row_gain": rows}
            light["noise"] = "exact" if self.noise else None
            captures, scored = terms.captures.describe(scene, prepared, part, gain, row_gain), []
            for seed in range(self.noise_seeds):
                images = prepared.expose(states, seed=seed, **light)
                scored.append(terms.torch_scores(images.clamp_(0.0, 1.0), captures, "image"))
            chunks.append({name: np.stack([s[name] for s in scored]) for name in scored[0]})
        return {name: np.concatenate([c[name] for c in chunks], axis=1) for name in chunks[0]}
