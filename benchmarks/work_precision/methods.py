"""The methods that are compared: each makes captures at other settings of a noisy raw.

*Shared* methods do what does not depend on the target settings once per raw (`Method.prepare`) and
expose the result as often as asked. *Transition* methods begin with the raw for every target.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from benchmarks.denoising import Denoiser, classical
from benchmarks.fidelity.models import weights
from simulator import CameraSettings, CameraSimulator, RawImage, exposure_ratio
from simulator.capture.limits import DEFAULT_TOLERANCE
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import clip_and_quantise
from simulator.noise.noise_level_function import NoiseLevelFunction

Dtype = Literal["float32", "bfloat16"]

TOLERANCES = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
#: The one that bfloat16 and single transitions are measured with.
DEFAULT = DEFAULT_TOLERANCE
#: Networks that may run, the least and the most accurate.
FAMILY = ("nano", "compact", "large")


@dataclass(frozen=True, eq=False)
class Method:
    """One way from a raw to captures at other settings; either `prepare` or `shoot` is there.

    `prepare` is what is done once per raw: its result has ``expose(states, seed=)``, a capture of
    each state (S, 4, H, W), and ``expected(settings)``, one without noise. `shoot` makes a capture
    (4, H, W) of a raw, settings and a seed, and the same without noise. `tolerance` is that of the
    simulator's plan, if any.
    """

    name: str
    dtype: Dtype = "float32"
    tolerance: float | None = None
    prepare: Callable[[RawImage], Any] | None = None
    shoot: Callable[[RawImage, CameraSettings, int], tuple[Tensor, Tensor]] | None = None

    @property
    def key(self) -> str:
        """Name with its type where that is not float32."""
        return self.name + ", bfloat16" * (self.dtype == "bfloat16")


def all_methods() -> list[Method]:
    """Every method whose weights are there; in bfloat16 where the processor computes it."""
    bare = CameraSimulator(device="cpu")
    methods = [
        Method("exposure", prepare=_Exposed),
        Method("exposure+nlf", prepare=bare.prepare),
        *(_denoised_by(name, denoise, bare) for name, denoise in classical().items()),
    ]
    both = bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
    dtypes: tuple[Dtype, ...] = ("float32", "bfloat16") if both else ("float32",)
    for dtype in dtypes:
        for name in FAMILY:
            tolerances = TOLERANCES if name == "large" and dtype == "float32" else (DEFAULT,)
            methods += [planned(name, tolerance, dtype) for tolerance in tolerances]
        if dtype == "float32":
            methods.append(_planned_transition(simulator("compact", dtype), DEFAULT))
        methods.append(full("large", simulator("large", dtype), dtype))
        if weights("paper") is not None:
            paper = simulator("paper", dtype)
            methods += [
                full("paper", paper, dtype),
                Method("paper, no repetition", dtype, prepare=partial(PaperSweep, paper)),
            ]
    return methods


def simulator(preset: str, dtype: Dtype = "float32") -> CameraSimulator:
    """A simulator that keeps no results: a second run must not be a look-up of the first."""
    path: Any = weights(preset)
    return CameraSimulator.from_pretrained(path, device="cpu", precision=dtype, cache=None)


# -- shared ---------------------------------------------------------------------------------------


class _Exposed:
    """The raw times the exposure ratio, clipped and quantised, with whatever noise it has."""

    def __init__(self, raw: RawImage) -> None:
        self._raw = raw

    def expose(self, states: Iterable[CameraSettings], *, seed: int = 0) -> Tensor:
        return torch.stack([clip_and_quantise(self.expected(s), self._raw.camera) for s in states])

    def expected(self, settings: CameraSettings) -> Tensor:
        return self._raw.data * exposure_ratio(self._raw.settings, settings)


def _denoised_by(name: str, denoise: Denoiser, bare: CameraSimulator) -> Method:
    """A denoiser, once, then as a simulator without networks."""

    def prepare(raw: RawImage) -> PreparedScene:
        prepared, clean = bare.prepare(raw), NoiseLevelFunction.zero()
        return replace(prepared, light=denoise(prepared.light, prepared.nlf), nlf=clean)

    return Method(name, prepare=prepare)


def _noisy(light: Tensor, settings: CameraSettings, raw: RawImage, seed: int) -> Tensor:
    """A capture of light without noise at the settings that it was exposed with."""
    clean = PreparedScene(light, settings, raw.camera, NoiseLevelFunction.zero())
    return clean.expose([settings], seed=seed)[0]


def planned(name: str, tolerance: float, dtype: Dtype = "float32") -> Method:
    prepare = partial(simulator(name, dtype).prepare, depth="unknown", tolerance=tolerance)
    return Method(f"{name} {tolerance:g}", dtype, tolerance, prepare=prepare)


class PaperSweep:
    """The paper's networks as a sensible user would sweep with them.

    States of equal exposure ratio share a run of the noise module, and those of equal f-number,
    too, one of the aperture module, which runs only where the aperture opens.
    """

    def __init__(self, own: CameraSimulator, raw: RawImage) -> None:
        self._own, self._raw = own, raw
        self._opened: dict[tuple[float, float], Tensor] = {}
        self._denoised: dict[float, Tensor] = {}

    def expose(self, states: Iterable[CameraSettings], *, seed: int = 0) -> Tensor:
        """See `Method`."""
        return torch.stack([_noisy(self.expected(s), s, self._raw, seed) for s in states])

    @torch.no_grad()
    def expected(self, settings: CameraSettings) -> Tensor:
        """See `Method`."""
        raw, ratio = self._raw, exposure_ratio(self._raw.settings, settings)
        own, source = self._own, self._raw.settings.effective_f_number
        assert own.noise is not None
        assert own.aperture is not None
        with torch.autocast("cpu", torch.bfloat16, enabled=own.precision == "bfloat16"):
            if ratio not in self._denoised:
                exposed = own.exposure(raw.data[None], ratio).clamp(0.0, 1.0)
                noise = raw.noise.exposed(ratio)
                numbers = (torch.tensor([v]) for v in (noise.shot, noise.read))
                self._denoised[ratio] = own.noise(exposed, *numbers)
            denoised, target = self._denoised[ratio], settings.effective_f_number
            if target >= source:
                return denoised[0]
            if (ratio, target) not in self._opened:
                f_numbers = (torch.tensor([n]) for n in (source, target))
                zero = torch.zeros_like(denoised)
                self._opened[ratio, target] = own.aperture(denoised, zero, *f_numbers)[0].float()
            return self._opened[ratio, target]


# -- transitions ----------------------------------------------------------------------------------


def _planned_transition(own: CameraSimulator, tolerance: float) -> Method:
    def shoot(raw: RawImage, settings: CameraSettings, seed: int) -> tuple[Tensor, Tensor]:
        prepared = own.prepare(raw, depth="unknown", tolerance=tolerance)
        return prepared.expose([settings], seed=seed)[0], prepared.expected(settings)

    return Method(f"compact {tolerance:g}, one at a time", "float32", tolerance, shoot=shoot)


def full(preset: str, own: CameraSimulator, dtype: Dtype = "float32") -> Method:
    """Every module of `own` for every transition, as ``simulate(..., tolerance=None)``."""

    def shoot(raw: RawImage, settings: CameraSettings, seed: int) -> tuple[Tensor, Tensor]:
        stages = own.stages(raw, settings, seed=seed)
        return stages.capture, stages.light

    return Method(f"{preset} full", dtype, shoot=shoot)
