import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from agents.cli import bench
from tests.simulator.training.captures import write_dataset

OURS = """
def run(out, *, seed, quick):
    out.mkdir()
    (out / 'ours').write_text(f'{seed} {quick}')
"""


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for folder, code in (("checkout", OURS), ("mine", "raise RuntimeError('not ours')")):
        (tmp_path / folder / "benchmarks").mkdir(parents=True)
        (tmp_path / folder / "benchmarks" / "__init__.py").write_text("")
        (tmp_path / folder / "benchmarks" / "convergence.py").write_text(code)
    loaded = {name: sys.modules.pop(name) for name in list(sys.modules) if "benchmarks" in name}
    monkeypatch.syspath_prepend(tmp_path / "mine")  # takes back what is added to the path, too
    monkeypatch.setattr(bench, "CHECKOUT", tmp_path / "checkout")
    yield
    for name in [name for name in sys.modules if "benchmarks" in name]:
        del sys.modules[name]
    sys.modules.update(loaded)


def test_the_working_folder_does_not_matter(ae_env, folders, tmp_path):
    code, _, _ = ae_env("bench", "convergence", "--quick", "--seed", 3, "--out", "here")
    assert code == 0
    assert (tmp_path / "here" / "ours").read_text() == "3 True"


def test_an_installed_package_says_that_it_has_none(ae_env, folders, tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "CHECKOUT", tmp_path / "site-packages")
    code, _, error = ae_env("bench", "throughput")
    assert code == 2
    assert "the benchmarks are not part of the installed package" in error
    assert "pip install -e ." in error


@pytest.mark.parametrize(
    ("name", "part", "words"),
    [("throughput", "agents", "an option of transfer only"), ("transfer", "table", "tables")],
)
def test_parts_are_those_of_transfer(ae_env, name, part, words):
    code, _, error = ae_env("bench", name, "--part", part)
    assert code == 2
    assert words in error


@pytest.mark.parametrize(
    "arguments",
    [("recorded", "nope"), ("paper", "nope"), ("paper", "data", "--weights", "nope")],
    ids=" ".join,
)
def test_what_is_refused_leaves_no_folder(ae_env, arguments, tmp_path):
    write_dataset(tmp_path / "data")
    for out in ((), ("--out", "here")):
        code, _, error = ae_env("bench", *arguments, *out)
        assert code == 2, error
        assert "nope" in error
    assert [path.name for path in tmp_path.iterdir()] == ["data"]
