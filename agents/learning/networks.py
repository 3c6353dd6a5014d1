"""Networks that the learnt agents share: features of a frame, and values of every state."""

from __future__ import annotations

import gymnasium as gym
import torch
from torch import nn

from ae_env.grid import ExposureGrid
from ae_env.observation import PEDESTAL, SENSOR_RANGES, SETTINGS_RANGES

#: Range of log2 luminance that the absolute plane maps to about [-1, 1].
_LUMINANCE_CENTRE, _LUMINANCE_SCALE = 3.0, 8.0
#: Blocks are averaged so that the planes are about this large.
_PLANE_SIZE = 16
#: Zones of the meter a side.
_ZONES = 4
#: A code at or above this share of full scale counts as clipped.
_CLIPPED = 0.995
#: The smallest signal that the absolute plane shows.
_SIGNAL_FLOOR = 2.0**-12


class ExposureFeatures(nn.Module):
    """A small CNN over the raw and its absolute luminance, and the numbers beside it.

    The raw alone does not tell a bright scene from a long exposure. A plane of absolute log
    luminance, log2 of the decoded green plus the EV100 of the frame's settings, does; it is the one
    input that made the difference in trials. The planes are first averaged to about 16 x 16, with
    the maximum of the luminance as another plane: exposure is decided on coarse structure. The
    readings of a light meter, mean luminance and clipped share of 4 x 4 zones, are added to the
    CNN's features.

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
        self.numbers = 3 + (2 if self.has_sensors else 0) + 2 * _ZONES**2
        height, width_px = raw.shape[1:]
        self.block = max(1, min(height, width_px) // _PLANE_SIZE)
        self.cnn = nn.Sequential(
            nn.Conv2d(6, 24, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(24, 32, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(32, 48, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
        )
        with torch.no_grad():
            planes = torch.zeros(1, 6, height // self.block, width_px // self.block)
            flat = self.cnn(planes).shape[1]
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
        exposure = ev100[:, None, None, None]
        pooled = nn.functional.avg_pool2d(codes, self.block)  # (B, 4, ~16, ~16)
        peak = nn.functional.max_pool2d(codes[:, 1:2], self.block)  # of one green
        signal = _decode(pooled[:, 1:3].mean(dim=1, keepdim=True))
        planes = [pooled, _absolute(signal, exposure), _absolute(_decode(peak), exposure)]
        pool = nn.functional.adaptive_avg_pool2d
        zones = _absolute(pool(signal, _ZONES), exposure)
        clipped = pool((peak >= _CLIPPED).to(codes.dtype), _ZONES)
        features = [self.cnn(torch.cat(planes, dim=1)), zones.flatten(1), clipped.flatten(1)]
        numbers = [settings] if sensors is None else [settings, sensors]
        joint: torch.Tensor = self.head(torch.cat([*features, *numbers], dim=1))
        return joint


def _decode(codes: torch.Tensor) -> torch.Tensor:
    """Signal of companded codes in [0, 1] (see `ae_env.observation`)."""
    return (1.0 + PEDESTAL) * codes.square() - PEDESTAL


def _absolute(signal: torch.Tensor, ev100: torch.Tensor) -> torch.Tensor:
    """log2 of the luminance that gives `signal` at `ev100`, scaled to about [-1, 1]."""
    luminance = signal.clamp(min=_SIGNAL_FLOOR).log2() + ev100
    return (luminance - _LUMINANCE_CENTRE) / _LUMINANCE_SCALE


def _apex_table(grid: ExposureGrid) -> torch.Tensor:
    """EV100, Av, Tv and Sv of every state, (S, 4)."""
    apex = [[s.aperture_value, s.time_value, s.speed_value] for s in grid]
    ev100 = torch.tensor(grid.ev100, dtype=torch.float32)[:, None]
    return torch.cat([ev100, torch.tensor(apex)], dim=1)


class StateHead(nn.Module):
    """Values of every exposure state, by one small network that all states share.

    A state enters as its EV100, Av, Tv and Sv, and as the blur that the sensors predict for it.
    So what is learnt about one state serves its neighbours, and any grid within the same ranges.

    Args:
        grid: The states.
        features: Size of the features that describe the frame.
        has_sensors: Whether image speed and defocus are observed.
        outputs: Values per state.
        width: Hidden units.
        trained_on: Grid that the weights come from, on whose scale the states enter; by default
            `grid`.
    """

    def __init__(
        self,
        grid: ExposureGrid,
        features: int,
        has_sensors: bool,
        outputs: int = 1,
        width: int = 64,
        trained_on: ExposureGrid | None = None,
    ) -> None:
        super().__init__()
        self.has_sensors = has_sensors
        table = _apex_table(grid)
        known = table if trained_on is None else _apex_table(trained_on)
        self.states: torch.Tensor
        self.log2_time: torch.Tensor
        self.log2_opening: torch.Tensor
        spread = known.std(dim=0) if len(known) > 1 else torch.ones(known.shape[1])
        normalised = (table - known.mean(dim=0)) / spread.clamp(min=1.0)
        self.register_buffer("states", normalised, persistent=False)
        self.register_buffer("log2_time", -table[:, 2], persistent=False)
        self.register_buffer("log2_opening", 2.0 - 0.5 * table[:, 1], persistent=False)
        self.from_features = nn.Linear(features, width)
        self.from_state = nn.Linear(table.shape[1] + (2 if has_sensors else 0), width, bias=False)
        self.hidden = nn.Linear(width, width)
        self.values = nn.Linear(width, outputs)

    def forward(self, features: torch.Tensor, sensors: torch.Tensor | None) -> torch.Tensor:
        """Values (B, S, outputs).

        Args:
            features: (B, features) of the frame.
            sensors: (B, 2) in [-1, 1]; None where they are not observed.
        """
        states = self.states.expand(len(features), -1, -1)  # (B, S, 4)
        if self.has_sensors:
            if sensors is None:
                raise ValueError("`sensors` must be given: the network was made for them")
            states = torch.cat([states, self._blur(sensors)], dim=2)
        hidden = torch.relu(self.from_features(features)[:, None] + self.from_state(states))
        values: torch.Tensor = self.values(torch.relu(self.hidden(hidden)))
        return values

    def _blur(self, sensors: torch.Tensor) -> torch.Tensor:
        """log2 of each state's blur in 64ths of the frame, and its loss of sharpness; scaled."""
        low, high = SENSOR_RANGES[:, 0], SENSOR_RANGES[:, 1]
        speed = low[0] + (sensors[:, :1] + 1.0) * 0.5 * (high[0] - low[0])
        defocus = low[1] + (sensors[:, 1:] + 1.0) * 0.5 * (high[1] - low[1])
        motion_px = torch.exp2(speed + 6.0 + self.log2_time)  # (B, S): 64 pixels a frame height
        defocus_px = torch.exp2(defocus + self.log2_opening)
        squared = motion_px.square() + defocus_px.square()
        loss = torch.log1p(squared)
        return torch.stack([squared.log2() / 8.0, loss / 2.0], dim=2)
