"""How a scene lies before the lens: what is out of focus, and which part of it is the subject."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import distance_transform_edt

from simulator.utils.checks import check_number

#: Levels that `Layout.shares` counts defocus in.
_LEVELS = 255


class Shares(NamedTuple):
    """A layout's pixels, counted; K sorts of them.

    Args:
        defocus: (K,) circle of confusion relative to the largest.
        subject: (K,) bool, whether they are the subject's.
        share: (K,) of all pixels.
    """

    defocus: np.ndarray
    subject: np.ndarray
    share: np.ndarray


@dataclass(frozen=True, eq=False)
class Layout:
    """Where a scene is out of focus, and where its subject is.

    Args:
        defocus: (H, W) float32 in [0, 1], circle of confusion relative to that of a scene's
            `defocus`; 0 is the plane of focus.
        subject: (H, W) bool, the pixels of the subject, which may move apart from the rest; None
            for no subject.

    Raises:
        ValueError: If a shape, a type or a value is none of these.
    """

    defocus: torch.Tensor
    subject: torch.Tensor | None = None

    def __post_init__(self) -> None:
        found, mask = self.defocus, self.subject
        for name, value in (("defocus", found), ("subject", mask)):
            if not isinstance(value, torch.Tensor) and (name == "defocus" or value is not None):
                raise ValueError(f"`{name}` (={type(value).__name__}) must be a torch tensor")
        if found.ndim != 2 or not bool(((found >= 0.0) & (found <= 1.0)).all()):
            raise ValueError(f"`defocus` (shape {tuple(found.shape)}) must be (H, W) in [0, 1]")
        object.__setattr__(self, "defocus", found.detach().float().cpu().contiguous())
        if mask is None:
            return
        if mask.dtype != torch.bool or mask.shape != found.shape:
            raise ValueError(
                f"`subject` ({mask.dtype}, shape {tuple(mask.shape)}) must be bool of the shape of "
                f"`defocus`, {tuple(found.shape)}"
            )
        count = int(mask.count_nonzero())
        known = mask.cpu().contiguous() if 0 < count < mask.numel() else None
        object.__setattr__(self, "subject", known)

    @classmethod
    def from_depth(cls, depth: torch.Tensor, distance: float, *, in_focus: float) -> Layout:
        """The layout of a scene whose depth is known; the subject is what is in focus.

        The circle of confusion goes with the difference of the inverse distances.

        Args:
            depth: (H, W) distance [m], above 0.
            distance: At which the lens is focused [m].
            in_focus: Largest relative circle of confusion of the subject.

        Raises:
            ValueError: If an argument is out of range.
        """
        if not isinstance(depth, torch.Tensor) or not bool((depth > 0.0).all()):
            raise ValueError("`depth` must be a torch tensor with every value above 0 and not NaN")
        if not 0.0 < distance < math.inf:
            raise ValueError(f"`distance` (={distance}) must be above 0 and finite")
        check_number("in_focus", in_focus, 0.0, 1.0)
        apart = (1.0 / depth.double() - 1.0 / distance).abs()
        relative = (apart / apart.max().clamp(min=1e-12)).float()
        return cls(relative, relative <= in_focus)

    def averaged(self, factor: int) -> Layout:
        """Means over `factor` x `factor` pixels; the subject is where it has most of them."""

        def mean(values: torch.Tensor) -> torch.Tensor:
            return F.avg_pool2d(values[None].double(), factor)[0]

        subject = None if self.subject is None else mean(self.subject) > 0.5
        return Layout(mean(self.defocus).float().clamp(max=1.0), subject)

    def cut(self, rows: slice, columns: slice) -> Layout:
        """A window of it."""
        subject = None if self.subject is None else self.subject[rows, columns]
        return Layout(self.defocus[rows, columns], subject)

    @cached_property
    def shares(self) -> Shares:
        """The pixels, counted by defocus (in steps of 1/255) and subject."""
        levels = (self.defocus * _LEVELS).round().int().numpy()
        if self.subject is not None:
            levels = levels + (_LEVELS + 1) * self.subject.numpy()
        sorts, counts = np.unique(levels, return_counts=True)
        subject = sorts > _LEVELS
        defocus = (sorts - (_LEVELS + 1) * subject) / _LEVELS
        return Shares(defocus, subject, counts / levels.size)

    @cached_property
    def mask(self) -> torch.Tensor:
        """(1, H, W) float32, 1 where the subject is."""
        assert self.subject is not None
        return self.subject[None].float()

    @cached_property
    def behind(self) -> torch.Tensor:
        """(H, W) int64, the pixel of the background nearest to each, counted row by row."""
        assert self.subject is not None
        rows, columns = distance_transform_edt(
            self.subject.numpy(), return_distances=False, return_indices=True
        )
        return torch.from_numpy(rows.astype(np.int64) * self.subject.shape[1] + columns)
