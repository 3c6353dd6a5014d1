import datetime
import errno
import json
import os
import stat
import subprocess
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import torch

from simulator.utils.files import data_folder, result_meta, write_atomically, write_results


@pytest.mark.parametrize("content", [b"\x00\xffraw", "Grüße ☀", b"", ""])
@pytest.mark.parametrize("name", ["file", "y" * 246 + ".dng", "\u5b57" * 84 + ".d"])
def test_content_comes_back(tmp_path, content, name):
    deep = tmp_path / "a" / "b" / name  # folders are made and files replaced
    assert write_atomically(str(deep), content) == deep
    assert deep.read_bytes() == (content.encode() if isinstance(content, str) else content)
    write_atomically(deep, (memoryview(b"ab" * i) for i in range(3)))
    assert deep.read_bytes() == b"ababab"
    assert list(deep.parent.iterdir()) == [deep]


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (KeyboardInterrupt(), None),
        (OSError(errno.ENOSPC, "No space left"), r"`path` \(='.*file'\) cannot be written: No sp"),
    ],
)
def test_a_crash_leaves_the_old_content(tmp_path, fault, message):
    path = write_atomically(tmp_path / "file", "old")

    def pieces() -> Iterator[bytes]:
        yield b"half of it"
        raise fault

    with pytest.raises(type(fault), match=message):
        write_atomically(path, pieces())
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_permissions_are_those_of_an_ordinary_file(tmp_path, umask):
    before = os.umask(umask)
    try:
        (tmp_path / "ordinary").write_text("x")
        write_atomically(tmp_path / "written", "x")
    finally:
        assert os.umask(before) == umask  # it was left alone
    assert len({stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()}) == 1


def test_targets_that_cannot_be_written(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("x")
    targets = [tmp_path / "folder", tmp_path / "file" / "below", tmp_path / ("x" * 300)]
    for target in targets:
        with pytest.raises(OSError, match=r"`path` .* cannot be written: ") as caught:
            write_atomically(target, "x")
        assert str(target) in str(caught.value)
        assert ".tmp" not in str(caught.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]
    with pytest.raises(ValueError, match=r"`path` \(=3\) must be a file's name"):
        write_atomically(3, "x")


def test_the_folder_of_real_files(tmp_path, monkeypatch):
    beside = Path(__file__).resolve().parents[4] / "shared" / "data"
    unset = beside if beside.is_dir() else None
    for value, expected in ((tmp_path, tmp_path), ("", unset)):
        monkeypatch.setenv("AE_ENV_DATA", str(value))
        assert data_folder() == expected
    monkeypatch.setenv("AE_ENV_DATA", str(tmp_path / "none"))
    with pytest.raises(FileNotFoundError, match=r"AE_ENV_DATA \(='.*none'\) must name a folder"):
        data_folder()
    monkeypatch.delenv("AE_ENV_DATA")
    assert data_folder() == unset


def test_meta_says_where_a_number_comes_from():
    meta = result_meta("ae-env bench throughput", seed=3)
    assert set(meta) == {"command", "commit", "seed", "date", "machine", "versions"}
    assert (meta["command"], meta["seed"]) == ("ae-env bench throughput", 3)
    assert meta["machine"]["threads"] == torch.get_num_threads()
    assert meta["versions"]["torch"] == version("torch")
    age = datetime.datetime.now(datetime.UTC) - datetime.datetime.fromisoformat(meta["date"])
    assert abs(age.total_seconds()) < 60
    json.dumps(meta)

    def git(*arguments):
        command = ["git", "-C", Path(__file__).parent, *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    head = git("rev-parse", "--verify", "--quiet", "HEAD")
    changed = git("diff", "--quiet", "HEAD").returncode
    expected = None if head.returncode else head.stdout.strip() + "+changes" * changed
    assert meta["commit"] == expected


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), object(), np.float32("nan")])
def test_files_read_back_and_bad_values_leave_them(tmp_path, bad):
    path = tmp_path / "new" / "results.json"
    rows = [{"value": np.float32(0.5), "count": np.int64(3), "tensor": torch.tensor([1.0, 2.0])}]
    assert write_results(path, rows, {"command": "x"}) == path
    before = path.read_text()
    expected = {"meta": {"command": "x"}, "rows": [{"value": 0.5, "count": 3, "tensor": [1, 2]}]}
    assert json.loads(before) == expected
    with pytest.raises(ValueError, match="finite JSON"):
        write_results(path, [{"a": bad}], {})
    assert path.read_text() == before
    assert len(list(path.parent.iterdir())) == 1
