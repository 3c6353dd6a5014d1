"""HDR from one raw of a radiance map, against the map's own light, fused alike."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from torch import Tensor

from agents.applications.hdr import bracket_exposures, expose_and_develop, fuse, hdr_picture
from benchmarks.fidelity.models import equal_exposure, radiance_views
from benchmarks.harness import Part, Report, Row, benchmark, pivot, psnr, side_by_side, ssim, table
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene

CAMERA, F_NUMBER = "nikon_z6", 8.0
ISOS = (100, 1600, 6400)
#: Side of a view [packed pixel].
SIZE = 128
#: Range of the light [stops] from which a scene counts as of high dynamic range.
HIGH_RANGE = 10.0
#: Light below this is left out of the error of radiance, relative to the raw's white.
DARKEST = 2.0**-8
METHODS = {
    "single": "the raw, developed",
    "scaled": "one raw, its noise kept, Lee",
    "ours": "**one raw, `ae-env hdr`, Lee**",
    "bracket": "17 captures, Lee",
    "merged": "17 captures merged at least noise, Lee",
}


def _view(
    reference: ReferenceCamera, scene: ReferenceScene, iso: int
) -> tuple[CameraSettings, Tensor, Tensor]:
    """Settings that expose `scene` properly, its light behind the lens, and that light exposed."""
    settings = equal_exposure(scene.reference, iso, F_NUMBER)
    light = reference.blurred_light(scene, F_NUMBER)
    return settings, light, reference.expose(light, scene.reference, settings)


@torch.no_grad()
def measure(iso: int, seed: int, quick: bool) -> list[Row]:
    reference = ReferenceCamera(get_camera(CAMERA))
    simulator = CameraSimulator.from_pretrained("large", cache=None)
    exposures, rows = bracket_exposures(), []
    for scene in radiance_views(CAMERA, SIZE)[: 2 if quick else None]:
        settings, light, unclipped = _view(reference, scene, iso)
        times = [settings.exposure_time * 2.0**ev for ev in exposures]
        states = [replace(settings, exposure_time=seconds) for seconds in times]
        captures = [reference.capture(scene, s, seed, light=light).sample for s in states]
        look: Any = {"white_balance": scene.white_balance}
        raw = RawImage(captures[exposures.index(0.0)], settings, reference.camera, **look)
        begun = time.perf_counter()
        ours = hdr_picture(raw, simulator=simulator)
        seconds = time.perf_counter() - begun
        merged = _merged(captures, exposures, raw)
        taken = [expose_and_develop(replace(raw, data=capture)) for capture in captures]
        right = _simulated(replace(raw, data=unclipped))
        wanted = fuse(right)
        pictures = {
            "single": expose_and_develop(raw),
            "scaled": fuse(_simulated(raw)),
            "ours": ours.fused,
            "bracket": fuse(taken),
            "merged": fuse(_simulated(replace(raw, data=merged))),
        }
        lights = {"single": raw.data, "ours": ours.radiance, "merged": merged}
        low, high = np.quantile(unclipped.clamp(min=1e-9).numpy(), [0.001, 0.999])
        for method, picture in pictures.items():
            row: Row = {"scene": scene.scene_id, "group": scene.group, "iso": iso}
            row |= {"stops": float(np.log2(high / low)), "method": method}
            row |= {"psnr": psnr(picture, wanted), "ssim": ssim(picture.numpy(), wanted.numpy())}
            if method in lights:
                row["radiance_ev"] = _radiance_error(lights[method], unclipped)
            rows.append(row | ({"seconds": seconds} if method == "ours" else {}))
    return rows


def _simulated(raw: RawImage) -> list[Tensor]:
    """The bracket of one raw, developed."""
    return [expose_and_develop(raw, ev) for ev in bracket_exposures()]


@torch.no_grad()
def picture(seed: int, quick: bool) -> Figure:
    reference, iso, found = ReferenceCamera(get_camera(CAMERA)), ISOS[1], []
    for scene in radiance_views(CAMERA, SIZE)[: 2 if quick else None]:
        settings, _, unclipped = _view(reference, scene, iso)
        dark, bright = (float(s.double().mean()) for s in (unclipped < 2.0**-6, unclipped > 1.0))
        found.append((min(dark, 10.0 * bright), scene, settings, unclipped))
    _, scene, settings, unclipped = max(found, key=lambda entry: entry[0])
    sample = reference.capture(scene, settings, seed).sample
    raw = RawImage(sample, settings, reference.camera, white_balance=scene.white_balance)
    simulator = CameraSimulator.from_pretrained("large", cache=None)
    pictures = {
        f"the raw, developed (ISO {iso})": expose_and_develop(raw),
        "its noise kept, fused": fuse(_simulated(raw)),
        "ae-env hdr": hdr_picture(raw, simulator=simulator).fused,
        "the map's own light, fused": fuse(_simulated(replace(raw, data=unclipped))),
    }
    return side_by_side(pictures)


def _merged(captures: Sequence[Tensor], exposures: Sequence[float], raw: RawImage) -> Tensor:
    """Radiance of real captures: exposure^2 over variance of all that are not saturated."""
    shot, read = (torch.tensor(v)[:, None, None] for v in (raw.noise.shot, raw.noise.read))
    total, weights = torch.zeros_like(captures[0]), torch.zeros_like(captures[0])
    for capture, ev in zip(captures, exposures, strict=True):
        ratio, variance = 2.0**ev, shot * capture.clamp(min=0.0) + read
        weight = torch.where(capture < 0.99, ratio**2 / variance, 0.0)
        total, weights = total + weight * capture / ratio, weights + weight
    darkest = captures[0] / 2.0 ** exposures[0]
    return torch.where(weights > 0, total / weights.clamp(min=1e-12), darkest)


def _radiance_error(light: Tensor, truth: Tensor) -> float:
    """Root mean square error of log2 of the light [EV], where it is not too dark."""
    shown = truth > DARKEST
    error = light[shown].clamp(min=2.0**-12).log2() - truth[shown].log2()
    return float(error.double().square().mean().sqrt())


def parts(seed: int, quick: bool) -> list[Part]:
    isos = ISOS[1:2] if quick else ISOS
    return [Part(f"ISO {iso}", measure, {"iso": iso}, threads=1) for iso in isos]


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows: list[Row] = [row for part in results.values() for row in part]
    frame = pd.DataFrame(rows)
    frame["range"] = np.where(frame["stops"] < HIGH_RANGE, "low", "high")
    groups = frame.groupby(["iso", "range", "method"])
    means = groups[["psnr", "ssim", "radiance_ev"]].mean().assign(scenes=groups.size())
    means = means.reindex([*METHODS], level="method").reindex(["low", "high"], level="range")
    shown = means.reset_index().assign(label=lambda f: f["method"].map(METHODS)).to_dict("records")
    lit = [row for row in shown if not np.isnan(row["radiance_ev"])]
    group, seconds = "ISO {iso} {range}", {"seconds": frame["seconds"].median()}
    tables = {
        "pictures": pivot(shown, "picture = {label:md}", group, "{psnr:.1f} / {ssim:.3f}"),
        "radiance": pivot(lit, "light = {label:md}", group, "{radiance_ev:.3f}"),
        "time": table([seconds], "`ae-env hdr`'s own part, one core [s a view] = {seconds:.2f}"),
    }
    figure = picture(meta["seed"], meta["quick"])
    return Report([*rows, *shown], tables, figures={"hdr.webp": figure})


run = benchmark("hdr", parts, report)
