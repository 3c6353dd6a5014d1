"""Expected scores of every exposure state of a scene, and their cache.

``q(s)`` is the expectation of a state's score over noise. Parts of a scorer with a closed form are
evaluated once on noise-free light; the others are averaged over common noise seeds, with their
standard error.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from ae_env.grid import ExposureGrid
from ae_env.scenes.scene import Scene
from ae_env.scorers.captures import SceneCaptures
from ae_env.scorers.composite import CompositeScorer, is_own
from ae_env.scorers.fused import FusedScores
from ae_env.scorers.protocol import DependsOn, reads_pixels
from ae_env.scorers.registry import scorer_fingerprint
from ae_env.utils.checks import check_integer
from simulator.camera import CameraProfile
from simulator.capture.plan import DEFAULT_TOLERANCE, check_tolerance
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import clip_and_quantise
from simulator.optics.motion_path import ALONG_ROWS, Movement
from simulator.utils.cache import DiskCache, LruCache, cache_key

#: Bumped when the way that scores are computed changes.
TABLE_VERSION = 5
#: Memory for cached scores [byte]: some 10,000 scenes at 64 states.
MEMORY_BYTES = 2**25
#: States evaluated at once: more only spends time in memory paging. Where only the blur matters,
#: which seldom looks at pixels, as many as this number of samples allows.
_CHUNK = 16
_BLUR_SAMPLES = 2**22
#: Memory that an entry takes besides its numbers, about [byte].
_ENTRY_BYTES = 1000
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
    gain: float = 1.0,
) -> PreparedScene:
    """`scene` as `camera` sees it in an episode.

    Args:
        scene: The scene.
        camera: The body that takes the captures.
        speed: Image speed [frame heights per second].
        defocus: Blur diameter at f/4 [pixel of a 64-pixel frame], of what is least in focus.
        movement: Directions of the image's motion, and the subject's own.
        gain: Light relative to the scene's own.
    """
    prepared = replace(scene.prepared, camera=camera)
    return in_episode(prepared, speed=speed, defocus=defocus, movement=movement, gain=gain)


def in_episode(
    prepared: PreparedScene,
    *,
    speed: float = 0.0,
    defocus: float = 0.0,
    movement: Movement = ALONG_ROWS,
    gain: float = 1.0,
) -> PreparedScene:
    """A scene's `prepared` in an episode; the arguments are those of `prepare_scene`."""
    pixels = defocus * prepared.light.shape[-2] / 64.0
    return replace(prepared, image_speed=speed, defocus=pixels, movement=movement, gain=gain)


class ScoreTables:
    """Score tables of scenes under one scorer, camera and grid.

    Args:
        grid: The states.
        camera: The body that takes the captures.
        scorer: The scorer that rates them.
        noise_seeds: Captures per state that the parts without a closed form are averaged over.
        noise: Whether the captures that are scored are noisy.
        tolerance: How far the captures that are scored may be off, see `PreparedScene.tolerance`.
        use_cache: Whether to keep the per-scene parts on disk; in memory they are in any case.
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
        use_cache: bool = True,
    ) -> None:
        check_integer("noise_seeds", noise_seeds, 1)
        self.grid, self.camera, self.scorer = grid, camera, scorer
        self.noise, self.noise_seeds = noise, noise_seeds if noise else 1
        check_tolerance(tolerance)
        self.tolerance = tolerance
        fingerprint = scorer_fingerprint(scorer) if use_cache else None
        self._fingerprint = fingerprint
        # Scorers of one's own get a copy of the light, lest they write to the scene.
        self._captures = SceneCaptures(camera, MEMORY_BYTES, copies=is_own(scorer))
        self._disk = DiskCache()
        self._light_parts: LruCache[_LightParts] = LruCache(MEMORY_BYTES)
        self.fused = FusedScores(scorer)
        #: All other parts; None if there are none.
        self.others = scorer.subset(set(scorer.parts) - set(self.fused.parts))

    def table(
        self,
        scene: Scene,
        *,
        speed: float = 0.0,
        defocus: float = 0.0,
        movement: Movement = ALONG_ROWS,
        gain: float | np.ndarray = 1.0,
        row_gain: np.ndarray | None = None,
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
        """
        moves: Any = {"speed": speed, "defocus": defocus, "movement": movement}
        parts = self.closed_parts(scene, **moves, gain=gain, row_gain=row_gain)
        if self.scorer.closed_form:
            parts = {name: parts[name] for name in self.scorer.parts}
            mean = self.scorer.totals(parts)
            return ScoreTable(mean, np.zeros(len(self.grid)), parts, scene.allowed)
        samples = self._samples(scene, moves, gain, row_gain)
        totals = self.scorer.totals({**parts, **samples})  # (seeds, S)
        if not self.noise:
            error = np.zeros(len(self.grid))
        elif self.noise_seeds > 1:
            error = totals.std(axis=0, ddof=1) / np.sqrt(self.noise_seeds)
        else:
            error = np.full(len(self.grid), np.nan)  # one sample has no standard error
        parts |= {name: values.mean(axis=0) for name, values in samples.items()}
        parts = {name: parts[name] for name in self.scorer.parts}
        return ScoreTable(totals.mean(axis=0), error, parts, scene.allowed)

    def closed_parts(
        self,
        scene: Scene,
        *,
        speed: float = 0.0,
        defocus: float = 0.0,
        movement: Movement = ALONG_ROWS,
        gain: float | np.ndarray = 1.0,
        row_gain: np.ndarray | None = None,
    ) -> dict[str, np.ndarray]:
        """Scores (S,) of those parts of the scorer that have a closed form; see `table`."""
        moves: Any = {"speed": speed, "defocus": defocus, "movement": movement}
        light: Any = {"gain": gain, "row_gain": row_gain}
        if isinstance(gain, np.ndarray) or row_gain is not None:  # hardly comes again
            found = self._of_light(scene, **light)
        else:
            found = self._of_steady_light(scene, gain)
        parts = dict(found.parts)
        if self.fused.parts:
            states = self.grid.states
            captures = self._captures.describe(scene, states, **moves, **light)
            parts |= self.fused.scores(captures, found.means)
        return parts | self._parts(scene, ("blur",), moves, **light)

    def _of_steady_light(self, scene: Scene, gain: float) -> _LightParts:
        """The parts that do not depend on blur, cached in memory; of the own light, on disk too."""
        known = self._light_parts.get((id(scene), gain))
        if known is not None and known.scene() is scene:  # an id may be given out again
            return known
        found = self._of_own_light(scene) if gain == 1.0 else self._of_light(scene, gain=gain)
        size = found.means.nbytes + sum(values.nbytes for values in found.parts.values())
        self._light_parts.put((id(scene), gain), found, size + _ENTRY_BYTES)
        return found

    def _of_own_light(self, scene: Scene) -> _LightParts:
        """That of the scene's own light, from the disk where it has been made before."""
        names = [] if self.others is None else self.others.names("light")
        key = self._key(scene) if names or self.fused.reads_pixels else None
        stored = None if key is None else self._disk.get("score_tables", key)
        if stored is not None and self._is_whole(stored, names):
            parts = {name: stored[f"score:{name}"].numpy() for name in names}
            return _LightParts(weakref.ref(scene), stored["means"].numpy(), parts)
        found = self._of_light(scene, keep=False)  # the means are cached, not the pixels
        if key is not None:
            scores = {f"score:{name}": torch.from_numpy(v) for name, v in found.parts.items()}
            self._disk.put("score_tables", key, {"means": torch.from_numpy(found.means), **scores})
        return found

    def _is_whole(self, stored: dict[str, torch.Tensor], names: Sequence[str]) -> bool:
        """Whether a cached table has the shapes that are due, and finite numbers only."""
        count = len(self.grid)
        shapes: dict[str, list[int]] = {f"score:{name}": [count] for name in names}
        shapes["means"] = [count if self.fused.reads_pixels else 0, 3]
        found = {name: list(part.shape) for name, part in stored.items()}
        return found == shapes and all(bool(part.isfinite().all()) for part in stored.values())

    def _of_light(
        self,
        scene: Scene,
        *,
        gain: float | np.ndarray = 1.0,
        row_gain: np.ndarray | None = None,
        keep: bool = True,
    ) -> _LightParts:
        """The parts that depend on the scene and its light; `keep` as in `FusedScores.means`."""
        states, means = self.grid.states, np.empty((0, 3))
        light: Any = {"gain": gain, "row_gain": row_gain}
        if self.fused.reads_pixels:
            captures = self._captures.describe(scene, states, **light)
            means = self.fused.means([scene] * len(states), captures, keep=keep)
        return _LightParts(weakref.ref(scene), means, self._parts(scene, ("light",), **light))

    def _parts(
        self,
        scene: Scene,
        kinds: tuple[DependsOn, ...],
        moves: dict[str, Any] | None = None,
        *,
        gain: float | np.ndarray = 1.0,
        row_gain: np.ndarray | None = None,
    ) -> dict[str, np.ndarray]:
        """Scores (S,) of those of `others` that depend on one of `kinds`.

        `moves` has the arguments of `SceneCaptures.describe` that blur depends on.
        """
        names = [] if self.others is None else self.others.names(*kinds)
        if self.others is None or not names:
            return {}
        size, chunks = _CHUNK, []
        if kinds == ("blur",):
            size = max(size, _BLUR_SAMPLES // scene.light.numel())
        elif not any(reads_pixels(self.others.parts[name]) for name in names):
            size = len(self.grid)
        for part in _slices(len(self.grid), size):
            captures = self._captures.describe(
                scene,
                self.grid.states[part],
                **(moves or {}),
                gain=gain[part] if isinstance(gain, np.ndarray) else gain,
                row_gain=None if row_gain is None else row_gain[part],
            )
            scores = self.others.score_parts(None, captures, kinds)
            chunks.append({name: values.numpy() for name, values in scores.items()})
        return {name: np.concatenate([c[name] for c in chunks]) for name in chunks[0]}

    def _samples(
        self,
        scene: Scene,
        moves: dict[str, Any],
        gain: float | np.ndarray,
        row_gain: np.ndarray | None,
    ) -> dict[str, np.ndarray]:
        """Scores (seeds, S) of the parts without a closed form, on common noise seeds."""
        prepared = prepare_scene(scene, self.camera, **moves)
        prepared = replace(prepared, tolerance=self.tolerance)
        if not isinstance(gain, np.ndarray):
            gain = np.full(len(self.grid), gain)
        names = self.scorer.names("image")
        samples = {name: np.zeros((self.noise_seeds, len(self.grid))) for name in names}
        for part in _slices(len(self.grid), _CHUNK):
            states = self.grid.states[part]
            gains, rows = gain[part], None if row_gain is None else row_gain[part]
            captures = self._captures.describe(scene, states, **moves, gain=gains, row_gain=rows)
            light: Any = {"gain": gains, "row_gain": rows}
            for seed in range(self.noise_seeds):
                if self.noise:
                    images = prepared.expose(states, seed=seed, **light)
                else:
                    signals = prepared.expected_sweep(states, **light)
                    images = clip_and_quantise(signals, self.camera)
                images = images.clamp_(0.0, 1.0)
                for name, values in self.scorer.score_parts(images, captures, ("image",)).items():
                    samples[name][seed, part] = values.numpy()
        return samples

    def _key(self, scene: Scene) -> str | None:
        """Key of everything that changes the scores; None where the scorer cannot be told."""
        if self._fingerprint is None:
            return None
        reference, noise = scene.reference, [self.camera.nlf(iso) for iso in self.grid.isos]
        return cache_key(
            {
                "version": TABLE_VERSION,
                "scorer": self._fingerprint,
                "states": [self.grid.isos, self.grid.exposure_times, self.grid.f_numbers],
                "camera": [self.camera.name, [(nlf.shot, nlf.read) for nlf in noise]],
                "reference": [reference.iso, reference.exposure_time, reference.f_number],
                "ev100": scene.ev100,
                "scene": scene.scene_id,
                "white_balance": scene.white_balance,
                "colour_matrix": scene.camera.colour_matrix,
                "content": scene.content,
            }
        )


@dataclass(frozen=True)
class _LightParts:
    """The parts of a score that a scene's light decides; they keep no scene alive.

    Args:
        scene: The scene.
        means: Of `FusedScores.means`.
        parts: Scores (S,) of the other parts by name.
    """

    scene: weakref.ref[Scene]
    means: np.ndarray
    parts: dict[str, np.ndarray]


def _slices(count: int, size: int) -> list[slice]:
    return [slice(i, min(i + size, count)) for i in range(0, count, size)]
