"""The network of NIMA: MobileNet v1 with ten ratings as its output."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.utils import fuse_conv_bn_eval

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
        return self.head(features).softmax(dim=1)


def nima_network(weights: dict[str, Tensor]) -> NimaMobileNet:
    """The network with these weights, ready for inference.

    Args:
        weights: Its state, as `ae_env.scorers.nima_weights.read_weights` gives it.
    """
    network = NimaMobileNet()
    # What counts the batches of a training is not among the published numbers.
    counts = {k: v for k, v in network.state_dict().items() if k.endswith("num_batches_tracked")}
    network.load_state_dict({**counts, **weights})
    network.eval().requires_grad_(False)
    for layer in network.features:
        assert isinstance(layer, ConvNormReLU6)
        layer.fuse()
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
