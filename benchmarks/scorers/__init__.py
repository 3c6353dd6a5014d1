"""What the scorers cost, what they like, and whether they tell good captures from bad ones.

ae-env bench scorers
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ae_env.episodes.core import EpisodeCore
from ae_env.options import EnvOptions
from ae_env.scorers import CompositeScorer, list_scorers, make_scorer
from benchmarks.markdown import table
from benchmarks.scorers import correlations, sweeps, timing
from simulator.utils.files import write_atomically
from simulator.utils.results import result_meta, write_results

#: Packed pixels a side of the captures that every scorer is shown.
SIZE = 128


def run(out: Path, seed: int = 0, quick: bool = False) -> None:
    """Measures and writes ``scorers.json`` and ``scorers.md`` under `out`."""
    scorers, missing = _available()
    options = EnvOptions(scenes="bundled:small", split="test", resolution=SIZE)
    few, camera = options.load_scenes(), options.make_camera()
    name = "bundled:small" if quick else "bundled"
    every = EpisodeCore(EnvOptions(scenes=name, split="test"), num_envs=1)
    parts: dict[str, list[dict[str, Any]]] = {
        "milliseconds": timing.rows(scorers, repeats=2 if quick else 7),
        "best_ev": sweeps.best_ev_rows(scorers, few, camera, seed),
        "gain": sweeps.gain_rows(scorers, few, camera, seed),
        "correlation": correlations.rows(every, seed),
    }
    meta = result_meta(f"ae-env bench scorers{' --quick' * quick}", seed)
    meta |= {"scenes": len(every.scenes), "states": len(every.grid), "not_measured": missing}
    meta |= {"aspects": correlations.ASPECTS}
    rows = [{"measure": name, **row} for name, own in parts.items() for row in own]
    write_results(out / "scorers.json", rows, meta)
    text = [
        "# The scorers, measured",
        f"`{meta['command']}`, {meta['date'][:10]}.",
        "## What they read noise as",
        sweeps.gain_section(parts["gain"]),
        "## Which exposure they like best",
        sweeps.best_ev_section(parts["best_ev"]),
        "## What they cost",
        timing.section(parts["milliseconds"], meta["machine"]),
        "## Do they tell good captures from bad ones?",
        correlations.section(parts["correlation"], meta["states"], meta["scenes"]),
        *_not_measured(missing),
    ]
    write_atomically(out / "scorers.md", "\n\n".join(text) + "\n")


def _available() -> tuple[dict[str, CompositeScorer], dict[str, str]]:
    """The known scorers, and why those that cannot be made here cannot."""
    made, missing = {}, {}
    for name in list_scorers():
        try:
            made[name] = make_scorer(name)
        except (ValueError, ImportError, OSError) as error:
            missing[name] = " ".join(str(error).split())
    return made, missing


def _not_measured(missing: dict[str, str]) -> list[str]:
    if not missing:
        return []
    body = [[f"`{name}`", why] for name, why in missing.items()]
    return ["## Not measured", table(["scorer", "why"], body)]
