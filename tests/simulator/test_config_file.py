"""YAML files and what is wrong with them, in one line that names the entry."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import BaseModel, ConfigDict, Field, field_validator

from simulator.config_file import load_yaml


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


def test_a_good_file(tmp_path: Path) -> None:
    assert load(tmp_path, "name: x\npart: {steps: 4}\n") == Whole(name="x", part=Part(steps=4))


def test_the_home_folder_is_expanded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "a.yaml").write_text("name: x")
    assert load_yaml("~/a.yaml", Whole).name == "x"


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("name: x\npart: {steps: 0}", ["part.steps (=0)", "greater than or equal to 1"]),
        ("name: x\npart: {steps: 3}", ["part.steps (=3): must be even"]),
        ("name: x\nprat: {steps: 2}", ["prat (={'steps': 2})", "not permitted"]),
        ("part: {}", ["name: Field required; part.steps: Field required"]),
        ("", ["valid dictionary"]),
        ("- a\n- b", ["valid dictionary"]),
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


@pytest.mark.parametrize("name", ["none.yaml", "."])
def test_a_missing_file_or_a_folder(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="there is no such file"):
        load_yaml(tmp_path / name, Whole)
