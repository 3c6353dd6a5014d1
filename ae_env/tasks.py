"""The other tasks: `ae_env/AutoExposureVideo-v0`, in which the light moves and settings take effect
frames late, and `ae_env/ExposureBracket-v0`, in which a few frames are merged into one.
"""

from __future__ import annotations

import functools
from typing import Any, Unpack

from gymnasium.vector import AutoresetMode

from ae_env.env import AutoExposureBase, AutoExposureEnv
from ae_env.episodes.bracket import ExposureBracket
from ae_env.options import EnvArguments, takes_env_arguments
from ae_env.registration import TASKS
from ae_env.vector_env import AutoExposureVectorEnv
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

    All arguments are those of `AutoExposureVectorEnv`, with the defaults of the task.
    """

    __init__ = takes_env_arguments(
        max_episode_steps=TASKS["ae_env/AutoExposureVideo-v0"][2], **VIDEO
    )(AutoExposureVectorEnv.__init__)


#: Defaults of the bracket task, and arguments that it does not have.
BRACKET: dict[str, Any] = {"grid": "bracket", "depth": "far"}
WITHOUT = ("scorer", "costs", "lighting", "delay", "reward", "with_oracle")
#: Time of all frames together [s], and how many there may be.
BUDGET, MAX_FRAMES = 0.3, 3
_MOST_SECONDS, _MOST_FRAMES = 3600.0, 16


class _Bracket(AutoExposureBase):
    """The limits that both environments of the bracket task add."""

    def _set_limits(self, budget: float, max_frames: int) -> None:
        self._budget = check_number("budget", budget, 1e-5, _MOST_SECONDS, more=" seconds")
        self._max_frames = check_integer("max_frames", max_frames, 1, _MOST_FRAMES)
        self._make_task = functools.partial(
            ExposureBracket, budget=self._budget, max_frames=self._max_frames
        )

    @property
    def budget(self) -> float:
        """Time that all frames of an episode may take together [s]."""
        return self._budget

    @property
    def max_frames(self) -> int:
        """Frames of an episode at most."""
        return self._max_frames


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

    `rewards` has `score`, the reward.

    ## Starting State

    A scene and its motion are drawn as in `AutoExposureEnv`; nothing is out of focus
    (`depth="far"`). The viewfinder's state is the one nearest to what an average meter reads;
    `reset(options={"state": index})` gives another.

    ## Episode End

    Terminated when the agent stops, chooses what does not fit into the time left, or has taken the
    last frame.

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

    All other arguments are those of `AutoExposureVectorEnv`, but for those that the task does not
    have.
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
