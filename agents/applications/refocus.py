"""Shallow depth of field from one raw: the aperture opened beyond what the lens has.

What is out of focus is blurred as a thin lens would, nearer surfaces in front of farther ones, on
unclipped light with little noise; then the sensor records it, with the noise of its settings. What
stays in focus, and has nothing blurred before it, keeps its pixels as they were recorded.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F

from simulator import CameraSettings, CameraSimulator, Lens, NoiseLevelFunction, RawImage, defocus
from simulator.optics.thin_lens import SHARP


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
    cannot see blur below about 1.5 pixels: a picture that is sharp throughout stays as it is.

    Args:
        raw: The photograph.
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

    Raises:
        ValueError: If the aperture closes, if `depth` and `lens` do not come together or do not
            fit `raw`, if the camera's pixel pitch is needed and not known, or if neither depth nor
            networks are there; before any work.
    """
    _check(raw, f_number, depth, lens)
    simulator = CameraSimulator.from_pretrained() if simulator is None else simulator
    if depth is None and simulator.aperture is None:
        raise ValueError(
            "`depth` (=None) must be given to a `simulator` without networks: they estimate the "
            "blur, see CameraSimulator.from_pretrained"
        )
    source = raw.settings
    target = CameraSettings(source.iso, source.exposure_time, f_number)
    opened = source.effective_f_number / target.effective_f_number
    known = None if depth is None or lens is None else _known_blur(raw, depth, lens)
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
    metadata = {
        **raw.metadata,
        "depth": "estimated" if known is None else "given",
        "largest_disc_px": float(added.abs().max()),
    }
    return replace(raw, data=data, settings=settings, metadata=metadata)


def _check(raw: RawImage, f_number: float, depth: np.ndarray | None, lens: Lens | None) -> None:
    """Raises the `ValueError` of `refocus` about these arguments."""
    source = raw.settings
    target = CameraSettings(source.iso, source.exposure_time, f_number)
    if target.effective_f_number > source.effective_f_number:
        raise ValueError(
            f"`f_number` (={f_number:g}) must be at most that of the raw, {source.f_number:.3g}: "
            "closing the aperture would have to sharpen"
        )
    if depth is None and lens is None:
        return
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


def _known_blur(raw: RawImage, depth: np.ndarray, lens: Lens) -> torch.Tensor:
    """Signed circle of confusion (H, W) at the raw's own aperture [packed pixel]."""
    assert raw.camera.pixel_pitch_um is not None
    pitch = 2e-6 * raw.camera.pixel_pitch_um * raw.box_factor
    metres = torch.from_numpy(np.ascontiguousarray(depth, np.float64))
    blur = lens.circle_of_confusion(metres, raw.settings.effective_f_number) / pitch
    return F.avg_pool2d(blur[None], len(blur) // raw.data.shape[-2])[0]
