"""The tuned policies of `examples`: a meter of ten parameters, Shin's control, offline CQL."""

import contextlib
import importlib
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.optimize import minimize
from torch import nn

from ae_env.observation import frame_statistics
from examples.offline_cql import OfflineCQL, features
from examples.parametric_meter import Parameters, ParametricMeter
from examples.shin_nelder_mead import ShinNelderMead, nelder_mead

ROOT = Path(__file__).resolve().parents[3]


def test_parametric_meter_exposes_a_card_and_reads_statistics_alike(context, photograph, tmp_path):
    ev, file = context.grid.ev100, tmp_path / "found.json"
    frame = photograph(1.0, 10.0, [int(np.abs(ev - 11.0).argmin())])
    for stops in (0.0, 1.0, -1.0):
        own = Parameters(compensation=stops)
        np.testing.assert_allclose(Parameters.from_unit(own.to_unit()).to_unit(), own.to_unit())
        file.write_text(json.dumps({"runs": {"a": {"parameters": vars(own)}}}))
        for seen in (frame, frame | frame_statistics(frame["raw"])):
            for given in ({"parameters": own}, {"parameters": str(file), "run": "a"}):
                meter = ParametricMeter(context, **given)
                meter.reset(1)
                assert abs(ev[meter.act(seen)[0]] - (10.0 - stops)) < 0.2
    with pytest.raises(ValueError, match="`share`"):
        Parameters(share=1.5)


def test_a_score_from_tables_is_that_of_the_states_in_effect(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    tune = importlib.import_module("tune_meter")
    table = {key: np.zeros((1, 2, 1)) for key in ("raw", "histogram", "clipped")}
    table |= {"scores": np.array([[0.2, 0.8]]), "allowed": np.ones((1, 2), np.bool_)}
    table |= {"starts": np.zeros((1, 3), int), "sensors": np.zeros((1, tune.FRAMES, 2))}
    table |= {"sets": np.array(["a"]), "groups": np.array(["g"])}
    second = SimpleNamespace(reset=lambda count: None, act=lambda seen, masks: np.ones(6, int))
    # State 1 is in effect at once, or, with two frames of delay, in all frames but two.
    late = (0.2 * 2 + 0.8 * (tune.FRAMES - 2)) / tune.FRAMES
    expected = (0.5 * (0.8 + late) - 0.5) / (0.8 - 0.5)
    assert tune.Frames(table, np.zeros((2, 3))).score(second) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_simplex_asks_for_the_points_that_scipy_does(seed):
    simplex, asked, expected = 3.0 * np.random.default_rng(seed).normal(size=(3, 2)), [], []

    def value(x, points):
        points.append(np.array(x))
        return float(3.0 * (x[0] - 1.3) ** 2 + 2.0 * x[0] * x[1] + (x[1] + 0.7) ** 2)

    options = {"initial_simplex": simplex, "xatol": 1e-4, "fatol": np.inf}
    minimize(value, simplex[0], expected, method="Nelder-Mead", options=options)
    search = nelder_mead(simplex, 1e-4)
    point = next(search)
    with contextlib.suppress(StopIteration):
        while True:
            point = search.send(value(point, asked))
    np.testing.assert_allclose(asked, expected, atol=1e-9)


def test_shin_rests_on_a_state_and_searches_again_in_other_light(context, photograph):
    light = np.random.default_rng(0).lognormal(0.0, 1.0, (4, 8, 8)).repeat(8, 1).repeat(8, 2)
    policy, visited = ShinNelderMead(context), [0]
    policy.reset(1)
    for frame in range(60):
        seen = photograph(light, 12.0 if frame < 30 else 6.0, visited[-1])
        visited.append(int(policy.act(seen)[0]))
    assert len(set(visited[25:31])) == len(set(visited[55:])) == 1
    # As much as the light, but for the steps of the grid.
    assert 3.0 < context.grid.ev100[visited[30]] - context.grid.ev100[visited[-1]] < 9.0


def test_cql_runs_its_network_as_torch_does(context, photograph, tmp_path):
    seen, path = photograph(1.0, 10.0, np.arange(30)), tmp_path / "q.safetensors"
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(69, 8), nn.ReLU(), nn.Linear(8, len(context.grid)))
    own = {"0": "_encoder._layers.0", "2": "_fc"}
    save_file({own[n[0]] + n[1:]: v for n, v in network.state_dict().items()}, path)
    inputs = torch.from_numpy(features(*seen.values()))
    zones = torch.from_numpy(seen["raw"] / 255.0).unfold(2, 16, 16).unfold(3, 16, 16).mean((4, 5))
    np.testing.assert_allclose(inputs[:, :64], zones.flatten(1), atol=1e-6)
    assert OfflineCQL(context, path).act(seen).tolist() == network(inputs).argmax(1).tolist()
