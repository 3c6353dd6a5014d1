import json
import os
import pickle
from pathlib import Path

import pytest
import torch

from simulator.networks.weights import load_modules
from tests.simulator.networks.released_modules import make_released, save_released


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "demo").mkdir()
    for name, module in make_released().items():
        save_released(tmp_path / "demo" / name, module)
    return tmp_path / "demo"


def test_files_in_the_released_layout_become_weights(ae_env, folder: Path, dng: Path) -> None:
    """What the command proposes next then runs."""
    code, out, error = ae_env("import-weights", "ncs", "demo", "-o", "theirs/ncs.safetensors")
    assert (code, error) == (0, "")
    assert "noise: 13,398,404 parameters of unet_model" in out
    assert "licence: none stated" in out
    assert "next: ae-env simulate RAW --weights theirs/ncs.safetensors" in out
    modules, card = load_modules(folder.parent / "theirs" / "ncs")
    assert float(modules["exposure"].w) == pytest.approx(0.97)
    assert card == json.loads((folder.parent / "theirs" / "ncs.json").read_text())
    assert card["preset"] == "ncs"
    assert card["source"].keys() == {"exposure", "noise", "aperture"}
    options = ("--iso", "100", "--shutter", "1/64", "--aperture", "4", "--no-cache")
    code, _, error = ae_env("simulate", dng, *options, "--weights", "theirs/ncs.safetensors")
    assert (code, error) == (0, "")


class Harmful:
    def __reduce__(self):
        return os.system, ("touch harmed",)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nsc", "demo"), "did you mean 'ncs'?"),
        (("ncs", "none"), "`folder` (='none') must be a folder"),
        (("ncs", "demo", "-o", "ncs.pth"), "must end in .safetensors"),
        (("ncs", "bad"), "bad/unet_model` names posix.system"),
        (("ncs", "old"), "old/exp_model` names posix.system"),
        (("ncs", "empty"), "must also hold exp_model (exposure)"),
    ],
)
def test_errors_write_nothing(ae_env, tmp_path: Path, arguments, message: str) -> None:
    (tmp_path / "demo").mkdir()
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad").mkdir()
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "exp_model").write_bytes(pickle.dumps(Harmful(), protocol=0))
    torch.save({"model": Harmful()}, tmp_path / "bad" / "unet_model")
    before = sorted(tmp_path.rglob("*"))
    code, _, error = ae_env("import-weights", *arguments)
    assert code == 2
    assert message in error
    assert error.strip().count("\n") == 0
    assert sorted(tmp_path.rglob("*")) == before
