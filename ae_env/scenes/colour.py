"""Colours: from linear sRGB light to a camera's raw colours."""

from __future__ import annotations

import numpy as np
import torch

from simulator.camera import CameraProfile

#: Linear sRGB to XYZ, white D65 (IEC 61966-2-1).
XYZ_FROM_SRGB = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
)


def camera_from_srgb(
    camera: CameraProfile, illuminant: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Matrix from reflectance in linear sRGB to raw R, G, B under `illuminant`.

    Args:
        camera: Its `colour_matrix` (XYZ to camera); the identity on sRGB where it has none.
        illuminant: Colour of the light, linear sRGB; its brightness does not matter.

    Returns:
        The matrix, 3 x 3, scaled so that white gives 1 in green, and the raw R, G, B of white.
        White balance gains are ``1 / white``.

    Raises:
        ValueError: If white is not positive in every raw channel.
    """
    tint = np.asarray(illuminant, np.float64)
    if tint.shape != (3,) or not (np.isfinite(tint).all() and (tint > 0).all()):
        raise ValueError(f"`illuminant` (={illuminant}) must be 3 positive values (R, G, B)")
    matrix = np.eye(3)
    if camera.colour_matrix is not None:
        matrix = np.asarray(camera.colour_matrix, np.float64) @ XYZ_FROM_SRGB
        matrix = matrix / matrix.sum(axis=1)[1]
    matrix = matrix * tint
    white = matrix.sum(axis=1)
    if not (white > 0).all():
        raise ValueError(
            f"`colour_matrix` of camera {camera.name!r} takes white to {white.tolist()}, which "
            "must be positive in R, G and B"
        )
    return matrix / white[1], white / white[1]


def temperature_tint(log2_red_over_green: float) -> tuple[float, float, float]:
    """Colour of a light along the daylight to tungsten line, linear sRGB.

    Args:
        log2_red_over_green: 0 is D65, 0.6 about 4000 K, 1.16 tungsten (2856 K), -0.15 open shade.

    >>> temperature_tint(0.0)
    (1.0, 1.0, 1.0)
    """
    # Planck's locus in linear sRGB: illuminant A is (2.23, 1, 0.28), 4000 K (1.53, 1, 0.58).
    return (2.0**log2_red_over_green, 1.0, 2.0 ** (-1.5 * log2_red_over_green))


def check_rgb(rgb: torch.Tensor | np.ndarray) -> torch.Tensor:
    """`rgb` as float32 (3, H, W).

    Raises:
        ValueError: Unless it is linear light, finite and at least 0.
    """
    image = torch.as_tensor(rgb)
    if image.ndim != 3 or image.shape[0] != 3 or min(image.shape) < 1:
        raise ValueError(f"`rgb` (shape {tuple(image.shape)}) must be (3, H, W)")
    if not image.dtype.is_floating_point:
        raise ValueError(f"`rgb` (dtype {image.dtype}) must be floating point and linear")
    if not bool(torch.isfinite(image).all()) or bool((image < 0).any()):
        raise ValueError("`rgb` must be finite and at least 0 everywhere")
    return image.float()
