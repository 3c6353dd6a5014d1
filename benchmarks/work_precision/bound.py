"""What the plan predicts against what is measured: the distance between the plan and a full run.

The distance of two captures is that of their distributions, given the scene: per pixel the mean m
and the standard deviation s over source and target noise, as
``sqrt(mean((dm)^2 + (ds)^2) / s_target^2)``, the 2-Wasserstein distance of two normal distributions
in units of the target's noise. The scene is photographed several times; both runs get the same
photographs. The noise that is added last is known in closed form and not drawn. What the finite
number of photographs adds to a square is subtracted: from dm by the usual correction, from ds by
multiplying the differences of two halves of the photographs. Pixels that are white in the scene at
these settings count as equal.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.simulator.models import Models
from benchmarks.simulator.scenes import Progress
from benchmarks.work_precision.methods import TOLERANCES
from benchmarks.work_precision.trials import GRID, Trial, test_trials
from simulator import CameraSettings, CameraSimulator, RawImage
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import exposed_light
from simulator.noise.noise_level_function import noise_variance
from simulator.noise.top_up import top_up_variance

#: Photographs of each scene.
DRAWS = 8
#: States of each scene: fair ones, and others of the grid.
FAIR, ANY = 3, 1
#: Standard deviations are pooled over squares of this side [pixel].
_WINDOW = 9
#: Light from here on is white in every capture: what differs above cannot show.
WHITE = 1.0 - 1e-6
#: A measured distance counts as beyond the prediction from here on: rounding.
ROUNDING = 0.005


def measure(
    models: Models, *, seed: int, quick: bool, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """One row per scene, state and tolerance.

    Args:
        models: Of which ``compact`` is measured.
        seed: Of the photographs.
        quick: A few scenes.
        progress: Called with the scene and the share that is done.
    """
    own = models.compact
    rows: list[dict[str, Any]] = []
    chosen = test_trials(quick=quick)
    for number, trial in enumerate(chosen):
        if progress is not None:
            progress(trial.scene.scene_id, number / len(chosen))
        raws = [trial.raw(seed + 100 * number + i) for i in range(DRAWS)]
        prepared_scenes = {t: _prepared(own, raws, t) for t in TOLERANCES}
        for settings in _states(trial, number, quick):
            truth = trial.mean(settings)
            full = Draws.of_full(own, raws, settings)
            for tolerance in TOLERANCES:
                plan = prepared_scenes[tolerance][0].plan(settings)
                planned = Draws.of_plan(prepared_scenes[tolerance], settings)
                # White in both captures, whatever its light: no difference of theirs can show.
                shows = torch.where(truth < WHITE, noise_variance(truth, full.target), torch.inf)
                distance, error = planned.distance(full, shows)
                rows.append(
                    {
                        "part": "bound",
                        "scene": trial.scene.scene_id,
                        "kind": trial.scene.kind,
                        "source": str(trial.source),
                        "settings": str(settings),
                        "tolerance": tolerance,
                        "predicted_error": float(plan.predicted_error),
                        "predicted_difference": float(plan.predicted_difference),
                        "measured": distance,
                        "measured_square_error": error,
                        "violated": distance**2 - 2.0 * error
                        > (plan.predicted_difference + ROUNDING) ** 2,
                        "left_out": sorted(plan.left_out),
                        "modules": list(plan.modules),
                    }
                )
    return rows


def _prepared(
    own: CameraSimulator, raws: Sequence[RawImage], tolerance: float
) -> list[PreparedScene]:
    return [own.prepare(raw, depth="unknown", tolerance=tolerance) for raw in raws]


def _states(trial: Trial, number: int, quick: bool) -> list[CameraSettings]:
    """Fair states and, of the rest of the grid, others in turn."""
    own = trial.states(1 if quick else FAIR)
    rest = [s for s in GRID if s not in trial.states()]
    others = itertools.islice(itertools.cycle(rest), 7 * number, 7 * number + ANY)
    return [*own, *(others if rest else ())]


@dataclass(frozen=True, eq=False)
class Draws:
    """Captures of one scene at the same settings before their noise is drawn.

    Args:
        light: (K, 4, H, W) what each photograph became.
        added: (K, 4, H, W) variance of the noise that is added to it.
        target: Noise of the camera at these settings.
    """

    light: Tensor
    added: Tensor
    target: Any

    @classmethod
    def of_full(
        cls, own: CameraSimulator, raws: Sequence[RawImage], settings: CameraSettings
    ) -> Draws:
        """Of the run that leaves nothing out."""
        light = torch.stack([own.stages(raw, settings).light for raw in raws])
        target = raws[0].camera.nlf(settings.iso)
        return cls(light, noise_variance(light, target), target)

    @classmethod
    def of_plan(cls, prepared_scenes: Sequence[PreparedScene], settings: CameraSettings) -> Draws:
        """Of what is planned for each of the photographs."""
        light, added = [], []
        for prepared in prepared_scenes:
            exposure = prepared.exposure(settings)
            image = exposed_light(prepared.blurred_light.blurred(exposure), exposure)
            missing, _ = top_up_variance(
                image, exposure.source_noise, exposure.target, exposure.remaining_variance
            )
            light.append(image)
            added.append(missing)
        return cls(torch.stack(light), torch.stack(added), exposure.target)

    def deviation(self) -> Tensor:
        """(4, H, W) standard deviation of the capture, pooled over a neighbourhood."""
        variance = _variance(self.light.double()) + self.added.double().mean(dim=0)
        side = _WINDOW // 2
        padded = F.pad(variance[None], (side,) * 4, mode="reflect")
        return F.avg_pool2d(padded, _WINDOW, stride=1)[0].clamp(min=0.0).sqrt()

    def part(self, chosen: slice) -> Draws:
        """Of some of the photographs."""
        return Draws(self.light[chosen], self.added[chosen], self.target)

    def distance(self, other: Draws, variance: Tensor) -> tuple[float, float]:
        """Distance to `other`, of the same photographs, and the standard error of its square.

        Args:
            other: Another run.
            variance: (4, H, W) of the target's noise.
        """
        count = len(self.light)
        difference = self.light.double() - other.light.double()
        spread = _variance(difference) / variance
        means = difference.mean(dim=0).square() / variance - spread / count
        halves = slice(0, None, 2), slice(1, None, 2)
        first, second = (self.part(h).deviation() - other.part(h).deviation() for h in halves)
        square = float((means + first * second / variance).mean())
        pairs = count * (count - 1) / 2
        error = float((spread.square().mean() / (pairs * spread.numel())).sqrt())
        return max(0.0, square) ** 0.5, error


def _variance(draws: Tensor) -> Tensor:
    """Variance over the first dimension; torch's own takes twenty times as long there."""
    return (draws - draws.mean(dim=0)).square_().sum(dim=0) / (len(draws) - 1)
