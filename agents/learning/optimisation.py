"""The optimiser steps of a supervised training, and its checkpoint."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from torch import nn

from simulator.utils.checkpoint import Checkpoint


class Optimisation:
    """AdamW with a one-cycle schedule; a training that was interrupted goes on where it was.

    Args:
        network: What is trained.
        steps: Optimiser steps in all.
        learning_rate: Peak of the schedule.
        weight_decay: Of AdamW.
        checkpoint: File for the state of the training; None for none.
        identity: JSON value; the checkpoint of a training with another one is not resumed.
        warm_up: Share of the steps in which the learning rate rises.

    Attributes:
        done: Steps so far.
        store: The checkpoint, a context manager.
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        steps: int,
        learning_rate: float,
        weight_decay: float,
        checkpoint: Path | None,
        identity: Any,
        warm_up: float = 0.3,
    ) -> None:
        self.network, self.done = network, 0
        self.optimizer = torch.optim.AdamW(
            network.parameters(), lr=learning_rate, weight_decay=weight_decay
        )
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(
            self.optimizer, max_lr=learning_rate, total_steps=steps + 1, pct_start=warm_up
        )
        self._parts: dict[str, Any] = {
            "network": network,
            "optimizer": self.optimizer,
            "schedule": self.schedule,
        }
        self.store = Checkpoint(checkpoint, identity, self._state)
        past = self.store.load()
        if past is not None:
            self.done = int(past["step"])
            for name, part in self._parts.items():
                part.load_state_dict(past[name])

    def _state(self) -> dict[str, Any]:
        states = {name: part.state_dict() for name, part in self._parts.items()}
        return {"step": self.done, **states}

    def step(self, loss: torch.Tensor) -> None:
        """One step down `loss`.

        Raises:
            ValueError: If it is not finite.
        """
        if not math.isfinite(loss.item()):
            raise ValueError(f"the loss (={loss.item()}) must be finite; lower `learning_rate`")
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        self.schedule.step()
        self.done += 1
