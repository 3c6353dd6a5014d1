"""HDR from one raw: the bracket that the camera did not take, fused to one picture."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from agents.applications.exposure_fusion import fuse
from simulator import CameraSimulator, RawImage, render_srgb
from simulator.raw.develop import quarter_turns, srgb_from_camera
from simulator.utils.files import write_atomically

#: Ends and step of the bracket [EV].
STOPS, STEP = 4.0, 0.5


class HdrPicture(NamedTuple):
    """What `hdr_picture` returns.

    Args:
        radiance: (4, H, W) float32 packed light with little noise, 1.0 is the raw's white; what
            was saturated there is an estimate.
        fused: (3, 2H, 2W) float32 in [0, 1], sRGB: the bracket fused.
        exposures: EV of the bracket's pictures relative to the raw.
    """

    radiance: Tensor
    fused: Tensor
    exposures: tuple[float, ...]


def hdr_picture(
    raw: RawImage,
    *,
    stops: float = STOPS,
    step: float = STEP,
    simulator: CameraSimulator | None = None,
) -> HdrPicture:
    """Simulates a bracket of `raw`, each picture with little noise, and fuses it.

    What is saturated in the raw is taken as a neutral highlight, brighter than white where every
    plane is clipped (`simulator.raw.develop`). Holding it white in
    the darkest pictures would make halos around it.

    Args:
        raw: The photograph.
        stops: The bracket reaches from -`stops` to +`stops` [EV], in (0, 10].
        step: Between its pictures [EV], in (0, `stops`].
        simulator: What reduces noise; by default ``CameraSimulator.from_pretrained()``.

    Raises:
        ValueError: If an argument is out of its range.
    """
    exposures = bracket_exposures(stops, step)
    simulator = CameraSimulator.from_pretrained() if simulator is None else simulator
    prepared = simulator.prepare(raw, tolerance=0.0)
    light = prepared.denoised_lights[-1].light if prepared.denoised_lights else prepared.light

    # 8 bits a sample: the pictures of a large raw fill the memory.
    codes = [render_srgb(_exposed(replace(raw, data=light), ev)) for ev in exposures]

    def bracket() -> Iterator[Tensor]:
        for picture in codes:
            yield picture.float() / 255.0

    return HdrPicture(light, fuse(bracket), exposures)


def bracket_exposures(stops: float = STOPS, step: float = STEP) -> tuple[float, ...]:
    """EV of the pictures of a bracket, darkest first.

    >>> bracket_exposures(1.0, 0.5)
    (-1.0, -0.5, 0.0, 0.5, 1.0)
    """
    if not 0.0 < stops <= 10.0:
        raise ValueError(f"`stops` (={stops!r}) must be in (0, 10]")
    if not 0.05 <= step <= stops:
        raise ValueError(f"`step` (={step!r}) must be in [0.05, {stops:g}], at most `stops`")
    count = math.floor(stops / step + 1e-9)
    return tuple(step * i for i in range(-count, count + 1))


def developed(raw: RawImage, ev: float = 0.0) -> Tensor:
    """The picture (3, 2H, 2W) in [0, 1] of `raw`, whose light may exceed white, `ev` brighter.

    Its sensor clips at white, and each code has 8 bits, as in a camera's JPEG.
    """
    return render_srgb(_exposed(raw, ev)).float() / 255.0


def _exposed(raw: RawImage, ev: float) -> RawImage:
    return replace(raw, data=(raw.data * 2.0**ev).clamp(max=1.0))


def linear_rgb(raw: RawImage, radiance: Tensor) -> np.ndarray:
    """Linear light (H, W, 3) float32 in the primaries of sRGB, white-balanced, not clipped.

    It is turned as the camera was held, as a developed picture is.

    Args:
        raw: Says how it is balanced and turned, and its camera's colours.
        radiance: (4, H, W), see `HdrPicture`.
    """
    gains = np.array(raw.white_balance) / min(raw.white_balance)
    red, green, green2, blue = radiance.double().cpu().numpy()
    rgb = np.stack([red, 0.5 * (green + green2), blue], axis=-1) * gains
    if raw.camera.colour_matrix is not None:
        rgb = rgb @ srgb_from_camera(raw.camera.colour_matrix).numpy().T
    return np.maximum(np.rot90(rgb, quarter_turns(raw)), 0.0).astype(np.float32)


def write_exr(path: str | Path, image: np.ndarray) -> Path:
    """Writes linear light (H, W, 3) as an EXR of 32-bit floats.

    Raises:
        ImportError: If OpenEXR is not installed.
    """
    openexr = import_openexr()
    path = Path(path)
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    with tempfile.TemporaryDirectory() as folder:  # OpenEXR writes to a path only
        file = Path(folder, "image.exr")
        openexr.File(header, {"RGB": np.ascontiguousarray(image)}).write(str(file))
        return write_atomically(path, file.read_bytes())


def import_openexr() -> Any:
    """The module OpenEXR.

    Raises:
        ImportError: If it is not installed; names the extra.
    """
    try:
        import OpenEXR
    except ImportError:
        raise ImportError(
            "EXR files need OpenEXR: install the extra with pip install 'ae-env[hdr]'"
        ) from None
    return OpenEXR
