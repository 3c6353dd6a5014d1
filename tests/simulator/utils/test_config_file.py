from pathlib import Path
from unittest.mock import Mock

import pytest
from pydantic import Field, field_validator

from simulator.utils.config_file import Configuration, load_yaml, read_yaml

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
