"""NIMA against Keras: one network with the same random weights, from files that Keras wrote."""

import hashlib
import pickle
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
from ae_env.scorers.learnt import PUBLISHED, Classifier, NimaMobileNet, read_network
from ae_env.utils.user_files import UserCodeError

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
    for weight in model.weights:
        shape = tuple(weight.shape)
        if weight.name in ("moving_variance", "gamma"):
            weight.assign(rng.uniform(0.7, 1.6, shape))
        elif weight.name in ("beta", "moving_mean", "bias"):
            weight.assign(rng.normal(0.1, 0.3, shape))
        else:  # He's scale, or the signal dies in the depth
            fan = np.prod(shape[:2]) if "dw" in weight.path else np.prod(shape[:-1])
            gain = 24.0 if "dense_1" in weight.path else 2.0
            weight.assign(rng.normal(0.0, np.sqrt(gain / fan), shape))
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
    code = textwrap.dedent(KERAS)
    subprocess.run([sys.executable, "-W", "ignore", "-c", code, str(folder)], check=True)
    return folder


def test_a_converted_file_scores_as_keras_does(keras_files, tmp_path, monkeypatch):
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
        scores = scorer(pictures, None)
        np.testing.assert_allclose(scores.numpy(), (means - 1.0) / 9.0, atol=2e-5)
    alone = torch.cat([scorer(p[None], None) for p in pictures])
    torch.testing.assert_close(alone, scores, rtol=0.0, atol=1e-6)
    for size in (1, 300):  # any picture is resized
        score = scorer(torch.full((1, 3, size, size + 1), 0.5), None)
        assert 0.0 < float(score) < 1.0


def test_other_files_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "other.hdf5", "w") as file:
        file["conv1_bn/conv1_bn/gamma:0"] = np.zeros(64)
    with pytest.raises(ValueError, match="gamma:0"):
        convert_nima.convert(tmp_path / "other.hdf5", tmp_path / "out.safetensors")
    assert [path.name for path in tmp_path.iterdir()] == ["other.hdf5"]
    weights = {k: v for k, v in NimaMobileNet().state_dict().items() if "num_batches" not in k}
    assert sum(values.numel() for values in weights.values()) == 3_239_114  # as Keras counts
    bias = weights.pop("head.bias")
    file = tmp_path / "damaged.safetensors"
    for damaged in ({}, {"head.bias": torch.zeros(11)}, {"head.bias": bias * torch.nan}):
        save_file({**weights, **damaged}, file)
        with pytest.raises(ValueError, match=r"`file`(.|\n)*head.bias"):
            read_network(file)
    with pytest.raises(ValueError, match="`file`"):
        read_network(tmp_path / "nothing.safetensors")


onnx = pytest.importorskip("onnx")
MEAN, STD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])


def write_network(
    path: Path, batch: int | str = "batch", size: int | str = "side", *, softmax: bool = False
) -> Path:
    """Three classes: the logits are the means of red, green and blue."""
    node, info = onnx.helper.make_node, onnx.helper.make_tensor_value_info
    nodes = [node("GlobalAveragePool", ["x"], ["m"]), node("Flatten", ["m"], ["logits"])]
    if softmax:
        nodes.append(node("Softmax", ["logits"], ["shares"]))
    given = info("x", onnx.TensorProto.FLOAT, [batch, 3, size, size])
    found = info("shares" if softmax else "logits", onnx.TensorProto.FLOAT, [batch, 3])
    graph = onnx.helper.make_graph(nodes, "means", [given], [found])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.save(model, str(path))
    return path


def pictures(count: int = 5, height: int = 36, width: int = 48) -> torch.Tensor:
    colours = np.random.default_rng(0).random((count, 3, 1, 1)).astype(np.float32)
    return torch.from_numpy(colours).expand(count, 3, height, width).contiguous()


def confidences(images: torch.Tensor) -> np.ndarray:
    logits = (images.double().mean(dim=(2, 3)).numpy() - MEAN) / STD
    powers = np.exp(logits)
    return powers.max(axis=1) / powers.sum(axis=1)


@pytest.mark.parametrize("batch", ["batch", 1, 2], ids=str)
@pytest.mark.parametrize("softmax", [False, True], ids=["logits", "probabilities"])
def test_the_confidence_is_the_largest_probability(tmp_path, monkeypatch, batch, softmax):
    file = write_network(tmp_path / "a.onnx", batch, 32, softmax=softmax)
    monkeypatch.setenv("AE_ENV_CLASSIFIER", str(file))
    scorer = make_scorer("classifier").parts["classifier"]
    assert scorer.size == 32  # the file's own
    images = pictures()
    scores = scorer(images, None)
    np.testing.assert_allclose(scores.numpy(), confidences(images), rtol=1e-5)
    again = pickle.loads(pickle.dumps(scorer))(images[:1], None)
    np.testing.assert_allclose(again.numpy(), confidences(images[:1]), rtol=1e-5)


def test_a_callable_sees_normalised_squares() -> None:
    seen = []

    def network(x: torch.Tensor) -> np.ndarray:
        seen.append(x)
        return x.numpy().mean(axis=(2, 3))

    images = pictures(20)
    scores = Classifier(network, size=24)(images, None)
    np.testing.assert_allclose(scores.numpy(), confidences(images), rtol=1e-5)
    assert {x.shape[1:] for x in seen} == {(3, 24, 24)}
    expected = (images.mean(dim=(2, 3)).numpy() - MEAN) / STD
    np.testing.assert_allclose(torch.cat(seen)[:, :, 0, 0].numpy(), expected, rtol=1e-4)
    assert seen[0].dtype == torch.float32
    own = Classifier(torch.nn.Flatten().eval(), size=1, mean=(0, 0, 0), std=(0.5, 0.5, 0.5))
    powers = np.exp(images.mean(dim=(2, 3)).numpy() / 0.5)
    expected = powers.max(axis=1) / powers.sum(axis=1)
    np.testing.assert_allclose(own(images, None).numpy(), expected, rtol=1e-4)


def test_what_is_no_classifier_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    with pytest.raises(ValueError, match=r"AE_ENV_CLASSIFIER=FILE"):
        make_scorer("classifier")
    (tmp_path / "classifier.onnx").write_text("no network")
    with pytest.raises(ValueError, match=r"classifier.onnx'\) cannot be read"):
        make_scorer("classifier")
    fixed = write_network(tmp_path / "fixed.onnx", size=32)
    for model, arguments, name in (
        *((fixed, {"size": 224}, "size"), (fixed, {"std": (0, 1, 1)}, "std")),
        *((b"file.onnx", {}, "model"), (torch.nn.Dropout(), {}, "model")),  # in training mode
    ):
        with pytest.raises(ValueError, match=f"`{name}`"):
            Classifier(model, **arguments)
    for network in (lambda x: "a cat", lambda x: x.mean(dim=(1, 2, 3))[:, None], lambda x: 1 / 0):
        with pytest.raises(UserCodeError, match=r"returned|the classifier raised ZeroDivision"):
            Classifier(network)(pictures(2), None)
    other = write_network(tmp_path / "other.onnx", batch=1)  # not read before
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"pip install 'ae-env\[onnx\]'"):
        Classifier(other)
