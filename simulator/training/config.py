"""Configuration of a training of the simulator's modules."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from simulator.camera import get_camera
from simulator.utils.config_file import Configuration, load_yaml

_STAGES = ("noise", "exposure", "aperture", "baseline")
#: Stages of the presets that are not whole simulators.
_STAGES_OF = {"nano": ("noise",), "large": ("noise",), "pc": ("baseline",), "dl": ("baseline",)}


class StageConfig(Configuration):
    """One stage of the training.

    Args:
        steps: Optimiser steps; the whole budget, unless `minutes` is given.
        minutes: Budget in time instead of in steps: processor minutes of the training process on a
            CPU, so that other work on the machine does not count; wall-clock minutes on a GPU.
        batch: Pairs per step and process.
        crop: Height and width of the crops [packed pixel].
        learning_rate: Peak of a one-cycle schedule (rise over 5 %, cosine fall to 0).
        average: Decay of the running average of the weights that is kept in the end; 0 keeps the
            last ones.
    """

    steps: int | None = Field(default=None, ge=1, le=10_000_000)
    minutes: float | None = Field(default=None, gt=0, le=100_000)
    batch: int = Field(default=8, ge=1, le=4096)
    crop: int = Field(default=64, ge=16, le=4096)
    learning_rate: float = Field(default=1e-3, gt=0, le=1.0)
    average: float = Field(default=0.0, ge=0, lt=1)

    @model_validator(mode="after")
    def _one_budget(self) -> StageConfig:
        if (self.steps is None) == (self.minutes is None):
            raise ValueError("exactly one of `steps` and `minutes` must be given")
        return self


class SceneConfig(Configuration):
    """Scenes that the reference camera photographs.

    Args:
        procedural: Procedural scenes in the training split; three quarters of them have depth.
        size: Height and width of a scene [packed pixel].
        radiance: Folder of radiance maps, searched with its subfolders; null leaves them out.
    """

    procedural: int = Field(default=240, ge=1, le=100_000)
    size: int = Field(default=256, ge=32, le=4096)
    radiance: str | None = None


class SimulatorConfig(Configuration):
    """A training of the three modules, or of a baseline.

    Args:
        preset: ``"compact"`` or ``"paper"``; ``"nano"`` and ``"large"`` are noise modules alone;
            ``"pc"`` (parameter concatenation) and ``"dl"`` (decoupled learning) are the paper's
            baselines, one network trained in one stage.
        camera: Built-in camera that records the sequences. The noise stage adds the noise of every
            built-in camera.
        body: Seed of the hidden error of its body.
        seed: Seed of everything that is random.
        start: Weights of the same preset that the training goes on from: a name that comes with the
            package or a file; by default it begins with random ones.
        precision: Of the networks; weights, optimiser and losses stay float32.
        scenes: Scenes of the sequences.
        exposure, noise, aperture: The three stages of a simulator.
        baseline: The stage of ``"pc"`` and ``"dl"``.
    """

    preset: Literal["nano", "compact", "large", "paper", "pc", "dl"]
    camera: str = "nikon_z6"
    body: int = Field(default=1, ge=0)
    seed: int = Field(default=0, ge=0)
    start: str | None = None
    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    scenes: SceneConfig = SceneConfig()
    exposure: StageConfig | None = None
    noise: StageConfig | None = None
    aperture: StageConfig | None = None
    baseline: StageConfig | None = None

    @model_validator(mode="after")
    def _check(self) -> SimulatorConfig:
        get_camera(self.camera)
        stages = _STAGES_OF.get(self.preset, ("exposure", "noise", "aperture"))
        for name in _STAGES:
            wanted = name in stages
            if wanted != (getattr(self, name) is not None):
                rule = "must be given" if wanted else "must be left out"
                raise ValueError(f"`{name}` {rule} for preset {self.preset!r}")
        for name, stage in self.stages().items():
            if name != "noise" and stage.crop > self.scenes.size:
                raise ValueError(
                    f"`{name}.crop` (={stage.crop}) must not exceed `scenes.size` "
                    f"(={self.scenes.size})"
                )
        return self

    def stages(self) -> dict[str, StageConfig]:
        """The stages by name, in order."""
        return {name: getattr(self, name) for name in _STAGES if getattr(self, name) is not None}

    def card(self, last_stage: str | None = None) -> dict[str, Any]:
        """JSON values that identify the training, without the stages after `last_stage`.

        The noise stage has pictures of its own: nothing but its budget and the seed changes it.
        """
        values = self.model_dump(mode="json", exclude_none=True)
        if last_stage == "noise":
            names = ("preset", "seed", "start", "precision", "noise")
            return {name: values[name] for name in names if name in values}
        stages = list(self.stages())
        later = [] if last_stage is None else stages[stages.index(last_stage) + 1 :]
        return {name: value for name, value in values.items() if name not in later}


def load_config(path: str | Path) -> SimulatorConfig:
    """The configuration in a YAML file; see `simulator.utils.config_file.load_yaml`."""
    return load_yaml(path, SimulatorConfig)
