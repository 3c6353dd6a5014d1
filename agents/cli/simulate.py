"""``ae-env simulate``: one raw in, one raw at other settings out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from agents.cli.console import (
    Device,
    Seed,
    console,
    make_folder,
    parse_seconds,
    print_files,
    save_picture,
    torch_device,
)
from simulator.capture.plan import DEFAULT_TOLERANCE, check_tolerance

if TYPE_CHECKING:
    from simulator.camera_simulator import CameraSimulator
    from simulator.raw.image import RawImage

Weights = Annotated[
    str, typer.Option(help="Networks: compact, a file of weights, or none to only add noise.")
]
Depth = Annotated[
    str,
    typer.Option(help="far, or unknown: estimate what is out of focus and blur it as f/ opens."),
]
Cache = Annotated[bool, typer.Option(help="Cache the outputs of the networks between runs.")]
Tolerance = Annotated[
    float,
    typer.Option(help="Error to accept for speed, in units of the target's noise; 0 for none."),
]
Noise = Annotated[
    str, typer.Option(help="exact: drawn; or bank: looked up in a bank of normals, faster.")
]


def simulate(
    raw: Annotated[Path, typer.Argument(help="Any Bayer raw that LibRaw reads.")],
    iso: Annotated[float, typer.Option(help="Target ISO speed.")],
    shutter: Annotated[str, typer.Option(help="Target exposure time, such as 1/60 or 0.5 [s].")],
    aperture: Annotated[float, typer.Option(help="Target f-number.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="DNG to write.")] = Path("out.dng"),
    png: Annotated[Path | None, typer.Option(help="Also write the developed picture here.")] = None,
    seed: Seed = 0,
    weights: Weights = "compact",
    depth: Depth = "far",
    tolerance: Tolerance = DEFAULT_TOLERANCE,
    noise: Noise = "exact",
    device: Device = "auto",
    cache: Cache = True,
) -> None:
    """Simulate one raw at other settings and write it as a DNG; prints the plan.

    Example: `ae-env simulate IMG_0001.CRW --iso 800 --shutter 1/60 --aperture 4 -o out.dng`
    """
    from simulator import CameraSettings, read_raw, write_dng
    from simulator.noise.generator import check_noise

    check_noise(noise)
    check_tolerance(tolerance)
    settings = CameraSettings(iso, parse_seconds(shutter), aperture)
    device = torch_device(device)
    for name, path in (("out", out), ("png", png)):
        suffix = ".dng" if name == "out" else ".png"
        if path is not None and path.suffix.lower() != suffix:
            raise ValueError(f"`{name}` (={str(path)!r}) must end in {suffix}")
    source = read_raw(raw)
    for name, path in (("out", out), ("png", png)):
        if path is not None:
            make_folder(path.parent, name=name, file=path)
    simulator = make_simulator(weights, device, cache)
    prepared = simulator.prepare(source, depth=depth, tolerance=tolerance)  # type: ignore[arg-type]
    console.print(f"source {source.settings} ({source.camera.name})", highlight=False)
    console.print(str(prepared.plan(settings)), highlight=False, soft_wrap=True)
    result = simulator.simulate(prepared, settings, seed=seed, noise=noise)  # type: ignore[arg-type]
    result = replace(result, metadata={**source.metadata, **result.metadata})
    write_dng(out, result)
    files = {"DNG": out}
    if png is not None:
        files["PNG"] = _write_png(png, result)
    print_files(files)


def make_simulator(weights: str, device: str, cache: bool) -> CameraSimulator:
    """The simulator that the options `--weights`, `--device` and `--cache` describe."""
    from simulator import CameraSimulator

    if weights == "none":
        return CameraSimulator(device=device)
    where: Literal["disk"] | None = "disk" if cache else None
    return CameraSimulator.from_pretrained(weights, device=device, cache=where)


def _write_png(path: Path, raw: RawImage) -> Path:
    from PIL import Image

    from simulator import render_srgb

    picture = render_srgb(raw).permute(1, 2, 0).cpu().numpy()
    return save_picture(path, Image.fromarray(picture))
