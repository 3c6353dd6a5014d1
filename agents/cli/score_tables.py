"""``ae-env score-tables``: the scores of all states for many files, in one process or on Ray."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Annotated

import typer

from agents.cli.console import Seed, make_folder, print_files, print_line, progress_bars


def score_tables(
    what: Annotated[
        str, typer.Argument(help="A folder or glob of raws and radiance maps, or one of them.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the shards.")] = Path(
        "score_tables"
    ),
    on: Annotated[
        str,
        typer.Option(
            help="local: this process; ray: a Ray on this machine; or a cluster's address, such as "
            "ray://head:10001 or auto."
        ),
    ] = "local",
    workers: Annotated[int, typer.Option(help="Processes on Ray.", min=1)] = 2,
    per_shard: Annotated[int, typer.Option(help="Files of a shard.", min=1)] = 16,
    resolution: Annotated[int, typer.Option(help="Packed pixels a side.", min=1)] = 64,
    grid: Annotated[
        str, typer.Option(help="Exposure grid: default, third_stop, video, bracket.")
    ] = "default",
    scorer: Annotated[str, typer.Option(help="Scorer, as for `evaluate`.")] = "balanced",
    camera: Annotated[str, typer.Option(help="Camera for radiance maps.")] = "nikon_z6",
    weights: Annotated[
        str, typer.Option(help="Networks that take the noise out of raws; none for none.")
    ] = "compact",
    captures: Annotated[bool, typer.Option(help="Also write the captures.")] = False,
    seed: Seed = 0,
) -> None:
    """Score every exposure state of many raws or radiance maps; writes Parquet, shard by shard.

    Run it again to continue. Needs the extra `tables`; a cluster the extra `ray`.

    Example: `ae-env score-tables path/to/raws -o tables`
    """
    from ae_env.grid import ExposureGrid
    from ae_env.scenes.load import check_weights
    from ae_env.scorers import make_scorer
    from agents.score_shards import ShardPlan, check_engine, run
    from simulator import get_camera

    try:
        import pyarrow  # noqa: F401
    except ModuleNotFoundError:
        raise ImportError(
            "`ae-env score-tables` needs the extra tables: pip install 'ae-env[tables]'"
        ) from None
    check_engine(on)
    ExposureGrid.from_spec(grid), make_scorer(scorer), get_camera(camera)
    if weights != "none":
        check_weights(weights)
    plan = ShardPlan.of(
        what,
        out,
        per_shard=per_shard,
        resolution=resolution,
        camera=camera,
        grid=grid,
        scorer=scorer,
        weights=weights,
        captures=captures,
        seed=seed,
    )
    make_folder(out)
    begun = perf_counter()
    with progress_bars() as progress, progress("shards") as task:
        made = run(plan, on, task, workers)
    if not made:
        print_line("every shard was there already")
        return
    scenes, bad = (sum(int(one[name]) for one in made) for name in ("scenes", "bad"))
    seconds = perf_counter() - begun
    print_line(f"{scenes} scenes in {seconds:.1f} s, {bad} files that could not be read")
    if bad:
        print_line(f"which and why: {out}/bad-*.jsonl")
    if not scenes:
        raise RuntimeError("none of these files could be made a scene")
    print_files({"score tables": out / "tables-*.parquet"})
