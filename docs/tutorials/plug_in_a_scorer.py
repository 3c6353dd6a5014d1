# %% [markdown]
# # Plug in a scorer, and see what it wants
#
# The reward is the score of the capture, so a scorer decides what an agent learns. This script,
# `docs/tutorials/plug_in_a_scorer.py`, registers one, looks at what it likes in all 64 states of a
# scene, and lets the light change.

# %%
import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np

import ae_env
from ae_env import register_scorer
from ae_env.rendering import contact_sheet
from ae_env.scenes import load_scenes
from simulator import get_camera

# %% [markdown]
# A scorer is a function of a batch: developed pictures (`domain = "srgb"`) or packed raws
# (`domain = "raw"`), rated in [0, 1].


# %%
@register_scorer("number_plate")
class NumberPlate:
    """Share of the middle third that is neither black nor white, and sharp enough to read."""

    domain = "srgb"

    def __call__(self, images, captures):  # (B, 3, H, W) in [0, 1] -> (B,)
        """Scores a batch of pictures."""
        h, w = images.shape[-2:]
        middle = images[..., h // 3 : -h // 3, w // 3 : -w // 3].mean(dim=1)
        readable = ((middle > 0.05) & (middle < 0.95)).float().mean(dim=(1, 2))
        edges = middle.diff(dim=2).abs().mean(dim=(1, 2)) / 0.02
        return readable * edges.clamp(max=1.0)


# %% [markdown]
# The contact sheet shows every state of a scene: ISO by panel, exposure time to the right, f-number down.
# The frame around each capture is its score, the star marks the best one. The image moves here by half a
# frame height a second, so long exposures blur.

# %%
scene = load_scenes("bundled:back_light", "test", camera=get_camera("nikon_z6"))[0]
scorer = {"number_plate": 0.8, "noise": 0.2}
contact_sheet(scene, scorer=scorer, speed=0.5, seed=0).save("plug_in_a_scorer.webp")

# %% [markdown]
# ![all 64 states, framed in the colour of their score](plug_in_a_scorer.webp)
#
# The same scorer in an environment whose light falls by four stops in the third frame. Its terms are
# in the info, as `rewards.` and their name.

# %%
env = gym.make(
    "ae_env/AutoExposure-v0",
    scenes="bundled:back_light",
    scorer=scorer,
    lighting={"kind": "step", "stops": -4, "at": 3},
    with_oracle=True,
)
observation, info = env.reset(seed=0)
for frame in range(5):
    observation, reward, _, _, info = env.step(int(info["oracle_state"]))  # the best one of before
    terms = {name: round(float(info[name]), 2) for name in info if name.startswith("rewards.")}
    print(frame + 1, env.unwrapped.grid[int(info["state"])], terms)

# %% [markdown]
# Can an agent cheat it? `ae-env bench scorers` raises the gain under a scorer and looks whether it is
# pleased by noise: [which scorers an agent can cheat](../results/scorers.md). More on scorers, in files,
# packages and on the command line: [plug in a scorer](../plug-in-a-scorer.md).
