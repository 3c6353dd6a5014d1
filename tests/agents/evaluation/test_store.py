import json

import numpy as np
import pytest

from agents.evaluation.jobs import EvaluationStore, part_key, policy_content

ARRAYS = {"x": np.arange(300).reshape(3, 100), "y": np.linspace(0.0, 1.0, 50)}


def test_parts_come_back_and_hold_no_pickles(tmp_path):
    store = EvaluationStore(tmp_path)
    store.save("a", ARRAYS, {"y": [1, None]})
    arrays, meta = store.load("a")
    assert {k: v.tolist() for k, v in arrays.items()} == {k: v.tolist() for k, v in ARRAYS.items()}
    assert meta == {"y": [1, None]}
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"]  # no temporary file stays
    np.savez(tmp_path / "b.npz", meta=np.array(json.dumps({})), x=np.array([object()]))
    assert store.load("b") is None
    assert store.load("c") is None
    assert not store.has("c")


def test_a_damaged_part_counts_as_missing_and_its_file_is_named(tmp_path, caplog):
    """Bytes changed, cut off, or put in: a part is read whole, or not at all."""
    store = EvaluationStore(tmp_path)
    whole = store.save("a", ARRAYS, {}).read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(600):
        content = bytearray(whole)
        for position in rng.integers(len(whole), size=rng.integers(1, 4)):
            content[position] ^= int(rng.integers(1, 256))
        (tmp_path / "a.npz").write_bytes(content)
        found = store.load("a")
        if found is not None:  # the bytes decide nothing, such as a date
            assert found[0].keys() == ARRAYS.keys()
            assert all(np.array_equal(found[0][name], ARRAYS[name]) for name in ARRAYS)
    for content in (b"", whole[: len(whole) // 2], whole[10:], b"no archive"):
        (tmp_path / "a.npz").write_bytes(content)
        caplog.clear()
        assert store.load("a") is None
        assert f"{tmp_path / 'a.npz'} is damaged and is measured again" in caplog.text


def test_keys_depend_on_their_parts_and_the_version(monkeypatch):
    first = part_key("k", 1)
    assert first == part_key("k", 1)
    assert first.startswith("k-")
    assert len({first, part_key("k", 2), part_key("l", 1)}) == 3
    monkeypatch.setattr("agents.evaluation.jobs.package_version", lambda: "9.9")
    assert part_key("k", 1) != first


NAMES = ("matrix:tuned?weights={0}/a", "ppo:{0}/a?device=cpu", "ppo:{0}/a", "recorded:{0}")


@pytest.mark.parametrize("name", [*NAMES, "{0}/a.py:C"])
def test_what_a_name_points_to_counts(name, tmp_path):
    name = name.format(tmp_path)
    files = [tmp_path / f"a{suffix}" for suffix in ("", ".safetensors", ".json", ".py")]
    for file in files:
        file.write_text("before")
    before = policy_content(name)
    assert policy_content(name) == before != ""
    for file in files:
        file.write_text("after!")
    assert policy_content(name) != before


def test_modules_beside_a_file_count_and_nothing_else(tmp_path):
    file, helper, inner = tmp_path / "mine.py", tmp_path / "helper.py", tmp_path / "sub"
    inner.mkdir()
    for path in (file, helper, inner / "other.py", tmp_path / "data.csv"):
        path.write_text("x = 1\n")
    before = policy_content(f"{file}:Mine")
    for path in (inner / "other.py", tmp_path / "data.csv"):
        path.write_text("x = 2\n")
    assert policy_content(f"{file}:Mine") == before
    helper.write_text("x = 2\n")
    assert policy_content(f"{file}:Mine") != before
    assert policy_content("matrix:P") == ""
    assert policy_content("ppo") != policy_content("regression")
