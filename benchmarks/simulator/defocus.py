"""Opening the aperture from f/11 to f/4: error by size of the circle of confusion, and time.

The source is a noisy capture at f/11, the truth the noise-free mean at f/4 and the same exposure,
with the reference camera's occlusion-aware defocus. Errors are pooled over the pixels of a class
(`benchmarks.simulator.depth_views`) in held-out procedural scenes, and in each of the photographs
with measured depth. Photographs and radiance maps without depth are in focus throughout: they say
how much is blurred that should not be.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from ae_env.scenes.reference_scenes import depth_photographs, reference_scenes
from benchmarks.simulator.depth_views import (
    BORDER,
    CLASSES,
    CLIP_MARGIN,
    DEPTH_STEP,
    F_TARGET,
    FOCUS_MARGIN,
    IN_FOCUS,
    ISOS,
    View,
    make_views,
)
from benchmarks.simulator.scenes import Progress, clipped, data_root
from simulator import RawImage, get_camera
from simulator.networks.aperture_module import ApertureModule
from simulator.networks.noise_module import NoiseModule, smoothed, variance_map
from simulator.optics.disc_bank import DiscBank, added_blur

if TYPE_CHECKING:
    from benchmarks.simulator.models import Models

CAMERA = "nikon_z6"
#: Procedural groups, of which three quarters have depth, and their height and width [pixel].
GROUPS, SIZE = 32, 256
QUICK_GROUPS, QUICK_SIZE = 8, 128
#: What counts by scene counts scenes with as many pixels of the class, or in focus.
FEWEST_PIXELS = 500
#: Height and width of the raw that is timed [pixel], and runs of each step.
TIMED_SIZE, REPEATS = 128, 15


def measure(
    models: Models, *, seed: int, quick: bool, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """Rows of kind ``"error"``, ``"change"`` and ``"time"``.

    Args:
        models: Both presets; the paper's may be missing.
        seed: Of the captures' noise.
        quick: A few small scenes, and one focus of each photograph.
        progress: Called before every scene.
    """
    camera = get_camera(CAMERA)
    groups, size = (QUICK_GROUPS, QUICK_SIZE) if quick else (GROUPS, SIZE)
    scenes = reference_scenes("test", camera, number=groups, size=size, radiance=data_root())
    scenes = [scene for scene in scenes if scene.kind in ("depth", "photograph", "radiance")]
    photographs = depth_photographs(camera, data=data_root())
    if quick:
        scenes, photographs = scenes[::4], photographs[::2]
    views = make_views([*scenes, *photographs], camera, seed=seed)
    modules = Modules.of(models.compact)
    paper = None if models.paper is None else Modules.of(models.paper)
    rows = defocus_errors(modules, views, paper=paper, progress=progress)
    return rows + time_rows(modules, views, paper, 3 if quick else REPEATS)


@dataclass(frozen=True, eq=False)
class Modules:
    """An aperture module, and the noise module before it; None leaves the source's noise in."""

    aperture: ApertureModule
    noise: NoiseModule | None

    @classmethod
    def of(cls, simulator: Any) -> Modules:
        """Those of a `CameraSimulator`."""
        return cls(simulator.aperture, simulator.noise)

    def denoised(self, source: RawImage) -> tuple[Tensor, Tensor]:
        """(1, 4, H, W) the source with little noise, and the deviation of what was removed."""
        exposed = source.data[None]
        if self.noise is not None and self.noise.preset == "paper":
            exposed = exposed.clamp(0.0, 1.0)
        shot, read = (torch.tensor([v]) for v in (source.noise.shot, source.noise.read))
        clean = exposed if self.noise is None else self.noise(exposed, shot, read)
        return clean, variance_map(smoothed(exposed), shot, read).sqrt()

    def opened(self, clean: Tensor, deviation: Tensor, f_number: float) -> Tensor:
        """(1, 4, H, W) at f/4."""
        f_numbers = torch.tensor([[f_number], [F_TARGET]])
        return self.aperture(clean, deviation, *f_numbers)


@dataclass
class _Pool:
    """What is pooled of one set of scenes at one ISO."""

    pixels: dict[str, int] = field(default_factory=lambda: dict.fromkeys(CLASSES, 0))
    squares: dict[str, dict[str, float]] = field(default_factory=lambda: {n: {} for n in CLASSES})
    by_scene: dict[str, list[float]] = field(default_factory=lambda: {n: [] for n in CLASSES})
    map_errors: dict[str, list[Tensor]] = field(default_factory=lambda: {n: [] for n in CLASSES})
    changes: dict[str, list[float]] = field(default_factory=dict)  # one per scene in focus

    def add_errors(self, view: View, images: dict[str, Tensor], diameter: Tensor) -> None:
        """Squared errors of `images`, and errors of the estimated `diameter` (H, W)."""
        camera = view.sources[ISOS[0]].camera
        errors = {
            name: (clipped(image, camera) - view.target).double().square().sum(dim=0)
            for name, image in images.items()
        }
        for name, mask in view.classes.items():
            self.pixels[name] += int(mask.sum())
            sums = self.squares[name]
            own = {variant: float(error[mask].sum()) for variant, error in errors.items()}
            for variant, square in own.items():
                sums[variant] = sums.get(variant, 0.0) + square
            if int(mask.sum()) >= FEWEST_PIXELS:
                self.by_scene[name].append((own["full"] / own["exp"]) ** 0.5)
            self.map_errors[name].append((diameter - view.diameter)[mask])

    def add_changes(self, view: View, changes: dict[str, Tensor]) -> None:
        """RMS change where nothing is out of focus, over the RMS noise at the lowest ISO."""
        mask = view.in_focus
        if int(mask.sum()) < FEWEST_PIXELS:
            return
        nlf = view.sources[ISOS[0]].noise
        shot, read = (torch.tensor([v]) for v in (nlf.shot, nlf.read))
        noise = float(variance_map(view.target[None], shot, read)[0][:, mask].mean())
        for name, change in changes.items():
            ratio = float(change[:, mask].square().mean() / noise) ** 0.5
            self.changes.setdefault(name, []).append(ratio)


@torch.no_grad()
def defocus_errors(
    modules: Modules,
    views: Sequence[View],
    *,
    paper: Modules | None = None,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Errors by class, and the change where nothing is out of focus.

    Args:
        modules: Those of the preset ``"compact"`` that are measured.
        views: What they are measured on.
        paper: The paper's networks, to stand beside.
        progress: Called before every view.

    Returns:
        Rows of kind ``"error"`` per set, ISO and class, and ``"change"`` per set and ISO.
    """
    pools: dict[tuple[str, int], _Pool] = {}
    for done, view in enumerate(views):
        if progress is not None:
            progress(view.name, done / len(views))
        for iso, source in view.sources.items():
            pool = pools.setdefault((view.set_name, iso), _Pool())
            f_numbers = source.settings.effective_f_number, F_TARGET
            clean, deviation = modules.denoised(source)
            # What the module does, its bank shared with the same blur of the true diameters.
            bank, diameter = DiscBank(clean[0]), modules.aperture.defocus(clean, deviation)[0]
            full = bank.blurred(added_blur(diameter, *f_numbers))
            truth = bank.blurred(added_blur(view.diameter, *f_numbers))
            images = {"exp": source.data, "ns": clean[0], "full": full, "true_depth": truth}
            changes = {"full": full - clean[0]}
            if paper is not None:
                clean, deviation = paper.denoised(source)
                images["paper"] = paper.opened(clean, deviation, f_numbers[0])[0]
                changes["paper"] = images["paper"] - clean[0]
            pool.add_errors(view, images, diameter)
            pool.add_changes(view, changes)
    rows: list[dict[str, Any]] = []
    for (set_name, iso), pool in pools.items():
        head = {"part": "defocus", "set": set_name, "iso": iso}
        rows += ({**head, "kind": "error", **row} for row in _error_rows(pool))
        rows += ({**head, "kind": "change", **row} for row in _change_rows(pool))
    return rows


def _error_rows(pool: _Pool) -> Iterator[dict[str, Any]]:
    clear = pool.pixels["1.5 px and more"] + pool.pixels["below 1.5 px"]
    for name, target in CLASSES.items():
        count = pool.pixels[name]
        if count == 0:
            continue
        rmse = {v: (s / (4 * count)) ** 0.5 for v, s in pool.squares[name].items()}
        errors, ratios = torch.cat(pool.map_errors[name]), pool.by_scene[name]
        yield {
            "pixels": name,
            "count": count,
            "area": round(count / clear, 4),
            "rmse": {v: float(f"{e:.4g}") for v, e in rmse.items()},
            "relative_to_exp": {v: round(e / rmse["exp"], 4) for v, e in rmse.items()},
            "median_scene": round(float(np.median(ratios)), 4) if ratios else None,
            "scenes": len(ratios),
            "full_to_ns": round(rmse["full"] / rmse["ns"], 4),
            "map_median_absolute_error": round(float(errors.abs().median()), 3),
            "map_median_error": round(float(errors.median()), 3),
            "target": target,
            "met": None if target is None else rmse["full"] <= target * rmse["exp"],
        }


def _change_rows(pool: _Pool) -> Iterator[dict[str, Any]]:
    for variant, ratios in pool.changes.items():
        yield {
            "variant": variant,
            "scenes": len(ratios),
            "median": round(float(np.median(ratios)), 4),
            "largest": round(max(ratios), 4),
            "share_below_noise": round(float(np.mean(np.array(ratios) < 1.0)), 3),
            "met": float(np.median(ratios)) < 1.0,
        }


@torch.no_grad()
def time_rows(
    modules: Modules, views: Sequence[View], paper: Modules | None, repeats: int
) -> list[dict[str, Any]]:
    """Median time of each step on the middle of the most defocused view [ms]."""
    view = max(views, key=lambda v: float(v.diameter.clamp(max=7.0).mean()))
    source = _middle(view.sources[ISOS[0]])
    f_number = source.settings.effective_f_number
    clean, deviation = modules.denoised(source)
    diameter = modules.aperture.defocus(clean, deviation)
    added = {n: added_blur(diameter, f_number, n) for n in (F_TARGET, 2.0**1.5, 2.0**2.5)}
    bank = DiscBank(clean)
    for blur in added.values():
        bank.blurred(blur)
    steps: dict[str, Callable[[], Any]] = {
        "map, once per scene": lambda: modules.aperture.defocus(clean, deviation),
        "first f-number, with its discs": lambda: DiscBank(clean).blurred(added[F_TARGET]),
        "further f-number": lambda: bank.blurred(added[2.0**2.5]),
    }
    if paper is not None:
        steps["paper's network, every f-number"] = lambda: paper.opened(clean, deviation, f_number)
    shape = list(clean.shape[1:])
    return [
        {"part": "defocus", "kind": "time", "step": name, "shape": shape, **_timed(call, repeats)}
        for name, call in steps.items()
    ]


def _middle(source: RawImage) -> RawImage:
    height, width = source.data.shape[1:]
    side = min(TIMED_SIZE, height, width)
    top, left = (height - side) // 2, (width - side) // 2
    cut = source.data[:, top : top + side, left : left + side].contiguous()
    return RawImage(cut, source.settings, source.camera)


def _timed(call: Callable[[], Any], repeats: int) -> dict[str, float]:
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - start))
    low, middle, high = np.percentile(times, (25, 50, 75))
    return {"ms": round(middle, 2), "ms_quartiles": [round(low, 2), round(high, 2)]}


def section(rows: list[dict[str, Any]]) -> str:
    """The part as Markdown."""
    lines = [
        "RMSE against the noise-free mean at f/4 and the same exposure, relative to EXP, which "
        "keeps the source's blur; each cell is ISO 100 / ISO 1600 of the source. Classes are by "
        "true circle of confusion at f/11, in pixels of the raw that the map is estimated on. "
        '"True depth" is the same blur by the true circle of confusion, the most that a map can '
        "reach; only occlusion separates it from the truth. Apart are pixels within "
        f"{CLIP_MARGIN} of one at white in source or target, and a border of {BORDER}; area is "
        "of all the others. Near a depth edge: the pixel's disc at f/4 reaches one whose circle "
        f"of confusion differs by more than {DEPTH_STEP:g} px, or such a one's disc reaches it. "
        "Map error: median of the absolute error, and of the error.",
    ]
    errors = [r for r in rows if r["kind"] == "error"]
    for set_name in dict.fromkeys(r["set"] for r in errors):
        lines += ["", f"### {_title(set_name)}", "", *_error_table(errors, set_name)]
    lines += ["", *_change_table([r for r in rows if r["kind"] == "change"])]
    lines += ["", "| step | ms (quartiles) | raw |", "|---|--:|---|"]
    for row in rows:
        if row["kind"] == "time":
            low, high = row["ms_quartiles"]
            shape = " x ".join(map(str, row["shape"]))
            lines.append(f"| {row['step']} | {row['ms']:g} ({low:g} to {high:g}) | {shape} |")
    return "\n".join(lines) + "\n"


def _title(set_name: str) -> str:
    if set_name == "procedural":
        return "Held-out procedural scenes"
    return f"Photograph with measured depth: {set_name}"


def _error_table(errors: list[dict[str, Any]], set_name: str) -> list[str]:
    lines = [
        "| circle of confusion at f/11 | area | asked | Full | met | median scene | Full to NS "
        "| true depth | paper | map error [px] |",
        "|---|--:|--:|--:|---|--:|--:|--:|--:|--:|",
    ]
    for name, target in CLASSES.items():
        group = [r for r in errors if r["set"] == set_name and r["pixels"] == name]
        if not group:
            continue

        cells = [
            name,
            f"{group[0]['area']:.1%}",
            "" if target is None else f"{target:g}",
            _each(group, lambda r: f"{r['relative_to_exp']['full']:.2f}"),
            "" if target is None else _each(group, lambda r: "yes" if r["met"] else "no"),
            _each(group, _scene_cell),
            _each(group, lambda r: f"{r['full_to_ns']:.2f}"),
            _each(group, lambda r: f"{r['relative_to_exp']['true_depth']:.2f}"),
            _each(group, _paper_cell),
            _each(group, _map_cell),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _each(group: list[dict[str, Any]], cell: Callable[[dict[str, Any]], str]) -> str:
    return " / ".join(cell(row) for row in group)


def _scene_cell(row: dict[str, Any]) -> str:
    return f"{row['median_scene']:.2f}" if row["scenes"] else "-"


def _paper_cell(row: dict[str, Any]) -> str:
    return f"{row['relative_to_exp']['paper']:.2f}" if "paper" in row["rmse"] else "-"


def _map_cell(row: dict[str, Any]) -> str:
    return f"{row['map_median_absolute_error']:.2f} ({row['map_median_error']:+.2f})"


def _change_table(changes: list[dict[str, Any]]) -> list[str]:
    lines = [
        f"Where every circle of confusion within {FOCUS_MARGIN} px is below {IN_FOCUS:g} px: RMS "
        "change that opening makes, relative to the noise of a capture at ISO 100. Asked: below 1 "
        "in the median scene, from a source at ISO 100.",
        "",
        "| set | source | module | scenes | median scene | largest | scenes below 1 |",
        "|---|---|---|--:|--:|--:|--:|",
    ]
    for row in changes:
        module = "compact" if row["variant"] == "full" else "paper"
        lines.append(
            f"| {row['set']} | ISO {row['iso']} | {module} | {row['scenes']} | {row['median']:.2f} "
            f"| {row['largest']:.2f} | {row['share_below_noise']:.0%} |"
        )
    return lines
