"""Shallow depth of field from one raw: the aperture opened beyond what the lens has.

What is out of focus is blurred as a thin lens would, nearer surfaces in front of farther ones, on
unclipped light with little noise; then the sensor records it, with the noise of its settings. What
stays in focus, and has nothing blurred before it, keeps its pixels as they were recorded.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
import torch.nn.functional as F

from simulator import CameraSettings, CameraSimulator, Lens, NoiseLevelFunction, RawImage, defocus
from simulator.radiance.reading import read_exr
from simulator.reference.thin_lens import SHARP
from simulator.training.scenes import fill_from_nearest
from simulator.utils.checks import check_number, check_word
from simulator.utils.files import file_fault, open_picture, refuse_bomb

#: The numbers of a depth map: distances, or inverse distances.
DepthKind = Literal["distance", "disparity"]
#: Metres for each unit of a PNG, as depth cameras write them.
PNG_METRES = 1e-3
#: What is said where the estimate of the blur finds none.
NOTHING_FOUND = (
    "nothing was found out of focus, so nothing changed: blur below 1.5 pixels cannot be told from "
    "sharpness"
)


def refocus(
    raw: RawImage,
    f_number: float,
    *,
    depth: np.ndarray | None = None,
    lens: Lens | None = None,
    simulator: CameraSimulator | None = None,
    seed: int = 0,
) -> RawImage:
    """`raw` as a wider aperture would have recorded it, at the same exposure.

    Where depth is not known, the circle of confusion of each pixel is estimated from how soft it
    is, and everything that is out of focus is taken to lie behind what is in focus. The estimate
    cannot see blur below about 1.5 pixels: a picture that is sharp throughout stays as it is. A
    `ValueError`, before any work, if the aperture closes, if `depth` and `lens` do not come
    together or fit `raw`, or if pixel pitch or networks are needed and missing.

    Args:
        f_number: As marked, at most the raw's own; down to 0.5.
        depth: Distances from the lens [m], (H, W) or (2H, 2W) for a raw of H x W packed pixels;
            inf allowed. None estimates the blur.
        lens: Focal length, and where it is focused. Given together with `depth`.
        simulator: What reduces noise and estimates the blur; by default
            ``CameraSimulator.from_pretrained()``.
        seed: Seed of the noise of what is blurred, >= 0.

    Returns:
        The raw; its exposure time is shorter as the aperture is wider. ``metadata["depth"]`` is
        ``"given"`` or ``"estimated"``, ``metadata["largest_disc_px"]`` the widest disc of
        confusion at `f_number` [packed pixel].
    """
    source = raw.settings
    target = CameraSettings(source.iso, source.exposure_time, f_number)
    if target.effective_f_number > source.effective_f_number:
        raise ValueError(
            f"`f_number` (={f_number:g}) must be at most that of the raw, {source.f_number:.3g}: "
            "closing the aperture would have to sharpen"
        )
    known = _known_blur(raw, depth, lens)
    if known is None and simulator is not None and simulator.aperture is None:
        raise ValueError(
            "`depth` (=None) must be given to a `simulator` without networks: they estimate the "
            "blur, see CameraSimulator.from_pretrained"
        )
    simulator = CameraSimulator.from_pretrained() if simulator is None else simulator
    opened = source.effective_f_number / target.effective_f_number
    prepared = simulator.prepare(raw, tolerance=0.0)
    clean = prepared.denoised_lights[-1].light if prepared.denoised_lights else prepared.light
    diameter = simulator.estimate_defocus(prepared) if known is None else known
    # Second moments add: the blur that is there already is not added again.
    added = diameter.double().cpu() * float(np.sqrt(opened**2 - 1.0))
    blurred = defocus(clean, added)
    settings = replace(target, exposure_time=source.exposure_time / opened**2)
    scene = replace(
        prepared, light=blurred, denoised_lights=(), nlf=NoiseLevelFunction.zero(), saturated=None
    )
    frame, _ = scene.capture(settings, seed)
    kept = (added.abs().to(clean.device) <= SHARP) & (blurred == clean).all(dim=0)
    data = torch.where(kept, raw.data.to(frame), frame)
    how = "estimated" if known is None else "given"
    facts = {"depth": how, "largest_disc_px": float(added.abs().max())}
    return replace(raw, data=data, settings=settings, metadata={**raw.metadata, **facts})


def _known_blur(raw: RawImage, depth: np.ndarray | None, lens: Lens | None) -> torch.Tensor | None:
    """Signed circle of confusion (H, W) at the raw's own aperture [packed pixel]; checks it all."""
    if depth is None and lens is None:
        return None
    if depth is None or lens is None:
        given = "lens" if depth is None else "depth"
        raise ValueError(f"`{given}` must come with both of `depth` and `lens`")
    height, width = raw.data.shape[-2:]
    fits = (height, width), (2 * height, 2 * width)
    if not isinstance(depth, np.ndarray) or depth.shape not in fits:
        shape = getattr(depth, "shape", type(depth).__name__)
        raise ValueError(
            f"`depth` (shape {shape}) must be {fits[0]} or {fits[1]}, as the raw's packed or "
            "sensor pixels"
        )
    if depth.dtype.kind not in "uif" or not (depth > lens.focal_length).all():
        raise ValueError(
            f"`depth` (the least is {depth.min()} m) must be distances above the focal length, "
            f"{lens.focal_length:g} m"
        )
    if raw.camera.pixel_pitch_um is None:
        raise ValueError(
            f"`raw`: the pixel pitch of {raw.camera.name!r} is not known; give it, with "
            "`--pixel-pitch` or dataclasses.replace(camera, pixel_pitch_um=...)"
        )
    pitch = 2e-6 * raw.camera.pixel_pitch_um * raw.box_factor
    metres = torch.from_numpy(np.ascontiguousarray(depth, np.float64))
    blur = lens.circle_of_confusion(metres, raw.settings.effective_f_number) / pitch
    return F.avg_pool2d(blur[None], len(blur) // raw.data.shape[-2])[0]


def read_depth(
    path: str | Path,
    *,
    kind: DepthKind = "distance",
    scale: float | None = None,
    layer: str | None = None,
) -> np.ndarray:
    """Distances from the lens, of a depth camera's, a stereo matcher's or a network's file.

    A `ValueError` if the file is no such map, or `kind` or `scale` is wrong.

    Args:
        path: A PNG of one channel (8 or 16 bit), an EXR (channel Z, Depth, V, Y, or R alone; an
            `ImportError` if OpenEXR is not installed) or a ``.npy`` array (H, W).
        kind: ``"disparity"`` where larger numbers are nearer: 1 / metres, times a constant.
        scale: Metres for each unit, or 1 / metres for each unit of disparity. By default
            a PNG of distances is in millimetres, an EXR or ``.npy`` in metres; a disparity has
            no default.
        layer: Part or layer of an EXR, such as ``"ViewLayer.Depth"``, where several have depth.

    Returns:
        (H, W) float64 [m], all > 0. Where the file has no number (0 in a PNG, NaN, infinite or
        negative elsewhere; 0 is infinitely far in a disparity of floats), the nearest pixel's.
    """
    path = Path(path)
    check_word("kind", kind, get_args(DepthKind))
    if scale is not None or kind == "disparity":
        unit = "1 / metres" if kind == "disparity" else "metres"
        check_number("scale", scale, 1e-12, 1e12, more=f": {unit} for each unit")
    values = _read_map(path, layer)
    of_png = path.suffix.lower() == ".png"
    zero_counts = kind == "disparity" and not of_png  # infinitely far
    known = np.isfinite(values) & ((values > 0) | ((values == 0) & zero_counts))
    if not (known & (values > 0)).any():
        raise ValueError(f"`depth` (={str(path)!r}) must hold a number above 0")
    filled = fill_from_nearest(np.where(known, values, np.nan))
    if kind == "disparity":
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / (filled * scale))
    return filled * (scale or (PNG_METRES if of_png else 1.0))


def _read_map(path: Path, layer: str | None) -> np.ndarray:
    """The map (H, W) of numbers in a file, float64."""
    try:
        if fault := file_fault(path):
            raise ValueError(f"it {fault}")
        match path.suffix.lower():
            case ".png":
                with open_picture(path, ["PNG"]) as picture:
                    # Indices into a palette would look like a map.
                    values = np.asarray(picture.convert() if picture.mode == "P" else picture)
            case ".npy":
                values = np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))
            case ".exr":
                kinds = ("Z",), ("DEPTH",), ("V",), ("Y",), ("R",)
                values = read_exr(path, kinds, layer, outside=math.nan)[0][0]
            case _:
                raise ValueError("the file must end in .png, .exr or .npy")
        if values.ndim != 2 or not values.size or values.dtype.kind not in "uif":
            raise ValueError(
                "the file must hold one map (H, W) of numbers: a PNG of one channel, an EXR with a "
                "channel Z, Y or R, or an array"
            )
        if claim := refuse_bomb(values.shape[0], values.shape[1], values.nbytes):
            raise ValueError(f"it {claim}")
    except (OSError, SyntaxError, RuntimeError, EOFError, ValueError) as error:
        raise ValueError(f"`depth` (={str(path)!r}) cannot be read: {error}") from error
    return np.asarray(values, np.float64)
