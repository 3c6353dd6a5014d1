"""YAML files and what is wrong with them, in one line that names the entry."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import BaseModel, ConfigDict, Field, field_validator

from simulator.utils.config_file import Configuration, load_yaml, read_yaml

#: Nine lists of nine, each of the one before: 3 * 10**8 entries where the aliases are followed.
BOMB = "a0: &a0 [x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10)
)


class Part(BaseModel):
    model_config = ConfigDict(extra="forbid")
    steps: int = Field(ge=1)

    @field_validator("steps")
    @classmethod
    def _even(cls, value: int) -> int:
        if value % 2:
            raise ValueError("must be even")
        return value


class Whole(BaseModel):
    model_config = ConfigDict(extra="forbid")
    name: str
    part: Part | None = None


def load(folder: Path, text: str | bytes) -> Whole:
    file = folder / "a.yaml"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_yaml(file, Whole)


def test_a_good_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert load(tmp_path, "name: x\npart: {steps: 4}\n") == Whole(name="x", part=Part(steps=4))
    text = "name: &n x\npart:\n  <<: {steps: 2}\n"  # aliases and merges
    assert load(tmp_path, text) == Whole(name="x", part=Part(steps=2))
    monkeypatch.setenv("HOME", str(tmp_path))
    assert load_yaml("~/a.yaml", Whole).name == "x"


def test_any_values_are_read_within_the_same_bounds(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    for text, value in (
        ("[1, 2.5, null]", [1, 2.5, None]),
        ("", None),
        ("a: {b: c}", {"a": {"b": "c"}}),
    ):
        file.write_text(text)
        assert read_yaml(file) == value
    for text, message in ((BOMB, "at most 10000 entries"), ("a: 1\na: 2", "given twice")):
        file.write_text(text)
        with pytest.raises(ValueError, match=rf"`preset` \(='.*a.yaml'\): .*{message}"):
            read_yaml(file, name="preset")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("name: x\npart: {steps: 0}", ["part.steps (=0)", "greater than or equal to 1"]),
        ("name: x\npart: {steps: 3}", ["part.steps (=3): must be even"]),
        ("name: x\nprat: {steps: 2}", ["prat (={'steps': 2}): unknown", "did you mean `part`?"]),
        ("part: {}", ["name: Field required; part.steps: Field required"]),
        ("name: x\npart: {stesp: 2}", ["part.stesp (=2): unknown", "did you mean `steps`?"]),
        ("", ["is empty: it must have entries, of name, part"]),
        ("- a\n- b", ["holds ['a', 'b']: it must have entries"]),
        ("7", ["holds 7: it must have entries"]),
        ("name: x\npart: {steps: 2}\nname: y", ["'name' is given twice, again in line 3"]),
        ("name: x\npart: {steps: 2, steps: 4}", ["'steps' is given twice"]),
        ("name: " + "[" * 100 + "]" * 100, ["nested deeper than 50"]),
        ("name: " + "[" * 20_000, ["nested too deeply"]),
        ("name: &a [*a]", ["nested deeper than 50"]),
        (BOMB, ["at most 10000 entries"]),
        ("name: !!int x", ["is not YAML: invalid literal"]),
        ("name: 2001-13-45", ["is not YAML: month must be"]),
        ("name: [1]: 2", ["is not YAML"]),
        ("name: x" + " " * 2**20, ["must not be larger than"]),
        ("name: true", ["name (=True): Input should be a valid string"]),
        ("name: [", ["is not YAML"]),
        (b"name: \xff\xfe", ["is not YAML"]),
        ("name: !!python/object/apply:os.getcwd []", ["is not YAML"]),  # nothing is executed
    ],
)
def test_errors_name_file_and_entry_in_one_line(
    tmp_path: Path, text: str | bytes, parts: list[str]
) -> None:
    with pytest.raises(ValueError) as caught:
        load(tmp_path, text)
    message = str(caught.value)
    assert message.startswith(f"`config` (={str(tmp_path / 'a.yaml')!r})")
    assert "\n" not in message
    assert "Value error" not in message
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    ("name", "message"),
    [("none.yaml", "there is no such file"), (".", "is a folder"), ("x" * 5000, "cannot be read")],
)
def test_a_missing_file_or_a_folder(tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_yaml(tmp_path / name, Whole)


def test_an_unreadable_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: object, **kwargs: object) -> str:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_text", refuse)  # root may read anything
    with pytest.raises(ValueError, match=r"`config` .*cannot be read: Permission denied"):
        load(tmp_path, "name: x")


class Numbers(Configuration):
    share: float = 0.5
    steps: int = 1


@pytest.mark.parametrize("entry", ["share", "steps"])
def test_true_is_no_number(tmp_path: Path, entry: str) -> None:
    (tmp_path / "a.yaml").write_text(f"{entry}: yes\n")
    with pytest.raises(ValueError, match=rf"{entry} \(=True\): .*not be true or false"):
        load_yaml(tmp_path / "a.yaml", Numbers)


class Many(Configuration):
    parts: dict[str, Part] = Field(default_factory=dict)
    rows: tuple[Part, ...] = ()
    one: Part | None = None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("parts: {a: {stesp: 3}}", r"parts\.a\.stesp \(=3\): unknown, the .*mean `steps`"),
        ("rows: [{steps: 2}, {foo: 3}]", r"rows\.1\.foo \(=3\): unknown, .*'steps'"),
        ("one: {foo: 3}", r"one\.foo \(=3\): unknown, .*'steps'"),
        ("rows: 3", r"rows \(=3\): must be a list"),
        ("parts: 3", r"parts \(=3\): must be a mapping"),
        ("parts: {a: 3}", r"parts\.a \(=3\): must be a mapping"),
    ],
)
def test_entries_of_mappings_and_lists(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ValueError, match=message):
        load_yaml(tmp_path / "a.yaml", Many)
