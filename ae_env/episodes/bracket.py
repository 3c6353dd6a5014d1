"""`ExposureBracket`: the task in which a few frames of a scene are merged."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from ae_env.episodes.state import Episodes
from ae_env.merging import LOG_FLOOR, WORST_EV, log_error, merge
from ae_env.scenes.scene import Scene
from ae_env.scorers.score_table import ScoreTable
from simulator.capture.batch import FrameStatistics
from simulator.capture.prepared_scene import Layout
from simulator.optics.motion import Taps, path_blur_apart
from simulator.radiance.light import WHITE_SIGNAL, mean_anchor
from simulator.settings import exposure_ratio

#: Time from the end of an exposure to the begin of the next [s].
FRAME_GAP = 1.0 / 60.0
#: Names and meaning of the numbers in an observation's ``bracket``.
BRACKET_NUMBERS = ("time_left", "frames_left", "white", "noisy")
#: A merged sample whose standard deviation is a larger share of it counts as noisy.
NOISY = 0.1
_STAY = Taps(np.zeros(4, np.int64), np.zeros(4, np.int64), np.array([1, 0, 0, 0], np.float32))


@dataclass(frozen=True)
class _Truth:
    """Light that a merged image is compared with, its floor, and which pixels are known."""

    light: torch.Tensor
    floor: float
    known: torch.Tensor | None


class ExposureBracket:
    """Merges the frames of an episode, and rewards what each adds to the quality.

    The frame of the reset is the viewfinder's, metered and not merged. The camera's shake between
    frames is taken out, as bursts are aligned before they are merged; a subject that moves on its
    own is elsewhere in each frame. The scorer, costs, lighting and delay of the options are not
    used.

    Args:
        episodes: The episodes, with their scenes and options.
        captures: Not used.
        scorer: Not used.
        transitions: Not used.
        budget: Time that all frames of an episode may take together [s].
        max_frames: Frames of an episode at most.

    Attributes:
        num_actions: The states, and to stop.
        stop: The action that ends an episode.

    Raises:
        ValueError: If the scenes are recorded.
    """

    def __init__(
        self,
        episodes: Episodes,
        captures: object,
        scorer: object,
        transitions: object,
        *,
        budget: float,
        max_frames: int,
    ) -> None:
        options, grid, camera = episodes.options, episodes.grid, episodes.camera
        if options.recorded is not None:
            raise ValueError(
                f"`scenes` (={options.scenes!r}) must not be recorded: of a bracket's frames every "
                "state and the light behind them must be known"
            )
        self.budget, self.max_frames = budget, max_frames
        self.stop, self.num_actions = len(grid), len(grid) + 1
        self.outputs: tuple[str, ...] = ("numbers",)
        self.in_chunks = False
        self._episodes, self._scenes, self._grid, self._camera = (
            episodes,
            episodes.scenes,
            grid,
            camera,
        )
        count = len(episodes.begun)
        size = (count, max_frames, 4, options.resolution, options.resolution)
        self._numbers = np.zeros(size, np.uint16)
        self._gains = np.zeros((count, max_frames))
        self._noise = np.zeros((count, max_frames, 2, 4))
        self._left = np.full(count, budget)
        self._clock, self._first_middle, self._middle = np.zeros((3, count))
        self._count = np.zeros(count, np.int64)
        self._fresh = np.zeros(count, bool)  # a frame was taken that is not merged yet
        self._quality, self._error = np.zeros((2, count))
        self._unseen, self._white, self._noisy = np.ones((3, count))
        self._truths: dict[int, _Truth] = {}
        self._metered: dict[int, int] = {}
        self._times = np.array([state.exposure_time for state in grid])
        black, span = np.array(camera.black_level), np.array(camera.span)
        self._black, self._span = (
            torch.from_numpy(a.astype(np.float32))[:, None, None] for a in (black, span)
        )

    def columns(self) -> dict[str, np.ndarray]:
        """The frames taken, and what they are worth, n long each."""
        mine = {name: value for name, value in vars(self).items() if name != "_times"}
        return {name: value for name, value in mine.items() if isinstance(value, np.ndarray)}

    def spaces(self) -> dict[str, gym.Space[Any]]:
        """``bracket`` is observed beside the latest frame."""
        return {"bracket": gym.spaces.Box(0.0, 1.0, (len(BRACKET_NUMBERS),), np.float32)}

    def allowed(self, env_indices: np.ndarray) -> np.ndarray:
        """(B, S + 1) bool: states whose exposure fits into the time left; stopping always may."""
        episodes = self._episodes
        fits = self._times <= self._left[env_indices, None] + 1e-9
        fits &= episodes.allowed[episodes.scene[env_indices]] | ~episodes.begun[env_indices, None]
        return np.concatenate([fits, np.ones((len(env_indices), 1), bool)], axis=1)

    def initial(self, env_indices: np.ndarray, options: Sequence[Mapping[str, Any]] | None) -> None:
        """Shows the viewfinder's frame at the metered state, or at the one asked for."""
        self._left[env_indices] = self.budget
        for zeroed in (self._gains, self._clock, self._middle, self._first_middle, self._count):
            zeroed[env_indices] = 0
        for zeroed in (self._fresh, self._quality, self._error):
            zeroed[env_indices] = 0
        for full in (self._unseen, self._white, self._noisy):
            full[env_indices] = 1.0
        for row, env_index in enumerate(env_indices.tolist()):
            if options is None or options[row].get("state") is None:
                scene = int(self._episodes.scene[env_index])
                self._episodes.state[env_index] = self._metered_state(scene)

    def forget(self, lights: np.ndarray) -> None:
        """Does nothing: nothing is cached by light."""

    def _metered_state(self, scene: int) -> int:
        """The state nearest to what an average meter reads."""
        if scene not in self._metered:
            green = self._scenes[scene].clean_light[1:3].mean(dim=0)
            ev100 = -self._scenes[scene].reference.log2_exposure - math.log2(mean_anchor(green))
            self._metered[scene] = self._grid.nearest(ev100)
        return self._metered[scene]

    # -- step ---------------------------------------------------------------------------------

    def transition(
        self, env_indices: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Uses up the time of the frames that are taken.

        Args:
            env_indices: Whose turn it is.
            actions: (K,) states, or `stop`. A state that does not fit into the time left is not
                photographed and ends the episode.

        Returns:
            See `Task.transition`.
        """
        takes = self.allowed(env_indices)[np.arange(len(actions)), actions]
        takes &= actions != self.stop
        taking, times = env_indices[takes], self._times[actions[takes]]
        self._middle[taking] = self._clock[taking] + 0.5 * times
        first = self._count[taking] == 0
        self._first_middle[taking[first]] = self._middle[taking[first]]
        self._clock[taking] += times + FRAME_GAP
        self._left[taking] = np.maximum(self._left[taking] - times - FRAME_GAP, 0.0)
        self._count[taking] += 1
        self._fresh[taking] = True
        return takes, taking[self._offsets(taking).any(axis=1)]

    def terminal(self, env_indices: np.ndarray, takes: np.ndarray) -> np.ndarray:
        """(K,) bool: no frame was taken, or the last."""
        return ~takes | (self._count[env_indices] == self.max_frames)

    def measure(
        self,
        env_indices: np.ndarray,
        frames: FrameStatistics,
        outputs: Mapping[str, np.ndarray],
        gains: np.ndarray,
        rows: np.ndarray | None,
    ) -> dict[str, np.ndarray]:
        """Merges the frames that were taken: what that adds to the quality (B,)."""
        before = self._quality[env_indices].copy()
        fresh = np.flatnonzero(self._fresh[env_indices])
        if len(fresh):
            self._add_frames(env_indices[fresh], outputs["numbers"][fresh])
        return {"gain": self._quality[env_indices] - before}

    def reward(
        self, env_indices: np.ndarray, columns: dict[str, np.ndarray]
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """What the frames added to the quality."""
        gain = columns.pop("gain")
        columns |= {
            "quality": self._quality[env_indices],
            "log_error": self._error[env_indices],
            "unseen": self._unseen[env_indices],
            "frames": self._count[env_indices],
            "time_left": self._left[env_indices],
        }
        return {"score": gain}, gain.copy()

    def observation(self, env_indices: np.ndarray) -> dict[str, np.ndarray]:
        """``bracket`` (B, 4): see `BRACKET_NUMBERS`."""
        numbers = [
            self._left[env_indices] / self.budget,
            1.0 - self._count[env_indices] / self.max_frames,
            self._white[env_indices],
            self._noisy[env_indices],
        ]
        return {"bracket": np.stack(numbers, axis=1).astype(np.float32)}

    def _add_frames(self, env_indices: np.ndarray, numbers: np.ndarray) -> None:
        """Adds the frames `numbers` (B, 4, R, R), and merges each episode's."""
        at = self._count[env_indices] - 1
        self._numbers[env_indices, at] = numbers
        for env_index, k in zip(env_indices.tolist(), at.tolist(), strict=True):
            scene = self._scenes[self._episodes.scene[env_index]]
            state = self._grid[int(self._episodes.state[env_index])]
            self._gains[env_index, k] = exposure_ratio(scene.reference, state)
            if self._episodes.options.noise:
                nlf = self._camera.nlf(state.iso).scaled(1.0 / scene.box_factor**2)
                self._noise[env_index, k] = nlf.shot, nlf.read
        self._fresh[env_indices] = False
        light, precision = self.merged(env_indices)
        truths = [self._truth(int(scene)) for scene in self._episodes.scene[env_indices]]
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
            own = self._scenes[scene]
            white = WHITE_SIGNAL * 2.0 ** (own.ev100 + own.reference.log2_exposure)
            marks = own.saturated
            known = None if marks is None or bool(marks.all()) else ~marks
            self._truths[scene] = _Truth(own.clean_light, LOG_FLOOR * white, known)
        return self._truths[scene]

    # -- a subject that moves between frames --------------------------------------------------

    def _offsets(self, env_indices: np.ndarray) -> np.ndarray:
        """(B, 2) int64: rows and columns by which the subject has moved since the first frame."""
        episodes, size = self._episodes, self._episodes.options.resolution
        apart = self._middle[env_indices] - self._first_middle[env_indices]
        moved = episodes.subject_speed[env_indices] * apart * size
        angle = episodes.subject_direction[env_indices]
        offsets = np.stack([moved * np.sin(angle), moved * np.cos(angle)], axis=1)
        return np.rint(np.clip(offsets, -size, size)).astype(np.int64)

    def displaced(self, env_index: int) -> Scene | None:
        """The scene with its subject where it is now; None where it has not moved."""
        rows, columns = self._offsets(np.array([env_index]))[0].tolist()
        if not rows and not columns:
            return None
        return displaced(self._scenes[self._episodes.scene[env_index]], rows, columns)

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
