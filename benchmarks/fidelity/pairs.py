"""The paper's table: every method on pairs of captures that no training saw.

Sources and targets are photographed by the reference camera: the body that was trained on, and one
of another camera. An estimate is what a method makes of the source before the output's noise is
added; it is compared with the noisy target, as the paper does, and with the target's noise-free
mean. Everything is clipped to [-pedestal, 1] first.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from skimage.metrics import structural_similarity
from torch import Tensor, nn

from benchmarks.fidelity.models import FULL, QUICK, Models, held_out_scenes, load_models
from benchmarks.harness import Row, clipped, pivot, psnr, table
from simulator import CameraSettings, CameraSimulator, RawImage, exposure_ratio, get_camera
from simulator.noise.noise_level_function import noise_variance
from simulator.reference.camera import BodyError, ReferenceCamera, ReferenceCapture
from simulator.reference.sequences import Pair, select_pairs
from simulator.reference.sequences import Sequence as CaptureSequence
from simulator.training.data import draw_sequences, settings_parameters

#: Camera and the seed of its body: the one trained on, and one that no training saw.
CAMERAS = {"nikon_z6": 1, "canon_70d": 7}
_NAMES = {"nikon_z6": "Nikon Z6, trained body", "canon_70d": "Canon 70D, unseen"}
#: Pairs by mix: "all" is the paper's, any two captures of a sequence; the others are drawn from the
#: scenes that have depth, because few pairs of the first open the aperture of something defocused.
PAIRS = {"all": 300, "opening": 100, "f/11 to f/4": 60}
QUICK_PAIRS = {"all": 6, "opening": 2, "f/11 to f/4": 2}
#: Defocus that can be seen [packed pixel], and the share of white pixels from which a source counts
#: as saturated.
VISIBLE_BLUR, SATURATED = 1.5, 0.01
#: PSNR and SSIM that the paper publishes (table 1), on its own photographs.
PUBLISHED = {
    "nikon_z6": "PC 18.78 / 0.542, DL 34.34 / 0.879, EXP 35.31 / 0.903, NS 35.36 / 0.911, "
    "Full 36.10 / 0.923",
    "canon_70d": "PC 18.96 / 0.413, DL 24.86 / 0.429, EXP 33.53 / 0.831, NS 33.49 / 0.837, "
    "Full 34.28 / 0.846",
}


@dataclass(frozen=True, eq=False)
class Case:
    """One pair, photographed.

    Args:
        group: Source group of the scene.
        has_depth: Whether its depth is known.
        source: The noisy input.
        target: The noisy output and its mean.
        blur: Largest circle of confusion of the source in the crop [pixel].
    """

    group: str
    has_depth: bool
    source: RawImage
    target: ReferenceCapture
    blur: float

    @property
    def stops(self) -> int:
        """By how many steps the aperture opens."""
        return self.source.settings.aperture_stop - self.target.settings.aperture_stop

    @property
    def opens(self) -> bool:
        """Whether the aperture opens."""
        return self.stops > 0

    @property
    def cleaner(self) -> bool:
        """Whether the target has less noise than the source brings, averaged over the crop."""
        camera, mean = self.source.camera, self.target.mean
        ratio = exposure_ratio(self.source.settings, self.target.settings)
        exposed = camera.nlf(self.source.settings.iso).exposed(ratio)
        wanted = camera.nlf(self.target.settings.iso)
        return bool(noise_variance(mean, wanted).mean() < noise_variance(mean, exposed).mean())


#: Groups of which every pair is in exactly one: where the average margin comes from.
PARTITION: dict[str, Callable[[Case], bool]] = {
    "opens, blur >= 1.5 px": lambda c: c.opens and c.blur >= VISIBLE_BLUR,
    "opens, blur < 1.5 px": lambda c: c.opens and c.blur < VISIBLE_BLUR and c.has_depth,
    "opens, no depth known": lambda c: c.opens and not c.has_depth,
    "does not open, cleaner target": lambda c: not c.opens and c.cleaner,
    "does not open, noisier target": lambda c: not c.opens and not c.cleaner,
}
#: Groups of pairs, in the order of the report.
GROUPS: dict[str, Callable[[Case], bool]] = {
    "all": lambda c: True,
    "target noisier than the source": lambda c: not c.cleaner,
    "target cleaner than the source": lambda c: c.cleaner,
    "aperture closes": lambda c: c.stops < 0,
    "same aperture": lambda c: c.stops == 0,
    "aperture opens": lambda c: c.opens,
    **PARTITION,
    "source saturated in > 1 %": lambda c: float(c.source.saturated.float().mean()) > SATURATED,
}


def measure(camera: str, mix: str, seed: int, quick: bool) -> list[Row]:
    """One row per group of pairs and method."""
    number, index = list(CAMERAS).index(camera), list(PAIRS).index(mix)
    count = (QUICK_PAIRS if quick else PAIRS)[mix]
    profile, models = get_camera(camera), load_models()
    reference = ReferenceCamera(profile, body=BodyError.draw(profile, CAMERAS[camera]))
    sequences = draw_sequences(held_out_scenes(camera, quick), profile, seed)
    pairs = _pairs_of(mix, sequences, reference)
    if count < len(pairs):
        rng = np.random.default_rng([seed, number, index])
        pairs = [pairs[i] for i in sorted(rng.choice(len(pairs), count, replace=False))]
    crop = (QUICK if quick else FULL)[2]
    cases = _photographed(pairs, sequences, reference, crop, seed)
    return list(_rows([(case, _scores(case, models)) for case in cases], camera, mix))


def _pairs_of(
    mix: str, sequences: Sequence[CaptureSequence], camera: ReferenceCamera
) -> list[Pair]:
    """The pairs of a mix: any two captures of a sequence; those of scenes with depth that open the
    aperture, or in a tenth of them keep it; or those of them from f/11 to f/4."""
    if mix == "all":
        return select_pairs(sequences, "all", camera.camera)
    opening = select_pairs(sequences, "aperture", camera.camera)
    pairs = [p for p in opening if sequences[p.sequence].scene.depth is not None]
    if mix == "opening":
        return pairs
    wanted = [CameraSettings(100, 1.0, n).aperture_stop for n in (11, 4)]
    return [
        p
        for p in pairs
        if [sequences[p.sequence].settings[i].aperture_stop for i in (p.source, p.target)] == wanted
    ]


def _photographed(
    pairs: list[Pair],
    sequences: Sequence[CaptureSequence],
    camera: ReferenceCamera,
    crop: int,
    seed: int,
) -> Iterator[Case]:
    """The captures of every pair, of the same crop, each with noise of its own."""
    blurred: dict[tuple[int, int], Tensor] = {}
    for number, pair in enumerate(pairs):
        sequence = sequences[pair.sequence]
        scene = sequence.scene
        for old in [key for key in blurred if key[0] != pair.sequence]:
            del blurred[old]  # pairs come in order of their sequence
        rng = np.random.default_rng([seed, number, pair.sequence, pair.source, pair.target])
        top, left = (int(rng.integers(n - crop + 1)) for n in scene.size)
        window = (..., slice(top, top + crop), slice(left, left + crop))
        captures = []
        for settings in (sequence.settings[pair.source], sequence.settings[pair.target]):
            key = (pair.sequence, settings.aperture_stop)
            if key not in blurred:
                blurred[key] = camera.blurred_light(scene, settings.f_number)
            noise, light = int(rng.integers(2**31)), blurred[key][window]
            captures.append(camera.capture(scene, settings, noise, light=light))
        source, target = captures
        blur = camera.blur_diameter(scene, source.settings.effective_f_number)[window]
        raw = RawImage(source.sample, source.settings, camera.camera)
        yield Case(scene.group, scene.depth is not None, raw, target, float(blur.max()))


# -- methods --------------------------------------------------------------------------------------

#: Name, preset, and whether w and b are those of the trained body.
Method = tuple[str, str, bool]


def _estimates(case: Case, models: Models) -> Iterator[tuple[Method, Tensor, float | None]]:
    """Every method's estimate of the target and its time [ms], and the ceiling."""
    for name, network in models.baselines.items():
        yield (name.upper(), "", False), *_baseline(case, network)
    for preset, corrected in (("compact", True), ("compact", False), ("paper", True)):
        simulator = (models.corrected if corrected else models.simulators).get(preset)
        if simulator is None:
            continue
        times: dict[str, float] = {}
        handles = _stopwatch(simulator, times)
        stages = simulator.stages(case.source, case.target.settings)
        for handle in handles:
            handle.remove()
        images = {"EXP": stages.exposed, "NS": stages.denoised, "Full": stages.opened}
        for name, image in images.items():
            yield (name, preset, corrected), image, 1e3 * (times[name] - times["start"])
    yield ("ceiling", "", False), case.target.mean, None


def _stopwatch(simulator: CameraSimulator, times: dict[str, float]) -> list[Any]:
    """Hooks that note when a simulator's exposure module starts and each module ends."""
    assert simulator.noise is not None
    assert simulator.aperture is not None
    modules = {"EXP": simulator.exposure, "NS": simulator.noise, "Full": simulator.aperture}

    def note(name: str) -> Callable[..., None]:
        return lambda *_: times.update({name: time.perf_counter()})

    handles = [module.register_forward_hook(note(name)) for name, module in modules.items()]
    return [*handles, simulator.exposure.register_forward_pre_hook(note("start"))]


@torch.no_grad()
def _baseline(case: Case, network: nn.Module) -> tuple[Tensor, float]:
    settings = case.source.settings, case.target.settings
    parameters = torch.tensor([[v for s in settings for v in settings_parameters(s)]])
    began = time.perf_counter()
    image = network(case.source.data[None], parameters)[0]
    return image, 1e3 * (time.perf_counter() - began)


def _scores(case: Case, models: Models) -> dict[Method, Row]:
    """PSNR [dB] and SSIM against the noisy target and against its mean, and the time."""
    scores = {}
    for method, estimate, milliseconds in _estimates(case, models):
        image, scores[method] = clipped(estimate, case.source.camera), {"ms": milliseconds}
        for name, target in (("noisy", case.target.sample), ("mean", case.target.mean)):
            ssim = structural_similarity(
                image.numpy(), target.numpy(), channel_axis=0, data_range=1.0
            )
            scores[method] |= {f"{name}_db": psnr(image, target), f"{name}_ssim": float(ssim)}
    return scores


def _rows(scored: list[tuple[Case, dict[Method, Row]]], camera: str, mix: str) -> Iterator[Row]:
    for group, belongs in GROUPS.items():
        chosen = [(case, scores) for case, scores in scored if belongs(case)]
        if not chosen or (mix != "all" and not group.startswith(("aperture opens", "opens"))):
            continue
        subjects = [case.group for case, _ in chosen]
        for method in chosen[0][1]:
            name, preset, corrected = method
            head: Row = {"part": "pairs", "camera": camera, "mix": mix, "group": group}
            head["method"] = name
            head |= {"preset": preset, "body_correction": corrected, "pairs": len(chosen)}
            row = head | {"source_groups": len(set(subjects))}
            for field in ("noisy_db", "noisy_ssim", "mean_db", "mean_ssim"):
                row[field] = float(np.mean([scores[method][field] for _, scores in chosen]))
            for over, other in _compared(method).items():
                for field in ("noisy_db", "mean_db"):
                    gains = np.array([s[method][field] - s[other][field] for _, s in chosen])
                    row[f"{over}_{field}"] = float(gains.mean())
                    row[f"{over}_{field}_error"] = _standard_error(gains, subjects)
            times = [s[method]["ms"] for _, s in chosen if s[method]["ms"] is not None]
            yield row | {"milliseconds": float(np.median(times)) if times else None}


def _compared(method: Method) -> dict[str, Method]:
    """Baselines of a method's gain: the exposure alone, and the stage before."""
    name, preset, corrected = method
    exposed = ("EXP", preset or "compact", corrected or not preset)
    before = {"NS": "EXP", "Full": "NS"}.get(name)
    return {"over_exp": exposed} | ({"over_before": (before, preset, corrected)} if before else {})


def _standard_error(values: np.ndarray, subjects: list[str]) -> float | None:
    """Standard error of the mean, the pairs of a source group taken as one draw."""
    names, index = np.unique(subjects, return_inverse=True)
    if len(names) < 2:
        return None
    sums = np.bincount(index, values - values.mean())
    return float(math.sqrt(len(names) / (len(names) - 1) * (sums**2).sum()) / len(values))


# -- report ---------------------------------------------------------------------------------------


def tables(rows: list[Row]) -> dict[str, str]:
    """The table, how many pairs there are, the margin by group, and the breakdown."""
    paper = [r for r in rows if (r["mix"], r["group"]) == ("all", "all")]
    whole = {r["camera"]: r["pairs"] for r in paper}
    ceiling = [r for r in rows if r["method"] == "ceiling"]
    counts = [r for r in ceiling if r["group"] in ("all", "aperture opens")]
    counts = [r for r in counts if (r["group"] == "all") == (r["mix"] == "all")]
    full = [
        r | {"share": r["pairs"] / whole[r["camera"]]}
        for r in rows
        if (r["method"], r["preset"], r["body_correction"]) == ("Full", "compact", True)
        and r["mix"] == "all"
        and r["group"] in (*PARTITION, "all")
    ]
    paper_contents: dict[str, Any] = {
        "noisy": "{noisy_db:.2f} / {noisy_ssim:.3f}",
        "mean": "{mean_db:.2f} / {mean_ssim:.3f}",
        "ms": "{milliseconds:.1f}",
    }
    margins: dict[str, Any] = {
        "share": "{share:.0%}",
        "over EXP [dB]": "{over_exp_noisy_db:+.2f} ± {over_exp_noisy_db_error:.2f}",
        "over NS [dB]": "{over_before_noisy_db:+.2f} ± {over_before_noisy_db_error:.2f}",
        "contribution [dB]": lambda r: f"{r['share'] * r['over_exp_noisy_db']:+.2f}",
    }
    found = {
        "counts": table(counts, {"camera": "{camera}", "mix": "{mix}", **_COUNTS}),
        "paper": pivot(
            paper, line=("PSNR [dB] / SSIM", _label), columns=_camera, contents=paper_contents
        ),
        "margin": pivot(full, line=("pairs", "{group}"), columns=_camera, contents=margins),
    }
    for camera in CAMERAS:
        own = [
            r for r in rows if r["camera"] == camera and (r["body_correction"] or not r["preset"])
        ]
        found[f"groups-{camera}"] = pivot(
            own,
            line=("mix: pairs", "{mix}: {group} ({pairs})"),
            columns=_label,
            contents={"": "{noisy_db:.2f} / {mean_db:.2f}"},
        )
    return found


_COUNTS = {"pairs": "{pairs}", "source groups": "{source_groups}"}


def _camera(row: Row) -> str:
    return _NAMES[row["camera"]]


def _label(row: Row) -> str:
    if not row["preset"]:
        return row["method"]
    return f"{row['method']} `{row['preset']}`" + ", w = 1, b = 0" * (not row["body_correction"])
