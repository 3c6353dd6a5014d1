"""Shallow depth of field from one raw at f/11, against a thin lens that is opened for real."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pandas as pd
import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from torch import Tensor

from agents.applications.refocus import refocus
from benchmarks.fidelity.models import equal_exposure, weights
from benchmarks.harness import Part, Report, Row, benchmark, clipped, psnr, side_by_side, table
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera, render_srgb
from simulator.optics.discs import DiscBank, added_blur
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene
from simulator.training.scenes import depth_photographs
from simulator.utils.files import data_folder

CAMERA, F_SOURCE = "nikon_z6", 11.0
ISOS, F_NUMBERS = (100, 1600), (4.0, 2.8, 2.0, 1.4)
#: Step of the circle of confusion at f/4 between neighbours that is a depth edge [packed pixel],
#: and how far from one an error counts as at the edge.
EDGE_STEP, EDGE_MARGIN = 2.0, 8
METHODS = {
    "none": "no change",
    "paper": "paper's module, depth unknown",
    "plain unknown": "plain blur, depth unknown",
    "ours unknown": "**refocus, depth unknown**",
    "plain given": "plain blur, depth given",
    "ours given": "**refocus, depth given**",
}


@torch.no_grad()
def measure(number: int, seed: int, quick: bool) -> list[Row]:
    camera = get_camera(CAMERA)
    scene = depth_photographs(camera, data=data_folder())[number]
    reference = ReferenceCamera(camera)
    simulator = CameraSimulator.from_pretrained("large", cache=None)
    rows, edges = [], _edges(reference, scene)
    f_numbers = F_NUMBERS[-1:] if quick else F_NUMBERS
    light = {n: reference.blurred_light(scene, n) for n in f_numbers}
    for iso in ISOS[:1] if quick else ISOS:
        source = reference.capture(scene, equal_exposure(scene.reference, iso, F_SOURCE), seed)
        raw = RawImage(source.sample, source.settings, camera)
        for f_number in f_numbers:
            settings = equal_exposure(scene.reference, iso, f_number)
            truth = reference.capture(scene, settings, seed, light=light[f_number]).mean
            for method, opened in _methods(raw, scene, f_number, simulator, seed).items():
                begun = time.perf_counter()
                picture = clipped(opened(), camera)
                seconds = time.perf_counter() - begun
                row: Row = {"scene": scene.scene_id, "iso": iso, "f_number": f_number}
                row |= {"method": method, "psnr": psnr(picture, truth), "seconds": seconds}
                rows.append(row | {"edge_psnr": psnr(picture[:, edges], truth[:, edges])})
    return rows


def _edges(reference: ReferenceCamera, scene: ReferenceScene) -> Tensor:
    """(H, W) bool, pixels near a step of depth."""
    # Private: which side of the plane of focus a pixel is on is nowhere else.
    diameter = F.avg_pool2d(reference._signed_diameter(scene, 4.0)[None], 2)[0] / 2.0
    steps = torch.zeros_like(diameter)
    steps[1:] = diameter.diff(dim=0).abs()
    steps[:, 1:] = torch.maximum(steps[:, 1:], diameter.diff(dim=1).abs())
    edges = (steps > EDGE_STEP).double()[None]
    return F.max_pool2d(edges, 2 * EDGE_MARGIN + 1, 1, EDGE_MARGIN)[0] > 0


def _methods(
    raw: RawImage, scene: ReferenceScene, f_number: float, simulator: CameraSimulator, seed: int
) -> dict[str, Callable[[], Tensor]]:
    """Each method as a function that makes the picture (4, H, W) and takes all of its time."""
    assert scene.depth is not None
    metres, lens = scene.depth.numpy(), scene.lens
    source, target = (
        CameraSettings(raw.settings.iso, 1.0, n).effective_f_number for n in (F_SOURCE, f_number)
    )

    def denoised() -> tuple[Any, Tensor]:
        prepared = simulator.prepare(raw, tolerance=0.0)
        return prepared, prepared.denoised_lights[-1].light

    def plain(diameter: Tensor, light: Tensor) -> Tensor:
        return DiscBank(light).blurred(added_blur(diameter, source, target).float())

    def plain_given() -> Tensor:
        assert raw.camera.pixel_pitch_um is not None
        blur = lens.circle_of_confusion(torch.from_numpy(metres).double(), source)
        packed = F.avg_pool2d(blur[None], 2)[0] / (2e-6 * raw.camera.pixel_pitch_um)
        return plain(packed.abs(), denoised()[1])

    def plain_unknown() -> Tensor:
        prepared, light = denoised()
        return plain(simulator.estimate_defocus(prepared), light)

    def ours(**depth: Any) -> Tensor:
        return refocus(raw, f_number, simulator=simulator, seed=seed, **depth).data

    methods: dict[str, Callable[[], Tensor]] = {"none": lambda: raw.data}
    if (path := weights("paper")) is not None:
        aperture: Any = CameraSimulator.from_pretrained(path, cache=None).aperture

        def paper() -> Tensor:
            light = denoised()[1][None]
            f_numbers = (torch.tensor([n], dtype=torch.float32) for n in (source, target))
            opened: Tensor = aperture(light, torch.zeros_like(light), *f_numbers)[0]
            return opened

        methods["paper"] = paper
    return methods | {
        "plain unknown": plain_unknown,
        "ours unknown": ours,
        "plain given": plain_given,
        "ours given": lambda: ours(depth=metres, lens=lens),
    }


@torch.no_grad()
def picture(seed: int) -> Figure:
    camera, iso, f_number = get_camera(CAMERA), ISOS[0], F_NUMBERS[-1]
    scene = depth_photographs(camera, data=data_folder())[0]
    reference = ReferenceCamera(camera)
    settings = equal_exposure(scene.reference, iso, F_SOURCE)
    sample = reference.capture(scene, settings, seed).sample
    raw = RawImage(sample, settings, camera, white_balance=scene.white_balance)
    simulator = CameraSimulator.from_pretrained("large", cache=None)
    methods = _methods(raw, scene, f_number, simulator, seed)
    truth = reference.capture(scene, equal_exposure(scene.reference, iso, f_number), seed).mean
    shown = {
        f"the raw, f/{F_SOURCE:g}": sample,
        f"f/{f_number:g}, depth estimated": methods["ours unknown"](),
        f"f/{f_number:g}, depth given": methods["ours given"](),
        f"f/{f_number:g}, thin lens": truth,
    }
    pictures = {name: render_srgb(replace(raw, data=data)) for name, data in shown.items()}
    return side_by_side(pictures)


def parts(seed: int, quick: bool) -> list[Part]:
    count = len(depth_photographs(get_camera(CAMERA), data=data_folder()))
    numbers = range(0, count, 2 if quick else 1)
    return [Part(f"scene {n}", measure, {"number": n}, threads=1) for n in numbers]


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows: list[Row] = [row for part in results.values() for row in part]
    groups = pd.DataFrame(rows).groupby(["method", "iso", "f_number"], sort=False)
    frame = groups[["psnr", "edge_psnr"]].mean().reset_index()
    seconds = pd.DataFrame(rows).groupby(["method", "iso"])["seconds"].median()
    means: list[Row] = []
    for (method, iso), own in frame.groupby(["method", "iso"], sort=False):
        mean: Row = {"method": METHODS[str(method)], "iso": iso}
        mean["seconds"] = seconds.get((method, iso))
        for n, whole, edge in own[["f_number", "psnr", "edge_psnr"]].to_numpy():
            mean |= {f"psnr {n:g}": whole, f"edge_psnr {n:g}": edge}
        means.append(mean)
    means.sort(key=lambda row: (list(METHODS.values()).index(row["method"]), row["iso"]))
    columns = {"method": "{method:md}", "ISO": "{iso}"}
    for name in (f"{f_number:g}" for f_number in F_NUMBERS):
        columns[f"f/{name}"] = f"{{psnr {name}:.1f}} / {{edge_psnr {name}:.1f}}"
    tables = {"psnr": table(means, columns | {"seconds": "{seconds:.2f}"})}
    return Report([*rows, *means], tables, figures={"refocus.webp": picture(meta["seed"])})


run = benchmark("refocus", parts, report)
