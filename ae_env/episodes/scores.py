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
    """Scores captures; in static light, those with a closed form are kept by slot and state.

    Args:
        tables: The scorer, and where its closed forms are worked out.
        scenes: What is photographed; the first slots are theirs, then there is one per place.
        episodes: Who photographs it.
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
        # By slot and state, the last column that of the whole; and which slots have them.
        slots = len(scenes) + len(episodes.slot)
        self._closed = self.scorer.names("light", "blur") if static else []
        self._closed_columns = [f"score:{name}" for name in self._closed]
        self._scores = np.zeros((slots, len(self.grid), len(self._closed) + 1))
        self._scored = np.zeros(slots, bool)
        self.reads_images = not self.scorer.closed_form
        self._keeps_totals = static and self.scorer.closed_form
        others = None if static else tables.others
        self.reads_pixels = self.reads_images or (
            others is not None and any(map(reads_pixels, others.parts.values()))
        )

    def forget(self, slots: np.ndarray) -> None:
        """Makes the scores of `slots` unknown."""
        self._scored[slots] = False

    def of(
        self,
        places: np.ndarray,
        frames: np.ndarray | None,
        gains: np.ndarray,
        rows: np.ndarray | None,
    ) -> dict[str, np.ndarray]:
        """Scores (B,) of the captures at `places`, by ``score:`` and the name of the part.

        Args:
            places: (B,) of the episodes.
            frames: (B, 4, R, R) float32 captures, where `reads_images`.
            gains: (B,) light relative to the scenes' own.
            rows: (B, R) light of each row relative to that, or None; see `Captures`.
        """
        slots, states = self.episodes.slot[places], self.episodes.state[places]
        scores: dict[str, np.ndarray] = {}
        if self._static:
            if not self._scored[slots].all():
                self._score(places)
            known = self._scores[slots, states].T
            scores = dict(zip(self._closed_columns, known, strict=False))
            if self.scorer.closed_form:
                return scores
        scenes = [self.scenes[scene] for scene in self.episodes.scene[places].tolist()]
        captures = self._captures(places, scenes, gains, rows)
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

    def totals(self, parts: dict[str, np.ndarray], places: np.ndarray) -> np.ndarray:
        """(B,) float64 of the whole scorer, from the scores of its parts."""
        if self._keeps_totals:
            return self._scores[self.episodes.slot[places], self.episodes.state[places], -1]
        return self.scorer.totals(parts)

    def _captures(
        self,
        places: np.ndarray,
        scenes: Sequence[Scene],
        gains: np.ndarray,
        rows: np.ndarray | None,
    ) -> Captures:
        light = None
        if not self.reads_pixels:
            light = torch.empty(1).expand(len(places), *scenes[0].light.shape)
        return describe_captures(
            scenes,
            [self.grid[state] for state in self.episodes.state[places].tolist()],
            self.tables.camera,
            speed=self.episodes.speed[places],
            defocus=self.episodes.defocus[places],
            gain=gains,
            row_gain=rows,
            light=light,
        )

    def _score(self, places: np.ndarray) -> None:
        """Works out all scores that have a closed form, in the slots of `places` that lack them."""
        slots, first = np.unique(self.episodes.slot[places], return_index=True)
        missing = ~self._scored[slots]
        slots, first = slots[missing], first[missing]
        for slot, place in zip(slots.tolist(), places[first].tolist(), strict=True):
            episode = self.episodes[place]
            parts = self.tables.closed_parts(
                self.scenes[episode.scene], speed=episode.speed, defocus=episode.defocus
            )
            for column, name in enumerate(self._closed):
                self._scores[slot, :, column] = parts[name]
        if self.scorer.closed_form:
            columns = np.moveaxis(self._scores[slots], -1, 0).copy()
            totals = self.scorer.totals(dict(zip(self._closed, columns, strict=False)))
            self._scores[slots, :, -1] = totals
        self._scored[slots] = True
