"""How much of a transition may be left out, in units of the target's noise."""

from __future__ import annotations

import math
from numbers import Real

#: By default the distribution of a pixel may move by a tenth of its noise's standard deviation.
DEFAULT_TOLERANCE = 0.1


def check_tolerance(tolerance: float) -> float:
    """`tolerance` as a float.

    Raises:
        ValueError: Unless it is a finite number >= 0.
    """
    if (
        isinstance(tolerance, bool)
        or not isinstance(tolerance, Real)
        or not 0 <= tolerance < math.inf
    ):
        raise ValueError(f"`tolerance` (={tolerance!r}) must be a finite number >= 0")
    return float(tolerance)


class Budget:
    """Errors of the steps of one transition, and which of them a tolerance leaves out.

    Noise that stays widens a pixel's distribution, blur that is missing shifts it: squares add.
    Several missing blurs shift it the same way and add up; each is booked with what it adds to the
    square, so that the root of the sum of squares of all errors is right for any set of steps.

    Args:
        tolerance: Bound on the root of the sum of squares of what is left out. 0 leaves out nothing
            that changes a pixel.
    """

    def __init__(self, tolerance: float) -> None:
        self.tolerance = tolerance
        self.errors: dict[str, float] = {}
        self._noise = self._blur = 0.0

    def leaves_out_noise_reduction(self, error: float, *, pointless: bool = False) -> bool:
        """Books noise reduction, which errs by `error` if left out.

        Args:
            error: See `simulator.light_statistics.LightStatistics.excess`.
            pointless: Whether the network would err as much: it is left out then whatever it costs,
                unless nothing is to be left out.
        """
        self.errors["noise_reduction"] = error
        left_out = self.tolerance > 0.0 and (error <= self.tolerance or pointless)
        self._noise = error if left_out else 0.0
        return left_out

    def leaves_out_blur(self, name: str, error: float) -> bool:
        """Books a blur, which errs by `error` if it alone is left out."""
        together = self._blur + error
        left_out = self.tolerance > 0.0 and math.hypot(self._noise, together) <= self.tolerance
        self.errors[name] = math.sqrt(error * (together + self._blur)) if error else 0.0
        if left_out:
            self._blur = together
        return left_out
