import json
from pathlib import Path

from simulator.utils.files import sibling


def test_train_then_evaluate(ae_env, tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(
        "agent: regression\nnum_envs: 4\nenvironment: {scenes: 'bundled:small', resolution: 36}\n"
        "training: {frames: 24, width: 8}\n"
    )
    out = Path("runs/a-0.5")
    code, text, _ = ae_env("train", "tiny.yaml", "--out", out, "--seed", 2)
    assert code == 0
    assert f"next: ae-env evaluate --policy regression:{out}" in text
    card = json.loads(sibling(tmp_path / out, ".json").read_text())
    assert card["training"]["training"]["seed"] == 2
    code, _, _ = ae_env(
        *("evaluate", "--policy", f"regression:{out}", "--scenes", "bundled:small"),
        *("--resolution", 36, "--frames", 2, "--episodes", 1),
    )
    assert code == 0
