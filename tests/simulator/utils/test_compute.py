import logging
from functools import partial
from pathlib import Path

import numba
from numba.core import caching

from simulator.utils import compute as jit
from simulator.utils.compute import kernel


def add(a: int, b: int) -> int:
    return a + b


def test_kernels_run_without_the_lock_and_are_cached():
    compiled = kernel(fastmath=True)(add)
    assert isinstance(compiled, numba.core.dispatcher.Dispatcher)
    assert compiled(1, 2) == 3
    assert {"nogil": True, "fastmath": True}.items() <= compiled.targetoptions.items()
    assert compiled.stats.cache_path is not None


def test_they_run_where_nothing_can_be_cached(monkeypatch, caplog):
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    with caplog.at_level(logging.INFO, "simulator.utils.compute"):
        assert kernel()(add)(1, 2) == 3
    assert "compiled again in each process" in caplog.text


def test_a_kernel_is_stale_when_a_module_changes_that_it_depends_on(tmp_path, monkeypatch):
    """Numba itself would run the kernel that it compiled with a constant's old value."""
    monkeypatch.setattr(jit, "_ROOT", tmp_path)
    texts = {
        "ae_env/kernels.py": "from ae_env.part import (\n    middle,\n)\nimport numpy",
        "ae_env/part/middle.py": "    from simulator.a.constants import FACTOR",
        "simulator/a/constants.py": "FACTOR = 2.0",
        "simulator/a/others.py": "FACTOR = 2.0",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)

    checksum = partial(jit._checksum.__wrapped__, tmp_path / "ae_env/kernels.py")
    before = checksum()
    (tmp_path / "simulator/a/others.py").write_text("FACTOR = 3.0")
    assert checksum() == before
    for name in list(texts)[:3]:
        (tmp_path / name).write_text(texts[name] + " # changed")
        assert checksum() != before
        (tmp_path / name).write_text(texts[name])
    monkeypatch.undo()
    stamp = kernel()(add)._cache._cache_file._source_stamp  # type: ignore[attr-defined]
    assert stamp[1] == jit._checksum(Path(__file__))
