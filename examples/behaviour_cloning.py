"""Imitates a recorded policy: `python examples/behaviour_cloning.py DATASET`, a minute.

First: ae-env record --policy matrix:tuned --episodes 1000 -o ae_env/matrix-v0
Then: ae-env evaluate --policy examples/behaviour_cloning.py:Imitator --policy matrix:tuned
"""

import sys
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_model, save_model
from torch import nn

from agents import Policy

WEIGHTS = "runs/imitator.safetensors"
SEEN = ("raw", "settings", "sensors")


def features(raw, settings, sensors):
    """(N, 4 * 4 * 4 + 5): the frame in 4 x 4 zones, its settings, and the sensors."""
    zones = nn.functional.adaptive_avg_pool2d(torch.as_tensor(raw).float() / 255, 4)
    return torch.cat([zones.flatten(1), torch.as_tensor(settings), torch.as_tensor(sensors)], dim=1)


def make_network(num_states):
    """The untrained network, a logit for each state."""
    return nn.Sequential(nn.Linear(69, 256), nn.ReLU(), nn.Linear(256, num_states))


def train(dataset_id, weights=WEIGHTS, epochs=60, seed=0):
    """Learns the recorded actions; returns the share of them that it repeats."""
    import minari

    torch.manual_seed(seed)
    dataset = minari.load_dataset(dataset_id)
    episodes = list(dataset.iterate_episodes())
    # The last observation of an episode has no action.
    seen = [np.concatenate([e.observations[name][:-1] for e in episodes]) for name in SEEN]
    actions = torch.from_numpy(np.concatenate([e.actions for e in episodes]))
    inputs = features(*seen)
    network = make_network(int(dataset.action_space.n))
    optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3)
    for _ in range(epochs):
        for rows in torch.randperm(len(actions)).split(256):
            loss = nn.functional.cross_entropy(network(inputs[rows]), actions[rows])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    Path(weights).parent.mkdir(parents=True, exist_ok=True)
    save_model(network, weights)
    return float((network(inputs).argmax(dim=1) == actions).float().mean())


class Imitator(Policy):
    """The state that the recorded policy would most probably choose."""

    def __init__(self, context, weights=WEIGHTS):
        super().__init__(context)
        self.network = make_network(len(context.grid))
        load_model(self.network, weights)

    def act(self, observations, action_masks=None):
        """The most probable state that is allowed."""
        with torch.inference_mode():
            logits = self.network(features(*(observations[name] for name in SEEN))).numpy()
        if action_masks is not None:
            logits = np.where(action_masks, logits, -np.inf)
        return logits.argmax(axis=1)


if __name__ == "__main__":
    print(f"repeats {train(sys.argv[1]):.0%} of the recorded actions; weights in {WEIGHTS}")
