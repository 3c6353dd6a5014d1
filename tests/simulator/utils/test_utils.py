"""What is kept on a disk: files, configurations, a cache, trainings; kernels, threads and tiles."""

import errno
import json
import logging
import os
import pickle
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import platformdirs
import pytest
import torch
import torch.nn.functional as F
from numba.core import caching
from pydantic import Field
from safetensors.torch import load_file, save

from simulator import camera_simulator
from simulator.networks.aperture_module import DefocusMap
from simulator.networks.noise_module import SIZES, NoiseModule
from simulator.utils import cache as cache_module
from simulator.utils import checkpoint
from simulator.utils import compute as jit
from simulator.utils.cache import LruCache, Store, cache_dir, cache_key, content_digest
from simulator.utils.checkpoint import Checkpoint
from simulator.utils.compute import kernel, parallel_ranges
from simulator.utils.config_file import Configuration, load_yaml, read_yaml
from simulator.utils.files import data_folder, write_atomically, write_results
from simulator.utils.tiles import in_tiles, varying


@pytest.mark.parametrize("content", [b"\x00\xffraw", "Grüße ☀", b"", ""])
@pytest.mark.parametrize("name", ["file", "y" * 246 + ".dng", "\u5b57" * 84 + ".d"])
def test_content_comes_back(tmp_path, content, name):
    deep = tmp_path / "a" / "b" / name  # folders are made and files replaced
    assert write_atomically(str(deep), content) == deep
    assert deep.read_bytes() == (content.encode() if isinstance(content, str) else content)
    write_atomically(deep, (memoryview(b"ab" * i) for i in range(3)))
    assert deep.read_bytes() == b"ababab"
    (link := tmp_path / "link").symlink_to(deep.relative_to(tmp_path))
    assert write_atomically(link, "through a link") == link
    assert (link.is_symlink(), deep.read_text()) == (True, "through a link")
    assert list(deep.parent.iterdir()) == [deep]
    (loop := tmp_path / "loop").symlink_to(loop)
    with pytest.raises(OSError, match=r"`path` .* cannot be written"):
        write_atomically(loop, "nowhere")


@pytest.mark.parametrize("fault", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left")])
def test_a_crash_leaves_the_old_content(tmp_path, fault):
    path = write_atomically(tmp_path / "file", "old")

    def pieces():
        yield b"half of it"
        raise fault

    with pytest.raises(type(fault)):
        write_atomically(path, pieces())
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_targets_that_cannot_be_written_and_permissions(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("x")
    targets = [tmp_path / "folder", tmp_path / "file" / "below", tmp_path / ("x" * 300)]
    for target in targets:
        with pytest.raises(OSError, match=f"`path` .*{target}"):
            write_atomically(target, "x")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]
    written, ordinary = write_atomically(targets[0] / "a", "x"), tmp_path / "file"
    assert written.stat().st_mode == ordinary.stat().st_mode


def test_the_folders_of_real_files_and_of_the_cache(tmp_path, monkeypatch):
    beside = Path(__file__).resolve().parents[4] / "shared" / "data"
    unset = beside if beside.is_dir() else None
    for value, expected in ((tmp_path, tmp_path), ("", unset)):
        monkeypatch.setenv("AE_ENV_DATA", str(value))
        assert data_folder() == expected
    monkeypatch.setenv("AE_ENV_DATA", str(tmp_path / "none"))
    with pytest.raises(FileNotFoundError, match="AE_ENV_DATA"):
        data_folder()
    monkeypatch.delenv("AE_ENV_DATA")
    assert data_folder() == unset
    usual, here = Path(platformdirs.user_cache_dir("ae-env")), tmp_path / "here"
    for value, expected in ((here, here), ("~/there", Path.home() / "there"), ("", usual)):
        monkeypatch.setenv("AE_ENV_CACHE", str(value))
        assert cache_dir() == expected
    assert not here.exists()


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


class Part(Configuration):
    steps: int = Field(ge=1)


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
    # Names of our own are no code.
    text = "[bundled:snow, matrix:P, 'recorded:my_grid?iso=100', ppo:video, a.dng, 'x.yaml', '1:2',"
    (tmp_path / "a.yaml").write_text(text + " 'test: outdoor', 'time: tunnel', 'http://a']")
    assert len(read_yaml(tmp_path / "a.yaml")) == 10
    for name in ("none.yaml", ".", "x" * 5000):
        with pytest.raises(ValueError, match="`preset`"):
            read_yaml(tmp_path / name, name="preset")


@pytest.mark.parametrize(
    "text",
    [
        *("scorer: their/evil.py:X", "scorer: {noise: 0.5, '~/evil.py:X': 0.5}", "a: evil.py"),
        *(
            "scenes: json.tool:attr",
            "policies: [matrix:P, 'evil.py:Mine?gain=2']",
            "scenes: json:x",
        ),
        # What loads a module runs it before it looks for the name in it.
        *("a: evil.py:1", "a: evil.py:\u00e9", "a: 'json:X-v0'", 'a: "a\\nb/evil.py:X"'),
        *("a: !!binary ZXZpbC5weTpY", "a: !!set {evil.py:X: }", "a: !!pairs [b: evil.py:X]"),
    ],
)
def test_code_in_a_file_needs_trust(tmp_path, monkeypatch, text):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"`config` .*a\.yaml.* --trust"):
        read_yaml(tmp_path / "a.yaml")
    for trusted in (str(tmp_path), f"/nowhere:{tmp_path.parent}", "all"):
        monkeypatch.setenv("AE_ENV_TRUST", trusted)
        assert read_yaml(tmp_path / "a.yaml")


#: Few bytes that stand for 2^59 values.
DOUBLED = "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 60))


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("name: x\npart: {steps: 0}", ["part.steps (=0)", "greater than or equal to 1"]),
        ("name: x\npart: {stesp: 2}", ["part.stesp (=2): unknown", "did you mean `steps`?"]),
        ("", ["is empty: it must map entries to values; known entries: name, part, parts"]),
        ("name: x\npart: {steps: 2}\nname: y", ["): the entry 'name' is given twice, again in"]),
        ("name: " + "[" * 10**6, ["nested too deeply"]),
        ("- a\n" * 2**18, ["holds more than 65536 values"]),
        ("a: 0x" + "f" * 9999, ["one of more than 2048 characters"]),  # no text of decimals
        (DOUBLED, ["aliases stand for more than"]),
        ("name: &a {x: 1}\nb: {<<: [*a, *a]}", ["`<<` merges one mapping"]),
        ("name: !!python/object/apply:os.getcwd []", ["is not YAML"]),  # nothing is executed
    ],
)
def test_errors_name_file_and_entry_in_one_line(tmp_path, text, parts):
    with pytest.raises(ValueError) as caught:
        load(tmp_path, text)
    message = str(caught.value)
    assert message.startswith(f"`config` (={str(tmp_path / 'a.yaml')!r})")
    assert "\n" not in message
    assert [part for part in parts if part not in message] == []


KEYS = [cache_key("denoised", i) for i in range(64)]
VALUES = {
    "light": torch.randn(1, 4, 5, 3).to(memory_format=torch.channels_last),
    "parts": torch.tensor([0.1, float("nan"), -0.0], dtype=torch.float64),
    "states": np.arange(300).reshape(3, 100)[:, ::-1],
    "mask": np.array(True),
    "rows": [{"scene": "ä", "score": None, "regret": 0.1}],
}


def test_what_keys_and_digests_depend_on(monkeypatch):
    assert cache_key("k", {"a": 1, "b": [2]}) == cache_key("k", {"b": [2], "a": 1})
    keys = {cache_key("k", parts) for parts in ({"a": 1}, {"a": 2}, {"b": 1}, {"a": [1]})}
    keys.add(cache_key("l", {"a": 1}))
    monkeypatch.setattr(cache_module, "__version__", "99.0")
    assert len(keys | {cache_key("k", {"a": 1})}) == 6
    # A digest sees content and not layout.
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
    other = pickle.loads(pickle.dumps(cache))
    assert (len(other), other.nbytes, other.max_bytes) == (0, 0, 40)
    cache.clear()
    assert (len(cache), cache.nbytes, cache.get(0)) == (0, 0, None)


def bits(values):
    """Values with their types, to the bit: NaN and -0.0 as well."""
    arrays = (torch.Tensor, np.ndarray)
    return values and {
        name: (type(v), np.asarray(v).dtype, np.shape(v), np.asarray(v).tobytes())
        if isinstance(v, arrays)
        else v
        for name, v in values.items()
    }


def test_what_is_read_is_what_was_written(tmp_path):
    store = Store(tmp_path)
    assert store.get(KEYS[0]) is None
    store.put(KEYS[0], VALUES)
    assert bits(store.get(KEYS[0])) == bits(VALUES)
    assert load_file(store.path(KEYS[0])).keys() == VALUES.keys() - {"rows"}  # by others, too
    assert store.get(KEYS[1]) is store.get(KEYS[0].replace("denoised", "opened")) is None
    with pytest.raises(TypeError):  # no pickles
        store.put(KEYS[3], {"objects": np.array([object()])})


def test_damaged_files_are_as_if_not_there(tmp_path, caplog):
    store = Store(tmp_path)
    path = store.path(KEYS[0])
    store.put(KEYS[0], VALUES)
    good = path.read_bytes()
    for content in (b"", good[:-8], save({"light": torch.rand(4)})):  # the last is somebody else's
        path.write_bytes(content)
        caplog.clear()
        assert store.get(KEYS[0]) is None
        assert f"{path} is damaged" in caplog.text
    for place in range(0, len(good), 30):  # some bytes decide nothing, such as a space
        path.write_bytes(good[:place] + bytes([good[place] ^ 1]) + good[place + 1 :])
        found = store.get(KEYS[0])
        assert found is None or bits(found) == bits(VALUES)
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
        store = Store(tmp_path / folder, max_bytes=10**6)
        store.put(key, {"light": torch.zeros(4)})
        assert store.get(key) is None
    messages = {record.getMessage() for record in caplog.records}
    assert len(messages) == len(caplog.records) <= 2  # once for reading, once for writing
    assert any("could not be stored" in message for message in messages)
    with pytest.raises(OSError, match=r"`path` .* cannot be written"):  # what a run needs
        Store(tmp_path / folder).put(KEYS[0], {"light": torch.zeros(4)})
    assert not list(tmp_path.rglob("*.tmp"))
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
    store.put(KEYS[0], {"light": torch.zeros(5001)})  # more than all may have
    assert sum(size for _, size in store.usage().values()) <= 16_500


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


def test_writers_share_a_folder(tmp_path, caplog):
    def use(seed: int) -> None:
        store, rng = Store(tmp_path, max_bytes=60_000), np.random.default_rng(seed)
        for _ in range(60):
            i = int(rng.integers(12))
            store.put(KEYS[i], {"light": torch.full((2000,), float(i))})
            found = store.get(KEYS[int(rng.integers(12))])
            assert found is None or len(set(found["light"].tolist())) == 1

    with ThreadPoolExecutor(3) as pool:
        list(pool.map(use, range(3)))
    assert not caplog.records
    assert not list(tmp_path.rglob("*.tmp"))
    assert sum(size for _, size in Store(tmp_path).usage().values()) <= 60_000


def made(path, identity="a", **values):
    return Checkpoint(path, identity, lambda: {"step": 7, **values})


def test_it_saves_when_it_is_due_at_the_end_and_on_a_full_disk_not(tmp_path, monkeypatch, caplog):
    path, now = tmp_path / "run", 100.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    own = made(path)
    for seconds, due in ((checkpoint.INTERVAL, False), (1.0, True), (0.0, False)):
        now += seconds
        own.save_when_due()
        assert path.exists() == due
        path.unlink(missing_ok=True)
    for error, kept in ((KeyboardInterrupt, True), (SystemExit, True), (ValueError, False)):
        with pytest.raises(error), own:
            raise error
        assert path.exists() == kept
        path.unlink(missing_ok=True)
    with made(None) as nowhere, Checkpoint(path, "a", dict, writes=False) as silent:
        assert nowhere.load() is silent.load() is None
    assert not path.exists()
    with own:  # at the end
        pass
    assert made(path).load() == {"step": 7}
    error = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr("simulator.utils.files.os.replace", Mock(side_effect=error))
    made(path, step=2).save()
    assert "not saved" in caplog.text
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
    assert made(path).load() == {"step": 7}


def test_a_state_that_is_damaged_foreign_or_of_another_version(tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "run"
    made(path, weight=torch.ones(1000)).save()
    good = path.read_bytes()
    path.write_bytes(good[:-50])
    assert made(path).load() is None
    assert f"{path} is damaged, training restarts" in caplog.text
    path.write_bytes(good)
    assert made(path, {"seed": 1}).load() is None
    monkeypatch.setattr(checkpoint, "__version__", "77")
    assert made(path).load() is None
    assert caplog.text.count("training restarts") == 3


# -- kernels, threads and tiles --------------------------------------------------------------------


def add(a: int, b: int) -> int:
    return a + b


def test_kernels_run_without_the_lock_and_where_they_cannot_be_cached(monkeypatch, caplog):
    assert kernel()(add).targetoptions["nogil"]
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    with caplog.at_level(logging.INFO, "simulator.utils.compute"):
        assert kernel()(add)(1, 2) == 3
    assert "compiled again in each process" in caplog.text


def test_a_kernel_is_stale_when_a_module_changes_that_it_depends_on(tmp_path, monkeypatch):
    """Numba itself would run the kernel that it compiled with a constant's old value."""
    monkeypatch.setattr(jit, "_ROOT", tmp_path)
    texts = {
        "ae_env/kernels.py": "from ae_env import (\n    middle,\n)\nimport numpy",
        "ae_env/middle.py": "    from simulator.constants import FACTOR",
        "simulator/constants.py": "FACTOR = 2.0",
        "simulator/others.py": "no kernel depends on it",
    }
    checksums = []
    for change in ("", *texts):
        for name, text in texts.items():
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).write_text(text + " # changed" * (name == change))
        jit._read.cache_clear()
        checksums.append(jit._checksum.__wrapped__(tmp_path / "ae_env/kernels.py"))
    assert checksums[-1] == checksums[0]
    assert len(set(checksums)) == 4
    monkeypatch.undo()
    stamp = kernel()(add)._cache._cache_file._source_stamp
    assert stamp[1] == jit._checksum(Path(__file__))


@pytest.mark.parametrize(("count", "threads"), [(0, 3), (1, 3), (2, 8), (7, 1), (7, 3)])
def test_every_item_is_done_once(count, threads):
    done: list[int] = []

    def task(a: int, b: int) -> None:  # a task may ask for shares itself
        parallel_ranges(lambda c, d: done.extend(range(a + c, a + d)), b - a, threads=2)

    parallel_ranges(task, count, threads=threads)
    assert sorted(done) == [*range(count)]


def test_pieces_are_contiguous_and_run_at_the_same_time():
    barrier, pieces = threading.Barrier(3, timeout=30), []

    def task(first: int, last: int) -> None:
        barrier.wait()  # passes only if all three are under way
        pieces.append((first, last))

    parallel_ranges(task, 48, threads=3)
    assert sorted(pieces) == [(first, first + 2) for first in range(0, 48, 2)]
    names = []  # little work stays on the caller's thread
    parallel_ranges(lambda *_: names.append(threading.current_thread()), 5, least=3, threads=4)
    assert names == [threading.current_thread()]


@pytest.mark.parametrize("bad", [0, 3])
def test_errors_of_any_piece_are_raised_once_the_others_under_way_are_done(bad):
    begun, done = [], [bad]

    def task(first: int, last: int) -> None:
        begun.append(first)
        if first == bad:
            raise ValueError(f"piece {first}")
        time.sleep(0.01)
        done.append(first)

    with pytest.raises(ValueError, match=f"piece {bad}"):
        parallel_ranges(task, 6, threads=2)
    assert sorted(done) == sorted(begun)


def frame(*size, seed=0):
    return torch.rand(1, 4, *size, generator=torch.Generator().manual_seed(seed))


def mean_of_neighbours(*images):
    """Sees 2 pixels far, and the position modulo 4."""
    total = F.avg_pool2d(F.pad(sum(images), (2,) * 4), 5, stride=1)
    rows = torch.arange(total.shape[-2])[:, None] % 4
    return total * (1 + rows) + torch.arange(total.shape[-1]) % 4


@pytest.mark.parametrize("size", [(1, 1), (12, 16), (16, 17), (5, 93), (93, 5), (61, 203)])
@pytest.mark.parametrize("tile", [12, 64, 512])
def test_tiles_of_a_function_of_neighbourhood_and_phase(size, tile):
    """Everywhere; and where only some pixels are needed, the fallback elsewhere."""
    image, other = frame(*size), frame(*size, seed=1)
    whole, needed = mean_of_neighbours(image, other), torch.zeros(size, dtype=torch.bool)
    needed[:9, :21] = needed[-5:, -30:] = needed[size[0] // 2, size[1] // 3] = True
    tiled = in_tiles(mean_of_neighbours, image, other, halo=4, tile=tile)
    torch.testing.assert_close(tiled, whole, rtol=0, atol=1e-6)
    options = {"tile": tile, "needed": needed, "fallback": -image}
    some = in_tiles(mean_of_neighbours, image, other, halo=4, **options)
    torch.testing.assert_close(some, torch.where(needed, whole, -image), rtol=0, atol=1e-6)
    assert torch.equal(in_tiles(lambda x: x.sum(1), image, halo=4, tile=8), image.sum(1))


def test_no_tile_is_larger_than_promised():
    sizes: list[tuple[int, ...]] = []

    def spy(image):
        sizes.append(tuple(image.shape[-2:]))
        return image.double()[:, :2]

    image = frame(50, 130)
    assert torch.equal(in_tiles(spy, image, halo=8, tile=16), image.double()[:, :2])
    assert (max(max(s) for s in sizes), len(sizes)) == (16 + 2 * 8, 4 * 9)


@pytest.mark.parametrize("name", ["noise", "map"])
def test_the_halo_covers_what_the_networks_see(name):
    """What lies beyond the halo changes no bit of the centre; what lies within does."""
    if name == "map":
        blur = DefocusMap(width=6).eval().requires_grad_(False)
        network, halo = lambda x: blur(x, torch.full_like(x, 0.01)), camera_simulator._MAP_HALO
    else:
        assert len(SIZES["compact"]) == max(map(len, SIZES.values()))  # no size sees more
        noise = NoiseModule("compact").eval().requires_grad_(False).network
        torch.nn.init.normal_(noise.tail.weight)
        shot, read = torch.full((1, 4), 1e-2), torch.full((1, 4), 1e-4)
        far = torch.zeros(1, 4, 1, 1)
        halo = camera_simulator._NOISE_HALO
        network = lambda x: noise.uncorrected(x, far.expand_as(x), shot, read)  # noqa: E731
    image, (top, bottom) = frame(200, 200), (96, 104)
    centre, found = (..., slice(top, bottom), slice(top, bottom)), []
    for seen in (halo, 16):
        keep = (..., *2 * [slice(top - seen, bottom + seen)])
        other = frame(200, 200, seed=7) * 3
        other[keep] = image[keep]
        found.append(network(other)[centre])
    assert torch.equal(found[0], network(image)[centre])
    assert not torch.equal(found[1], found[0])
    # A tile of it whose corner lies on a multiple of 8 gives the same.
    tile = (..., *2 * [slice(top - halo, bottom + halo)])
    alone = network(image[tile])[..., halo:-halo, halo:-halo]
    torch.testing.assert_close(alone, found[0], rtol=0, atol=1e-4)


def test_constant_parts_do_not_vary():
    image, expected = frame(75, 100)[0], torch.ones(75, 100, dtype=torch.bool)
    image[:, 32:, :50] = 1.0  # saturated
    image[:, :16, 64:] = 0.0  # black, but for one plane's pixel
    image[2, 3, 70] = 1e-6
    expected[32:, :48] = expected[:16, 80:] = False
    assert torch.equal(varying(image), expected)
    expected[32:48] = expected[:, 48:] = expected[:, 32:48] = True
    assert torch.equal(varying(image, 16), expected)
    # A cell of one pixel cannot show that it varies.
    corner = varying(torch.ones(4, 33, 49))
    assert corner.nonzero().tolist() == [[32, 48]]
    assert not varying(torch.ones(4, 33, 48)).any()
