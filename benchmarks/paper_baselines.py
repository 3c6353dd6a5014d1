"""The paper's two baselines (section 4.3): networks that know the settings, but no physics.

They are presets of `build_modules` once this module is imported. In a clone they are trained by

    python -m benchmarks.paper_baselines train-simulator configs/simulator/pc.yaml

Both take ``parameters``: log2(ISO / 100), log2(exposure time / s) and log2(f-number) of the
source, then of the target. Both predict the target raw itself, not a residual.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from simulator.networks.unet import LEAK, instance_norm
from simulator.networks.weights import BUILDERS

#: Camera parameters of a pair: three of the source, three of the target.
NUM_PARAMETERS = 6
#: Networks get ``(parameters + offset) / unit``: of an image's order and, from ISO 100, 1/8000 s
#: and f/1 up, not negative. Leaky layers that start as the identity would shrink a negative plane
#: to 0.2^9 of itself, and the exposure time would be lost.
PARAMETER_OFFSET = (0.0, 13.0, 0.0, 0.0, 13.0, 0.0)
PARAMETER_UNIT = 8.0


def scaled_parameters(parameters: Tensor, image: Tensor) -> Tensor:
    """Parameters (B, 6) as the networks get them, on the device and in the dtype of `image`."""
    return (parameters.to(image) + image.new_tensor(PARAMETER_OFFSET)) / PARAMETER_UNIT


class AdaptiveNorm(nn.Module):
    """``lambda * x + mu * BN(x)``, both learnt scalars, from lambda = 1 and mu = 0."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.identity = nn.Parameter(torch.ones(()))
        self.normalised = nn.Parameter(torch.zeros(()))
        self.norm = nn.BatchNorm2d(width, eps=1e-3, momentum=0.01, affine=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same shape. In training B * H * W must exceed 1."""
        normalised: Tensor = self.norm(x)
        return self.identity * x + self.normalised * normalised


class ParameterConcatenation(nn.Module):
    """Baseline PC: a context aggregation network, the parameters as six constant planes.

    Convolutions of growing dilation that start as the identity. 77,046 parameters.

    Source: Chen, Xu and Koltun 2017, Fast Image Processing with Fully-Convolutional Networks,
    table 1 and equations 2 and 3.
    """

    def __init__(
        self, *, width: int = 32, dilations: Sequence[int] = (1, 2, 4, 8, 16, 32, 64, 128, 1)
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        inputs = 4 + NUM_PARAMETERS
        for dilation in dilations:
            layer = nn.Conv2d(inputs, width, 3, padding=dilation, dilation=dilation)
            nn.init.dirac_(layer.weight)
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
            layers += [layer, AdaptiveNorm(width), nn.LeakyReLU(LEAK)]
            inputs = width
        self.body = nn.Sequential(*layers, nn.Conv2d(width, 4, 1))

    def forward(self, image: Tensor, parameters: Tensor) -> Tensor:
        """The raw (B, 4, H, W) at the target's settings, of any size."""
        scaled = scaled_parameters(parameters, image)
        planes = scaled[:, :, None, None].expand(-1, -1, *image.shape[-2:])
        result: Tensor = self.body(torch.cat([image, planes], dim=1))
        return result


class GeneratedConvolution(nn.Module):
    """A convolution without bias whose kernel is a fully connected layer of the parameters.

    Starts as a He-initialised kernel that the parameters vary by some tens of percent. `upsample`:
    a 4 x 4 transposed convolution of stride 2 in place of 3 x 3, for as many outputs as inputs.
    """

    def __init__(
        self, inputs: int, outputs: int, stride: int = 1, dilation: int = 1, upsample: bool = False
    ) -> None:
        super().__init__()
        size = 4 if upsample else 3
        self.shape = (inputs, outputs, 4, 4) if upsample else (outputs, inputs, 3, 3)
        self.stride, self.dilation, self.upsample = stride, dilation, upsample
        self.generator = nn.Linear(NUM_PARAMETERS, math.prod(self.shape))
        deviation = math.sqrt(2.0 / (inputs * size * size))
        nn.init.normal_(self.generator.bias, std=deviation)
        nn.init.normal_(self.generator.weight, std=0.3 * deviation / math.sqrt(NUM_PARAMETERS))

    def forward(self, x: Tensor, parameters: Tensor) -> Tensor:
        """(B, inputs, H, W) and scaled parameters (B, 6), to (B, outputs, H', W')."""
        batch, channels, height, width = x.shape
        kernels = self.generator(parameters).reshape(-1, *self.shape[1:])  # a group a sample
        x = x.reshape(1, batch * channels, height, width)
        if self.upsample:
            x = F.conv_transpose2d(x, kernels, stride=2, padding=1, groups=batch)
        else:
            x = F.conv2d(x, kernels, None, self.stride, self.dilation, self.dilation, batch)
        return x.reshape(batch, -1, *x.shape[-2:])


class _NormalisedGenerated(nn.Module):
    """`GeneratedConvolution` and instance normalisation with learnt scale and shift."""

    def __init__(self, inputs: int, outputs: int, **convolution: Any) -> None:
        super().__init__()
        self.convolution = GeneratedConvolution(inputs, outputs, **convolution)
        self.scale = nn.Parameter(torch.ones(outputs))
        self.shift = nn.Parameter(torch.zeros(outputs))

    def forward(self, x: Tensor, parameters: Tensor) -> Tensor:
        batch = len(x)
        x = self.convolution(x, parameters)
        return instance_norm(x, self.scale.expand(batch, -1), self.shift.expand(batch, -1))


class _ResidualBlock(nn.Module):
    """Two layers of the same dilation, added to their input."""

    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.first = _NormalisedGenerated(width, width, dilation=dilation)
        self.second = _NormalisedGenerated(width, width, dilation=dilation)

    def forward(self, x: Tensor, parameters: Tensor) -> Tensor:
        return F.relu(x + self.second(F.relu(self.first(x, parameters)), parameters))


def edge_map(image: Tensor) -> Tensor:
    """Mean over planes of the absolute differences to the four neighbours, (B, 1, H, W).

    A neighbour outside the image counts as equal. (Fan et al. 2018 give it to their network.)
    """
    across, down = image.diff(dim=3).abs(), image.diff(dim=2).abs()
    total = F.pad(across, (1, 0)) + F.pad(across, (0, 1))
    total = total + F.pad(down, (0, 0, 1, 0)) + F.pad(down, (0, 0, 0, 1))
    return total.mean(dim=1, keepdim=True) / 4.0


class DecoupledNet(nn.Module):
    """Baseline DL: a network whose convolution weights are generated from the parameters.

    Instance normalisation, which takes the absolute brightness out of the features, and ReLU after
    all convolutions but the last. The image comes with its edge map. 4.88 M parameters.

    Source: Fan et al. 2018, Decouple Learning for Parameterized Image Operators. One thing
    differs: no ReLU on the output, because a packed raw may be negative.
    """

    def __init__(
        self, *, width: int = 64, dilations: Sequence[int] = (2, 4, 4, 8, 8, 16, 1)
    ) -> None:
        super().__init__()
        layer = partial(_NormalisedGenerated, width, width)
        self.head = nn.ModuleList([_NormalisedGenerated(5, width), layer(), layer(stride=2)])
        self.blocks = nn.ModuleList(_ResidualBlock(width, dilation) for dilation in dilations)
        self.neck = nn.ModuleList([layer(upsample=True), layer()])
        self.tail = GeneratedConvolution(width, 4)

    def forward(self, image: Tensor, parameters: Tensor) -> Tensor:
        """The raw (B, 4, H, W) at the target's settings, of any size."""
        height, width = image.shape[-2:]
        scaled = scaled_parameters(parameters, image)
        x = torch.cat([image, edge_map(image)], dim=1)
        for layer in self.head:
            x = F.relu(layer(x, scaled))
        for block in self.blocks:
            x = block(x, scaled)
        for layer in self.neck:
            x = F.relu(layer(x, scaled)[..., :height, :width])  # an odd size came out one larger
        result: Tensor = self.tail(x, scaled)
        return result


BUILDERS["pc"] = lambda: nn.ModuleDict({"baseline": ParameterConcatenation()})
BUILDERS["dl"] = lambda: nn.ModuleDict({"baseline": DecoupledNet()})

if __name__ == "__main__":
    from agents.cli.main import main

    main()
