"""Trains d3rlpy's discrete CQL on recorded episodes, in an environment of its own; CPU, minutes.

    ae-env record --policy matrix:tuned --episodes 500 -o ae_env/matrix-v0
    ae-env record --policy random --episodes 500 -o ae_env/random-v0
    python -m venv d3 && d3/bin/pip install d3rlpy h5py safetensors
    d3/bin/python examples/offline_cql.py ~/.minari/datasets/ae_env/{matrix,random}-v0
    ae-env evaluate --policy examples/offline_cql.py:OfflineCQL --policy matrix:tuned

The training reads Minari's HDF5 files and imports nothing of ae-env, so d3rlpy and its requirements
(the old `gym` among them) stay apart; the policy needs NumPy and safetensors only.
"""

import argparse
import time
from pathlib import Path

import numpy as np

try:
    from agents import Policy
except ImportError:  # the environment that trains has no ae-env, and needs no policy
    Policy = object

WEIGHTS = "runs/offline_cql.safetensors"
ZONES = 4


def features(raw, settings, sensors):
    """(N, 4 * 4 * 4 + 5) float32: mean codes of 4 x 4 zones in [0, 1], settings and sensors."""
    count, planes, height, width = raw.shape
    blocks = raw.reshape(count, planes, ZONES, height // ZONES, ZONES, width // ZONES)
    zones = blocks.mean(axis=(3, 5), dtype=np.float32) / 255.0
    return np.concatenate([zones.reshape(count, -1), settings, sensors], 1, dtype=np.float32)


def load_episodes(folders):
    """Features, actions, rewards and ends of all steps of the datasets in `folders`."""
    import h5py

    found = []
    for folder in folders:
        with h5py.File(Path(folder) / "data" / "main_data.hdf5") as file:
            for episode in file.values():
                seen = episode["observations"]
                # The last observation of an episode has no action.
                inputs = features(*(seen[n][:-1] for n in ("raw", "settings", "sensors")))
                ends = np.arange(len(inputs)) == len(inputs) - 1
                found.append((inputs, episode["actions"][:], episode["rewards"][:], ends))
    return [np.concatenate(column) for column in zip(*found, strict=True)]


def train(folders, weights, steps, gamma, alpha, seed):
    """Learns from the recorded steps and writes the network; returns how many there were."""
    import d3rlpy
    from safetensors.numpy import save_file

    d3rlpy.seed(seed)
    inputs, actions, rewards, ends = load_episodes(folders)
    never = np.zeros(len(ends), np.float32)  # episodes are cut off: the light goes on
    dataset = d3rlpy.dataset.MDPDataset(
        inputs, actions[:, None], rewards.astype(np.float32), never, ends.astype(np.float32)
    )
    config = d3rlpy.algos.DiscreteCQLConfig(
        batch_size=256, learning_rate=5e-4, gamma=gamma, alpha=alpha, target_update_interval=1000
    )
    learner = config.create(device=False)
    silent = d3rlpy.logging.NoopAdapterFactory()
    epoch = min(steps, 1000)
    learner.fit(dataset, steps, epoch, logger_adapter=silent, show_progress=False)
    state = learner.impl.q_function[0].state_dict()
    Path(weights).parent.mkdir(parents=True, exist_ok=True)
    save_file({name: tensor.numpy().copy() for name, tensor in state.items()}, weights)
    return len(inputs)


class OfflineCQL(Policy):
    """The state of the highest Q that a training on recorded episodes found."""

    def __init__(self, context, weights=WEIGHTS):
        from safetensors.numpy import load_file

        super().__init__(context)
        found = load_file(weights)
        names = sorted(name.removesuffix(".weight") for name in found if name.endswith("weight"))
        self.layers = [(found[f"{name}.weight"], found[f"{name}.bias"]) for name in names]
        if len(self.layers[-1][1]) != len(context.grid):
            raise ValueError(f"`weights` (={weights!r}) are of another grid")

    def act(self, observations, action_masks=None):
        """The best state that is allowed."""
        q = features(*(observations[name] for name in ("raw", "settings", "sensors")))
        for i, (weight, bias) in enumerate(self.layers):
            q = (q if i == 0 else np.maximum(q, 0.0)) @ weight.T + bias
        if action_masks is not None:
            q = np.where(action_masks, q, -np.inf)
        return q.argmax(axis=1)


def main():
    """Trains with the arguments of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folders", nargs="+", help="folders of Minari datasets")
    parser.add_argument("--weights", default=WEIGHTS)
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--gamma", type=float, default=0.5)
    parser.add_argument("--alpha", type=float, default=0.1, help="how conservative")
    parser.add_argument("--seed", type=int, default=0)
    given, begin = parser.parse_args(), time.process_time()
    count = train(given.folders, given.weights, given.steps, given.gamma, given.alpha, given.seed)
    seconds = time.process_time() - begin
    print(f"{given.steps} updates on {count} steps, {seconds:.0f} s of CPU: {given.weights}")


if __name__ == "__main__":
    main()
