"""Exposure module: the linear change of brightness, corrected for the errors of a body."""

from __future__ import annotations

import torch
from torch import Tensor, nn

#: Pixels above this in the source are over-exposed: their true light is unknown (section 3.1).
OVER_EXPOSED = 0.99


class ExposureModule(nn.Module):
    """``w * ratio * (raw + b)``, w a scalar (from 1) and b one number per plane (from 0).

    b corrects an inaccurate black level, w a shutter and a lens that deviate from their nominal
    values (paper, section 3.1; the model of Abdelhamed et al. 2018). The paper clips the result
    to [0, 1]; here the clip comes last, after blur and noise (see `simulator.capture`).
    """

    def __init__(self) -> None:
        super().__init__()
        self.w = nn.Parameter(torch.ones(()))
        self.b = nn.Parameter(torch.zeros(4))

    def forward(self, raw: Tensor, ratio: Tensor | float) -> Tensor:
        """The raw ((B,) 4, H, W) at another exposure, one `ratio` or (B,), not clipped."""
        scale = self.w * torch.as_tensor(ratio, dtype=raw.dtype, device=raw.device)
        if scale.ndim:
            scale = scale[:, None, None, None]
        return (raw + self.b[:, None, None]) * scale

    @property
    def is_identity(self) -> bool:
        """Whether w = 1 and b = 0: nothing was learnt."""
        return bool(self.w == 1.0) and not bool(self.b.any())


class LinearFit:
    """Accumulates the least squares of w and b over pairs of captures.

    Minimises ``sum((w ratio (I_1 + b_p) - I_2)^2)`` over pixels with I_1 <= 0.99: linear in w and
    in ``v_p = w b_p``, five unknowns.
    """

    def __init__(self) -> None:
        self._normal = torch.zeros(5, 5, dtype=torch.float64)
        self._right = torch.zeros(5, dtype=torch.float64)

    def add(self, source: Tensor, target: Tensor, ratio: Tensor) -> None:
        """Takes in captures (B, 4, H, W) of one camera and their exposure ratios (B,).

        Saturated pixels of the target say nothing about w either and are left out.
        """
        scale = ratio.double()[:, None, None, None]
        used = ((source <= OVER_EXPOSED) & (target <= OVER_EXPOSED)).double()
        light = scale * source.double()
        wanted = target.double()
        offset = scale.expand_as(light)
        self._normal[0, 0] += (used * light * light).sum()
        self._right[0] += (used * light * wanted).sum()
        cross = (used * light * offset).sum((0, 2, 3))
        self._normal[0, 1:] += cross
        self._normal[1:, 0] += cross
        self._normal[range(1, 5), range(1, 5)] += (used * offset * offset).sum((0, 2, 3))
        self._right[1:] += (used * offset * wanted).sum((0, 2, 3))

    def solve(self) -> ExposureModule:
        """The module with the fitted w and b.

        Raises:
            ValueError: If no unsaturated pixels were taken in.
        """
        try:
            solution = torch.linalg.solve(self._normal, self._right)
        except torch.linalg.LinAlgError:  # type: ignore[attr-defined]
            raise ValueError("`captures` must hold unsaturated pixels of every plane") from None
        module = ExposureModule()
        with torch.no_grad():
            module.w.copy_(solution[0])
            module.b.copy_(solution[1:] / solution[0])
        return module.requires_grad_(False)
