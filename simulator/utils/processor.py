"""What the processor can do."""

from __future__ import annotations

import logging

import torch

logger = logging.getLogger(__name__)


def computes_bfloat16(device: torch.device) -> bool:
    """Whether networks in bfloat16 are worth it there: others emulate it, ten times as slow."""
    return device.type != "cpu" or bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


def check_bfloat16(device: torch.device) -> None:
    """Logs a warning where bfloat16 is emulated."""
    if not computes_bfloat16(device):
        logger.warning(
            "precision 'bfloat16': this processor emulates it, ten times as slow as 'float32'"
        )
