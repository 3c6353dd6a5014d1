"""Scores of running episodes: what is worked out for them, and what is not."""

from __future__ import annotations

from typing import Any

import pytest

from ae_env import AutoExposureEnv
from ae_env.scorers.score_table import ScoreTables


@pytest.mark.parametrize("lighting", ["sine", "flicker"])
def test_expected_reward_of_a_closed_form_needs_no_table(
    lighting: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In changing light a table is 64 scores of which 63 are not asked for."""
    env = AutoExposureEnv(
        scenes="bundled:small", resolution=36, reward="expected", lighting=lighting
    )
    env.reset(seed=4)
    table, asked = ScoreTables.table, []

    def counted(*args: Any, **kwargs: Any) -> Any:
        asked.append(kwargs)
        return table(*args, **kwargs)

    monkeypatch.setattr(ScoreTables, "table", counted)
    for state in (3, 60, 21):
        reward = env.step(state)[1]
        assert asked == []
        assert reward == pytest.approx(env.expected_scores()[state], abs=1e-9)
        asked.clear()
