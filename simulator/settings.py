"""Camera settings and the photographic arithmetic between them, in log2 and float64."""

import math
from dataclasses import dataclass, field
from typing import Self

from simulator.utils.checks import check_number

#: Calibration constant of reflected-light meters in the saturation-based ISO 12232 relation used
#: throughout: a surface of luminance L gives ``x = L * t * ISO / (120 * N**2)`` of sensor white.
SATURATION_CONSTANT = 120.0
#: Incident-light calibration: an EV100 of 0 is 2.5 lux.
LUX_AT_EV0 = 2.5
#: A recorded shutter time this close (relative) to a nominal stop stands for the exact stop.
SNAP_TOLERANCE = 0.03

# fmt: off
_FRACTIONS = (
    8000, 6400, 5000, 4000, 3200, 2500, 2000, 1600, 1250, 1000, 800, 640, 500, 400, 320, 250, 200,
    160, 125, 100, 80, 60, 50, 40, 30, 25, 20, 15, 13, 10, 8, 6, 5, 4,
)
_SECONDS = (
    0.3, 0.4, 0.5, 0.6, 0.8, 1, 1.3, 1.6, 2, 2.5, 3, 3.2, 4, 5, 6, 8, 10, 13, 15, 20, 25, 30,
)
# fmt: on
#: Marked exposure times [s].
NOMINAL_TIMES = (*(1.0 / n for n in _FRACTIONS), *_SECONDS)


@dataclass(frozen=True, order=True)
class CameraSettings:
    """The three settings that decide an exposure.

    The ranges keep every exposure ratio between two settings below 2**106, a finite float32.

    >>> CameraSettings(iso=100, exposure_time=1 / 125, f_number=16).ev100
    14.965784284662087
    """

    iso: float  #: ISO speed, in [0.001, 1e8]
    exposure_time: float  #: time the shutter is open, in seconds, in [1e-9, 1e5]
    f_number: float  #: aperture f-number as marked on the lens, in [0.5, 1024]
    #: Aperture in sixths of the f-number's octave (thirds of a stop): ``round(6 log2 N)``.
    aperture_stop: int = field(init=False, repr=False, compare=False)
    #: The f-number that the marked one stands for, 2.8 for sqrt(2)**3 (paper, section 3.1).
    effective_f_number: float = field(init=False, repr=False, compare=False)
    #: log2 of the exposure by `effective_f_number`, relative to ISO 100, 1 s, f/1.
    log2_exposure: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name, low, high in (
            ("iso", 1e-3, 1e8),
            ("exposure_time", 1e-9, 1e5),
            ("f_number", 0.5, 1024.0),
        ):
            object.__setattr__(self, name, check_number(name, getattr(self, name), low, high))
        stop = round(6.0 * math.log2(self.f_number))
        exposure = math.log2(self.exposure_time) + math.log2(self.iso / 100.0) - stop / 3.0
        object.__setattr__(self, "aperture_stop", stop)
        object.__setattr__(self, "effective_f_number", 2.0 ** (stop / 6.0))
        object.__setattr__(self, "log2_exposure", exposure)

    @classmethod
    def from_exif(cls, iso: float, exposure_time: float, f_number: float) -> Self:
        """Settings of a file: `iso`, `f_number` and, of a rounded `exposure_time`, the exact stop.

        >>> CameraSettings.from_exif(100, 1 / 60, 2.8).exposure_time == 1 / 64
        True
        """
        settings = cls(iso, exposure_time, f_number)
        return cls(settings.iso, snap_exposure_time(settings.exposure_time), settings.f_number)

    @property
    def ev100(self) -> float:
        """Exposure value at ISO 100: ``log2(N**2 / t) - log2(ISO / 100)``, N as marked."""
        return self.aperture_value + self.time_value - math.log2(self.iso / 100.0)

    @property
    def aperture_value(self) -> float:
        """APEX Av: ``2 log2(N)``."""
        return 2.0 * math.log2(self.f_number)

    @property
    def time_value(self) -> float:
        """APEX Tv: ``-log2(t)``."""
        return -math.log2(self.exposure_time)

    @property
    def speed_value(self) -> float:
        """APEX Sv: ``log2(ISO / 3.125)``, 5 at ISO 100."""
        return math.log2(self.iso / 3.125)

    def __str__(self) -> str:
        time = format_exposure_time(self.exposure_time)
        return f"ISO {self.iso:g}, {time}, f/{self.f_number:.3g}"


def exposure_ratio(source: CameraSettings, target: CameraSettings) -> float:
    """How much brighter the same scene is recorded at `target` than at `source`.

    ``alpha = alpha_t * alpha_g * alpha_n`` (paper, section 3.1), the aperture through its rounded
    stop because recorded f-numbers are rounded.

    >>> exposure_ratio(CameraSettings(100, 0.5, 4), CameraSettings(200, 0.25, 5.6))
    0.5
    """
    return 2.0 ** (target.log2_exposure - source.log2_exposure)


def incident_ev100(illuminance: float) -> float:
    """EV100 that an incident-light meter reads at `illuminance` [lux].

    >>> round(incident_ev100(20_000), 1)
    13.0
    """
    if not (math.isfinite(illuminance) and illuminance / LUX_AT_EV0 > 0):
        raise ValueError(f"`illuminance` (={illuminance!r}) must be positive and finite")
    return math.log2(illuminance / LUX_AT_EV0)


def sensor_signal(luminance: float, settings: CameraSettings) -> float:
    """Signal of a surface of `luminance` [cd/m^2] at `settings`; 1.0 is sensor white.

    Saturation-based speed of ISO 12232 (H = 0.65 L t / N^2, H_sat = 78 / ISO). It is the exposure
    scale of OpenUSD's `UsdGeomCamera`, the imaging ratio t (ISO / 100) / N^2 times a responsivity,
    which is 5 / 6 here; our N is the exact stop that a marked f-number stands for.

    >>> sensor_signal(1.2, CameraSettings(100, 1.0, 1.0))  # 0.65 * 1.2 = 78 / 100
    1.0
    """
    return luminance * 100.0 * 2.0**settings.log2_exposure / SATURATION_CONSTANT


def snap_exposure_time(exposure_time: float) -> float:
    """The exact third-stop that a recorded `exposure_time` [s] stands for, or the value itself.

    1/60 stands for 1/64, 1/1000 for 1/1024. Nominal speeds are third-stops; a value more than 3 %
    from every nominal stop is kept. Industrial cameras run at exactly what they say: use
    `CameraSettings` directly for them.
    """
    nearest = min(NOMINAL_TIMES, key=lambda n: abs(math.log(exposure_time / n)))
    if abs(exposure_time / nearest - 1.0) > SNAP_TOLERANCE:
        return exposure_time
    return 2.0 ** (round(3.0 * math.log2(nearest)) / 3.0)


def format_exposure_time(exposure_time: float) -> str:
    """`exposure_time` [s] as photographers write it.

    >>> format_exposure_time(1 / 125), format_exposure_time(2.0)
    ('1/125 s', '2 s')
    """
    if exposure_time >= 0.4:
        return f"{exposure_time:g} s" if exposure_time != 0.5 else "1/2 s"
    return f"1/{1.0 / exposure_time:.4g} s"
