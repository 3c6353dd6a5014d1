"""Episodes of policies in one scene, recorded for the page."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from typing import Any

import gymnasium as gym

import ae_env  # noqa: F401  (registers the environments)
from ae_env.lighting.moving import KIND_SETS, MOVES
from ae_env.scenes import Scene
from agents.evaluation.running import fit_policies
from agents.policy import Policy, PolicyContext
from agents.policy_names import make_policy
from agents.report.film import Recording, record

#: Kinds of moving light, and light that stays.
STILL = "still"
LIGHTS = (STILL, *MOVES, *KIND_SETS)
#: Frames after which a policy has settled in still light.
SETTLED = 8


def play(
    names: Sequence[str], scene: Scene, *, light: str = STILL, frames: int = 64, seed: int = 0
) -> list[Recording]:
    """One episode of each policy in `scene`, all in the same light.

    Args:
        names: Of the policies, as `make_policy` takes them.
        scene: At most 64 pixels a side.
        light: One of `LIGHTS`; `AutoExposure-v0` where it stays, else `AutoExposureVideo-v0`.
        frames: Actions.
        seed: Decides the light and the start.

    Raises:
        ValueError: If there is no such policy, or it cannot drive this camera.
    """
    task: dict[str, Any] = {"id": "ae_env/AutoExposure-v0"}
    fitted_on: dict[str, Any] = {"scenes": "bundled"}
    if light != STILL:
        moving = {"kind": "moving", "kinds": light}
        task = {"id": "ae_env/AutoExposureVideo-v0", "lighting": moving}
        fitted_on["grid"] = "video"
    envs = gym.make_vec(
        **task,
        num_envs=1,
        scenes=[scene],
        camera=scene.camera,
        resolution=scene.light.shape[-1],
        max_episode_steps=frames + 1,
        render_mode="rgb_array",
        with_oracle=True,
    )
    with closing(envs):
        context = PolicyContext.from_envs(envs)
        policies: dict[str, Policy] = {name: make_policy(name, context) for name in names}
        fit_policies(policies, fitted_on)
        return [record(name, policy, envs, frames, seed) for name, policy in policies.items()]


def settled(names: Sequence[str], scene: Scene) -> dict[str, int]:
    """State of the default grid that each policy holds after `SETTLED` frames of still light."""
    return {r.name: r.states[-1] for r in play(names, scene, frames=SETTLED)}
