"""`CompositeScorer`, the weighted mean of others; `Balanced`, the default one, and its terms.

Each part is checked: it may be the user's own. Of the terms, exposure and blur are known of a
capture; `Highlights`, `Shadows` and `Noise` are measured on the frame that was recorded. Their
constants were frozen before any agent was trained.
"""

import logging
import math
import time
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, get_args

import numpy as np
import torch

from ae_env.observation import decode_observation, encode_observation
from ae_env.scorers.captures import Captures, ColourMatrix, DependsOn, Domain, Scorer
from ae_env.utils.user_files import UserCodeError
from simulator.raw.develop import develop_known
from simulator.utils.checks import as_float
from simulator.utils.compute import kernel

logger = logging.getLogger(__name__)

#: Scores may be this far outside [0, 1] by rounding.
ROUNDING = 1e-6
#: A user's scorer that takes longer than this for one batch is named in the log, once [s].
SLOW_SECONDS = 5.0
_slow: set[str] = set()  # those that were found in this process


def depends_on(scorer: Scorer) -> DependsOn:
    """The `DependsOn` of `scorer`; ``"image"`` unless it says otherwise."""
    return getattr(scorer, "depends_on", "image")


class CompositeScorer:
    """Weighted mean of scorers, the `parts` by name, with `weights`, equal by default.

    The weights are divided by their sum. A `ValueError` if a part is no scorer, or a weight is
    missing or not positive.
    """

    domain: Domain = "raw"

    def __init__(
        self, parts: Mapping[str, Scorer], weights: Mapping[str, float] | None = None
    ) -> None:
        weights = dict.fromkeys(parts, 1.0) if weights is None else dict(weights)
        fit = all(0 < as_float(w) < math.inf for w in weights.values())
        if not (parts and fit and set(weights) == set(parts)):
            rule = f"must give each of the parts {list(parts)} a finite number > 0"
            raise ValueError(f"`weights` (={weights}) {rule}")
        for name, part in parts.items():
            check_part(name, part)
        total = sum(weights.values())
        self.parts = dict(parts)
        self.weights = {name: weight / total for name, weight in weights.items()}

    @cached_property
    def closed_form(self) -> bool:
        """Whether every part has a closed form, so that no noise needs to be drawn."""
        return all(depends_on(part) != "image" for part in self.parts.values())

    @property
    def depends_on(self) -> DependsOn:
        """The `DependsOn` of the whole, as a part of another scorer."""
        if not self.closed_form:
            return "image"
        return "blur" if self.names("blur") else "light"

    def names(self, *kinds: DependsOn) -> list[str]:
        """Names of the parts that depend on one of `kinds`."""
        return [name for name, part in self.parts.items() if depends_on(part) in kinds]

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        """Scores (B,) of raw `images` (B, 4, H, W) in [0, 1]."""
        return self.combine(self.score_parts(images, captures))

    def score_parts(
        self,
        images: torch.Tensor | None,
        captures: Captures,
        kinds: tuple[DependsOn, ...] = ("image", "light", "blur"),
    ) -> dict[str, torch.Tensor]:
        """Score (B,) float64 of each part that depends on one of `kinds`.

        `images` and `captures` as of `Scorer`; developed to sRGB only if a part asks for it.
        """
        views: dict[str, torch.Tensor | None] = {"raw": images}
        scores = {}
        for name in self.names(*kinds):
            part = self.parts[name]
            view: torch.Tensor | None = None
            if depends_on(part) == "image":
                if images is None:
                    raise ValueError(f"scorer {name!r} needs `images`, got None")
                if part.domain not in views:
                    gains, matrices = captures.white_balance, captures.colour_matrices
                    views[part.domain] = developed(images, gains, matrices)
                view = views[part.domain]
                if view is not None and len(self.names("image")) > 1:
                    view = view.clone()  # a part may write to its images
            scores[name] = scores_of(name, part, view, captures)
        return scores

    def combine(self, scores: Mapping[str, Any]) -> Any:
        """Total of the parts' `scores`: tensors, arrays of any one shape, or numbers."""
        total: Any = sum(weight * scores[name] for name, weight in self.weights.items())
        # Rounding may leave [0, 1].
        return total.clip(0.0, 1.0) if torch.is_tensor(total) else np.clip(total, 0.0, 1.0)

    def totals(self, scores: Mapping[str, Any]) -> Any:
        """`combine` of arrays or tensors `scores`; a `UserCodeError` if one is not in [0, 1].

        It is checked because a user's class may override it.
        """
        placed, totals = any(map(torch.is_tensor, scores.values())), self.combine(scores)
        totals = torch.as_tensor(totals) if placed else np.asarray(totals, np.float64)
        if type(self).__module__.startswith("ae_env."):
            return totals
        if not ((totals >= -ROUNDING) & (totals <= 1.0 + ROUNDING)).all():
            found = _describe_range(totals)
            raise UserCodeError(
                f"scorer {type(self).__name__!r}: `combine` returned {found}: rule is [0, 1]"
            )
        return totals.clip(0.0, 1.0)


def developed(
    images: torch.Tensor, white_balance: torch.Tensor, matrices: Sequence[ColourMatrix | None]
) -> torch.Tensor:
    """sRGB (B, 3, H, W) of raws (B, 4, H, W), each in the colours of its own scene's camera.

    `white_balance` are (B, 3) gains of R, G, B; for `matrices` see `Captures.colour_matrices`.
    """
    if len(set(matrices)) == 1:
        return develop_known(images, white_balance, matrices[0])
    pairs = zip(images, white_balance, matrices, strict=True)
    return torch.cat([develop_known(image[None], gains, matrix) for image, gains, matrix in pairs])


def check_part(name: str, part: Any) -> None:
    """Raises a `ValueError` unless `part`, which is called `name`, is a scorer."""
    if not callable(part):
        raise ValueError(f"`scorer` (={name!r}) must be callable, got {type(part).__name__}")
    for attribute, known, value in (
        ("domain", get_args(Domain), getattr(part, "domain", None)),
        ("depends_on", get_args(DependsOn), depends_on(part)),
    ):
        if value not in known:
            *others, last = map(repr, known)
            rule = f"{', '.join(others)} or {last}"
            raise ValueError(f"scorer {name!r} has `{attribute}` (={value!r}); it must be {rule}")


def scores_of(
    name: str, scorer: Scorer, images: torch.Tensor | None, captures: Captures
) -> torch.Tensor:
    """Scores (B,) float64 in [0, 1] of one scorer, which may be the user's own.

    Errors call it `name`; `images` are (B, C, H, W), or None where it has a closed form. A
    `UserCodeError` if it raises (the cause is chained), returns anything but B numbers in [0, 1],
    or changes `captures`.
    """
    if not is_own(scorer):
        check = captures.device.type == "cpu"
        return _checked(name, scorer(images, captures), captures, check=check)
    before, begin = _versions(captures), time.perf_counter()
    try:
        scores = scorer(images, captures)
    except Exception as error:
        raise UserCodeError(f"scorer {name!r} raised {type(error).__name__}: {error}") from error
    if time.perf_counter() - begin > SLOW_SECONDS and name not in _slow:
        _slow.add(name)
        logger.warning("scorer %r takes more than %g s for one batch", name, SLOW_SECONDS)
    if _versions(captures) != before:
        raise UserCodeError(
            f"scorer {name!r} changed its `captures` in place: it must work on copies, because "
            "other scorers get the same ones"
        )
    return _checked(name, scores, captures)


def is_own(scorer: Any) -> bool:
    """Whether `scorer`, or a part of it, comes from outside of this package."""
    if not type(scorer).__module__.startswith("ae_env."):
        return True
    return any(is_own(part) for part in getattr(scorer, "parts", {}).values())


def _versions(captures: Captures) -> dict[str, int]:
    """The counts of writes, where not 0, that torch keeps for the tensors of `captures`."""
    tensors = [(n, value) for n, value in vars(captures).items() if isinstance(value, torch.Tensor)]
    return {n: t._version for n, t in tensors if not t.is_inference() and t._version}


def _checked(name: str, scores: Any, captures: Captures, *, check: bool = True) -> torch.Tensor:
    """`scores` where the captures are, on the CPU as float64, clipped to [0, 1].

    Rounding may leave that. To `check` their range, the CPU has to wait for a device.
    """
    count, dtype = len(captures), torch.float64 if captures.device.type == "cpu" else torch.float32
    if not isinstance(scores, torch.Tensor) or scores.shape != (count,) or scores.is_complex():
        what = type(scores).__name__
        if isinstance(scores, torch.Tensor):
            what = f"{tuple(scores.shape)} {scores.dtype}"
        raise UserCodeError(f"scorer {name!r} returned {what}: it must return a tensor ({count},)")
    found: Any = scores.detach().to(captures.device, dtype)
    values = found.numpy() if found.is_cpu else found  # NumPy takes less time for few numbers
    if check and not bool(((values >= -ROUNDING) & (values <= 1 + ROUNDING)).all()):  # NaN is not
        raise UserCodeError(f"scorer {name!r} returned {_describe_range(found)}: rule is [0, 1]")
    values = values.clip(0.0, 1.0)
    return torch.from_numpy(values) if found.is_cpu else values


def _describe_range(values: Any) -> str:
    """The range of an array or a tensor, for messages."""
    if bool((values != values).any()):
        return "NaN"
    return f"scores from {float(values.min())} to {float(values.max())}"


# -- the terms, and the default scorer -------------------------------------------------------------


class Brightness:
    """Exposure against the incident light: snow stays white and night stays dark.

    ``exp(-(sqrt(1 + e^2) - 1))`` with e the stops of over-exposure: EV of the incident light minus
    EV of the settings. Where the light is unknown, the mean over what is likely. In flickering
    light, the mean over the rows, each with its own e.
    """

    domain: Domain = "raw"
    depends_on: DependsOn = "light"
    reads_pixels = False

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        likely = captures.likely_ev
        error = captures.proper_ev[:, None] if likely is None else likely  # (B, K)
        error = error - captures.ev100[:, None]
        if captures.row_gain is not None:
            error = error[:, :, None] + captures.row_gain.log2()[:, None]  # (B, K, H)
        scores = torch.exp(1.0 - torch.sqrt(1.0 + error**2))
        while scores.ndim > 1:  # rows and lights that are alike have themselves as their mean
            first = scores[..., :1]
            scores = (first + (scores - first).mean(dim=-1, keepdim=True))[..., 0]
        return scores


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
        if captures.row_gain is None:
            return torch.ones(len(captures), dtype=torch.float64)
        stops = captures.row_gain.clamp(min=2.0**-64).log2()  # dark between pulses
        return 1.0 / (1.0 + (stops.std(dim=1, correction=0) / self.scale) ** 2)


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
    """

    domain: Domain = "raw"
    scale = 0.15

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        blown = recorded_signal(images).amax(dim=1) >= 1.0
        return torch.exp(-blown.double().mean(dim=(1, 2)) / self.scale)


class Shadows:
    """Blocked shadows: ``exp(-f / 0.20)``, f the mean of ``sigmoid(-(log2(x) + 9) / 0.5)``.

    9 stops below white, a sample is half blocked.
    """

    domain: Domain = "raw"
    scale = 0.20
    depth = 9.0
    width = 0.5

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        dark = self.shares(recorded_signal(images))
        return torch.exp(-dark.mean(dim=(1, 2, 3), dtype=torch.float64) / self.scale)

    def shares(self, signal: torch.Tensor) -> torch.Tensor:
        """How far samples of a recorded `signal` are blocked, 0 to 1."""
        stops = signal.clamp(min=2.0**-40).log2_()
        return torch.sigmoid((stops + self.depth).mul_(-1.0 / self.width))


class Noise:
    """Signal-to-noise ratio of a native sensor pixel: mean of ``s / (s + 18^1.5)``, s = SNR^1.5.

    SNR is ``x / sqrt(variance)`` of the recorded value x. The variance is that of the noise in the
    frame: shot and read noise at the settings, or the source's where that is greater; none where
    the frame has none. It is of the sensor's own pixels, not of the box-averaged frame: otherwise
    ISO would be nearly free.
    """

    domain: Domain = "raw"
    half_snr = 18.0

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        signal = recorded_signal(images)
        shares = self.shares(signal, captures.noise_variance(signal))
        return shares.mean(dim=(1, 2, 3), dtype=torch.float64)

    def shares(self, signal: torch.Tensor, variance: torch.Tensor) -> torch.Tensor:
        """``s / (s + 18^1.5)`` of samples of a recorded `signal`, >= 0, with this noise."""
        power = (signal.square() / variance.clamp(min=1e-30)).pow_(0.75)  # SNR**1.5
        return power / (power + self.half_snr**1.5)


class Sharpness:
    """Motion and defocus blur: mean over the pixels of ``1 / (1 + (b / b0)^2)``.

    b is the extent of both blurs of a pixel together, b0 a 64th of the frame's height.
    """

    domain: Domain = "raw"
    depends_on: DependsOn = "blur"
    reads_pixels = False

    def __call__(self, images: torch.Tensor | None, captures: Captures) -> torch.Tensor:
        scale, spread = 64.0 / captures.frame_height, captures.pixel_blur
        if spread is None:
            return 1.0 / (1.0 + (captures.blur_px * scale) ** 2)
        # In order: the rows of a larger batch are longer.
        return (spread.shares / (1.0 + (spread.levels * scale) ** 2)).cumsum(dim=1)[:, -1]


class Balanced(CompositeScorer):
    """The default scorer: a photograph is as good as its worst fault allows.

    Product of the five terms, each to its weight, times ``(1 - fh^4) (1 - fs^4)``, fh and fs the
    shares of blown and blocked pixels: a frame that is all white or all black scores near 0.
    """

    def __init__(self) -> None:
        parts: dict[str, Any] = {
            "brightness": Brightness(),
            "highlights": Highlights(),
            "shadows": Shadows(),
            "noise": Noise(),
            "sharpness": Sharpness(),
        }
        super().__init__(parts, dict(zip(parts, (0.30, 0.15, 0.10, 0.20, 0.25), strict=True)))

    def combine(self, scores: Mapping[str, Any]) -> Any:
        """Total of the parts' `scores`: tensors, arrays of any one shape, or numbers."""
        values, weights = [scores[name] for name in self.weights], [*self.weights.values()]
        faults = {name: self.parts[name].scale for name in ("highlights", "shadows")}  # type: ignore[attr-defined]
        if any(map(torch.is_tensor, values)):
            left = [1.0 - (torch.log(scores[name]) * faults[name]) ** 4 for name in faults]
            factors: Any = [*(share.clamp(min=0.0) for share in left), *map(pow, values, weights)]
            return math.prod(factors)
        try:  # arrays without torch, whose threads do not survive a fork
            columns = np.array(values, np.float64)
        except ValueError:  # of different shapes
            columns = np.array(np.broadcast_arrays(*values), np.float64)
        totals, rows = np.empty(columns.shape[1:]), [[*self.weights].index(name) for name in faults]
        fixed = np.array(weights), np.array(rows), np.array([*faults.values()])
        _balance(columns.reshape(len(columns), -1), *fixed, totals.reshape(-1))
        return totals[()]


@kernel()
def _balance(scores, weights, faults, scales, totals):  # type: ignore[no-untyped-def]
    """`Balanced.combine` of `scores` (K, N); shares of the two `faults` have these `scales`."""
    for i in range(len(totals)):
        total = 1.0
        for fault in range(2):
            left = 1.0 - (scales[fault] * math.log(scores[faults[fault], i])) ** 4
            total *= 0.0 if left < 0.0 else left  # rounding may leave a share above 1
        for part in range(len(weights)):
            total *= scores[part, i] ** weights[part]
        totals[i] = total
