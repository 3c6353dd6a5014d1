"""``ae-env sweep``: all exposure states of one raw."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from agents.cli.console import (
    Device,
    Seed,
    make_folder,
    print_files,
    progress_bars,
    save_picture,
    torch_device,
)
from agents.cli.simulate import (
    Cache,
    Depth,
    SourceAperture,
    SourceIso,
    SourceShutter,
    Weights,
    check_depth,
    make_simulator,
    source_settings,
)
from simulator.capture.plan import DEFAULT_TOLERANCE, check_tolerance

if TYPE_CHECKING:
    from ae_env.scenes import Scene

#: Packed pixels a side of a picture on a contact sheet, at most.
_SHEET_SIZE = 128


def sweep(
    raw: Annotated[Path, typer.Argument(help="Any Bayer raw that LibRaw reads.")],
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("sweep"),
    dngs: Annotated[bool, typer.Option(help="Also write the 64 DNGs, full size.")] = False,
    source_iso: SourceIso = None,
    source_shutter: SourceShutter = None,
    source_aperture: SourceAperture = None,
    seed: Seed = 0,
    weights: Weights = "compact",
    depth: Depth = "far",
    tolerance: Annotated[
        float, typer.Option(help="Of the DNGs: error to accept for speed, see simulate.")
    ] = DEFAULT_TOLERANCE,
    device: Device = "auto",
    cache: Cache = True,
) -> None:
    """All 64 exposure states of one raw as a contact sheet, coloured by score.

    Example: `ae-env sweep IMG_0001.CRW --out sweep`
    """
    from ae_env.grid import ExposureGrid
    from ae_env.rendering import contact_sheet
    from ae_env.scenes import Scene
    from simulator import read_raw, write_dng

    check_depth(depth, weights)
    check_tolerance(tolerance)
    device = torch_device(device)
    source = read_raw(raw, settings=source_settings(source_iso, source_shutter, source_aperture))
    simulator = make_simulator(weights, device, cache)
    make_folder(out)
    sheet = out / "contact_sheet.png"
    with progress_bars() as progress, progress("contact sheet") as task:
        scene = _small_scene(Scene.from_raw(source, scene_id=raw.stem), weights, depth, cache)
        save_picture(sheet, contact_sheet(scene, camera=source.camera, seed=seed))
        task(1, 1)
    files = {"contact sheet": sheet}
    if dngs:
        grid = ExposureGrid.default()
        prepared = simulator.prepare(source, depth=depth, tolerance=tolerance)  # type: ignore[arg-type]
        with progress_bars() as progress, progress("DNGs") as task:
            for i, settings in enumerate(grid):
                path = out / f"{raw.stem}-{i:02d}.dng"
                write_dng(path, simulator.simulate(prepared, settings, seed=seed))
                task(i + 1, len(grid))
        files["DNGs"] = out
    print_files(files)


def _small_scene(scene: Scene, weights: str, depth: str, cache: bool) -> Scene:
    """`scene` at the size of a contact sheet, with what the networks find out about it."""
    from ae_env.scenes.load import SceneNetworks

    size = min(_SHEET_SIZE, *scene.light.shape[1:])
    if weights == "none":
        return scene.resized(size)
    networks = SceneNetworks(weights, cache=cache)
    small = networks.resized(scene, size) if depth == "unknown" else scene.resized(size)
    return networks.denoised(small)
