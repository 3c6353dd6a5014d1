import copy
import errno
import hashlib
import multiprocessing
import os
import pickle
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import platformdirs
import pytest
import torch
from safetensors.torch import load_file, save

from simulator.utils import cache as cache_module
from simulator.utils.cache import (
    CACHE_KINDS,
    DiskCache,
    LruCache,
    cache_dir,
    cache_key,
    content_digest,
)

KEYS = [cache_key({"i": i}) for i in range(64)]


def test_the_variable_names_the_folder(monkeypatch, tmp_path):
    usual, here = Path(platformdirs.user_cache_dir("ae-env")), tmp_path / "here"
    for value, expected in ((here, here), ("~/there", Path.home() / "there"), ("", usual)):
        monkeypatch.setenv("AE_ENV_CACHE", str(value))
        assert cache_dir() == expected
    assert not here.exists()
    for cache in (LruCache, lambda size: DiskCache(max_bytes=size)):
        with pytest.raises(ValueError, match=r"`max_bytes` \(=-1\) must be at least 0"):
            cache(-1)


def test_keys_depend_on_names_values_and_the_version(monkeypatch):
    assert cache_key({"a": 1, "b": [2]}) == cache_key({"b": [2], "a": 1})
    keys = {cache_key(parts) for parts in ({"a": 1}, {"a": 2}, {"b": 1}, {"a": [1]})}
    monkeypatch.setattr(cache_module, "package_version", lambda: "99.0")
    assert len(keys | {cache_key({"a": 1})}) == 5
    text = b'{"package":"99.0","parts":{"a":1}}'
    assert cache_key({"a": 1}) == hashlib.sha256(text).hexdigest()[:24]


def test_digest_sees_content_and_not_layout():
    light = torch.rand(2, 4, 6, 8)
    digest = content_digest({"light": light})
    expected = b"light:torch.float32:(2, 4, 6, 8);" + light.numpy().tobytes()
    assert digest == hashlib.sha256(expected).hexdigest()
    for same in (light.to(memory_format=torch.channels_last), light.clone().requires_grad_()):
        assert content_digest({"light": same}) == digest
    one = light.clone()
    one[1, 3, 5, 7] = torch.nextafter(one[1, 3, 5, 7], torch.tensor(2.0))
    others = [
        {"light": one},
        {"dark": light},
        {"light": light.double()},
        {"light": light.reshape(2, 4, 8, 6)},
        {"light": light, "mask": light > 0.5},
        {},
        {"light": torch.tensor(1.0)},
        {"light": torch.zeros(0, 3)},
        {"light": torch.ones(3, dtype=torch.bfloat16)},
    ]
    assert len({digest, *map(content_digest, others)}) == 1 + len(others)


def test_the_least_recently_used_goes_first():
    """Against a plain dict that does the same slowly."""
    rng, cache = np.random.default_rng(0), LruCache(40)
    model: dict[int, tuple[int, int]] = {}  # value and size by key, the oldest first
    for step in range(2000):
        key, size = int(rng.integers(12)), int(rng.integers(1, 50))
        item = model.pop(key, None)
        if rng.random() < 0.5:
            assert cache.get(key) == (item[0] if item else None)
        else:
            cache.put(key, step, size)
            item = (step, size) if size <= 40 else None
        model |= {key: item} if item else {}
        while sum(size for _, size in model.values()) > 40:
            del model[next(iter(model))]
        assert (len(cache), cache.nbytes) == (len(model), sum(size for _, size in model.values()))
    for other in (pickle.loads(pickle.dumps(cache)), copy.deepcopy(cache)):
        assert (len(other), other.nbytes, other.max_bytes) == (0, 0, 40)
    cache.clear()
    assert (len(cache), cache.nbytes, cache.get(0)) == (0, 0, None)


def test_what_is_read_is_what_was_written(tmp_path):
    disk = DiskCache(tmp_path)
    tensors = {
        "light": torch.randn(1, 4, 5, 3).to(memory_format=torch.channels_last),
        "parts": torch.tensor([0.1, float("nan"), -0.0], dtype=torch.float64),
    }
    assert disk.get("denoised", KEYS[0]) is None
    disk.put("denoised", KEYS[0], tensors)
    for found in (disk.get("denoised", KEYS[0]), load_file(disk.path("denoised", KEYS[0]))):
        assert content_digest(found) == content_digest(tensors)  # to the bit: NaN and -0.0
    assert disk.get("denoised", KEYS[1]) is None
    assert disk.get("opened", KEYS[0]) is None
    with pytest.raises(ValueError, match=r"`kind` \(='pictures'\) must be one of"):
        disk.get("pictures", KEYS[0])


def test_damaged_files_are_as_if_not_there(tmp_path, caplog):
    disk, tensors = DiskCache(tmp_path), {"light": torch.rand(4, 8, 8)}
    disk.put("denoised", KEYS[0], tensors)
    path = disk.path("denoised", KEYS[0])
    good = path.read_bytes()
    flipped = good[:-1] + bytes([good[-1] ^ 1])
    for damaged in (b"", good[:-8], b"\xff" * 64, flipped, save(tensors)):
        path.write_bytes(damaged)
        caplog.clear()
        assert disk.get("denoised", KEYS[0]) is None
        assert f"cached file {path} is damaged" in caplog.text
        disk.put("denoised", KEYS[0], tensors)
        assert disk.get("denoised", KEYS[0]) is not None
    path.unlink()
    path.mkdir()
    assert disk.get("denoised", KEYS[0]) is None
    assert "cannot be read" in caplog.text


@pytest.mark.parametrize("folder", ["file", "x" * 300, "loop", "full"])
def test_a_folder_that_cannot_be_used_costs_one_warning(tmp_path, folder, caplog, monkeypatch):
    if folder == "full":
        error = OSError(errno.ENOSPC, "No space left on device")
        monkeypatch.setattr("simulator.utils.files.os.replace", Mock(side_effect=error))
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for key in KEYS[:3]:  # every environment has a cache of its own
        disk = DiskCache(tmp_path / folder)
        disk.put("denoised", key, {"light": torch.zeros(4)})
        assert disk.get("denoised", key) is None
    messages = {record.getMessage() for record in caplog.records}
    assert len(messages) == len(caplog.records) <= 2  # once for reading, once for writing
    assert any("could not be cached" in message for message in messages)
    assert not list(tmp_path.rglob("*.tmp"))
    assert disk.usage() == dict.fromkeys(CACHE_KINDS, (0, 0))
    disk.clear()


def test_the_bound_on_disk_holds_and_what_was_used_longest_ago_goes_first(tmp_path):
    disk = DiskCache(tmp_path / "order", max_bytes=16_000)
    tensor = {"light": torch.zeros(700)}  # 2800 bytes and a header: five fit, six do not
    for i in range(5):
        disk.put(CACHE_KINDS[i % 3], KEYS[i], tensor)
        os.utime(disk.path(CACHE_KINDS[i % 3], KEYS[i]), (1e9 + i, 1e9 + i))
    assert disk.get(CACHE_KINDS[0], KEYS[0]) is not None  # used just now: 1 is the oldest
    disk.put("opened", KEYS[5], tensor)
    there = [i for i in range(6) for k in CACHE_KINDS if disk.path(k, KEYS[i]).is_file()]
    assert there == [0, 2, 3, 4, 5]
    disk = DiskCache(tmp_path, max_bytes=20_000)
    for i, key in enumerate(KEYS):
        disk.put("denoised", key, {"light": torch.zeros(100 * (1 + i % 9))})
        assert disk.usage()["denoised"][1] <= 20_000
        assert disk.get("denoised", key) is not None
    assert disk.usage()["denoised"][0] > 4
    disk.put("denoised", KEYS[0], {"light": torch.zeros(5001)})  # 20,004 bytes
    assert disk.usage()["denoised"][1] <= 20_000
    found = DiskCache(tmp_path, max_bytes=5000)  # another run with less room
    found.put("denoised", cache_key({"another": 1}), {"light": torch.zeros(10)})
    assert found.usage()["denoised"][1] <= 5000


def test_nothing_else_is_ever_removed(tmp_path):
    disk = DiskCache(tmp_path, max_bytes=6000)
    folder = tmp_path / "denoised"
    folder.mkdir()
    names = ["compact.safetensors", "notes.txt", f"{KEYS[0]}.txt", f"my-{KEYS[0]}.safetensors"]
    for path in [tmp_path / "weights.safetensors", *(folder / name for name in names)]:
        path.write_bytes(b"mine" * 2000)
        os.utime(path, (1e9, 1e9))
    written = folder / f".{KEYS[1]}.safetensors.abc123.tmp"  # by another process, this very moment
    abandoned = folder / f".{KEYS[2]}.safetensors.abc124.tmp"
    for path in (written, abandoned):
        path.write_bytes(b"half" * 1000)
    os.utime(abandoned, (1e9, 1e9))
    disk.put("denoised", KEYS[3], {"light": torch.zeros(10)})
    assert (written.exists(), abandoned.exists()) == (True, False)
    disk.put("opened", KEYS[3], {"x": torch.zeros(1)})
    sizes = [disk.path(kind, KEYS[3]).stat().st_size for kind in ("denoised", "opened")]
    expected = {"denoised": (2, 4000 + sizes[0]), "opened": (1, sizes[1])}
    assert disk.usage() == dict.fromkeys(CACHE_KINDS, (0, 0)) | expected
    disk.clear()
    assert disk.usage() == dict.fromkeys(CACHE_KINDS, (0, 0))
    assert not (tmp_path / "opened").exists()
    assert sorted(p.name for p in folder.iterdir()) == sorted(names)
    assert (tmp_path / "weights.safetensors").exists()


def _use(folder: Path, seed: int, ready: Any) -> None:
    """Writes and reads the same few files as another process; fails where one is not whole."""
    disk, rng = DiskCache(folder, max_bytes=60_000), np.random.default_rng(seed)
    ready.wait(timeout=120)
    for _ in range(60):
        i = int(rng.integers(12))
        disk.put("denoised", KEYS[i], {"light": torch.full((2000,), float(i))})
        found = disk.get("denoised", KEYS[int(rng.integers(12))])
        if found is not None:
            assert len(set(found["light"].tolist())) == 1


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # forking a process that has threads
def test_processes_share_a_folder(tmp_path, caplog):
    context = multiprocessing.get_context("fork")
    ready = context.Barrier(2)
    process = context.Process(target=_use, args=(tmp_path, 1, ready))
    process.start()
    _use(tmp_path, 2, ready)
    process.join()
    assert process.exitcode == 0
    assert not caplog.records
    assert not list(tmp_path.rglob("*.tmp"))
    assert sum(size for _, size in DiskCache(tmp_path).usage().values()) <= 60_000
