"""The commands of the simulator: one raw in, one or all 64 states out; training of its networks."""

from __future__ import annotations

import contextlib
import os
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from agents.cli.console import (
    Device,
    OwnSeed,
    Seed,
    command_line,
    console,
    make_folder,
    parse_seconds,
    print_files,
    progress_bars,
    save_picture,
    torch_device,
)
from simulator.capture.exposure import DEFAULT_TOLERANCE, check_tolerance

if TYPE_CHECKING:
    from ae_env.scenes import Scene
    from simulator.camera_simulator import CameraSimulator
    from simulator.raw.image import RawImage
    from simulator.reference.reference_camera import ReferenceScene
    from simulator.training.config import SimulatorConfig

Weights = Annotated[
    str, typer.Option(help="Networks: compact, a file of weights, or none to only add noise.")
]
Depth = Annotated[
    str,
    typer.Option(help="far, or unknown: estimate what is out of focus and blur it as f/ opens."),
]
Cache = Annotated[
    bool, typer.Option(help="Keep what the networks find out in the cache folder, and look there.")
]
Tolerance = Annotated[
    float,
    typer.Option(help="Error to accept for speed, in units of the target's noise; 0 for none."),
]
Noise = Annotated[
    str, typer.Option(help="exact: drawn; or bank: looked up in a bank of normals, faster.")
]

#: Procedural scenes that a training validates on.
_VALIDATION_SCENES = 24
#: Packed pixels a side of a picture on a contact sheet, at most.
_SHEET_SIZE = 128


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
    from simulator.capture.prepared_scene import check_noise

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
    simulator = _simulator(weights, device, cache)
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


def sweep(
    raw: Annotated[Path, typer.Argument(help="Any Bayer raw that LibRaw reads.")],
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("sweep"),
    dngs: Annotated[bool, typer.Option(help="Also write the 64 DNGs, full size.")] = False,
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

    _check_depth(depth, weights)
    check_tolerance(tolerance)
    device = torch_device(device)
    source = read_raw(raw)
    make_folder(out)
    scene = _small_scene(Scene.from_raw(source, scene_id=raw.stem), weights, depth, cache)
    sheet = out / "contact_sheet.png"
    save_picture(sheet, contact_sheet(scene, camera=source.camera, seed=seed))
    files = {"contact sheet": sheet}
    if dngs:
        grid, simulator = ExposureGrid.default(), _simulator(weights, device, cache)
        prepared = simulator.prepare(source, depth=depth, tolerance=tolerance)  # type: ignore[arg-type]
        with progress_bars() as progress, progress("DNGs") as task:
            for i, settings in enumerate(grid):
                path = out / f"{raw.stem}-{i:02d}.dng"
                write_dng(path, simulator.simulate(prepared, settings, seed=seed))
                task(i + 1, len(grid))
        files["DNGs"] = out
    print_files(files)


def train_simulator(
    config: Annotated[Path, typer.Argument(help="YAML such as configs/simulator/compact.yaml.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder; by default runs/simulator/NAME-OF-THE-CONFIG.")
    ] = None,
    seed: OwnSeed = None,
    device: Device = "auto",
    tensorboard: Annotated[bool, typer.Option(help="Log to OUT/tensorboard.")] = True,
) -> None:
    """Train the simulator's modules stage by stage; a second run goes on where it was stopped.

    Example: `ae-env train-simulator configs/simulator/compact.yaml`

    Several processes or GPUs: `accelerate launch -m ae_env train-simulator CONFIG`.
    """
    from simulator.training.config import load_config
    from simulator.training.train import train_and_save

    training = load_config(config)
    if seed is not None:
        training = training.model_copy(update={"seed": seed})
    folder = Path("runs/simulator") / config.stem if out is None else out
    make_folder(folder)
    device = torch_device(device)
    with progress_bars() as progress:
        tasks: dict[str, Any] = {}
        with contextlib.ExitStack() as stack:

            def report(name: str, share: float, values: dict[str, float]) -> None:
                if name not in tasks:
                    tasks[name] = stack.enter_context(progress(name))
                tasks[name](share, 1.0, ", ".join(f"{k} {v:.3f}" for k, v in values.items()))

            weights = train_and_save(
                training,
                training_scenes,
                folder / training.preset,
                command=command_line(),
                device=device,
                tensorboard=tensorboard,
                progress=report,
            )
    print_files({"weights": weights, "model card": weights.with_suffix(".json")})
    if training.preset in ("compact", "paper"):
        command = shlex.join(["ae-env", "simulate", "RAW", "--weights", str(weights)])
        console.print(f"next: {command} ...", highlight=False, soft_wrap=True, markup=False)


def training_scenes(config: SimulatorConfig, split: str) -> Sequence[ReferenceScene]:
    """The scenes of a split that a training's configuration names."""
    from ae_env.scenes.reference_scenes import draped_scenes, reference_scenes
    from simulator import get_camera

    radiance = os.path.expandvars(config.scenes.radiance or "")
    if "$" in radiance:
        console.print(f"{config.scenes.radiance} is not set: training without radiance maps")
        radiance = ""
    camera = get_camera(config.camera)
    scenes = reference_scenes(
        split,  # type: ignore[arg-type]
        camera,
        number=config.scenes.procedural if split == "train" else _VALIDATION_SCENES,
        size=config.scenes.size,
        radiance=Path(radiance) if radiance else None,
        seed=config.seed,
    )
    return [*scenes, *draped_scenes(scenes, camera, seed=config.seed)]


def _check_depth(depth: str, weights: str) -> None:
    """Raises a `ValueError` if `depth` is unknown to us, or needs networks that are not there."""
    if depth not in ("far", "unknown"):
        raise ValueError(f"`depth` (={depth!r}) must be 'far' or 'unknown'")
    if depth == "unknown" and weights == "none":
        raise ValueError("`depth` (='unknown') needs networks: leave out `--weights none`")


def _small_scene(scene: Scene, weights: str, depth: str, cache: bool) -> Scene:
    """`scene` at the size of a contact sheet, with what the networks find out about it."""
    from ae_env.scenes.loading import SceneNetworks

    size = min(_SHEET_SIZE, *scene.light.shape[1:])
    if weights == "none":
        return scene.resized(size)
    networks = SceneNetworks(weights, cache=cache)
    small = networks.resized(scene, size) if depth == "unknown" else scene.resized(size)
    return networks.denoised(small)


def _simulator(weights: str, device: str, cache: bool) -> CameraSimulator:
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
