"""The scale and the colours of light: from linear sRGB to a camera's planes at known settings."""

import math
from dataclasses import replace

import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.camera_files import XYZ_FROM_SRGB
from simulator.reference.reference_camera import lens_blur, sample_mosaic
from simulator.settings import LUX_AT_EV0, SATURATION_CONSTANT, CameraSettings, incident_ev100

#: Signal of a perfectly white diffuse surface at the incident-light exposure, ``x = 0.663 * R``.
#: Luminance R E / pi in ISO 12232's ``x = 100 L t / (120 N^2)`` with ``E = 2.5 * 2**EV100``.
WHITE_SIGNAL = 100.0 * LUX_AT_EV0 / (SATURATION_CONSTANT * math.pi)
#: Mean of green, clipped at white, that a scene of unknown light is anchored to.
MEAN_SIGNAL = 0.12
#: ISO and f-number of the reference settings made here; the exposure time follows from the EV.
_REFERENCE_ISO, _REFERENCE_F_NUMBER = 100.0, 4.0
#: EV100 of a radiance map of unknown scale, unless the caller knows better.
DEFAULT_EV100 = 10.0


def reference_settings(ev100: float) -> CameraSettings:
    """ISO 100, f/4 and the exposure time at which ``-log2_exposure`` is `ev100`."""
    unit = CameraSettings(_REFERENCE_ISO, 1.0, _REFERENCE_F_NUMBER)
    return replace(unit, exposure_time=2.0 ** (-unit.log2_exposure - ev100))


def mean_anchor(green: torch.Tensor) -> float:
    """Factor at which the mean of `green` (any shape), clipped at 1, is `MEAN_SIGNAL`.

    Clipping keeps a sun of 10,000 times white from deciding the exposure of everything else.
    """
    values = green.detach().double().clamp(min=0.0).cpu().numpy().ravel()
    rest = lit = values[values > 0.0]
    if len(rest) <= MEAN_SIGNAL * len(values):
        reason = f"no exposure brings its mean to {MEAN_SIGNAL}; give `illuminance`"
        share = len(lit) / max(len(values), 1)
        raise ValueError(f"`light` is 0 in all but {share:.1%} of its pixels: {reason}")
    while True:  # what a factor that is too low clips stays clipped
        clipped = len(lit) - len(rest)
        factor = float((MEAN_SIGNAL * len(values) - clipped) / rest.sum())
        if factor * rest.max() <= 1.0:
            return factor
        rest = rest[rest * factor < 1.0]


def camera_from_srgb(
    camera: CameraProfile, illuminant: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Matrix (3, 3) from reflectance in linear sRGB to raw R, G, B, and the raw R, G, B of white.

    It is scaled so that white gives 1 in green; white balance gains are ``1 / white``. A camera
    without a `colour_matrix` sees sRGB. `illuminant` is the light's colour in linear sRGB; its
    brightness does not matter.
    """
    tint = np.asarray(illuminant, np.float64)
    if tint.shape != (3,) or not (np.isfinite(tint).all() and (tint > 0).all()):
        raise ValueError(f"`illuminant` (={illuminant}) must be 3 positive values (R, G, B)")
    matrix = np.eye(3)
    if camera.colour_matrix is not None:
        matrix = np.asarray(camera.colour_matrix, np.float64) @ np.array(XYZ_FROM_SRGB)
        matrix = matrix / matrix.sum(axis=1)[1]
    matrix = matrix * tint
    white = matrix.sum(axis=1)
    if not (white > 0).all():
        rule = f"takes white to {white.tolist()}, which must be positive in R, G and B"
        raise ValueError(f"`colour_matrix` of camera {camera.name!r} {rule}")
    return matrix / white[1], white / white[1]


def temperature_tint(log2_red_over_green: float) -> tuple[float, float, float]:
    """Colour of a light along the daylight to tungsten line, linear sRGB.

    0 is D65, 0.6 about 4000 K, 1.16 tungsten (2856 K), -0.15 open shade.
    """
    # Planck's locus in linear sRGB: illuminant A is (2.23, 1, 0.28), 4000 K (1.53, 1, 0.58).
    return (2.0**log2_red_over_green, 1.0, 2.0 ** (-1.5 * log2_red_over_green))


def camera_light(
    rgb: torch.Tensor | np.ndarray,
    camera: CameraProfile,
    illuminance: float | None = None,
    ev100: float = DEFAULT_EV100,
    illuminant: tuple[float, float, float] = (1.0, 1.0, 1.0),
    *,
    sampled: bool = False,
) -> tuple[torch.Tensor, CameraSettings, tuple[float, float, float]]:
    """Takes linear light into a camera's colours, and to the level of its reference settings.

    Args:
        rgb: (3, H, W) linear light, sRGB primaries, at least 0 and finite. With `illuminance`
            given, 1.0 is a perfectly white surface under it (so the values of surfaces are
            reflectances); without, the scale is arbitrary.
        camera: Its `colour_matrix` takes sRGB to the camera; without one the colours stay.
        illuminance: Light on the subject [lux]; None where the scale is unknown.
        ev100: Without `illuminance`, where the mean of green, clipped at white, is set to 0.12.
        illuminant: Colour of the light, linear sRGB, multiplied onto `rgb`.
        sampled: Whether the pixels of `rgb`, (3, 2H, 2W), are photosites: they go through a lens
            that is sharp to about a pixel and the camera's colour filter array. Otherwise each
            becomes a packed pixel, all four planes of it at one place.

    Returns:
        (4, H, W) float32 packed planes, not clipped; the settings at which 1.0 is sensor white; and
        the gains of R, G, B that make a grey card grey.
    """
    image = torch.as_tensor(rgb)
    is_float = image.ndim == 3 and image.shape[0] == 3 and image.dtype.is_floating_point
    if not is_float or not image.numel() or not (image.isfinite() & (image >= 0)).all():
        found = f"{image.dtype}, shape {tuple(image.shape)}"
        raise ValueError(f"`rgb` ({found}) must be float light, (3, H, W), finite and at least 0")
    image = image.float()
    matrix, white = camera_from_srgb(camera, illuminant)
    planes = torch.from_numpy(matrix).float() @ image.reshape(3, -1)
    planes = planes.clamp_(min=0.0).reshape(image.shape)
    light = sample_mosaic(lens_blur(planes), camera.cfa) if sampled else planes[[0, 1, 1, 2]]
    if illuminance is not None:
        reference = reference_settings(incident_ev100(illuminance))
        light *= WHITE_SIGNAL
    else:
        reference = reference_settings(ev100)
        light *= mean_anchor(light[1:3] if sampled else light[1])
    red, green, blue = white.tolist()
    return light, reference, (green / red, 1.0, green / blue)
