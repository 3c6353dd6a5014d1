"""The terms that `balanced` is made of, `Banding`, and how they are evaluated.

Exposure and blur are known of a capture; `Highlights`, `Shadows` and `Noise` are measured on the
frame that was recorded. Their constants were frozen before any agent was trained.

Those three are means over the samples of functions of the recorded value. `TermScores` evaluates
them from the histogram of a frame's codes. Their expectation over the noise of a light is a mean
over the light of smooth functions, which are tabulated once for each noise: exact for the means,
and for scores to the first order in their noise, which a frame of thousands of samples averages.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numba
import numpy as np
import torch
from scipy.special import ndtr

from ae_env.observation import PEDESTAL, decode_observation, encode_array, encode_observation
from ae_env.scorers.composite import CompositeScorer
from ae_env.scorers.protocol import Captures, DependsOn, Domain, PixelBlur
from simulator.camera import CameraProfile
from simulator.capture.sensor import Transitions, record
from simulator.settings import CameraSettings
from simulator.utils.cache import LruCache
from simulator.utils.compute import addresses, as_pointer, kernel, parallel_ranges

#: Memory for tabulated expectations [byte].
_BYTES = 2**25
#: Samples times frames from which another thread is worth waking.
_WORTH_A_THREAD = 2**15
#: Expectations are tabulated at this many values between two codes.
_FINE = 8
#: Distance at which noise no longer matters, in its standard deviations.
_FAR = 4.5
#: The normal distribution up to there, and its values in a standard deviation.
_PER_DEVIATION = 128
_NORMAL = ndtr(np.arange(-_FAR * _PER_DEVIATION, _FAR * _PER_DEVIATION + 1) / _PER_DEVIATION)
_ZERO, _ONE = np.float32(0), np.float32(1)
_PEDESTAL = np.float32(PEDESTAL)
_SCALE = np.float32(255.0 * _FINE / math.sqrt(1.0 + PEDESTAL))
_BLOCK = 256
_jit = kernel(fastmath={"nsz", "contract", "reassoc"}, boundscheck=False)


class Brightness:
    """Exposure against the incident light: snow stays white and night stays dark.

    ``exp(-(sqrt(1 + e^2) - 1))`` with e the stops of over-exposure: EV of the incident light minus
    EV of the settings. Where the light is unknown, e is against a mean of 0.12 of white. In
    flickering light, the mean over the rows, each with its own e.
    """

    domain: Domain = "raw"
    depends_on: DependsOn = "light"
    reads_pixels = False

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        error = captures.proper_ev - captures.ev100
        if captures.row_gain is None:
            return torch.exp(1.0 - torch.sqrt(1.0 + error**2))
        error = error[:, None] + captures.row_gain.log2()  # (B, H)
        return torch.exp(1.0 - torch.sqrt(1.0 + error**2)).mean(dim=1)


class Banding:
    """Bands of flickering light on a rolling shutter: ``1 / (1 + (s / s0)^2)``.

    s is the standard deviation over the rows of log2 of their light [stops]; s0 is 0.1 stop, that
    of a sinusoidal band of +-10 % of the light. 1 where all rows have the same light.
    """

    domain: Domain = "raw"
    depends_on: DependsOn = "light"
    reads_pixels = False
    scale = 0.1

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        if captures.row_gain is None:
            return torch.ones(len(captures), dtype=torch.float64)
        stops = captures.row_gain.clamp(min=2.0**-64).log2()  # dark between pulses
        spread = stops.std(dim=1, correction=0)
        return 1.0 / (1.0 + (spread / self.scale) ** 2)


def code_signals() -> torch.Tensor:
    """(256,) float32 signals of the 8-bit codes; 0 up to the code of black."""
    signals = torch.from_numpy(decode_observation(np.arange(256, dtype=np.uint8)))
    signals[: int(encode_observation(torch.zeros(1))) + 1] = 0.0
    return signals


def recorded_signal(images: torch.Tensor) -> torch.Tensor:
    """Signal of raw `images` (B, 4, H, W) as their 8-bit codes show it, at least 0.

    The terms are functions of these codes, so that what rates a frame is what an agent sees of it.
    """
    return code_signals().to(images.device)[encode_observation(images).long()]


class Highlights:
    """Blown highlights: ``exp(-f / 0.15)``, f the share of pixels with a plane at white.

    At white is the last of the 8-bit codes: 0.996 of sensor white or more.

    Attributes:
        scale: Share at which the score is 1/e, 0.15.
    """

    domain: Domain = "raw"
    scale = 0.15

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        blown = recorded_signal(images).amax(dim=1) >= 1.0
        return torch.exp(-blown.double().mean(dim=(1, 2)) / self.scale)


class Shadows:
    """Blocked shadows: ``exp(-f / 0.20)``, f the mean of ``sigmoid(-(log2(x) + 9) / 0.5)``.

    Attributes:
        scale: Share at which the score is 1/e, 0.20.
        depth: How far below white a sample is half blocked, 9 stops.
        width: Of the sigmoid, 0.5 stop.
    """

    domain: Domain = "raw"
    scale = 0.20
    depth = 9.0
    width = 0.5

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        dark = self.shares(recorded_signal(images))
        return torch.exp(-dark.mean(dim=(1, 2, 3), dtype=torch.float64) / self.scale)

    @classmethod
    def shares(cls, signal: torch.Tensor) -> torch.Tensor:
        """How far samples of a recorded `signal` are blocked, 0 to 1."""
        stops = signal.clamp(min=2.0**-40).log2_()
        return torch.sigmoid((stops + cls.depth).mul_(-1.0 / cls.width))


class Noise:
    """Signal-to-noise ratio of a native sensor pixel: mean of ``s / (s + 18^1.5)``, s = SNR^1.5.

    SNR is ``x / sqrt(variance)`` of the recorded value x. The variance is that of the noise in the
    frame: shot and read noise at the settings, or the source's where that is greater; none where
    the frame has none. It is of the sensor's own pixels, not of the box-averaged frame: otherwise
    ISO would be nearly free.

    Attributes:
        half_snr: SNR at which the score is a half, 18.
    """

    domain: Domain = "raw"
    half_snr = 18.0

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        signal = recorded_signal(images)
        shares = self.shares(signal, captures.noise_variance(signal))
        return shares.mean(dim=(1, 2, 3), dtype=torch.float64)

    @classmethod
    def shares(cls, signal: torch.Tensor, variance: torch.Tensor) -> torch.Tensor:
        """``s / (s + 18^1.5)`` of samples of a recorded `signal`, >= 0, with this noise."""
        power = (signal.square() / variance.clamp(min=1e-30)).pow_(0.75)  # SNR**1.5
        return power / (power + cls.half_snr**1.5)


class Sharpness:
    """Motion and defocus blur: mean over the pixels of ``1 / (1 + (b / b0)^2)``.

    b is the extent of both blurs of a pixel together in pixels of the frame, b0 a 64th of its
    height.
    """

    domain: Domain = "raw"
    depends_on: DependsOn = "blur"
    reads_pixels = False

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,)."""
        blur = captures.blur_px if captures.pixel_blur is None else captures.pixel_blur
        return self.of(blur, captures.frame_height)

    @staticmethod
    def of(blur: torch.Tensor | PixelBlur, frame_height: int) -> torch.Tensor:
        """Scores (B,) of extents (B,), or of those of the pixels, in frames so high."""
        scale = 64.0 / frame_height
        if isinstance(blur, PixelBlur):
            return (blur.shares / (1.0 + (blur.levels * scale) ** 2)).sum(dim=1)
        return 1.0 / (1.0 + (blur * scale) ** 2)


def _logarithm(values: Any) -> Any:
    """Natural logarithm; of arrays by NumPy, as torch's threads do not survive a fork."""
    return values.log() if torch.is_tensor(values) else np.log(values)


class Balanced(CompositeScorer):
    """The default scorer: a photograph is as good as its worst fault allows.

    Product of the five terms, each to its weight, times ``(1 - fh^4) (1 - fs^4)``, fh and fs the
    shares of blown and blocked pixels: a frame that is all white or all black scores near 0.
    """

    def __init__(self) -> None:
        weighted: dict[str, tuple[Any, float]] = {
            "brightness": (Brightness(), 0.30),
            "highlights": (Highlights(), 0.15),
            "shadows": (Shadows(), 0.10),
            "noise": (Noise(), 0.20),
            "sharpness": (Sharpness(), 0.25),
        }
        super().__init__(
            {name: part for name, (part, _) in weighted.items()},
            {name: weight for name, (_, weight) in weighted.items()},
        )

    def combine(self, scores: Mapping[str, Any]) -> Any:
        """Total score from the parts' scores: tensors, arrays of any one shape, or numbers."""
        blown = -Highlights.scale * _logarithm(scores["highlights"])
        blocked = -Shadows.scale * _logarithm(scores["shadows"])
        # Rounding may leave a share above 1.
        score = (1.0 - blown**4).clip(0.0, 1.0) * (1.0 - blocked**4).clip(0.0, 1.0)
        for name, weight in self.weights.items():
            score = score * scores[name] ** weight
        return score


# -- scores from codes ----------------------------------------------------------------------------

#: Column of the means for each term; and the terms that need none.
_COLUMNS = {Highlights: 0, Shadows: 1, Noise: 2}
_WITHOUT_PIXELS = (Banding, Brightness, Sharpness)
_SIGNALS = code_signals()


class TermScores:
    """Those parts of a scorer that are made of the terms above, composites of them included.

    Args:
        scorer: The scorer whose parts they are.
        camera: The body that takes the captures.
        states: The settings of the S states.
        noise: Whether captures are noisy.

    Attributes:
        parts: Those parts by name.
    """

    def __init__(
        self,
        scorer: CompositeScorer,
        camera: CameraProfile,
        states: Sequence[CameraSettings],
        *,
        noise: bool,
    ) -> None:
        self.parts = {n: p for n, p in scorer.parts.items() if _is_known(p) and _has_pixels(p)}
        #: Whether a part needs `Captures` besides the means.
        self.reads_captures = any(type(part) not in _COLUMNS for part in self.parts.values())
        self.camera, self.noise = camera, noise
        isos = sorted({state.iso for state in states})
        noises = [camera.nlf(iso) for iso in isos]
        self._which = np.array([isos.index(state.iso) for state in states])
        self._shot_read = np.array([[n.shot, n.read] for n in noises])[self._which]  # (S, 2, 4)
        self._shares = self._noise_shares(np.array([[n.shot, n.read] for n in noises]))
        self._dark = Shadows.shares(_SIGNALS).numpy()
        self._edges = _code_edges(camera)
        # Up to light beyond white that even the most noise does not bring back.
        shot, read = (max(max(getattr(n, name)) for n in noises) for name in ("shot", "read"))
        light = 1.0
        for _ in range(100):
            light = 1.0 + _FAR * math.sqrt(shot * light + read)
        self._size = int(_FINE * (2.0 + 255.0 * math.sqrt(light + PEDESTAL)))
        self._tables: LruCache[np.ndarray] = LruCache(_BYTES)

    def _noise_shares(
        self, shot_read: np.ndarray, source_noise: np.ndarray | None = None
    ) -> np.ndarray:
        """(K, 4, 256) float32 `Noise.shares` of each code.

        Args:
            shot_read: (K, 2, 4) noise of a native pixel.
            source_noise: (K, 2, 4) noise of the source, where it may be greater.
        """
        light = _SIGNALS.double().numpy()
        variance = np.zeros((len(shot_read), 4, 256))
        if self.noise:
            variance = shot_read[:, 0, :, None] * light + shot_read[:, 1, :, None]
            if source_noise is not None:
                other = source_noise[:, 0, :, None] * light + source_noise[:, 1, :, None]
                variance = np.maximum(variance, other)
        shares: np.ndarray = Noise.shares(_SIGNALS, torch.from_numpy(variance).float()).numpy()
        return shares

    def score(self, means: np.ndarray, captures: Captures | None) -> dict[str, np.ndarray]:
        """Scores (B,) float64 by part.

        Args:
            means: (B, 3) result of `measured` or `expected` for the captures.
            captures: The captures; None unless `reads_captures`.
        """
        return {name: _score(part, means, captures) for name, part in self.parts.items()}

    def _shares_of_frames(
        self, states: np.ndarray, source_noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Noise shares (K, 4, 256) and which of them each frame has; see `measured`."""
        noisy = source_noise.any(axis=(1, 2))
        if not noisy.any():
            return self._shares, self._which[states]
        own = self._noise_shares(self._shot_read[states[noisy]], source_noise[noisy])
        which = self._which[states]
        which[noisy] = len(self._shares) + np.arange(len(own))
        return np.concatenate([self._shares, own]), which

    def measured(
        self, codes: np.ndarray, states: np.ndarray, source_noise: np.ndarray
    ) -> np.ndarray:
        """Means (B, 3) of recorded frames: shares of blown and of blocked samples, and `noise`.

        Args:
            codes: (B, 4, H, W) uint8 of the frames.
            states: (B,) at which they were taken.
            source_noise: (B, 2, 4) shot and read noise of the sources, of a native pixel.
        """
        shares, which = self._shares_of_frames(states, source_noise)
        flat = codes.reshape(len(codes), 4, -1)
        means = np.empty((len(codes), 3))
        least = max(1, _WORTH_A_THREAD // flat[0].size)
        fixed = (flat, shares, which, self._dark, means)
        parallel_ranges(lambda a, b: measure_codes(a, b, *fixed), len(codes), least=least)
        return means

    def expected(
        self,
        transitions: Transitions,
        states: np.ndarray,
        box_factors: np.ndarray,
        row_gain: np.ndarray | None = None,
    ) -> np.ndarray:
        """Expectation (B, 3) of `measured` over the noise that the transitions add.

        Args:
            transitions: Light and exposures.
            states: (B,) of the frames.
            box_factors: (B,) sensor pixels averaged per side into one of the frame.
            row_gain: (B, H) light of each row relative to the frame's, or None.
        """
        table = transitions.before_rounding(self.camera).averaged_table()
        source_noise = table[:, 3:] * np.square(box_factors)[:, None, None]
        if not self.noise:
            codes = np.empty((len(table), *transitions.light[0].shape), np.uint8)
            record(transitions, self.camera, row_gain=row_gain, codes=codes)
            return self.measured(codes, states, source_noise)
        shares, which = self._shares_of_frames(states, source_noise)
        # What the noise shares depend on, too.
        kinds = np.stack([self._which[states], box_factors], axis=1)
        keys = [table[i, 1:].tobytes() + kinds[i].tobytes() for i in range(len(table))]
        numbers: dict[bytes, int] = {}
        tables: list[np.ndarray] = []
        for i, key in enumerate(keys):
            if key not in numbers:
                numbers[key] = len(tables)
                tables.append(self._tabulated(key, table[i, 1:3], shares[which[i]]))
        height, width = transitions.light[0].shape[-2:]
        rows = np.ones((len(table), 1)) if row_gain is None else row_gain
        fixed = (
            addresses(transitions.light),
            1 if row_gain is None else height,
            height * width if row_gain is None else width,
            table[:, 0].astype(np.float32),
            rows.astype(np.float32),
            self._size,
            np.array([tables[numbers[key]].ctypes.data for key in keys], np.uintp),
        )
        means = np.empty((len(table), 3))
        least = max(1, _WORTH_A_THREAD // (4 * height * width))
        parallel_ranges(lambda a, b: expect_means(a, b, *fixed, means), len(table), least=least)
        return means

    def _tabulated(self, key: bytes, missing: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """(4, 3, G) float32 expectations by light: above the last code, blocked, and `noise`."""
        found = self._tables.get(key)
        if found is None:
            found = np.empty((4, 3, self._size), np.float32)
            for plane in range(4):
                noise = self._edges[plane], *missing[:, plane]
                expect_codes(self._dark, shares[plane], *noise, found[plane])
            self._tables.put(key, found, found.nbytes)
        return found


def _code_edges(camera: CameraProfile) -> np.ndarray:
    """(4, 256) signals from which a plane is recorded as each code or one above.

    A signal is rounded to digital numbers first: halfway below the first number of a code.
    """
    numbers = np.arange(camera.white_level + 1.0)
    edges = np.empty((4, 256))
    for plane, (black, span) in enumerate(zip(camera.black_level, camera.span, strict=True)):
        first = np.searchsorted(encode_array((numbers - black) / span), np.arange(256))
        edges[plane] = (first - 0.5 - black) / span
    return edges


def _is_known(part: Any) -> bool:
    """Whether `part` is exactly what is computed here; a subclass may do something else."""
    if isinstance(part, CompositeScorer):
        known = type(part).__module__.startswith("ae_env.")
        return known and all(map(_is_known, part.parts.values()))
    # An instance with constants of its own is not known either.
    return type(part) in (*_COLUMNS, *_WITHOUT_PIXELS) and not vars(part)


def _has_pixels(part: Any) -> bool:
    if isinstance(part, CompositeScorer):
        return any(map(_has_pixels, part.parts.values()))
    return type(part) in _COLUMNS


def _score(part: Any, means: np.ndarray, captures: Captures | None) -> np.ndarray:
    if isinstance(part, CompositeScorer):
        scores = {name: _score(inner, means, captures) for name, inner in part.parts.items()}
        return part.totals(scores)
    column = _COLUMNS.get(type(part))
    if column is None:
        return np.asarray(part(None, captures).numpy())
    values = means[:, column]
    return np.asarray(np.clip(values if column == 2 else np.exp(-values / part.scale), 0.0, 1.0))


# -- kernels --------------------------------------------------------------------------------------


@_jit
def measure_codes(  # type: ignore[no-untyped-def]
    first, last, codes, shares, which, dark, means
):
    """Means of the frames `first` to `last`.

    Args:
        first: First frame.
        last: One past the last.
        codes: (B, 4, N) uint8.
        shares: (K, 4, 256) float32, what a sample of each code adds to `noise`.
        which: (B,) which of them each frame has.
        dark: (256,) float32, what a sample of each code adds to the share of blocked ones.
        means: (B, 3) float64 to write to.
    """
    size = codes.shape[2]
    # Four histograms: a sample need not wait for that of the sample before.
    counts = np.empty((4, 256), np.int32)
    whole = size // 4 * 4
    for frame in range(first, last):
        blown, planes, blocked, clean = 0, 0, 0.0, 0.0
        for plane in range(4):
            samples = codes[frame, plane]
            counts[:] = 0
            for i in range(0, whole, 4):
                counts[0, samples[i]] += 1
                counts[1, samples[i + 1]] += 1
                counts[2, samples[i + 2]] += 1
                counts[3, samples[i + 3]] += 1
            for i in range(whole, size):
                counts[0, samples[i]] += 1
            for code in range(256):
                count = counts[0, code] + counts[1, code] + counts[2, code] + counts[3, code]
                blocked += count * np.float64(dark[code])
                clean += count * np.float64(shares[which[frame], plane, code])
            white = counts[0, 255] + counts[1, 255] + counts[2, 255] + counts[3, 255]
            blown, planes = blown + white, planes + (white > 0)
        if planes > 1:  # else no pixel was counted twice
            blown = 0
            red, green, other, blue = codes[frame]
            for i in range(size):
                brightest = max(max(red[i], green[i]), max(other[i], blue[i]))
                blown += brightest == 255
        means[frame, 0] = blown / size
        means[frame, 1] = blocked / (4 * size)
        means[frame, 2] = clean / (4 * size)


@_jit
def _normal_above(z):  # type: ignore[no-untyped-def]
    """Share of standard normals above -z, |z| <= `_FAR`, within 1e-5."""
    place = (z + _FAR) * _PER_DEVIATION
    index = min(int(place), len(_NORMAL) - 2)
    return _NORMAL[index] + (place - index) * (_NORMAL[index + 1] - _NORMAL[index])


@_jit
def expect_codes(dark, clean, edges, shot, read, out):  # type: ignore[no-untyped-def]
    """Expectations of functions of the code that noisy light is recorded as.

    Args:
        dark: (256,) float32 by code, the first function.
        clean: (256,) float32, the second.
        edges: (256,) signals from which each code is recorded, or one above.
        shot: Shot noise that is added.
        read: Read noise that is added.
        out: (3, G) float32 to write to, at `_FINE` values of light between two codes: the
            probability of the last code, and both expectations.
    """
    unit, start, last, count = (1.0 + PEDESTAL) / 255.0**2, 0, 0, out.shape[1]
    i = 0
    while True:
        light = unit * (i / _FINE) ** 2 - PEDESTAL
        spread = math.sqrt(max(max(light, 0.0) * shot + read, 1e-30))
        lowest, highest = light - _FAR * spread, light + _FAR * spread
        while start > 0 and edges[start] > lowest:
            start -= 1
        while start < 255 and edges[start + 1] <= lowest:
            start += 1
        code, by_spread = start, 1.0 / spread
        blocked, noise, above = dark[code], clean[code], np.float64(code == 255)
        while code < 255 and edges[code + 1] <= highest:
            code += 1
            above = _normal_above((light - edges[code]) * by_spread)
            blocked += above * (dark[code] - dark[code - 1])
            noise += above * (clean[code] - clean[code - 1])
        out[0, i] = above if code == 255 else 0.0
        out[1, i], out[2, i] = blocked, noise
        for f in range(3):  # a straight line from the last one
            for j in range(last + 1, i):
                share = (j - last) / (i - last)
                out[f, j] = out[f, last] + share * (out[f, i] - out[f, last])
        if i == count - 1:
            return
        # Steps of a quarter of a standard deviation: wide noise leaves nothing fine.
        step = math.sqrt((light + 0.25 * spread + PEDESTAL) / unit) * _FINE
        last, i = i, min(max(i + 1, int(step)), count - 1)


@_jit
def _interpolated(table, places, shares):  # type: ignore[no-untyped-def]
    """Sum of a function between `places` and the next ones."""
    total = _ZERO
    for i in range(len(places)):
        low, high = table[places[i]], table[places[i] + 1]
        total += low + shares[i] * (high - low)
    return total


@_jit
def expect_means(  # type: ignore[no-untyped-def]
    first, last, light, rows, columns, ratio, row_gain, grid, tables, means
):
    """Expected means of the frames `first` to `last`.

    Args:
        first: First frame.
        last: One past the last.
        light: (B,) addresses of (4, R, C) float32.
        rows: R; 1 where all rows have the same gain.
        columns: C.
        ratio: (B, 4) float32, what the light is multiplied by.
        row_gain: (B, R) float32.
        grid: G.
        tables: (B,) addresses of (4, 3, G) float32 of `expect_codes`.
        means: (B, 3) float64 to write to.
    """
    kept, shares = np.empty((2, _BLOCK), np.float32)
    places = np.empty(_BLOCK, np.int32)
    size, end_of_grid = rows * columns, np.float32(grid - 1.001)
    for frame in range(first, last):
        pointer = as_pointer(light[frame])  # type: ignore[call-arg, var-annotated]
        signal = numba.carray(pointer, (4, size))
        own = numba.carray(as_pointer(tables[frame]), (4, 3, grid))
        blown = blocked = clean = 0.0
        for row in range(rows):
            gain = row_gain[frame, row]
            for start in range(row * columns, (row + 1) * columns, _BLOCK):
                end = min(start + _BLOCK, (row + 1) * columns)
                number = end - start
                kept[:number] = _ONE
                for plane in range(4):
                    factor, part = ratio[frame, plane] * gain, signal[plane, start:end]
                    brightest = np.int32(0)
                    for i in range(number):
                        x = part[i] * factor + _PEDESTAL
                        place = min(np.sqrt(x if x > _ZERO else _ZERO) * _SCALE, end_of_grid)
                        places[i] = np.int32(place)
                        shares[i] = place - np.float32(places[i])
                        brightest = max(brightest, places[i])
                    table = own[plane]
                    blocked += _interpolated(table[1], places[:number], shares)
                    clean += _interpolated(table[2], places[:number], shares)
                    if table[0, brightest + 1] > _ZERO:
                        for i in range(number):
                            low, high = table[0, places[i]], table[0, places[i] + 1]
                            kept[i] *= _ONE - (low + shares[i] * (high - low))
                left = _ZERO
                for i in range(number):
                    left += kept[i]
                blown += number - left
        means[frame, 0] = blown / size
        means[frame, 1] = blocked / (4 * size)
        means[frame, 2] = clean / (4 * size)
