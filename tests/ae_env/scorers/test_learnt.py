"""NIMA against Keras with the same random weights, and classifiers from files."""

import hashlib
import math
import pickle
import sys
from itertools import pairwise
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

#: Mean ratings that Keras 3.15 gives to `pictures_of_keras` with `weights_of_keras`, by
#: ``MobileNet((224, 224, 3), include_top=False, pooling="avg", weights=None)`` and a dense layer of
#: ten with a softmax; ``predict(2 * pictures - 1) @ np.arange(1, 11)``.
MEANS_OF_KERAS = np.array([8.475087, 8.796729, 8.662664])
WIDTHS = [32, 64, 128, 128, 256, 256, *[512] * 6, 1024, 1024]


def pictures_of_keras() -> torch.Tensor:
    rng = np.random.default_rng(1)
    pictures = rng.random((3, 224, 224, 3)) * np.array([1.0, 0.2, 1.0])[:, None, None, None]
    pictures[2] = np.linspace(0.0, 1.0, 224)[None, :, None] ** np.array([0.5, 1.0, 2.0])
    return torch.from_numpy(pictures.astype(np.float32)).permute(0, 3, 1, 2)


def weights_of_keras() -> dict[tuple[str, str], np.ndarray]:
    """Random ones by layer and array, in Keras' shapes."""
    kernels: dict[str, tuple[int, ...]] = {"conv1": (3, 3, 3, 32)}
    for i, (inputs, outputs) in enumerate(pairwise(WIDTHS), start=1):
        kernels |= {f"conv_dw_{i}": (3, 3, inputs, 1), f"conv_pw_{i}": (1, 1, inputs, outputs)}
    rng, weights = np.random.default_rng(0), {}
    for layer, shape in [*kernels.items(), ("dense_1", (1024, 10))]:
        # He's scale, or the signal dies in the depth.
        fan = math.prod(shape[:2] if "dw" in layer else shape[:-1])
        gain = 24.0 if layer == "dense_1" else 2.0
        weights[layer, "kernel"] = rng.normal(0.0, math.sqrt(gain / fan), shape)
        if layer == "dense_1":
            weights[layer, "bias"] = rng.normal(0.1, 0.3, 10)
            continue
        channels = shape[2] if "dw" in layer else shape[3]
        for array in ("gamma", "beta", "moving_mean", "moving_variance"):
            positive = array in ("gamma", "moving_variance")
            drawn = rng.uniform(0.7, 1.6, channels) if positive else rng.normal(0.1, 0.3, channels)
            weights[f"{layer}_bn", array] = drawn
    return weights


def test_a_converted_file_scores_as_keras_does(tmp_path, monkeypatch):
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "cache"))
    for name in ("nima_aesthetic", "nima_technical"):
        with pytest.raises(ValueError, match=rf"AE_ENV_{name.upper()}.*{PUBLISHED[name]}"):
            make_scorer(name)
    weights, old, whole = tmp_path / "weights.h5", "{0}/{0}/{1}:0", "model_weights/{0}/{0}/{1}"
    # As `save_weights` of Keras 2 and `save` of Keras 3 name them.
    with h5py.File(weights, "w") as first, h5py.File(tmp_path / "whole.h5", "w") as second:
        for (layer, array), values in weights_of_keras().items():
            depthwise = "_dw_" in layer and array == "kernel"
            own = "depthwise_kernel" if depthwise else array
            first[old.format(layer, own)] = values.astype(np.float32)
            second[whole.format(layer, array)] = values.astype(np.float32)
    content = weights.read_bytes()
    blob = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
    monkeypatch.setitem(convert_nima.PUBLISHED, "nima_technical", blob)
    convert_nima.main(str(weights))  # as if published: into the cache folder
    with pytest.raises(SystemExit, match="name"):
        convert_nima.main(str(tmp_path / "whole.h5"))
    convert_nima.main(str(tmp_path / "whole.h5"), str(tmp_path / "new" / "mine.safetensors"))
    monkeypatch.setenv("AE_ENV_NIMA_AESTHETIC", str(tmp_path / "new" / "mine.safetensors"))
    pictures = pictures_of_keras()
    for name in ("nima_aesthetic", "nima_technical"):
        scorer = make_scorer(name).parts[name]
        scores = scorer(pictures, None)
        np.testing.assert_allclose(scores.numpy(), (MEANS_OF_KERAS - 1.0) / 9.0, atol=2e-5)
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
