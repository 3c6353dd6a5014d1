"""Reading pickles of torch without running them: both formats, and what is refused."""

from __future__ import annotations

import io
import os
import pickle
import re
import subprocess
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from simulator.networks.torch_files import read_state


class Calls:
    """Pickled as a call of `function`."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


def saved(path: Path, content: Any, *, legacy: bool) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # source of classes that is not found
        torch.save(content, path, _use_new_zipfile_serialization=not legacy)
    return path


FORMATS = pytest.mark.parametrize("legacy", [True, False], ids=["legacy", "zip"])


@FORMATS
def test_tensors_come_back(tmp_path: Path, legacy: bool) -> None:
    """Views that share a storage, transposed, of several types, empty; buffers of a module."""
    base = torch.arange(24.0).reshape(4, 6)
    state = {"a": base[1:, 2:], "b": base.T, "c": torch.tensor(5), "d": torch.zeros(0, 3)}
    state |= {"e": torch.tensor([True, False]), "f": torch.ones(3, dtype=torch.bfloat16)}
    found = read_state(saved(tmp_path / "state", state, legacy=legacy))
    assert list(found) == list(state)
    for name, tensor in state.items():
        assert found[name].dtype == tensor.dtype
        assert torch.equal(found[name], tensor)
    network = nn.DataParallel(nn.Sequential(nn.Conv2d(2, 3, 1, bias=False), nn.BatchNorm2d(3)))
    found = read_state(saved(tmp_path / "network", network, legacy=legacy))
    expected = network.module.state_dict()
    assert list(found) == list(expected)
    assert all(torch.equal(found[name], tensor) for name, tensor in expected.items())


def test_storages_of_the_types_of_cuda(tmp_path: Path) -> None:
    """As torch before 1.6 named them."""
    path = saved(tmp_path / "state", {"a": torch.arange(3.0)}, legacy=True)
    content = path.read_bytes()
    assert content.count(b"ctorch\nFloatStorage\n") == 1
    path.write_bytes(content.replace(b"ctorch\nFloat", b"ctorch.cuda\nFloat"))
    assert read_state(path)["a"].tolist() == [0.0, 1.0, 2.0]


@FORMATS
@pytest.mark.parametrize(
    ("function", "argument", "named"),
    [
        (os.system, "touch harmed", r"(posix|nt)\.system"),
        (subprocess.Popen, "touch harmed", r"\w+\.Popen"),
        (eval, "open('harmed', 'w')", r"(__builtin__|builtins)\.eval"),
        (getattr, "harmed", r"(__builtin__|builtins)\.getattr"),
        (torch.load, "harmed", r"torch\.serialization\.load"),
        (torch.hub.load, "harmed", r"torch\.hub\.load"),
        (pickle.loads, b"harmed", r"pickle\.loads"),
    ],
)
def test_harmful_pickles_are_refused_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, legacy: bool, function, argument, named: str
) -> None:
    monkeypatch.chdir(tmp_path)
    content = {"model": Calls(function, argument)}
    path = saved(tmp_path / "exp_model", content, legacy=legacy)
    with pytest.raises(ValueError, match=named) as caught:
        read_state(path)
    assert "exp_model` names " in str(caught.value)
    assert "\n" not in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["exp_model"]


def test_pickles_of_any_protocol_are_refused_by_name(tmp_path: Path) -> None:
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        content = pickle.dumps({"model": Calls(os.system, "touch harmed")}, protocol)
        (tmp_path / "exp_model").write_bytes(content)
        with pytest.raises(ValueError, match=r"exp_model` names (posix|nt)\.system"):
            read_state(tmp_path / "exp_model")


def test_a_large_number_in_a_pickle_takes_no_memory(tmp_path: Path) -> None:
    """1 is to be remembered as object 16,777,215."""
    (tmp_path / "exp_model").write_bytes(b"\x80\x02K\x01r\xff\xff\xff\x00.")
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"must be a file that torch\.save wrote"):
            read_state(tmp_path / "exp_model")
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()


def test_layers_of_torch_are_stand_ins_that_call_nothing(tmp_path: Path) -> None:
    """A call where the file must only name a class, and a class that is not known."""
    torch.save({"model": Calls(nn.Linear, 2, 3)}, tmp_path / "call")
    with pytest.raises(ValueError, match="call` is damaged"):
        read_state(tmp_path / "call")

    network = nn.Sequential(nn.Linear(2, 2))
    Mine = type("Mine", (nn.Sequential,), {"__module__": __name__})
    globals()["Mine"] = Mine
    network.__class__ = Mine
    try:
        path = saved(tmp_path / "own", network, legacy=True)
    finally:
        del globals()["Mine"]
    with pytest.raises(ValueError, match=re.escape(f"names {__name__}.Mine, which is no part")):
        read_state(path)
    assert list(read_state(path, packages=(__name__,))) == ["0.weight", "0.bias"]


@FORMATS
def test_files_that_are_cut_off(tmp_path: Path, legacy: bool) -> None:
    path = saved(tmp_path / "whole", {"a": torch.arange(1000.0)}, legacy=legacy)
    content = path.read_bytes()
    for share in (0.03, 0.3, 0.6, 0.99):
        part = tmp_path / "part"
        part.write_bytes(content[: int(share * len(content))])
        with pytest.raises(ValueError, match=r"^`[^\n]*part` [^\n]+$"):
            read_state(part)


def test_tensors_outside_of_their_storage(tmp_path: Path) -> None:
    """A view of five numbers, of a storage of three, or of a storage that is not there."""
    path = saved(tmp_path / "a", {"a": torch.arange(5.0)}, legacy=False)
    with zipfile.ZipFile(path) as archive:
        records = {name: archive.read(name) for name in archive.namelist()}
    (numbers,) = (name for name in records if name.endswith("data/0"))
    for change, message in (
        ({numbers: records[numbers][:12]}, "the storage 0 has 12 bytes"),
        ({numbers: None}, "there is no"),
    ):
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in (records | change).items():
                if content is not None:
                    archive.writestr(name, content)
        with pytest.raises(ValueError, match=message):
            read_state(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/data.pkl", b"")
    with pytest.raises(ValueError, match="is compressed"):
        read_state(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([1, 2], "must hold a network or its state_dict"),
        ({"a": 1}, "must hold a network or its state_dict"),
        ({}, "must hold a network or its state_dict"),
    ],
)
def test_files_of_other_things(tmp_path: Path, content: Any, message: str) -> None:
    torch.save(content, tmp_path / "a")
    with pytest.raises(ValueError, match=message):
        read_state(tmp_path / "a")
    stream = io.BytesIO()
    pickle.dump(content, stream)
    (tmp_path / "b").write_bytes(stream.getvalue())
    with pytest.raises(ValueError, match=r"must be a file that torch\.save wrote"):
        read_state(tmp_path / "b")
