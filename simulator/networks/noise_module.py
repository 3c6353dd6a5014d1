"""Noise module: removes the source's noise, so that the target's can take its place."""

import itertools
from typing import Literal, NamedTuple, Self, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from simulator.capture.statistics import Residual
from simulator.networks.unet import UNet, padded
from simulator.noise.generator import frame_normals, noise_keys
from simulator.raw.develop import window_means
from simulator.utils.checks import check_word

Preset = Literal["nano", "compact", "large", "paper", "ncs"]
#: Side of the window that smooths the signal which the noise level is read from.
_SMOOTHING = 5
#: Seed of the sample of noise that is an input of the authors' network.
_SAMPLE_SEED = 1234
#: Windows of the local means [packed pixel]: the near one divides detail from surroundings, the far
#: one shows the network the noise that the near mean still has.
_NEAR, _FAR = 17, 65
#: Side of the cells on which the far mean and the correction of the mean are worked out.
_CELL = 8
#: Window of the correction of the mean [cells].
_MEAN_CELLS = 17
#: Largest change of a pixel, in standard deviations of its noise.
_LARGEST = 5.0
#: The network's inputs, detail and level, are compressed beyond this many standard deviations.
_LEVEL = 8.0

#: The family: channels of each level, the finest first, each with half the resolution of the one
#: before.
SIZES = {"nano": (16, 24, 32), "compact": (32, 48, 80, 96), "large": (48, 96, 176, 256)}
#: What bfloat16 changes of a result, in units of the noise that is removed: root mean square over
#: 44 validation scenes at ISO 100 to 6400 (single ones: 0.006 to 0.027).
BFLOAT16_ERROR = {"nano": 0.009, "compact": 0.012, "large": 0.013}
#: `NoiseModule.operations` by preset, as torch's `FlopCounterMode` counts them on 32 x 32 pixels.
_OPERATIONS = {"nano": 41472, "compact": 177792, "large": 608768, "paper": 430848, "ncs": 949760}


class Stabiliser(NamedTuple):
    """Transform of a raw into a picture whose noise has a standard deviation of about 1.

    ``z = 2 y / (sqrt(shot y + c) + sqrt(c))`` with ``c = read + 3/8 shot^2``: the generalised
    Anscombe transform less its value at 0, in a form that stays exact as shot goes to 0, where it
    becomes ``y / sigma``. Below 0 it goes on as a straight line. `root` is ``sqrt(c)``, above 0;
    both are (B, 4, 1, 1).
    """

    shot: Tensor
    root: Tensor

    @classmethod
    def of(cls, shot: Tensor, read: Tensor) -> Self:
        """For noise of (B, 4) `shot` and `read`, in float32."""
        shot, read = (v.float()[:, :, None, None] for v in (shot, read))
        return cls(shot, (read + 0.375 * shot.square()).sqrt().clamp(min=1e-18))

    def forward(self, y: Tensor) -> Tensor:
        """Stabilised picture of a raw (B, 4, H, W)."""
        positive = y.clamp(min=0.0)
        bent = 2.0 * positive / ((self.shot * positive + self.root.square()).sqrt() + self.root)
        return bent + (y - positive) / self.root

    def inverse(self, z: Tensor) -> Tensor:
        """Raw (B, 4, H, W) of a stabilised picture.

        Algebraically, ``sqrt(c) z + shot z^2 / 4``. That the mean of a square is more than the
        square of the mean is left to the network, whose error is measured after this step.
        """
        return self.root * z + 0.25 * self.shot * z.clamp(min=0.0).square()

    @property
    def linearity(self) -> Tensor:
        """In [0, 1]: 1 where read noise rules, 0 where photons do."""
        return self.root / (self.root + self.shot)


class Denoiser(nn.Module):
    """Estimates the noise of a raw in units of its standard deviation, at most 5 of them.

    The network sees the stabilised picture less its mean over 17 x 17 pixels, how that mean
    differs from the one over 65 x 65, the level itself, and how linear the stabilisation is.
    What it takes away is corrected such that the mean over about 136 x 136 pixels stays: noise has
    a mean of zero, so nothing else may be taken on average. `size` is a name in `SIZES`.
    """

    def __init__(self, size: str = "compact") -> None:
        super().__init__()
        widths = SIZES[size]
        self.stride = 2 ** (len(widths) - 1)
        self.head = nn.Conv2d(16, widths[0], 3, padding=1)
        self.encode = nn.ModuleList(ResidualBlock(w) for w in widths[:-1])
        self.down = nn.ModuleList(
            nn.Conv2d(fine, coarse, 2, stride=2) for fine, coarse in itertools.pairwise(widths)
        )
        self.coarsest = nn.Sequential(*(ResidualBlock(widths[-1]) for _ in range(2)))
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(coarse, fine, 2, stride=2)
            for fine, coarse in itertools.pairwise(widths)
        )
        self.decode = nn.ModuleList(ResidualBlock(w) for w in widths[:-1])
        self.tail = nn.Conv2d(widths[0], 4, 3, padding=1)
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="linear")
                assert module.bias is not None
                nn.init.zeros_(module.bias)
            if isinstance(module, ResidualBlock):  # starts near the identity: no warm-up needed
                with torch.no_grad():
                    module.second.weight.mul_(0.1)
        nn.init.zeros_(self.tail.weight)  # it starts by changing nothing

    def forward(self, image: Tensor, shot: Tensor, read: Tensor) -> Tensor:
        """Noise-reduced raw (B, 4, H, W), float32, of any exposure.

        `shot` (B, 4) is the slope of the noise variance, on the same scale, `read` (B, 4) the
        variance at zero signal.
        """
        clean = self.uncorrected(image, self.surroundings(image, shot, read), shot, read)
        # In training a residual that is the same everywhere must cost something.
        return clean if self.training else self.corrected(clean, image, shot, read)

    def surroundings(self, image: Tensor, shot: Tensor, read: Tensor) -> Tensor:
        """The stabilised picture's mean over 65 x 65 pixels, (B, 4, H, W), of the whole frame."""
        height, width = image.shape[-2:]
        far = _coarse_mean(
            Stabiliser.of(shot, read).forward(padded(image.float(), _CELL)), _FAR // _CELL | 1
        )
        return far[..., :height, :width]

    def uncorrected(self, image: Tensor, far: Tensor, shot: Tensor, read: Tensor) -> Tensor:
        """The network alone; a pixel depends on those within 80 pixels, and on place modulo 8.

        `image` may be a part of a frame; `far` is its `surroundings`.
        """
        height, width = image.shape[-2:]
        stabiliser = Stabiliser.of(shot, read)
        z, far = stabiliser.forward(padded(image.float(), _CELL)), padded(far.float(), _CELL)
        near = box_mean(z, _NEAR)
        features = [
            _LEVEL * _asinh((z - near) / _LEVEL),
            _asinh(4.0 * (near - far)),
            _asinh(near / _LEVEL),
            stabiliser.linearity.expand_as(z),
        ]
        del near, far
        features[:] = [torch.cat(features, dim=1)]
        residual = self._residual(features.pop()).float()  # the tile's memory is the network's now
        # Bounded by a function whose slope never vanishes: a saturated network must still learn.
        clean = stabiliser.inverse(z + residual * (1.0 + (residual / _LARGEST).square()).rsqrt())
        return clean[..., :height, :width]

    def corrected(self, clean: Tensor, image: Tensor, shot: Tensor, read: Tensor) -> Tensor:
        """`clean` of a whole frame with the local mean of `image`, in units of the noise."""
        height, width = image.shape[-2:]
        root = Stabiliser.of(shot, read).root
        sigma = (shot.float()[:, :, None, None] * clean.clamp(min=0.0)).add_(root.square()).sqrt_()
        taken = ((image.float() - clean) / sigma).clamp_(-2.0 * _LARGEST, 2.0 * _LARGEST)
        mean = _coarse_mean(padded(taken, _CELL), _MEAN_CELLS)[..., :height, :width]
        # Windows are smaller at the borders, so these count more than their share: made up for.
        rest = (sigma * (taken - mean)).mean(dim=(2, 3), keepdim=True)
        return clean + sigma * (mean + rest / sigma.mean(dim=(2, 3), keepdim=True))

    def _residual(self, x: Tensor) -> Tensor:
        x = self.head(x)
        skips = []
        for block, down in zip(self.encode, self.down, strict=True):
            x = block(x)
            skips.append(x)
            x = down(x)
        x = self.coarsest(x)
        for block, up in zip(reversed(self.decode), reversed(self.up), strict=True):
            x = up(x).add_(skips.pop())  # on large frames these are most of the memory
            x = block(x)
        return self.tail(x)


def _asinh(x: Tensor) -> Tensor:
    """Inverse hyperbolic sine, of vectorised functions: torch's own takes three times as long."""
    size = x.abs().clamp(max=1e18)  # whose square is finite
    square = size.square()
    return torch.log1p(size + square / (1.0 + (1.0 + square).sqrt())).copysign(x)


def _coarse_mean(x: Tensor, cells: int) -> Tensor:
    """Local mean over `cells` x `cells` cells of 8 x 8 pixels, between cells interpolated.

    Only cells of the frame count: at its borders the window is smaller.
    """
    means = window_means(F.avg_pool2d(x, _CELL), cells)
    return F.interpolate(means, x.shape[-2:], mode="bilinear", align_corners=False)


class ResidualBlock(nn.Module):
    """``x + conv(relu(conv(x)))``, 3 x 3, the first dilated."""

    def __init__(self, width: int, *, dilation: int = 1) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation)
        self.second = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same shape."""
        # In place where autograd allows it: on large frames fresh memory costs as much as the sums.
        return self.second(F.relu_(self.first(x))).add_(x)


class NoiseModule(nn.Module):
    """Denoises an exposed raw of known noise level function.

    The presets ``"nano"``, ``"compact"`` and ``"large"`` are a `Denoiser` of that size, which
    commutes with exposure; ``"paper"`` is the U-Net of Brooks et al. 2019 with a noise-level map,
    as the paper uses it (section 3.2); ``"ncs"`` is the U-Net of the authors' released code, whose
    second input is a sample of the noise in place of its level. The sample is always the same, so
    that results can be shared between captures.
    """

    def __init__(self, preset: Preset = "compact") -> None:
        super().__init__()
        check_word("preset", preset, get_args(Preset))
        self.preset = preset
        self.residual: Residual | None = None  # known once it is trained
        if preset == "paper" or preset == "ncs":
            self.network: nn.Module = UNet(preset)
        else:
            self.network = Denoiser(preset)

    @property
    def commutes(self) -> bool:
        """Whether it commutes with exposure: denoising at any exposure gives the same light."""
        return self.preset in SIZES

    @property
    def operations(self) -> int:
        """Arithmetic operations of its convolutions per packed pixel, a sum and a product each."""
        return _OPERATIONS[self.preset]

    def forward(self, exposed: Tensor, shot: Tensor, read: Tensor) -> Tensor:
        """The raw with little noise, float32; one without noise (shot = read = 0) as it is.

        `exposed` (B, 4, H, W) is on the scale of the target, as are the slope `shot` (B, 4) of its
        noise variance and the variance `read` (B, 4) at zero signal.
        """
        if self.commutes:
            result = self.network(exposed, shot, read)
        else:
            level = second = variance_map(exposed, shot, read).sqrt()
            if self.preset == "ncs":  # the same sample for every image of this size
                key = int(noise_keys(_SAMPLE_SEED)[0])
                sample = torch.from_numpy(frame_normals(key, tuple(exposed.shape[1:])))
                second = exposed + level * sample[None].to(exposed.device)
            result = exposed + self.network(torch.cat([exposed, second], dim=1)).float()
        noisy = ((shot > 0) | (read > 0)).any(dim=1)
        return torch.where(noisy[:, None, None, None], result, exposed.float())


def variance_map(signal: Tensor, shot: Tensor, read: Tensor) -> Tensor:
    """Noise variance ``read + shot * max(signal, 0)`` of each pixel, (B, 4, H, W) float32."""
    slope, offset = (v.float()[:, :, None, None] for v in (shot, read))
    return signal.float().clamp(min=0.0) * slope + offset


def smoothed(image: Tensor) -> Tensor:
    """Mean over 5 x 5 pixels, borders repeated.

    A noise level read from single noisy pixels would be too low where noise made them dark.
    """
    return box_mean(image, _SMOOTHING)


def box_mean(x: Tensor, window: int) -> Tensor:
    """Mean of `x` (B, C, H, W) over `window` x `window` pixels, an odd number, borders repeated.

    Sums over 1, 2, 4, 8 ... pixels are doubled from one another: a few additions of whole images
    where pooling would read every pixel `window` times.
    """
    height, width = x.shape[-2:]
    rows = _running_sum(F.pad(x, (window // 2,) * 4, mode="replicate"), window, -2, height)
    return _running_sum(rows, window, -1, width) / (window * window)


def _running_sum(x: Tensor, window: int, axis: int, size: int) -> Tensor:
    """Sums of `window` neighbours along `axis`, the first `size` of them."""
    total: Tensor | None = None
    done, span = 0, 1
    while True:
        if window & span:
            part = x.narrow(axis, done, size)
            total = part if total is None else total + part
            done += span
        if 2 * span > window:
            assert total is not None
            return total
        length = x.shape[axis] - span
        x = x.narrow(axis, 0, length) + x.narrow(axis, span, length)
        span *= 2
