"""Sequences of captures of one scene, and the pairs of them that train and test each module."""

import functools
import itertools
import math
from collections.abc import Sequence as SequenceOf
from dataclasses import dataclass
from typing import Literal, Protocol, get_args

import numpy as np

from simulator.camera import CameraProfile
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.reference.reference_camera import ReferenceScene
from simulator.settings import CameraSettings, exposure_ratio, incident_ev100, sensor_signal
from simulator.utils.checks import check_word

Stage = Literal["exposure", "noise", "aperture", "all"]

#: ISO speeds, third stops as cameras mark them.
# fmt: off
ISO_SPEEDS = (
    100, 125, 160, 200, 250, 320, 400, 500, 640, 800, 1000, 1250, 1600, 2000, 2500, 3200, 4000,
    5000, 6400, 8000, 10000, 12800, 16000,
)
# fmt: on
#: Exposure times [s]: the exact third stops that the marked 1/8000 ... 4 s stand for.
EXPOSURE_TIMES = tuple(2.0 ** (k / 3) for k in range(-39, 7))
#: F-numbers, whole stops as lenses mark them.
F_NUMBERS = (4.0, 5.6, 8.0, 11.0, 16.0, 22.0)
#: Captures in a sequence, fewest and most.
CAPTURES = (20, 25)
#: Illuminance [lux] of the darkest and brightest scene that the paper photographed.
ILLUMINANCE = (1.0, 20_000.0)

#: Exposure error [EV]: a normal distribution of this standard deviation, cut at `_LARGEST_ERROR`.
_ERROR_SPREAD = 2.0
_LARGEST_ERROR = 3.0
#: ISO, in stops above 100, that the draw centres on in the darkest and in the brightest scene.
_ISO_CENTRES, _ISO_SPREAD = (5.0, 1.5), 2.5
#: Aperture, in stops below f/4, likewise.
_APERTURE_CENTRES, _APERTURE_SPREAD = (1.0, 4.0), 2.0
#: Noise beyond the calibrated ISOs is extrapolated: this far, and no further.
_ISO_BEYOND = 2.5

#: Highest ISO of a target with little noise (paper, section 4.2: 100, 200 and 400).
LOW_ISO = 400.0
#: Its noise variance, relative to the source's at the same exposure, is at most this.
_LOW_NOISE = 0.25
#: Exposure error [EV] of a target that is neither grossly dark nor grossly clipped.
_FAIR_ERROR = (-3.0, 2.0)
#: Share of pairs without a change of aperture among those of the aperture stage.
_SAME_APERTURE = 0.1
_GREY = 0.18


@dataclass(frozen=True)
class Sequence:
    """One scene and the settings of each of its captures, at least two."""

    scene: ReferenceScene
    settings: tuple[CameraSettings, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "settings", tuple(self.settings))
        if len(self.settings) < 2:
            raise ValueError(f"`settings` (={self.settings}) must be at least 2 captures")


class HasSettings(Protocol):
    """A sequence of captures, simulated or real."""

    @property
    def settings(self) -> tuple[CameraSettings, ...]:
        """The settings of each capture."""


@dataclass(frozen=True, order=True)
class Pair:
    """Two captures of one sequence, the input of a module and its target, by their indices."""

    sequence: int
    source: int
    target: int


def draw_settings(
    illuminance: float, rng: np.random.Generator, camera: CameraProfile
) -> list[CameraSettings]:
    """Draw the settings of one sequence, as the paper captured its own (section 4.1).

    20 to 25 different triples of ISO 100 to 16000, 1/8000 to 4 s and f/4 to f/22, all discrete. A
    triple is drawn with a weight that falls with its exposure error (normal, 2 EV, none beyond
    3 EV) and with its distance from an ISO and an aperture that depend on the light: the brighter
    the scene, the lower the ISO, the shorter the time and the smaller the aperture on average.

    `illuminance` is the light on the scene [lux], 1 to 20,000 in the paper. ISOs above 2.5 times
    the highest calibrated one of `camera` are not drawn. The settings are in ascending order (ISO,
    then time, then f-number). A `ValueError` if fewer than 25 expose such a scene to within 3 EV.
    """
    candidates, stops = _candidates(min(camera.nlf_by_iso), _ISO_BEYOND * max(camera.nlf_by_iso))
    weights = _weights(stops, incident_ev100(illuminance))
    if np.count_nonzero(weights) < CAPTURES[1]:
        raise ValueError(
            f"`illuminance` (={illuminance}) must let at least {CAPTURES[1]} settings expose to "
            f"within {_LARGEST_ERROR:g} EV; {np.count_nonzero(weights)} do"
        )
    count = int(rng.integers(CAPTURES[0], CAPTURES[1] + 1))
    drawn = rng.choice(len(candidates), count, replace=False, p=weights / weights.sum())
    return sorted(candidates[i] for i in drawn)


@functools.cache
def _candidates(lowest_iso: float, highest_iso: float) -> tuple[list[CameraSettings], np.ndarray]:
    """Every triple, in ascending order, and (n, 3): log2 exposure, ISO and aperture in stops."""
    isos = [iso for iso in ISO_SPEEDS if lowest_iso <= iso <= highest_iso]
    triples = itertools.product(isos, EXPOSURE_TIMES, F_NUMBERS)
    candidates = [CameraSettings(*triple) for triple in triples]
    widest = 4  # f/4 lets 4 stops less light through than f/1
    stops = [
        (s.log2_exposure, math.log2(s.iso / 100.0), s.aperture_stop / 3 - widest)
        for s in candidates
    ]
    return candidates, np.array(stops)


def _weights(stops: np.ndarray, light: float) -> np.ndarray:
    """How likely each candidate is drawn, up to a factor, in a scene of EV100 `light`."""
    darkest, brightest = (incident_ev100(e) for e in ILLUMINANCE)
    brightness = min(max((light - darkest) / (brightest - darkest), 0.0), 1.0)
    centres = [low + (high - low) * brightness for low, high in (_ISO_CENTRES, _APERTURE_CENTRES)]
    error, iso, aperture = light + stops[:, 0], *(stops[:, 1:] - centres).T
    distance = (
        (error / _ERROR_SPREAD) ** 2 + (iso / _ISO_SPREAD) ** 2 + (aperture / _APERTURE_SPREAD) ** 2
    )
    return np.where(np.abs(error) <= _LARGEST_ERROR, np.exp(-0.5 * distance), 0.0)


def select_pairs(
    sequences: SequenceOf[Sequence], stage: Stage, camera: CameraProfile
) -> list[Pair]:
    """Select the pairs that a stage of the training uses (paper, section 4.2, "Pair selection").

    They are in ascending order. By `stage`:

    - ``"exposure"`` or ``"all"``: any two captures of a sequence, in either direction.
    - ``"noise"``: the same f-number, so that defocus does not differ; a target with little noise:
      ISO 400 or less, and at mid grey at most a quarter of the source's noise variance, by the
      noise of `camera`, once both are at the same exposure; the target exposed to within
      -3 to +2 EV.
    - ``"aperture"``: a target with a smaller f-number than the source, and up to a tenth of pairs
      with the same one, for which nothing should change.
    """
    check_word("stage", stage, get_args(Stage))
    if stage == "noise":
        return [pair for pair in any_pairs(sequences) if _has_little_noise(sequences, pair, camera)]
    return opening_pairs(sequences) if stage == "aperture" else any_pairs(sequences)


def any_pairs(sequences: SequenceOf[HasSettings]) -> list[Pair]:
    """Any two captures of a sequence, in either direction, in ascending order."""
    return [
        Pair(index, source, target)
        for index, sequence in enumerate(sequences)
        for source, target in itertools.permutations(range(len(sequence.settings)), 2)
    ]


def grey_signal(scene: ReferenceScene, settings: CameraSettings) -> float:
    """Signal of a grey card (18 %) in the scene's light, 1.0 at sensor white; unclipped.

    Where the scene's illuminance is unknown, the median of its light stands for the card.
    """
    if scene.illuminance is not None:
        return sensor_signal(_GREY * scene.illuminance / math.pi, settings)
    return float(scene.light.median()) * exposure_ratio(scene.reference, settings)


def _has_little_noise(sequences: SequenceOf[Sequence], pair: Pair, camera: CameraProfile) -> bool:
    # An 18 % card at the exposure that an incident-light meter gives, 0.119 of sensor white.
    right = sensor_signal(_GREY * 2.5 / math.pi, CameraSettings(100, 1.0, 1.0))
    sequence = sequences[pair.sequence]
    source, target = sequence.settings[pair.source], sequence.settings[pair.target]
    if source.aperture_stop != target.aperture_stop or target.iso > LOW_ISO:
        return False
    grey = grey_signal(sequence.scene, target)
    error = math.log2(grey / right) if grey > 0 else -math.inf
    if not _FAIR_ERROR[0] <= error <= _FAIR_ERROR[1]:
        return False
    own, wanted = camera.nlfs([source, target])
    return is_cleaner(wanted, own.exposed(exposure_ratio(source, target)), grey)


def is_cleaner(target: NoiseLevelFunction, source: NoiseLevelFunction, signal: float) -> bool:
    """Whether the target's noise variance at `signal` is at most a quarter of the source's."""
    target_variance, source_variance = (
        sum(r + s * signal for r, s in zip(nlf.read, nlf.shot, strict=True))
        for nlf in (target, source)
    )
    return target_variance <= _LOW_NOISE * source_variance


def opening_pairs(sequences: SequenceOf[HasSettings]) -> list[Pair]:
    """Pairs whose target is more open than the source, and up to a tenth that are as open."""
    pairs = any_pairs(sequences)

    def stops(pair: Pair) -> int:
        settings = sequences[pair.sequence].settings
        return settings[pair.source].aperture_stop - settings[pair.target].aperture_stop

    opened = [p for p in pairs if stops(p) > 0]
    same = [p for p in pairs if stops(p) == 0]
    room = int(len(opened) * _SAME_APERTURE / (1 - _SAME_APERTURE))
    # Evenly spaced, so that every sequence has its share.
    chosen = [same[i * len(same) // room] for i in range(room)] if room < len(same) else same
    return sorted(opened + chosen)
