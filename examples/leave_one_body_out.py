"""Does an agent need the camera that it will work on? Regression agents leave one body out.

`python examples/leave_one_body_out.py` trains on one body, on all of them, and on all but that one,
for as many frames each, and judges every agent on that body in unseen views of real places
(``polyhaven``, test split). It writes docs/results/leave_one_body_out.json and its page's table.
"""

import os
import time

import gymnasium as gym
import numpy as np
import torch

import ae_env  # noqa: F401  (registers the environments)
from agents.learning.regression import RegressionPolicy, RegressionTraining, train_regression
from agents.policy import PolicyContext
from benchmarks.harness import Report, table, write_report
from benchmarks.isolated import ROOT
from simulator import list_cameras
from simulator.utils.files import result_meta

ENV, BODIES, TESTED = "ae_env/AutoExposure-v0", list_cameras(), ("canon_700d", "nikon_z6")
FRAMES, NUM_ENVS, EPISODE, VIEWS = 24_000, 60, 8, 216
SETTINGS = {"weight_decay": 5e-2, "dropout": 0.5, "seed": 0}
COLUMNS = """body = {body} | trained on = {trained} | CPU minutes = {minutes:.1f} |
score = {score:.4f} | worst place = {worst:.3f} | oracle = {oracle:.4f} | change = {change:+.4f} |
95 % = {low:+.4f} to {high:+.4f}"""


class SideBySide:
    """Vector environments, one of each body, as one; other attributes are those of the first."""

    def __init__(self, parts):
        self.parts, self.num_envs = parts, sum(part.num_envs for part in parts)
        self.unwrapped = self

    def __getattr__(self, name):
        return getattr(self.parts[0].unwrapped, name)

    @staticmethod
    def _joined(seen):
        return {name: np.concatenate([one[name] for one in seen]) for name in seen[0]}

    def reset(self, seed=None):
        """Begins an episode everywhere."""
        found = [part.reset(seed=1000 * i + (seed or 0)) for i, part in enumerate(self.parts)]
        return self._joined([observation for observation, _ in found]), {}

    def step(self, actions):
        """Takes a step everywhere."""
        shares = np.split(actions, len(self.parts))
        found = [part.step(own) for part, own in zip(self.parts, shares, strict=True)]
        ends = [np.concatenate([one[i] for one in found]) for i in (1, 2, 3)]
        return self._joined([one[0] for one in found]), *ends, {}

    def expected_scores(self):
        """(N, S), as of a vector environment."""
        return np.concatenate([part.unwrapped.expected_scores() for part in self.parts])

    def right_ev100(self):
        """(N,), as of a vector environment."""
        return np.concatenate([part.unwrapped.right_ev100() for part in self.parts])


def make(camera, count, **options):
    """Environments with one body."""
    return gym.make_vec(ENV, num_envs=count, camera=camera, resolution=64, **options)


def trained(bodies):
    """An agent that has seen these bodies, and the CPU seconds that it took."""
    options = {"scenes": "mixed", "split": "train", "autoreset_mode": "SAME_STEP"}
    envs = SideBySide([make(body, NUM_ENVS // len(bodies), **options) for body in bodies])
    begun = time.process_time()
    network = train_regression(envs, RegressionTraining(frames=FRAMES, **SETTINGS))
    return network, time.process_time() - begun


def judged(network, body):
    """(places,) mean expected scores on a body, and those of the best states."""
    options = {"scenes": "polyhaven", "split": "test", "autoreset_mode": "DISABLED"}
    envs = make(body, VIEWS, max_episode_steps=EPISODE + 1, **options)
    policy = RegressionPolicy(PolicyContext.from_envs(envs), network=network)
    seen, _ = envs.reset(seed=0, options={"scene": list(range(VIEWS))})
    policy.reset(VIEWS)
    found = np.zeros((2, VIEWS))
    for _ in range(EPISODE):
        actions, scores = policy.act(seen), envs.unwrapped.expected_scores()
        found += np.stack([scores[np.arange(VIEWS), actions], scores.max(axis=1)]) / EPISODE
        seen, *_ = envs.step(actions)
    groups = [scene.group for scene in envs.unwrapped.scenes]
    places = [np.isin(groups, place) for place in dict.fromkeys(groups)]
    return np.array([found[:, own].mean(axis=1) for own in places]).T


def main():
    """Trains, judges and writes."""
    os.chdir(ROOT)
    torch.set_num_threads(1)
    rows, every, rng = [], trained(BODIES), np.random.default_rng(0)
    for body in TESTED:
        others = [other for other in BODIES if other != body]
        agents = {"that body": trained([body]), "all bodies": every, "the others": trained(others)}
        base = None
        for name, (network, seconds) in agents.items():
            score, oracle = judged(network, body)
            base = score if base is None else base
            means = rng.choice(score - base, (4000, len(score))).mean(axis=1)
            low, high = np.percentile(means, (2.5, 97.5)).tolist()
            row = {"body": body, "trained": name, "minutes": seconds / 60, "worst": score.min()}
            row |= {"score": score.mean(), "oracle": oracle.mean(), "low": low, "high": high}
            row |= {"change": (score - base).mean(), "places": len(score), "frames": FRAMES}
            rows.append({k: v.item() if isinstance(v, np.generic) else v for k, v in row.items()})
            print(rows[-1], flush=True)
    meta = result_meta("python examples/leave_one_body_out.py", 0)
    found = Report(rows, {"agents": table(rows, COLUMNS)})
    write_report(found, ROOT / "docs" / "results", "leave_one_body_out", meta)


if __name__ == "__main__":
    main()
