"""Expected scores of every exposure state of a scene, and their cache.

``q(s)`` is the expectation of a state's score over noise. Parts of a scorer with a closed form are
evaluated once on noise-free light; the others are averaged over common noise seeds, with their
standard error.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from ae_env.checks import check_integer
from ae_env.grid import ExposureGrid
from ae_env.scenes.scene import Scene
from ae_env.scorers.call import is_own
from ae_env.scorers.composite import CompositeScorer
from ae_env.scorers.protocol import Captures, DependsOn
from ae_env.scorers.registry import scorer_fingerprint
from simulator.cache import DiskCache, LruCache, cache_key
from simulator.camera import CameraProfile
from simulator.capture import clip_and_quantise
from simulator.latent import Latent
from simulator.settings import CameraSettings, exposure_ratio
from simulator.tolerance import DEFAULT_TOLERANCE, check_tolerance

#: Bumped when the way that scores are computed changes.
TABLE_VERSION = 3
#: What the scores that are kept in memory take at most: some 10,000 scenes at 64 states [byte].
MEMORY_BYTES = 2**25
#: States evaluated at once: more only spends time in memory paging. Where only the blur matters,
#: which seldom looks at pixels, as many as this number of samples allows.
_CHUNK = 16
_BLUR_SAMPLES = 2**22
#: What an entry takes in memory beside its numbers, about [byte].
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
    """

    mean: np.ndarray
    standard_error: np.ndarray
    parts: dict[str, np.ndarray]

    @cached_property
    def oracle(self) -> int:
        """The best state; ties go to the lower index, that is the lower ISO.

        States of equal exposure score alike but for the rounding of their settings: a tie is
        whatever comes within `TIE` of the best.
        """
        return int(np.argmax(self.mean >= self.mean.max() - TIE))


def scene_latent(
    scene: Scene,
    camera: CameraProfile,
    *,
    speed: float = 0.0,
    defocus: float = 0.0,
    gain: float = 1.0,
) -> Latent:
    """What `camera` sees of `scene` in an episode.

    Args:
        scene: The scene.
        camera: The body that takes the captures.
        speed: Image speed [frame heights per second].
        defocus: Blur diameter at f/4 [pixel of a 64-pixel frame].
        gain: Light relative to the scene's own.
    """
    latent = replace(scene.latent, camera=camera)
    return in_episode(latent, speed=speed, defocus=defocus, gain=gain)


def in_episode(
    latent: Latent, *, speed: float = 0.0, defocus: float = 0.0, gain: float = 1.0
) -> Latent:
    """A scene's `latent` in an episode; the arguments are those of `scene_latent`."""
    pixels = defocus * latent.light.shape[-2] / 64.0
    return replace(latent, image_speed=speed, defocus=pixels, gain=gain)


def describe_captures(
    scenes: list[Scene],
    settings: list[CameraSettings],
    camera: CameraProfile,
    *,
    speed: np.ndarray,
    defocus: np.ndarray,
    gain: np.ndarray,
    light: torch.Tensor | None = None,
) -> Captures:
    """`Captures` of one state each of `scenes`, all (B,) long.

    Args:
        scenes: Scene of each capture.
        settings: Settings of each capture.
        camera: The body.
        speed: (B,) image speed [frame heights per second].
        defocus: (B,) blur diameter at f/4 [pixel of a 64-pixel frame].
        gain: (B,) light relative to the scenes' own.
        light: (B, 4, H, W) the scenes' `Scene.clean_light` where it is at hand already.
    """
    height = scenes[0].light.shape[-2]
    times = np.array([s.exposure_time for s in settings])
    openings = np.array([4.0 / s.effective_f_number for s in settings])
    blur = np.hypot(speed * times * height, defocus * openings * height / 64.0)
    own = [c.own_blur(s.effective_f_number) for c, s in zip(scenes, settings, strict=True)]
    blur = np.hypot(blur, own)  # exactly `blur` where they are 0
    ratios = [exposure_ratio(c.reference, s) for c, s in zip(scenes, settings, strict=True)]
    return Captures(
        settings=settings,
        scene_ids=[c.scene_id for c in scenes],
        scene_light=torch.stack([c.clean_light for c in scenes]) if light is None else light,
        ratio=torch.from_numpy(np.array(ratios) * gain),
        nlf=[camera.nlf(s.iso) for s in settings],
        proper_ev=torch.from_numpy(np.array([c.ev100 for c in scenes]) + np.log2(gain)),
        blur_px=torch.from_numpy(blur),
        white_balance=torch.tensor([c.white_balance for c in scenes]),
        colour_matrices=[c.camera.colour_matrix for c in scenes],
    )


@dataclass(frozen=True)
class _AtRest:
    """Captures of a scene at rest, without its light, and what their blur is worked out from."""

    scene: weakref.ref[Scene]
    captures: Captures
    times: np.ndarray
    openings: np.ndarray


class ScoreTables:
    """Score tables of scenes under one scorer, camera and grid.

    Args:
        grid: The states.
        camera: The body that takes the captures.
        scorer: What rates them.
        noise_seeds: Captures per state that the parts without a closed form are averaged over.
        noise: Whether the captures that are scored are noisy.
        tolerance: How far the captures that are scored may be off, see `Latent.tolerance`.
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
        self._copies = is_own(scorer)
        self._disk = DiskCache()
        self._light_parts: LruCache[_LightParts] = LruCache(MEMORY_BYTES)
        self._at_rest: LruCache[_AtRest] = LruCache(MEMORY_BYTES)

    def table(
        self, scene: Scene, *, speed: float = 0.0, defocus: float = 0.0, gain: float = 1.0
    ) -> ScoreTable:
        """Expected scores of all states of `scene` in an episode (see `scene_latent`)."""
        parts = self.closed_parts(scene, speed=speed, defocus=defocus, gain=gain)
        if self.scorer.closed_form:
            parts = {name: parts[name] for name in self.scorer.parts}
            mean = self.scorer.totals(parts)
            return ScoreTable(mean, np.zeros(len(self.grid)), parts)
        samples = self._samples(scene, speed, defocus, gain)
        totals = self.scorer.totals({**parts, **samples})  # (seeds, S)
        if not self.noise:
            error = np.zeros(len(self.grid))
        elif self.noise_seeds > 1:
            error = totals.std(axis=0, ddof=1) / np.sqrt(self.noise_seeds)
        else:
            error = np.full(len(self.grid), np.nan)  # one sample has no standard error
        parts |= {name: values.mean(axis=0) for name, values in samples.items()}
        return ScoreTable(
            totals.mean(axis=0), error, {name: parts[name] for name in self.scorer.parts}
        )

    def closed_parts(
        self, scene: Scene, *, speed: float = 0.0, defocus: float = 0.0, gain: float = 1.0
    ) -> dict[str, np.ndarray]:
        """Scores (S,) of those parts of the scorer that have a closed form."""
        blur_parts = self._parts(scene, ("blur",), speed=speed, defocus=defocus, gain=gain)
        return {**self._scene_parts(scene, gain), **blur_parts}

    def _scene_parts(self, scene: Scene, gain: float) -> dict[str, np.ndarray]:
        known = self._light_parts.get((id(scene), gain))
        if known is not None and known.scene() is scene:  # an id may be given out again
            return known.parts
        names = self.scorer.names("light")
        key = self._key(scene) if names and gain == 1.0 else None
        stored = None if key is None else self._disk.get("score_tables", key)
        if stored is not None and set(stored) == set(names):
            parts = {name: stored[name].numpy() for name in names}
        else:
            parts = self._parts(scene, ("light",), speed=0.0, defocus=0.0, gain=gain)
            if key is not None:
                kept = {name: torch.from_numpy(values) for name, values in parts.items()}
                self._disk.put("score_tables", key, kept)
        size = sum(values.nbytes for values in parts.values())
        self._light_parts.put(
            (id(scene), gain), _LightParts(weakref.ref(scene), parts), size + _ENTRY_BYTES
        )
        return parts

    def _parts(
        self,
        scene: Scene,
        kinds: tuple[DependsOn, ...],
        *,
        speed: float,
        defocus: float,
        gain: float,
    ) -> dict[str, np.ndarray]:
        if not self.scorer.names(*kinds):
            return {}
        chunks = []
        size = max(_CHUNK, _BLUR_SAMPLES // scene.light.numel()) if kinds == ("blur",) else _CHUNK
        for states in _chunks(list(self.grid.states), size):
            if kinds == ("blur",) and gain == 1.0:
                captures = self._blurred_captures(scene, states, speed, defocus)
            else:
                captures = self._captures(scene, states, speed, defocus, gain)
            scores = self.scorer.score_parts(None, captures, kinds)
            chunks.append({name: values.numpy() for name, values in scores.items()})
        return {name: np.concatenate([c[name] for c in chunks]) for name in chunks[0]}

    def _captures(
        self, scene: Scene, states: list[CameraSettings], speed: float, defocus: float, gain: float
    ) -> Captures:
        count = len(states)
        return describe_captures(
            [scene] * count,
            states,
            self.camera,
            speed=np.full(count, speed),
            defocus=np.full(count, defocus),
            gain=np.full(count, gain),
            light=self._light(scene, count),
        )

    def _blurred_captures(
        self, scene: Scene, states: list[CameraSettings], speed: float, defocus: float
    ) -> Captures:
        """`_captures` at a gain of 1: what does not depend on the blur is kept."""
        key = (id(scene), states[0])
        known = self._at_rest.get(key)
        if known is None or known.scene() is not scene or len(known.times) != len(states):
            known = self._described(scene, states)
            self._at_rest.put(key, known, _ENTRY_BYTES * len(states))
        height = scene.light.shape[-2]
        blur = np.hypot(speed * known.times * height, defocus * known.openings * height / 64.0)
        return replace(
            known.captures,
            scene_light=self._light(scene, len(states)),
            blur_px=torch.from_numpy(np.hypot(blur, known.captures.blur_px.numpy())),
        )

    def _light(self, scene: Scene, count: int) -> torch.Tensor:
        light = scene.clean_light.clone() if self._copies else scene.clean_light
        return light.expand(count, -1, -1, -1)

    def _described(self, scene: Scene, states: list[CameraSettings]) -> _AtRest:
        captures = self._captures(scene, states, 0.0, 0.0, 1.0)
        return _AtRest(
            weakref.ref(scene),
            replace(captures, scene_light=torch.empty(0)),  # keeps no scene alive
            np.array([s.exposure_time for s in states]),
            np.array([4.0 / s.effective_f_number for s in states]),
        )

    def _samples(
        self, scene: Scene, speed: float, defocus: float, gain: float
    ) -> dict[str, np.ndarray]:
        """Scores (seeds, S) of the parts without a closed form, on common noise seeds."""
        latent = scene_latent(scene, self.camera, speed=speed, defocus=defocus, gain=gain)
        latent = replace(latent, tolerance=self.tolerance)
        names = self.scorer.names("image")
        samples = {name: np.zeros((self.noise_seeds, len(self.grid))) for name in names}
        start = 0
        for states in _chunks(list(self.grid.states)):
            captures = self._captures(scene, states, speed, defocus, gain)
            for seed in range(self.noise_seeds):
                if self.noise:
                    images = latent.expose(states, seed=seed)
                else:
                    light = torch.stack([latent.expected(state) for state in states])
                    images = clip_and_quantise(light, self.camera)
                images = images.clamp_(0.0, 1.0)
                for name, values in self.scorer.score_parts(images, captures, ("image",)).items():
                    samples[name][seed, start : start + len(states)] = values.numpy()
            start += len(states)
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
    """Scores (S,) of a scene by part; the scene itself is not kept for them."""

    scene: weakref.ref[Scene]
    parts: dict[str, np.ndarray]


def _chunks(states: list[CameraSettings], size: int = _CHUNK) -> list[list[CameraSettings]]:
    return [states[i : i + size] for i in range(0, len(states), size)]
