"""A small detector and descriptor of local features, and how matches are made of them."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

#: Pixels a side of a cell that holds at most one keypoint.
CELL = 4
#: Keypoints closer than this to the border are left out, and to a stronger one [pixel].
BORDER, SPACING = 4, 3
DESCRIPTOR = 64


class Features(NamedTuple):
    """Keypoints of one picture, the strongest first: x and y [pixel] (N, 2), 0 at the middle of the
    first pixel, and descriptors (N, D) of length 1."""

    points: Tensor
    descriptors: Tensor


def _double(channels_in: int, channels: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for given in (channels_in, channels):
        layers += [nn.Conv2d(given, channels, 3, padding=1, bias=False)]
        layers += [nn.BatchNorm2d(channels), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class Detector(nn.Module):
    """Scores and dense descriptors of a picture, both from one encoder.

    After SuperPoint (DeTone et al. 2018): a softmax over the pixels of a cell and "none of them",
    and normalised descriptors that are interpolated. It is smaller, and its cells are finer.
    """

    def __init__(self) -> None:
        super().__init__()
        widths = (16, 32, 64, 64)
        self.levels = nn.ModuleList(
            _double(given, width) for given, width in zip((1, *widths), widths, strict=False)
        )
        self.merged = nn.Sequential(nn.Conv2d(128, 64, 1, bias=False), nn.BatchNorm2d(64))
        self.score = nn.Sequential(
            nn.Conv2d(64, 32, 3, padding=1), nn.ReLU(), nn.Conv2d(32, CELL**2 + 1, 1)
        )
        self.descriptor = nn.Conv2d(64, DESCRIPTOR, 1)

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (B, 17, H/4, W/4), the last of "none", and descriptors (B, 64, H/4, W/4).

        `pictures` (B, 3, H, W) are sRGB in [0, 1], H and W multiples of 8.
        """
        grey = 0.299 * pictures[:, :1] + 0.587 * pictures[:, 1:2] + 0.114 * pictures[:, 2:]
        # Every picture to the same mean and contrast, so that a gap is not hopeless from the start.
        deviation, mean = torch.std_mean(grey, dim=(1, 2, 3), keepdim=True)
        x = (grey - mean) / (deviation + 1e-3)
        for index, level in enumerate(self.levels):
            x = level(x if index == 0 else F.max_pool2d(x, 2))
            if index == 2:
                fine = x
        x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
        x = F.relu(self.merged(torch.cat([fine, x], dim=1)))
        return self.score(x), self.descriptor(x)

    @torch.no_grad()
    def detect(self, pictures: Tensor, count: int) -> list[Features]:
        """The `count` strongest keypoints of each picture."""
        logits, dense = self(pictures.contiguous(memory_format=torch.channels_last))
        scores = F.pixel_shuffle(logits.softmax(dim=1)[:, :-1], CELL)
        largest = F.max_pool2d(scores, 2 * SPACING + 1, 1, SPACING)
        scores = torch.where(scores == largest, scores, 0.0)[:, 0]
        scores = F.pad(scores[:, BORDER:-BORDER, BORDER:-BORDER], (BORDER,) * 4)
        found = []
        for score, maps in zip(scores, dense, strict=True):
            values, index = score.flatten().topk(count)
            index = index[values > 0]
            points = torch.stack([index % score.shape[1], index // score.shape[1]], dim=1).float()
            found.append(Features(points, sample(maps[None], points[None])[0]))
        return found


def sample(dense: Tensor, points: Tensor) -> Tensor:
    """Descriptors (B, K, D) of length 1 at points (B, K, 2) of pictures, of a map of cells."""
    height, width = (CELL * n for n in dense.shape[-2:])
    size = torch.tensor([width, height], dtype=points.dtype)
    grid = (points + 0.5) / size * 2.0 - 1.0
    values = F.grid_sample(dense, grid[:, :, None], align_corners=False, padding_mode="border")
    return F.normalize(values[..., 0].transpose(1, 2), dim=-1)


def mutual_matches(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Indices of descriptors (N, D) and (M, D) that are each other's nearest."""
    if not len(first) or not len(second):
        none = torch.zeros(0, dtype=torch.int64)
        return none, none
    similar = first @ second.T
    forth, back = similar.argmax(dim=1), similar.argmax(dim=0)
    index = torch.arange(len(first))
    mutual = back[forth] == index
    return index[mutual], forth[mutual]
