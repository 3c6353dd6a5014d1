"""The convolutional features that the learnt agents share."""

from __future__ import annotations

import gymnasium as gym
import torch
from torch import nn

from ae_env.observation import PEDESTAL, SETTINGS_RANGES

#: Range of log2 luminance that the absolute plane maps to about [-1, 1].
_LUMINANCE_CENTRE, _LUMINANCE_SCALE = 3.0, 8.0
#: The smallest signal that the absolute plane shows.
_SIGNAL_FLOOR = 2.0**-12


class ExposureFeatures(nn.Module):
    """A small CNN over the raw and its absolute luminance, and the numbers beside it.

    The raw alone does not tell a bright scene from a long exposure. A plane of absolute log
    luminance, log2 of the decoded green plus the EV100 of the frame's settings, does; it is the one
    input that made the difference in trials. The planes are averaged over 2 x 2 pixels first, with
    the maximum of the luminance kept beside: exposure is decided on coarse structure.

    Args:
        observation_space: Observation of a single environment, with a uint8 ``raw``.
        width: Output features.

    Raises:
        ValueError: If the raw is not observed as uint8.
    """

    def __init__(self, observation_space: gym.spaces.Dict, width: int = 256) -> None:
        super().__init__()
        raw = observation_space["raw"]
        if raw.dtype != "uint8" or raw.shape is None:
            raise ValueError(f"`observation_space['raw']` (={raw}) must be a uint8 image")
        self.has_sensors = "sensors" in observation_space.spaces
        self.numbers = 3 + (2 if self.has_sensors else 0)
        self.cnn = nn.Sequential(
            nn.Conv2d(6, 32, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(32, 48, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(48, 48, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
        )
        with torch.no_grad():
            flat = self.cnn(torch.zeros(1, 6, *(s // 2 for s in raw.shape[1:]))).shape[1]
        self.head = nn.Sequential(nn.Linear(flat + self.numbers, width), nn.ReLU())
        self.ranges: torch.Tensor
        ranges = torch.tensor(SETTINGS_RANGES, dtype=torch.float32)
        self.register_buffer("ranges", ranges, persistent=False)

    def forward(
        self, codes: torch.Tensor, settings: torch.Tensor, sensors: torch.Tensor | None
    ) -> torch.Tensor:
        """Features (B, width).

        Args:
            codes: (B, 4, H, W) float, the observed raw divided by 255.
            settings: (B, 3) float in [-1, 1].
            sensors: (B, 2) float in [-1, 1]; None where they are not observed.
        """
        low, high = self.ranges.unbind(dim=1)
        apex = low + (settings + 1.0) * 0.5 * (high - low)  # Av, Tv, Sv
        ev100 = apex[:, 0] + apex[:, 1] - apex[:, 2] + 5.0
        green = 0.5 * (codes[:, 1:2] + codes[:, 2:3])
        signal = (1.0 + PEDESTAL) * green.square() - PEDESTAL
        luminance = signal.clamp(min=_SIGNAL_FLOOR).log2() + ev100[:, None, None, None]
        luminance = (luminance - _LUMINANCE_CENTRE) / _LUMINANCE_SCALE  # (B, 1, H, W)
        planes = [
            nn.functional.avg_pool2d(codes, 2),
            nn.functional.avg_pool2d(luminance, 2),
            nn.functional.max_pool2d(luminance, 2),
        ]
        numbers = settings if sensors is None else torch.cat([settings, sensors], dim=1)
        features = self.cnn(torch.cat(planes, dim=1))
        return self.head(torch.cat([features, numbers], dim=1))
