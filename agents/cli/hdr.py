"""``ae-env hdr``: one raw in, its radiance and a fused picture out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from agents.cli.console import (
    Device,
    check_outputs,
    print_files,
    print_line,
    torch_device,
)
from agents.cli.simulate import Cache, SourceAperture, SourceIso, SourceShutter, Weights


def hdr(
    raw: Annotated[Path, typer.Argument(help="Any Bayer raw that LibRaw reads.")],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="EXR to write: linear light, 1 at the raw's white.")
    ] = Path("out.exr"),
    png: Annotated[Path | None, typer.Option(help="Also write the fused picture here.")] = None,
    stops: Annotated[
        float, typer.Option(help="The bracket reaches this far down and up [EV].")
    ] = 4.0,
    step: Annotated[float, typer.Option(help="Between its pictures [EV].")] = 0.5,
    source_iso: SourceIso = None,
    source_shutter: SourceShutter = None,
    source_aperture: SourceAperture = None,
    weights: Weights = "large",
    device: Device = "auto",
    cache: Cache = True,
) -> None:
    """Simulate a bracket of one raw, reduce its noise and fuse it to one picture.

    Example: `ae-env hdr IMG_0001.CRW -o out.exr --png out.png`
    """
    from agents.applications.hdr import (
        bracket_exposures,
        hdr_picture,
        import_openexr,
        linear_rgb,
        write_exr,
    )
    from agents.cli.simulate import make_simulator, source_settings, write_upright
    from simulator import read_raw

    bracket_exposures(stops, step)
    import_openexr()
    check_outputs(raw, out=(out, ".exr"), png=(png, ".png"))
    source = read_raw(raw, settings=source_settings(source_iso, source_shutter, source_aperture))
    picture = hdr_picture(
        source,
        stops=stops,
        step=step,
        simulator=make_simulator(weights, torch_device(device), cache),
    )
    print_line(f"source {source.settings} ({source.camera.name})")
    count, saturated = len(picture.exposures), float(source.saturated.float().mean())
    print_line(
        f"fused {count} simulated pictures, {picture.exposures[0]:+g} to "
        f"{picture.exposures[-1]:+g} EV"
    )
    if saturated >= 5e-5:
        print_line(f"highlights: {saturated:.2%} of the raw is saturated: its light is estimated")
    files = {"EXR": write_exr(out, linear_rgb(source, picture.radiance))}
    if png is not None:
        files["PNG"] = write_upright(png, source, (picture.fused * 255.0).round().byte())
    print_files(files)
