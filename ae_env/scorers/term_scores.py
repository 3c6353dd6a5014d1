"""`TermScores`: the scores of frames, and of what is known of captures without a frame.

`Highlights`, `Shadows` and `Noise` are means over the samples of functions of the recorded value.
What each code of a frame adds is looked up. Their expectation over the noise of a light is a mean
over the light of smooth functions, which are tabulated once for each noise: exact for the means,
and for scores to the first order in their noise, which a frame of thousands of samples averages.
All other parts of a scorer are torch's.
"""

import math
from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch

from ae_env.observation import PEDESTAL, encode_array
from ae_env.scenes.scene import Scene
from ae_env.scorers.captures import Captures, DependsOn, SceneCaptures
from ae_env.scorers.terms import (
    Banding,
    Brightness,
    CompositeScorer,
    Highlights,
    Noise,
    Shadows,
    Sharpness,
    code_signals,
    depends_on,
)
from simulator.camera import CameraProfile
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import CodeMeans, Transitions, packed_tables, record
from simulator.settings import CameraSettings
from simulator.utils.cache import LruCache
from simulator.utils.compute import addresses, as_pointer, kernel, parallel_ranges

#: Memory for tabulated expectations [byte].
_BYTES = 2**25
#: States whose pixels are looked at at once: more only spends time in memory paging.
CHUNK = 16
#: Samples times frames from which another thread is worth waking.
_WORTH_A_THREAD = 2**15
#: Expectations are tabulated at this many values between two codes.
_FINE = 8
#: Distance at which noise no longer matters, in its standard deviations.
_FAR = 4.5
#: The normal distribution up to there, and its values in a standard deviation.
_PER_DEVIATION = 128
_NORMAL = np.arange(-_FAR * _PER_DEVIATION, _FAR * _PER_DEVIATION + 1) / _PER_DEVIATION
_NORMAL = torch.special.ndtr(torch.from_numpy(_NORMAL)).numpy()
_ZERO, _ONE = np.float32(0), np.float32(1)
_PEDESTAL = np.float32(PEDESTAL)
_SCALE = np.float32(255.0 * _FINE / math.sqrt(1.0 + PEDESTAL))
_BLOCK = 256
#: Column of the means for each term; and the terms that need none.
_COLUMNS = {Highlights: 0, Shadows: 1, Noise: 2}
_WITHOUT_PIXELS = (Banding, Brightness, Sharpness)
_SIGNALS = code_signals()
_jit = kernel(fastmath={"nsz", "contract", "reassoc"}, boundscheck=False)


class TermScores:
    """Scores of one scorer at the states of a grid, part by part; see `ScoreTables`."""

    def __init__(
        self,
        scorer: CompositeScorer,
        camera: CameraProfile,
        states: Sequence[CameraSettings],
        *,
        noise: bool,
    ) -> None:
        self.camera, self.states, self.noise = camera, states, noise
        #: Parts that are made of the terms of `ae_env.scorers.terms` alone, composites included,
        #: and measured on frames; by name. Their expectation has a closed form.
        self.parts = {n: p for n, p in scorer.parts.items() if _is_known(p) and _has_pixels(p)}
        others = {n: p for n, p in scorer.parts.items() if n not in self.parts}
        #: All other parts, which torch evaluates; None if there are none.
        self.torch_terms = CompositeScorer(others) if others else None
        #: Whether `parts` need `Captures` besides the means.
        self.reads_captures = any(type(part) not in _COLUMNS for part in self.parts.values())
        #: Whether every part's expectation has one, so that no noise is drawn for it.
        self.closed_form = self.torch_terms is None or self.torch_terms.closed_form
        #: Names of the parts of `torch_terms` that depend on blur, if all are `Sharpness`.
        of_blur = [n for n, part in others.items() if depends_on(part) == "blur"]
        self.only_sharpness = of_blur if all(type(others[n]) is Sharpness for n in of_blur) else []
        #: Whether those of `torch_terms` that look at no frame take no account of a source's noise.
        seen = [part for part in others.values() if depends_on(part) != "image"]
        self.ignores_noise = all(type(part) in _WITHOUT_PIXELS for part in seen)
        self.captures = SceneCaptures(camera, states, noisy=noise)
        noises = [*dict.fromkeys(each := camera.nlfs(states))]
        self._which = np.array([noises.index(nlf) for nlf in each])
        self._shot_read = np.array([[n.shot, n.read] for n in noises])[self._which]  # (S, 2, 4)
        self._shares = self._noise_shares(np.array([[n.shot, n.read] for n in noises]))
        self._dark = Shadows().shares(_SIGNALS).numpy()
        self._packed = packed_tables(self._dark, self._shares)
        self._edges = _code_edges(camera)
        # Up to light beyond white that even the most noise does not bring back.
        shot, read = (max(max(getattr(n, name)) for n in noises) for name in ("shot", "read"))
        light = 1.0
        for _ in range(100):
            light = 1.0 + _FAR * math.sqrt(shot * light + read)
        self._size = int(_FINE * (2.0 + 255.0 * math.sqrt(light + PEDESTAL)))
        self._tables: LruCache[np.ndarray] = LruCache(_BYTES)

    def torch_scores(
        self, images: torch.Tensor | None, captures: Captures, *kinds: DependsOn
    ) -> dict[str, Any]:
        """Scores (B,) of `torch_terms` that depend on `kinds`; those on the CPU as arrays."""
        if self.torch_terms is None:
            return {}
        scores = self.torch_terms.score_parts(images, captures, kinds)
        return {n: values.numpy() if values.is_cpu else values for n, values in scores.items()}

    def closed_form_terms(
        self,
        scene: Scene,
        prepared: PreparedScene,
        *kinds: DependsOn,
        gain: float | np.ndarray = 1.0,
        row_gain: np.ndarray | None = None,
    ) -> dict[str, np.ndarray]:
        """Scores (S,) of those of `torch_terms` that look at no frame but depend on `kinds`.

        `prepared` is the scene as it is in the episode; for the gains see `ScoreTables.table`.
        """
        if self.torch_terms is None or not (names := self.torch_terms.names(*kinds)):
            return {}
        if names == self.only_sharpness:
            return dict.fromkeys(names, self.captures.sharpness(scene, prepared))
        terms, chunks = [self.torch_terms.parts[name] for name in names], []
        # Without ``reads_pixels = False``, a scorer may look at the light.
        chunk = CHUNK if any(getattr(term, "reads_pixels", True) for term in terms) else None
        for part in slices(len(self.states), chunk):
            captures = self.captures.describe(scene, prepared, part, gain, row_gain)
            chunks.append(self.torch_scores(None, captures, *kinds))
        return {name: np.concatenate([c[name] for c in chunks]) for name in names}

    # -- parts that are made of terms ---------------------------------------------------------

    def _noise_shares(
        self, shot_read: np.ndarray, source_noise: np.ndarray | None = None
    ) -> np.ndarray:
        """(K, 4, 256) float32 `Noise.shares` of each code, for noise (K, 2, 4) of native pixels.

        That of the source is (K, 2, 4), too; the greater of both counts.
        """
        light = _SIGNALS.double().numpy()
        variance = np.zeros((len(shot_read), 4, 256))
        if self.noise:
            variance = shot_read[:, 0, :, None] * light + shot_read[:, 1, :, None]
            if source_noise is not None:
                other = source_noise[:, 0, :, None] * light + source_noise[:, 1, :, None]
                variance = np.maximum(variance, other)
            variance += (self.camera.prnu * light) ** 2
        shares: np.ndarray = Noise().shares(_SIGNALS, torch.from_numpy(variance).float()).numpy()
        return shares

    def score(self, means: Any, captures: Captures | None) -> dict[str, Any]:
        """Scores (B,) by part, from the `means` (B, 3) of `measured` or `expected`."""
        return {name: _score(part, means, captures) for name, part in self.parts.items()}

    def _shares_of_frames(
        self, states: np.ndarray, source_noise: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Noise shares (K, 4, 256) and which of them each frame has; see `measured`."""
        if source_noise is None or not (noisy := source_noise.any(axis=(1, 2))).any():
            return self._shares, self._which[states]
        own = self._noise_shares(self._shot_read[states[noisy]], source_noise[noisy])
        which = self._which[states]
        which[noisy] = len(self._shares) + np.arange(len(own))
        return np.concatenate([self._shares, own]), which

    def measured(
        self,
        codes: np.ndarray | torch.Tensor,
        states: np.ndarray,
        source_noise: np.ndarray | None = None,
    ) -> Any:
        """Means (B, 3) of recorded frames: shares of blown and of blocked samples, and `noise`.

        Args:
            codes: (B, 4, H, W) uint8 of the frames; a tensor on any device gives one on it.
            states: (B,) at which they were taken.
            source_noise: (B, 2, 4) shot and read noise of the sources, of a native pixel, or None.
        """
        shares, which = self._shares_of_frames(states, source_noise)
        if isinstance(codes, torch.Tensor):
            return _means_by_torch(codes.flatten(2), shares, which, self._dark)
        packed = self._packed if shares is self._shares else packed_tables(self._dark, shares)
        found = CodeMeans.empty(packed, which)
        found.fill(codes)
        return found.means

    def means_of(self, states: np.ndarray) -> CodeMeans:
        """`measured`, to be filled when frames of clean sources are recorded at `states` (B,)."""
        return CodeMeans.empty(self._packed, self._which.take(states))

    def expected(
        self,
        transitions: Transitions,
        states: np.ndarray,
        box_factors: np.ndarray,
        row_gain: np.ndarray | None = None,
    ) -> Any:
        """Expectation (B, 3) of `measured` over the noise that the transitions (B,) add.

        `box_factors` (B,) sensor pixels per side are averaged into one of the frame; `row_gain`
        (B, H) is the light of each row relative to the frame's.
        """
        light = transitions.light
        table = transitions.before_rounding(self.camera).averaged_table()
        source_noise = table[:, 3:] * np.square(box_factors)[:, None, None]
        if not self.noise:
            codes: Any = np.empty((len(table), *transitions.shape), np.uint8)
            if isinstance(light, torch.Tensor):
                codes = torch.empty(codes.shape, dtype=torch.uint8, device=light.device)
            record(transitions, self.camera, row_gain=row_gain, codes=codes)
            return self.measured(codes, states, source_noise)
        shares, which = self._shares_of_frames(states, source_noise)
        # What the noise shares depend on, too.
        kinds = np.stack([self._which[states], box_factors], axis=1)
        keys = [table[i, 1:].tobytes() + kinds[i].tobytes() for i in range(len(table))]
        tables: dict[bytes, np.ndarray] = {}
        for i, key in enumerate(keys):
            if key not in tables:
                tables[key] = self._tabulated(key, table[i, 1:3], shares[which[i]])
        _, height, width = transitions.shape
        rows = np.ones((len(table), 1)) if row_gain is None else row_gain
        if isinstance(light, torch.Tensor):
            place = {key: number for number, key in enumerate(tables)}
            own = light, table[:, 0], rows, [*tables.values()], [place[key] for key in keys]
            return _expected_by_torch(*own)
        fixed = (
            addresses(light),
            *transitions.shape[1:],
            table[:, 0].astype(np.float32),
            rows.astype(np.float32),
            self._size,
            np.array([tables[key].ctypes.data for key in keys], np.uintp),
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


def slices(count: int, size: int | None) -> list[slice]:
    """[0, `count`) in parts of `size`; None for one."""
    size = size or count
    return [slice(i, min(i + size, count)) for i in range(0, count, size)]


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


def _score(part: Any, means: Any, captures: Captures | None) -> Any:
    if isinstance(part, CompositeScorer):
        scores = {name: _score(inner, means, captures) for name, inner in part.parts.items()}
        return part.totals(scores)
    column, placed = _COLUMNS.get(type(part)), isinstance(means, torch.Tensor)
    if column is None:
        scores = part(None, captures)
        return scores.to(means) if placed else np.asarray(scores.numpy())
    values, exp = means[:, column], torch.exp if placed else np.exp
    return values.clip(None, 1.0) if column == 2 else exp(values / -part.scale)


def _means_by_torch(
    codes: torch.Tensor, shares: np.ndarray, which: np.ndarray, dark: np.ndarray
) -> torch.Tensor:
    """`CodeMeans` by torch operations on any device."""
    to, index = codes.device, codes.long()
    own = torch.from_numpy(shares).to(to)[torch.from_numpy(which).to(to)]  # (B, 4, 256)
    blocked = torch.from_numpy(dark).to(to)[index].mean(dim=(1, 2))
    clean, blown = own.gather(2, index).mean(dim=(1, 2)), (codes == 255).any(dim=1)
    return torch.stack([blown.float().mean(dim=1), blocked, clean], dim=1)


def _expected_by_torch(
    light: torch.Tensor,
    ratio: np.ndarray,
    row_gain: np.ndarray,
    tables: Sequence[np.ndarray],
    which: Sequence[int],
) -> torch.Tensor:
    """`expect_means` by torch operations on the device of `light` (B, 4, H, W).

    `tables` are (4, 3, G), of which frame b has ``which[b]``.
    """
    to, size = light.device, tables[0].shape[-1]
    factors = ratio[:, :, None] * row_gain[:, None]  # (B, 4, H or 1)
    signal = light * torch.from_numpy(factors.astype(np.float32)).to(to)[..., None]
    place = signal.add_(PEDESTAL).clamp_(min=0.0).sqrt_().mul_(float(_SCALE)).flatten(2)
    place = place.clamp_(max=size - 1.001)
    index = place.long()
    share, values = place - index, torch.from_numpy(np.concatenate(tables).ravel()).to(to)
    first = 4 * torch.tensor(which, device=to)[:, None] + torch.arange(4, device=to)  # (B, 4)
    starts = [index + ((3 * first + function) * size)[..., None] for function in range(3)]
    above, blocked, clean = (torch.lerp(values[i], values[i + 1], share) for i in starts)
    blown = (1.0 - (1.0 - above).prod(dim=1)).mean(dim=1)
    return torch.stack([blown, blocked.mean(dim=(1, 2)), clean.mean(dim=(1, 2))], dim=1)


@_jit
def _normal_above(z):  # type: ignore[no-untyped-def]
    """Share of standard normals above -z, |z| <= `_FAR`, within 1e-5."""
    place = (z + _FAR) * _PER_DEVIATION
    index = min(int(place), len(_NORMAL) - 2)
    return _NORMAL[index] + (place - index) * (_NORMAL[index + 1] - _NORMAL[index])


@_jit
def expect_codes(dark, clean, edges, shot, read, out):  # type: ignore[no-untyped-def]
    """Expectations of functions of the code that noisy light is recorded as.

    `dark` and `clean` (256,) are the functions, `edges` (256,) the signals from which each code or
    one above is recorded; `shot` and `read` are the noise that is added. `out` (3, G) gets, at
    `_FINE` values of light from code to code, the last one's probability and both expectations.
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
    """Expected means (B, 3) of the frames from the `first` to before the `last`.

    `light` has addresses (B,) of (4, R, C) float32, which `ratio` (B, 4) and `row_gain` (B, R),
    or (B, 1), multiply. `tables` has those of (4, 3, G) float32 of `expect_codes`, G the `grid`.
    """
    kept, shares = np.empty((2, _BLOCK), np.float32)
    places = np.empty(_BLOCK, np.int32)
    size, end_of_grid = rows * columns, np.float32(grid - 1.001)
    for frame in range(first, last):
        pointer = as_pointer(light[frame])  # type: ignore[call-arg, var-annotated]
        signal = numba.carray(pointer, (4, size))
        own = numba.carray(as_pointer(tables[frame]), (4, 3, grid))
        blown = blocked = clean = 0.0
        bands = False
        for gain in row_gain[frame]:
            bands |= gain != row_gain[frame, 0]
        length = columns if bands else size  # a frame without any is summed as alone
        for row in range(size // length):
            gain = row_gain[frame, row]
            for start in range(row * length, (row + 1) * length, _BLOCK):
                end = min(start + _BLOCK, (row + 1) * length)
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
