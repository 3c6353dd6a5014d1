"""What the learnt policies share: a network from memory or from a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from torch import nn

from ae_env.grid import ExposureGrid
from agents.learning.agent_weights import check_context, load_agent, load_into, trained_grid
from agents.policy import Policy, PolicyContext


class NetworkPolicy(Policy):
    """Base of the policies that a trained network decides.

    Args:
        context: The camera, the grid and the observation.
        weights: File that a training wrote; or give `network`.
        network: A network in memory.
        device: Torch device for `weights`.

    Raises:
        ValueError: If the weights were trained for another observation, or for a grid whose ranges
            the context's leaves, or not exactly one of `weights` and `network` is given.
    """

    #: What `agents.learning.agent_weights` calls this sort of agent.
    kind: ClassVar[str]

    def __init__(
        self,
        context: PolicyContext,
        weights: str | Path | None = None,
        network: nn.Module | None = None,
        device: str = "cpu",
    ) -> None:
        super().__init__(context)
        self.name = self.kind
        if (weights is None) == (network is None):
            raise ValueError("give either `weights` or `network`")
        if network is None:
            tensors, card = load_agent(str(weights), self.kind)
            check_context(card, context)
            network = self.make_network(context, card["width"], trained_grid(card))
            load_into(network, tensors, str(weights))
            network.to(device)
        self.network: Any = network.eval()
        self.reset(0)

    @staticmethod
    def make_network(
        context: PolicyContext, width: int, trained_on: ExposureGrid | None = None
    ) -> nn.Module:
        """The untrained network that the weights of an agent of this kind fit.

        Args:
            context: What the agent decides for.
            width: Hidden features.
            trained_on: Grid that the weights come from; by default that of the context.
        """
        raise NotImplementedError("a learnt policy must implement `make_network`")
