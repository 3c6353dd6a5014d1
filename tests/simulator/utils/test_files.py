"""Files appear whole or not at all, and the folder of real files is found."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from simulator.utils.files import data_folder, write_atomically


@pytest.mark.parametrize("content", [b"\x00\xffraw", "Grüße ☀", b"", ""])
def test_content_comes_back(tmp_path: Path, content: bytes | str) -> None:
    path = write_atomically(tmp_path / "file", content)
    assert path == tmp_path / "file"
    expected = content.encode("utf-8") if isinstance(content, str) else content
    assert path.read_bytes() == expected
    deep = tmp_path / "a" / "b" / "file.json"  # folders are made and files replaced
    write_atomically(deep, "old and longer")
    write_atomically(str(deep), (memoryview(b"ab" * i) for i in range(3)))
    assert deep.read_bytes() == b"ababab"
    assert [p.name for p in deep.parent.iterdir()] == ["file.json"]


def test_a_crash_leaves_the_old_content(tmp_path: Path) -> None:
    path = write_atomically(tmp_path / "file", "old")

    def interrupted() -> Iterator[bytes]:
        yield b"half of it"
        raise KeyboardInterrupt

    def full() -> Iterator[bytes]:
        yield b"half of it"
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, interrupted())
    with pytest.raises(OSError, match=r"`path` \(='.*file'\) cannot be written: No space left"):
        write_atomically(path, full())
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_permissions_are_those_of_an_ordinary_file(tmp_path: Path) -> None:
    for umask in (0o022, 0o077):
        before = os.umask(umask)
        try:
            (tmp_path / "ordinary").unlink(missing_ok=True)
            (tmp_path / "ordinary").write_text("x")
            write_atomically(tmp_path / "written", "x")
        finally:
            assert os.umask(before) == umask  # it was left alone
        modes = [stat.S_IMODE((tmp_path / n).stat().st_mode) for n in ("ordinary", "written")]
        assert modes[0] == modes[1]


def test_targets_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("x")
    targets = [tmp_path / "folder", tmp_path / "file" / "below", tmp_path / ("x" * 300)]
    targets += [Path("/proc/x")] if Path("/proc/version").exists() else []
    for target in targets:
        with pytest.raises(OSError, match=r"`path` .* cannot be written: ") as caught:
            write_atomically(target, "x")
        assert str(target) in str(caught.value)
        assert ".tmp" not in str(caught.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]
    with pytest.raises(ValueError, match=r"`path` \(=3\) must be a file's name"):
        write_atomically(3, "x")  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["y" * 246 + ".dng", "\u5b57" * 84 + ".d"])
def test_names_as_long_as_names_may_be(tmp_path: Path, name: str) -> None:
    assert write_atomically(tmp_path / name, b"1").read_bytes() == b"1"


def test_the_folder_of_real_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AE_ENV_DATA", str(tmp_path))
    assert data_folder() == tmp_path
    monkeypatch.setenv("AE_ENV_DATA", str(tmp_path / "none"))
    assert data_folder() is None
    monkeypatch.delenv("AE_ENV_DATA")
    unset = data_folder()
    monkeypatch.setenv("AE_ENV_DATA", "")
    assert data_folder() == unset
    root = Path(__file__).resolve().parents[4]
    assert unset == (root / "shared/data" if (root / "shared/data").is_dir() else None)
