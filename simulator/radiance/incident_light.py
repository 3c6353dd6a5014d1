"""The right exposure: incident light as a meter with a dome reads it, known or inferred.

A photographer's incident-light meter has a dome, held where the subject stands and pointed at the
camera. It weighs the light from every direction by (1 + cos) / 2, the angle being that to the
camera, and its reading E asks for ``EV100 = log2(100 E / C)`` with C = 340, within the 320 to 540
that ISO 2720:1974 allows such receptors (C = 250 is of flat ones). Everywhere here, `illuminance`
is in the lux of a flat receptor that asks for the same, ``EV100 = log2(E / 2.5)``.

Where the reading and that of an average meter in the camera differ by more than `LARGEST_GAP`, the
right exposure is that far from the camera's (`bounded`): the subject is then not where the meter
is, or is lit from behind before a void.

Where nothing was read there is an `IncidentPosterior`, from what a camera knows of its frame.
"""

import functools
import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
import torch

from simulator.radiance.light import MEAN_SIGNAL
from simulator.settings import LUX_AT_EV0, SATURATION_CONSTANT

#: C of a receptor with a dome [lux s ISO].
DOME_CONSTANT = 340.0
#: Lux of a flat receptor (C = 250) for each of a dome's: both ask for the same exposure.
FLAT_LUX = 100.0 * LUX_AT_EV0 / DOME_CONSTANT
#: Largest difference between the right exposure and an average meter's [EV].
LARGEST_GAP = 1.5
#: Luminance of linear sRGB.
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
#: How many values of the incident EV100, equally likely, a posterior is summed over; and these.
LIKELY = 16
_LIKELY = tuple(NormalDist().inv_cdf((i + 0.5) / LIKELY) for i in range(LIKELY))
#: Zones a side whose mean log luminance the posterior knows, and their pixels a side.
_ZONES, _ZONE_SIDE = 4, 8
#: Range of log2 signals that zones are averaged over: noise and lamps count for no more.
_DARKEST, _BRIGHTEST = -12.0, 5.0


def receptor_reading(
    panorama: np.ndarray, azimuth: float, pitch: float, *, dome: bool = True
) -> float:
    """What a receptor reads within a panorama, in units of its luminance times steradian.

    The integral of the luminance times (1 + cos) / 2, or of the positive cosine for a flat
    receptor; even light of luminance 1 gives 2 pi and pi.

    Args:
        panorama: (3, H, W) linear sRGB, equirectangular.
        azimuth, pitch: Where the receptor points [degrees]; a pitch of 90 is up.
        dome: Whether it has a dome.
    """
    height, width = panorama.shape[1:]
    longitude = ((np.arange(width) + 0.5) / width * 2.0 - 1.0) * math.pi
    latitude = (0.5 - (np.arange(height) + 0.5) / height) * math.pi
    faced, tilt = math.radians(azimuth), math.radians(pitch)
    cosine = np.cos(latitude)[:, None] * math.cos(tilt) * np.cos(longitude - faced)[None, :]
    cosine += np.sin(latitude)[:, None] * math.sin(tilt)
    weight = 0.5 * (1.0 + cosine) if dome else np.maximum(cosine, 0.0)
    luminance = np.tensordot(LUMINANCE, panorama, axes=1)
    seen = (luminance * weight * np.cos(latitude)[:, None]).sum(dtype=np.float64)
    return float(seen * 2.0 * math.pi**2 / (height * width))


def picture_illuminance(front: float, reflected_ev100: float) -> float:
    """Illuminance as a dome reads it at the subject of a picture, of which only the front is known.

    The half sphere before the subject is taken as even light that casts `front` [lux] on a surface
    facing the camera: the dome reads 1.5 times that. The half sphere behind the subject is taken as
    bright as an average meter finds the picture: the dome reads pi / 2 times this luminance.
    """
    behind = MEAN_SIGNAL * 0.01 * SATURATION_CONSTANT * 2.0**reflected_ev100  # [cd/m^2]
    return FLAT_LUX * (1.5 * front + 0.5 * math.pi * behind)


def bounded(ev100: float | np.ndarray, reflected_ev100: float | None) -> float | np.ndarray:
    """The EV100 of the incident light, moved to within `LARGEST_GAP` of the average meter's.

    `reflected_ev100` is None where that meter reads nothing, as in the dark.
    """
    if reflected_ev100 is None:
        return ev100
    return reflected_ev100 + np.clip(ev100 - reflected_ev100, -LARGEST_GAP, LARGEST_GAP)


@dataclass(frozen=True)
class IncidentLight:
    """What is known of the incident light of a scene.

    Args:
        ev100: EV100 that it asks for, the mean of what is likely.
        spread: Its standard deviation [EV]; 0 where the light is known.
        reflected_ev100: EV100 of an average meter in the camera; None where it reads nothing.
    """

    ev100: float
    spread: float
    reflected_ev100: float | None

    @functools.cached_property
    def right_ev100(self) -> np.ndarray:
        """(1,) EV100 of the right exposure; (16,), equally likely, where the light is not known."""
        likely = np.array([0.0] if self.spread == 0.0 else _LIKELY)
        return np.asarray(bounded(self.ev100 + self.spread * likely, self.reflected_ev100))


@dataclass(frozen=True)
class IncidentPosterior:
    """A normal distribution of the incident EV100 given a frame, its mean linear in `features`.

    Args:
        weights: Of the features.
        offset: Of the mean [EV].
        spread: Standard deviation [EV].
    """

    weights: tuple[float, ...]
    offset: float
    spread: float

    def infer(self, green: torch.Tensor, reflected_ev100: float) -> IncidentLight:
        """The incident light of a frame whose green, (H, W), has a mean of 0.12."""
        gap = self.offset + float(np.dot(self.weights, features(green, reflected_ev100)))
        return IncidentLight(reflected_ev100 + gap, self.spread, reflected_ev100)


def features(green: torch.Tensor, reflected_ev100: float) -> np.ndarray:
    """What a camera knows of the light of its frame, (10,): how bright it is, and where.

    Args:
        green: (H, W) signal at the exposure where its mean, clipped at white, is 0.12.
        reflected_ev100: EV100 of that exposure.

    Returns:
        Mean log2 signal of 4 rows of zones, of their outer and of their inner halves; the share of
        clipped pixels; `reflected_ev100`.
    """
    pool = torch.nn.functional.adaptive_avg_pool2d
    small = pool(green[None, None].double().clamp(min=0.0), _ZONES * _ZONE_SIDE)
    stops = small.clamp(min=2.0**_DARKEST).log2().clamp(max=_BRIGHTEST)
    zones = pool(stops, _ZONES)[0, 0]
    sides = (zones + zones.flip(1))[:, : _ZONES // 2] / 2.0  # left and right alike
    clipped = float((small >= 1.0).double().mean())
    return np.array([*sides.flatten().tolist(), clipped, reflected_ev100])


#: Weights and offset by `examples/fit_posterior.py`, on 48 views of each training map; it also says
#: what the spread covers in training places that are left out in turn and in validation places.
POSTERIOR = IncidentPosterior(
    weights=(0.074, -0.071, 0.077, -0.144, 0.081, -0.087, 0.300, 0.242, -9.240, -0.080),
    offset=2.005,
    spread=1.23,
)
