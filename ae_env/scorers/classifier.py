"""Confidence: how sure a user's own image classifier is of what a picture shows."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from ae_env.scorers.protocol import Captures, DependsOn, Domain
from ae_env.utils.user_files import UserCodeError, find_model_file
from simulator.utils.checks import check_integer

#: Environment variable that names the ONNX file.
VARIABLE = "AE_ENV_CLASSIFIER"
#: Side of the pictures that a classifier sees where it does not say so [pixel].
INPUT_SIZE = 224
#: Mean and standard deviation of sRGB over ImageNet, by which most classifiers want it normalised.
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
#: Pictures that are classified at once.
_CHUNK = 16
#: Rows whose sum is this close to 1, and that have nothing negative, are probabilities already.
_SUM_ERROR = 1e-3

#: From normalised pictures (B, 3, S, S) float32 to logits or probabilities (B, classes).
Network = Callable[[Tensor], Any]


class Classifier:
    """Largest class probability of your own classifier, an ONNX file or a callable.

    The maximum of the softmax: what Lens chooses a camera's settings by, without knowing the label
    (Baek et al., Adaptive Camera Sensor for Vision Models, ICLR 2025). A picture is resized to
    `size` x `size`, whatever its shape, and normalised per channel.

    Args:
        model: ``.onnx`` of one float32 input (B, 3, S, S) whose first output is (B, classes), or a
            callable likewise, such as a `torch.nn.Module` in evaluation mode. Logits, or
            probabilities. By default the file that ``AE_ENV_CLASSIFIER`` names, else
            ``classifier.onnx`` in the cache folder.
        size: S [pixel]; by default the file's own, else 224.
        mean: Subtracted from R, G, B in [0, 1].
        std: What the differences are divided by.

    Raises:
        ValueError: If there is no such file, or it is no classifier.
        ImportError: If it is a file and ONNX Runtime is not installed.

    >>> from ae_env.scorers import make_scorer
    >>> scorer = make_scorer(Classifier(lambda pictures: pictures.mean(dim=(2, 3)), size=64))
    >>> list(scorer.parts)
    ['Classifier']
    """

    domain: Domain = "srgb"
    depends_on: DependsOn = "image"
    needs = f"ONNX file: {VARIABLE}"
    version = 1

    def __init__(
        self,
        model: str | os.PathLike[str] | Network | None = None,
        *,
        size: int | None = None,
        mean: Sequence[float] = MEAN,
        std: Sequence[float] = STD,
    ) -> None:
        if size is not None:
            check_integer("size", size, 1, 4096)
        self.mean, self.std = _triple("mean", mean), _triple("std", std)
        if min(self.std) <= 0.0:
            raise ValueError(f"`std` (={std!r}) must be > 0")
        self.batch: int | None = None  # of a network that takes no other number of pictures
        if callable(model):
            if getattr(model, "training", False):
                raise ValueError("`model` must be in evaluation mode: call its eval() first")
            self._model: Network | tuple[str, str] = model
            self.size = size or INPUT_SIZE
            return
        if not isinstance(model, str | os.PathLike | None):
            raise ValueError(f"`model` (={model!r}) must be an ONNX file, a callable or None")
        found = find_model_file(
            "classifier",
            model,
            VARIABLE,
            ("classifier.onnx",),
            how="an ONNX file of one input (B, 3, S, S) and an output (B, classes)",
        ).resolve()
        # SHA-256 of the file: another network under the same name gives other scores.
        self._model = str(found), hashlib.sha256(found.read_bytes()).hexdigest()
        self.batch, own_size = _input_shape(*self._model)
        if size is not None and own_size not in (None, size):
            raise ValueError(f"`size` (={size}) must be that of {str(found)!r}, {own_size}")
        self.size = own_size or size or INPUT_SIZE

    def __call__(self, images: Tensor | None, captures: Captures) -> Tensor:
        """Scores (B,) of sRGB `images` (B, 3, H, W).

        Raises:
            UserCodeError: If the network raises, or returns anything but numbers (B, classes).
        """
        assert images is not None
        mean, std = (torch.tensor(v)[:, None, None] for v in (self.mean, self.std))
        shape = (self.size, self.size)
        scores = []
        with torch.no_grad():
            for part in images.split(self.batch or _CHUNK):  # type: ignore[no-untyped-call]
                if part.shape[2:] != shape:
                    part = functional.interpolate(part, shape, mode="bilinear", antialias=True)
                outputs = self._outputs((part.float().clamp(0.0, 1.0) - mean) / std)
                scores.append(_confidence(outputs, len(part)))
        return torch.cat(scores)

    def _outputs(self, pictures: Tensor) -> Any:
        model = self._model
        run = model if callable(model) else partial(self._run, _session(*model))
        try:
            return run(pictures)
        except Exception as error:  # whatever a user's network raises
            text = f"the classifier raised {type(error).__name__}: {error}"
            raise UserCodeError(text) from error

    def _run(self, session: Any, pictures: Tensor) -> Any:
        missing = 0 if self.batch is None else self.batch - len(pictures)
        if missing:
            pictures = torch.cat([pictures, pictures[-1:].expand(missing, -1, -1, -1)])
        outputs = session.run(None, {session.get_inputs()[0].name: pictures.numpy()})[0]
        return outputs[: len(outputs) - missing]


def _triple(name: str, values: Sequence[float]) -> tuple[float, float, float]:
    try:
        red, green, blue = (float(value) for value in values)
    except (TypeError, ValueError):
        raise ValueError(f"`{name}` (={values!r}) must be three numbers, for R, G and B") from None
    return red, green, blue


def _confidence(outputs: Any, count: int) -> Tensor:
    """Largest probability (B,) float64 of logits or probabilities (B, classes)."""
    try:
        values = torch.as_tensor(outputs)
        found = "complex numbers" if values.is_complex() else str(tuple(values.shape))
    except (TypeError, ValueError, RuntimeError):
        values, found = torch.empty(0), type(outputs).__name__
    if values.is_complex() or values.ndim != 2 or len(values) != count or values.shape[1] < 2:
        raise UserCodeError(
            f"the classifier returned {found}: it must return (B, classes), two classes or more, "
            f"of {count} pictures"
        )
    values = values.double()
    sums = values.sum(dim=1)
    if bool((values >= 0.0).all()) and bool(((sums - 1.0).abs() < _SUM_ERROR).all()):
        return values.amax(dim=1).clamp(max=1.0)
    return values.softmax(dim=1).amax(dim=1)


# -- ONNX files -----------------------------------------------------------------------------------


@lru_cache(maxsize=4)
def _session(file: str, digest: str) -> Any:
    """The network of a file, read once per content."""
    try:
        import onnxruntime
    except ImportError as error:
        raise ImportError(
            f"scorer 'classifier' reads {file!r} by ONNX Runtime: pip install 'ae-env[onnx]' "
            f"({error})"
        ) from error
    content = Path(file).read_bytes()
    if hashlib.sha256(content).hexdigest() != digest:
        raise ValueError(f"`model` (={file!r}) must not change while it is in use")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime has errors of its own
        raise ValueError(f"`model` (={file!r}) cannot be read: {error}") from error


def _input_shape(file: str, digest: str) -> tuple[int | None, int | None]:
    """Batch and side of the pictures that a file's network takes; None where it takes any."""
    inputs = _session(file, digest).get_inputs()
    shape = list(inputs[0].shape)
    numbers = [n if isinstance(n, int) else None for n in shape]
    if len(inputs) != 1 or len(shape) != 4 or numbers[1] not in (3, None):
        found = [list(each.shape) for each in inputs]
        raise ValueError(f"`model` (={file!r}, inputs {found}) must have one input (B, 3, S, S)")
    if inputs[0].type != "tensor(float)" or numbers[2] != numbers[3]:
        raise ValueError(
            f"`model` (={file!r}, input {inputs[0].type} {shape}) must take float32 squares"
        )
    return numbers[0], numbers[2]
