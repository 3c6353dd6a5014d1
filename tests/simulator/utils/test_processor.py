import logging

import pytest
import torch

from simulator import CameraSimulator
from simulator.utils.compute import computes_bfloat16


def test_emulated_bfloat16_is_said(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    known = "simulator.utils.compute.computes_bfloat16"
    for computed in (True, False):
        monkeypatch.setattr(known, lambda device, computed=computed: computed)
        with caplog.at_level(logging.WARNING):
            CameraSimulator(device="cpu", precision="bfloat16")
        assert ("ten times as slow" in caplog.text) is not computed
    assert computes_bfloat16(torch.device("cuda"))
