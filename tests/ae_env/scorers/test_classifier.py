"""The confidence of a user's classifier, against NumPy's softmax of what it says."""

import pickle
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

from ae_env.scorers import make_scorer
from ae_env.scorers.classifier import Classifier
from ae_env.utils.user_files import UserCodeError
from tests.ae_env.recorded_files import GRID, write_raws

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
    graph = onnx.helper.make_graph(
        nodes,
        "means",
        [info("x", onnx.TensorProto.FLOAT, [batch, 3, size, size])],
        [info("shares" if softmax else "logits", onnx.TensorProto.FLOAT, [batch, 3])],
    )
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
def test_the_confidence_is_the_largest_probability(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batch: int | str, softmax: bool
) -> None:
    monkeypatch.setenv(
        "AE_ENV_CLASSIFIER", str(write_network(tmp_path / "a.onnx", batch, 32, softmax=softmax))
    )
    scorer = make_scorer("classifier").parts["classifier"]
    assert scorer.size == 32  # the file's own
    images = pictures()
    scores = scorer(images, None)  # type: ignore[arg-type]
    np.testing.assert_allclose(scores.numpy(), confidences(images), rtol=1e-5)
    again = pickle.loads(pickle.dumps(scorer))(images[:1], None)
    np.testing.assert_allclose(again.numpy(), confidences(images[:1]), rtol=1e-5)


def test_a_callable_sees_normalised_squares() -> None:
    seen = []

    def network(x: torch.Tensor) -> np.ndarray:
        seen.append(x)
        return x.numpy().mean(axis=(2, 3))

    images = pictures(20)
    scores = Classifier(network, size=24)(images, None)  # type: ignore[arg-type]
    np.testing.assert_allclose(scores.numpy(), confidences(images), rtol=1e-5)
    assert {x.shape[1:] for x in seen} == {(3, 24, 24)}
    expected = (images.mean(dim=(2, 3)).numpy() - MEAN) / STD
    np.testing.assert_allclose(torch.cat(seen)[:, :, 0, 0].numpy(), expected, rtol=1e-4)
    assert seen[0].dtype == torch.float32
    own = Classifier(torch.nn.Flatten().eval(), size=1, mean=(0, 0, 0), std=(0.5, 0.5, 0.5))
    powers = np.exp(images.mean(dim=(2, 3)).numpy() / 0.5)
    expected = powers.max(axis=1) / powers.sum(axis=1)
    np.testing.assert_allclose(own(images, None).numpy(), expected, rtol=1e-4)  # type: ignore[arg-type]


def test_a_network_in_training_mode_is_refused() -> None:
    with pytest.raises(ValueError, match="`model` must be in evaluation mode"):
        Classifier(torch.nn.Dropout())
    with pytest.raises(ValueError, match=r"`mean` \(='abc'\) must be three numbers"):
        Classifier(torch.nn.Flatten().eval(), mean="abc")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (lambda x: "a cat", r"returned str: it must return \(B, classes\)"),
        (lambda x: None, "returned NoneType: it must"),
        (lambda x: {"logits": x}, "returned dict: it must"),
        (lambda x: [[1.0, 2.0], [3.0]], "returned list: it must"),
        (lambda x: torch.zeros(len(x), 3, dtype=torch.complex64), "returned complex numbers"),
        (lambda x: 1 / 0, "the classifier raised ZeroDivisionError: division by zero"),
    ],
)
def test_what_a_callable_does_wrong_is_one_kind_of_error(network, message: str) -> None:
    with pytest.raises(UserCodeError, match=message):
        Classifier(network)(pictures(2), None)  # type: ignore[arg-type]


@pytest.mark.parametrize("model", [3, b"file.onnx", ["file.onnx"]])
def test_a_model_is_a_file_or_a_callable(model) -> None:
    with pytest.raises(
        ValueError, match=r"`model` \(=.*\) must be an ONNX file, a callable or None"
    ):
        Classifier(model)


def test_it_rates_the_captures_of_a_recorded_grid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_raws(tmp_path / "grid" / "desk")
    monkeypatch.setenv("AE_ENV_CLASSIFIER", str(write_network(tmp_path / "a.onnx")))
    env = gym.make(
        "ae_env:ae_env/AutoExposure-v0",
        scenes=f"recorded:{tmp_path / 'grid'}",
        split="test",
        scorer="classifier",
        resolution=36,
        with_oracle=True,
    )
    env.reset(seed=0)
    rewards = []
    for state in range(len(GRID)):
        _, reward, _, _, info = env.step(state)
        rewards.append(reward)
        best = info["oracle_state"]
    assert np.ptp(rewards) > 0.01
    assert int(np.argmax(rewards)) == best


def test_what_is_no_classifier_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    with pytest.raises(ValueError, match=r"needs a model file.*AE_ENV_CLASSIFIER=FILE.*\.onnx"):
        make_scorer("classifier")
    (tmp_path / "classifier.onnx").write_text("no network")
    with pytest.raises(ValueError, match=r"classifier.onnx'\) cannot be read"):
        make_scorer("classifier")
    fixed = write_network(tmp_path / "fixed.onnx", size=32)
    with pytest.raises(ValueError, match=r"`size` \(=224\) must be that of .*fixed.onnx', 32"):
        Classifier(fixed, size=224)
    with pytest.raises(ValueError, match=r"`std` \(=\(0, 1, 1\)\) must be > 0"):
        Classifier(fixed, std=(0, 1, 1))
    with pytest.raises(ValueError, match=r"returned \(1, 1\): it must return \(B, classes\)"):
        Classifier(lambda x: x.mean(dim=(1, 2, 3))[:, None])(pictures(1), None)  # type: ignore[arg-type]
    other = write_network(tmp_path / "other.onnx", batch=1)  # not read before
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"pip install 'ae-env\[onnx\]'"):
        Classifier(other)
