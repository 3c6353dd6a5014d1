"""Charts of the page, as SVG made of numbers alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np

from ae_env.rendering import PATH_COLOURS

#: Colours of the planes R, G1, G2, B in a histogram.
_PLANES = ("#ff5c5c", "#4fd36b", "#b6f0a0", "#6aa5ff")
#: Colour of the best state, and of each policy.
BEST, POLICIES = "#a0a0a0", PATH_COLOURS[:2]
_WIDTH = 640


def score_colour(score: float) -> tuple[str, str]:
    """Background and ink of a score in [0, 1]."""
    red, green, blue, _ = matplotlib.colormaps["viridis"](min(max(score, 0.0), 1.0))
    ink = "#000" if 0.3 * red + 0.59 * green + 0.11 * blue > 0.45 else "#fff"
    return matplotlib.colors.to_hex((red, green, blue)), ink


def histogram(shares: np.ndarray, height: int = 96) -> str:
    """Histogram of the raw planes: black on the left, white on the right, root of the share."""
    tallest = float(np.sqrt(shares[:, 1:-1].max())) or 1.0  # clipped samples would hide the rest
    lines = []
    for plane, colour in zip(np.minimum(np.sqrt(shares) / tallest, 1.0), _PLANES, strict=True):
        lines.append(_line(plane, colour, height - 2, 0.0, 1.0))
    return _svg(lines, height)


def chart(lines: Mapping[str, Sequence[float]], low: float, high: float, height: int = 110) -> str:
    """Values over the frames of an episode, as HTML; the names of `lines` are their colours."""
    drawn = [_line(values, colour, height, low, high) for colour, values in lines.items()]
    ends = f'<span class="high">{high:.3g}</span><span class="low">{low:.3g}</span>'
    return _svg(drawn, height) + ends


def _line(
    values: Sequence[float] | np.ndarray, colour: str, height: int, low: float, high: float
) -> str:
    step, scale = _WIDTH / max(len(values) - 1, 1), (height - 4) / max(high - low, 1e-9)
    points = " ".join(
        f"{i * step:.1f},{height - 2 - (float(v) - low) * scale:.1f}" for i, v in enumerate(values)
    )
    return (
        f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2" '
        'vector-effect="non-scaling-stroke"/>'
    )


def _svg(parts: Sequence[str], height: int) -> str:
    return (
        f'<svg viewBox="0 0 {_WIDTH} {height}" preserveAspectRatio="none" '
        f'style="width:100%;height:{height}px;display:block">{"".join(parts)}</svg>'
    )
