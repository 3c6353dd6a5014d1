"""`ae_env/AutoExposureVideo-v0`: the light moves, and settings take effect frames late."""

from __future__ import annotations

from typing import Any

from ae_env.env import AutoExposureEnv
from ae_env.registration import TASKS, with_defaults
from ae_env.vector_env import AutoExposureVectorEnv

#: Arguments that differ from those of `AutoExposureEnv`.
DEFAULTS: dict[str, Any] = {
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

    __init__ = with_defaults(AutoExposureEnv.__init__, **DEFAULTS)


class AutoExposureVideoVectorEnv(AutoExposureVectorEnv):
    """`num_envs` episodes of `AutoExposureVideoEnv`, photographed in batches.

    All arguments are those of `AutoExposureVectorEnv`, with the defaults of the task.
    """

    __init__ = with_defaults(
        AutoExposureVectorEnv.__init__,
        max_episode_steps=TASKS["ae_env/AutoExposureVideo-v0"][2],
        **DEFAULTS,
    )
