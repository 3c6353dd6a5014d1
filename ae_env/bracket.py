"""`ae_env/ExposureBracket-v0`: a few frames, merged into one of a higher dynamic range."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any

from ae_env.env import AutoExposureBase, AutoExposureEnv
from ae_env.episodes.bracket_core import BracketCore
from ae_env.episodes.core import EpisodeCore
from ae_env.options import EnvOptions
from ae_env.registration import names_nearest
from ae_env.vector_env import AutoExposureVectorEnv
from simulator.utils.checks import check_integer, check_number

#: Arguments that differ from those of `AutoExposureEnv`, and those that there are not.
DEFAULTS: dict[str, Any] = {"grid": "bracket", "depth": "far"}
WITHOUT = ("scorer", "costs", "lighting", "delay", "reward", "with_oracle")
#: Time of all frames together [s], and how many there may be.
BUDGET, MAX_FRAMES = 0.3, 3
_MOST_SECONDS, _MOST_FRAMES = 3600.0, 16


class _Bracket(AutoExposureBase):
    """The arguments that both environments add."""

    _budget: float
    _max_frames: int

    def _take(self, budget: float, max_frames: int) -> None:
        self._budget = check_number("budget", budget, 1e-5, _MOST_SECONDS, more=" seconds")
        self._max_frames = check_integer("max_frames", max_frames, 1, _MOST_FRAMES)

    def _make_core(self, options: EnvOptions, num_envs: int) -> EpisodeCore:
        return BracketCore(options, num_envs, self._budget, self._max_frames)

    @property
    def budget(self) -> float:
        """Time that all frames of an episode may take together [s]."""
        return self._budget

    @property
    def max_frames(self) -> int:
        """Frames of an episode at most."""
        return self._max_frames


def _with_arguments_of(base: type, **defaults: Any) -> Callable[..., Any]:
    """Decorates a constructor that passes the arguments of `base` on, with this task's defaults."""
    other = DEFAULTS | defaults

    def decorate(init: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(init)
        taken = [p for p in own.parameters.values() if p.kind is not p.VAR_KEYWORD]
        names = {p.name for p in taken}
        for name, given in inspect.signature(base).parameters.items():
            if name not in names and name not in WITHOUT:
                taken.append(given.replace(default=other.get(name, given.default)))

        @functools.wraps(init)
        def made(self: Any, *args: Any, **kwargs: Any) -> None:
            init(self, *args, **{**other, **kwargs})

        made.__signature__ = own.replace(parameters=taken)  # type: ignore[attr-defined]
        return names_nearest(made)

    return decorate


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

    @_with_arguments_of(AutoExposureEnv)
    def __init__(
        self, *, budget: float = BUDGET, max_frames: int = MAX_FRAMES, **options: Any
    ) -> None:
        self._take(budget, max_frames)
        super().__init__(**options)


class ExposureBracketVectorEnv(_Bracket, AutoExposureVectorEnv):
    """`num_envs` episodes of `ExposureBracketEnv`, photographed in batches.

    All other arguments are those of `AutoExposureVectorEnv`, but for those that the task does not
    have.
    """

    @_with_arguments_of(AutoExposureVectorEnv, max_episode_steps=None)
    def __init__(
        self,
        num_envs: int = 1,
        *,
        budget: float = BUDGET,
        max_frames: int = MAX_FRAMES,
        **options: Any,
    ) -> None:
        self._take(budget, max_frames)
        super().__init__(num_envs, **options)
