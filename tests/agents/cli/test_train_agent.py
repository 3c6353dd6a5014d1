import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from simulator.utils.files import sibling


def test_train_then_evaluate(ae_env, tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(
        "agent: regression\nnum_envs: 4\nenvironment: {scenes: 'bundled:small', resolution: 36}\n"
        "training: {frames: 24, width: 8}\n"
    )
    out = Path("runs/a-0.5")
    code, text, _ = ae_env("train", "tiny.yaml", "--out", out, "--seed", 2)
    assert code == 0
    (following,) = re.findall("next: ae-env (.*)", text)
    card = json.loads(sibling(tmp_path / out, ".json").read_text())
    assert card["training"]["training"]["seed"] == 2
    few = ("--scenes", "bundled:small", "--frames", 2, "--episodes", 1)
    code, text, _ = ae_env(*shlex.split(following), *few)
    assert code == 0
    assert f"regression:{out}" in text


@pytest.mark.parametrize(
    ("config", "options"),
    [
        (
            "agent: forecaster\ntraining: {steps: 2, width: 4, batch_size: 2, traces: 5}\n",
            ("--preset", "video", "--policy", "regression:video?foresight=a"),
        ),
    ],
)
def test_what_is_next_names_the_task(ae_env, tmp_path: Path, config: str, options: Any) -> None:
    (tmp_path / "tiny.yaml").write_text(config)
    code, text, _ = ae_env("train", "tiny.yaml", "--out", "a")
    assert code == 0
    (following,) = re.findall("next: ae-env (.*)", text)
    assert shlex.split(following) == ["evaluate", *options]
