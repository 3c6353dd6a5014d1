"""Episodes in which a few frames of a scene are merged: the core behind `ExposureBracket-v0`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from ae_env.episodes.core import EpisodeCore, Frames
from ae_env.observation import encode_observation, frame_statistics
from ae_env.options import EnvOptions
from ae_env.scenes.scene import Scene
from ae_env.scorers.score_table import ScoreTable, prepare_scene
from ae_env.utils.merging import LOG_FLOOR, WORST_EV, log_error, merge
from simulator.capture.layout import Layout
from simulator.capture.prepared_scene import PreparedScene
from simulator.optics.motion_path import Taps, path_blur_apart
from simulator.radiance.light import WHITE_SIGNAL, mean_anchor
from simulator.settings import exposure_ratio

#: Time from the end of an exposure to the begin of the next [s].
FRAME_GAP = 1.0 / 60.0
#: Names and meaning of the numbers in an observation's ``bracket``.
BRACKET_NUMBERS = ("time_left", "frames_left", "white", "noisy")
#: A merged sample whose standard deviation is a larger share of it counts as noisy.
NOISY = 0.1
#: What is kept of the frames of each episode, n long.
_PROGRESS = (
    *("_numbers", "_gains", "_noise", "_left", "_clock", "_first_middle", "_middle", "_count"),
    *("_fresh", "_quality", "_error", "_unseen", "_white", "_noisy"),
)
_STAY = Taps(np.zeros(4, np.int64), np.zeros(4, np.int64), np.array([1, 0, 0, 0], np.float32))


@dataclass(frozen=True)
class _Truth:
    """What a merged image is compared with: light, floor, and which pixels are known."""

    light: torch.Tensor
    floor: float
    known: torch.Tensor | None


class BracketCore(EpisodeCore):
    """`EpisodeCore` whose frames are kept and merged.

    The frame of the reset is the viewfinder's, metered and not kept. The camera's shake between
    frames is taken out, as bursts are aligned before they are merged; a subject that moves on its
    own is elsewhere in each frame.

    Args:
        options: The environment's arguments; the scorer, costs, lighting and delay are not used.
        num_envs: Number of episodes side by side.
        budget: Time that all frames of an episode may take together [s].
        max_frames: Frames of an episode at most.
        scenes: As of `EpisodeCore`.
    """

    def __init__(
        self,
        options: EnvOptions,
        num_envs: int,
        budget: float,
        max_frames: int,
        scenes: Sequence[Scene] | None = None,
    ) -> None:
        if options.recorded is not None:
            raise ValueError(
                f"`scenes` (={options.scenes!r}) must not be recorded: of a bracket's frames every "
                "state and the light behind them must be known"
            )
        self.shown, self.budget, self.max_frames = options.observation, budget, max_frames
        super().__init__(replace(options, observation="dn"), num_envs, scenes)
        size = (num_envs, max_frames, 4, options.resolution, options.resolution)
        self._numbers = np.zeros(size, np.uint16)
        self._gains = np.zeros((num_envs, max_frames))
        self._noise = np.zeros((num_envs, max_frames, 2, 4))
        self._left = np.full(num_envs, budget)
        self._clock, self._first_middle, self._middle = np.zeros((3, num_envs))
        self._count = np.zeros(num_envs, np.int64)
        self._fresh = np.zeros(num_envs, bool)  # a frame was taken that is not merged yet
        self._quality, self._error = np.zeros((2, num_envs))
        self._unseen, self._white, self._noisy = np.ones((3, num_envs))
        self._truths: dict[int, _Truth] = {}
        self._metered: dict[int, int] = {}
        self._times = np.array([state.exposure_time for state in self.grid])
        black, span = np.array(self.camera.black_level), np.array(self.camera.span)
        self._black, self._span = (
            torch.from_numpy(a.astype(np.float32))[:, None, None] for a in (black, span)
        )

    def _arguments(self) -> dict[str, Any]:
        limits = {"budget": self.budget, "max_frames": self.max_frames}
        shown = replace(self.options, observation=self.shown)
        return super()._arguments() | limits | {"options": shown}

    def _progress(self) -> dict[str, Any]:
        return super()._progress() | {name: getattr(self, name) for name in _PROGRESS}

    def _resume(self, progress: Mapping[str, Any]) -> None:
        super()._resume(progress)
        for name in _PROGRESS:
            getattr(self, name)[:] = progress[name]

    @property
    def stop(self) -> int:
        """The action that ends an episode."""
        return len(self.grid)

    @property
    def num_actions(self) -> int:
        """Number of actions: the states, and to stop."""
        return len(self.grid) + 1

    def observation_space(self) -> gym.spaces.Dict:
        """Space of one episode's observation."""
        numbers, self.options = self.options, replace(self.options, observation=self.shown)
        spaces = dict(super().observation_space().spaces)
        self.options = numbers
        spaces["bracket"] = gym.spaces.Box(0.0, 1.0, (len(BRACKET_NUMBERS),), np.float32)
        return gym.spaces.Dict(spaces)

    def action_masks(self, env_indices: np.ndarray) -> np.ndarray:
        """(B, S + 1) bool: states whose exposure fits into the time left; stopping always may."""
        fits = self._times <= self._left[env_indices, None] + 1e-9
        allowed = super().action_masks(env_indices) & fits
        return np.concatenate([allowed, np.ones((len(env_indices), 1), bool)], axis=1)

    def begin(
        self,
        env_indices: np.ndarray,
        rngs: Sequence[np.random.Generator],
        options: Sequence[Mapping[str, Any]] | None = None,
    ) -> None:
        """Draws new episodes, the viewfinder's frame at the metered state or the one asked for."""
        self._clear(env_indices)
        super().begin(env_indices, rngs, options)
        for row, env_index in enumerate(env_indices.tolist()):
            if options is None or options[row].get("state") is None:
                scene = int(self.episodes.scene[env_index])
                self.episodes.state[env_index] = self._metered_state(scene)

    def _clear(self, env_indices: np.ndarray) -> None:
        self._left[env_indices] = self.budget
        for zeroed in (self._gains, self._clock, self._middle, self._first_middle, self._count):
            zeroed[env_indices] = 0
        for zeroed in (self._fresh, self._quality, self._error):
            zeroed[env_indices] = 0
        for full in (self._unseen, self._white, self._noisy):
            full[env_indices] = 1.0

    def _metered_state(self, scene: int) -> int:
        """The state nearest to what an average meter reads."""
        if scene not in self._metered:
            green = self.scenes[scene].clean_light[1:3].mean(dim=0)
            ev100 = -self.scenes[scene].reference.log2_exposure - math.log2(mean_anchor(green))
            self._metered[scene] = self.grid.nearest(ev100)
        return self._metered[scene]

    # -- step ---------------------------------------------------------------------------------

    def transition(self, env_indices: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Takes a frame in each of `env_indices` (K,), or ends its episode.

        Args:
            env_indices: Whose turn it is.
            actions: (K,) states, or `stop`. A state that does not fit into the time left is not
                photographed and ends the episode.

        Returns:
            (K,) bool, which episodes have ended.
        """
        wrong = (actions < 0) | (actions > self.stop)
        if wrong.any():
            raise ValueError(f"`action` (={actions[wrong][0]}) must be in [0, {self.stop}]")
        self._check_begun(env_indices)
        masks = self.action_masks(env_indices)
        takes = masks[np.arange(len(actions)), actions] & (actions != self.stop)
        taking, times = env_indices[takes], self._times[actions[takes]]
        super().transition(taking, actions[takes])
        self._middle[taking] = self._clock[taking] + 0.5 * times
        first = self._count[taking] == 0
        self._first_middle[taking[first]] = self._middle[taking[first]]
        self._clock[taking] += times + FRAME_GAP
        self._left[taking] = np.maximum(self._left[taking] - times - FRAME_GAP, 0.0)
        self._count[taking] += 1
        self._fresh[taking] = True
        self._forget(taking[self._offsets(taking).any(axis=1)])
        return ~takes | (self._count[env_indices] == self.max_frames)

    def observe(self, env_indices: np.ndarray) -> Frames:
        """Photographs the episodes of `env_indices` (B,); merges the frames that were taken."""
        frames = super().observe(env_indices)
        signals = (torch.from_numpy(frames.raw.astype(np.float32)) - self._black) / self._span
        codes = encode_observation(signals).numpy()
        shown: dict[str, np.ndarray] = {"raw": codes}
        if self.shown == "statistics":
            shown = frame_statistics(codes)
        elif self.shown == "linear":
            shown = {"raw": signals.clamp(-(2.0**-10), 1.0).numpy()}
        elif self.shown == "dn":
            shown = {"raw": frames.raw}
        before = self._quality[env_indices].copy()
        rows = np.flatnonzero(self._fresh[env_indices])
        if len(rows):
            self._keep(env_indices[rows], frames.raw[rows])
        numbers = np.stack(
            [
                self._left[env_indices] / self.budget,
                1.0 - self._count[env_indices] / self.max_frames,
                self._white[env_indices],
                self._noisy[env_indices],
            ],
            axis=1,
        )
        observation = {**frames.observation, **shown, "bracket": numbers.astype(np.float32)}
        gain = self._quality[env_indices] - before
        info = {name: column for name, column in frames.info.items() if name != "rewards"}
        info |= {
            "quality": self._quality[env_indices],
            "log_error": self._error[env_indices],
            "unseen": self._unseen[env_indices],
            "frames": self._count[env_indices],
            "time_left": self._left[env_indices],
            "rewards": {"score": gain},
        }
        return Frames(observation, info, gain.copy(), codes)

    def _keep(self, env_indices: np.ndarray, numbers: np.ndarray) -> None:
        """Keeps the frames `numbers` (B, 4, R, R), and merges each episode's."""
        at = self._count[env_indices] - 1
        self._numbers[env_indices, at] = numbers
        for env_index, k in zip(env_indices.tolist(), at.tolist(), strict=True):
            scene = self.scenes[self.episodes.scene[env_index]]
            state = self.grid[int(self.episodes.state[env_index])]
            self._gains[env_index, k] = exposure_ratio(scene.reference, state)
            if self.options.noise:
                nlf = self.camera.nlf(state.iso).scaled(1.0 / scene.box_factor**2)
                self._noise[env_index, k] = nlf.shot, nlf.read
        self._fresh[env_indices] = False
        light, precision = self.merged(env_indices)
        truths = [self._truth(int(scene)) for scene in self.episodes.scene[env_indices]]
        truth = torch.stack([t.light for t in truths])
        floor = torch.tensor([t.floor for t in truths])
        errors = log_error(light, precision, truth, floor)
        unseen = precision <= 0.0
        noisy = light.clamp(min=0.0) * precision.sqrt() * NOISY < 1.0
        for row, (env_index, t) in enumerate(zip(env_indices.tolist(), truths, strict=True)):
            known = slice(None) if t.known is None else t.known
            error, hidden = errors[row][:, known], unseen[row][:, known]
            self._quality[env_index] = 1.0 - float(error.double().mean()) / WORST_EV
            share = float(hidden.double().mean())
            self._unseen[env_index] = share
            shown = float(error.double().mean()) - share * WORST_EV
            self._error[env_index] = shown / (1.0 - share) if share < 1.0 else WORST_EV
            self._white[env_index] = float(unseen[row].double().mean())
            self._noisy[env_index] = float((noisy[row] & ~unseen[row]).double().mean())

    def merged(self, env_indices: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, 4, R, R) merged light at each scene's reference, and its inverse variance."""
        kept = torch.from_numpy(self._numbers[env_indices].astype(np.float32))
        signals = (kept - self._black) / self._span
        gains, noise = (torch.from_numpy(a[env_indices]) for a in (self._gains, self._noise))
        return merge(signals, gains, noise[:, :, 0], noise[:, :, 1])

    def _truth(self, scene: int) -> _Truth:
        if scene not in self._truths:
            own = self.scenes[scene]
            white = WHITE_SIGNAL * 2.0 ** (own.ev100 + own.reference.log2_exposure)
            marks = own.saturated
            known = None if marks is None or bool(marks.all()) else ~marks
            self._truths[scene] = _Truth(own.clean_light, LOG_FLOOR * white, known)
        return self._truths[scene]

    # -- a subject that moves between frames --------------------------------------------------

    def _offsets(self, env_indices: np.ndarray) -> np.ndarray:
        """(B, 2) int64: rows and columns by which the subject has moved since the first frame."""
        episodes = self.episodes
        apart = self._middle[env_indices] - self._first_middle[env_indices]
        moved = episodes.subject_speed[env_indices] * apart * self.options.resolution
        angle = episodes.subject_direction[env_indices]
        offsets = np.stack([moved * np.sin(angle), moved * np.cos(angle)], axis=1)
        size = self.options.resolution
        return np.rint(np.clip(offsets, -size, size)).astype(np.int64)

    def _prepared(self, light_index: int) -> PreparedScene:
        env_index = light_index - len(self.scenes)
        if env_index < 0 or not self._offsets(np.array([env_index])).any():
            return super()._prepared(light_index)
        episode = self.episodes[env_index]
        rows, columns = self._offsets(np.array([env_index]))[0].tolist()
        scene = displaced(self.scenes[episode.scene], rows, columns)
        prepared = prepare_scene(scene, self.camera, **episode.moves)
        return replace(prepared, tolerance=self.options.tolerance)

    def score_table(self, env_index: int) -> ScoreTable:
        """Raises: what a frame is worth depends on those before and after it.

        Raises:
            ValueError: Always.
        """
        raise ValueError("a bracket has no score table: the frames are rated together")


def displaced(scene: Scene, rows: int, columns: int) -> Scene:
    """`scene` with its subject `rows` further down and `columns` further right.

    What it uncovers shows the background nearest to it, as in a blur.
    """
    layout = scene.layout
    if layout is None or layout.subject is None:
        return scene
    there = Taps(np.full(4, -rows), np.full(4, -columns), _STAY.weights)
    mask = _shifted(layout.mask, rows, columns)
    behind = layout.behind

    def moved(planes: torch.Tensor) -> torch.Tensor:
        # Nothing of the subject enters from beyond the border, which blurs replicate.
        inside = path_blur_apart(planes, layout.mask, behind, _STAY, there)
        outside = planes.flatten(1)[:, behind.flatten()].reshape(planes.shape)
        return torch.where(mask > 0.0, inside, outside)

    subject = mask[0] > 0.0
    new = Layout(moved(layout.defocus[None])[0].clamp(0.0, 1.0), subject)
    denoised = None if scene.denoised is None else moved(scene.denoised)
    return replace(scene, light=moved(scene.light), denoised=denoised, layout=new)


def _shifted(planes: torch.Tensor, rows: int, columns: int) -> torch.Tensor:
    """`planes` (P, H, W) further down and right, 0 where nothing comes from."""
    out = torch.zeros_like(planes)
    height, width = planes.shape[1:]
    if abs(rows) >= height or abs(columns) >= width:
        return out
    target = (
        slice(max(rows, 0), height + min(rows, 0)),
        slice(max(columns, 0), width + min(columns, 0)),
    )
    source = (
        slice(max(-rows, 0), height - max(rows, 0)),
        slice(max(-columns, 0), width - max(columns, 0)),
    )
    out[:, target[0], target[1]] = planes[:, source[0], source[1]]
    return out
