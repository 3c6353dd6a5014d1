"""Contact sheets of one scene's states with the paths of the policies."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agents.evaluation.result import EvaluationResult
from simulator.utils.files import write_atomically

if TYPE_CHECKING:
    from agents.evaluation.plan_run import PlanRun

#: Paths on one sheet, frames of a path.
_ABREAST, _FRAMES = 5, 8
#: The kind of scene that is shown, where there is one.
_KIND = "back_light"


def path_sheets(
    folder: Path,
    run: PlanRun,
    result: EvaluationResult,
    blur: tuple[np.ndarray, np.ndarray],
    order: list[str],
) -> dict[str, Path]:
    """Write ``contact_sheet.png``, and ``contact_sheet_2.png`` and so on for further policies.

    Args:
        folder: Where to.
        run: The plan that was run.
        result: What was measured in unchanging light.
        blur: Image speed and defocus of the episodes (`PlanRun.blur`).
        order: Policies, the best first.

    Returns:
        The files by name; none where the grid has more states than a sheet shows.
    """
    from ae_env.rendering import MAX_SHEET_STATES, contact_sheet

    if len(run.grid) > MAX_SHEET_STATES:
        return {}
    kinds = [scene.kind for scene in run.scenes]
    j = kinds.index(_KIND) if _KIND in kinds else 0
    episode = int(np.flatnonzero(run.episodes.table == j)[0])
    options = run.plan.options()
    files = {}
    for k, first in enumerate(range(0, len(order), _ABREAST)):
        paths = {}
        for name in order[first : first + _ABREAST]:
            states = result.tracks[name].states[0, episode, :_FRAMES]
            paths[name] = [int(result.start_states[episode]), *map(int, states)]
        picture = contact_sheet(
            run.scenes[j],
            camera=options.make_camera(),
            grid=run.grid,
            scorer=options.make_scorer(),
            speed=float(blur[0][j]),
            defocus=float(blur[1][j]),
            path=paths,
        )
        stream = io.BytesIO()
        picture.save(stream, format="PNG")
        name = "contact_sheet.png" if k == 0 else f"contact_sheet_{k + 1}.png"
        files[name] = write_atomically(folder / name, stream.getvalue())
    return files
