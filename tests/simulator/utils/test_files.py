"""Files that are written, results and their meta, configurations."""

import datetime
import errno
import json
import os
import stat
import subprocess
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from pydantic import Field, field_validator

from simulator.utils.config_file import Configuration, load_yaml, read_yaml
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


# -- configurations --------------------------------------------------------------------------------

#: Nine lists of nine, each of the one before: 3 * 10**8 entries where the aliases are followed.
BOMB = "a0: &a0 [x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10)
)


class Part(Configuration):
    steps: int = Field(ge=1)

    @field_validator("steps")
    @classmethod
    def _even(cls, value: int) -> int:
        if value % 2:
            raise ValueError("must be even")
        return value


class Whole(Configuration):
    name: str
    part: Part | None = None
    parts: dict[str, Part] = Field(default_factory=dict)
    rows: tuple[Part, ...] = ()
    share: float = 0.5


def load(folder: Path, text: str | bytes) -> Whole:
    file = folder / "a.yaml"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_yaml(file, Whole)


def test_a_good_file(tmp_path, monkeypatch):
    for text in ("name: x\npart: {steps: 2}\n", "name: &n x\npart:\n  <<: {steps: 2}\n"):  # merges
        assert load(tmp_path, text) == Whole(name="x", part=Part(steps=2))
    monkeypatch.setenv("HOME", str(tmp_path))
    assert load_yaml("~/a.yaml", Whole).name == "x"
    (tmp_path / "a.yaml").write_text("[1, 2.5, null]")
    assert read_yaml(tmp_path / "a.yaml") == [1, 2.5, None]
    (tmp_path / "a.yaml").write_text("[")
    with pytest.raises(ValueError, match="`preset`"):
        read_yaml(tmp_path / "a.yaml", name="preset")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none.yaml", "there is no such file"),
        (".", "is a folder"),
        ("x" * 5000, "cannot be read"),
        ("a.yaml", "cannot be read: Permission denied"),
    ],
)
def test_what_cannot_be_read(tmp_path, monkeypatch, name, message):
    if name == "a.yaml":
        (tmp_path / name).touch()
        error = PermissionError(13, "Permission denied")  # root may read anything
        monkeypatch.setattr(Path, "read_text", Mock(side_effect=error))
    with pytest.raises(ValueError, match=rf"`config` .*{message}"):
        load_yaml(tmp_path / name, Whole)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("name: x\npart: {steps: 0}", ["part.steps (=0)", "greater than or equal to 1"]),
        ("name: x\nprat: {steps: 2}", ["prat (={'steps': 2}): unknown", "did you mean `part`?"]),
        ("name: x\npart: {stesp: 2}", ["part.stesp (=2): unknown", "did you mean `steps`?"]),
        ("", ["is empty: it must map entries to values; known entries: name, part, parts"]),
        ("- a\n- b", ["holds ['a', 'b']: it must map entries"]),
        ("name: x\npart: {steps: 2}\nname: y", ["'name' is given twice, again in line 3"]),
        ("name: " + "[" * 700, ["nested too deeply"]),
        ("name: &a [*a]", ["name (=", "valid string"]),
        (BOMB, ["a9 (=", "unknown"]),
        ("name: 2001-13-45", ["is not YAML: month must be"]),
        ("name: x" + " " * 2**20, ["must not be larger than"]),
        (b"name: \xff\xfe", ["is not YAML"]),
        ("name: x\nparts: {a: {stesp: 3}}", ["parts.a.stesp (=3): unknown, the", "mean `steps`"]),
        ("name: x\nrows: [{steps: 2}, {foo: 3}]", ["rows.1.foo (=3): unknown", "'steps'"]),
        ("name: !!python/object/apply:os.getcwd []", ["is not YAML"]),  # nothing is executed
    ],
)
def test_errors_name_file_and_entry_in_one_line(tmp_path, text, parts):
    with pytest.raises(ValueError) as caught:
        load(tmp_path, text)
    message = str(caught.value)
    assert message.startswith(f"`config` (={str(tmp_path / 'a.yaml')!r})")
    assert "\n" not in message
    assert "Value error" not in message
    assert [part for part in parts if part not in message] == []
