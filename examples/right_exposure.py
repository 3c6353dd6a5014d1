"""What agents lose because no frame shows the right exposure: agents, and the same ones told it.

The right exposure is read by a dome at the subject, from light that is mostly out of the picture.
`python examples/right_exposure.py` runs the agents behind `regression:video?foresight=learnt` in
views of real places twice: as they are, and told the right exposure of the frame in hand. Nothing
else differs: frames, forecast of the light, and networks, which were trained to guess it. It writes
``docs/results/foresight.json`` and the table of its page, in 10 minutes of one core.
"""

import sys
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from ae_env.observation import SETTINGS_RANGES
from agents.evaluation.intervals import difference_interval
from agents.evaluation.metrics import group_means
from agents.learning.regression import RegressionPolicy, observation_tensors
from agents.policy import PolicyContext
from agents.policy_names import training_seeds
from agents.rollouts import ENV_ID
from benchmarks.harness import Report, Row, table, write_report
from benchmarks.isolated import ROOT
from simulator.utils.files import result_meta

AGENT, KINDS, SEED = "regression:video", ("shadows", "clouds", "pans", "still"), 0
#: Training seeds, views of test places, and frames of an episode.
AGENTS, VIEWS, FRAMES = 3, 48, 96
#: Standard deviation of an exposure that is known [EV]: the least that the networks can say.
CERTAIN = float(np.exp(-2.0))
ENVIRONMENT: dict[str, Any] = {"scenes": "polyhaven", "resolution": 64, "grid": "video"}
ENVIRONMENT |= {"delay": {"iso": 1, "exposure_time": 2, "f_number": 2}}
COLUMNS = """light = {kind} | agent = {agent:.3f} |
told the right exposure = {told:.3f} | gain = {gain:+.3f} ({gain_ci95:+.3f}) |
least gain in a place = {least:+.3f} | error of its guess [EV] = {error:.2f} |
in the worst place = {worst_error:.2f}"""


class Told(RegressionPolicy):
    """Its network is told the right exposure of the frame in hand, `right` (N,) [EV100]."""

    right, shown = np.zeros(0), np.zeros((0, 3), np.float32)

    def _predict(self, *inputs: torch.Tensor | None) -> tuple[Any, Any]:
        settings = inputs[1]
        assert settings is not None
        low, high = SETTINGS_RANGES[2]
        # In light that is so many stops brighter, the right exposure is, too (`shift_ev`).
        stops = (self.shown[:, 2] - settings[:, 2].numpy()) * (high - low) / 2.0
        right = torch.from_numpy(self.right + stops).float()
        known = right, torch.full_like(right, CERTAIN)
        self.network.states.right_ev100 = lambda *_: known  # type: ignore[union-attr, assignment]
        return super()._predict(*inputs)


def run(kind: str) -> Row:
    """What the agents of all training seeds score, as they are and told."""
    moving = {"lighting": {"kind": "moving", "kinds": kind}} if kind != "still" else {}
    options: dict[str, Any] = {**ENVIRONMENT, **moving, "split": "test", "num_envs": VIEWS}
    options |= {"autoreset_mode": "DISABLED", "max_episode_steps": FRAMES + 1}
    first: Any = gym.make_vec(ENV_ID, **options)
    base, context = first.unwrapped, PolicyContext.from_envs(first)
    views = [i * len(base.scenes) // VIEWS for i in range(VIEWS)]
    groups = [base.scenes[i].group for i in views]
    files = [w.partition(":")[2] for w in training_seeds(AGENT)[:AGENTS]]
    policies = [p(context, f, foresight="learnt") for p in (RegressionPolicy, Told) for f in files]
    envs: list[Any] = [first, *(gym.make_vec(ENV_ID, **options) for _ in policies[1:])]
    seen = [e.reset(seed=SEED, options={"scene": views})[0] for e in envs]
    for policy in policies:
        policy.reset(len(views))
    scores, errors = np.zeros((len(policies), len(views))), np.zeros((len(files), len(views)))
    best, chance = np.zeros((2, len(views)))
    for _ in range(FRAMES):
        right = base.right_ev100()
        for i, policy in enumerate(policies):
            if isinstance(policy, Told):
                policy.right, policy.shown = right, seen[i]["settings"]
            else:
                with torch.inference_mode():
                    guess = policy.network.predict(*observation_tensors(seen[i]))[2]
                errors[i] += np.square(guess.numpy() - right)
            seen[i] = envs[i].step(policy.act(seen[i]))[0]
        expected = base.expected_scores()  # the light, and so the scores, are those of all
        states = [e.unwrapped.states for e in envs]
        scores += np.stack([expected[np.arange(len(views)), s] for s in states])
        best, chance = best + expected.max(axis=1), chance + expected.mean(axis=1)
    span = group_means(best - chance, groups)
    gains = np.stack([group_means(row - chance, groups) for row in scores])
    agent, told = np.split(gains, 2)
    gain = difference_interval(told, agent, span)
    error = np.sqrt(group_means(errors.mean(axis=0) / FRAMES, groups))
    row: Row = {"kind": kind, "places": len(span), "gain": gain.value}
    row |= {"gain_ci95": gain.pair, "least": ((told - agent).mean(axis=0) / span).min()}
    for name, own in (("agent", agent), ("told", told)):
        row[name] = own.mean(axis=0).sum() / span.sum()
    return row | {"error": np.sqrt(np.square(error).mean()), "worst_error": error.max()}


def main() -> None:
    """Runs every kind of light, and writes what was found."""
    torch.set_num_threads(1)
    meta = result_meta("python examples/right_exposure.py", SEED)
    meta |= {"frames": FRAMES, "views": VIEWS, "training_seeds": AGENTS}
    rows = [run(kind) for kind in KINDS]
    report = Report(rows, {"told": table(rows, COLUMNS)})
    write_report(report, ROOT / "docs" / "results", "foresight", meta)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        sys.exit(__doc__)
    main()
