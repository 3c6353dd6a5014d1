"""docs/own-scorer.md: what it prints works as it is printed."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

import gymnasium as gym
import pytest
import torch
import yaml

from ae_env.scorers import make_scorer
from ae_env.scorers.registry import describe_scorers
from agents.learning.training import AgentConfig

PAGE = (Path(__file__).parents[2] / "docs" / "own-scorer.md").read_text(encoding="utf-8")
SMALL = {"scenes": "bundled:snow", "resolution": 36}


def _blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


SCORER, USE = _blocks("python")
(YAML,) = _blocks("yaml")
(TOML,) = _blocks("toml")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with the page's file in it."""
    (tmp_path / "my_scorer.py").write_text(SCORER)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_scorer_has_ten_lines() -> None:
    lines = [line for line in SCORER.splitlines() if line and not line.startswith("#")]
    assert len(lines) <= 10


@pytest.mark.usefixtures("folder")
def test_the_file_computes_what_it_says() -> None:
    pictures = torch.zeros(2, 3, 40, 40)
    pictures[0, :, 10:30, 10:20] = 0.8  # half of the middle: standard deviation 0.4
    pictures[1, :, :10] = 1.0  # outside of the middle
    scorer = make_scorer("my_scorer.py:CentreContrast").parts["CentreContrast"]
    scores = scorer(pictures, None)  # type: ignore[arg-type]
    torch.testing.assert_close(scores, torch.tensor([0.8, 0.0]), atol=1e-3, rtol=0.0)


def test_the_use_of_it_works(folder: Path, capsys: pytest.CaptureFixture) -> None:
    assert "resolution=64" in USE
    small = USE.replace("resolution=64", 'resolution=36, scenes="bundled:snow"')
    exec(compile(small, "docs/own-scorer.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "CentreContrast" in printed
    assert "noise" in printed


@pytest.mark.usefixtures("folder")
def test_the_yaml_is_a_training() -> None:
    config = AgentConfig.model_validate(yaml.safe_load(YAML))
    assert config.environment["scorer"] == {"my_scorer.py:CentreContrast": 0.5, "noise": 0.5}
    with pytest.raises(ValueError, match=r"there is no file 'your_scorer\.py'"):
        AgentConfig.model_validate(yaml.safe_load(YAML.replace("my_", "your_")))


def test_the_package_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its metadata as pip would write it from the page's pyproject.toml."""
    project = tomllib.loads(TOML)
    (module,) = project["tool"]["setuptools"]["py-modules"]
    (tmp_path / f"{module}.py").write_text(SCORER)
    name, version = project["project"]["name"], project["project"]["version"]
    info = tmp_path / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    groups = project["project"]["entry-points"]
    lines = [f"[{g}]\n" + "\n".join(f"{k} = {v}" for k, v in groups[g].items()) for g in groups]
    (info / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    row = next(row for row in describe_scorers() if row.name == "centre_contrast")
    assert (row.package, row.domain, row.error) == ("my-scores", "srgb", "")
    assert row.summary.startswith("Contrast of the middle")
    env = gym.make("ae_env:ae_env/AutoExposure-v0", scorer="centre_contrast", **SMALL)
    env.reset(seed=0)
    assert 0.0 <= env.step(env.action_space.sample())[1] <= 1.0
    sys.modules.pop(module, None)


def test_the_command_takes_it(ae_env, folder: Path) -> None:
    """As the page prints it, on few and small scenes."""
    (command,) = re.findall(r"`(ae-env evaluate .*?)`", PAGE)
    assert command.endswith("--scorer my_scorer.py:CentreContrast")
    small = "--scenes bundled:snow --resolution 36 --frames 2 --episodes 1 --workers 1 --out out"
    code, _, err = ae_env(*command.split()[1:], *small.split())
    assert code == 0, err
    assert (folder / "out" / "results.json").is_file()
