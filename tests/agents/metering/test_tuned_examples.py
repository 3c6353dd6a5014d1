"""Tuned policies of `examples`: a meter of ten parameters, Shin's control, offline CQL."""

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


def test_parametric_meter_exposes_a_card_and_reads_statistics_alike(context, photograph, tmp_path):
    ev, file = context.grid.ev100, tmp_path / "found.json"
    frame = photograph(1.0, 10.0, [int(np.abs(ev - 11.0).argmin())])
    for stops in (0.0, 1.0, -1.0):
        own = Parameters(compensation=stops)
        file.write_text(json.dumps({"runs": {"a": {"parameters": vars(own)}}}))
        for given, more in (((str(file), "a"), {}), ((own,), frame_statistics(frame["raw"]))):
            meter = ParametricMeter(context, *given)
            meter.reset(1)
            assert abs(ev[meter.act(frame | more)[0]] - (10.0 - stops)) < 0.2


def test_a_score_from_tables_is_that_of_the_states_in_effect(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[3] / "examples")
    tune = importlib.import_module("tune_meter")
    table = {key: np.zeros((1, 2, 1)) for key in ("raw", "histogram", "clipped")}
    table |= {"scores": np.array([[0.2, 0.8]]), "allowed": np.ones((1, 2), np.bool_)}
    table |= {"starts": np.zeros((1, 3), int), "sensors": np.zeros((1, tune.FRAMES, 2))}
    table |= dict.fromkeys(("sets", "groups"), np.array(["a"]))
    second = SimpleNamespace(reset=lambda count: None, act=lambda seen, masks: np.ones(6, int))
    # State 1 is in effect at once, or, with two frames of delay, in all frames but two.
    expected = (0.8 - 0.5 * 2 * (0.8 - 0.2) / tune.FRAMES - 0.5) / (0.8 - 0.5)
    assert tune.Frames(table, np.zeros((2, 3))).score(second) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_simplex_asks_for_the_points_that_scipy_does(seed):
    simplex, asked, expected = 3.0 * np.random.default_rng(seed).normal(size=(3, 2)), [], []

    def value(x, points):
        points.append(np.array(x))
        return float(3.0 * (x[0] - 1.3) ** 2 + 2.0 * x[0] * x[1] + (x[1] + 0.7) ** 2)

    options, search = {"initial_simplex": simplex, "fatol": np.inf}, nelder_mead(simplex, 1e-4)
    minimize(value, simplex[0], expected, method="Nelder-Mead", options=options)
    with contextlib.suppress(StopIteration):
        point = next(search)
        while True:
            point = search.send(value(point, asked))
    np.testing.assert_allclose(asked, expected, atol=1e-9)


def test_shin_rests_on_a_state_and_searches_again_in_other_light(context, photograph):
    light = np.random.default_rng(0).lognormal(0.0, 1.0, (4, 8, 8)).repeat(8, 1).repeat(8, 2)
    policy, visited = ShinNelderMead(context), [0]
    policy.reset(1)
    for ev in [12.0] * 30 + [6.0] * 30:
        visited.append(int(policy.act(photograph(light, ev, visited[-1]))[0]))
    assert len(set(visited[25:31])) == len(set(visited[55:])) == 1
    fall = -np.diff(context.grid.ev100[[visited[30], visited[-1]]])[0]
    assert 3.0 < fall < 9.0  # the light falls by 6, and the grid has steps


def test_cql_runs_its_network_as_torch_does(context, photograph, tmp_path):
    seen, path = photograph(1.0, 10.0, np.arange(30)), tmp_path / "q.safetensors"
    network = nn.Sequential(nn.Linear(69, 8), nn.ReLU(), nn.Linear(8, len(context.grid)))
    save_file({f"layer{name}": v for name, v in network.state_dict().items()}, path)
    expected = network(torch.from_numpy(features(*seen.values()))).argmax(1).tolist()
    assert OfflineCQL(context, path).act(seen).tolist() == expected
