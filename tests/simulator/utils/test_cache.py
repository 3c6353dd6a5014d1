"""What is kept: the order and bound in memory, whole files on disk, several processes at once."""

from __future__ import annotations

import copy
import hashlib
import logging
import multiprocessing
import os
import pickle
import stat
import threading
from pathlib import Path

import numpy as np
import platformdirs
import pytest
import torch
from safetensors.torch import load_file

from simulator.utils.cache import (
    CACHE_KINDS,
    DiskCache,
    LruCache,
    cache_dir,
    cache_key,
    content_digest,
)

KEYS = [cache_key({"i": i}) for i in range(64)]


def test_the_variable_names_the_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "here"))
    assert cache_dir() == tmp_path / "here"
    assert not cache_dir().exists()
    monkeypatch.setenv("AE_ENV_CACHE", "~/there")
    assert cache_dir() == Path.home() / "there"
    monkeypatch.delenv("AE_ENV_CACHE")
    assert cache_dir() == Path(platformdirs.user_cache_dir("ae-env"))


def test_cache_key_depends_on_names_and_values() -> None:
    assert cache_key({"a": 1, "b": [2]}) == cache_key({"b": [2], "a": 1})
    assert cache_key({"a": 1}) != cache_key({"a": 2})
    assert cache_key({"a": 1}) == hashlib.sha256(b'{"a":1}').hexdigest()[:24]


# -- digests --------------------------------------------------------------------------------------


def test_digest_is_that_of_the_bytes() -> None:
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    expected = hashlib.sha256(b"light:torch.float32:(2, 3);" + values.tobytes()).hexdigest()
    assert content_digest({"light": torch.from_numpy(values)}) == expected


def test_digest_sees_content_and_not_layout() -> None:
    light = torch.rand(2, 4, 6, 8)
    digest = content_digest({"light": light})
    assert content_digest({"light": light.to(memory_format=torch.channels_last)}) == digest
    assert content_digest({"light": light.clone().requires_grad_()}) == digest
    one = light.clone()
    one[1, 3, 5, 7] = torch.nextafter(one[1, 3, 5, 7], torch.tensor(2.0))
    others = [
        {"light": one},
        {"dark": light},
        {"light": light.double()},
        {"light": light.reshape(2, 4, 8, 6)},
        {"light": light, "mask": light > 0.5},
        {"light": light, "mask": light > 0.6},
        {},
    ]
    assert len({digest, *map(content_digest, others)}) == 1 + len(others)


@pytest.mark.parametrize(
    "tensor",
    [torch.tensor(1.0), torch.zeros(0, 3), torch.ones(3, dtype=torch.bfloat16), torch.arange(3)],
    ids=["single", "empty", "bfloat16", "integer"],
)
def test_any_tensor_has_a_digest(tensor: torch.Tensor) -> None:
    assert content_digest({"x": tensor}) == content_digest({"x": tensor.clone()})


# -- in memory ------------------------------------------------------------------------------------


def test_the_least_recently_used_goes_first() -> None:
    cache: LruCache[str] = LruCache(3)
    for name in "abc":
        cache.put(name, name.upper(), 1)
    assert cache.get("a") == "A"  # now b is the oldest
    cache.put("d", "D", 1)
    assert [cache.get(name) for name in "abcd"] == ["A", None, "C", "D"]
    cache.put("c", "C2", 1)  # replaced, and the most recent: a is the oldest
    cache.put("e", "E", 1)
    assert [cache.get(name) for name in "acde"] == [None, "C2", "D", "E"]


def test_the_bound_holds_in_bytes() -> None:
    cache: LruCache[int] = LruCache(10)
    cache.put("a", 1, 4)
    cache.put("b", 2, 4)
    assert (len(cache), cache.nbytes) == (2, 8)
    cache.put("c", 3, 7)  # 15: a and b go
    assert (len(cache), cache.nbytes, cache.get("c")) == (1, 7, 3)
    cache.put("a", 1, 11)  # larger than all of it: not kept, and nothing goes for it
    assert (len(cache), cache.nbytes, cache.get("a")) == (1, 7, None)
    cache.put("c", 4, 2)
    assert (len(cache), cache.nbytes, cache.get("c")) == (1, 2, 4)
    cache.put("c", 5, 11)  # the old value of a key is not the value of the new one
    assert (len(cache), cache.nbytes, cache.get("c")) == (0, 0, None)
    cache.put("d", 6, 10)
    cache.clear()
    assert (len(cache), cache.nbytes, cache.get("d")) == (0, 0, None)
    nothing: LruCache[int] = LruCache(0)
    nothing.put("a", 1, 1)
    assert len(nothing) == 0


def test_the_bound_holds_in_any_order() -> None:
    """Against a plain list that does the same slowly."""
    rng = np.random.default_rng(0)
    cache: LruCache[int] = LruCache(40)
    model: list[tuple[int, int, int]] = []  # (key, value, size), the oldest first
    for step in range(2000):
        key, size = int(rng.integers(12)), int(rng.integers(1, 50))
        found = [item for item in model if item[0] == key]
        if rng.random() < 0.5:
            assert cache.get(key) == (found[0][1] if found else None)
            model = [item for item in model if item[0] != key] + found
        else:
            cache.put(key, step, size)
            model = [item for item in model if item[0] != key]
            if size <= 40:
                model.append((key, step, size))
            while sum(item[2] for item in model) > 40:
                model.pop(0)
        assert cache.nbytes == sum(item[2] for item in model) <= 40
        assert len(cache) == len(model)


def test_threads_share_it() -> None:
    cache: LruCache[int] = LruCache(50)
    errors: list[BaseException] = []

    def work(first: int) -> None:
        try:
            for i in range(4000):
                key = (first + 7 * i) % 97
                value = cache.get(key)
                assert value is None or value == key
                cache.put(key, key, 1 + key % 5)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    assert cache.nbytes <= 50
    assert cache.nbytes == sum(1 + k % 5 for k in range(97) if cache.get(k) is not None)


def test_a_copy_is_empty() -> None:
    cache: LruCache[int] = LruCache(5)
    cache.put("a", 1, 1)
    for other in (pickle.loads(pickle.dumps(cache)), copy.deepcopy(cache)):
        assert (len(other), other.nbytes, other.max_bytes) == (0, 0, 5)


@pytest.mark.parametrize("make", [LruCache, lambda size: DiskCache(max_bytes=size)])
def test_a_bound_below_zero_is_refused(make) -> None:
    with pytest.raises(ValueError, match=r"`max_bytes` \(=-1\) must be at least 0"):
        make(-1)


# -- on disk --------------------------------------------------------------------------------------


def test_what_is_read_is_what_was_written(tmp_path: Path) -> None:
    disk = DiskCache(tmp_path)
    tensors = {
        "light": torch.randn(1, 4, 5, 3).to(memory_format=torch.channels_last),
        "parts": torch.tensor([0.1, float("nan"), -0.0], dtype=torch.float64),
    }
    assert disk.get("denoised", KEYS[0]) is None
    disk.put("denoised", KEYS[0], tensors)
    found = disk.get("denoised", KEYS[0])
    assert found is not None
    assert found.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert found[name].dtype == tensor.dtype
        assert found[name].numpy().tobytes() == tensor.contiguous().numpy().tobytes()
    assert load_file(disk.path("denoised", KEYS[0])).keys() == tensors.keys()  # by another reader
    assert disk.get("denoised", KEYS[1]) is None
    assert disk.get("opened", KEYS[0]) is None


def test_unknown_kinds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"`kind` \(='pictures'\) must be one of"):
        DiskCache(tmp_path).get("pictures", KEYS[0])


@pytest.mark.parametrize("damage", ["empty", "cut", "header", "value", "folder"])
def test_damaged_files_are_as_if_not_there(
    tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    disk, tensors = DiskCache(tmp_path), {"light": torch.rand(4, 8, 8)}
    disk.put("denoised", KEYS[0], tensors)
    path = disk.path("denoised", KEYS[0])
    content = bytearray(path.read_bytes())
    if damage == "value":
        content[-2] ^= 1
    path.write_bytes(
        {"empty": b"", "cut": content[:-8], "header": b"\xff" * 64}.get(damage, content)
    )
    if damage == "folder":
        path.unlink()
        path.mkdir()
    with caplog.at_level(logging.WARNING):
        assert disk.get("denoised", KEYS[0]) is None
    assert ("cannot be read" if damage == "folder" else "is damaged") in caplog.text
    if damage != "folder":
        disk.put("denoised", KEYS[0], tensors)
        assert disk.get("denoised", KEYS[0]) is not None


def test_a_folder_that_cannot_be_written_costs_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("in the way")
    disk = DiskCache(tmp_path / "file")
    with caplog.at_level(logging.WARNING):
        for key in KEYS[:3]:
            disk.put("denoised", key, {"light": torch.zeros(4)})
            assert disk.get("denoised", key) is None
    assert len(caplog.records) == 1
    assert "could not be cached" in caplog.text
    assert disk.usage() == dict.fromkeys(CACHE_KINDS, (0, 0))


def test_a_full_disk_costs_one_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("simulator.utils.files.os.replace", full)
    with caplog.at_level(logging.WARNING):
        DiskCache(tmp_path).put("denoised", KEYS[0], {"light": torch.zeros(4)})
    assert "No space left" in caplog.text
    assert list((tmp_path / "denoised").iterdir()) == []


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_cache_is_read(tmp_path: Path) -> None:
    disk = DiskCache(tmp_path)
    disk.put("denoised", KEYS[0], {"light": torch.zeros(4)})
    folder = tmp_path / "denoised"
    folder.chmod(stat.S_IRUSR | stat.S_IXUSR)
    try:
        assert disk.get("denoised", KEYS[0]) is not None
        disk.put("denoised", KEYS[1], {"light": torch.zeros(4)})
        assert disk.get("denoised", KEYS[1]) is None
    finally:
        folder.chmod(stat.S_IRWXU)


def _age(path: Path, seconds: float) -> None:
    used = path.stat().st_mtime - seconds
    os.utime(path, (used, used))


def test_files_used_longest_ago_go_first(tmp_path: Path) -> None:
    disk = DiskCache(tmp_path, max_bytes=16_000)
    tensor = {"light": torch.zeros(700)}  # 2800 bytes and a header: five fit, six do not
    for i in range(5):
        disk.put(CACHE_KINDS[i % 3], KEYS[i], tensor)
        _age(disk.path(CACHE_KINDS[i % 3], KEYS[i]), 1000 - i)
    assert disk.get(CACHE_KINDS[0], KEYS[0]) is not None  # used just now: 1 is the oldest
    disk.put("opened", KEYS[5], tensor)
    there = [i for i in range(6) for k in CACHE_KINDS if disk.path(k, KEYS[i]).is_file()]
    assert there == [0, 2, 3, 4, 5]


def test_the_bound_on_disk_holds(tmp_path: Path) -> None:
    disk = DiskCache(tmp_path, max_bytes=20_000)
    for i, key in enumerate(KEYS):
        disk.put("denoised", key, {"light": torch.zeros(100 * (1 + i % 9))})
        assert sum(size for _, size in disk.usage().values()) <= 20_000
        assert disk.get("denoised", key) is not None
    assert disk.usage()["denoised"][0] > 4
    disk.put("denoised", KEYS[0], {"light": torch.zeros(5001)})  # 20,004 bytes
    assert sum(size for _, size in disk.usage().values()) <= 20_000
    found = DiskCache(tmp_path, max_bytes=5000)  # another run with less room
    found.put("denoised", cache_key({"another": 1}), {"light": torch.zeros(10)})
    assert sum(size for _, size in found.usage().values()) <= 5000


def test_nothing_else_is_ever_removed(tmp_path: Path) -> None:
    disk = DiskCache(tmp_path, max_bytes=4000)
    folder = tmp_path / "denoised"
    folder.mkdir()
    names = ["compact.safetensors", "notes.txt", f"{KEYS[0]}.txt", f"my-{KEYS[0]}.safetensors"]
    for path in [tmp_path / "weights.safetensors", *(folder / name for name in names)]:
        path.write_bytes(b"mine" * 2000)
        _age(path, 10_000)
    written = folder / f".{KEYS[1]}.safetensors.abc123.tmp"  # by another process, this very moment
    abandoned = folder / f".{KEYS[2]}.safetensors.abc124.tmp"
    for path in (written, abandoned):
        path.write_bytes(b"half" * 1000)
    _age(abandoned, 10_000)
    disk.put("denoised", KEYS[3], {"light": torch.zeros(10)})
    assert written.exists()
    assert not abandoned.exists()
    disk.clear()
    assert sorted(p.name for p in folder.iterdir()) == sorted(names)
    assert (tmp_path / "weights.safetensors").exists()


def test_usage_counts_files_and_bytes_by_kind(tmp_path: Path) -> None:
    disk = DiskCache(tmp_path)
    assert disk.usage() == dict.fromkeys(CACHE_KINDS, (0, 0))
    for kind, keys in (("denoised", KEYS[:3]), ("score_tables", KEYS[:1])):
        for key in keys:
            disk.put(kind, key, {"x": torch.zeros(25)})
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / f"bundled-train-64-{KEYS[0]}.safetensors").write_bytes(b"12345")
    size = disk.path("denoised", KEYS[0]).stat().st_size
    assert disk.usage() == {
        "scenes": (1, 5),
        "score_tables": (1, size),
        "denoised": (3, 3 * size),
        "defocus_maps": (0, 0),
        "opened": (0, 0),
    }
    disk.clear()
    assert disk.usage() == dict.fromkeys(CACHE_KINDS, (0, 0))
    assert list(tmp_path.iterdir()) == []


def _use(folder: Path, seed: int, rounds: int) -> None:
    """Writes and reads the same few files as other processes; fails where one is not whole."""
    disk = DiskCache(folder, max_bytes=60_000)
    rng = np.random.default_rng(seed)
    for _ in range(rounds):
        i = int(rng.integers(12))
        disk.put("denoised", KEYS[i], {"light": torch.full((2000,), float(i))})
        found = disk.get("denoised", KEYS[int(rng.integers(12))])
        if found is not None:
            assert len(set(found["light"].tolist())) == 1


def test_processes_share_a_folder(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=_use, args=(tmp_path, i, 150)) for i in range(2)]
    for process in processes:
        process.start()
    with caplog.at_level(logging.WARNING):
        _use(tmp_path, 2, 150)
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, 0]
    assert not caplog.records
    names = os.listdir(tmp_path / "denoised")
    assert not [name for name in names if name.endswith(".tmp")]
    assert sum(size for _, size in DiskCache(tmp_path).usage().values()) <= 60_000
