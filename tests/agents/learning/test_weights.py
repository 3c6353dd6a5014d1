import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch
from safetensors.torch import load_file

from ae_env.grid import ExposureGrid
from agents.learning import weights as agent_weights
from agents.learning.regression import RegressionPolicy, ScoreRegressor
from agents.policy import PolicyContext
from agents.policy_names import make_policy
from simulator.utils.files import sibling


def make_network(context: PolicyContext) -> ScoreRegressor:
    torch.manual_seed(0)
    return ScoreRegressor(context.observation_space, context.grid, width=8)


@pytest.fixture
def agent(context: PolicyContext, tmp_path: Path) -> Path:
    path = tmp_path / "regression-0.5"
    training = {"agent": "regression"}
    agent_weights.save_agent(path, "regression", make_network(context), 8, context, training)
    return path


def test_round_trip(agent: Path, context: PolicyContext) -> None:
    files = {path.name for path in agent.parent.iterdir()}
    assert files == {"regression-0.5.json", "regression-0.5.safetensors"}
    tensors, card = agent_weights.load_agent(agent, "regression")
    expected = {"width": 8, "training": {"agent": "regression"}}
    assert card | expected | {"context": agent_weights.describe_context(context)} == card
    network, on_disk = make_network(context), load_file(sibling(agent, ".safetensors"))
    for parameter in network.parameters():
        parameter.data.zero_()
    agent_weights.load_into(network, tensors, agent)
    assert all(torch.equal(value, on_disk[name]) for name, value in network.state_dict().items())
    next(network.parameters()).data.fill_(float("nan"))
    with pytest.raises(ValueError, match="must be finite"):
        agent_weights.save_agent(agent, "regression", network, 8, context, {})
    assert load_file(sibling(agent, ".safetensors")).keys() == on_disk.keys()


@pytest.mark.parametrize(
    ("suffix", "content", "message"),
    [
        (".json", None, "there is no regression-0.5.json"),
        (".safetensors", None, "there is no regression-0.5.safetensors"),
        (".safetensors", b"", "the hash of regression-0.5.safetensors"),
        (".json", b"{", "regression-0.5.json is damaged"),
        (".json", b'{"kind": "regression", "format": 1}', "width: Field required; context: Field"),
        (".json", b'{"kind": "regression", "format": 2}', "of format 2"),
        (".json", {"aliases": 3}, r"aliases \(=3\): must be a mapping"),
        (".json", {"width": True}, r"width \(=True\)"),
        (".json", {"width": 10**9}, r"width \(=1000000000\)"),
        (".json", {"width": 9}, r"do not fit the network: [^\n]*weight[^\n]*\Z"),
        (".json", {"sha256": 7}, r"the hash of .* \(=7\.\.\.\)"),
        (".json", {"context": {"observation": "uint8", "resolution": [4]}}, "resolution = "),
        (".json", {"kind": "ppo"}, "must be a regression agent of format 1, got 'ppo'"),
    ],
)
def test_damaged_and_wrong_files(
    agent: Path, context: PolicyContext, suffix: str, content: Any, message: str
) -> None:
    file = sibling(agent, suffix)
    if isinstance(content, dict):
        card = json.loads(file.read_text())
        del card["sha256"]  # a card of an earlier version, which is fine
        file.write_text(json.dumps(card))
        assert make_policy(f"regression:{agent}", context).name == "regression"
        content = json.dumps(card | content).encode()
    file.unlink()
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(FileNotFoundError if content is None else ValueError, match=message):
        make_policy(f"regression:{agent}", context)


def test_another_grid_or_observation_than_the_trained(agent: Path, context: PolicyContext) -> None:
    inside = {"isos": (100, 200), "exposure_times": (0.01, 0.1), "f_numbers": (4.0, 8.0)}
    space = gym.spaces.Dict({n: context.observation_space[n] for n in ("raw", "settings")})
    for changes, message in (
        ({"isos": (50, 200)}, "isos from 100 to 6400, the environment has 50 to 200"),
        ({"exposure_times": (0.01, 1.0)}, "exposure_times from 0.001 to 0.5.* has 0.01 to 1"),
        ({"f_numbers": (4.0, 16.0)}, "f_numbers from 4 to 11.* has 4 to 16"),
        (None, "sensors = True, the environment has False"),
    ):
        other = (
            {"grid": ExposureGrid(**inside | changes)} if changes else {"observation_space": space}
        )
        with pytest.raises(ValueError, match=message):
            make_policy(f"regression:{agent}", replace(context, **other))
    with pytest.raises(ValueError, match="either `weights` or `network`"):
        RegressionPolicy(context)


@pytest.mark.parametrize("name", ["regression", "ppo"])
def test_a_finer_grid_gives_known_states_their_values(name: str, context: PolicyContext) -> None:
    """The states' scale is that of the training: it is not worked out anew from the grid."""
    coarse = context.grid
    isos, times = {*coarse.isos, 200.0, 3200.0}, {*coarse.exposure_times, 1 / 30}
    finer = ExposureGrid(tuple(sorted(isos)), tuple(sorted(times)), coarse.f_numbers[:3])
    raw, settings, sensors = torch.rand(2, 4, 64, 64), torch.rand(2, 3), torch.rand(2, 2)
    frame = {"raw": raw, "settings": settings * 2 - 1, "sensors": sensors * 2 - 1}
    values = []
    for grid in (coarse, finer):
        network = make_policy(name, replace(context, grid=grid)).network
        with torch.inference_mode():
            if name == "ppo":
                codes = {**frame, "raw": frame["raw"] * 255}
                values.append(network.get_distribution(codes).distribution.logits)
            else:
                values.append(network(*frame.values())[0])
    pairs = [(i, finer.states.index(s)) for i, s in enumerate(coarse) if s.f_number < 11]
    first, second = (list(index) for index in zip(*pairs, strict=True))
    known, found = values[0][:, first], values[1][:, second]
    if name == "ppo":  # logits are known up to their norm
        known, found = known - known[:, :1], found - found[:, :1]
    torch.testing.assert_close(found, known, rtol=1e-5, atol=1e-5)
