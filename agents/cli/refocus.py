"""``ae-env refocus``: one raw in, the same with a shallower depth of field out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from agents.cli.console import (
    Device,
    Seed,
    check_outputs,
    option_names,
    parse_f_number,
    print_files,
    print_line,
    torch_device,
)
from agents.cli.simulate import Cache, SourceAperture, SourceIso, SourceShutter, Weights

if TYPE_CHECKING:
    import numpy as np

    from simulator import Lens, RawImage


def refocus(
    raw: Annotated[Path, typer.Argument(help="Any Bayer raw that LibRaw reads.")],
    aperture: Annotated[str, typer.Option(help="Wider f-number, such as 1.4 or f/1.4.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="DNG to write.")] = Path("out.dng"),
    png: Annotated[Path | None, typer.Option(help="Also write the developed picture here.")] = None,
    depth: Annotated[
        Path | None,
        typer.Option(
            help="Depth map of the developed picture, upright, or half its size: PNG, EXR or .npy; "
            "by default the blur is estimated."
        ),
    ] = None,
    depth_kind: Annotated[
        str | None,
        typer.Option(help="distance (default), or disparity: larger numbers are nearer."),
    ] = None,
    depth_scale: Annotated[
        float | None,
        typer.Option(
            help="Metres for each unit (by default 0.001 in a PNG, else 1), or 1 / metres for "
            "each unit of disparity."
        ),
    ] = None,
    focus: Annotated[
        str | None,
        typer.Option(
            help="Where the lens is focused: a distance such as 2.5 [m], or a pixel of the depth "
            "map such as 640,480; by default its middle."
        ),
    ] = None,
    focal_length: Annotated[
        float | None, typer.Option(help="Of the lens [mm]; by default the file's.")
    ] = None,
    pixel_pitch: Annotated[
        float | None, typer.Option(help="Of the sensor [um]; by default the camera's, if known.")
    ] = None,
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

    from agents.applications.depth_map import read_depth
    from agents.applications.refocus import refocus as refocused
    from agents.cli.simulate import make_simulator, source_settings, write_png
    from simulator import read_raw, write_dng
    from simulator.raw.develop import quarter_turns

    f_number = parse_f_number(aperture)
    if depth is None:
        for name, value in (
            ("depth-kind", depth_kind),
            ("depth-scale", depth_scale),
            ("focus", focus),
            ("focal-length", focal_length),
            ("pixel-pitch", pixel_pitch),
        ):
            if value is not None:
                raise ValueError(f"`{name}` (={value}) is an option of a known `--depth`")
    if pixel_pitch is not None and not 0.1 <= pixel_pitch <= 100.0:
        raise ValueError(f"`pixel-pitch` (={pixel_pitch:g}) must be in [0.1, 100] micrometres")
    check_outputs(raw, depth, out=(out, ".dng"), png=(png, ".png"))
    source = read_raw(raw, settings=source_settings(source_iso, source_shutter, source_aperture))
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
    for line in _remarks(source, result):
        print_line(line)
    write_dng(out, result)
    files = {"DNG": out}
    if png is not None:
        files["PNG"] = write_png(png, result)
    print_files(files)


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


def _remarks(source: RawImage, result: RawImage) -> list[str]:
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
