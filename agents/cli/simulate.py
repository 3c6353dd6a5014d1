"""What becomes of one raw: ``ae-env simulate``, ``sweep``, ``refocus`` and ``hdr``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from agents.cli.console import (
    TOLERANCE,
    Cache,
    Depth,
    Device,
    Noise,
    OutDng,
    Png,
    Raw,
    Seed,
    SourceAperture,
    SourceIso,
    SourceShutter,
    Tolerance,
    Weights,
    check_outputs,
    console,
    make_folder,
    option_names,
    parse_f_number,
    parse_seconds,
    print_files,
    print_line,
    progress_bars,
    save_picture,
    torch_device,
)

if TYPE_CHECKING:
    import numpy as np
    import torch

    from ae_env.scenes import Scene
    from simulator import CameraSimulator, Lens, RawImage

#: Packed pixels a side of a picture on a contact sheet, at most.
_SHEET_SIZE = 128


def simulate(
    raw: Raw,
    iso: Annotated[float, typer.Option(help="Target ISO speed.")],
    shutter: Annotated[str, typer.Option(help="Target exposure time, such as 1/60 or 0.5 [s].")],
    aperture: Annotated[str, typer.Option(help="Target f-number, such as 4 or f/4.")],
    out: OutDng = Path("out.dng"),
    png: Png = None,
    source_iso: SourceIso = None,
    source_shutter: SourceShutter = None,
    source_aperture: SourceAperture = None,
    seed: Seed = 0,
    weights: Weights = "compact",
    depth: Depth = "far",
    tolerance: Tolerance = TOLERANCE,
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
    from simulator import CameraSettings
    from simulator.capture.exposure import check_tolerance
    from simulator.capture.sensor import check_noise

    check_noise(noise)
    check_tolerance(tolerance)
    settings = CameraSettings(iso, parse_seconds(shutter), parse_f_number(aperture))
    device = torch_device(device)
    check_outputs(raw, out=(out, ".dng"), png=(png, ".png"))
    source = _read(raw, source_iso, source_shutter, source_aperture)
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
    _write(result, out, png)


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


def sweep(
    raw: Raw,
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
    ] = TOLERANCE,
    device: Device = "auto",
    cache: Cache = True,
) -> None:
    """All 64 exposure states of one raw as a contact sheet, coloured by score.

    Example: `ae-env sweep IMG_0001.CRW --out sweep`
    """
    from ae_env.grid import ExposureGrid
    from ae_env.rendering import contact_sheet
    from ae_env.scenes import Scene
    from simulator import write_dng
    from simulator.capture.exposure import check_tolerance

    check_depth(depth, weights)
    check_tolerance(tolerance)
    device = torch_device(device)
    source = _read(raw, source_iso, source_shutter, source_aperture)
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


# -- refocus --------------------------------------------------------------------------------------

DepthMap = Annotated[
    Path | None,
    typer.Option(
        help="Depth map of the developed picture, upright, or half its size: PNG, EXR or .npy; "
        "by default the blur is estimated."
    ),
]
DepthKindName = Annotated[
    str | None,
    typer.Option(help="distance (default), or disparity: larger numbers are nearer."),
]
DepthScale = Annotated[
    float | None,
    typer.Option(
        help="Metres for each unit (by default 0.001 in a PNG, else 1), or 1 / metres for "
        "each unit of disparity."
    ),
]
Focus = Annotated[
    str | None,
    typer.Option(
        help="Where the lens is focused: a distance such as 2.5 [m], or a pixel of the depth "
        "map such as 640,480; by default its middle."
    ),
]
FocalLength = Annotated[float | None, typer.Option(help="Of the lens [mm]; by default the file's.")]
PixelPitch = Annotated[
    float | None, typer.Option(help="Of the sensor [um]; by default the camera's, if known.")
]


def refocus(
    raw: Raw,
    aperture: Annotated[str, typer.Option(help="Wider f-number, such as 1.4 or f/1.4.")],
    out: OutDng = Path("out.dng"),
    png: Png = None,
    depth: DepthMap = None,
    depth_kind: DepthKindName = None,
    depth_scale: DepthScale = None,
    focus: Focus = None,
    focal_length: FocalLength = None,
    pixel_pitch: PixelPitch = None,
    source_iso: SourceIso = None,
    source_shutter: SourceShutter = None,
    source_aperture: SourceAperture = None,
    seed: Seed = 0,
    weights: Weights = "large",
    device: Device = "auto",
    cache: Cache = True,
) -> None:
    """Open the aperture of one raw beyond its lens: shallow depth of field, written as a DNG.

    Example: `ae-env refocus IMG_0001.CRW --aperture 1.4 -o out.dng --png out.png`
    """
    import numpy as np

    from agents.applications.refocus import read_depth
    from agents.applications.refocus import refocus as refocused
    from simulator.raw.develop import quarter_turns

    f_number = parse_f_number(aperture)
    if depth is None:
        _check_unused(
            depth_kind=depth_kind,
            depth_scale=depth_scale,
            focus=focus,
            focal_length=focal_length,
            pixel_pitch=pixel_pitch,
        )
    if pixel_pitch is not None and not 0.1 <= pixel_pitch <= 100.0:
        raise ValueError(f"`pixel-pitch` (={pixel_pitch:g}) must be in [0.1, 100] micrometres")
    check_outputs(raw, depth, out=(out, ".dng"), png=(png, ".png"))
    source = _read(raw, source_iso, source_shutter, source_aperture)
    metres, lens = None, None
    if depth is not None:
        with option_names(kind="depth-kind", scale="depth-scale"):
            kind: Any = depth_kind or "distance"
            metres = read_depth(depth, kind=kind, scale=depth_scale)
        if pixel_pitch is not None:
            source = replace(source, camera=replace(source.camera, pixel_pitch_um=pixel_pitch))
        lens = _lens(source, metres, focus, focal_length)
        metres = np.rot90(metres, -quarter_turns(source))  # as the sensor lies
    with option_names(f_number="aperture"):
        result = refocused(
            source,
            f_number,
            depth=metres,
            lens=lens,
            simulator=make_simulator(weights, torch_device(device), cache),
            seed=seed,
        )
    print_line(f"source {source.settings} ({source.camera.name})")
    for line in _refocus_remarks(source, result):
        print_line(line)
    _write(result, out, png)


def _check_unused(**options: object) -> None:
    """Raises a `ValueError` if an option of a known depth is there without one."""
    for name, value in options.items():
        if value is not None:
            option = name.replace("_", "-")
            raise ValueError(f"`{option}` (={value}) is an option of a known `--depth`")


def _lens(
    source: RawImage, metres: np.ndarray, focus: str | None, focal_length: float | None
) -> Lens:
    """The lens that the options and the file describe."""
    from simulator import Lens

    millimetres = source.metadata.get("focal_length") if focal_length is None else focal_length
    if millimetres is None:
        raise ValueError("`focal-length` (=None) must be given: the file does not say it")
    if not float(millimetres) > 0.0:
        raise ValueError(f"`focal-length` (={millimetres:g}) must be above 0 mm")
    with option_names(focus_distance="focus", focal_length="focal-length"):
        return Lens(float(millimetres) / 1000.0, _focus_distance(focus, metres))


def _focus_distance(focus: str | None, metres: np.ndarray) -> float:
    """Distance that the lens is focused at [m]: as given, at a pixel, or in the middle."""
    import numpy as np

    height, width = metres.shape
    if focus is None:
        rows, columns = (
            slice(n * 9 // 20, max(n * 11 // 20, n * 9 // 20 + 1)) for n in (height, width)
        )
        return float(np.median(metres[rows, columns]))
    numbers: list[Any] = focus.split(",")
    try:
        numbers = [float(number) for number in numbers]
    except ValueError:
        numbers = []
    if len(numbers) == 1 and numbers[0] > 0.0:
        return float(numbers[0])
    if len(numbers) == 2 and 0 <= numbers[0] < width and 0 <= numbers[1] < height:
        return float(metres[int(numbers[1]), int(numbers[0])])
    raise ValueError(
        f"`focus` (={focus!r}) must be metres above 0, such as 2.5, or a pixel X,Y of the depth "
        f"map ({width} x {height})"
    )


def _refocus_remarks(source: RawImage, result: RawImage) -> list[str]:
    """Lines about what was done."""
    how, largest = result.metadata["depth"], result.metadata["largest_disc_px"]
    lines = [f"depth {how}; at {result.settings} the widest disc has {largest:.1f} packed pixels"]
    if result.settings.effective_f_number == source.settings.effective_f_number:
        lines.append("this is the aperture of the raw: nothing changed")
    elif how == "estimated" and largest == 0.0:
        lines.append(
            "nothing was found out of focus, so nothing changed: blur below 1.5 pixels cannot be "
            "told from sharpness; a depth map (`--depth`) says what is far"
        )
    return lines


def hdr(
    raw: Raw,
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

    bracket_exposures(stops, step)
    import_openexr()
    check_outputs(raw, out=(out, ".exr"), png=(png, ".png"))
    source = _read(raw, source_iso, source_shutter, source_aperture)
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
        files["PNG"] = _write_upright(png, source, (picture.fused * 255.0).round().byte())
    print_files(files)


# -- shared by the commands -----------------------------------------------------------------------


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


def _read(path: Path, iso: float | None, shutter: str | None, aperture: str | None) -> RawImage:
    """The raw at `path`, with the settings that the options give instead of the file's."""
    from simulator import CameraSettings, read_raw

    given = [value is not None for value in (iso, shutter, aperture)]
    if any(given) and not all(given):
        raise ValueError(
            "give all of --source-iso, --source-shutter and --source-aperture, or none"
        )
    settings = None
    if iso is not None and shutter is not None and aperture is not None:
        settings = CameraSettings(
            iso,
            parse_seconds(shutter, "source-shutter"),
            parse_f_number(aperture, "source-aperture"),
        )
    return read_raw(path, settings=settings)


def _write(raw: RawImage, out: Path, png: Path | None) -> None:
    """Writes the DNG and, where asked for, the developed picture; prints their names."""
    from simulator import render_srgb, write_dng

    write_dng(out, raw)
    files = {"DNG": out}
    if png is not None:
        files["PNG"] = _write_upright(png, raw, render_srgb(raw))
    print_files(files)


def _write_upright(path: Path, raw: RawImage, srgb: torch.Tensor) -> Path:
    """Writes `srgb` (3, 2H, 2W) uint8, a picture of `raw`, upright and with square pixels."""
    from agents.report.plots import upright_picture

    aspect = raw.metadata.get("pixel_aspect", 1.0)
    if aspect != 1.0:
        print_line(f"pixels are {aspect:g} times as wide as high: the PNG is stretched")
    return save_picture(path, upright_picture(raw, srgb))
