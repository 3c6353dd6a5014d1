"""Where the time of a step goes, and what more cores would bring.

`python examples/profile_step.py [SIZE [ENVIRONMENTS]] [cached]` steps environments (64 by default)
with random actions on one thread, in motion and out of focus, or neither: `cached`. It times the
sections that threads share (`simulator.utils.compute.parallel_ranges`); all else is the
interpreter's, on one thread whatever there are. A step on n threads takes at least the rest and an
n-th of the sections. The fused kernel of `ae-env bench throughput` runs in turns with the steps, as
do steps without any section but plans (their frames are rubbish): what the interpreter takes beyond
theirs, it waits for memory, as its code and data have left the processor's caches meanwhile.

Then steps on one thread and on two take turns. With `cached`, so do steps, the benchmark's torch
scorer on recorded frames (`LiveScore`), and steps with that scorer.
"""

import gc
import sys
import time
from collections import defaultdict

import gymnasium as gym
import numpy as np
import torch

import ae_env  # noqa: F401  (registers the environments)
from benchmarks.throughput.kernel_limit import KernelLimit
from benchmarks.throughput.steps import LiveScore, recorded
from simulator.utils import compute

STEPS, ROUNDS = 40, 9
CALLERS = {
    "_plan_rows": "plans of large batches",
    "_photograph": "blur, frames, sums of codes",
    "blur": "sharpness of each capture",
    "record": "frames, sums of codes",
    "_run": "blur before frames",
}


def timed_sections(spent, left_out):
    """Makes every module's `parallel_ranges` add its seconds to `spent`, by the caller's name.

    While there is something in `left_out`, it does nothing but plans.
    """
    original = compute.parallel_ranges

    def timed(task, count, **options):
        name = sys._getframe(1).f_code.co_name
        if left_out and name != "_plan_rows":
            return
        begun = time.perf_counter()
        try:
            original(task, count, **options)
        finally:
            if name != "_plan_rows" or count >= 2 * options["least"]:  # else one thread has it all
                spent[name] += time.perf_counter() - begun

    for module in list(sys.modules.values()):
        if getattr(module, "parallel_ranges", None) is original:
            module.parallel_ranges = timed


def in_turns(*calls):
    """(rounds, calls) seconds of `STEPS` calls of each, after one that is not timed."""
    rounds = np.empty((ROUNDS, len(calls)))
    for row in rounds:
        for i, call in enumerate(calls):
            call()
            begun = time.perf_counter()
            for _ in range(STEPS):
                call()
            row[i] = time.perf_counter() - begun
    return rounds


def main(size=64, num_envs=64, *, cached=False):
    """Measures and prints a table."""
    torch.set_num_threads(1)
    options = {"scenes": "bundled:small", "resolution": size, "autoreset_mode": "SAME_STEP"}
    options |= {"motion": "none", "depth": "far"} if cached else {}
    envs = gym.make_vec("ae_env/AutoExposure-v0", num_envs=num_envs, **options)
    lights = np.stack([scene.light.numpy() for scene in envs.unwrapped.scenes])
    kernel = KernelLimit(lights, num_envs, noise="bank", seed=0)
    envs.reset(seed=0)
    actions = np.random.default_rng(0).integers(0, 64, (100 + ROUNDS * STEPS, num_envs))
    for chosen in actions[:100]:
        envs.step(chosen)
    rows, spent, left_out = [], defaultdict(float), []
    timed_sections(spent, left_out)
    gc.collect()
    for chosen in np.split(actions[100:], ROUNDS):
        spent.clear()
        begun = time.perf_counter()
        for own in chosen:
            envs.step(own)
        whole = time.perf_counter() - begun
        kernel.step()  # its data are in the processor's cache again
        begun = time.perf_counter()
        for _ in range(STEPS):
            kernel.step()
        rows.append({**spent, "whole": whole, "kernel": time.perf_counter() - begun})
        left_out.append(True)
        begun = time.perf_counter()
        with np.errstate(all="ignore"):
            for own in chosen:
                envs.step(own)
        rows[-1]["empty"] = time.perf_counter() - begun
        left_out.clear()
        envs.reset()
    scale = 1e6 / (STEPS * num_envs)
    names = {name for row in rows for name in row}
    of = {name: scale * np.median([row.get(name, 0.0) for row in rows]) for name in names}
    whole, alone, empty = (of.pop(name) for name in ("whole", "kernel", "empty"))
    rest = whole - sum(of.values())
    print(f"{num_envs} environments, {size} x {size}, microseconds a frame, median of {ROUNDS}")
    for name in sorted(of, key=of.get, reverse=True):
        print(f"{CALLERS.get(name, name):34} {of[name]:7.1f} {of[name] / whole:5.0%}")
    print(f"{'interpreter and NumPy':34} {rest:7.1f} {rest / whole:5.0%}")
    print(f"{'steps without any section':34} {empty:7.1f}")
    print(f"{'the fused kernel alone':34} {alone:7.1f} {whole / alone:5.2f} times less")
    for threads in (1, 2, 8, 16):
        least = rest + (whole - rest) / threads
        print(
            f"{f'step on {threads} threads, at least':34} {least:7.1f} {whole / least:5.2f} times"
        )
    rng = np.random.default_rng(1)

    def step(own=envs, threads=1):
        torch.set_num_threads(threads)
        own.step(rng.integers(0, 64, num_envs))

    one, two = in_turns(step, lambda: step(threads=2)).T
    print(f"{'in turns: step on one thread':34} {scale * np.median(one):7.1f}")
    print(f"{'step on 2 threads':34} {scale * np.median(two):7.1f}", end="")
    print(f" {np.median(one / two):5.2f} times as fast")
    if cached:
        options |= {"scorer": f"{LiveScore.__module__}:{LiveScore.__name__}"}
        scored = gym.make_vec("ae_env/AutoExposure-v0", num_envs=num_envs, **options)
        scored.reset(seed=0)
        images, scorer = recorded(num_envs, resolution=size), LiveScore()
        alone, live, both = in_turns(step, lambda: scorer(images, None), lambda: step(scored)).T
        print(f"{'in turns: step, then torch scorer':34} {scale * np.median(alone + live):7.1f}")
        print(f"{'step with torch scorer':34} {scale * np.median(both):7.1f}", end="")
        print(f" {np.median(both / (alone + live)):5.2f} times as long")


if __name__ == "__main__":
    numbers = [word for word in sys.argv[1:] if word != "cached"]
    known = len(numbers) <= 2 and all(number.isdecimal() for number in numbers)
    given = dict(zip(("size", "num_envs"), map(int, numbers), strict=False)) if known else {}
    if not known or not (
        36 <= given.get("size", 64) <= 256 and 1 <= given.get("num_envs", 64) <= 2**16
    ):
        sys.exit(
            "usage: python examples/profile_step.py [SIZE [ENVIRONMENTS]] [cached]\n"
            "SIZE is 36 to 256, ENVIRONMENTS 1 to 65536"
        )
    main(**given, cached="cached" in sys.argv)
