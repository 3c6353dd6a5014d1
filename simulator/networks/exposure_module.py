"""Exposure module: the linear change of brightness, corrected for the errors of a body."""

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
