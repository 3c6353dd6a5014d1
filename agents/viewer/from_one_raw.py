"""What one raw gives besides captures: its aperture opened, and its light as one HDR picture."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from PIL import Image

from agents.applications.hdr import hdr_picture, linear_rgb, write_exr
from agents.applications.refocus import refocus
from agents.report.plots import upright_picture
from simulator import CameraSimulator, RawImage, render_srgb, write_dng
from simulator.utils.files import write_atomically

#: F-numbers as cameras mark them, in third stops.
_MARKED = (
    *(1.4, 1.6, 1.8, 2.0, 2.2, 2.5, 2.8, 3.2, 3.5, 4.0, 4.5, 5.0, 5.6, 6.3, 7.1, 8.0, 9.0, 10.0),
    *(11.0, 13.0, 14.0, 16.0, 18.0, 20.0, 22.0),
)
#: Largest picture on the page, longer side [pixel of the sensor].
_LONGEST = 1536


@dataclass(frozen=True)
class Made:
    """What was made of a raw.

    Args:
        jpeg: Its picture on the page.
        aspect: Width of the picture by its height.
        told: A line about it.
        files: By ending, functions that write it to a path.
    """

    jpeg: bytes
    aspect: float
    told: str
    files: Mapping[str, Callable[[Path], object]] = field(default_factory=dict)


def wider_f_numbers(raw: RawImage) -> tuple[float, ...]:
    """The marked f-numbers that are wider than the raw's, the nearest first; down to f/1.4."""
    own = raw.settings.effective_f_number  # what is marked 5.6 may be recorded as 5.66
    settings = (replace(raw.settings, f_number=n) for n in reversed(_MARKED))
    return tuple(s.f_number for s in settings if s.effective_f_number < own)


def recorded(raw: RawImage) -> Made:
    """The raw itself, developed."""
    told = f"{raw.camera.name}, {raw.settings}"
    return Made(*_shown(upright_picture(raw, render_srgb(raw))), told)


def opened(raw: RawImage, f_number: float, simulator: CameraSimulator) -> Made:
    """The raw as a wider aperture would have recorded it; the blur is estimated."""
    result = refocus(raw, f_number, simulator=simulator)
    largest = result.metadata["largest_disc_px"]
    told = f"f/{f_number:g}, blur estimated: the widest disc has {largest:.1f} packed pixels"
    if largest == 0.0:
        told = (
            "nothing was found out of focus, so nothing changed: blur below 1.5 pixels cannot be "
            "told from sharpness"
        )
    image = upright_picture(result, render_srgb(result))
    return Made(*_shown(image), told, {".dng": lambda path: write_dng(path, result)})


def fused(raw: RawImage, simulator: CameraSimulator) -> Made:
    """The simulated bracket of the raw, fused."""
    hdr = hdr_picture(raw, simulator=simulator)
    image = upright_picture(raw, (hdr.fused * 255.0).round().byte())
    darkest, brightest = hdr.exposures[0], hdr.exposures[-1]
    told = f"{len(hdr.exposures)} simulated pictures, {darkest:+g} to {brightest:+g} EV, fused"
    saturated = float(raw.saturated.float().mean())
    if saturated >= 5e-5:
        told += f"; {saturated:.2%} of the raw is saturated: its light is estimated"
    files = {
        ".png": lambda path: write_atomically(path, _encoded(image, "PNG")),
        ".exr": lambda path: write_exr(path, linear_rgb(raw, hdr.radiance)),
    }
    return Made(*_shown(image), told, files)


def _shown(image: Image.Image) -> tuple[bytes, float]:
    """JPEG and aspect of a picture, averaged down for the page."""
    small = image.reduce(max(1, -(-max(image.size) // _LONGEST)))
    return _encoded(small, "JPEG"), small.width / small.height


def _encoded(image: Image.Image, kind: str) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format=kind, quality=90)
    return buffer.getvalue()
