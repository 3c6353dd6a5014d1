"""Motion and defocus blur of linear light, energy-preserving and matched in second moment.

Both work on *unclipped* light, so that a lamp ten times above white smears into a streak that is
still white: clipping comes later, once (see `simulator.capture.sensor`). Borders are replicated.
The shapes are those of `simulator.optics.shapes`.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F

from simulator.optics.shapes import disc_kernel, streak_share

_FFT_TAPS = 11  # kernels wider than this are applied in the Fourier domain
_DIRECT_TAPS = 25  # the same where `simulator.optics.blur_kernels` does the sum


def motion_blur(light: torch.Tensor, extent_px: float) -> torch.Tensor:
    """Uniform motion along the rows during the exposure.

    Args:
        light: (..., H, W) linear light.
        extent_px: Distance that the image moves, in pixels, >= 0.

    Returns:
        (..., H, W), the same dtype. A running sum in float64 makes the cost of long streaks
        independent of the extent.
    """
    n, end = streak_share(extent_px)
    if not n and not end:
        return light
    if _has_kernels(light):
        from simulator.optics.blur_kernels import streak  # numba: only where something is blurred

        return streak(light, extent_px)
    width, radius = light.shape[-1], n + 1
    covered = 2 * n + 1 + 2.0 * end
    full, edge = 1.0 / covered, end / covered
    if radius >= width:  # the whole row and both borders: counted, as padding might not fit
        column = torch.arange(width, device=light.device)
        left, right = radius - 1 - column + edge / full, column + radius - width + edge / full
        rows = light.double()
        total = rows.sum(-1, keepdim=True) + rows[..., :1] * left + rows[..., -1:] * right
        return (total * full).to(light.dtype)
    padded = F.pad(light.reshape(-1, 1, width), (radius, radius), mode="replicate")
    sums = F.pad(padded.double().cumsum(-1), (1, 0))
    inner = sums[..., 2 * radius : 2 * radius + width] - sums[..., 1 : 1 + width]
    ends = padded[..., :width] + padded[..., 2 * radius :]
    return (inner * full + ends.double() * edge).to(light.dtype).reshape(light.shape)


def disc_blur(light: torch.Tensor, diameter_px: float) -> torch.Tensor:
    """Defocus by a uniform disc.

    Args:
        light: (..., H, W) linear light.
        diameter_px: Diameter of the circle of confusion, in pixels, >= 0.

    Returns:
        (..., H, W), the same dtype.
    """
    weights = disc_kernel(diameter_px)
    taps = weights.shape[0]
    if taps == 1:
        return light
    if taps <= _DIRECT_TAPS and _has_kernels(light):
        from simulator.optics.blur_kernels import disc

        return disc(light, diameter_px)
    height, width = light.shape[-2:]
    radius = taps // 2
    padded = F.pad(light.reshape(-1, 1, height, width), (radius,) * 4, mode="replicate")
    kernel = torch.from_numpy(weights).to(light.device)
    if taps <= _FFT_TAPS:
        return F.conv2d(padded, kernel[None, None].to(light.dtype)).reshape(light.shape)
    # float64: a lamp a thousand times above white must not leave ringing in the shadows.
    size = [height + 2 * radius, width + 2 * radius]
    spectrum = torch.fft.rfft2(padded.double()) * torch.fft.rfft2(kernel, s=size)
    blurred = torch.fft.irfft2(spectrum, s=size)[..., 2 * radius :, 2 * radius :]
    return blurred.to(light.dtype).reshape(light.shape)


def _has_kernels(light: torch.Tensor) -> bool:
    return light.device.type == "cpu" and light.dtype == torch.float32 and not light.requires_grad


def box_mean(x: torch.Tensor, window: int) -> torch.Tensor:
    """Mean over `window` x `window` pixels, borders repeated.

    Sums over 1, 2, 4, 8 ... pixels are doubled from one another: a few additions of whole images
    where pooling would read every pixel `window` times.

    Args:
        x: (B, C, H, W).
        window: Odd side of the window [pixel].

    Returns:
        (B, C, H, W).
    """
    height, width = x.shape[-2:]
    padded = F.pad(x, (window // 2,) * 4, mode="replicate")
    rows = _running_sum(padded, window, -2, height)
    return _running_sum(rows, window, -1, width) / (window * window)


def _running_sum(x: torch.Tensor, window: int, axis: int, size: int) -> torch.Tensor:
    """Sums of `window` neighbours along `axis`, the first `size` of them."""
    total: torch.Tensor | None = None
    done, span = 0, 1
    while True:
        if window & span:
            part = x.narrow(axis, done, size)
            total = part if total is None else total + part
            done += span
        if 2 * span > window:
            assert total is not None
            return total
        length = x.shape[axis] - span
        x = x.narrow(axis, 0, length) + x.narrow(axis, span, length)
        span *= 2
