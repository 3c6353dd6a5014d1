"""Classes from files of the user's own."""

import sys
from pathlib import Path

import pytest

from ae_env.utils.user_files import load_from_file, split_file_name

ARGUMENT = "`thing` (='mine.py:Mine')"


def _write(file: Path, text: str) -> Path:
    file.write_text(text)
    return file


def test_names_of_files() -> None:
    for file, name in (("mine.py", "Mine"), ("/a/b.py/m.py", "Mine"), ("C:\\a b\\m.py", "Mine")):
        assert split_file_name(f"{file}:{name}") == (file, name)
    assert split_file_name("mine.py:") == ("mine.py", "")
    assert split_file_name("noise") is None


def test_a_file_is_run_once_until_it_changes(tmp_path, monkeypatch):
    file = _write(tmp_path / "my file-1.py", "class Mine:\n    number = 1\n")
    first = load_from_file(str(file), "Mine", ARGUMENT)
    monkeypatch.chdir(tmp_path)
    assert load_from_file("my file-1.py", "Mine", ARGUMENT) is first
    monkeypatch.setenv("HOME", str(tmp_path))
    assert load_from_file("~/my file-1.py", "Mine", ARGUMENT) is first
    _write(file, "class Mine:\n    number = 2\n")  # in the same second, of the same length
    assert load_from_file(str(file), "Mine", ARGUMENT).number == 2
    other = tmp_path / "folder"
    other.mkdir()
    twin = _write(other / "my file-1.py", "class Mine:\n    number = 3\n")
    assert load_from_file(str(twin), "Mine", ARGUMENT).number == 3
    assert load_from_file(str(file), "Mine", ARGUMENT).number == 2


def test_helpers_beside_a_file_are_found_and_not_mixed_up(tmp_path: Path) -> None:
    """From any folder, a package too; two folders may have helpers of the same names."""
    before, path = set(sys.modules), list(sys.path)
    for number in (1, 2):
        folder = tmp_path / str(number)
        (folder / "own_package").mkdir(parents=True)
        _write(folder / "own_helper.py", f"number = {number}")
        _write(folder / "own_package" / "__init__.py", "")
        _write(folder / "own_package" / "part.py", f"from own_helper import number as n{number}")
        text = f"from own_package.part import n{number} as n\nclass Mine:\n    number = n\n"
        _write(folder / "mine.py", text)
    files = [str(tmp_path / str(number) / "mine.py") for number in (1, 2)]
    assert [load_from_file(f, "Mine", ARGUMENT).number for f in (*files, files[0])] == [1, 2, 1]
    _write(tmp_path / "1" / "own_helper.py", "number = 333")
    with open(files[0], "a") as file:
        file.write("# changed")
    assert load_from_file(files[0], "Mine", ARGUMENT).number == 333
    assert sys.path == path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def test_what_is_importable_anyway_is_not_imported_twice(tmp_path, monkeypatch):
    """Packages of an environment within the folder, or of the folder itself, on the path."""
    monkeypatch.syspath_prepend(tmp_path)
    _write(tmp_path / "on_the_path.py", "class Base: ...")
    for name in ("one", "two"):
        _write(tmp_path / f"{name}.py", "from on_the_path import Base as Mine")
    one, two = (load_from_file(str(tmp_path / f"{n}.py"), "Mine", ARGUMENT) for n in ("one", "two"))
    assert one is two
    monkeypatch.delitem(sys.modules, "on_the_path")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import a_module_that_is_not_there", "ModuleNotFoundError: No module named 'a_module"),
        ("def (:", "SyntaxError"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("x = 1\n1 / 0", r"mine\.py cannot be loaded: ZeroDivisionError: .* \(line 2\)"),
        ("class Mime: ...", "no class 'Mine' there; found Mime; did you mean 'Mime'"),
        ("x = 3", "no class 'Mine' there; found no class at all"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path: Path, text: str, message: str) -> None:
    file = _write(tmp_path / "mine.py", text)
    before = set(sys.modules)
    with pytest.raises(ValueError, match=message) as caught:
        load_from_file(str(file), "Mine", ARGUMENT)
    assert str(caught.value).startswith(ARGUMENT)
    left = [name for name in set(sys.modules) - before if name.startswith("ae_env_user_")]
    assert len(left) == ("class" in message)  # what failed to load is not kept
    for path, name in ((tmp_path / "none.py", "Mine"), (file, "")):
        with pytest.raises(ValueError, match=r"`thing` \(='mine.py:Mine'\)"):
            load_from_file(str(path), name, ARGUMENT)
