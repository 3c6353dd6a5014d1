"""What is kept on a disk: results in a cache, and the state of a training."""

import copy
import errno
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
from simulator.utils import checkpoint
from simulator.utils.cache import LruCache, Store, cache_dir, cache_key, content_digest
from simulator.utils.checkpoint import Checkpoint

KEYS = [cache_key("denoised", i) for i in range(64)]


VALUES = {
    "light": torch.randn(1, 4, 5, 3).to(memory_format=torch.channels_last),
    "parts": torch.tensor([0.1, float("nan"), -0.0], dtype=torch.float64),
    "states": np.arange(300).reshape(3, 100)[:, ::-1],
    "mask": np.array(True),
    "rows": [{"scene": "ä", "score": None, "regret": 0.1}],
}


def test_the_variable_names_the_folder(monkeypatch, tmp_path):
    usual, here = Path(platformdirs.user_cache_dir("ae-env")), tmp_path / "here"
    for value, expected in ((here, here), ("~/there", Path.home() / "there"), ("", usual)):
        monkeypatch.setenv("AE_ENV_CACHE", str(value))
        assert cache_dir() == expected
    assert not here.exists()
    for cache in (LruCache, lambda size: Store(tmp_path, max_bytes=size)):
        with pytest.raises(ValueError, match="`max_bytes`"):
            cache(-1)


def test_keys_depend_on_the_kind_the_parts_and_the_version(monkeypatch):
    assert cache_key("k", {"a": 1, "b": [2]}) == cache_key("k", {"b": [2], "a": 1})
    keys = {cache_key("k", parts) for parts in ({"a": 1}, {"a": 2}, {"b": 1}, {"a": [1]})}
    keys.add(cache_key("l", {"a": 1}))
    monkeypatch.setattr(cache_module, "__version__", "99.0")
    assert len(keys | {cache_key("k", {"a": 1})}) == 6


def test_digest_sees_content_and_not_layout():
    light = torch.rand(2, 4, 6, 8)
    digest = content_digest({"light": light})
    for same in (light.to(memory_format=torch.channels_last), light.clone().requires_grad_()):
        assert content_digest({"light": same}) == digest
    one = light.clone()
    one[1, 3, 5, 7] = torch.nextafter(one[1, 3, 5, 7], torch.tensor(2.0))
    others = [{"light": one}, {"dark": light}, {"light": light, "mask": light > 0.5}, {}]
    changed = light.double(), light.reshape(2, 4, 8, 6), torch.tensor(1.0), torch.zeros(0, 3)
    others += [{"light": each} for each in (*changed, torch.ones(3, dtype=torch.bfloat16))]
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


def same(found: dict[str, Any] | None, expected: dict[str, Any] = VALUES) -> bool:
    """Whether values came back with their types, to the bit: NaN and -0.0 as well."""
    if found is None or found.keys() != expected.keys():
        return False
    for name, value in expected.items():
        if type(found[name]) is not type(value):
            return False
        if isinstance(value, torch.Tensor | np.ndarray):
            one, other = np.asarray(value), np.asarray(found[name])
            if (one.dtype, one.shape, one.tobytes()) != (other.dtype, other.shape, other.tobytes()):
                return False
        elif found[name] != value:
            return False
    return True


def test_what_is_read_is_what_was_written(tmp_path):
    store = Store(tmp_path)
    assert store.get(KEYS[0]) is None
    store.put(KEYS[0], VALUES)
    assert same(store.get(KEYS[0]))
    assert load_file(store.path(KEYS[0])).keys() == VALUES.keys() - {"rows"}  # by others, too
    assert store.get(KEYS[1]) is None
    assert store.get(KEYS[0].replace("denoised", "opened")) is None
    store.put(KEYS[2], {"seconds": 1.5})
    assert store.get(KEYS[2]) == {"seconds": 1.5}
    with pytest.raises(TypeError):  # no pickles
        store.put(KEYS[3], {"objects": np.array([object()])})


def test_damaged_files_are_as_if_not_there(tmp_path, caplog):
    """Bytes changed, cut off, or put in: a result is read whole, or not at all."""
    store, rng = Store(tmp_path), np.random.default_rng(0)
    path = store.path(KEYS[0])
    store.put(KEYS[0], VALUES)
    good = path.read_bytes()
    damaged = [b"", good[:-8], good[: len(good) // 2], good[10:], b"\xff" * 64]
    damaged.append(save({"light": torch.rand(4)}))  # of somebody else
    for content in damaged:
        path.write_bytes(content)
        caplog.clear()
        assert store.get(KEYS[0]) is None
        assert f"{path} is damaged" in caplog.text
    for _ in range(600):
        changed = bytearray(good)
        for position in rng.integers(len(good), size=rng.integers(1, 4)):
            changed[position] ^= int(rng.integers(1, 256))
        path.write_bytes(changed)
        found = store.get(KEYS[0])
        assert found is None or same(found)  # some bytes decide nothing, such as a space
    store.put(KEYS[0], VALUES)
    assert same(store.get(KEYS[0]))
    path.unlink()
    path.mkdir()
    assert store.get(KEYS[0]) is None
    assert "cannot be read" in caplog.text


@pytest.mark.parametrize("folder", ["file", "x" * 300, "loop", "full"])
def test_a_folder_that_cannot_be_used_costs_one_warning(tmp_path, folder, caplog, monkeypatch):
    if folder == "full":
        error = OSError(errno.ENOSPC, "No space left on device")
        monkeypatch.setattr("simulator.utils.files.os.replace", Mock(side_effect=error))
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for key in KEYS[:3]:  # every environment has a store of its own
        store = Store(tmp_path / folder)
        store.put(key, {"light": torch.zeros(4)})
        assert store.get(key) is None
    messages = {record.getMessage() for record in caplog.records}
    assert len(messages) == len(caplog.records) <= 2  # once for reading, once for writing
    assert any("could not be stored" in message for message in messages)
    assert not list(tmp_path.rglob("*.tmp"))
    assert store.usage() == {}
    store.clear()


def test_the_bound_holds_and_what_was_used_longest_ago_goes_first(tmp_path):
    store = Store(tmp_path / "order", max_bytes=16_500)
    values = {"light": torch.zeros(700)}  # 2800 bytes and a header: five fit, six do not
    keys = [cache_key(kind, i) for i, kind in enumerate(["scenes", "denoised", "opened"] * 2)]
    for i, key in enumerate(keys[:5]):
        store.put(key, values)
        os.utime(store.path(key), (1e9 + i, 1e9 + i))
    assert store.get(keys[0]) is not None  # used just now: 1 is the oldest
    store.put(keys[5], values)
    assert [i for i, key in enumerate(keys) if store.path(key).is_file()] == [0, 2, 3, 4, 5]
    store = Store(tmp_path, max_bytes=20_000)
    for i, key in enumerate(KEYS):
        store.put(key, {"light": torch.zeros(100 * (1 + i % 9))})
        assert store.usage()["denoised"][1] <= 20_000
        assert store.get(key) is not None
    assert store.usage()["denoised"][0] > 4
    store.put(KEYS[0], {"light": torch.zeros(5001)})  # 20,004 bytes
    assert store.usage()["denoised"][1] <= 20_000
    smaller = Store(tmp_path, max_bytes=5000)  # another run with less room
    smaller.put(cache_key("denoised", "another"), {"light": torch.zeros(10)})
    assert smaller.usage()["denoised"][1] <= 5000


def test_nothing_else_is_ever_removed(tmp_path):
    store = Store(tmp_path, max_bytes=6000)
    folder, stems = tmp_path / "denoised", [key.partition("/")[2] for key in KEYS]
    folder.mkdir()
    names = ["compact.safetensors", "notes.txt", f"{stems[0]}.txt", f"my-{stems[0]}.safetensors"]
    for path in [tmp_path / "weights.safetensors", *(folder / name for name in names)]:
        path.write_bytes(b"mine" * 2000)
        os.utime(path, (1e9, 1e9))
    written = folder / f".{stems[1]}.safetensors.abc123.tmp"  # by another process, this very moment
    abandoned = folder / f".{stems[2]}.safetensors.abc124.tmp"
    for path in (written, abandoned):
        path.write_bytes(b"half" * 1000)
    os.utime(abandoned, (1e9, 1e9))
    other = cache_key("opened", 3)
    store.put(KEYS[3], {"light": torch.zeros(10)})
    assert (written.exists(), abandoned.exists()) == (True, False)
    store.put(other, {"x": torch.zeros(1)})
    sizes = [store.path(key).stat().st_size for key in (KEYS[3], other)]
    assert store.usage() == {"denoised": (2, 4000 + sizes[0]), "opened": (1, sizes[1])}
    store.clear()
    assert store.usage() == {}
    assert not (tmp_path / "opened").exists()
    assert sorted(p.name for p in folder.iterdir()) == sorted(names)
    assert (tmp_path / "weights.safetensors").exists()


def _use(folder: Path, seed: int, ready: Any) -> None:
    """Writes and reads the same few files as another process; fails where one is not whole."""
    store, rng = Store(folder, max_bytes=60_000), np.random.default_rng(seed)
    ready.wait(timeout=120)
    for _ in range(60):
        i = int(rng.integers(12))
        store.put(KEYS[i], {"light": torch.full((2000,), float(i))})
        found = store.get(KEYS[int(rng.integers(12))])
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
    assert sum(size for _, size in Store(tmp_path).usage().values()) <= 60_000


def made(path: Path | None, identity: Any = "a", **values: Any) -> Checkpoint:
    return Checkpoint(path, identity, lambda: {"step": 7, **values})


def test_it_saves_when_it_is_due_and_at_the_end(tmp_path, monkeypatch):
    path, now = tmp_path / "run", 100.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    own = made(path)
    for seconds, due in ((checkpoint.INTERVAL, False), (1.0, True), (0.0, False)):
        now += seconds
        own.save_when_due()
        assert path.exists() == due
        path.unlink(missing_ok=True)
    with own:  # at the end
        assert not path.exists()
    assert path.exists()
    path.unlink()
    with made(None) as nowhere, Checkpoint(path, "a", dict, writes=False) as silent:
        assert nowhere.load() is silent.load() is None
    assert not path.exists()


def test_a_full_disk_stops_no_training(tmp_path, monkeypatch, caplog):
    path = tmp_path / "run"
    made(path, step=1).save()
    error = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr("simulator.utils.files.os.replace", Mock(side_effect=error))
    made(path, step=2).save()
    assert "not saved" in caplog.text
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
    assert made(path).load() == {"step": 1}


@pytest.mark.parametrize(
    ("error", "kept"), [(KeyboardInterrupt, True), (SystemExit, True), (ValueError, False)]
)
def test_what_ends_a_training_decides_whether_its_state_is_kept(error, kept, tmp_path):
    with pytest.raises(error), made(tmp_path / "run"):
        raise error
    assert (tmp_path / "run").exists() == kept


class Harm:
    """Would run code on unpickling."""

    def __reduce__(self) -> Any:
        return Path.touch, (Path("harmed"),)


def test_damaged_or_foreign(tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "run"
    made(path, weight=torch.ones(1000)).save()
    good, files = path.read_bytes(), []
    middle = len(good) // 2  # the weights are by far the largest part
    flipped = good[:middle] + bytes([good[middle] ^ 1]) + good[middle + 1 :]
    for content in ([1, 2], {"identity": Harm()}):
        torch.save(content, path)
        files.append(path.read_bytes())
    foreign = save({"weight": torch.zeros(2)})
    for damaged in (good[:-50], b"not a checkpoint at all", b"", foreign, flipped, *files):
        path.write_bytes(damaged)
        caplog.clear()
        assert made(path).load() is None
        assert f"{path} is damaged, training restarts" in caplog.text
    assert not (tmp_path / "harmed").exists()


def test_another_training_or_version(tmp_path, monkeypatch, caplog):
    path = tmp_path / "run"
    made(path, {"seed": 0}).save()
    assert made(path, {"seed": 0}).load() == {"step": 7}
    assert made(path, {"seed": 1}).load() is None
    monkeypatch.setattr(checkpoint, "__version__", "77")
    assert made(path, {"seed": 0}).load() is None
    assert caplog.text.count("training restarts") == 2
