"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

torch.set_num_threads(min(2, torch.get_num_threads()))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real files named by AE_ENV_DATA, or a skip that says what is missing."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("AE_ENV_DATA", default))
    if not folder.is_dir():
        pytest.skip("real data not found: set AE_ENV_DATA to its folder")
    return folder


@pytest.fixture(autouse=True)
def cache_in_tmp(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cached scenes and score tables of the tests live in the test run's own folder."""
    folder = tmp_path_factory.getbasetemp() / "cache"
    monkeypatch.setenv("AE_ENV_CACHE", str(folder))
