"""Noise of the full output against the noise level function and the reference camera.

Every capture is simulated several times, each from a source photographed anew and with output noise
of its own: the variance between these is the output's noise, what their mean is off the truth is
its bias. The histogram of the residuals, in units of the noise level function's deviation, is
compared with the reference camera's by the Kullback-Leibler divergence.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.simulator.models import Models
from benchmarks.simulator.scenes import FULL, QUICK, Progress, cropped, held_out_scenes
from simulator import (
    CameraProfile,
    CameraSettings,
    CameraSimulator,
    NoiseLevelFunction,
    PreparedScene,
    RawImage,
    get_camera,
)
from simulator.noise.noise_level_function import noise_variance
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene

CAMERAS = ("nikon_z6", "canon_70d")
#: ISO of the targets; the last is beyond both calibrations.
ISOS = (100, 200, 400, 800, 1600, 3200, 6400, 16000)
#: Ways to a target, by what the source is; the last opens the aperture of a defocused scene.
NOISE_FREE, CLEANER, NOISIER, OPENED = (
    "noise-free scene",
    "from ISO 100",
    "from ISO 6400 at 1/4 of the light",
    "f/11 to f/4 at the same ISO",
)
#: Which ways are gone with which scene.
ROUTES = {
    "steps": (NOISE_FREE, CLEANER, NOISIER),
    "scenes": (NOISE_FREE, CLEANER, NOISIER),
    "defocused": (OPENED,),
}
#: Signals of the chart's patches [of white].
_PATCHES = tuple(2.0**stop for stop in (-9, -8, -7, -6, -5, -4, -3, -2, -1))
#: Pixels further from a clip than this many deviations are measured.
_CLEAR = 5.0
#: Bins of the histogram over +-5 deviations; what is beyond is in the outermost.
_BINS, _REACH = 80, 5.0
#: Levels with fewer pixels are left out.
_FEWEST = 200


def measure(
    models: Models, *, seed: int, quick: bool, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """One row per camera, scene, ISO of the target and route, and for the reference camera itself.

    Args:
        models: What is measured; `compact` only.
        seed: Of the noise.
        quick: Few small scenes, ISOs and repeats.
        progress: Called with what is simulated and the share that is done.
    """
    isos, repeats = (ISOS[::6], 3) if quick else (ISOS, 8)
    rows: list[dict[str, Any]] = []
    for number, camera in enumerate(CAMERAS):
        reference = ReferenceCamera(get_camera(camera))
        for index, (kind, scenes) in enumerate(_scenes(camera, quick).items()):
            for step, iso in enumerate(isos):
                if progress is not None:
                    share = (index + step / len(isos)) / len(ROUTES)
                    progress(f"{camera}, {kind}, ISO {iso}", (number + share) / len(CAMERAS))
                photographer = _Photographer(reference, scenes, iso, repeats, seed)
                own: dict[str, tuple[list[Tensor], float | None]] = {
                    "reference": (photographer.reference(1), None)
                }
                for route in ROUTES[kind]:
                    own[route] = photographer.simulated(models.compact, route)
                truth = photographer.truth()
                again = photographer.reference(2)
                for route, (images, spent) in own.items():
                    row = _row(images, again, truth, reference.camera, iso)
                    head = {"part": "noise", "camera": camera, "scene": kind, "iso": iso}
                    if route == NOISIER:
                        row["source_variance_ratio"] = _brought(truth, reference.camera, iso)
                    rows.append({**head, "route": route, "milliseconds": spent, **row})
    return rows


def _scenes(camera: str, quick: bool) -> dict[str, list[ReferenceScene]]:
    """The chart, held-out scenes of natural statistics, and such with something out of focus."""
    crop = (QUICK if quick else FULL)[2]
    known = [cropped(scene, crop) for scene in held_out_scenes(camera, quick=quick)]
    radiance = [s for s in known if s.kind == "radiance"]
    flat = radiance or [s for s in known if s.depth is None]
    profile = ReferenceCamera(get_camera(camera))
    deep = [
        s
        for s in known
        if s.depth is not None and float(profile.blur_diameter(s, 11).quantile(0.5)) >= 1.0
    ]
    count = 1 if quick else 4
    return {
        "steps": [_chart(8 if quick else 16)],
        "scenes": flat[:: max(1, len(flat) // count)][:count],
        "defocused": deep[:count],
    }


def _chart(side: int) -> ReferenceScene:
    """Flat patches, 3 x 3 of them, each 3 `side` pixels a side."""
    patches = torch.tensor(_PATCHES).reshape(3, 3)
    light = patches.repeat_interleave(3 * side, 0).repeat_interleave(3 * side, 1)
    settings = CameraSettings(100, 1.0, 4)
    return ReferenceScene("steps", "steps", "chart", light.expand(4, -1, -1).clone(), settings)


@dataclass(frozen=True)
class _Photographer:
    """Takes captures at one ISO and the scene's own exposure, for real and simulated."""

    camera: ReferenceCamera
    scenes: list[ReferenceScene]
    iso: float
    repeats: int
    seed: int

    def truth(self) -> list[Tensor]:
        """What each scene shows without noise (4, H, W), not clipped."""
        return [self._signal(s, self._target(s)) for s in self.scenes]

    def reference(self, draw: int) -> list[Tensor]:
        """The reference camera's captures of each scene (repeats, 4, H, W)."""
        return [
            torch.stack(
                [
                    self._recorded(signal, self.iso, index, repeat, draw)
                    for repeat in range(self.repeats)
                ]
            )
            for index, signal in enumerate(self.truth())
        ]

    def simulated(self, simulator: CameraSimulator, route: str) -> tuple[list[Tensor], float]:
        """The same from the simulator, and the time of one capture, preparation left out [ms]."""
        images, times = [], []
        for index, scene in enumerate(self.scenes):
            target = self._target(scene)
            own = []
            for repeat in range(self.repeats):
                prepared = self._prepared(simulator, scene, route, index, repeat)
                began = time.perf_counter()
                own.append(prepared.capture(target, self.seed + repeat)[0])
                times.append(1e3 * (time.perf_counter() - began))
            images.append(torch.stack(own))
        return images, float(np.median(times))

    def _prepared(
        self, simulator: CameraSimulator, scene: ReferenceScene, route: str, index: int, repeat: int
    ) -> PreparedScene:
        profile = self.camera.camera
        if route == NOISE_FREE:
            clean = NoiseLevelFunction.zero()
            return simulator.prepare(PreparedScene(scene.light, scene.reference, profile, clean))
        target = self._target(scene)
        source = {
            CLEANER: _at(scene, 100),
            NOISIER: replace(_at(scene, 6400), exposure_time=_at(scene, 6400).exposure_time / 4),
            OPENED: replace(target, exposure_time=target.exposure_time * 8, f_number=11),
        }[route]
        data = self._recorded(self._signal(scene, source), source.iso, index, repeat, 0)
        raw = RawImage(data, source, profile)
        return simulator.prepare(raw, depth="unknown" if route == OPENED else "far")

    def _target(self, scene: ReferenceScene) -> CameraSettings:
        return _at(scene, self.iso)

    def _signal(self, scene: ReferenceScene, settings: CameraSettings) -> Tensor:
        light = _blurred_light(self.camera, scene, settings.f_number)
        return self.camera.expose(light, scene.reference, settings)

    def _recorded(self, signal: Tensor, iso: float, index: int, repeat: int, draw: int) -> Tensor:
        words = [self.seed, index, repeat, draw]
        state = np.random.SeedSequence(words).generate_state(1)[0]
        return self.camera.record(signal, iso, torch.Generator().manual_seed(int(state)))


@functools.lru_cache(maxsize=32)
def _blurred_light(camera: ReferenceCamera, scene: ReferenceScene, f_number: float) -> Tensor:
    return camera.blurred_light(scene, f_number)


def _at(scene: ReferenceScene, iso: float) -> CameraSettings:
    """The scene's reference exposure, at `iso` and with a shorter time."""
    time = scene.reference.exposure_time * scene.reference.iso / iso
    return replace(scene.reference, iso=iso, exposure_time=time)


def _brought(truth: list[Tensor], camera: CameraProfile, iso: float) -> float:
    """Noise variance that the noisier source brings, over the target's, all pixels together."""
    noisier = camera.nlf(6400).exposed(4.0)
    signal = torch.cat([image.clamp(max=1.0).flatten(1) for image in truth], dim=1)[:, :, None]
    brought, wanted = (noise_variance(signal, nlf).sum() for nlf in (noisier, camera.nlf(iso)))
    return float(brought / wanted)


def _row(
    captures: list[Tensor],
    again: list[Tensor],
    truth: list[Tensor],
    camera: CameraProfile,
    iso: float,
) -> dict[str, Any]:
    """Variance, bias and histogram of `captures` over the pixels that are clear of both clips."""
    nlf = camera.nlf(iso)
    signals, variances, wanted, offsets, residuals, references = [], [], [], [], [], []
    pedestal = torch.tensor(camera.pedestal)[:, None, None]
    for images, others, signal in zip(captures, again, truth, strict=True):
        expected = noise_variance(signal, nlf)
        sigma = expected.sqrt()
        clear = (signal + _CLEAR * sigma < 1.0) & (signal - _CLEAR * sigma > -pedestal)
        signals.append(signal[clear])
        wanted.append(expected[clear])
        variances.append(images.double().var(dim=0)[clear])
        offsets.append(((images.double().mean(dim=0) - signal) / sigma)[clear])
        residuals.append(((images - signal) / sigma)[:, clear].flatten())
        references.append(((others - signal) / sigma)[:, clear].flatten())
    level, variance, expected, offset = map(torch.cat, (signals, variances, wanted, offsets))
    levels = list(_levels(level, variance, expected, offset, len(captures[0])))
    return {
        "levels": levels,
        "variance_ratio": float(variance.sum() / expected.sum()),
        "variance_ratio_lowest": min(v["variance_ratio"] for v in levels),
        "variance_ratio_highest": max(v["variance_ratio"] for v in levels),
        "kl": _divergence(torch.cat(references), torch.cat(residuals)),
        "extrapolated": nlf.extrapolated,
    }


def _levels(
    level: Tensor, variance: Tensor, expected: Tensor, offset: Tensor, repeats: int
) -> Iterator[dict[str, Any]]:
    """Per octave of the signal: variance over the NLF's, and the mean's error in deviations."""
    octave = torch.log2(level.clamp(min=2.0**-12)).round()
    for value in octave.unique().tolist():
        own = octave == value
        if int(own.sum()) < _FEWEST:
            continue
        ratio = float(variance[own].sum() / expected[own].sum())
        # What the noise of a mean of few captures adds is not bias.
        squared = float(offset[own].square().mean()) - ratio / repeats
        yield {
            "signal": 2.0**value,
            "pixels": int(own.sum()),
            "variance_ratio": ratio,
            "mean_error": float(offset[own].mean()),
            "bias_rms": max(0.0, squared) ** 0.5,
        }


def _divergence(reference: Tensor, simulated: Tensor) -> float:
    """Kullback-Leibler divergence KL(reference || simulated) of two residual histograms [nats]."""
    edges = np.linspace(-_REACH, _REACH, _BINS + 1)
    inside = np.nextafter(_REACH, 0.0)
    counts = [
        np.histogram(v.numpy().clip(-inside, inside), edges)[0] + 0.5
        for v in (reference, simulated)
    ]
    p, q = (c / c.sum() for c in counts)
    return float((p * np.log(p / q)).sum())


# -- report ---------------------------------------------------------------------------------------


def section(rows: list[dict[str, Any]]) -> str:
    """Markdown: variance over the NLF, bias and divergence by ISO, for every way to the target."""
    lines = [
        "`compact`, simulated several times from sources photographed anew. *Steps*: flat patches "
        "from 2^-9 to 1/2 of white; *scenes*: held-out radiance maps (procedural ones where those "
        "are missing); *defocused*: procedural scenes with depth, photographed at f/11. Only "
        f"pixels {_CLEAR:g} deviations clear of both clips count. ISO 16000 is extrapolated. A "
        "denoiser's output is not free of noise: *source* is the variance, over the target's, that "
        "the noisier source brings and that would remain without it.",
    ]
    cameras = dict.fromkeys(r["camera"] for r in rows)
    for camera in cameras:
        own = [r for r in rows if r["camera"] == camera]
        for title, cell in (
            ("variance over the noise level function, lowest to highest octave of signal", _ratio),
            ("largest RMS error of the mean over the octaves, in deviations of the noise", _bias),
            ("KL divergence of the residuals from the reference camera's, x 1000", _kl),
        ):
            lines += ["", f"### {camera}: {title}", "", *_table(own, cell)]
    times = [r["milliseconds"] for r in rows if r["milliseconds"] is not None]
    lines += [
        "",
        "The columns *reference* are the reference camera against itself: what chance alone makes. "
        f"A capture takes {np.median(times):.2f} ms (median), preparation left out.",
    ]
    return "\n".join(lines)


def _table(rows: list[dict[str, Any]], cell: Any) -> list[str]:
    columns = list(dict.fromkeys((r["scene"], r["route"]) for r in rows))
    lines = [
        "| ISO | " + " | ".join(f"{scene}: {route}" for scene, route in columns) + " |",
        "|--:" + "|--:" * len(columns) + "|",
    ]
    for iso in dict.fromkeys(r["iso"] for r in rows):
        by_column = {(r["scene"], r["route"]): r for r in rows if r["iso"] == iso}
        cells = [cell(by_column[c]) if c in by_column else "" for c in columns]
        lines.append(f"| {iso} | {' | '.join(cells)} |")
    return lines


def _ratio(row: dict[str, Any]) -> str:
    text = f"{row['variance_ratio_lowest']:.2f} to {row['variance_ratio_highest']:.2f}"
    brought = row.get("source_variance_ratio")
    return text if brought is None else f"{text} (source {brought:.0f})"


def _bias(row: dict[str, Any]) -> str:
    return f"{max(v['bias_rms'] for v in row['levels']):.2f}"


def _kl(row: dict[str, Any]) -> str:
    return f"{1e3 * row['kl']:.2f}"
