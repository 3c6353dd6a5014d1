"""Scores of the captures of running episodes, part by part."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from ae_env.episodes.recorded import RecordedBatch
from ae_env.episodes.scene_facts import SceneFacts
from ae_env.episodes.state import Episodes
from ae_env.scenes.scene import Scene
from ae_env.scorers.captures import describe_captures
from ae_env.scorers.protocol import Captures, reads_pixels
from ae_env.scorers.score_table import ScoreTables
from simulator.capture.batch import CaptureBatch, FrameStatistics
from simulator.capture.prepared_scene import PreparedScene
from simulator.noise.noise_level_function import NoiseLevelFunction

#: From so many new captures on, each is scored alone; below, all states of their lights are.
_MANY = 8


class PartScores:
    """Scores the captures of running episodes.

    Parts that look at no frame are cached in static light, and so are expectations.

    Args:
        tables: The scorer, and where expectations are worked out.
        scenes: Scenes that are photographed.
        facts: What is known of them.
        episodes: The episodes that photograph them.
        batch: What photographs them.
        static: Whether the light never changes.
        expected: Whether the parts that are measured on frames are replaced by their expectation.

    Attributes:
        reads_codes: Whether a part is measured on the codes of the frames.
        reads_images: Whether a part looks at the images.
        reads_pixels: Whether a part looks at all pixels of a frame, in torch.
    """

    def __init__(
        self,
        tables: ScoreTables,
        scenes: Sequence[Scene],
        facts: SceneFacts,
        episodes: Episodes,
        batch: CaptureBatch | RecordedBatch,
        *,
        static: bool,
        expected: bool,
    ) -> None:
        self.tables, self.grid, self.batch = tables, tables.grid, batch
        self.scenes, self.episodes, self._static = scenes, episodes, static
        self._code_scores, self._others = tables.code_scores, tables.others
        others = self._others
        # By `Episodes.light_index` and state; and which have been scored.
        lights = len(scenes) + len(episodes.light_index)
        self._known = [] if others is None else others.names("light", "blur")
        self._scores = np.zeros((lights, len(self.grid), len(self._known)))
        self._scored = np.zeros((lights, len(self.grid)), bool)
        self._of_light: dict[int, dict[str, np.ndarray]] = {}  # by scene; see `_light_scores`
        self._means = np.full((lights, len(self.grid), 3), np.nan)
        self._box_factors = facts.box_factor
        self.reads_images = not tables.closed_form and not expected
        self._measures = bool(self._code_scores.parts)
        self._expected = expected
        self.reads_codes = self._measures and not expected
        self.reads_pixels = self.reads_images or (
            others is not None and any(map(reads_pixels, others.parts.values()))
        )

    def forget(self, lights: np.ndarray) -> None:
        """Makes the scores under these `Episodes.light_index` unknown."""
        self._scored[lights] = False
        self._means[lights] = np.nan

    def of(
        self,
        env_indices: np.ndarray,
        frames: FrameStatistics,
        codes: np.ndarray | None,
        images: np.ndarray | None,
        gains: np.ndarray,
        rows: np.ndarray | None,
    ) -> dict[str, np.ndarray]:
        """Scores (B,) of the captures of `env_indices`, by ``score:`` and the name of the part.

        Args:
            env_indices: (B,) of the environments.
            frames: Statistics of their frames.
            codes: (B, 4, R, R) uint8 of the frames, where `reads_codes`.
            images: (B, 4, R, R) float32 frames, where `reads_images`.
            gains: (B,) light relative to the scenes' own.
            rows: (B, R) light of each row relative to that, or None; see `Captures`.
        """
        boxes = self._box_factors[self.episodes.scene[env_indices]]
        brought = frames.source_noise * np.square(boxes)[:, None, None]
        captures: Captures | None = None
        if self.reads_images or not self._static or self._code_scores.reads_captures:
            captures = self._captures(env_indices, gains, rows, brought)
        scores = self._known_scores(env_indices, captures, gains, brought)
        if self._measures:
            states = self.episodes.state[env_indices]
            if codes is None:
                means = self._expected_means(env_indices, boxes, rows)
            else:
                means = self._code_scores.measured(codes, states, brought)
            scores |= self._code_scores.scores(captures, means)
        if images is not None and self._others is not None and captures is not None:
            shown = torch.from_numpy(images).clamp(0.0, 1.0)
            found = self._others.score_parts(shown, captures, ("image",))
            scores |= {name: values.numpy() for name, values in found.items()}
        return {f"score:{name}": values for name, values in scores.items()}

    def _known_scores(
        self,
        env_indices: np.ndarray,
        captures: Captures | None,
        gains: np.ndarray,
        brought: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """Scores of the parts that look at no frame; in static light, cached."""
        if self._others is None or not self._known:
            return {}
        if not self._static and captures is not None:
            found = self._others.score_parts(None, captures, ("light", "blur"))
            return {name: values.numpy() for name, values in found.items()}
        lights, states = self.episodes.light_index[env_indices], self.episodes.state[env_indices]
        new = np.flatnonzero(~self._scored[lights, states])
        if len(new) >= _MANY:
            own = self._captures(env_indices[new], gains[new], None, brought[new])
            found = self._others.score_parts(None, own, ("light", "blur"))
            columns = [found[name].numpy() for name in self._known]
            self._scores[lights[new], states[new]] = np.stack(columns, axis=1)
            self._scored[lights[new], states[new]] = True
        else:
            self._score_all_states(env_indices[new])
        return dict(zip(self._known, self._scores[lights, states].T, strict=True))

    def _score_all_states(self, env_indices: np.ndarray) -> None:
        """Scores every state of the lights of `env_indices`: one by one takes longer."""
        for env_index in env_indices.tolist():
            light, scene = (
                int(of_each[env_index])
                for of_each in (self.episodes.light_index, self.episodes.scene)
            )
            prepared = self.batch.prepared_scene(light)
            parts = self._light_scores(scene, prepared)
            parts |= self.tables.known_parts(self.scenes[scene], prepared, kinds=("blur",))
            self._scores[light] = np.stack([parts[name] for name in self._known], axis=1)
            self._scored[light] = True

    def _light_scores(self, scene: int, prepared: PreparedScene) -> dict[str, np.ndarray]:
        """Scores of the parts that depend on the light alone: no episode changes them.

        The blur averages the noise that a source brings, so only those without it are cached.
        """
        known = self._of_light.get(scene)
        if known is None:
            known = self.tables.known_parts(self.scenes[scene], prepared, kinds=("light",))
            if prepared.nlf.is_zero:
                self._of_light[scene] = known
        return dict(known)

    def _expected_means(
        self, env_indices: np.ndarray, boxes: np.ndarray, rows: np.ndarray | None
    ) -> np.ndarray:
        """`CodeScores.expected` of the captures; in static light, cached."""
        lights, states = self.episodes.light_index[env_indices], self.episodes.state[env_indices]
        missing = np.isnan(self._means[lights, states, 0]) | (not self._static)
        if missing.any():
            assert isinstance(self.batch, CaptureBatch)  # recorded frames are measured
            transitions = self.batch.transitions(lights[missing], states[missing])
            gains = None if rows is None else rows[missing]
            found = self._code_scores.expected(transitions, states[missing], boxes[missing], gains)
            self._means[lights[missing], states[missing]] = found
        return self._means[lights, states]

    def _captures(
        self,
        env_indices: np.ndarray,
        gains: np.ndarray,
        rows: np.ndarray | None,
        brought: np.ndarray,
    ) -> Captures:
        scenes = [self.scenes[scene] for scene in self.episodes.scene[env_indices].tolist()]
        light = None
        if not self.reads_pixels:
            light = torch.empty(1).expand(len(env_indices), *scenes[0].light.shape)
        noises = None
        if brought.any():
            noises = [NoiseLevelFunction(tuple(s), tuple(r)) for s, r in brought.tolist()]
        return describe_captures(
            scenes,
            [self.grid[state] for state in self.episodes.state[env_indices].tolist()],
            self.tables.camera,
            speed=self.episodes.speed[env_indices],
            defocus=self.episodes.defocus[env_indices],
            movements=[self.episodes[index].movement for index in env_indices.tolist()],
            gain=gains,
            row_gain=rows,
            light=light,
            source_noise=noises,
            noisy=self.tables.noise,
        )
