import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from simulator.utils.files import data_folder, write_atomically


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
        write_atomically(3, "x")  # type: ignore[arg-type]


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
