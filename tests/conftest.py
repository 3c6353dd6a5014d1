"""Fixtures shared by all tests."""

import logging
import multiprocessing
import multiprocessing.forkserver
import os
import socket

import hypothesis
import pytest
import torch

from simulator.utils.files import data_folder

# Property tests run the same examples every time, keep none, and may wait for a kernel to compile;
# HYPOTHESIS_EXAMPLES asks for more of them.
hypothesis.settings.register_profile(
    "tests",
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=int(os.environ.get("HYPOTHESIS_EXAMPLES", "25")),
    print_blob=True,
    suppress_health_check=[
        hypothesis.HealthCheck.function_scoped_fixture,  # the cache's folder serves all examples
        hypothesis.HealthCheck.too_slow,
    ],
)
hypothesis.settings.load_profile("tests")

# A share of the processors for each worker of pytest-xdist: OpenMP's waiting threads block others.
_WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
torch.set_num_threads(max(1, min(2, torch.get_num_threads() // _WORKERS)))
os.environ.setdefault("OMP_NUM_THREADS", str(torch.get_num_threads()))  # of processes they start


#: Files of whole runs (commands, pages, trainings, evaluations, exports): all of their tests are
#: slow, and `make test-fast` does not even import them.
SLOW_FILES = [
    *("test_docs.py", "test_benchmarks.py", "simulator/test_camera_simulator.py"),
    *("simulator/networks/test_*.py", "ae_env/scorers/test_pictures.py"),
    *("simulator/training/*.py", "ae_env/scenes/test_bundled.py", "agents/test_*.py"),
    *("agents/bracketing/*.py", "agents/evaluation/test_engine.py", "agents/report/*.py"),
    *("agents/learning/test_learners.py", "agents/metering/test_programs.py"),
    "agents/onboard/*.py",
]


def _is_slow_file(path):
    return any(path.match(f"tests/{pattern}") for pattern in SLOW_FILES)


def pytest_ignore_collect(collection_path, config):
    return True if config.option.markexpr == "not slow" and _is_slow_file(collection_path) else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if _is_slow_file(item.path):
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session")
def data_dir():
    """The folder of real files named by AE_ENV_DATA, or a skip that says what is missing."""
    folder = data_folder()
    if folder is None:
        pytest.skip("real data not found: set AE_ENV_DATA to its folder")
    return folder


@pytest.fixture(autouse=True, scope="session")
def cache_in_tmp(tmp_path_factory):
    """Cached scenes of the tests live in the test run's own folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AE_ENV_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
        yield


@pytest.fixture
def no_network(monkeypatch):
    """Every connection is refused: nothing may be fetched at run time."""
    monkeypatch.setattr(socket.socket, "connect", pytest.fail)
    monkeypatch.setattr(socket, "getaddrinfo", pytest.fail)


@pytest.fixture(autouse=True)
def the_same_random_numbers_and_threads():
    """A test draws the same from torch's own generator on every run, in any order."""
    torch.manual_seed(0)
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def forkserver():
    """Starts processes from a server that has imported everything and computed nothing."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        pytest.skip("needs POSIX processes")
    context = multiprocessing.get_context("forkserver")
    used = ("agents.cli.main", "agents.learning.ppo", "agents.learning.training", "torch._dynamo")
    context.set_forkserver_preload([*used, "ae_env.vector_env", "agents.evaluation.jobs"])
    multiprocessing.forkserver.ensure_running()
    return context


@pytest.fixture
def quick_spawn(forkserver, monkeypatch):
    """Processes that the package spawns come from `forkserver`: importing torch takes seconds."""
    monkeypatch.setattr(multiprocessing, "get_context", {"spawn": forkserver}.__getitem__)


@pytest.fixture
def ae_env(monkeypatch, capsys, tmp_path):
    """Runs the command line as the console script does, in a folder of its own."""
    from agents.cli import main as cli

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(logging, "basicConfig", lambda **_: None)  # pytest has its own handlers

    def run(*arguments: object) -> tuple[int, str, str]:
        argv = ["ae-env", *map(str, arguments)]
        monkeypatch.setattr("sys.argv", argv)
        with pytest.raises(SystemExit) as caught:
            cli.main()
        output = capsys.readouterr()
        return int(caught.value.code or 0), output.out, output.err

    return run
