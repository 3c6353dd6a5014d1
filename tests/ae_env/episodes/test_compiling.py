"""The second process compiles what a default environment needs, and nothing else."""

import json
import os
import subprocess
import sys

_CODE = """
import importlib, json
from ae_env.episodes import compiling
from ae_env.episodes.compiling import KERNELS

def signatures():
    found = {}
    for name in KERNELS:
        module, _, kernel = name.rpartition(".")
        kernel = getattr(importlib.import_module(module), kernel)
        found[name] = sorted(map(str, kernel.signatures))
    return found

compiling._run()
compiled = signatures()
import gymnasium as gym
env = gym.make("ae_env/AutoExposure-v0", scenes="bundled:small")
env.reset(seed=0)
for _ in range(40):
    env.reset()
    env.step(63)
print(json.dumps([compiled, signatures()]))
"""


def test_it_compiles_the_kernels_of_a_default_environment() -> None:
    """With other types of an argument, both processes would compile, and the first wait besides."""
    done = subprocess.run(
        [sys.executable, "-c", _CODE], env=os.environ, capture_output=True, text=True, check=True
    )
    compiled, needed = json.loads(done.stdout.splitlines()[-1])
    assert all(compiled.values())
    assert compiled == needed
