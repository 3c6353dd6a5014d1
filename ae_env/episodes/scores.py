"""Scores of the captures of running episodes, part by part."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from ae_env.episodes.state import Episodes
from ae_env.scenes.scene import Scene
from ae_env.scorers.captures import describe_captures
from ae_env.scorers.composite import CompositeScorer
from ae_env.scorers.protocol import Captures, DependsOn, reads_pixels
from ae_env.scorers.score_table import ScoreTables


class PartScores:
    """Scores captures; in static light, those with a closed form are cached.

    Args:
        tables: The scorer, and where its closed forms are worked out.
        scenes: Scenes that are photographed.
        episodes: The episodes that photograph them.
        static: Whether the light never changes.

    Attributes:
        reads_images: Whether a part looks at the images.
        reads_pixels: Whether a part looks at all pixels of a frame, in torch.
    """

    def __init__(
        self,
        tables: ScoreTables,
        scenes: Sequence[Scene],
        episodes: Episodes,
        *,
        static: bool,
    ) -> None:
        self.tables, self.scorer, self.grid = tables, tables.scorer, tables.grid
        self.scenes, self.episodes, self._static = scenes, episodes, static
        # By `Episodes.light_index` and state, the last column that of the whole scorer; and which
        # lights have been scored.
        lights = len(scenes) + len(episodes.light_index)
        self._closed = self.scorer.names("light", "blur") if static else []
        self._closed_columns = [f"score:{name}" for name in self._closed]
        self._scores = np.zeros((lights, len(self.grid), len(self._closed) + 1))
        self._scored = np.zeros(lights, bool)
        self.reads_images = not self.scorer.closed_form
        self._keeps_totals = static and self.scorer.closed_form
        others = None if static else tables.others
        self.reads_pixels = self.reads_images or (
            others is not None and any(map(reads_pixels, others.parts.values()))
        )

    def forget(self, lights: np.ndarray) -> None:
        """Makes the scores under these `Episodes.light_index` unknown."""
        self._scored[lights] = False

    def of(
        self,
        env_indices: np.ndarray,
        frames: np.ndarray | None,
        gains: np.ndarray,
        rows: np.ndarray | None,
    ) -> dict[str, np.ndarray]:
        """Scores (B,) of the captures of `env_indices`, by ``score:`` and the name of the part.

        Args:
            env_indices: (B,) of the environments.
            frames: (B, 4, R, R) float32 captures, where `reads_images`.
            gains: (B,) light relative to the scenes' own.
            rows: (B, R) light of each row relative to that, or None; see `Captures`.
        """
        lights, states = self.episodes.light_index[env_indices], self.episodes.state[env_indices]
        scores: dict[str, np.ndarray] = {}
        if self._static:
            if not self._scored[lights].all():
                self._score(env_indices)
            known = self._scores[lights, states].T
            scores = dict(zip(self._closed_columns, known, strict=False))
            if self.scorer.closed_form:
                return scores
        scenes = [self.scenes[scene] for scene in self.episodes.scene[env_indices].tolist()]
        captures = self._captures(env_indices, scenes, gains, rows)
        parts: CompositeScorer | None = self.scorer
        kinds: tuple[DependsOn, ...] = ("image",)
        if not self._static:
            fused = self.tables.fused
            found = fused.scores(captures, fused.means(scenes, captures))
            scores = {f"score:{name}": values for name, values in found.items()}
            parts, kinds = self.tables.others, ("image", "light", "blur")
        images = None if frames is None else torch.from_numpy(frames).clamp(0.0, 1.0)
        if parts is not None:
            for name, values in parts.score_parts(images, captures, kinds).items():
                scores[f"score:{name}"] = values.numpy()
        return scores

    def totals(self, parts: dict[str, np.ndarray], env_indices: np.ndarray) -> np.ndarray:
        """(B,) float64 of the whole scorer, from the scores of its parts."""
        if self._keeps_totals:
            lights = self.episodes.light_index[env_indices]
            return self._scores[lights, self.episodes.state[env_indices], -1]
        return self.scorer.totals(parts)

    def _captures(
        self,
        env_indices: np.ndarray,
        scenes: Sequence[Scene],
        gains: np.ndarray,
        rows: np.ndarray | None,
    ) -> Captures:
        light = None
        if not self.reads_pixels:
            light = torch.empty(1).expand(len(env_indices), *scenes[0].light.shape)
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
        )

    def _score(self, env_indices: np.ndarray) -> None:
        """Works out the scores with a closed form, where the lights of `env_indices` lack them."""
        lights, first = np.unique(self.episodes.light_index[env_indices], return_index=True)
        missing = ~self._scored[lights]
        lights, first = lights[missing], first[missing]
        for light, env_index in zip(lights.tolist(), env_indices[first].tolist(), strict=True):
            episode = self.episodes[env_index]
            parts = self.tables.closed_parts(self.scenes[episode.scene], **episode.moves)
            for column, name in enumerate(self._closed):
                self._scores[light, :, column] = parts[name]
        if self.scorer.closed_form:
            columns = np.moveaxis(self._scores[lights], -1, 0).copy()
            totals = self.scorer.totals(dict(zip(self._closed, columns, strict=False)))
            self._scores[lights, :, -1] = totals
        self._scored[lights] = True
