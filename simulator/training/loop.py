"""One stage of a training: steps, schedule, checkpoints, logs. Accelerate does the plumbing."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from simulator.training.config import StageConfig
from simulator.training.data import ReferencePairs
from simulator.utils.checkpoint import Checkpoint, HasState

if TYPE_CHECKING:
    from accelerate import Accelerator

#: Called with the share of the stage that is done, in [0, 1], and the latest values.
StageProgress = Callable[[float, dict[str, float]], None]
#: Share of the budget in which the learning rate rises.
_RISE = 0.05
#: Largest norm of a gradient.
_GRADIENT_NORM = 1.0
#: Steps between two log entries, and the memory of the running means that are logged.
_LOG_EVERY, _SMOOTHING = 20, 0.98


@dataclass
class Clock:
    """How much of a stage's budget is used up; survives a restart.

    Args:
        stage: The budget.
        on_cpu: Whether minutes are processor minutes of this process or wall-clock minutes.
    """

    stage: StageConfig
    on_cpu: bool
    step: int = 0
    seconds: float = 0.0
    _started: float = 0.0

    def start(self) -> None:
        """Begins to count time."""
        self._started = self._now() - self.seconds

    def tick(self) -> None:
        """Counts a step."""
        self.step += 1
        self.seconds = self._now() - self._started

    @property
    def share(self) -> float:
        """Share of the budget that is used, in [0, 1]."""
        if self.stage.steps is not None:
            return min(self.step / self.stage.steps, 1.0)
        assert self.stage.minutes is not None
        return min(self.seconds / (60.0 * self.stage.minutes), 1.0)

    def _now(self) -> float:
        return time.process_time() if self.on_cpu else time.monotonic()

    def state_dict(self) -> dict[str, Any]:
        """Steps and seconds so far."""
        return {"step": self.step, "seconds": self.seconds}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from where another clock was."""
        self.step, self.seconds = int(state["step"]), float(state["seconds"])


def learning_rate(share: float, peak: float) -> float:
    """One cycle: rises linearly over the first 5 % of the budget, falls to 0 as a cosine.

    >>> learning_rate(0.05, 1.0), round(learning_rate(0.525, 1.0), 3), learning_rate(1.0, 1.0)
    (1.0, 0.5, 0.0)
    """
    if share < _RISE:
        return peak * max(share / _RISE, 1e-3)
    return peak * 0.5 * (1.0 + math.cos(math.pi * (share - _RISE) / (1.0 - _RISE)))


def train_stage(
    name: str,
    loss: nn.Module,
    trained: nn.Module,
    pairs: ReferencePairs,
    stage: StageConfig,
    accelerator: Accelerator,
    *,
    checkpoint: Path,
    identity: Any,
    progress: StageProgress | None = None,
) -> Clock:
    """Trains `trained` until the stage's budget is used up.

    A stage that was interrupted at any moment goes on at its last checkpoint, at most 20 s back,
    and, where its budget is in steps, ends with the weights of one that was not.

    Args:
        name: Of the stage, for log and checkpoint.
        loss: Maps a `Batch` to a mapping with ``"loss"``; holds `trained`.
        trained: The module whose parameters change.
        pairs: Where the batches come from.
        stage: Budget, batch, crop and learning rate.
        accelerator: Devices, precision, processes.
        checkpoint: File of the state.
        identity: JSON value; a checkpoint of another training is not taken over.
        progress: Called every few steps.

    Returns:
        Steps and seconds that were used.
    """
    device = accelerator.device
    loss.requires_grad_(False)
    trained.requires_grad_(True)
    loss.to(device=device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimiser = torch.optim.Adam(trained.parameters(), lr=stage.learning_rate)
    clock = Clock(stage, on_cpu=device.type == "cpu")
    parts: dict[str, HasState] = {"module": trained, "optimiser": optimiser, "clock": clock}
    if accelerator.scaler is not None:  # float16: what the loss is multiplied by
        parts["scaler"] = accelerator.scaler
    state = Checkpoint(checkpoint, parts, identity=[name, identity])
    state.restore()
    wrapped, stepper = accelerator.prepare(loss, optimiser)
    means: dict[str, float] = {}
    clock.start()
    whole = True  # no step is half done
    try:
        while clock.share < 1.0:
            optimiser.param_groups[0]["lr"] = learning_rate(clock.share, stage.learning_rate)
            rank = accelerator.process_index
            batch = pairs.batch(clock.step, stage.batch, stage.crop, process=rank)
            values = wrapped(batch.to(device))
            _follow(means, values, name)
            accelerator.backward(values["loss"])
            accelerator.clip_grad_norm_(trained.parameters(), _GRADIENT_NORM)
            whole = False
            stepper.step()
            clock.tick()
            _agree(clock, accelerator)
            whole = True
            stepper.zero_grad()
            if clock.step % _LOG_EVERY == 0 or clock.share >= 1.0:
                accelerator.log({f"{name}/{k}": v for k, v in means.items()}, step=clock.step)
                if progress is not None:
                    progress(clock.share, means)
            if accelerator.is_main_process:
                state.save(clock.step)
    finally:  # also after Ctrl-C
        if whole and accelerator.is_main_process:
            state.save(clock.step, force=True)
    return clock


def _agree(clock: Clock, accelerator: Accelerator) -> None:
    """Sets every process's clock by the main one's: they must stop after the same step, as each
    step waits for all of them."""
    if accelerator.num_processes > 1:
        from accelerate.utils import broadcast

        seconds = torch.tensor(clock.seconds, dtype=torch.float32, device=accelerator.device)
        clock.seconds = float(broadcast(seconds))


def _follow(means: dict[str, float], values: dict[str, torch.Tensor], name: str) -> None:
    """Running means of what a step gave.

    Raises:
        ValueError: If the loss is not finite: the state on disk is then the last good one.
    """
    for key, value in values.items():
        number = float(value.detach())
        if key == "loss" and not math.isfinite(number):
            raise ValueError(
                f"stage {name!r}: the loss (={number}) must be finite; lower `learning_rate`"
            )
        if math.isfinite(number):
            means[key] = _SMOOTHING * means.get(key, number) + (1.0 - _SMOOTHING) * number
