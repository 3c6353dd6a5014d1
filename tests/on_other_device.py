"""What torch does on another device than the CPU, on a stand-in for one.

`tests/ae_env/test_device.py` runs this file in a process of its own.
"""

import numpy as np
import pytest
import torch
from torch.utils._pytree import tree_map

from simulator.augment import ExposureAugmentation
from simulator.camera_simulator import CameraSimulator
from simulator.raw.image import RawImage
from tests import other_device as other
from tests.ae_env.environments import make_envs
from tests.ae_env.scorer_images import Own
from tests.ae_env.test_device import assert_close
from tests.simulator.test_augment import CAMERA, pictures
from tests.simulator.test_camera_simulator import BASE, TARGET, Z6, picture


def likeness(images, captures):
    """A score that needs the images and much of what is known of them."""
    variance = captures.noise_variance(captures.light.clamp(0.0, 1.0))
    apart = (images - captures.light).square() / (variance + 0.01)
    known = captures.blur_px + captures.ratio.log2().abs() + captures.white_balance.sum(dim=1)
    return 1.0 / (1.0 + apart.mean(dim=(1, 2, 3)) + 0.1 * known)


@pytest.mark.parametrize(
    ("arguments", "reads"),
    [
        ({}, 0),
        ({"motion": "none", "depth": "far", "noise": "exact"}, 0),
        ({"reward": "expected", "sensors": True, "observation": "statistics"}, 0),
        ({"reward": "expected", "noise": False, "with_oracle": True}, 0),
        ({"lighting": "flicker", "costs": {"flicker": 1.0, "switch": 0.1}, "lens": "random"}, 0),
        ({"noise": "sensor", "camera": "sony_a7s2", "source": "raw", "with_subject": True}, None),
        ({"scorer": {"balanced": 0.7, "shim": 0.3}, "lighting": "flicker"}, 0),
        ({"scorer": "fidelity", "source": "raw", "lighting": "flicker"}, None),
        ({"scorer": Own(likeness), "lighting": "sine"}, 1),  # for the range of its scores
    ],
)
def test_a_step_neither_mixes_devices_nor_reads_back(arguments, reads) -> None:
    """As on a GPU, of which this machine may have none."""
    with other.OtherDevice() as device:
        loops, torchs = (make_envs(3, device=name, **arguments) for name in (None, other.NAME))
        for envs in (loops, torchs):
            envs.reset(seed=3)
        for actions in np.random.default_rng(0).integers(64, size=(3, 3)):
            device.reads.clear()
            found = torchs.step(actions)
            assert reads is None or device.reads.total() == reads
            found = tree_map(lambda x: x.held, found)  # all of it is there
            assert not any(x.dtype == torch.float64 for x in found[-1].values())
            assert_close(loops.step(actions), found)


def test_torchs_default_device_changes_nothing() -> None:
    with other.OtherDevice():
        plain, moved = make_envs(), make_envs()
        plain.reset(seed=1)
        with torch.device(other.NAME):
            moved.reset(seed=1)
            found = moved.step(np.array([3, 9, 63]))
    np.testing.assert_array_equal(found[1], plain.step(np.array([3, 9, 63]))[1])


def test_another_device_gives_the_pictures_of_the_cpu() -> None:
    given = pictures()
    with other.OtherDevice():
        here, there = (ExposureAugmentation()(x, range(4)) for x in (given, given.to(other.NAME)))
    assert (here - there.held).abs().max() <= 12.92 * 1.618 / min(CAMERA.span) + 1e-4


def test_another_device_gives_the_same_digital_numbers() -> None:
    raw = RawImage(picture(33, 31), BASE, Z6)
    for scene in ({}, {"image_speed": 0.5, "defocus": 2.0}):
        with other.OtherDevice():
            frames = [
                CameraSimulator(device=device).simulate(raw, TARGET, seed=2, **scene).data.cpu()
                for device in ("cpu", other.NAME)
            ]
        off = 14512 * (frames[0].double() - frames[1]).abs()
        assert off.max() < 1.01  # rounding may fall either way
        assert (off > 0.5).double().mean() < 1e-3
