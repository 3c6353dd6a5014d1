"""``ae-env simulate``: one raw in, one raw at other settings out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from agents.cli.console import (
    Device,
    Seed,
    check_outputs,
    console,
    parse_f_number,
    parse_seconds,
    print_files,
    print_line,
    save_picture,
    torch_device,
)
from simulator.capture.plan import DEFAULT_TOLERANCE, check_tolerance

if TYPE_CHECKING:
    import torch

    from simulator.camera_simulator import CameraSimulator
    from simulator.raw.image import RawImage
    from simulator.settings import CameraSettings

Weights = Annotated[
    str,
    typer.Option(
        help="Largest network that may run: nano, compact, large; a file of weights; or none to "
        "only add noise."
    ),
]
Depth = Annotated[
    str,
    typer.Option(help="far, or unknown: estimate what is out of focus and blur it as f/ opens."),
]
Cache = Annotated[bool, typer.Option(help="Cache the outputs of the networks between runs.")]
Tolerance = Annotated[
    float,
    typer.Option(
        help="Error that a capture may have, in units of the target's noise: the cheapest way "
        "within it is taken, or else the best; 0 for the best."
    ),
]
Noise = Annotated[
    str,
    typer.Option(
        help="exact: drawn; bank: looked up in a bank of normals, faster; or sensor: drawn with "
        "the row noise and the tails of a calibrated camera's read noise."
    ),
]


SourceIso = Annotated[
    float | None, typer.Option(help="ISO speed of RAW, instead of what the file says.")
]
SourceShutter = Annotated[str | None, typer.Option(help="Exposure time of RAW [s].")]
SourceAperture = Annotated[str | None, typer.Option(help="F-number of RAW.")]


def simulate(
    raw: Annotated[Path, typer.Argument(help="Any Bayer raw that LibRaw reads.")],
    iso: Annotated[float, typer.Option(help="Target ISO speed.")],
    shutter: Annotated[str, typer.Option(help="Target exposure time, such as 1/60 or 0.5 [s].")],
    aperture: Annotated[str, typer.Option(help="Target f-number, such as 4 or f/4.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="DNG to write.")] = Path("out.dng"),
    png: Annotated[Path | None, typer.Option(help="Also write the developed picture here.")] = None,
    source_iso: SourceIso = None,
    source_shutter: SourceShutter = None,
    source_aperture: SourceAperture = None,
    seed: Seed = 0,
    weights: Weights = "compact",
    depth: Depth = "far",
    tolerance: Tolerance = DEFAULT_TOLERANCE,
    noise: Noise = "exact",
    device: Device = "auto",
    cache: Cache = True,
    details: Annotated[
        bool, typer.Option("--details", help="Also print why each step runs or is left out.")
    ] = False,
) -> None:
    """Simulate one raw at other settings and write it as a DNG; prints the plan.

    Example: `ae-env simulate IMG_0001.CRW --iso 800 --shutter 1/60 --aperture 4 -o out.dng`
    """
    from simulator import CameraSettings, read_raw, write_dng
    from simulator.noise.generator import check_noise

    check_noise(noise)
    check_tolerance(tolerance)
    settings = CameraSettings(iso, parse_seconds(shutter), parse_f_number(aperture))
    device = torch_device(device)
    check_outputs(raw, out=(out, ".dng"), png=(png, ".png"))
    source = read_raw(raw, settings=source_settings(source_iso, source_shutter, source_aperture))
    if noise == "sensor":
        source.camera.read_noise(iso)  # refuses a camera without its calibration
    simulator = make_simulator(weights, device, cache)
    prepared = simulator.prepare(source, depth=depth, tolerance=tolerance)  # type: ignore[arg-type]
    console.print(f"source {source.settings} ({source.camera.name})", highlight=False)
    plan = prepared.plan(settings)
    for text in (plan.explain(), *([plan.details()] if details else [])):
        console.print(text, highlight=False, soft_wrap=True)
    result = simulator.simulate(prepared, settings, seed=seed, noise=noise)  # type: ignore[arg-type]
    result = replace(result, metadata={**source.metadata, **result.metadata})
    for line in _remarks(source, result, details=details):
        print_line(line)
    write_dng(out, result)
    files = {"DNG": out}
    if png is not None:
        files["PNG"] = write_png(png, result)
    print_files(files)


def _remarks(source: RawImage, result: RawImage, *, details: bool) -> Iterator[str]:
    """Lines about what the result hides at the ends of its range, and what had to be guessed.

    The plan's details have said already how far the noise is from its calibration.
    """
    from simulator import exposure_ratio

    numbers, white = result.to_mosaic(), result.camera.white_level
    ends = [(numbers == end).mean() for end in (0, white)]
    yield f"recorded: {ends[0]:.2%} of the samples at black, {ends[1]:.2%} at white"
    stops = result.camera.nlf(result.settings.iso).extrapolation
    if stops and not details:
        where = "above" if stops > 0 else "below"
        iso, camera = f"{result.settings.iso:g}", result.camera.name
        yield f"noise: ISO {iso} is {abs(stops):.1f} stops {where} the calibration of {camera}"
    hidden = result.metadata["clipped_source"]
    if hidden and exposure_ratio(source.settings, result.settings) < 1.0:
        yield f"highlights: {hidden:.2%} of the source is saturated: neutral, as bright as is known"


def make_simulator(weights: str, device: str, cache: bool) -> CameraSimulator:
    """The simulator that the options `--weights`, `--device` and `--cache` describe."""
    from simulator import CameraSimulator

    if weights == "none":
        return CameraSimulator(device=device)
    where: Literal["disk"] | None = "disk" if cache else None
    return CameraSimulator.from_pretrained(weights, device=device, cache=where)


def check_depth(depth: str, weights: str) -> None:
    """Raises a `ValueError` if `depth` is unknown to us, or needs networks that are not there."""
    if depth not in ("far", "unknown"):
        raise ValueError(f"`depth` (={depth!r}) must be 'far' or 'unknown'")
    if depth == "unknown" and weights == "none":
        raise ValueError("`depth` (='unknown') needs networks: leave out `--weights none`")


def source_settings(
    iso: float | None, shutter: str | None, aperture: str | None
) -> CameraSettings | None:
    """Settings of the source that the options give; None for those of the file."""
    from simulator import CameraSettings

    if iso is None and shutter is None and aperture is None:
        return None
    if iso is None or shutter is None or aperture is None:
        raise ValueError(
            "give all of --source-iso, --source-shutter and --source-aperture, or none"
        )
    return CameraSettings(
        iso, parse_seconds(shutter, "source-shutter"), parse_f_number(aperture, "source-aperture")
    )


def write_png(path: Path, raw: RawImage) -> Path:
    """Writes a raw's developed picture; see `write_upright`."""
    from simulator import render_srgb

    return write_upright(path, raw, render_srgb(raw))


def write_upright(path: Path, raw: RawImage, srgb: torch.Tensor) -> Path:
    """Writes `srgb` (3, 2H, 2W) uint8, a picture of `raw`, upright and with square pixels."""
    from agents.report.plots import upright_picture

    aspect = raw.metadata.get("pixel_aspect", 1.0)
    if aspect != 1.0:
        print_line(f"pixels are {aspect:g} times as wide as high: the PNG is stretched")
    return save_picture(path, upright_picture(raw, srgb))
