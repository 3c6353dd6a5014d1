"""The methods that are compared: each makes captures at other settings of a noisy raw.

*Shared* methods do what does not depend on the target settings once per raw (`Method.prepare`) and
expose the result as often as asked. *Transition* methods begin with the raw for every target.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import torch
from torch import Tensor, nn

from benchmarks.captures import recorded
from benchmarks.fidelity.denoising import behind_anscombe, non_local_means
from benchmarks.fidelity.models import load_models, weights
from simulator import (
    CameraSettings,
    CameraSimulator,
    NoiseLevelFunction,
    PreparedScene,
    RawImage,
    exposure_ratio,
)
from simulator.training.data import settings_parameters

Dtype = Literal["float32", "bfloat16"]

TOLERANCES = (0.0, 0.03, 0.1, 0.3, 1.0)
#: The one that bfloat16 and single transitions are measured with.
DEFAULT = 0.1


class Prepared(Protocol):
    """A raw, ready to be exposed."""

    def expose(
        self, states: Iterable[CameraSettings], *, seed: int = 0, out: Tensor | None = None
    ) -> Tensor:
        """One capture per state, (S, 4, H, W); written to `out` if that is given."""

    def expected(self, settings: CameraSettings) -> Tensor:
        """(4, H, W) the same without noise, not clipped."""


@dataclass(frozen=True, eq=False)
class Method:
    """One way from a raw to captures at other settings; either `prepare` or `shoot` is there.

    Args:
        name: As the tables have it.
        dtype: Of the networks.
        tolerance: Of the simulator's plan; None where there is no plan.
        prepare: What is done once per raw.
        shoot: One capture (4, H, W) from a raw, settings and a seed, and the same without noise.
    """

    name: str
    dtype: Dtype = "float32"
    tolerance: float | None = None
    prepare: Callable[[RawImage], Prepared] | None = None
    shoot: Callable[[RawImage, CameraSettings, int], tuple[Tensor, Tensor]] | None = None

    @property
    def mode(self) -> str:
        """Whether the work is shared by the states of a sweep."""
        return "transition" if self.prepare is None else "shared"

    @property
    def key(self) -> str:
        """Name with its type where that is not float32."""
        return self.name + ", bfloat16" * (self.dtype == "bfloat16")


def all_methods() -> list[Method]:
    """Every method whose weights are there."""
    bare, models = CameraSimulator(device="cpu"), load_models()
    methods = [
        Method("exposure", prepare=_Exposed),
        Method("exposure+nlf", prepare=bare.prepare),
        _with_non_local_means(bare),
    ]
    dtypes: tuple[Dtype, ...] = ("float32", "bfloat16")
    for dtype in dtypes:
        compact = simulator("compact", dtype)
        tolerances: Sequence[float] = TOLERANCES if dtype == "float32" else (0.0, DEFAULT)
        methods += [planned(compact, tolerance, dtype) for tolerance in tolerances]
        if dtype == "float32":
            methods.append(_planned_transition(compact, DEFAULT))
        methods.append(full("compact", compact, dtype))
        if "paper" in models.simulators:
            methods.append(full("paper", simulator("paper", dtype), dtype))
        methods += [_baseline(name, net, dtype) for name, net in models.baselines.items()]
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

    def expose(
        self, states: Iterable[CameraSettings], *, seed: int = 0, out: Tensor | None = None
    ) -> Tensor:
        camera = self._raw.camera
        return torch.stack([recorded(self.expected(s), camera) for s in states], out=out)

    def expected(self, settings: CameraSettings) -> Tensor:
        return self._raw.data * exposure_ratio(self._raw.settings, settings)


def _with_non_local_means(bare: CameraSimulator) -> Method:
    """Non-local means behind the Anscombe transform, once, then as a simulator without networks."""
    denoise = behind_anscombe(non_local_means)

    def prepare(raw: RawImage) -> Prepared:
        prepared = bare.prepare(raw)
        return replace(prepared, light=denoise(prepared), nlf=NoiseLevelFunction.zero())

    return Method("non-local means", prepare=prepare)


def planned(own: CameraSimulator, tolerance: float, dtype: Dtype = "float32") -> Method:
    """`own`, prepared once, leaving out what `tolerance` allows; it finds the defocus itself."""

    def prepare(raw: RawImage) -> Prepared:
        return own.prepare(raw, depth="unknown", tolerance=tolerance)

    return Method(f"compact {tolerance:g}", dtype, tolerance, prepare=prepare)


# -- transitions ----------------------------------------------------------------------------------


def _planned_transition(own: CameraSimulator, tolerance: float) -> Method:
    """One transition of `own` at a time, leaving out what `tolerance` allows."""

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


def _baseline(name: str, network: nn.Module, dtype: Dtype) -> Method:
    """A network that is told both settings, with the target's noise added to what it predicts."""

    @torch.no_grad()
    def shoot(raw: RawImage, settings: CameraSettings, seed: int) -> tuple[Tensor, Tensor]:
        told = [v for s in (raw.settings, settings) for v in settings_parameters(s)]
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=dtype == "bfloat16"):
            light = network(raw.data[None], torch.tensor([told]))[0].float()
        clean = PreparedScene(light, settings, raw.camera, NoiseLevelFunction.zero())
        return clean.expose([settings], seed=seed)[0], light

    return Method(name, dtype, shoot=shoot)
