"""Blind estimation of a raw's noise level function from its pixels.

After Foi, Trimeche, Katkovnik, Egiazarian, "Practical Poissonian-Gaussian noise modeling and
fitting for single-image raw-data" (IEEE TIP 2008): a high-pass that a smooth surface does not
reach, level sets, a robust scale per level, a robust fit of variance against level. Where the
paper finds smooth regions by an edge map and takes the median absolute deviation, this takes a low
quantile of block variances, which withstands texture in most of a level's blocks.
"""

import numpy as np
import torch

from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.raw.image import check_packed

#: Blocks overlap by half: each is four cells.
_BLOCK, _STEP = 8, 4
#: Share of each level's blocks that is used: those with the least slope.
_SMOOTH = 0.3
#: Quantile of their high-pass energy, and that quantile for white Gaussian noise of variance 1
#: (simulated once, 140,000 blocks): what makes the low quantile an unbiased variance.
_QUANTILE, _QUANTILE_OF_NOISE = 0.1, 0.6266
_BLOCKS_PER_LEVEL, _MAX_LEVELS = 200, 40
#: Fewest blocks that an estimate is made from.
_MIN_BLOCKS = 24
_MAX_PIXELS = 1_500_000
#: Highest share of clipped pixels in a block.
_CLIPPED = 0.01
#: Texture only adds: levels above the fit by more than this are left out (relative).
_ENVELOPE, _INLIER = 0.05, 0.15
#: Extremes that many pixels share are clips where they are near black and white.
_SHARED, _NEAR_BLACK, _NEAR_WHITE = 1e-3, 2e-3, 0.75
_TINY = 1e-14


def estimate_nlf(data: np.ndarray | torch.Tensor) -> NoiseLevelFunction:
    """Estimate a raw's noise level function from the raw alone.

    A `ValueError` if `data` is too small or too clipped to tell.

    Args:
        data: (4, H, W) packed raw, white at 1, at least 24 x 24. Its noise must be independent
            from pixel to pixel: not demosaicked, resampled, denoised or compressed with loss.

    The noise is the same in all four planes: they share one amplifier, and pooling them covers the
    most levels. Where the raw shows one level only, its variance is put down to shot noise, or to
    read noise at zero signal.

    Accuracy, variance at 2 to 50 % of white: within 7 % on flat fields and ramps, 12 % on
    photographs a little softer than the sensor. Where no level has a smooth surface - fine texture
    all over, at low ISO - the texture counts as noise and the estimate is too high, three times at
    worst in the trials (`docs/raw-files.md`). The read noise of a bright photograph is a guess.

    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> light = np.broadcast_to(np.linspace(0.0, 0.8, 256), (4, 256, 256))
    >>> noisy = light + np.sqrt(1e-4 * light + 1e-6) * rng.standard_normal(light.shape)
    >>> nlf = estimate_nlf(noisy)
    >>> bool(abs(nlf.shot[0] / 1e-4 - 1) < 0.05 and abs(nlf.read[0] / 1e-6 - 1) < 0.25)
    True
    """
    planes = _central_bands(check_packed("data", data).detach().cpu().numpy()).astype(np.float64)
    white, floor = min(1.0, float(planes.max())), float(planes.min())
    if white < _NEAR_WHITE and np.mean(planes == white) >= _SHARED:
        white = 1.0
    if floor > _NEAR_BLACK or np.mean(planes == floor) < _SHARED:
        floor = -np.inf
    found: list[tuple[np.ndarray, ...]] = [(np.empty(0),) * 3]
    if min(planes.shape[1:]) >= _BLOCK + 2:
        found = [_blocks_of(plane, white, floor) for plane in planes]
    mean, energy, slope = (np.concatenate(parts) for parts in zip(*found, strict=True))
    if len(mean) < _MIN_BLOCKS:
        raise ValueError(
            f"`data` (shape {tuple(planes.shape)}, {len(mean)} unclipped blocks) must have "
            f"at least {_MIN_BLOCKS} unclipped blocks of {_BLOCK} x {_BLOCK} to estimate the noise"
        )
    shot, read = 0.0, 1.0
    # The smooth blocks of equally populated levels, as indices.
    count = int(np.clip(len(mean) // _BLOCKS_PER_LEVEL, 1, _MAX_LEVELS))
    sets = np.array_split(np.argsort(mean, kind="stable"), count)
    levels = [own[slope[own] <= np.quantile(slope[own], _SMOOTH)] for own in sets]
    for _ in range(3):
        # A level set spans a range of signals: correct for the change of the variance inside it.
        level, variance, weight = _variance_by_level(mean, energy, levels, shot, read)
        # Close to a clip the noise is cut off: leave out levels within three standard deviations.
        sigma = np.sqrt(variance)
        clear = (level + 3 * sigma < white) & (level - 3 * sigma > floor)
        if clear.any():
            level, variance, weight = level[clear], variance[clear], weight[clear]
        shot, read = _fit(level, variance, weight)
    return NoiseLevelFunction((shot,) * 4, (read,) * 4, source="blind estimate (after Foi 2008)")


def _central_bands(planes: np.ndarray) -> np.ndarray:
    """Bands of 64 rows spread over the frame, so that large raws cost no more than small ones."""
    height, width = planes.shape[1:]
    every = -(-height * width // _MAX_PIXELS)
    if every <= 1:
        return planes
    starts = range(0, max(1, height - 63), 64 * every)
    return np.concatenate([planes[:, s : s + 64] for s in starts], axis=0)


def _quarters(image: np.ndarray) -> list[np.ndarray]:
    """Means of the four quarters, `_STEP` x `_STEP` pixels, of each block."""
    height, width = (n // _STEP for n in image.shape)
    rows = image[: height * _STEP].reshape(height, _STEP, -1).sum(axis=1)
    cells = rows[:, : width * _STEP].reshape(height, width, _STEP).sum(axis=2) / _STEP**2
    return [cells[:-1, :-1], cells[:-1, 1:], cells[1:, :-1], cells[1:, 1:]]


def _blocks_of(plane: np.ndarray, white: float, floor: float) -> tuple[np.ndarray, ...]:
    """Statistics (N,) of the overlapping blocks of one plane that are not clipped.

    The mean, the mean square of the high-pass (the noise variance on a smooth surface), and the
    spread of the four quarters' means.
    """
    # Immerkaer's [1 -2 1] x [1 -2 1]: blind to slopes and to curvature along one axis; over 6,
    # white noise has the same variance after it.
    rows = plane[:-2] - 2.0 * plane[1:-1] + plane[2:]
    high_pass = (rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:]) / 6.0
    inner = plane[1:-1, 1:-1]
    clipped = ((inner >= white) | (inner <= floor)).astype(np.float64)
    quarters = _quarters(inner)
    slope = np.maximum.reduce(quarters) - np.minimum.reduce(quarters)
    mean, energy, share = (
        np.mean(parts, axis=0) for parts in (quarters, _quarters(high_pass**2), _quarters(clipped))
    )
    keep = share <= _CLIPPED
    return mean[keep], energy[keep], slope[keep]


def _variance_by_level(
    mean: np.ndarray, energy: np.ndarray, levels: list[np.ndarray], shot: float, read: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Level, noise variance and number of blocks of each level set, each (L,)."""
    relative = energy / np.maximum(shot * np.maximum(mean, 0.0) + read, _TINY)
    rows = []
    for smooth in levels:
        level = float(mean[smooth].mean())
        scale = max(shot * max(level, 0.0) + read, _TINY)
        variance = scale * np.quantile(relative[smooth], _QUANTILE) / _QUANTILE_OF_NOISE
        rows.append((level, max(float(variance), _TINY), len(smooth)))
    means, variances, weight = np.array(rows, np.float64).T
    return means, variances, weight


def _fit(level: np.ndarray, variance: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Shot and read noise: first the lower envelope of the levels, then least squares near it."""
    signal = np.maximum(level, 0.0)
    if signal.max() < 0.5 * np.sqrt(np.median(variance)):  # a dark frame: no signal to speak of
        return 0.0, float(np.average(variance, weights=weight))
    if signal.max() < 1.3 * signal.min():  # one level: slope and intercept cannot be told apart
        return float(np.average(variance / signal, weights=weight)), 0.0
    shot, read = _least_squares(signal, variance, weight / variance**2)
    for step in range(40):
        model = np.maximum(shot * signal + read, _TINY)
        above = variance / model - 1.0
        if step < 30:
            trust = 1.0 / (1.0 + (np.maximum(above, 0.0) / _ENVELOPE) ** 2)
        else:
            trust = (above < _INLIER).astype(np.float64)
        shot, read = _least_squares(signal, variance, weight * trust / model**2)
    return shot, read


def _least_squares(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Non-negative slope and intercept of y against x, weighted."""
    w, wx, wxx = weight.sum(), (weight * x).sum(), (weight * x * x).sum()
    wy, wxy = (weight * y).sum(), (weight * x * y).sum()
    determinant = w * wxx - wx * wx
    if determinant <= 1e-12 * w * wxx:
        return (0.0, float(wy / w)) if wxx == 0.0 else (float(wxy / wxx), 0.0)
    slope, intercept = (w * wxy - wx * wy) / determinant, (wxx * wy - wx * wxy) / determinant
    if slope < 0.0:
        return 0.0, float(wy / w)
    if intercept < 0.0:
        return float(wxy / wxx), 0.0
    return float(slope), float(intercept)
