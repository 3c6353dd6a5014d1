"""From names to modules."""

from __future__ import annotations

import pytest

from simulator.networks.paper_baselines import DecoupledNet, ParameterConcatenation
from simulator.networks.weights import PRESETS, build_modules


@pytest.mark.parametrize("preset", ["compact", "paper"])
def test_presets_of_the_simulator(preset: str) -> None:
    modules = build_modules(preset)
    assert sorted(modules) == ["aperture", "exposure", "noise"]
    assert modules["noise"].preset == modules["aperture"].preset == preset


def test_baselines() -> None:
    assert isinstance(build_modules("pc")["baseline"], ParameterConcatenation)
    assert isinstance(build_modules("dl")["baseline"], DecoupledNet)


def test_an_unknown_name_is_refused() -> None:
    assert PRESETS == ("compact", "paper", "pc", "dl")
    with pytest.raises(ValueError, match=r"`preset` \(='compcat'\)"):
        build_modules("compcat")


def test_compact_fits_in_what_may_be_shipped() -> None:
    """Issue: at most 4 MB of float32 weights."""
    assert 4 * sum(p.numel() for p in build_modules("compact").parameters()) < 4_000_000
