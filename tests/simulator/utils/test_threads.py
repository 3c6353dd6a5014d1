import multiprocessing
import threading

import numpy as np
import pytest

from simulator.utils.compute import parallel_ranges


@pytest.mark.parametrize("threads", [1, 2, 3, 8])
@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_every_item_is_done_once(count, threads):
    done = np.zeros((count, 10), int)

    def task(first: int, last: int) -> None:
        for row in done[first:last]:  # a task may ask for shares itself

            def inner(a: int, b: int, row: np.ndarray = row) -> None:
                row[a:b] += 1

            parallel_ranges(inner, 10, threads=2)

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


def _sum_in_child(queue: multiprocessing.Queue) -> None:
    totals = np.zeros(2)

    def task(first: int, last: int) -> None:
        totals[first:last] = last

    parallel_ranges(task, 2, threads=2)
    queue.put(totals.tolist())


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # forking a process that has threads
def test_child_processes_make_threads_of_their_own():
    parallel_ranges(lambda *_: None, 2, threads=2)  # this process has some already
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_sum_in_child, args=(queue,))
    child.start()
    assert queue.get(timeout=60) == [1.0, 2.0]
    child.join(timeout=60)
