"""The methods that are compared: what each makes of a noisy raw at other settings, and its noise.

*Shared* methods do what does not depend on the target settings once per raw (`Method.prepare`) and
expose the result as often as asked. *Transition* methods begin with the raw for every target.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from benchmarks.simulator.denoising import behind_anscombe, non_local_means
from benchmarks.simulator.models import FOLDER, Models
from simulator import CameraSettings, CameraSimulator, NoiseLevelFunction, RawImage, exposure_ratio
from simulator.capture.exposure import Exposure
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import add_noise, clip_and_quantise
from simulator.noise.generator import FrameNoise, sweep_keys
from simulator.training.data import settings_parameters

Dtype = Literal["float32", "bfloat16"]
Mode = Literal["shared", "transition"]

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


class Shot(NamedTuple):
    """A capture (4, H, W), and what makes the same without noise."""

    capture: Tensor
    expected: Callable[[], Tensor]


@dataclass(frozen=True, eq=False)
class Method:
    """One way from a raw to captures at other settings; either `prepare` or `shoot` is there.

    Args:
        name: As the tables have it.
        dtype: Of the networks.
        tolerance: Of the simulator's plan; None where there is no plan.
        prepare: What is done once per raw.
        shoot: One capture from a raw, settings and a seed.
    """

    name: str
    dtype: Dtype = "float32"
    tolerance: float | None = None
    prepare: Callable[[RawImage], Prepared] | None = None
    shoot: Callable[[RawImage, CameraSettings, int], Shot] | None = None

    @property
    def mode(self) -> Mode:
        """Whether the work is shared by the states of a sweep."""
        return "transition" if self.prepare is None else "shared"

    @property
    def key(self) -> tuple[str, str]:
        """What tells it from the others."""
        return self.name, self.dtype


def all_methods(models: Models) -> list[Method]:
    """Every method whose weights are there.

    Args:
        models: Trained networks.
    """
    methods = [exposure_only(), with_noise(), with_non_local_means()]
    dtypes: tuple[Dtype, ...] = ("float32", "bfloat16")
    for dtype in dtypes:
        compact = simulator(models, "compact", dtype)
        tolerances: Sequence[float] = TOLERANCES if dtype == "float32" else (0.0, DEFAULT)
        methods += [planned(compact, tolerance, dtype) for tolerance in tolerances]
        if dtype == "float32":
            methods.append(planned_transition(compact, DEFAULT))
        methods.append(full("compact", compact, dtype))
        if models.paper is not None:
            methods.append(full("paper", simulator(models, "paper", dtype), dtype))
        for name, network in (("pc", models.pc), ("dl", models.dl)):
            if network is not None:
                methods.append(baseline(name, network, dtype))
    return methods


def simulator(models: Models, preset: str, dtype: Dtype = "float32") -> CameraSimulator:
    """A simulator of its own, which keeps no results between calls.

    Args:
        models: Says which presets there are.
        preset: ``"compact"`` or ``"paper"``.
        dtype: Of its networks.
    """
    if models.cards.get(preset) is None:
        raise ValueError(f"`preset` (={preset!r}) must be one of {list(models.cards)}")
    weights = preset if preset == "compact" else FOLDER / preset / f"{preset}.safetensors"
    # No cache: a second run must not be a look-up of the first.
    return CameraSimulator.from_pretrained(weights, device="cpu", precision=dtype, cache=None)


# -- shared ---------------------------------------------------------------------------------------


class _Exposed:
    """The raw times the exposure ratio, and whatever noise it has."""

    def __init__(self, raw: RawImage) -> None:
        self._raw = raw

    def expose(
        self, states: Iterable[CameraSettings], *, seed: int = 0, out: Tensor | None = None
    ) -> Tensor:
        camera = self._raw.camera
        return torch.stack([clip_and_quantise(self.expected(s), camera) for s in states], out=out)

    def expected(self, settings: CameraSettings) -> Tensor:
        return self._raw.data * exposure_ratio(self._raw.settings, settings)


def exposure_only() -> Method:
    """Light times the exposure ratio, clipped and quantised."""
    return Method("exposure", prepare=_Exposed)


def with_noise() -> Method:
    """The same, and noise added up to the target's where the source has less."""
    bare = CameraSimulator(device="cpu")
    return Method("exposure+nlf", prepare=bare.prepare)


def with_non_local_means() -> Method:
    """Non-local means behind the Anscombe transform, once, then as a simulator without networks."""
    bare, denoise = CameraSimulator(device="cpu"), behind_anscombe(non_local_means)

    def prepare(raw: RawImage) -> Prepared:
        prepared = bare.prepare(raw)
        return replace(prepared, light=denoise(prepared), nlf=NoiseLevelFunction.zero())

    return Method("non-local means", prepare=prepare)


class _Banked:
    """A prepared scene whose sweeps read their noise from the bank of drawn normals."""

    def __init__(self, prepared: PreparedScene) -> None:
        self._prepared = prepared
        self.expected = prepared.expected

    def expose(
        self, states: Iterable[CameraSettings], *, seed: int = 0, out: Tensor | None = None
    ) -> Tensor:
        return self._prepared.expose(states, seed=seed, noise="bank", out=out)


def planned(
    own: CameraSimulator, tolerance: float, dtype: Dtype = "float32", *, bank: bool = False
) -> Method:
    """`own`, prepared once, leaving out what `tolerance` allows; it finds the defocus itself.

    Args:
        own: With networks.
        tolerance: In units of the target's noise.
        dtype: Of the networks.
        bank: Whether noise comes from the bank.
    """

    def prepare(raw: RawImage) -> Prepared:
        prepared = own.prepare(raw, depth="unknown", tolerance=tolerance)
        return _Banked(prepared) if bank else prepared

    name = f"compact {tolerance:g}{', bank' * bank}"
    return Method(name, dtype, tolerance, prepare=prepare)


# -- transitions ----------------------------------------------------------------------------------


def planned_transition(own: CameraSimulator, tolerance: float) -> Method:
    """One transition of `own` at a time, leaving out what `tolerance` allows."""

    def shoot(raw: RawImage, settings: CameraSettings, seed: int) -> Shot:
        out = own.simulate(raw, settings, seed=seed, depth="unknown", tolerance=tolerance)

        def expected() -> Tensor:
            return own.prepare(raw, depth="unknown", tolerance=tolerance).expected(settings)

        return Shot(out.data, expected)

    return Method(f"compact {tolerance:g}, one at a time", "float32", tolerance, shoot=shoot)


def full(preset: str, own: CameraSimulator, dtype: Dtype = "float32") -> Method:
    """Every module of `own` for every transition, as ``simulate(..., tolerance=None)``."""

    def shoot(raw: RawImage, settings: CameraSettings, seed: int) -> Shot:
        stages = own.stages(raw, settings, seed=seed)
        return Shot(stages.capture, lambda: stages.light)

    return Method(f"{preset} full", dtype, shoot=shoot)


def baseline(name: str, network: nn.Module, dtype: Dtype = "float32") -> Method:
    """A network that is told both settings, with the target's noise added to what it predicts."""

    @torch.no_grad()
    def shoot(raw: RawImage, settings: CameraSettings, seed: int) -> Shot:
        told = [v for s in (raw.settings, settings) for v in settings_parameters(s)]
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=dtype == "bfloat16"):
            light = network(raw.data[None], torch.tensor([told])).float()
        target = Exposure(1.0, NoiseLevelFunction.zero(), raw.camera.nlf(settings.iso))
        noise = FrameNoise(int(sweep_keys(seed, [settings])[0]))
        noisy, _ = add_noise(light, [target], [noise])
        return Shot(clip_and_quantise(noisy[0], raw.camera), lambda: light[0])

    return Method(name, dtype, shoot=shoot)
