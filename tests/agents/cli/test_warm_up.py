import gymnasium as gym
import pytest
from typer.testing import CliRunner

from agents.cli.main import app


def test_every_environment_that_is_warmed_up_can_be_made(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    make_vec = gym.make_vec

    def make_small(name: str, **arguments):
        made.append(name.rpartition("/")[2])
        return make_vec(name, **{**arguments, "scenes": "bundled:small", "resolution": 36})

    monkeypatch.setattr(gym, "make_vec", make_small)
    result = CliRunner().invoke(app, ["warm-up"], catch_exceptions=False)
    assert result.exit_code == 0
    assert {"AutoExposure-v0", "AutoExposureVideo-v0", "ExposureBracket-v0"} == set(made)
