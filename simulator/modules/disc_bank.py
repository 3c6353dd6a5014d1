"""Defocus that varies from pixel to pixel, as a blend of a few uniform disc blurs.

Blurring once with every disc of a bank and interpolating between neighbours, per pixel and in the
*squared* diameter (second moments add, so that is where blur is linear), makes any map of blur
diameters and any f-number for the cost of a gather.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from simulator.blur import disc_blur
from simulator.blur_shapes import disc_kernel

#: Diameters of the bank [pixel]: each doubles the blurred area, the step at which a blend of two
#: discs is within 2 % of the disc between them.
DIAMETERS = (0.0, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.3, 16.0, 22.6, 32.0)

_KNOTS = np.array(DIAMETERS) ** 2

#: How far the largest disc reaches, as a multiple of 4 [pixel].
HALO = 20


class DiscBank:
    """An image behind every disc of the bank; each blur is computed when it is first needed.

    Args:
        image: (..., H, W) linear light. No gradient flows into it.
    """

    def __init__(self, image: Tensor) -> None:
        self._levels = {0: image.detach()}

    def level(self, index: int) -> Tensor:
        """The image behind disc `index` of `DIAMETERS`."""
        if index not in self._levels:
            self._levels[index] = disc_blur(self._levels[0], DIAMETERS[index])
        return self._levels[index]

    def _blur(self, indices: list[int]) -> None:
        """Makes several levels side by side, which wakes the other threads once."""
        from simulator.blur_kernels import Blur, blur_many

        image = self._levels[0].contiguous()
        made = {index: torch.empty_like(image) for index in indices}
        blur_many([Blur(image, DIAMETERS[index], level) for index, level in made.items()])
        self._levels |= made

    def blurred(self, diameter: Tensor) -> Tensor:
        """The image blurred by `diameter`, differentiable in it.

        Args:
            diameter: (..., H, W) blur diameter of each pixel [pixel], >= 0, broadcast against the
                image; beyond the largest disc of the bank it stays there.
        """
        image, frame = self._levels[0], _frame_of(diameter)
        if frame is not None and frame.shape == image.shape[-2:] and _has_kernels(image):
            from simulator.blend_kernels import blend, needed  # numba: only where it is needed

            indices = needed(frame, _KNOTS)
            self._blur([index for index in indices if index not in self._levels])
            return blend({index: self._levels[index] for index in indices}, frame, _KNOTS)
        return self._blended(diameter.square().clamp(max=DIAMETERS[-1] ** 2))

    def _blended(self, squared: Tensor) -> Tensor:
        """`blurred` on any device, by squared diameter."""
        total: Tensor | None = None
        for index, weight in _weights(squared):
            term = self.level(index) * weight
            total = term if total is None else total + term
        assert total is not None
        return total


def remaining_variance(diameter: Tensor) -> Tensor:
    """Share of white noise's variance that `DiscBank.blurred` leaves, per pixel of `diameter`.

    The sum of squared weights of the blended kernel,
    ``(1 - t)^2 E_aa + 2 t (1 - t) E_ab + t^2 E_bb`` between discs a and b.
    """
    frame = _frame_of(diameter)
    if frame is not None:
        from simulator.blend_kernels import piecewise

        return piecewise(frame, _KNOTS, _kernel_products()).reshape(diameter.shape)
    return _remaining(diameter)


def _remaining(diameter: Tensor) -> Tensor:
    """`remaining_variance` on any device."""
    energy = torch.from_numpy(_kernel_products()).to(diameter)
    knots = torch.from_numpy(_KNOTS).to(diameter)
    squared = diameter.square().clamp(max=DIAMETERS[-1] ** 2)
    index = torch.searchsorted(knots[1:-1], squared, right=True)  # of the smaller disc
    same, both = energy.diagonal(), energy.diagonal(1)
    share = (squared - knots[index]) / knots.diff()[index]
    rest = 1.0 - share
    return rest.square() * same[index] + share * (
        2.0 * rest * both[index] + share * same[index + 1]
    )


def _has_kernels(image: Tensor) -> bool:
    return image.device.type == "cpu" and image.dtype == torch.float32


def _frame_of(diameter: Tensor) -> Tensor | None:
    """The diameters as one frame (H, W) that `simulator.blend_kernels` takes; None if they are not.

    Nothing is learnt through the kernels: a gradient takes the other way.
    """
    learns = diameter.requires_grad and torch.is_grad_enabled()
    if learns or not _has_kernels(diameter) or diameter.ndim < 2 or diameter.numel() == 0:
        return None
    frame = diameter.detach()
    if frame.numel() != frame.shape[-2] * frame.shape[-1]:
        return None
    return frame.reshape(frame.shape[-2:])


def _weights(squared: Tensor) -> Iterator[tuple[int, Tensor]]:
    """(index, weight) of every disc that some pixel needs: hat functions of squared diameter."""
    knots = _KNOTS.tolist()
    low, high = (float(v) for v in torch.aminmax(squared.detach()))
    for index, knot in enumerate(knots):
        before = knots[index - 1] if index else -1.0
        after = knots[index + 1] if index + 1 < len(knots) else knot + 1.0
        if before < high and low < after and not (high <= before or low >= after):
            rising = (squared - before) / (knot - before)
            falling = (after - squared) / (after - knot)
            yield index, torch.minimum(rising, falling).clamp(min=0.0)


@functools.cache
def _kernel_products() -> np.ndarray:
    """(K, K) sums of products of the weights of each disc and itself or its successor."""
    kernels = [disc_kernel(d) for d in DIAMETERS]
    products = np.zeros((len(kernels), len(kernels)))
    for i, kernel in enumerate(kernels):
        products[i, i] = (kernel**2).sum()
        if i + 1 < len(kernels):
            larger = kernels[i + 1]
            margin = (larger.shape[0] - kernel.shape[0]) // 2
            inner = larger[margin : margin + kernel.shape[0], margin : margin + kernel.shape[0]]
            products[i, i + 1] = (kernel * inner).sum()
    return products
