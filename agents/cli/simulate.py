"""What becomes of one raw: ``ae-env simulate``, ``sweep``, ``refocus`` and ``hdr``."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from typer import Option

from agents.cli import console
from agents.cli.console import check_outputs, print_files, print_line, progress_bars
from simulator.utils.checks import check_number, check_word, import_extra, parse_number
from simulator.utils.files import printable, write_picture

if TYPE_CHECKING:
    import numpy as np
    import torch

    from simulator import CameraSimulator, Lens, RawImage

#: Packed pixels a side of a picture on a contact sheet, at most.
_SHEET_SIZE = 128


@console.takes_source
def simulate(
    raw: console.Raw,
    iso: Annotated[float | None, Option(help="Target ISO speed; by default the raw's.")] = None,
    shutter: Annotated[str | None, Option(help="Exposure time, such as 1/60 or 0.5 [s].")] = None,
    aperture: Annotated[str | None, Option(help="F-number, such as 4 or f/4.")] = None,
    ev: Annotated[
        float | None, Option(help="+1: twice the raw's exposure time.", min=-32, max=32)
    ] = None,
    out: console.OutDng = Path("out.dng"),
    png: console.Png = None,
    source: Any = None,
    seed: console.Seed = 0,
    weights: console.Weights = "compact",
    depth: console.Depth = "far",
    lens: Annotated[
        str | None,
        Option(help="The raw's, lensfun:NAME?focal=50: its vignetting at the new f-number."),
    ] = None,
    tolerance: console.Tolerance = console.TOLERANCE,
    noise: console.Noise = "exact",
    device: console.Device = "auto",
    cache: console.Cache = True,
    details: Annotated[
        bool, Option("--details", help="Also print why each step runs or is left out.")
    ] = False,
) -> None:
    """Simulate one raw at other settings and write it as a DNG; prints the plan.

    Settings that are not given are the raw's.

    Example: `ae-env simulate IMG_0001.CRW --iso 800 --shutter 1/60 --aperture 4 -o out.dng`
    """
    from simulator import read_raw
    from simulator.capture.limits import check_tolerance
    from simulator.noise.generator import Noise
    from simulator.optics.vignetting import get_lens

    if ev is not None and shutter is not None:
        raise ValueError(f"`ev` (={ev:g}) changes the exposure time: leave out --shutter")
    with console.all_mistakes() as check:
        given = [
            check(console.setting, "iso", iso, "iso"),
            check(console.setting, "exposure_time", shutter, "shutter"),
            check(console.setting, "f_number", aperture, "aperture"),
        ]
        check(check_word, "noise", noise, get_args(Noise))
        check(check_tolerance, tolerance)
        through = check(get_lens, lens)
        check(check_outputs, raw, out=(out, ".dng"), png=(png, ".png"))
        simulator = check(make_simulator, weights, device, cache, depth)
        source = check(read_raw, raw, settings=source)
    changed = {"exposure_time": source.settings.exposure_time * 2.0 ** (ev or 0.0)}
    settings = replace(source.settings, **changed | given[0] | given[1] | given[2])
    if noise == "sensor":
        source.camera.read_noise(settings.iso)  # refuses a camera without its calibration
    options: Any = {"depth": depth, "tolerance": tolerance, "lens": through}
    prepared = simulator.prepare(source, **options)
    print_line(f"source {source.settings} ({source.camera.name})")
    plan = prepared.plan(settings)
    for text in (plan.explain(), *([plan.details()] if details else [])):
        console.terminal.print(text, highlight=False, soft_wrap=True)
    result = simulator.simulate(prepared, settings, seed=seed, noise=noise)
    result = replace(result, metadata={**source.metadata, **result.metadata})
    for line in _remarks(source, result, details=details):
        print_line(line)
    _write(result, out, png)


def _remarks(source: "RawImage", result: "RawImage", *, details: bool) -> Iterator[str]:
    """Lines about what the result hides at the ends of its range, and what had to be guessed."""
    from simulator import exposure_ratio
    from simulator.camera import LOW_CLIP

    high = (result.to_mosaic() == result.camera.white_level).mean()
    low = (result.data <= LOW_CLIP).double().mean()
    yield f"recorded: {low:.2%} of the samples at black, {high:.2%} at white"
    stops = result.camera.nlf(result.settings.iso).extrapolation
    if stops and not details:  # the plan's details have said so
        where = "above" if stops > 0 else "below"
        iso, camera = f"{result.settings.iso:g}", result.camera.name
        yield f"noise: ISO {iso} is {abs(stops):.1f} stops {where} the calibration of {camera}"
    hidden = result.metadata["clipped_source"]
    if hidden and exposure_ratio(source.settings, result.settings) < 1.0:
        yield f"highlights: {hidden:.2%} of the source is saturated: neutral, as bright as is known"


@console.takes_source
def sweep(
    raw: console.Raw,
    out: console.Folder = Path("sweep"),
    dngs: Annotated[bool, Option(help="Also write the 64 DNGs, full size.")] = False,
    source: Any = None,
    seed: console.Seed = 0,
    weights: console.Weights = "compact",
    depth: console.Depth = "far",
    tolerance: Annotated[
        float, Option(help="Of the DNGs: error to accept for speed, see simulate.")
    ] = console.TOLERANCE,
    device: console.Device = "auto",
    cache: console.Cache = True,
) -> None:
    """All 64 exposure states of one raw as a contact sheet, coloured by score.

    Example: `ae-env sweep IMG_0001.CRW --out sweep`
    """
    from ae_env.grid import ExposureGrid
    from ae_env.rendering import contact_sheet
    from ae_env.scenes import Scene
    from ae_env.scenes.load import SceneNetworks
    from simulator import read_raw, write_dng
    from simulator.capture.limits import check_tolerance

    check_tolerance(tolerance)
    simulator = make_simulator(weights, device, cache, depth)
    source = read_raw(raw, settings=source)
    console.make_folder(out)
    sheet = out / "contact_sheet.png"
    with progress_bars() as progress, progress("contact sheet") as task:
        scene = Scene.from_raw(source, scene_id=printable(raw.stem))
        size = min(_SHEET_SIZE, *scene.light.shape[1:])
        if weights == "none":
            scene = scene.resized(size)
        else:
            networks = SceneNetworks(weights, cache=cache)
            resized = networks.resized if depth == "unknown" else Scene.resized
            scene = networks.denoised(resized(scene, size))
        write_picture(sheet, contact_sheet(scene, camera=source.camera, seed=seed))
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


# -- refocus --------------------------------------------------------------------------------------

DepthMap = Annotated[
    Path | None,
    Option(
        help="Depth map of the developed picture, upright, or half its size: PNG, EXR or .npy; "
        "by default the blur is estimated."
    ),
]
DepthKindName = Annotated[
    str | None, Option(help="distance (default), or disparity: larger numbers are nearer.")
]
DepthScale = Annotated[
    float | None,
    Option(
        help="Metres for each unit (by default 0.001 in a PNG, else 1), or 1 / metres for "
        "each unit of disparity."
    ),
]
DepthLayer = Annotated[
    str | None, Option(help="Part or layer of an EXR, where several have depth.")
]
Focus = Annotated[
    str | None,
    Option(
        help="Where the lens is focused: a distance such as 2.5 [m], or a pixel of the depth "
        "map such as 640,480; by default its middle."
    ),
]
FocalLength = Annotated[float | None, Option(help="Of the lens [mm]; by default the file's.")]
PixelPitch = Annotated[
    float | None, Option(help="Of the sensor [um]; by default the camera's, if known.")
]


@console.takes_source
def refocus(
    raw: console.Raw,
    aperture: Annotated[str, Option(help="Wider f-number, such as 1.4 or f/1.4.")],
    out: console.OutDng = Path("refocused.dng"),
    png: console.Png = None,
    depth: DepthMap = None,
    depth_kind: DepthKindName = None,
    depth_scale: DepthScale = None,
    depth_layer: DepthLayer = None,
    focus: Focus = None,
    focal_length: FocalLength = None,
    pixel_pitch: PixelPitch = None,
    source: Any = None,
    seed: console.Seed = 0,
    weights: console.Weights = "large",
    device: console.Device = "auto",
    cache: console.Cache = True,
) -> None:
    """Open the aperture of one raw beyond its lens: shallow depth of field, written as a DNG.

    Example: `ae-env refocus IMG_0001.CRW --aperture 1.4 -o refocused.dng --png refocused.png`
    """
    import numpy as np

    from agents.applications import refocus as applied
    from simulator import read_raw
    from simulator.raw.develop import as_recorded

    with console.option_names(f_number="aperture"):
        f_number = parse_number(aperture, "f_number")
    for_depth = {"depth-kind": depth_kind, "depth-scale": depth_scale}
    for_depth |= {"depth-layer": depth_layer, "focus": focus}
    for_depth |= {"focal-length": focal_length, "pixel-pitch": pixel_pitch}
    for name, value in for_depth.items():
        if depth is None and value is not None:
            raise ValueError(f"`{name}` (={value}) is an option of a known `--depth`")
    if pixel_pitch is not None:
        check_number("pixel-pitch", pixel_pitch, 0.1, 100.0, more=" micrometres")
    check_outputs(raw, depth, out=(out, ".dng"), png=(png, ".png"))
    source = read_raw(raw, settings=source)
    metres, lens = None, None
    if depth is not None:
        with console.option_names(kind="depth-kind", scale="depth-scale"):
            kind: Any = depth_kind or "distance"
            metres = applied.read_depth(depth, kind=kind, scale=depth_scale, layer=depth_layer)
        if pixel_pitch is not None:
            source = replace(source, camera=replace(source.camera, pixel_pitch_um=pixel_pitch))
        lens = _lens(source, metres, focus, focal_length)
        metres = np.ascontiguousarray(as_recorded(metres, source))
    simulator = make_simulator(weights, device, cache)
    with console.option_names(f_number="aperture"):
        result = applied.refocus(
            source, f_number, depth=metres, lens=lens, simulator=simulator, seed=seed
        )
    print_line(f"source {source.settings} ({source.camera.name})")
    how, largest = result.metadata["depth"], result.metadata["largest_disc_px"]
    print_line(f"depth {how}; at {result.settings} the widest disc has {largest:.1f} packed pixels")
    if result.settings.effective_f_number == source.settings.effective_f_number:
        print_line("this is the aperture of the raw: nothing changed")
    elif how == "estimated" and largest == 0.0:
        print_line(f"{applied.NOTHING_FOUND}; a depth map (`--depth`) says what is far")
    _write(result, out, png)


def _lens(
    source: "RawImage", metres: "np.ndarray", focus: str | None, focal_length: float | None
) -> "Lens":
    from simulator import Lens

    millimetres = source.metadata.get("focal_length") if focal_length is None else focal_length
    more = " mm; the file does not say it" if millimetres is None else " mm"
    millimetres = check_number("focal-length", millimetres, 1e-3, 1e6, more=more)
    with console.option_names(focus_distance="focus", focal_length="focal-length"):
        return Lens(millimetres / 1000.0, _focus_distance(focus, metres))


def _focus_distance(focus: str | None, metres: "np.ndarray") -> float:
    """Distance that the lens is focused at [m]: as given, at a pixel, or in the middle."""
    import numpy as np

    height, width = metres.shape
    if focus is None:
        middle = [slice(n * 9 // 20, max(n * 11 // 20, n * 9 // 20 + 1)) for n in metres.shape]
        return float(np.median(metres[tuple(middle)]))
    with suppress(ValueError):  # no numbers
        match [float(number) for number in focus.split(",")]:
            case [distance] if distance > 0.0:
                return distance
            case [x, y] if 0 <= x < width and 0 <= y < height:
                return float(metres[int(y), int(x)])
    raise ValueError(
        f"`focus` (={focus!r}) must be metres above 0, such as 2.5, or a pixel X,Y of the depth "
        f"map ({width} x {height})"
    )


@console.takes_source
def hdr(
    raw: console.Raw,
    out: Annotated[
        Path, Option("--out", "-o", help="EXR to write: linear light, 1 at the raw's white.")
    ] = Path("fused.exr"),
    png: Annotated[Path | None, Option(help="Also write the fused picture here.")] = None,
    stops: Annotated[float, Option(help="The bracket reaches this far down and up [EV].")] = 4.0,
    step: Annotated[float, Option(help="Between its pictures [EV].")] = 0.5,
    source: Any = None,
    weights: console.Weights = "large",
    device: console.Device = "auto",
    cache: console.Cache = True,
) -> None:
    """Simulate a bracket of one raw, reduce its noise and fuse it to one picture.

    Example: `ae-env hdr IMG_0001.CRW -o fused.exr --png fused.png`
    """
    from agents.applications import hdr as applied
    from simulator import read_raw

    applied.bracket_exposures(stops, step)
    import_extra("OpenEXR", "hdr", "an EXR file")
    check_outputs(raw, out=(out, ".exr"), png=(png, ".png"))
    simulator = make_simulator(weights, device, cache)
    source = read_raw(raw, settings=source)
    picture = applied.hdr_picture(source, stops=stops, step=step, simulator=simulator)
    print_line(f"source {source.settings} ({source.camera.name})")
    darkest, brightest = picture.exposures[0], picture.exposures[-1]
    count, saturated = len(picture.exposures), float(source.saturated.float().mean())
    print_line(f"fused {count} simulated pictures, {darkest:+g} to {brightest:+g} EV")
    if saturated >= 5e-5:
        print_line(f"highlights: {saturated:.2%} of the raw is saturated: its light is estimated")
    files = {"EXR": applied.write_exr(out, applied.linear_rgb(source, picture.radiance))}
    if png is not None:
        files["PNG"] = _write_upright(png, source, (picture.fused * 255.0).round().byte())
    print_files(files)


# -- shared by the commands -----------------------------------------------------------------------


def make_simulator(weights: str, device: str, cache: bool, depth: str = "far") -> "CameraSimulator":
    """The simulator that the options describe; checks `depth`, which may need networks."""
    from simulator import CameraSimulator

    check_word("depth", depth, ("far", "unknown"))
    device = console.torch_device(device)
    if weights != "none":
        where: Literal["disk"] | None = "disk" if cache else None
        return CameraSimulator.from_pretrained(weights, device=device, cache=where)
    if depth == "unknown":
        raise ValueError("`depth` (='unknown') needs networks: leave out `--weights none`")
    return CameraSimulator(device=device)


def _write(raw: "RawImage", out: Path, png: Path | None) -> None:
    """Writes the DNG and, where asked for, the developed picture; prints their names."""
    from simulator import render_srgb, write_dng

    write_dng(out, raw)
    files = {"DNG": out}
    if png is not None:
        files["PNG"] = _write_upright(png, raw, render_srgb(raw))
    print_files(files)


def _write_upright(path: Path, raw: "RawImage", srgb: "torch.Tensor") -> Path:
    """Writes `srgb` (3, 2H, 2W) uint8, a picture of `raw`, upright and with square pixels."""
    from simulator.raw.develop import upright_picture

    aspect = raw.metadata.get("pixel_aspect", 1.0)
    if aspect != 1.0:
        print_line(f"pixels are {aspect:g} times as wide as high: the PNG is stretched")
    return write_picture(path, upright_picture(raw, srgb))
