"""From the name of a preset to its untrained modules."""

from __future__ import annotations

from torch import nn

from simulator.modules.aperture import ApertureModule
from simulator.modules.baselines import DecoupledNet, ParameterConcatenation
from simulator.modules.exposure import ExposureModule
from simulator.modules.noise import NoiseModule

#: What can be trained: the two presets of the simulator, and the paper's two baselines.
PRESETS = ("compact", "paper", "pc", "dl")


def build_modules(preset: str) -> nn.ModuleDict:
    """The untrained modules of a preset, by stage."""
    if preset == "pc":
        return nn.ModuleDict({"baseline": ParameterConcatenation()})
    if preset == "dl":
        return nn.ModuleDict({"baseline": DecoupledNet()})
    return nn.ModuleDict(
        {
            "exposure": ExposureModule(),
            "noise": NoiseModule(preset),  # type: ignore[arg-type]
            "aperture": ApertureModule(preset),  # type: ignore[arg-type]
        }
    )
