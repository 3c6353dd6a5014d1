r"""Searches the ten parameters of `parametric_meter.py` on training scenes; CPU only.

    pip install cma bayesian-optimization
    python examples/tune_meter.py --search cma --evaluations 250 --seeds 5 --out runs/cma.json
    ae-env evaluate --policy \
        "examples/parametric_meter.py:ParametricMeter?parameters=runs/cma.json&run=cma-250-0"

A search maximises the mean normalised score over training scenes, bundled and real ones with the
same weight, each begun dark, right and bright, with settings that take effect at once and two
frames late. Other source groups of the training split say which of the twenty best points is kept.
Every search sees the same episodes: all states of each are photographed once, so an evaluation
reads frames and expected scores from tables, in 0.1 s. No scene of the test split is opened.
"""

import argparse
import json
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from parametric_meter import Parameters, ParametricMeter

from ae_env.observation import decode_observation, frame_statistics
from agents.evaluation.evaluation_plan import start_state
from agents.evaluation.metrics import group_means, random_score
from agents.policy import Floats, PolicyContext
from agents.rollouts import RolloutPlan, action_masks, expected_scores, make_envs, scenes_of

#: Scenes of each set, and of these the share of the source groups that validate.
SCENES, VALIDATION = 150, 1 / 3
STARTS, DELAYS, FRAMES = ("dark", "middle", "bright"), (0, 2), 12
#: Points that a Bayesian search draws before it models.
DRAWN = 25
Score = Callable[[Floats], float]


@dataclass(frozen=True)
class Frames:
    """Every state of some episodes in static light: what a policy sees there, and what it scores.

    `seen` has the statistics (E, S, ...), `sensors` (E, FRAMES, 2), `scores` and `allowed` (E, S),
    `starts` (E, len(STARTS)), `sets` (E,) and `groups` (E,) the set and source group of each scene.
    """

    arrays: dict[str, Any]
    settings: Any  # (S, 3)

    @classmethod
    def photograph(
        cls, name: str, seed: int = 0, batch: int = 50
    ) -> tuple["Frames", PolicyContext]:
        """Takes all states of `SCENES` training scenes of the set `name`, source groups in turn."""
        environment = {"scenes": name, "split": "train", "resolution": 64}
        parts: list[dict[str, Any]] = []
        with closing(make_envs(environment, num_envs=batch, frames=128)) as envs:
            context = PolicyContext.from_envs(envs)
            plan = RolloutPlan.of_each_scene(scenes_of(envs), count=1, seed=seed, most=SCENES)
            for drawn in plan.batches(envs):
                scenes = [plan.scenes[i] for i in plan.scene[drawn.episodes]]
                part = _photograph(envs, context)
                chosen = [[start_state(s, scene, context.grid) for s in STARTS] for scene in scenes]
                part |= {"starts": np.array(chosen), "groups": drawn.groups}
                parts.append({key: value[drawn.valid] for key, value in part.items()})
        joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        settings = joined.pop("settings")[0]
        return cls(joined | {"sets": np.full(len(joined["scores"]), name)}, settings), context

    def part(self, rows: Any) -> "Frames":
        """Those of some episodes."""
        return Frames({key: value[rows] for key, value in self.arrays.items()}, self.settings)

    def score(self, policy: ParametricMeter) -> float:
        """Mean normalised score of a policy over sets, starts and delays."""
        starts, count = self.arrays["starts"], len(self.arrays["scores"])
        episode = np.repeat(np.arange(count), len(STARTS) * len(DELAYS))
        delay = np.tile(np.repeat(DELAYS, len(STARTS)), count)
        state = np.tile(starts, len(DELAYS)).reshape(-1)
        policy.reset(len(episode))
        asked, total = [state] * (1 + max(DELAYS)), np.zeros(len(episode))
        for frame in range(FRAMES):
            seen = {
                key: self.arrays[key][episode, state] for key in ("raw", "histogram", "clipped")
            }
            seen |= {"settings": self.settings[state]}
            seen |= {"sensors": self.arrays["sensors"][episode, frame]}
            asked.append(policy.act(seen, self.arrays["allowed"][episode]))
            state = np.where(delay > 0, asked[-1 - max(DELAYS)], asked[-1])
            total += self.arrays["scores"][episode, state] / FRAMES
        return self._normalised(total.reshape(count, -1).mean(axis=1))

    def _normalised(self, scores: Floats) -> float:
        """Normalised as an evaluation does, source groups with one weight; mean over the sets."""
        table, allowed = self.arrays["scores"], self.arrays["allowed"]
        chance, best = random_score(table, allowed), np.where(allowed, table, -np.inf).max(axis=1)
        found = []
        for name in np.unique(self.arrays["sets"]):
            rows = self.arrays["sets"] == name
            values = np.stack([scores - chance, best - chance])[:, rows]
            ours, most = group_means(values, self.arrays["groups"][rows]).mean(axis=1)
            found.append(ours / most)
        return float(np.mean(found))


def _photograph(envs: Any, context: PolicyContext) -> dict[str, Any]:
    """All states of the episodes that `envs` were reset to; where one is masked, the one before."""
    allowed, states = action_masks(envs), len(context.grid)
    table, frames, sensors = expected_scores(envs), [], []
    state = allowed.argmax(axis=1)
    for wanted in range(states):
        state = np.where(allowed[:, wanted], wanted, state)
        seen = envs.step(state)[0]
        statistics = frame_statistics(seen["raw"])
        statistics["raw"] = decode_observation(statistics["raw"])  # once, not in every evaluation
        frames.append(statistics | {"settings": np.array(seen["settings"])})
        sensors.append(np.array(seen["sensors"]))
    part = {key: np.stack([frame[key] for frame in frames], axis=1) for key in frames[0]}
    return part | {"sensors": np.stack(sensors[:FRAMES], 1), "scores": table, "allowed": allowed}


def load_frames(seed: int = 0) -> tuple[Frames, Frames, PolicyContext]:
    """Frames to search on, those to validate on, and the camera; no source group is in both."""
    sets = [Frames.photograph(name, seed) for name in ("bundled", "polyhaven")]
    (first, context), (second, _) = sets
    joined = {key: np.concatenate([first.arrays[key], second.arrays[key]]) for key in first.arrays}
    frames = Frames(joined, first.settings)
    held = np.zeros(len(joined["groups"]), np.bool_)
    rng = np.random.default_rng(seed)
    for name in np.unique(joined["sets"]):
        groups = rng.permutation(np.unique(joined["groups"][joined["sets"] == name]))
        held |= np.isin(joined["groups"], groups[: round(VALIDATION * len(groups))])
    return frames.part(~held), frames.part(held), context


# -- the searches: points of the unit cube, each told its score before the next is asked for -------


def cma_points(score: Score, seed: int) -> Iterator[Floats]:
    """CMA-ES from the defaults, step 0.2 of each range; N. Hansen's package `cma`."""
    import cma

    score(Parameters().to_unit())
    yield Parameters().to_unit()
    options = {"seed": seed + 1, "bounds": [0, 1], "verbose": -9, "tolfun": 0, "tolx": 0}
    options |= {"tolstagnation": 10**9, "tolfunhist": 0, "tolflatfitness": 10**9}
    search = cma.CMAEvolutionStrategy(Parameters().to_unit(), 0.2, options)
    while True:
        points = search.ask()
        losses = []
        for point in points:
            losses.append(-score(point))
            yield point
        search.tell(points, losses)


def bayes_points(score: Score, seed: int) -> Iterator[Floats]:
    """A Gaussian process (Matern 5/2) and expected improvement; the package `bayes_opt`."""
    from bayes_opt import BayesianOptimization
    from bayes_opt.acquisition import ExpectedImprovement

    bounds = {f"x{i}": (0.0, 1.0) for i in range(10)}
    rule = ExpectedImprovement(xi=0.0)
    search = BayesianOptimization(None, bounds, rule, random_state=seed, verbose=0)
    search.set_gp_params(alpha=1e-5, n_restarts_optimizer=1)
    first = [Parameters().to_unit(), *np.random.default_rng(seed).random((DRAWN - 1, 10))]
    while True:
        point = first.pop(0) if first else np.array(list(search.suggest().values()))
        search.register(point, score(point))
        yield point


def random_points(score: Score, seed: int) -> Iterator[Floats]:
    """Uniform draws, after the defaults: what a search has to beat."""
    rng, point = np.random.default_rng(seed), Parameters().to_unit()
    while True:
        score(point)
        yield point
        point = rng.random(10)


SEARCHES = {"cma": cma_points, "bayes": bayes_points, "random": random_points}


def run_search(
    name: str, seed: int, evaluations: int, train: Frames, held: Frames, context: PolicyContext
) -> dict[str, Any]:
    """One search: parameters kept, scores on both parts of the training scenes, CPU seconds."""
    begin, curve, bests = time.process_time(), list[float](), list[tuple[float, Floats]]()

    def score(point: Floats) -> float:
        curve.append(train.score(ParametricMeter(context, Parameters.from_unit(point))))
        return curve[-1]

    def validated(point: Floats) -> float:
        return held.score(ParametricMeter(context, Parameters.from_unit(point)))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a Gaussian process that did not converge
        for count, point in enumerate(SEARCHES[name](score, seed), 1):
            bests.append((curve[-1], np.array(point)))
            if count == evaluations:
                break
    # The twenty best points compete on the scenes held out: a maximum of many is optimistic.
    finalists = sorted(bests, key=lambda best: -best[0])[:20]
    kept = max(finalists, key=lambda best: validated(best[1]))
    return {
        "search": name,
        "seed": seed,
        "evaluations": evaluations,
        "validations": len(finalists),
        "cpu_seconds": round(time.process_time() - begin, 1),
        "train_score": round(kept[0], 5),
        "validation_score": round(validated(kept[1]), 5),
        "curve": np.maximum.accumulate(curve)[:: max(1, evaluations // 50)].round(4).tolist(),
        "parameters": asdict(Parameters.from_unit(kept[1])),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the searches of the command line; each is written when it ends, and not run again."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--search", choices=SEARCHES, action="append")
    parser.add_argument("--evaluations", type=int, default=250)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("runs/tuned_meters.json"))
    given = parser.parse_args(arguments)
    train, held, context = load_frames()
    runs = json.loads(given.out.read_text())["runs"] if given.out.exists() else {}
    base = ParametricMeter(context)
    print(f"defaults: train {train.score(base):.4f}, validation {held.score(base):.4f}")
    for search in given.search or SEARCHES:
        for seed in range(given.seeds):
            name = f"{search}-{given.evaluations}-{seed}"
            if name in runs:
                continue
            runs[name] = run_search(search, seed, given.evaluations, train, held, context)
            given.out.parent.mkdir(parents=True, exist_ok=True)
            given.out.write_text(json.dumps({"runs": runs}, indent=1) + "\n")
            shown = {k: v for k, v in runs[name].items() if k not in ("parameters", "curve")}
            print(shown, flush=True)


if __name__ == "__main__":
    main()
