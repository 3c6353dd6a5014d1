# %% [markdown]
# # Judge a light meter of your own
#
# A policy sees what a camera sees: the last frame as raw codes and the settings it was taken at. This
# one, `docs/tutorials/judge_a_meter.py`, exposes for the highlights: it puts the brightest percent of
# green a little below white. Then it is judged beside meters that are built in.

# %%
import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np

import ae_env
from ae_env.observation import decode_observation, decode_settings
from agents import Policy, PolicyContext, fit_policies, make_policy

EPISODES = 60
SCENES = "bundled"


class ForTheHighlights(Policy):
    """Puts the brightest percent of green at 80 % of white, at the lowest ISO that reaches it."""

    def act(self, observations, action_masks=None):
        """Chooses the state nearest to the EV100 at which the highlights are where they belong."""
        green = decode_observation(observations["raw"])[:, 1:3]  # 1.0 is sensor white
        bright = np.quantile(green.reshape(len(green), -1), 0.99, axis=1)
        av, tv, sv = decode_settings(observations["settings"])
        ev100 = av + tv - (sv - 5)  # of the frame that was seen
        stops = np.log2(np.maximum(bright, 1e-4) / 0.8)
        # Clipped highlights do not tell how bright they are: three stops darker, and look again.
        target = ev100 + np.where(bright > 0.97, 3.0, stops)
        cost = np.abs(self.context.grid.ev100[None] - target[:, None]).round(1)  # (N, S)
        if action_masks is not None:
            cost = np.where(action_masks, cost, np.inf)
        return cost.argmin(axis=1)  # ties go to the lower index: the lower ISO


# %% [markdown]
# Every policy gets the same scenes, starts and noise. `fit_policies` lets those that have something to
# learn, such as the program of `matrix:tuned`, learn it on training scenes.

# %%
envs = gym.make_vec(
    "ae_env/AutoExposure-v0",
    num_envs=EPISODES,
    scenes=SCENES,
    split="test",
    with_oracle=True,
    max_episode_steps=9,
)
context = PolicyContext.from_envs(envs)
policies = {name: make_policy(name, context) for name in ("average", "matrix", "matrix:tuned")}
policies["for the highlights"] = ForTheHighlights(context)
fit_policies(policies, {"scenes": SCENES})

regret, chosen = {}, {}
for name, policy in policies.items():
    observations, info = envs.reset(seed=0)
    policy.reset(EPISODES, seed=0)
    columns = []
    for _ in range(8):
        observations, _, _, _, info = envs.step(policy.act(observations))
        columns.append(info["regret"])
    regret[name] = np.stack(columns, axis=1)  # (episode, frame)
    chosen[name] = info["ev100"] - envs.unwrapped.grid.ev100[info["oracle_state"]]
    print(
        f"{name:20} mean regret {regret[name].mean():.3f}, last frame {regret[name][:, -1].mean():.3f}"
    )

# %% [markdown]
# How far each policy's exposure is from the best state's in the last frame, in EV; to the right is darker:

# %%
figure, axes = plt.subplots(figsize=(6, 3), constrained_layout=True)
axes.boxplot(list(chosen.values()), orientation="horizontal", tick_labels=list(chosen))
axes.axvline(0, color="grey", linewidth=0.5)
axes.set(xlabel="EV100 of the policy less that of the best state")
figure.savefig("judge_a_meter.png", dpi=80)

# %% [markdown]
# ![EV error of four meters](judge_a_meter.png)
#
# One kind of light and one seed tell little. The command does the whole protocol: conditions of light and delay,
# confidence intervals over source groups, a ranking, a report with pictures. It wants the class in a file of its own,
# such as `my_meter.py`, because the file is run wherever the policy is:
#
# ```
# ae-env evaluate --policy my_meter.py:ForTheHighlights --policy matrix:tuned
# ```
#
# What its columns mean, and options of the built-in policies: [judge](../judge.md).
