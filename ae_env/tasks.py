"""The other tasks: `ae_env/AutoExposureVideo-v0`, in which the light moves and settings take effect
frames late, and `ae_env/ExposureBracket-v0`, in which a few frames are merged into one.
"""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Unpack, cast

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode

from ae_env.env import AutoExposureBase, AutoExposureEnv
from ae_env.episodes.core import FrameBatch, Task
from ae_env.episodes.state import Episodes
from ae_env.merging import LOG_FLOOR, WORST_EV, log_error, merge
from ae_env.options import EnvArguments, takes_env_arguments
from ae_env.scenes.scene import Scene
from ae_env.scorers.score_table import ScoreTable
from ae_env.vector_env import AutoExposureVectorEnv
from simulator.capture.blurred_frames import Layout
from simulator.radiance.light import WHITE_SIGNAL, mean_anchor
from simulator.settings import exposure_ratio
from simulator.utils.checks import check_integer, check_number

#: Defaults of the video task that differ from those of `AutoExposureEnv`.
VIDEO: dict[str, Any] = {
    "grid": "video",
    "lighting": "moving",
    "delay": {"iso": 1, "exposure_time": 2, "f_number": 2},
    "costs": {"flicker": 1.0},
}


class AutoExposureVideoEnv(AutoExposureEnv):
    """Keep a film well exposed while the light moves and the sensor answers late.

    ## Description

    An episode is 3.2 seconds of film at 30 frames per second. The light of the scene ramps, swings,
    drifts or jumps, it comes and goes with tunnels, or lamps flicker; in tests shadows and clouds
    pass, or the light is that of a camera that turns in a real place (`ae_env.lighting.moving`).
    As on a real sensor an exposure time reaches the frame two frames after the next, a gain one
    frame after it, and the aperture follows with the exposure time. Whoever exposes for the frame
    that he has just seen is late: the light of the frame that an action exposes must be predicted,
    from a few frames, noisy and clipped. Neither a bandit nor a meter of the frame in hand can.

    The task is partially observable: a frame shows the light of its moment, not how it changes, nor
    which settings are on their way. An agent needs memory, or a stack of frames and its actions.

    Everything else is as in `AutoExposureEnv`, which has the observation and the info.

    ## Action Space

    `Discrete(64)`: index into `ExposureGrid.video()`, whose exposures fit between two frames. All
    three controls may change in every frame; each takes effect after its own delay.

    | control | values | in effect |
    |---|---|---|
    | ISO | 100, 400, 1600, 6400 | 1 frame after the next |
    | exposure time [s] | 1/2000, 1/500, 1/125, 1/30 | 2 frames after the next |
    | f-number | 2.8, 4, 5.6, 8 | 2 frames after the next |

    ## Rewards

    The score of the frame in [0, 1], of which sharpness is a part, minus the visible jump: the
    absolute change of the mean of the companded picture since the frame before (`costs`).

    ## Starting State

    As in `AutoExposureEnv`; the kind of light, its size and its pace are drawn, too.

    ## Episode End

    Truncated after 96 steps.

    ## Arguments

    Those of `AutoExposureEnv`, with other defaults: `grid="video"`, `costs={"flicker": 1.0}`,
    `delay={"iso": 1, "exposure_time": 2, "f_number": 2}`, and `lighting="moving"`, whose kinds are
    those of the split: `"train"` has ramps, sines, tunnels, steps, drifts and lamps, `"test"` has
    shadows, clouds and pans. `{"kind": "moving", "kinds": ["tunnels"]}` chooses.

    ## Version History

    * v0: first version
    """

    __init__ = takes_env_arguments(**VIDEO)(AutoExposureEnv.__init__)


class AutoExposureVideoVectorEnv(AutoExposureVectorEnv):
    """`num_envs` episodes of `AutoExposureVideoEnv`, photographed in batches.

    All arguments, such as `autoreset_mode`, are those of `AutoExposureVectorEnv`.
    """

    __init__ = takes_env_arguments(max_episode_steps=96, **VIDEO)(AutoExposureVectorEnv.__init__)


# -- brackets -------------------------------------------------------------------------------------

#: Time from the end of an exposure to the begin of the next [s].
FRAME_GAP = 1.0 / 60.0
#: Names and meaning of the numbers in an observation's ``bracket``.
BRACKET_NUMBERS = ("time_left", "frames_left", "white", "noisy")
#: A merged sample whose standard deviation is a larger share of it counts as noisy.
NOISY = 0.1
#: What other tasks add to the info; defaults of the bracket task, and arguments it does not have.
SHOWN = ("with_oracle", "with_subject")
BRACKET: dict[str, Any] = {"grid": "bracket", "depth": "far"}
WITHOUT = ("scorer", "costs", "lighting", "delay", "reward", "device", *SHOWN)
#: Time of all frames together [s], and how many there may be.
BUDGET, MAX_FRAMES = 0.3, 3
_MOST_SECONDS, _MOST_FRAMES = 3600.0, 16


class ExposureBracket(Task):
    """Merges the frames of an episode, and rewards what each adds to the quality.

    See `ExposureBracketEnv`, which has the limits. What else a task is given is not used. The
    action `stop`, behind those of the states, ends an episode. A `ValueError` if scenes are recorded.
    """

    outputs = ("numbers",)

    def __init__(self, episodes: Episodes, *unused: object, budget: float, max_frames: int) -> None:
        options, grid, camera = episodes.options, episodes.grid, episodes.camera
        if options.recorded is not None:
            raise ValueError(
                f"`scenes` (={options.scenes!r}) must not be recorded: of a bracket's frames every "
                "state and the light behind them must be known"
            )
        super().__init__(episodes)
        self.budget, self.max_frames = budget, max_frames
        self.stop, self.num_actions = len(grid), len(grid) + 1
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
        # By scene, the light that a merged image is compared with, its floor, and the known pixels.
        self._truths: dict[int, tuple[torch.Tensor, float, torch.Tensor | slice]] = {}
        self._metered: dict[int, int] = {}  # state, by scene
        self._times = np.array([state.exposure_time for state in grid])
        levels = torch.tensor([camera.black_level, camera.span], dtype=torch.float32)
        self._black, self._span = levels[:, :, None, None]

    def columns(self) -> dict[str, np.ndarray]:
        """The frames taken, and what they are worth, n long each."""
        return {n: v for n, v in vars(self).items() if isinstance(v, np.ndarray) and n != "_times"}

    def spaces(self) -> dict[str, gym.Space[Any]]:
        """``bracket`` is observed beside the latest frame."""
        return {"bracket": gym.spaces.Box(0.0, 1.0, (len(BRACKET_NUMBERS),), np.float32)}

    def allowed(self, env_indices: np.ndarray) -> np.ndarray:
        """(B, S + 1) bool: states whose exposure fits into the time left; stopping always may."""
        episodes = self.episodes
        fits = self._times <= self._left[env_indices, None] + 1e-9
        fits &= episodes.allowed[episodes.scene[env_indices]] | ~episodes.begun[env_indices, None]
        return np.concatenate([fits, np.ones((len(env_indices), 1), bool)], axis=1)

    def initial(self, env_indices: np.ndarray, options: Sequence[Mapping[str, Any]] | None) -> None:
        """Shows the viewfinder's frame at the metered state, or at the one asked for."""
        self._left[env_indices] = self.budget
        zeroed = self._gains, self._clock, self._middle, self._first_middle, self._count
        for values in (*zeroed, self._fresh, self._quality, self._error):
            values[env_indices] = 0
        for full in (self._unseen, self._white, self._noisy):
            full[env_indices] = 1.0
        for row, env_index in enumerate(env_indices.tolist()):
            if options is None or options[row].get("state") is None:
                scene = self.episodes.scene.item(env_index)
                if scene not in self._metered:
                    shown = self.episodes.scenes[scene]
                    stops = math.log2(mean_anchor(shown.clean_light[1:3].mean(dim=0)))
                    ev100 = -shown.reference.log2_exposure - stops
                    self._metered[scene] = self.episodes.grid.nearest(ev100)
                self.episodes.state[env_index] = self._metered[scene]

    def transition(
        self, env_indices: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Uses up the time of the frames that are taken.

        A state that does not fit into the time left is not photographed and ends the episode, as
        the last frame does.
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
        moved = taking[self._offsets(taking).any(axis=1)]
        return takes, moved, ~takes | (self._count[env_indices] == self.max_frames)

    def measure(self, frames: FrameBatch) -> dict[str, np.ndarray]:
        """Merges the frames that were taken: what that adds to the quality (B,)."""
        env_indices = frames.env_indices
        before = self._quality[env_indices].copy()
        fresh = np.flatnonzero(self._fresh[env_indices])
        if len(fresh):
            self._add_frames(env_indices[fresh], frames.outputs["numbers"][fresh])
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
            scene = self.episodes.scenes[self.episodes.scene[env_index]]
            state = self.episodes.grid[int(self.episodes.state[env_index])]
            self._gains[env_index, k] = exposure_ratio(scene.reference, state)
            if self.episodes.options.noise:
                own = self.episodes.camera.nlf(state.iso, state.exposure_time)
                nlf = own.scaled(1.0 / scene.box_factor**2)
                self._noise[env_index, k] = nlf.shot, nlf.read
        self._fresh[env_indices] = False
        light, precision = self.merged(env_indices)
        truths = [self._truth(int(scene)) for scene in self.episodes.scene[env_indices]]
        truth, floors, pixels = zip(*truths, strict=True)
        errors = log_error(light, precision, torch.stack(truth), torch.tensor(floors))
        unseen = precision <= 0.0
        noisy = light.clamp(min=0.0) * precision.sqrt() * NOISY < 1.0
        for row, (env_index, known) in enumerate(zip(env_indices.tolist(), pixels, strict=True)):
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

    def _truth(self, scene: int) -> tuple[torch.Tensor, float, torch.Tensor | slice]:
        if scene not in self._truths:
            own = self.episodes.scenes[scene]
            white = WHITE_SIGNAL * 2.0 ** (own.ev100 + own.reference.log2_exposure)
            marks = own.saturated
            known = slice(None) if marks is None or bool(marks.all()) else ~marks
            self._truths[scene] = own.clean_light, LOG_FLOOR * white, known
        return self._truths[scene]

    def _offsets(self, env_indices: np.ndarray) -> np.ndarray:
        """(B, 2) int64: rows and columns by which the subject has moved since the first frame."""
        episodes, size = self.episodes, self.episodes.options.resolution
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
        return move_subject(self.episodes.scenes[self.episodes.scene[env_index]], rows, columns)

    def score_table(self, env_index: int) -> ScoreTable:
        """Raises a `ValueError`: what a frame is worth depends on those before and after it."""
        raise ValueError("a bracket has no score table: the frames are rated together")


def move_subject(scene: Scene, rows: int, columns: int) -> Scene:
    """`scene` with its subject `rows` further down and `columns` further right.

    What it uncovers shows the background nearest to it, as in a blur.
    """
    layout = scene.layout
    if layout is None or layout.subject is None:
        return scene
    most, behind = np.array(layout.subject.shape), layout.behind.flatten()
    rows, columns = np.clip((rows, columns), -most, most).tolist()
    # Nothing of the subject enters from beyond the border.
    subject = torch.nn.functional.pad(layout.subject, (columns, -columns, rows, -rows))

    def moved(planes: torch.Tensor) -> torch.Tensor:
        background = planes.flatten(1)[:, behind].reshape(planes.shape)
        return torch.where(subject, planes.roll((rows, columns), (-2, -1)), background)

    new = Layout(moved(layout.defocus[None])[0].clamp(0.0, 1.0), subject)
    denoised = None if scene.denoised is None else moved(scene.denoised)
    # Codes are no longer where a ladder says.
    return replace(scene, light=moved(scene.light), denoised=denoised, layout=new, ladder=None)


class _Bracket(AutoExposureBase):
    """The limits that both environments of the bracket task add."""

    @property
    def budget(self) -> float:
        """Time that all frames of an episode may take together [s]."""
        return cast(ExposureBracket, self.core.task).budget

    @property
    def max_frames(self) -> int:
        """Frames of an episode at most."""
        return cast(ExposureBracket, self.core.task).max_frames

    def _set_limits(self, budget: float, max_frames: int) -> None:
        budget = check_number("budget", budget, 1e-5, _MOST_SECONDS, more=" seconds")
        max_frames = check_integer("max_frames", max_frames, 1, _MOST_FRAMES)
        self._make_task = functools.partial(ExposureBracket, budget=budget, max_frames=max_frames)


class ExposureBracketEnv(_Bracket, AutoExposureEnv):
    """Choose up to three frames that are merged into one picture of a higher dynamic range.

    ## Description

    A viewfinder shows the scene as an average meter exposes it; that frame is not kept. Then the
    agent takes frames, one at a time, each at a state of its choice, until the time is used up, the
    frames are, or it stops. What was taken is merged, each sample weighted by the inverse of its
    noise, and compared with the light of the scene. A frame tells which lights are still clipped or
    noisy, so that the next can be chosen for these: an action is worth what the others leave.

    Meanwhile the scene moves. The camera's shake blurs a frame, as in `AutoExposureEnv`; between
    frames it is taken out, as bursts are aligned. A subject that moves on its own is elsewhere in
    each frame: the merged picture shows it where it was in the middle of the first, with ghosts
    where later frames disagree.

    ## Action Space

    `Discrete(25)`: index into `ExposureGrid.bracket()`, `iso_index * 6 + time_index`, or 24 to
    stop. A state whose exposure does not fit into the time left is not photographed and ends the
    episode; `action_masks()` tells which fit. Between two exposures 1/60 s passes.

    | control | values |
    |---|---|
    | ISO | 100, 400, 1600, 6400 |
    | exposure time [s] | 1/4000, 1/1000, 1/250, 1/60, 1/15, 1/4 |
    | f-number | 4 |

    ## Observation Space

    That of `AutoExposureEnv`, of the latest frame, and

    | key | space | meaning |
    |---|---|---|
    | `bracket` | `Box(0, 1, (4,), float32)` | shares: of the time left, of the frames left, of the samples that are white in every frame kept, of those whose noise after merging is above 10 % of their light |

    The task is partially observable: frames before the latest are not shown again.

    ## Rewards

    What a frame adds to the quality of the merged picture, so that their sum is that quality:
    `1 - mean(error) / 2 EV`, where a sample's error is `|log2((merged + f) / (light + f))|`, f the
    light of a white surface times 2^-10, and 2 EV at most; a sample that is white (above 0.97) in
    every frame has 2 EV. Before the first frame the quality is 0.

    ## Info

    The keys of `AutoExposureEnv` without the oracle's, and

    | key | meaning |
    |---|---|
    | `quality` | of the merged picture |
    | `log_error` | mean error of the samples that a frame shows [EV] |
    | `unseen` | share of the samples that are white in every frame |
    | `frames` | frames kept |
    | `time_left` | time left [s] |

    `rewards.score` is the reward.

    ## Starting State

    A scene and its motion are drawn as in `AutoExposureEnv`; nothing is out of focus
    (`depth="far"`). The viewfinder's state is the one nearest to what an average meter reads;
    `reset(options={"state": index})` gives another.

    ## Episode End

    Terminated when the agent stops, its choice takes more than the time left, or no frame is left.

    ## Arguments

    Those of `AutoExposureEnv`, with `grid="bracket"` and `depth="far"`, without `scorer`, `costs`,
    `lighting`, `delay`, `reward` and `with_oracle`, and

    * `budget`: time that all frames of an episode may take together [s].
    * `max_frames`: frames of an episode at most.

    ## References

    Merging by the inverse of the noise: Hasinoff et al., "Noise-optimal capture for high dynamic
    range photography", CVPR 2010; Granados et al., "Optimal HDR reconstruction with linear digital
    cameras", CVPR 2010.

    ## Version History

    * v0: first version
    """

    @takes_env_arguments(WITHOUT, **BRACKET)
    def __init__(
        self,
        *,
        budget: float = BUDGET,
        max_frames: int = MAX_FRAMES,
        render_mode: str | None = None,
        **arguments: Unpack[EnvArguments],
    ) -> None:
        self._set_limits(budget, max_frames)
        super().__init__(render_mode=render_mode, **arguments)


class ExposureBracketVectorEnv(_Bracket, AutoExposureVectorEnv):
    """`num_envs` episodes of `ExposureBracketEnv`, photographed in batches.

    `budget` and `max_frames`: see `ExposureBracketEnv`; `autoreset_mode`: `AutoExposureVectorEnv`.
    """

    @takes_env_arguments(WITHOUT, **BRACKET)
    def __init__(
        self,
        num_envs: int = 1,
        *,
        budget: float = BUDGET,
        max_frames: int = MAX_FRAMES,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **arguments: Unpack[EnvArguments],
    ) -> None:
        self._set_limits(budget, max_frames)
        super().__init__(
            num_envs,
            autoreset_mode=autoreset_mode,
            max_episode_steps=max_episode_steps,
            render_mode=render_mode,
            **arguments,
        )
