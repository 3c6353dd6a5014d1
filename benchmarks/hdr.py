"""HDR from one raw of a radiance map, against the map's own light, fused alike."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from skimage.metrics import structural_similarity
from torch import Tensor

from agents.applications.hdr import (
    bracket_exposures,
    expose_and_develop,
    fuse,
    hdr_picture,
)
from benchmarks.fidelity.defocus import equal_exposure
from benchmarks.fidelity.models import checksums
from benchmarks.harness import Benchmark, Part, Report, Row, data_root, psnr, side_by_side, table
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera
from simulator.reference.camera import ReferenceCamera, ReferenceScene
from simulator.training.scenes import reference_scenes

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
    "ours mertens": "one raw, `ae-env hdr`'s bracket, Mertens",
    "bracket mertens": "17 captures, Mertens",
}


def _scenes(quick: bool) -> list[ReferenceScene]:
    """Views of held-out radiance maps, one of each."""
    scenes = reference_scenes("test", get_camera(CAMERA), number=0, size=SIZE, data=data_root())
    groups = {s.group: s for s in reversed(scenes) if s.kind == "radiance" and s.pitch == 2}
    return list(groups.values())[: 2 if quick else None]


def _view(
    reference: ReferenceCamera, scene: ReferenceScene, iso: int
) -> tuple[CameraSettings, Tensor, Tensor]:
    """Settings that expose `scene` properly, its light behind the lens, and that light exposed."""
    settings = equal_exposure(scene.reference, iso, F_NUMBER)
    light = reference.blurred_light(scene, F_NUMBER)
    return settings, light, reference.expose(light, scene.reference, settings)


@torch.no_grad()
def measure(iso: int, seed: int, quick: bool) -> list[Row]:
    """All scenes at one ISO."""
    camera = get_camera(CAMERA)
    reference = ReferenceCamera(camera)
    simulator = CameraSimulator.from_pretrained("large", cache=None)
    exposures, rows = bracket_exposures(), []
    for scene in _scenes(quick):
        settings, light, unclipped = _view(reference, scene, iso)
        look = {"white_balance": scene.white_balance}
        truth = RawImage(unclipped, settings, camera, **look)
        captures = [
            reference.capture(
                scene,
                replace(settings, exposure_time=settings.exposure_time * 2.0**ev),
                seed,
                light=light,
            ).sample
            for ev in exposures
        ]
        raw = RawImage(captures[exposures.index(0.0)], settings, camera, **look)
        begun = time.perf_counter()
        ours = hdr_picture(raw, simulator=simulator)
        seconds = time.perf_counter() - begun
        merged = _merged(captures, exposures, raw)
        taken = [expose_and_develop(replace(raw, data=capture)) for capture in captures]
        mine = [expose_and_develop(replace(raw, data=ours.radiance), ev) for ev in exposures]
        right = [expose_and_develop(truth, ev) for ev in exposures]
        fused, mertens = fuse(right), _mertens(right)
        pictures = {
            "single": (expose_and_develop(raw), fused),
            "scaled": (fuse([expose_and_develop(raw, ev) for ev in exposures]), fused),
            "ours": (ours.fused, fused),
            "bracket": (fuse(taken), fused),
            "merged": (
                fuse([expose_and_develop(replace(raw, data=merged), ev) for ev in exposures]),
                fused,
            ),
            "ours mertens": (_mertens(mine), mertens),
            "bracket mertens": (_mertens(taken), mertens),
        }
        lights = {"single": raw.data, "ours": ours.radiance, "merged": merged}
        low, high = np.quantile(unclipped.clamp(min=1e-9).numpy(), [0.001, 0.999])
        for method, (picture, wanted) in pictures.items():
            row: Row = {"scene": scene.scene_id, "group": scene.group, "iso": iso}
            row |= {"stops": float(np.log2(high / low)), "method": method}
            row |= {"psnr": psnr(picture, wanted), "ssim": _ssim(picture, wanted)}
            if method in lights:
                row["radiance_ev"] = _radiance_error(lights[method], unclipped)
            rows.append(row | ({"seconds": seconds} if method == "ours" else {}))
    return rows


@torch.no_grad()
def picture(seed: int, quick: bool) -> Figure:
    """The scene with the most light above the raw's white."""
    camera, iso = get_camera(CAMERA), ISOS[1]
    reference, found = ReferenceCamera(camera), []
    for scene in _scenes(quick):
        settings, _, unclipped = _view(reference, scene, iso)
        dark, bright = (float(s.double().mean()) for s in (unclipped < 2.0**-6, unclipped > 1.0))
        found.append((min(dark, 10.0 * bright), scene, settings, unclipped))
    _, scene, settings, unclipped = max(found, key=lambda entry: entry[0])
    look = {"white_balance": scene.white_balance}
    raw = RawImage(reference.capture(scene, settings, seed).sample, settings, camera, **look)
    simulator = CameraSimulator.from_pretrained("large", cache=None)
    right = [expose_and_develop(replace(raw, data=unclipped), ev) for ev in bracket_exposures()]
    return side_by_side(
        {
            f"the raw, developed (ISO {iso})": expose_and_develop(raw),
            "its noise kept, fused": fuse(
                [expose_and_develop(raw, ev) for ev in bracket_exposures()]
            ),
            "ae-env hdr": hdr_picture(raw, simulator=simulator).fused,
            "the map's own light, fused": fuse(right),
        }
    )


def _merged(captures: Sequence[Tensor], exposures: Sequence[float], raw: RawImage) -> Tensor:
    """Radiance of real captures: exposure^2 over variance of all that are not saturated."""
    shot, read = (torch.tensor(v)[:, None, None] for v in (raw.noise.shot, raw.noise.read))
    total, weights = torch.zeros_like(captures[0]), torch.zeros_like(captures[0])
    for capture, ev in zip(captures, exposures, strict=True):
        ratio = 2.0**ev
        variance = shot * capture.clamp(min=0.0) + read
        weight = torch.where(capture < 0.99, ratio**2 / variance, 0.0)
        total, weights = total + weight * capture / ratio, weights + weight
    darkest = captures[0] / 2.0 ** exposures[0]
    return torch.where(weights > 0, total / weights.clamp(min=1e-12), darkest)


def _mertens(pictures: Sequence[Tensor]) -> Tensor:
    import cv2

    codes = [p.mul(255.0).round().byte().permute(1, 2, 0).numpy() for p in pictures]
    fused = cv2.createMergeMertens().process(codes)
    return torch.from_numpy(fused).permute(2, 0, 1).clamp(0.0, 1.0)


def _ssim(picture: Tensor, wanted: Tensor) -> float:
    pair = picture.numpy(), wanted.numpy()
    return float(structural_similarity(*pair, channel_axis=0, data_range=1.0))


def _radiance_error(light: Tensor, truth: Tensor) -> float:
    """Root mean square error of log2 of the light [EV], where it is not too dark."""
    shown = truth > DARKEST
    error = light[shown].clamp(min=2.0**-12).log2() - truth[shown].log2()
    return float(error.double().square().mean().sqrt())


def parts(seed: int, quick: bool) -> list[Part]:
    """One part for each ISO."""
    isos = ISOS[1:2] if quick else ISOS
    return [
        Part(
            f"ISO {iso}",
            measure,
            {"iso": iso, "seed": seed, "quick": quick},
            threads=1,
            depends=checksums("large"),
        )
        for iso in isos
    ]


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """Means over the scenes, by ISO, and by the range of the light."""
    rows: list[Row] = [row for part in results.values() for row in part]
    frame = pd.DataFrame(rows)
    frame["method"] = pd.Categorical(frame["method"], list(METHODS))
    frame["range"] = pd.cut(
        frame["stops"], [-np.inf, HIGH_RANGE, np.inf], right=False, labels=["low", "high"]
    )
    means: dict[str, Row] = {label: {"method": label} for label in METHODS.values()}
    groups = frame.groupby(["iso", "range", "method"], observed=True)
    pictures: dict[str, Any] = {"picture": lambda row: row["method"]}
    errors: dict[str, Any] = {"light": lambda row: row["method"]}
    for (iso, level, method), own in groups:
        key, mean = f"ISO {iso} {level}", means[METHODS[str(method)]]
        for name in ("psnr", "ssim", "radiance_ev"):
            mean[f"{key} {name}"] = own[name].mean()
        mean[f"{key} scenes"] = len(own)
        pictures[key] = f"{{{key} psnr:.1f}} / {{{key} ssim:.3f}}"
        errors[key] = f"{{{key} radiance_ev:.3f}}"
    with_light = frame.dropna(subset="radiance_ev")["method"].unique()
    seconds = {"seconds": frame["seconds"].median()}
    tables = {
        "pictures": table(means.values(), pictures),
        "radiance": table((means[METHODS[method]] for method in with_light), errors),
        "time": table([seconds], {"`ae-env hdr`'s own part, one core [s a view]": "{seconds:.2f}"}),
    }
    figure = picture(meta["seed"], meta["quick"])
    return Report([*rows, *means.values()], tables, figures={"hdr.webp": figure})


BENCHMARK = Benchmark(
    name="hdr",
    title="HDR from one raw",
    parts=parts,
    report=report,
    code=("agents/applications", "benchmarks/hdr"),
)
run = BENCHMARK.run
