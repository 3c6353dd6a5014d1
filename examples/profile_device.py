"""How much memory torch moves for a frame on a device, which bounds what any card can do.

`python examples/profile_device.py [SIZE [ENVIRONMENTS]]` steps environments (64 x 64, 256 of them)
with random actions on `device="cpu"`, in motion and out of focus, and neither: cached. It adds up
the bytes that torch's operations read and write, views apart: a GPU moves as many, but for what
stays in its cache from one operation to the next. And it times what the CPU plans on one thread:
columns of the frames, what blurs them, and the taps of their paths, which all threads share.
"""

import sys
import time

import gymnasium as gym
import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import ae_env  # noqa: F401  (registers the environments)
from simulator.capture import batch, device_frames

STEPS = 8  # an episode's
BANDWIDTH = 3.35e12  # of an H100 SXM, as NVIDIA states it [byte/s]
#: Operations that read only those values of their first argument that they return, and those that
#: write only the values that they are given to it.
READ_SOME, WRITE_SOME = ("index", "gather"), ("index_put_", "copy_")


class Traffic(TorchDispatchMode):
    """Counts operations that make new tensors or write to one, and their bytes."""

    bytes = operations = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        out = function(*args, **(kwargs or {}))
        name, result = function.overloadpacket.__name__, list(_tensors(out))
        if function.is_view or name == "empty":
            return out
        read = list(_tensors((args, kwargs or {})))
        written = sum(tensor.nbytes for tensor in result)
        if name in READ_SOME:
            self.bytes += written
        if name in READ_SOME + WRITE_SOME:
            read = read[1:]
        if name in WRITE_SOME:
            written = sum(tensor.nbytes for tensor in read)
        self.bytes += written + sum(tensor.nbytes for tensor in read)
        self.operations += 1
        return out


def _tensors(values):
    if isinstance(values, torch.Tensor):
        yield values
    elif isinstance(values, dict):
        yield from _tensors(list(values.values()))
    elif isinstance(values, list | tuple):
        for value in values:
            yield from _tensors(value)


def timed(function, spent):
    """`function`, which adds the seconds that it takes to `spent`."""

    def call(*args):
        begun = time.perf_counter()
        try:
            return function(*args)
        finally:
            spent.append(time.perf_counter() - begun)

    return call


def main(size=64, num_envs=256):
    """Measures and prints a table."""
    torch.set_num_threads(1)
    planned = []
    for owner, method in (
        (batch.CaptureBatch, "_plan"),
        (device_frames.DeviceFrames, "plan"),
        (device_frames, "tap_columns"),
    ):
        setattr(owner, method, timed(getattr(owner, method), planned))
    for name, more in (("default", {}), ("cached", {"motion": "none", "depth": "far"})):
        options = {"scenes": "bundled:small", "resolution": size, "device": "cpu", **more}
        options |= {"autoreset_mode": "SAME_STEP", "num_envs": num_envs}
        envs = gym.make_vec("ae_env/AutoExposure-v0", **options)
        envs.reset(seed=0)
        actions = np.random.default_rng(0).integers(0, 64, (3 * STEPS, num_envs))
        for chosen in actions[:STEPS]:
            envs.step(chosen)
        planned.clear()
        for chosen in actions[STEPS : 2 * STEPS]:
            envs.step(chosen)
        planning = 1e6 * sum(planned) / (STEPS * num_envs)
        with Traffic() as traffic:
            for chosen in actions[2 * STEPS :]:
                envs.step(chosen)
        moved = traffic.bytes / (STEPS * num_envs)
        print(
            f"{name}: {moved / 1e6:.1f} MB a frame, {traffic.operations / STEPS:,.0f} operations a "
            f"step of {num_envs}; at {BANDWIDTH / 1e12:g} TB/s {BANDWIDTH / moved:,.0f} frames/s; "
            f"planned in {planning:.1f} microseconds a frame"
        )


if __name__ == "__main__":
    if len(sys.argv) > 3 or not all(word.isdecimal() for word in sys.argv[1:]):
        sys.exit("usage: python examples/profile_device.py [SIZE [ENVIRONMENTS]]")
    main(*map(int, sys.argv[1:]))
