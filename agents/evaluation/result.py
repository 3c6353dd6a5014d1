"""Everything that an evaluation measured in one condition, per episode and frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from agents.evaluation import metrics
from simulator.optics.motion_path import Movement

if TYPE_CHECKING:
    from ae_env.grid import ExposureGrid
    from ae_env.scenes import Scene
    from agents.evaluation.evaluation_plan import EvaluationPlan

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

CONDITIONS = ("all", "hard", "rest")


@dataclass(frozen=True)
class Track:
    """The states that one policy chose, and the frames that they gave.

    Leading axis K: training seeds (1 where there is nothing to train).

    Args:
        states: States of the frames after each action, ``(K, E, T)``; with a delay those that
            were chosen earlier.
        image_mean: Mean linear signal of each frame after an action, ``(K, E, T)``.
        code_mean: Mean of the companded frame, in [0, 1], ``(K, E, T)``.
        clipped_high: Share of saturated pixels, ``(K, E, T)``.
        clipped_low: Share of black pixels, ``(K, E, T)``.
        ms_per_decision: Time in `act` per camera and frame [ms], in batches.
        captures_per_decision: Frames taken for one decision.
        privileged: Whether the policy was told the best states.
        ms_alone: Time in `act` for one camera alone [ms]; None where it was not measured.
    """

    states: Ints
    image_mean: Floats
    code_mean: Floats
    clipped_high: Floats
    clipped_low: Floats
    ms_per_decision: float
    captures_per_decision: float
    privileged: bool
    ms_alone: float | None = None

    @classmethod
    def of_seeds(cls, tracks: Sequence[Track]) -> Track:
        """The tracks of several training seeds as one."""
        alone = [track.ms_alone for track in tracks if track.ms_alone is not None]
        return cls(
            states=np.concatenate([t.states for t in tracks]),
            image_mean=np.concatenate([t.image_mean for t in tracks]),
            code_mean=np.concatenate([t.code_mean for t in tracks]),
            clipped_high=np.concatenate([t.clipped_high for t in tracks]),
            clipped_low=np.concatenate([t.clipped_low for t in tracks]),
            ms_per_decision=float(np.mean([t.ms_per_decision for t in tracks])),
            captures_per_decision=tracks[0].captures_per_decision,
            privileged=tracks[0].privileged,
            ms_alone=float(np.mean(alone)) if alone else None,
        )


@dataclass(frozen=True)
class EvaluationResult:
    """Everything measured in one condition; `E` episodes, `T` frames, `S` states.

    Args:
        grid: The exposure states.
        scene_ids: Scene of each episode, ``(E,)``.
        groups: Source group of each episode.
        kinds: Kind of scene of each episode.
        hard: Whether the episode's scene is in the hard part.
        start_states: State of the reset frame.
        scores: q of every state, ``(E, T, S)``.
        allowed: Action masks of every frame, ``(E, T, S)``.
        tracks: By policy.
        seed: The plan's first seed.
        delays: Frames between a decision and the frame that has its ISO, its exposure time and
            its aperture.
        plan: The plan that the condition belongs to; None where a result was put together by hand,
            as everything below.
        scenes: Scene of each episode.
        speed: Image speed of each episode [frame heights per second], ``(E,)``.
        defocus: Blur diameter of each episode at f/4 [pixel of a 64-pixel frame], ``(E,)``.
        movement: Fields of each episode's `simulator.optics.motion_path.Movement`, ``(E, 4)``.
        other_scores: Mean score of the states that each policy chose under scorers that nothing was
            trained on: by scorer, then by policy.
    """

    grid: ExposureGrid
    scene_ids: NDArray[Any]
    groups: NDArray[Any]
    kinds: NDArray[Any]
    hard: NDArray[np.bool_]
    start_states: Ints
    scores: Floats
    allowed: NDArray[np.bool_]
    tracks: dict[str, Track]
    seed: int
    delays: tuple[int, int, int] = (0, 0, 0)
    plan: EvaluationPlan | None = None
    scenes: Sequence[Scene] = ()
    speed: Floats | None = None
    defocus: Floats | None = None
    movement: Floats | None = None
    other_scores: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def moves(self, episode: int) -> dict[str, Any]:
        """What blur depends on, as arguments of `ae_env.scorers.score_table.prepare_scene`."""
        known = {"speed": self.speed, "defocus": self.defocus}
        found: dict[str, Any] = {
            n: 0.0 if v is None else float(v[episode]) for n, v in known.items()
        }
        drawn = () if self.movement is None else self.movement[episode].tolist()
        return found | {"movement": Movement(*drawn)}

    @cached_property
    def oracle(self) -> Floats:
        """Mean q of the oracle over the frames, ``(E,)``."""
        mean: Floats = metrics.oracle_score(self.scores, self.allowed).mean(axis=-1)
        return mean

    @cached_property
    def delayed_oracle(self) -> Floats:
        """Mean q of the oracle whose decisions take effect after `delays`, ``(E,)``."""
        best = np.where(self.allowed, self.scores, -np.inf).argmax(axis=-1)
        late = (metrics.delayed_states(best, self.start_states, d) for d in self.delays)
        per_frame = metrics.score_of(self.scores, self.grid.mixed(*late))
        mean: Floats = per_frame.mean(axis=-1)
        return mean

    @cached_property
    def random(self) -> Floats:
        """Exact mean q of a random policy over the frames, ``(E,)``."""
        mean: Floats = metrics.random_score(self.scores, self.allowed).mean(axis=-1)
        return mean

    @cached_property
    def oracle_states(self) -> Ints:
        """The oracle's state in the last frame, ties to the lower index, ``(E,)``."""
        last = np.where(self.allowed[:, -1], self.scores[:, -1], -np.inf)
        best: Ints = last.argmax(axis=-1).astype(np.int64)
        return best

    def episode_metrics(self, policy: str) -> dict[str, NDArray[Any]]:
        """Every metric of `policy` per training seed and episode, ``(K, E)``.

        `ev_error` is per frame, ``(K, E, T)``: its median and percentiles are over frames.
        """
        if policy not in self._metrics:
            self._metrics[policy] = self._measured(policy)
        return self._metrics[policy]

    @cached_property
    def _metrics(self) -> dict[str, dict[str, NDArray[Any]]]:
        """Metrics that were asked for, by policy."""
        return {}

    @cached_property
    def settling(self) -> Ints:
        """Frame from which an episode's convergence counts, ``(E,)``; see `metrics.settling`."""
        return metrics.settling(self.scores)

    def _measured(self, policy: str) -> dict[str, NDArray[Any]]:
        track = self.tracks[policy]
        ev100, allowed = self.grid.ev100, self.allowed
        score = metrics.score_of(self.scores, track.states).mean(axis=-1)
        errors = metrics.ev_error(self.scores, track.states, ev100, allowed)
        frames, converged = metrics.frames_to_converge(errors, since=self.settling)
        start = np.broadcast_to(self.start_states[:, None], (*track.states.shape[:-1], 1))
        evs = ev100[np.concatenate([start, track.states], axis=-1)]
        static = np.all(self.scores[:, 1:] == self.scores[:, :-1], axis=-1)  # (E, T - 1)
        given = metrics.regret_given_ev(self.scores, track.states, ev100, allowed)
        return {
            "score": score,
            "regret": self.oracle - score,
            "regret_delayed": self.delayed_oracle - score,
            "regret_given_ev": given.mean(axis=-1),
            "ev_error": errors,
            "frames_to_converge": frames,
            "converged": converged,
            "frames_to_settle": metrics.frames_to_settle(evs, since=self.settling),
            "overshoot": metrics.overshoot(evs, since=self.settling),
            "ev_within_third": (errors <= metrics.THIRD_EV).mean(axis=-1),
            "reversals": metrics.reversals(evs),
            "flicker": metrics.flicker(track.image_mean, static),
            "jump": metrics.jump(track.code_mean),
            "clipped_high": track.clipped_high.mean(axis=-1),
            "clipped_low": track.clipped_low.mean(axis=-1),
        }

    @property
    def conditions(self) -> tuple[str, ...]:
        """``("all", "hard", "rest")``, or ``("all",)`` where one of the two parts has no scenes."""
        return CONDITIONS if self.hard.any() and not self.hard.all() else CONDITIONS[:1]

    def condition(self, name: str) -> NDArray[np.bool_]:
        """Which episodes belong to ``"all"``, ``"hard"`` or ``"rest"``, ``(E,)``."""
        masks = {"all": np.ones_like(self.hard), "hard": self.hard, "rest": ~self.hard}
        if name not in masks:
            raise ValueError(f"`condition` (={name!r}) must be one of {', '.join(masks)}")
        return masks[name]

    def group_gains(self, policy: str, condition: str = "all") -> tuple[Floats, Floats]:
        """Gains over random and the span to the oracle per source group: ``(K, G)``, ``(G,)``.

        These are the arguments of `agents.evaluation.intervals`.
        """
        members = self.condition(condition)
        gains = (self.episode_metrics(policy)["score"] - self.random)[:, members]
        span = (self.oracle - self.random)[members]
        groups = self.groups[members]
        return metrics.group_means(gains, groups)[0], metrics.group_means(span, groups)[0]
