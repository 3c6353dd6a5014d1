"""NIMA: the mean opinion that a network trained on human ratings expects."""

from __future__ import annotations

import hashlib
import os
from functools import lru_cache

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils import fuse_conv_bn_eval

from ae_env.scorers.protocol import Captures, DependsOn, Domain
from ae_env.utils.model_files import find_model_file

# -- the network: MobileNet v1 with ten ratings as its output -------------------------------------

#: Ratings are from 1 to this.
RATINGS = 10
#: Added to the variance in Keras' MobileNet.
_EPS = 1e-3
#: Output channels and stride of the 13 depthwise separable blocks.
_BLOCKS = (
    *((64, 1), (128, 2), (128, 1), (256, 2), (256, 1), (512, 2)),
    *((512, 1), (512, 1), (512, 1), (512, 1), (512, 1), (1024, 2), (1024, 1)),
)


class ConvNormReLU6(nn.Sequential):
    """Convolution without bias, batch normalisation and ReLU6, padded as Keras' MobileNet is.

    With stride 2 only the right and the lower edge are padded, by one pixel.

    Args:
        inputs: Channels.
        outputs: Channels.
        kernel: 1 or 3.
        stride: 1 or 2.
        groups: Of the convolution; `inputs` makes it depthwise.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, groups: int = 1):
        padding = (kernel - 1) // 2 if stride == 1 else 0
        convolution = nn.Conv2d(inputs, outputs, kernel, stride, padding, groups=groups, bias=False)
        super().__init__(
            nn.ZeroPad2d((0, 1, 0, 1)) if stride == 2 else nn.Identity(),
            convolution,
            nn.BatchNorm2d(outputs, eps=_EPS),
            nn.ReLU6(),
        )

    def fuse(self) -> None:
        """Takes the normalisation into the convolution, for inference only."""
        convolution, normalisation = self[1], self[2]
        assert isinstance(convolution, nn.Conv2d)
        assert isinstance(normalisation, nn.BatchNorm2d)
        self[1] = fuse_conv_bn_eval(convolution, normalisation)
        self[2] = nn.Identity()


class NimaMobileNet(nn.Module):
    """MobileNet v1 (width 1) with ten ratings as its output: 3,239,114 numbers.

    Source: Howard et al., MobileNets, 2017; Talebi and Milanfar, NIMA: Neural Image Assessment,
    IEEE Transactions on Image Processing 27(8), 2018, with the head of the published weights:
    global mean, then one dense layer.
    """

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = [ConvNormReLU6(3, 32, 3, 2)]
        inputs = 32
        for outputs, stride in _BLOCKS:
            layers.append(ConvNormReLU6(inputs, inputs, 3, stride, groups=inputs))
            layers.append(ConvNormReLU6(inputs, outputs, 1, 1))
            inputs = outputs
        self.features = nn.Sequential(*layers)
        self.head = nn.Linear(inputs, RATINGS)

    def forward(self, pictures: Tensor) -> Tensor:
        """Share of each rating.

        Args:
            pictures: (B, 3, 224, 224) in [-1, 1].

        Returns:
            (B, 10), each row sums to 1.
        """
        features = self.features(pictures).mean(dim=(2, 3))
        ratings: Tensor = self.head(features).softmax(dim=1)
        return ratings


#: Git blob ids of the published Keras files, by the scorer that they make.
PUBLISHED = {
    "nima_aesthetic": "003fb321ce92445e41d708144a3656589f9214e7",
    "nima_technical": "5e4a4ca2ce639309bfa4038d0bc10ba92b93bd26",
}


def read_network(file: str | os.PathLike[str]) -> NimaMobileNet:
    """The network of a file, ready for inference.

    Args:
        file: ``.safetensors``, as ``examples/convert_nima.py`` writes it.

    Raises:
        ValueError: If it cannot be read, or is not of this network.
    """
    network = NimaMobileNet()
    try:
        weights = load_file(file)
        missing, unexpected = network.load_state_dict(weights, strict=False)
    except (OSError, SafetensorError, RuntimeError) as error:
        raise ValueError(
            f"`file` (={str(file)!r}) must be weights of NIMA's MobileNet in .safetensors: {error}"
        ) from error
    # The counters of training batches are not among the published numbers.
    missing = [key for key in missing if not key.endswith("num_batches_tracked")]
    if missing or unexpected:
        raise ValueError(
            f"`file` (={str(file)!r}) must hold exactly the arrays of NIMA's MobileNet: {missing} "
            f"are missing, {unexpected} are none of it"
        )
    for key, values in weights.items():
        if not bool(values.isfinite().all()):
            raise ValueError(f"`file` (={str(file)!r}): {key} must be finite")
    network.eval().requires_grad_(False)
    for layer in network.features:
        assert isinstance(layer, ConvNormReLU6)
        layer.fuse()
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network


# -- scorers --------------------------------------------------------------------------------------

#: Side of the pictures that the network was trained on [pixel].
INPUT_SIZE = 224
#: Pictures that the network sees at once: more only spend time in memory paging.
_CHUNK = 8


def mean_rating(network: nn.Module, images: Tensor) -> Tensor:
    """Mean rating (B,) in [1, 10] of sRGB pictures.

    Args:
        network: A `NimaMobileNet`.
        images: (B, 3, H, W) sRGB in [0, 1], resized to 224 x 224 whatever their shape.
    """
    size = (INPUT_SIZE, INPUT_SIZE)
    ratings = torch.arange(1.0, RATINGS + 1.0, dtype=torch.float64)
    means = []
    with torch.no_grad():
        for part in images.split(_CHUNK):  # type: ignore[no-untyped-call]
            if part.shape[2:] != size:
                part = functional.interpolate(part, size, mode="bilinear", antialias=True)
            part = (2.0 * part.clamp(0.0, 1.0) - 1.0).to(memory_format=torch.channels_last)
            means.append(network(part).double() @ ratings)
    return torch.cat(means)


@lru_cache(maxsize=4)
def _network(file: str, digest: str) -> NimaMobileNet:
    """The network of a file, read once per content, which `digest` stands for."""
    return read_network(file)


class Nima:
    """Mean rating of people as a MobileNet expects it: (mean of 1..10 - 1) / 9.

    Talebi and Milanfar, NIMA: Neural Image Assessment, 2018. The weights do not come with the
    package: `file`, else what the scorer's environment variable names, else in the cache folder.

    Args:
        file: Weights (.safetensors) that ``examples/convert_nima.py`` made from the published ones.

    Raises:
        ValueError: If the file is not there or does not fit.
    """

    domain: Domain = "srgb"
    depends_on: DependsOn = "image"
    needs = "weights"
    version = 1
    #: Name of the scorer and of its weights.
    name = ""

    def __init__(self, file: str | os.PathLike[str] | None = None) -> None:
        found = find_model_file(
            self.name,
            file,
            f"AE_ENV_{self.name.upper()}",
            (f"{self.name}.safetensors",),
            how=(
                "examples/convert_nima.py makes it from the published Keras weights, whose git "
                f"blob id is {PUBLISHED[self.name]} (docs/scorers.md)"
            ),
        )
        self.file = str(found.resolve())
        #: SHA-256 of the file: other weights under the same name give other scores.
        self.digest = hashlib.sha256(found.read_bytes()).hexdigest()
        _network(self.file, self.digest)  # raises now, not at the first score

    def __call__(self, images: Tensor | None, captures: Captures) -> Tensor:
        """Scores (B,) of sRGB `images` (B, 3, H, W)."""
        assert images is not None
        return (mean_rating(_network(self.file, self.digest), images) - 1.0) / (RATINGS - 1.0)


class NimaAesthetic(Nima):
    """Aesthetic quality as people rate it: NIMA (2018), trained on AVA."""

    needs = "weights: AE_ENV_NIMA_AESTHETIC"
    name = "nima_aesthetic"


class NimaTechnical(Nima):
    """Technical quality as people rate it: NIMA (2018), trained on TID2013."""

    needs = "weights: AE_ENV_NIMA_TECHNICAL"
    name = "nima_technical"
