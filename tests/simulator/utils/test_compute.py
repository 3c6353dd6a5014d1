"""Kernels, threads and tiles."""

import logging
import multiprocessing
import threading
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from numba.core import caching
from torch import Tensor

from simulator import camera_simulator
from simulator.networks.aperture_module import DefocusMap
from simulator.networks.noise_module import SIZES, NoiseModule
from simulator.utils import compute as jit
from simulator.utils.compute import kernel, parallel_ranges
from simulator.utils.tiles import in_tiles, varying


def add(a: int, b: int) -> int:
    return a + b


def test_kernels_run_without_the_lock_and_where_they_cannot_be_cached(monkeypatch, caplog):
    assert kernel()(add).targetoptions["nogil"]
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    with caplog.at_level(logging.INFO, "simulator.utils.compute"):
        assert kernel()(add)(1, 2) == 3
    assert "compiled again in each process" in caplog.text


def test_a_kernel_is_stale_when_a_module_changes_that_it_depends_on(tmp_path, monkeypatch):
    """Numba itself would run the kernel that it compiled with a constant's old value."""
    monkeypatch.setattr(jit, "_ROOT", tmp_path)
    texts = {
        "ae_env/kernels.py": "from ae_env.part import (\n    middle,\n)\nimport numpy",
        "ae_env/part/middle.py": "    from simulator.a.constants import FACTOR",
        "simulator/a/constants.py": "FACTOR = 2.0",
        "simulator/a/others.py": "FACTOR = 2.0",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    checksums = [jit._checksum.__wrapped__(tmp_path / "ae_env/kernels.py")]
    for name in reversed(texts):  # first the one that no kernel depends on
        (tmp_path / name).write_text(texts[name] + " # changed")
        checksums.append(jit._checksum.__wrapped__(tmp_path / "ae_env/kernels.py"))
    assert checksums[0] == checksums[1]
    assert len(set(checksums)) == 4
    monkeypatch.undo()
    stamp = kernel()(add)._cache._cache_file._source_stamp
    assert stamp[1] == jit._checksum(Path(__file__))


@pytest.mark.parametrize("threads", [1, 3, 8])
@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_every_item_is_done_once(count, threads):
    done = np.zeros(count, int)

    def add_one(first: int, last: int) -> None:
        done[first:last] += 1

    def task(first: int, last: int) -> None:  # a task may ask for shares itself
        parallel_ranges(lambda a, b: add_one(first + a, first + b), last - first, threads=2)

    parallel_ranges(task, count, threads=threads)
    assert (done == 1).all()


def test_shares_are_contiguous_and_run_at_the_same_time():
    barrier, shares = threading.Barrier(3, timeout=30), []

    def task(first: int, last: int) -> None:
        barrier.wait()  # passes only if all three are under way
        shares.append((first, last))

    parallel_ranges(task, 9, threads=3)
    assert sorted(shares) == [(0, 3), (3, 6), (6, 9)]
    names = []  # little work stays on the caller's thread
    parallel_ranges(lambda *_: names.append(threading.current_thread()), 5, least=3, threads=4)
    assert names == [threading.current_thread()]


@pytest.mark.parametrize("bad", [0, 3])
def test_errors_of_any_share_are_raised_once_all_are_done(bad):
    done: list[int] = []

    def task(first: int, last: int) -> None:
        if first == bad:
            raise ValueError(f"share {first}")
        done.append(first)

    with pytest.raises(ValueError, match=f"share {bad}"):
        parallel_ranges(task, 6, threads=2)
    assert done == [3 - bad]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # forking a process that has threads
def test_child_processes_make_threads_of_their_own():
    parallel_ranges(lambda *_: None, 2, threads=2)  # this process has some already
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    task = partial(parallel_ranges, lambda *share: queue.put(share), 2, threads=2)
    child = context.Process(target=task)
    child.start()
    assert sorted(queue.get(timeout=60) for _ in range(2)) == [(0, 1), (1, 2)]
    child.join(timeout=60)


def frame(*size: int, seed: int = 0) -> Tensor:
    return torch.rand(1, 4, *size, generator=torch.Generator().manual_seed(seed))


def mean_of_neighbours(*images: Tensor) -> Tensor:
    """Sees 2 pixels far, and the position modulo 4."""
    total = F.avg_pool2d(F.pad(sum(images), (2,) * 4), 5, stride=1)
    rows = torch.arange(total.shape[-2])[:, None] % 4
    return total * (1 + rows) + torch.arange(total.shape[-1]) % 4


@pytest.mark.parametrize("size", [(1, 1), (12, 16), (16, 17), (5, 93), (93, 5), (61, 203)])
@pytest.mark.parametrize("tile", [12, 64, 512])
def test_tiles_of_a_function_of_neighbourhood_and_phase(size, tile):
    """Everywhere; and where only some pixels are needed, the fallback elsewhere."""
    image, other = frame(*size), frame(*size, seed=1)
    whole, needed = mean_of_neighbours(image, other), torch.zeros(size, dtype=torch.bool)
    needed[:9, :21] = needed[-5:, -30:] = needed[size[0] // 2, size[1] // 3] = True
    tiled = in_tiles(mean_of_neighbours, image, other, halo=4, tile=tile)
    torch.testing.assert_close(tiled, whole, rtol=0, atol=1e-6)
    options = {"tile": tile, "needed": needed, "fallback": -image}
    some = in_tiles(mean_of_neighbours, image, other, halo=4, **options)
    torch.testing.assert_close(some, torch.where(needed, whole, -image), rtol=0, atol=1e-6)
    assert torch.equal(in_tiles(lambda x: x.sum(1), image, halo=4, tile=8), image.sum(1))


def test_no_tile_is_larger_than_promised_and_small_frames_go_at_once():
    sizes: list[tuple[int, ...]] = []

    def spy(image: Tensor) -> Tensor:
        sizes.append(tuple(image.shape[-2:]))
        return image.double()[:, :2]

    image = frame(50, 130)
    assert torch.equal(in_tiles(spy, image, halo=8, tile=16), image.double()[:, :2])
    assert (max(max(s) for s in sizes), len(sizes)) == (16 + 2 * 8, 4 * 9)
    sizes.clear()
    in_tiles(spy, frame(24, 20), halo=8, tile=16)
    assert sizes == [(24, 20)]


@pytest.mark.parametrize("name", ["noise", "map"])
def test_the_halo_covers_what_the_networks_see(name):
    """What lies beyond the halo changes no bit of the centre; what lies within does."""
    if name == "map":
        blur = DefocusMap(width=6).eval().requires_grad_(False)
        network, halo = lambda x: blur(x, torch.full_like(x, 0.01)), camera_simulator._MAP_HALO
    else:
        assert len(SIZES["compact"]) == max(map(len, SIZES.values()))  # no size sees more
        noise = NoiseModule("compact").eval().requires_grad_(False).network
        torch.nn.init.normal_(noise.tail.weight)
        shot, read = torch.full((1, 4), 1e-2), torch.full((1, 4), 1e-4)
        far = torch.zeros(1, 4, 1, 1)
        halo = camera_simulator._NOISE_HALO
        network = lambda x: noise.uncorrected(x, far.expand_as(x), shot, read)  # noqa: E731
    image, (top, bottom) = frame(200, 200), (96, 104)
    centre, found = (..., slice(top, bottom), slice(top, bottom)), []
    for seen in (halo, 16):
        keep = (..., *2 * [slice(top - seen, bottom + seen)])
        other = frame(200, 200, seed=7) * 3
        other[keep] = image[keep]
        found.append(network(other)[centre])
    assert torch.equal(found[0], network(image)[centre])
    assert not torch.equal(found[1], found[0])
    # A tile of it whose corner lies on a multiple of 8 gives the same.
    tile = (..., *2 * [slice(top - halo, bottom + halo)])
    alone = network(image[tile])[..., halo:-halo, halo:-halo]
    torch.testing.assert_close(alone, found[0], rtol=0, atol=1e-4)


def test_constant_parts_do_not_vary():
    image, expected = frame(75, 100)[0], torch.ones(75, 100, dtype=torch.bool)
    image[:, 32:, :50] = 1.0  # saturated
    image[:, :16, 64:] = 0.0  # black, but for one plane's pixel
    image[2, 3, 70] = 1e-6
    expected[32:, :48] = expected[:16, 80:] = False
    assert torch.equal(varying(image), expected)
    expected[32:48] = expected[:, 48:] = expected[:, 32:48] = True
    assert torch.equal(varying(image, 16), expected)
    # A cell of one pixel cannot show that it varies.
    corner = varying(torch.ones(4, 33, 49))
    assert corner.nonzero().tolist() == [[32, 48]]
    assert not varying(torch.ones(4, 33, 48)).any()
