"""From a trained agent to one ONNX file that `agents.onboard.controller.Controller` runs."""

import contextlib
import hashlib
import io
import json
import logging
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ae_env.observation import PEDESTAL, SENSOR_RANGES, SETTINGS_RANGES
from agents.learning.ppo import PPOPolicy
from agents.learning.regression import SAME_LIGHT_EV, RegressionPolicy
from agents.metering.reading import BLACK_SIGNAL, SATURATED_STEP_EV, TARGET_SIGNAL, WHITE_SIGNAL
from agents.onboard.controller import FORMAT, METADATA, NO_DIGEST
from agents.policy import Policy
from simulator.utils.checks import import_extra
from simulator.utils.files import write_atomically


class _RegressionGraph(nn.Module):
    """Scores, their precision, and the light that an average meter reads [EV100]."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network: Any = network

    def forward(
        self, raw: torch.Tensor, settings: torch.Tensor, sensors: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        codes = raw.float() / 255.0
        scores, log_variance = self.network(codes, settings, sensors)
        return scores, torch.exp(-log_variance), self._metered(codes, settings)

    def _metered(self, codes: torch.Tensor, settings: torch.Tensor) -> torch.Tensor:
        """`agents.metering`'s average meter."""
        signal = (1.0 + PEDESTAL) * codes[:, 1:3].square() - PEDESTAL
        saturated = (signal >= WHITE_SIGNAL).float().mean(dim=(1, 2, 3))
        level = (signal.mean(dim=(1, 2, 3)).clamp(min=BLACK_SIGNAL) / TARGET_SIGNAL).log2()
        low, high = self.network.features.ranges.unbind(dim=1)
        apex = low + (settings + 1.0) * 0.5 * (high - low)
        ev100 = (3.0 * apex[:, 0]).round() / 3.0 + apex[:, 1] - (apex[:, 2] - 5.0)
        return ev100 + level + SATURATED_STEP_EV * saturated


class _PPOGraph(nn.Module):
    """Logits of the states."""

    def __init__(self, network: Any) -> None:
        super().__init__()
        self.extractor = network.pi_features_extractor
        self.latent, self.logits = network.mlp_extractor, network.action_net

    def forward(
        self, raw: torch.Tensor, settings: torch.Tensor, sensors: torch.Tensor | None = None
    ) -> torch.Tensor:
        shown = {"raw": raw.float() / 255.0, "settings": settings}
        if sensors is not None:
            shown["sensors"] = sensors
        return self.logits(self.latent.forward_actor(self.extractor(shown)))


def export_agent(policy: Policy, path: str | Path) -> Path:
    """Writes an agent as one ONNX file: the observation goes in as it is, for any batch.

    A `ValueError` unless it is a `RegressionPolicy` without foresight or a `PPOPolicy` without a
    history, and looks at pixels; an `ImportError` without the extra ``onnx``.
    """
    file = Path(path)
    if file.suffix != ".onnx":
        raise ValueError(f"`out` (={str(path)!r}) must end in .onnx")
    graph = _graph(policy)
    import_extra("onnxscript", "onnx", "the export")  # by torch's exporter
    onnx = import_extra("onnx", "onnx", "the export")
    context = policy.context
    shape = context.observation_space["raw"].shape or ()
    arguments = {"raw": torch.zeros(2, *shape, dtype=torch.uint8), "settings": torch.zeros(2, 3)}
    if context.has_sensors:
        arguments["sensors"] = torch.zeros(2, 2)
    ppo = isinstance(policy, PPOPolicy)
    outputs = ["logits"] if ppo else ["scores", "precision", "ev100"]
    model = _exported(graph.eval(), arguments, outputs).model_proto
    card = {
        "format": FORMAT,
        "kind": "ppo" if ppo else "regression",
        "states": [[s.iso, s.exposure_time, s.f_number] for s in context.grid],
        "frame_shape": list(shape),
        "sensors": context.has_sensors,
        "same_light_ev": SAME_LIGHT_EV,
        "hysteresis": (PPOPolicy if ppo else RegressionPolicy).hysteresis,
        "pedestal": PEDESTAL,
        "ranges": {"settings": SETTINGS_RANGES.tolist(), "sensors": SENSOR_RANGES.tolist()},
        "sha256": NO_DIGEST,
    }
    onnx.helper.set_model_props(model, {METADATA: json.dumps(card)})
    onnx.checker.check_model(model, full_check=True)
    content = model.SerializeToString()
    digest = hashlib.sha256(content).hexdigest()
    return write_atomically(file, content.replace(NO_DIGEST.encode(), digest.encode()))


def _graph(policy: Policy) -> nn.Module:
    if "histogram" in policy.context.observation_space.spaces:
        rule = "must observe pixels, not statistics"
    elif isinstance(policy, RegressionPolicy):
        if policy.foresight == "none":
            return _RegressionGraph(policy.network)
        rule = "must be without `foresight`, which is no part of the network"
    elif isinstance(policy, PPOPolicy):
        if not policy.network.features_extractor.features.history:
            return _PPOGraph(policy.network)
        rule = "must be without a history, which is not exported"
    else:
        rule = "must be a regression or a PPO agent"
    raise ValueError(f"`policy` (={policy.name!r}) {rule}")


def _exported(graph: nn.Module, arguments: dict[str, torch.Tensor], outputs: list[str]) -> Any:
    """The program, for any batch; the exporter's own output says nothing to a user."""
    batch = torch.export.Dim("batch", min=1)
    quiet = logging.getLogger("torch.onnx")
    level = quiet.level
    quiet.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            return torch.onnx.export(
                graph,
                tuple(arguments.values()),
                input_names=list(arguments),
                output_names=outputs,
                dynamic_shapes=tuple({0: batch} for _ in arguments),
                dynamo=True,
                verbose=False,
            )
    finally:
        quiet.setLevel(level)
