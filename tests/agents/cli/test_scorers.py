from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from ae_env.scorers import list_scorers, make_scorer
from ae_env.scorers.nima import PUBLISHED, _layout, git_blob_id


@pytest.fixture
def keras_file(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    with h5py.File(tmp_path / "weights.hdf5", "w") as file:
        for (layer, array), (_, _, shape) in _layout().items():
            if (layer.startswith("conv_dw") and array == "kernel") or "dense" in layer:
                continue
            file[f"{layer}/{layer}/{array}:0"] = rng.uniform(0.1, 0.2, shape).astype(np.float32)
        file["dense_1/dense_1/kernel:0"] = np.zeros((1024, 10), np.float32)
        file["dense_1/dense_1/bias:0"] = np.zeros(10, np.float32)
    return tmp_path / "weights.hdf5"


def test_all_scorers_are_listed(ae_env) -> None:
    code, out, _ = ae_env("scorers")
    assert code == 0
    for name in list_scorers():
        assert any(line.split()[:1] == [name] for line in out.splitlines()), name
    assert "Needs extra cv" in out
    assert "AE_ENV_NIMA_AESTHETIC" in out


def test_the_published_file_goes_to_where_the_scorer_looks(
    ae_env, keras_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "cache"))
    monkeypatch.setitem(PUBLISHED, "nima_technical", git_blob_id(keras_file.read_bytes()))
    code, out, _ = ae_env("convert-nima", keras_file)
    assert code == 0
    assert "weights.hdf5: the published weights of nima_technical" in out
    scorer = make_scorer("nima_technical").parts["nima_technical"]
    # The dense layer is zero, so each of 1..10 is as likely: (5.5 - 1) / 9.
    scores = scorer(torch.rand(2, 3, 50, 60), None)  # type: ignore[arg-type]
    assert scores.tolist() == pytest.approx([0.5, 0.5], abs=1e-6)
    code, out, _ = ae_env("cache", "--clear")
    assert code == 0
    assert (tmp_path / "cache" / "nima_technical.safetensors").is_file()


def test_other_weights_need_a_name(ae_env, keras_file: Path, tmp_path: Path) -> None:
    code, _, err = ae_env("convert-nima", keras_file)
    assert code == 2
    assert all(blob in err.replace("\n", "") for blob in PUBLISHED.values())
    target = tmp_path / "new" / "mine.safetensors"
    code, out, _ = ae_env("convert-nima", keras_file, "-o", target)
    assert code == 0
    assert "not one of the published files" in out
    assert f"AE_ENV_NIMA_AESTHETIC={target}" in out
    assert target.is_file()
