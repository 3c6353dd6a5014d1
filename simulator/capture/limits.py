"""Limits of captures: their error, and the light and the blur that they are made of."""

import sys

from simulator.utils.checks import check_number

#: Error that a capture may have, in units of the target's noise: by default the distribution of a
#: pixel may move by a tenth of its noise's standard deviation.
DEFAULT_TOLERANCE = 0.1
#: Signals beyond this many times sensor white are clipped early: they end at white in any case,
#: and an infinite variance times a zero draw would be NaN.
SIGNAL_LIMIT = 1e6
#: Exposure ratios are limited to this: float32 must hold them, and any two settings keep below.
RATIO_LIMIT = 2.0**107
#: Most negative signal that a companded 8-bit code shows; the offset under its square root.
PEDESTAL = 1.0 / 1024.0
#: Discs of defocus may be as wide as the frame, on small frames this wide [pixel]: the memory that
#: a blur takes grows with the square of it.
MAX_DISC_PX = 512.0


def check_tolerance(tolerance: float) -> float:
    """`tolerance` as a float; a `ValueError` unless it is a finite number >= 0."""
    more = "; ask `simulate` for the full run" if tolerance is None else ""
    return check_number("tolerance", tolerance, 0.0, sys.float_info.max, more=more)
