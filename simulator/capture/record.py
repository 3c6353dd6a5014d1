"""One capture: from linear light on the sensor to the numbers that the camera records.

The order is physical, and it matters: exposed light, not clipped -> motion and defocus blur of
that unclipped light -> noise of the blurred signal -> clip -> quantise, each of the last two once.
(Exposure and blur are linear and change places here: one blur then serves many exposures.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from simulator.camera import VARIANCE_LIMIT, CameraProfile
from simulator.capture.exposure import LIGHT_LIMIT, SIGNAL_LIMIT, Exposure
from simulator.noise.generator import FrameNoise, Noise
from simulator.noise.noise_level_function import noise_variance
from simulator.optics.blur import disc_blur, motion_blur
from simulator.utils.threads import in_shares

_TINY = torch.finfo(torch.float32).tiny
#: Samples whose noise is balanced at a time: they stay in the cache, and on one thread.
_BALANCED = 2**15


def sensor_light(prepared: torch.Tensor, exposure: Exposure) -> torch.Tensor:
    """Light on the sensor, (4, H, W): exposed and blurred, neither noisy nor clipped."""
    light = prepared
    if exposure.defocus_px or exposure.motion_px:  # else even the brightest light stays exact
        light = motion_blur(defocused_light(prepared, exposure.defocus_px), exposure.motion_px)
    return exposed_light(light, exposure)


def exposed_light(light: torch.Tensor, exposure: Exposure) -> torch.Tensor:
    """Light on the sensor, (4, H, W), of `light` that has the blur of `exposure` already."""
    return (light * exposure.ratio).clamp_(-SIGNAL_LIMIT, SIGNAL_LIMIT)


def defocused_light(prepared: torch.Tensor, defocus_px: float) -> torch.Tensor:
    """Light (4, H, W) of a scene behind an aperture, still at the prepared scene's exposure.

    Blur and exposure are linear, so the blur may come first: it then serves every exposure time
    and ISO.
    """
    return disc_blur(prepared.clamp(-LIGHT_LIMIT, LIGHT_LIMIT), defocus_px)


def add_noise(
    light: torch.Tensor, exposures: Sequence[Exposure], noises: Sequence[FrameNoise]
) -> tuple[torch.Tensor, np.ndarray]:
    """Tops the noise of each image of `light` (B, 4, H, W) up to its target's.

    Each image has its own noise, so that it comes out the same alone or in a batch.

    Returns:
        See `top_up`.
    """
    normals = np.stack([noise.normals(light.shape[1:]) for noise in noises])
    return top_up(light, exposures, torch.from_numpy(normals).to(light.device))


def top_up(
    light: torch.Tensor, exposures: Sequence[Exposure], normals: torch.Tensor
) -> tuple[torch.Tensor, np.ndarray]:
    """`add_noise` with the standard normals given, (B, 4, H, W).

    Returns:
        The noisy signal, and per image the excess noise (B,): mean over the pixels of the variance
        that the source brings beyond the target's, relative to the target's; 0 where the source is
        clean enough.
    """
    sources = [e.source_noise for e in exposures]
    targets = [e.target for e in exposures]
    shot = _planes([t.shot for t in targets]) - _planes([s.shot for s in sources])
    read = _planes([t.read for t in targets]) - _planes([s.read for s in sources])
    missing = light.clamp(min=0.0).mul_(shot.to(light)).add_(read.to(light))
    excess = np.zeros(len(exposures))
    for i, (source, target) in enumerate(zip(sources, targets, strict=True)):
        remaining = exposures[i].remaining
        if remaining is not None:  # what the blur of the aperture took away is to be added again
            missing[i] += (1.0 - remaining) * noise_variance(light[i], source)
        if not source.is_zero:
            excess[i] = _relative_excess(missing[i], noise_variance(light[i], target))
    if not all(source.is_zero for source in sources):
        missing.clamp_(min=0.0)
    return missing.sqrt_().mul_(normals).add_(light), excess


def record(
    light: torch.Tensor,
    exposure: Exposure,
    camera: CameraProfile,
    noise: FrameNoise | None,
    *,
    out: torch.Tensor,
) -> None:
    """One capture of light that is blurred already: exposed, noisy, clipped and quantised.

    A fused kernel on the CPU; elsewhere the same steps one by one.

    Args:
        light: (4, H, W) with the blur of `exposure`, at the exposure of the prepared scene.
        exposure: What happens to it.
        camera: The body.
        noise: The noise; None for none.
        out: (4, H, W) float32, contiguous, that the frame in [-pedestal, 1] is written to.
    """
    if not lacks_noise(exposure):
        noise = None
    if light.device.type == "cpu":
        from simulator.capture.kernels import record_capture  # numba: only where there is a capture

        record_capture(light, exposure, camera, noise=noise, out=out)
        return
    signal = exposed_light(light, exposure)[None]
    if noise is not None:
        signal, _ = add_noise(signal, [exposure], [noise])
    out.copy_(clip_and_quantise(signal[0], camera))


def lacks_noise(exposure: Exposure) -> bool:
    """Whether some signal could have less noise than the target; where not, none is drawn."""
    source, target = exposure.source_noise, exposure.target
    pairs = zip((*target.shot, *target.read), (*source.shot, *source.read), strict=True)
    return exposure.remaining is not None or any(wanted > given for wanted, given in pairs)


def record_batch(
    lights: Sequence[torch.Tensor],
    exposures: Sequence[Exposure],
    camera: CameraProfile,
    keys: np.ndarray,
    noise: Noise,
    *,
    out: torch.Tensor,
) -> None:
    """`record` of B frames at once on the CPU.

    Args:
        lights: B of (4, H, W), blurred already; several may be the same.
        exposures: What happens to each.
        camera: The body.
        keys: (B,) uint64 of the noise of each.
        noise: How the keys become noise.
        out: (B, 4, H, W) float32, contiguous.
    """
    from simulator.capture.kernels import exposure_table, record_frames
    from simulator.utils.jit import addresses

    lights = [light.contiguous() for light in lights]
    shares = [None if e.remaining is None else e.remaining.float().contiguous() for e in exposures]
    samples = out.shape[-2] * out.shape[-1]
    record_frames(
        addresses(lights),
        samples,
        exposure_table(exposures),
        camera,
        keys=keys,
        noise=noise,
        remaining=addresses(shares),
        signals=out.numpy().reshape(len(out), 4, samples),
        count=False,
    )


@dataclass(frozen=True)
class NoiseBalance:
    """The noise that a source brings against the noise that a capture should have.

    Args:
        relative_excess: Mean over the pixels of the variance beyond the target's, relative to it.
        excess: Mean of that variance, 1 is sensor white squared.
        is_short: Whether any pixel has less noise than the target.
    """

    relative_excess: float
    excess: float
    is_short: bool


def noise_balance(light: torch.Tensor, exposure: Exposure) -> NoiseBalance:
    """What the noise top-up of one image finds.

    Args:
        light: (4, H, W) at the exposure of the prepared scene.
        exposure: What happens to it; neither its ratio nor its noise are in `light` yet.
    """
    source, target = exposure.source_noise, exposure.target
    if source.is_zero:
        return NoiseBalance(0.0, 0.0, not target.is_zero)
    height, width = light.shape[-2:]
    rows = max(1, _BALANCED // width)
    parts = [slice(top, top + rows) for top in range(0, height, rows)]
    relative, excess, is_short = np.zeros(4), np.zeros(4), np.zeros(4, bool)

    def balance(first: int, last: int) -> None:
        for plane in range(first, last):
            shot = target.shot[plane] - source.shot[plane]
            read = target.read[plane] - source.read[plane]
            if shot >= 0.0 and read > 0.0:
                is_short[plane] = True  # at every pixel, whatever its light
                continue
            for part in parts:
                signal = (light[plane, part] * exposure.ratio).clamp_(0.0, SIGNAL_LIMIT)
                missing = signal * shot + read
                if exposure.remaining is not None:  # what the aperture's blur took is added again
                    missing += (1.0 - exposure.remaining[part]) * (
                        signal * source.shot[plane] + source.read[plane]
                    )
                is_short[plane] |= bool((missing > 0).any())
                wanted = signal.mul_(target.shot[plane]).add_(target.read[plane])
                missing.clamp_(max=0.0)
                excess[plane] -= float(missing.sum())
                relative[plane] -= float((missing / wanted.clamp_(min=_TINY)).sum())

    in_shares(balance, 4, threads=None if len(parts) > 4 else 1)
    count = light.numel()
    share = min(abs(float(relative.sum())) / count, VARIANCE_LIMIT)  # finite over no noise, too
    return NoiseBalance(share, abs(float(excess.sum())) / count, bool(is_short.any()))


def _relative_excess(missing: torch.Tensor, wanted: torch.Tensor) -> float:
    relative = missing / wanted.clamp_(min=_TINY)
    share = -float(relative.clamp_(max=0.0).mean(dtype=torch.float64))
    return min(max(0.0, share), VARIANCE_LIMIT)


def _planes(values: list[tuple[float, float, float, float]]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, :, None, None]  # (B, 4, 1, 1)


def clip_and_quantise(signal: torch.Tensor, camera: CameraProfile) -> torch.Tensor:
    """The camera's digital numbers of `signal` (..., 4, H, W), on the scale where white is 1."""
    device = signal.device
    span = torch.tensor(camera.span, dtype=torch.float32, device=device)[:, None, None]
    black = torch.tensor(camera.black_level, dtype=torch.float32, device=device)[:, None, None]
    numbers = (signal * span).add_(black).round_().clamp_(0.0, camera.white_level)
    return numbers.sub_(black).div_(span)
