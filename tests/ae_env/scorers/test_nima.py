"""NIMA against Keras: one network with the same random weights, from files that Keras wrote."""

import hashlib
import subprocess
import sys
import textwrap
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import examples.convert_nima as convert_nima
from ae_env.scorers import make_scorer
from ae_env.scorers.learnt import PUBLISHED, NimaMobileNet, read_network

KERAS = """
    import os, sys
    os.environ["KERAS_BACKEND"] = "torch"
    import h5py, keras, numpy as np, torch
    from keras.src.legacy.saving import legacy_h5_format
    torch.set_num_threads(1)
    folder = sys.argv[1]
    base = keras.applications.MobileNet(
        (224, 224, 3), include_top=False, pooling="avg", weights=None
    )
    dropped = keras.layers.Dropout(0.75)(base.output)
    head = keras.layers.Dense(10, activation="softmax", name="dense_1")
    model = keras.Model(base.inputs, head(dropped))
    rng = np.random.default_rng(0)
    for layer in model.layers:
        values = []
        for w in layer.weights:
            shape, name = tuple(w.shape), w.name
            if name in ("moving_variance", "gamma"):
                values.append(rng.uniform(0.7, 1.6, shape))
            elif name in ("beta", "moving_mean", "bias"):
                values.append(rng.normal(0.1, 0.3, shape))
            else:  # He's scale, or the signal dies in the depth
                fan = np.prod(shape[:2]) if "dw" in layer.name else np.prod(shape[:-1])
                gain = 24.0 if layer.name == "dense_1" else 2.0
                values.append(rng.normal(0.0, np.sqrt(gain / fan), shape))
        layer.set_weights(values)
    assert model.count_params() == 3_239_114
    with h5py.File(f"{folder}/weights.h5", "w") as file:  # of `save_weights` in Keras 2
        legacy_h5_format.save_weights_to_hdf5_group(file, model)
        for layer in model.layers:
            group = file[layer.name]
            if layer.name not in group:  # a layer without weights
                continue
            own = group[layer.name]
            for array in list(own):
                depthwise = layer.name.startswith("conv_dw") and array == "kernel"
                own.move(array, "depthwise_kernel:0" if depthwise else f"{array}:0")
            group.attrs["weight_names"] = [f"{layer.name}/{array}".encode() for array in own]
    model.save(f"{folder}/whole.h5")
    pictures = np.load(f"{folder}/pictures.npy")
    np.save(f"{folder}/shares.npy", model.predict(pictures * 255.0 / 127.5 - 1.0, verbose=0))
"""


@pytest.fixture(scope="module")
def keras_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """weights.h5 and whole.h5 of one network, and its answers to pictures.npy (N, H, W, 3)."""
    folder = tmp_path_factory.mktemp("keras")
    rng = np.random.default_rng(1)
    pictures = rng.random((3, 224, 224, 3)) * np.array([1.0, 0.2, 1.0])[:, None, None, None]
    pictures[2] = np.linspace(0.0, 1.0, 224)[None, :, None] ** np.array([0.5, 1.0, 2.0])
    np.save(folder / "pictures.npy", pictures.astype(np.float32))
    script = folder / "write.py"
    script.write_text(textwrap.dedent(KERAS))
    done = subprocess.run(
        [sys.executable, "-W", "ignore", str(script), str(folder)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return folder


def _pictures(folder: Path) -> torch.Tensor:
    return torch.from_numpy(np.load(folder / "pictures.npy")).permute(0, 3, 1, 2)


def test_a_converted_file_scores_as_keras_does(
    keras_files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "cache"))
    for name in ("nima_aesthetic", "nima_technical"):
        with pytest.raises(ValueError, match=rf"AE_ENV_{name.upper()}.*{PUBLISHED[name]}"):
            make_scorer(name)
    content = (keras_files / "weights.h5").read_bytes()
    blob = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
    monkeypatch.setitem(convert_nima.PUBLISHED, "nima_technical", blob)
    convert_nima.main(str(keras_files / "weights.h5"))  # as if published: into the cache folder
    with pytest.raises(SystemExit, match="name"):
        convert_nima.main(str(keras_files / "whole.h5"))
    convert_nima.main(str(keras_files / "whole.h5"), str(tmp_path / "new" / "mine.safetensors"))
    monkeypatch.setenv("AE_ENV_NIMA_AESTHETIC", str(tmp_path / "new" / "mine.safetensors"))
    means = np.load(keras_files / "shares.npy") @ np.arange(1.0, 11.0)
    assert np.ptp(means) > 0.3  # else this shows nothing
    pictures = torch.from_numpy(np.load(keras_files / "pictures.npy")).permute(0, 3, 1, 2)
    for name in ("nima_aesthetic", "nima_technical"):
        scorer = make_scorer(name).parts[name]
        scores = scorer(pictures, None)  # type: ignore[arg-type]
        np.testing.assert_allclose(scores.numpy(), (means - 1.0) / 9.0, atol=2e-5)
    alone = torch.cat([scorer(p[None], None) for p in pictures])  # type: ignore[arg-type]
    torch.testing.assert_close(alone, scores, rtol=0.0, atol=1e-6)
    for size in (1, 300):  # any picture is resized
        score = scorer(torch.full((1, 3, size, size + 1), 0.5), None)  # type: ignore[arg-type]
        assert 0.0 < float(score) < 1.0


def test_other_files_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "other.hdf5", "w") as file:
        file["conv1_bn/conv1_bn/gamma:0"] = np.zeros(64)
    with pytest.raises(ValueError, match="gamma:0"):
        convert_nima.convert(tmp_path / "other.hdf5", tmp_path / "out.safetensors")
    assert [path.name for path in tmp_path.iterdir()] == ["other.hdf5"]
    weights = {k: v for k, v in NimaMobileNet().state_dict().items() if "num_batches" not in k}
    assert sum(values.numel() for values in weights.values()) == 3_239_114  # as Keras counts
    damaged: list[dict[str, torch.Tensor]] = [
        {k: v for k, v in weights.items() if k != "head.bias"},
        {**weights, "head.bias": torch.zeros(11)},
        {**weights, "head.bias": torch.full((10,), float("nan"))},
    ]
    for index, arrays in enumerate(damaged):
        save_file(arrays, tmp_path / f"{index}.safetensors")
        with pytest.raises(ValueError, match=r"`file`(.|\n)*head.bias"):
            read_network(tmp_path / f"{index}.safetensors")
    with pytest.raises(ValueError, match="`file`"):
        read_network(tmp_path / "nothing.safetensors")
