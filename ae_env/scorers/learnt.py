"""Scorers that are networks of others: NIMA, a user's own classifier, the metrics of pyiqa."""

import hashlib
import math
import os
import re
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils import fuse_conv_bn_eval

from ae_env.scorers.captures import Captures, Domain
from ae_env.utils.user_files import UserCodeError
from simulator.utils.cache import cache_dir
from simulator.utils.checks import check_integer, check_type, onnx_session
from simulator.utils.files import read_bounded


def find_model_file(
    scorer: str, given: str | os.PathLike[str] | None, variable: str, name: str, *, how: str
) -> tuple[str, str]:
    """The model file of a scorer, and its SHA-256: another file of that name gives other scores.

    It is `given`, else what `variable` names, else `name` in the cache. A `ValueError` says where
    to put it, and `how` to get it.
    """
    named = os.environ.get(variable) if given is None else os.fspath(given)
    file = Path(named).expanduser() if named else cache_dir() / name
    if file.is_file():
        return str(file.resolve()), hashlib.sha256(read_bounded(file, 2**31)).hexdigest()
    if named:
        source = f"`{variable}`" if given is None else "`file`"
        raise ValueError(f"{source} (={named!r}) must be the model file of {scorer!r}; {how}")
    raise ValueError(
        f"scorer {scorer!r} needs a model file, which does not come with ae-env: set "
        f"{variable}=FILE, or put it at {file}; {how}"
    )


# -- NIMA: MobileNet v1 with ten ratings as its output --------------------------------------------

#: Ratings are from 1 to this.
RATINGS = 10
#: Added to the variance in Keras' MobileNet.
_EPS = 1e-3
#: Output channels and stride of the 13 depthwise separable blocks.
_BLOCKS = (
    *((64, 1), (128, 2), (128, 1), (256, 2), (256, 1), (512, 2)),
    *((512, 1), (512, 1), (512, 1), (512, 1), (512, 1), (1024, 2), (1024, 1)),
)


def _layer(inputs: int, outputs: int, kernel: int, stride: int, groups: int = 1) -> nn.Module:
    """Convolution without bias, batch normalisation and ReLU6, padded as Keras' MobileNet is.

    With stride 2 only the right and the lower edge are padded, by one pixel.
    """
    padding = (kernel - 1) // 2 if stride == 1 else 0
    return nn.Sequential(
        nn.ZeroPad2d((0, 1, 0, 1)) if stride == 2 else nn.Identity(),
        nn.Conv2d(inputs, outputs, kernel, stride, padding, groups=groups, bias=False),
        nn.BatchNorm2d(outputs, eps=_EPS),
        nn.ReLU6(),
    )


class NimaMobileNet(nn.Module):
    """MobileNet v1 (width 1) with ten ratings as its output: 3,239,114 numbers.

    Source: Howard et al., MobileNets, 2017; Talebi and Milanfar, NIMA: Neural Image Assessment,
    IEEE Transactions on Image Processing 27(8), 2018, with the head of the published weights:
    global mean, then one dense layer.
    """

    def __init__(self) -> None:
        super().__init__()
        layers = [_layer(3, 32, 3, 2)]
        inputs = 32
        for outputs, stride in _BLOCKS:
            layers.append(_layer(inputs, inputs, 3, stride, groups=inputs))
            layers.append(_layer(inputs, outputs, 1, 1))
            inputs = outputs
        self.features = nn.Sequential(*layers)
        self.head = nn.Linear(inputs, RATINGS)

    def forward(self, pictures: Tensor) -> Tensor:
        """Shares (B, 10) of the ratings of `pictures` (B, 3, 224, 224) in [-1, 1]; summing to 1."""
        return self.head(self.features(pictures).mean(dim=(2, 3))).softmax(dim=1)


#: Git blob ids of the published Keras files, by the scorer that they make.
PUBLISHED = {
    "nima_aesthetic": "003fb321ce92445e41d708144a3656589f9214e7",
    "nima_technical": "5e4a4ca2ce639309bfa4038d0bc10ba92b93bd26",
}


def read_network(file: str | os.PathLike[str]) -> NimaMobileNet:
    """The network of a ``.safetensors`` that ``examples/convert_nima.py`` wrote, for inference.

    A `ValueError` if it cannot be read, or is not of this network.
    """
    from simulator.networks.weights import load_into, read_weights

    network = NimaMobileNet()
    try:
        load_into(network, read_weights(read_bounded(Path(file))), "they")
    except (OSError, ValueError) as error:
        rule = "must be weights of NIMA's MobileNet in .safetensors"
        raise ValueError(f"`file` (={str(file)!r}) {rule}: {error}") from error
    network.eval().requires_grad_(False)
    layer: Any
    for layer in network.features:  # the normalisation goes into the convolution
        layer[1], layer[2] = fuse_conv_bn_eval(layer[1], layer[2]), nn.Identity()
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network


#: Side of the pictures that the network was trained on [pixel].
INPUT_SIZE = 224
#: Pictures that the network sees at once: more only spend time in memory paging.
_CHUNK = 8


def _of_size(pictures: Tensor, side: int) -> Tensor:
    if pictures.shape[2:] == (side, side):
        return pictures
    return functional.interpolate(pictures, (side, side), mode="bilinear", antialias=True)


@lru_cache(maxsize=4)
def _network(file: str, digest: str) -> NimaMobileNet:
    """The network of a file, read once per content, which `digest` stands for."""
    return read_network(file)


class Nima:
    """Mean rating of people as a MobileNet expects it: (mean of 1..10 - 1) / 9.

    Talebi and Milanfar, NIMA: Neural Image Assessment, 2018. The weights do not come with the
    package: `file` (.safetensors), which ``examples/convert_nima.py`` made from the published ones,
    else what the scorer's environment variable names, else in the cache folder. A `ValueError` if
    the file is not there or does not fit.
    """

    domain: Domain = "srgb"
    version = 1
    #: Name of the scorer and of its weights.
    name: str

    def __init__(self, file: str | os.PathLike[str] | None = None) -> None:
        how = "examples/convert_nima.py makes it from the published Keras weights, whose git "
        how += f"blob id is {PUBLISHED[self.name]} (docs/scorers.md)"
        own = f"AE_ENV_{self.name.upper()}", f"{self.name}.safetensors"
        self.file, self.digest = find_model_file(self.name, file, *own, how=how)
        _network(self.file, self.digest)  # raises now, not at the first score

    def __call__(self, images: Tensor, captures: Captures) -> Tensor:
        network, means = _network(self.file, self.digest), []
        ratings = torch.arange(1.0, RATINGS + 1.0, dtype=torch.float64)
        with torch.no_grad():
            for part in images.cpu().split(_CHUNK):  # type: ignore[no-untyped-call]
                part = _of_size(part, INPUT_SIZE)
                part = (2.0 * part.clamp(0.0, 1.0) - 1.0).to(memory_format=torch.channels_last)
                means.append(network(part).double() @ ratings)
        return (torch.cat(means) - 1.0) / (RATINGS - 1.0)


class NimaAesthetic(Nima):
    """Aesthetic quality as people rate it: NIMA (2018), trained on AVA."""

    needs = "weights: AE_ENV_NIMA_AESTHETIC"
    name = "nima_aesthetic"


class NimaTechnical(Nima):
    """Technical quality as people rate it: NIMA (2018), trained on TID2013."""

    needs = "weights: AE_ENV_NIMA_TECHNICAL"
    name = "nima_technical"


# -- confidence of a user's own image classifier --------------------------------------------------

#: Environment variable that names the ONNX file.
VARIABLE = "AE_ENV_CLASSIFIER"
#: Side of the pictures that a classifier sees where it does not say so [pixel].
DEFAULT_SIZE = 224
#: Mean and standard deviation of sRGB over ImageNet, by which most classifiers want it normalised.
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
#: Pictures that are classified at once.
_CLASSIFIED_AT_ONCE = 16
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
        mean, std: Subtracted from R, G, B in [0, 1]; what the differences are divided by.

    A `ValueError` if there is no such file, or it is no classifier; an `ImportError` if it is a
    file and ONNX Runtime is not installed.

    >>> from ae_env.scorers import make_scorer
    >>> scorer = make_scorer(Classifier(lambda pictures: pictures.mean(dim=(2, 3)), size=64))
    >>> list(scorer.parts)
    ['Classifier']
    """

    domain: Domain = "srgb"
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
        for name, values, low in (("mean", mean, -math.inf), ("std", std, 0.0)):
            try:
                red, green, blue = (float(value) for value in values)
            except (TypeError, ValueError, OverflowError):
                red = green = blue = math.nan
            if not min(red, green, blue) > low:
                rule = "three numbers, for R, G and B" + (", > 0" if name == "std" else "")
                raise ValueError(f"`{name}` (={values!r}) must be {rule}")
        self.mean, self.std = tuple(map(float, mean)), tuple(map(float, std))
        self.batch: int | None = None  # of a network that takes no other number of pictures
        if callable(model):
            if getattr(model, "training", False):
                raise ValueError("`model` must be in evaluation mode: call its eval() first")
            self._model: Network | tuple[str, str] = model
            self.size = size or DEFAULT_SIZE
            return
        check_type("model", model, str, os.PathLike, None)
        how = "an ONNX file of one input (B, 3, S, S) and an output (B, classes)"
        self._model = find_model_file("classifier", model, VARIABLE, "classifier.onnx", how=how)
        self.batch, own_size = _input_shape(*self._model)
        if size is not None and own_size not in (None, size):
            raise ValueError(f"`size` (={size}) must be that of {self._model[0]!r}, {own_size}")
        self.size = own_size or size or DEFAULT_SIZE

    def __call__(self, images: Tensor, captures: Captures) -> Tensor:
        """Scores (B,) of sRGB `images` (B, 3, H, W).

        A `UserCodeError` if the network raises, or returns anything but numbers (B, classes).
        """
        return self._classified(images.cpu()).amax(dim=1).clamp(max=1.0)

    def labels(self, images: Tensor) -> list[int]:
        """The most likely class of each picture."""
        return [int(label) for label in self._classified(images).argmax(dim=1)]

    def _classified(self, images: Tensor) -> Tensor:
        """Probabilities (B, classes) float64."""
        mean, std = (torch.tensor(v)[:, None, None] for v in (self.mean, self.std))
        found = []
        with torch.no_grad():
            for part in images.split(self.batch or _CLASSIFIED_AT_ONCE):  # type: ignore[no-untyped-call]
                part = _of_size(part, self.size).float().clamp(0.0, 1.0)
                found.append(_probabilities(self._outputs((part - mean) / std), len(part)))
        return torch.cat(found)

    def _outputs(self, pictures: Tensor) -> Any:
        try:
            if callable(self._model):
                return self._model(pictures)
            session = _session(*self._model)
            missing = 0 if self.batch is None else self.batch - len(pictures)
            if missing:
                pictures = torch.cat([pictures, pictures[-1:].expand(missing, -1, -1, -1)])
            outputs = session.run(None, {session.get_inputs()[0].name: pictures.numpy()})[0]
            return outputs[: len(outputs) - missing]
        except Exception as error:  # whatever a user's network raises
            raise UserCodeError(f"the classifier raised {type(error).__name__}: {error}") from error


def _probabilities(outputs: Any, count: int) -> Tensor:
    """Probabilities (B, classes) float64 of logits, or of probabilities."""
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
        return values
    return values.softmax(dim=1)


@lru_cache(maxsize=4)
def _session(file: str, digest: str) -> Any:
    """The network of a file, read once per content."""
    content = read_bounded(Path(file), 2**31)  # ONNX allows no more
    if hashlib.sha256(content).hexdigest() != digest:
        raise ValueError(f"`model` (={file!r}) must not change while it is in use")
    given, threads = f"`model` (={file!r})", torch.get_num_threads()
    return onnx_session(content, given, "the scorer classifier", threads)


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


# -- metrics of the package pyiqa, named ``pyiqa:musiq`` ------------------------------------------
# It has a non-commercial licence and is large, so it is no dependency of this package and imported
# only where one of its metrics is asked for.

_NUMBER = re.compile(r"[-+]?(?:inf|\d+\.?\d*(?:e[-+]?\d+)?)", re.IGNORECASE)


class PyiqaMetric:
    """A no-reference metric of pyiqa, its stated range mapped to [0, 1], higher better.

    Score = (value - low) / (high - low), clipped, or 1 minus that where lower is better. The range
    is the metric's own ``score_range``, which pyiqa calls a rough estimate.

    An `ImportError` if pyiqa is not installed; a `ValueError` if it has no such metric as
    ``pyiqa.create_metric`` takes, or that needs a reference or has no finite range.
    """

    domain: Domain = "srgb"
    needs = "pip install pyiqa"

    def __init__(self, metric: str) -> None:
        rule = f"`scorer` (='pyiqa:{metric}')"
        try:
            import pyiqa
        except ImportError as error:
            raise ImportError(
                f"{rule} needs pyiqa, which is non-commercial and no extra of this package: "
                f"pip install pyiqa ({error})"
            ) from error
        try:
            self._metric: Any = pyiqa.create_metric(metric, device=torch.device("cpu"))
        except Exception as error:
            what = f"{type(error).__name__}: {error}"
            raise ValueError(f"{rule} cannot be made by pyiqa.create_metric: {what}") from error
        if getattr(self._metric, "metric_mode", "NR") != "NR":
            raise ValueError(f"{rule} must be a metric that needs no reference picture")
        stated = getattr(self._metric, "score_range", None)  # such as "~0, ~100"
        numbers = [float(n) for n in _NUMBER.findall(str(stated))]
        if len(numbers) != 2 or not all(map(math.isfinite, numbers)) or numbers[0] >= numbers[1]:
            raise ValueError(
                f"{rule} states the score range {stated!r}, which must be two finite numbers to be "
                "mapped to [0, 1]: wrap the metric in a scorer of your own"
            )
        self.metric, (self.low, self.high) = metric, numbers
        self.lower_better = bool(getattr(self._metric, "lower_better", False))

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        with torch.no_grad():
            values = torch.as_tensor(self._metric(images.cpu())).double().reshape(len(images))
        share = ((values - self.low) / (self.high - self.low)).clamp(0.0, 1.0)
        return 1.0 - share if self.lower_better else share
