"""Must an agent know the camera that it works on? Regression agents that leave one body out.

`python examples/leave_one_body_out.py` trains on one body, on all of them, and on all but one, for
as many frames each, and judges every agent on the bodies of `TESTED`, in views of real places that
no training has seen. It writes ``docs/results/leave_one_body_out.json`` and the tables of its page,
in 40 minutes of one core, and 20 minutes more to draw the scenes in the colours of each body. A
run that was interrupted goes on with the agents in ``runs/leave_one_body_out``.
"""

import sys
import time
from collections.abc import Sequence
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from agents.evaluation.engine import evaluate, fit_policies
from agents.evaluation.intervals import difference_interval
from agents.evaluation.metrics import group_means
from agents.learning.policy_file import load_agent, save_agent
from agents.learning.regression import RegressionTraining, train_regression
from agents.learning.training import load_config
from agents.policy import PolicyContext
from agents.policy_names import make_policy
from agents.rollouts import ENV_ID
from benchmarks.harness import Report, Row, sections, table, write_report
from benchmarks.isolated import ROOT
from simulator import list_cameras
from simulator.utils.files import result_meta

RUNS, METER, ALL = ROOT / "runs" / "leave_one_body_out", "average:tuned", "all bodies"
#: Judged are the two bodies that cost most in each other's place (docs/results/bodies.md), and the
#: default one.
BODIES, TESTED, SEEDS = list_cameras(), ("canon_700d", "sony_a7s2", "nikon_z6"), (0, 1, 2)
#: Frames of a training, environments side by side (as many of each body), episodes of each view.
FRAMES, NUM_ENVS, EPISODES = 15_000, 60, 3
SIZE: dict[str, Any] = {"resolution": 64, "scorer": "balanced"}
COLUMNS = """trained on = {agent} | score = {score:.4f} | worst place = {worst:.3f} |
normalised = {normalised:.3f} | minus "this body" = {own:+.4f} ({own_ci95:+.4f}) |
in the worst place = {own_worst:+.3f} | minus "all bodies" = {all:+.4f} ({all_ci95:+.4f}) |
CPU minutes = {minutes:.1f}"""


class SideBySide(gym.vector.VectorEnv):
    """Vector environments of several bodies as one; all else is as the first of them has it."""

    def __init__(self, parts: Sequence[Any]) -> None:
        self.parts, self.num_envs = parts, sum(part.num_envs for part in parts)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.parts[0].unwrapped, name)

    def reset(self, *, seed: int = 0, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode in every environment."""
        return _joined([p.reset(seed=seed + 100 * i)[0] for i, p in enumerate(self.parts)]), {}

    def step(self, actions: Any) -> tuple[Any, ...]:
        """Takes a frame in every environment; without info."""
        own = np.split(actions, len(self.parts))
        found = [part.step(some)[:4] for part, some in zip(self.parts, own, strict=True)]
        seen, *others = zip(*found, strict=True)
        return _joined(seen), *map(np.concatenate, others), {}

    def expected_scores(self) -> Any:
        """(N, S), see `AutoExposureVectorEnv`."""
        return np.concatenate([part.unwrapped.expected_scores() for part in self.parts])

    def right_ev100(self) -> Any:
        """(N,), see `AutoExposureVectorEnv`."""
        return np.concatenate([part.unwrapped.right_ev100() for part in self.parts])


def _joined(seen: Sequence[Any]) -> dict[str, Any]:
    return {name: np.concatenate([one[name] for one in seen]) for name in seen[0]}


def train(name: str, bodies: Sequence[str], seed: int) -> None:
    """Trains an agent as ``configs/regression.yaml`` says, on fewer frames, unless it is there."""
    out = RUNS / f"{name}-{seed}"
    if out.with_suffix(".json").is_file():
        return
    known = load_config(ROOT / "configs" / "regression.yaml").training
    training = RegressionTraining(**known | {"frames": FRAMES, "seed": seed})
    options = {**SIZE, "scenes": "mixed", "split": "train", "autoreset_mode": "SAME_STEP"}
    options |= {"num_envs": NUM_ENVS // len(bodies)}
    envs = SideBySide([gym.make_vec(ENV_ID, camera=body, **options) for body in bodies])
    begun = time.process_time()
    network = train_regression(envs, training)
    facts = {"bodies": list(bodies), "minutes": (time.process_time() - begun) / 60.0}
    facts |= {"training": training.model_dump()}
    save_agent(out, "regression", network, network.width, PolicyContext.from_envs(envs), facts)
    print(out.name, facts["minutes"], flush=True)


def judge(body: str) -> list[Row]:
    """A row for the oracle, each agent and the tuned meter, on a body."""
    own = {**SIZE, "scenes": "polyhaven", "camera": body}
    context = PolicyContext.from_envs(gym.make_vec(ENV_ID, split="test", **own))
    policies, minutes = dict[str, Any](), dict[str, float]()
    for name in (body, ALL, f"all but {body}", *(other for other in TESTED if other != body)):
        files = [RUNS / f"{name}-{seed}" for seed in SEEDS]
        policies[name] = [make_policy(f"regression:{file}", context) for file in files]
        cards = [load_agent(file, "regression")[1] for file in files]
        minutes[name] = sum(card["training"]["minutes"] for card in cards) / len(cards)
    policies[METER], begun = make_policy(METER, context), time.process_time()
    fit_policies({METER: policies[METER]}, own)
    minutes[METER] = (time.process_time() - begun) / 60.0
    found = evaluate(policies, {**own, "split": "test"}, episodes_per_scene=EPISODES)
    span, chance = found.group_gains(METER)[1], group_means(found.random, found.groups)
    gains = {"oracle": span[None]} | {name: found.group_gains(name)[0] for name in policies}
    rows = list[Row]()
    for name, gain in gains.items():
        score = gain + chance  # of each training seed in each place
        row: Row = {"body": body, "agent": "this body" if name == body else name}
        row |= {"minutes": minutes.get(name), "places": len(span)}
        row |= {"score": score.mean(), "worst": score.mean(axis=0).min()}
        row |= {"by_seed": score.mean(axis=1), "normalised": gain.mean(axis=0).sum() / span.sum()}
        for key, other in (("own", body), ("all", ALL)):
            if name not in (other, "oracle"):
                less = difference_interval(gain, gains[other], np.ones_like(span))
                row |= {key: less.value, f"{key}_ci95": less.pair}
                row[f"{key}_worst"] = (gain.mean(axis=0) - gains[other].mean(axis=0)).min()
        rows.append(row)
    return rows


def main() -> None:
    """Trains what is missing, judges, and writes what was found."""
    torch.set_num_threads(1)
    meta = result_meta("python examples/leave_one_body_out.py", 0)
    meta |= {"frames": FRAMES, "training_seeds": SEEDS, "episodes": EPISODES}
    trained: dict[str, Sequence[str]] = {ALL: BODIES}
    for body in TESTED:
        others = [other for other in BODIES if other != body]
        trained |= {body: [body], f"all but {body}": others}
    for (name, bodies), seed in product(trained.items(), SEEDS):
        train(name, bodies, seed)
    rows = [row for body in TESTED for row in judge(body)]
    tables = {"agents": sections(rows, "{body}", lambda own: table(own, COLUMNS))}
    write_report(Report(rows, tables), ROOT / "docs" / "results", "leave_one_body_out", meta)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        sys.exit(__doc__)
    main()
