"""`AutoExposure`: the task in which every frame is scored on its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from ae_env.episodes.state import Episodes
from ae_env.options import COSTS
from ae_env.scenes.scene import Scene
from ae_env.scorers.captures import describe_captures
from ae_env.scorers.composite import CompositeScorer
from ae_env.scorers.protocol import Captures, reads_pixels
from ae_env.scorers.score_table import ScoreTable, ScoreTables
from simulator.capture.batch import FrameSource, FrameStatistics
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import Transitions
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.utils.cache import LruCache

#: From so many new captures on, each is scored alone; below, all states of their lights are.
_MANY = 8
#: Memory for score tables [byte]: some eight thousand of 64 states.
TABLES_BYTES = 2**25
#: Light and exposures behind the frames of scenes (B,) at states (B,): `CaptureBatch.transitions`.
FindTransitions = Callable[[np.ndarray, np.ndarray], Transitions]


class AutoExposure:
    """Scores each frame, takes the costs off, and compares it with the oracle.

    Parts of the score that look at no frame are cached in static light, and so are expectations.

    Args:
        episodes: The episodes, with their scenes and options.
        captures: What records their frames.
        scorer: Rates the frames.
        transitions: Light and exposures behind frames, `CaptureBatch.transitions`, where parts that
            are measured on frames are replaced by their expectation; else None.

    Attributes:
        num_actions: One for each state of the grid.
        outputs: What it reads of a frame: its ``"codes"``, its ``"signals"``.
        in_chunks: Whether a part of the score looks at all pixels of a frame, in torch.
        tables: The scorer, and where expectations of all states are worked out.
    """

    def __init__(
        self,
        episodes: Episodes,
        captures: FrameSource,
        scorer: CompositeScorer,
        transitions: FindTransitions | None,
    ) -> None:
        self._episodes, self._captures, self._transitions = episodes, captures, transitions
        self._options = options = episodes.options
        self._scenes, self.num_actions = episodes.scenes, len(episodes.grid)
        self.tables = tables = ScoreTables(
            episodes.grid,
            episodes.camera,
            scorer,
            noise=bool(options.noise),
            tolerance=options.tolerance,
        )
        self.scorer, self._terms, self._torch_terms = (
            tables.scorer,
            tables.term_scores,
            tables.torch_terms,
        )
        expected = transitions is not None
        # Some expectation has no closed form.
        self._reads_tables = expected and not tables.closed_form
        self._reads_images = not expected and not tables.closed_form
        reads_codes = bool(self._terms.parts) and not expected
        self.outputs: tuple[str, ...] = ("signals",) if self._reads_images else ()
        if reads_codes or "flicker" in options.costs:  # else no code of every sample is made
            self.outputs += ("codes",)
        self.in_chunks = self._reads_images or (
            self._torch_terms is not None
            and any(map(reads_pixels, self._torch_terms.parts.values()))
        )
        # By `Episodes.light_index` and state; and which have been scored.
        count, states = len(episodes.begun), self.num_actions
        lights = len(self._scenes) + count
        self._known = [] if self._torch_terms is None else self._torch_terms.names("light", "blur")
        self._scores = np.zeros((lights, states, len(self._known)))
        self._scored = np.zeros((lights, states), bool)
        self._light_scores: dict[int, dict[str, np.ndarray]] = {}  # by scene
        self._means = np.full((lights, states, 3), np.nan)
        self._tables: LruCache[ScoreTable] = LruCache(max(TABLES_BYTES, 128 * count * states))

    # -- a `Task` -----------------------------------------------------------------------------

    def spaces(self) -> dict[str, gym.Space[Any]]:
        """Nothing is observed beside the frame."""
        return {}

    def initial(self, env_indices: np.ndarray, options: Sequence[Mapping[str, Any]] | None) -> None:
        """Leaves new episodes as they were drawn."""

    def forget(self, lights: np.ndarray) -> None:
        """Makes the scores under these `Episodes.light_index` unknown."""
        self._scored[lights] = False
        self._means[lights] = np.nan

    def allowed(self, env_indices: np.ndarray) -> np.ndarray:
        """(B, S) bool: states that the scenes shown allow; all of them before the first reset."""
        episodes = self._episodes
        scenes, begun = episodes.scene[env_indices], episodes.begun[env_indices, None]
        return episodes.allowed[scenes] | ~begun

    def transition(
        self, env_indices: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Every action takes a frame, and moves nothing else."""
        return np.ones(len(env_indices), bool), env_indices[:0]

    def terminal(self, env_indices: np.ndarray, takes: np.ndarray) -> np.ndarray:
        """(K,) False: no episode ends by itself."""
        return ~takes

    def displaced(self, env_index: int) -> Scene | None:
        """None: no subject moves between frames."""
        return None

    def observation(self, env_indices: np.ndarray) -> dict[str, np.ndarray]:
        """Nothing beside the frame."""
        return {}

    def measure(
        self,
        env_indices: np.ndarray,
        frames: FrameStatistics,
        outputs: Mapping[str, np.ndarray],
        gains: np.ndarray,
        rows: np.ndarray | None,
    ) -> dict[str, np.ndarray]:
        """Scores (B,) by ``score:`` and part, and ``image_mean`` where a cost needs it."""
        columns: dict[str, np.ndarray] = {}
        if not self._reads_tables:
            scores = self._score(env_indices, frames, outputs, gains, rows)
            columns = {f"score:{name}": values for name, values in scores.items()}
        if "flicker" in self._options.costs:
            flat = outputs["codes"].reshape(len(env_indices), -1)
            columns["image_mean"] = flat.sum(axis=1, dtype=np.int64) / (255.0 * flat.shape[1])
        return columns

    def reward(
        self, env_indices: np.ndarray, columns: dict[str, np.ndarray]
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Terms of the reward by name, and the reward (B,): the score minus weighted costs.

        Takes the scores and the image means out of `columns`, and adds the oracle's.
        """
        if self._reads_tables:
            terms = self._from_tables(env_indices)
        else:
            terms = {name: columns.pop(f"score:{name}") for name in self.scorer.parts}
            terms["score"] = self.scorer.totals(terms)
        reward = terms["score"].copy()
        for name, cost in self._costs(env_indices, columns.pop("image_mean", None)).items():
            terms[name] = cost
            reward -= self._options.costs[name] * cost
        if self._options.with_oracle:
            states = self._episodes.state[env_indices]
            tables = [self.score_table(env_index) for env_index in env_indices.tolist()]
            best = np.array([t.mean[t.oracle] for t in tables])
            columns["oracle_state"] = np.array([t.oracle for t in tables])
            columns["regret"] = best - [t.mean[s] for t, s in zip(tables, states, strict=True)]
        return terms, reward

    def columns(self) -> dict[str, np.ndarray]:
        """All that it knows of episodes is worked out again."""
        return {}

    def score_table(self, env_index: int) -> ScoreTable:
        """Expected scores of all states in the current frame of environment `env_index`."""
        episodes, lighting = self._episodes, self._episodes.lighting
        episode = episodes[env_index]
        gain: float | np.ndarray = 1.0
        rows = None
        if lighting.within_frame:
            moment: tuple[float, ...] = (episode.frame, episode.phase)
        else:
            gain = episodes.gain(env_index, 0.0)[0]
            moment = (gain,)
        # All that a table depends on: tables of episodes that were seen before are cached.
        key = (episode.scene, episode.speed, episode.defocus, episode.movement, moment)
        table = self._tables.get(key)
        if table is None:
            if lighting.within_frame:
                gain, rows = episodes.gains_by_state(env_index)
            table = self.tables.table(
                self._scenes[episode.scene],
                gain=gain,
                row_gain=rows,
                prepared=self._captures.prepared_scene(episodes.light_index.item(env_index)),
            )
            self._tables.put(key, table, table.nbytes)
        return table

    # -- the reward ---------------------------------------------------------------------------

    def _from_tables(self, env_indices: np.ndarray) -> dict[str, np.ndarray]:
        """(B,) expected scores by part, and "score", where they take captures to work out."""
        pairs = zip(env_indices.tolist(), self._episodes.state[env_indices].tolist(), strict=True)
        found = [(self.score_table(env_index), state) for env_index, state in pairs]
        rewards = {
            name: np.array([table.parts[name][state] for table, state in found])
            for name in self.scorer.parts
        }
        return rewards | {"score": np.array([table.mean[state] for table, state in found])}

    def _costs(self, env_indices: np.ndarray, means: np.ndarray | None) -> dict[str, np.ndarray]:
        """(B,) each; 0 in the first frame of an episode."""
        costs = self._options.costs
        if not costs:
            return {}
        episodes, grid = self._episodes, self._episodes.grid
        first = episodes.previous[env_indices] < 0
        found = {name: np.zeros(len(env_indices)) for name in COSTS if name in costs}
        if means is not None:
            change = np.abs(means - episodes.image_mean[env_indices])
            found["flicker"] = np.where(first, 0.0, change)
            episodes.image_mean[env_indices] = means
        if "switch" in costs:
            now = grid.controls(episodes.state[env_indices])
            before = grid.controls(np.where(first, 0, episodes.previous[env_indices]))
            found["switch"] = np.where(first, 0.0, (before != now).mean(axis=-1))
        return found

    # -- scores of captures -------------------------------------------------------------------

    def _score(
        self,
        env_indices: np.ndarray,
        frames: FrameStatistics,
        outputs: Mapping[str, np.ndarray],
        gains: np.ndarray,
        rows: np.ndarray | None,
    ) -> dict[str, np.ndarray]:
        """Scores (B,) of the captures of `env_indices` by part; the arguments are `measure`'s."""
        episodes, static = self._episodes, self._episodes.static
        boxes = episodes.box_factor[episodes.scene[env_indices]]
        source_noise = frames.source_noise * np.square(boxes)[:, None, None]
        captures: Captures | None = None
        if self._reads_images or not static or self._terms.reads_captures:
            captures = self._describe(env_indices, gains, rows, source_noise)
        scores = self._known_scores(env_indices, captures, gains, source_noise)
        if self._terms.parts:
            states = episodes.state[env_indices]
            if self._transitions is None:
                means = self._terms.measured(outputs["codes"], states, source_noise)
            else:
                means = self._expected_means(env_indices, boxes, rows)
            scores |= self._terms.score(means, captures)
        if self._reads_images and self._torch_terms is not None and captures is not None:
            shown = torch.from_numpy(outputs["signals"]).clamp(0.0, 1.0)
            found = self._torch_terms.score_parts(shown, captures, ("image",))
            scores |= {name: values.numpy() for name, values in found.items()}
        return scores

    def _known_scores(
        self,
        env_indices: np.ndarray,
        captures: Captures | None,
        gains: np.ndarray,
        source_noise: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """Scores of the parts that look at no frame; in static light, cached."""
        episodes, terms = self._episodes, self._torch_terms
        if terms is None or not self._known:
            return {}
        if not episodes.static and captures is not None:
            found = terms.score_parts(None, captures, ("light", "blur"))
            return {name: values.numpy() for name, values in found.items()}
        lights, states = episodes.light_index[env_indices], episodes.state[env_indices]
        new = np.flatnonzero(~self._scored[lights, states])
        if len(new) >= _MANY:
            described = self._describe(env_indices[new], gains[new], None, source_noise[new])
            found = terms.score_parts(None, described, ("light", "blur"))
            columns = [found[name].numpy() for name in self._known]
            self._scores[lights[new], states[new]] = np.stack(columns, axis=1)
            self._scored[lights[new], states[new]] = True
        else:  # one by one takes longer than all states of a light at once
            for env_index in env_indices[new].tolist():
                self._score_all_states(episodes.light_index.item(env_index), env_index)
        return dict(zip(self._known, self._scores[lights, states].T, strict=True))

    def _score_all_states(self, light: int, env_index: int) -> None:
        scene = self._episodes.scene.item(env_index)
        prepared = self._captures.prepared_scene(light)
        parts = dict(self._scores_of_light(scene, prepared))
        parts |= self.tables.closed_form_terms(self._scenes[scene], prepared, kinds=("blur",))
        self._scores[light] = np.stack([parts[name] for name in self._known], axis=1)
        self._scored[light] = True

    def _scores_of_light(self, scene: int, prepared: PreparedScene) -> dict[str, np.ndarray]:
        """Scores of the parts that depend on the light alone: no episode changes them.

        Blur averages the noise of a source, so only scores of light without noise are cached.
        """
        known = self._light_scores.get(scene)
        if known is None:
            known = self.tables.closed_form_terms(self._scenes[scene], prepared, kinds=("light",))
            if prepared.nlf.is_zero:
                self._light_scores[scene] = known
        return known

    def _expected_means(
        self, env_indices: np.ndarray, boxes: np.ndarray, rows: np.ndarray | None
    ) -> np.ndarray:
        """`TermScores.expected` of the captures; in static light, cached."""
        episodes, transitions = self._episodes, self._transitions
        lights, states = episodes.light_index[env_indices], episodes.state[env_indices]
        missing = np.isnan(self._means[lights, states, 0]) | (not episodes.static)
        if missing.any() and transitions is not None:
            exposed = transitions(lights[missing], states[missing])
            some = None if rows is None else rows[missing]
            found = self._terms.expected(exposed, states[missing], boxes[missing], some)
            self._means[lights[missing], states[missing]] = found
        return self._means[lights, states]

    def _describe(
        self,
        env_indices: np.ndarray,
        gains: np.ndarray,
        rows: np.ndarray | None,
        source_noise: np.ndarray,
    ) -> Captures:
        episodes = self._episodes
        scenes = [self._scenes[scene] for scene in episodes.scene[env_indices].tolist()]
        light = None
        if not self.in_chunks:
            light = torch.empty(1).expand(len(env_indices), *scenes[0].light.shape)
        noises = None
        if source_noise.any():
            noises = [NoiseLevelFunction(tuple(s), tuple(r)) for s, r in source_noise.tolist()]
        return describe_captures(
            scenes,
            [episodes.grid[state] for state in episodes.state[env_indices].tolist()],
            episodes.camera,
            speed=episodes.speed[env_indices],
            defocus=episodes.defocus[env_indices],
            movements=[episodes[index].movement for index in env_indices.tolist()],
            gain=gains,
            row_gain=rows,
            light=light,
            source_noise=noises,
            noisy=self.tables.noise,
        )
