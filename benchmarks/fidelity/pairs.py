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
import pandas as pd
from torch import Tensor

from benchmarks.fidelity.models import FULL, QUICK, baseline, held_out_scenes, load_models, scores
from benchmarks.harness import Row, pivot, table
from simulator import CameraSettings, CameraSimulator, RawImage, exposure_ratio, get_camera
from simulator.noise.noise_level_function import noise_variance
from simulator.reference.reference_camera import BodyError, ReferenceCamera, ReferenceCapture
from simulator.reference.sequences import Pair, select_pairs
from simulator.reference.sequences import Sequence as CaptureSequence
from simulator.training.crops import draw_sequences

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
    """One pair, photographed: the noisy input, and the noisy output and its mean.

    `group` is the source group of the scene, `blur` the largest circle of confusion of the source
    in the crop [pixel].
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
        return needs_cleaning(self.source, self.target.settings, self.target.mean)


def needs_cleaning(source: RawImage, target: CameraSettings, mean: Tensor) -> bool:
    """Whether light `mean` has less noise at `target` than what the source brings, on average."""
    camera, ratio = source.camera, exposure_ratio(source.settings, target)
    exposed, wanted = source.noise.exposed(ratio), camera.nlf(target.iso)
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
    number, index = list(CAMERAS).index(camera), list(PAIRS).index(mix)
    count = (QUICK_PAIRS if quick else PAIRS)[mix]
    profile = get_camera(camera)
    reference = ReferenceCamera(profile, body=BodyError.draw(profile, CAMERAS[camera]))
    sequences = draw_sequences(held_out_scenes(camera, quick), profile, seed)
    pairs = _pairs_of(mix, sequences, reference)
    if count < len(pairs):
        rng = np.random.default_rng([seed, number, index])
        pairs = [pairs[i] for i in sorted(rng.choice(len(pairs), count, replace=False))]
    crop = (QUICK if quick else FULL)[2]
    cases = _photographed(pairs, sequences, reference, crop, seed)
    return list(_rows([(case, _scores(case)) for case in cases], camera, mix))


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

    def stops(pair: Pair) -> list[int]:
        settings = sequences[pair.sequence].settings
        return [settings[i].aperture_stop for i in (pair.source, pair.target)]

    return [pair for pair in pairs if stops(pair) == wanted]


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


def _estimates(case: Case) -> Iterator[tuple[Method, Tensor, float | None]]:
    """Every method's estimate of the target and its time [ms], and the ceiling."""
    models, target = load_models(), case.target.settings
    for name, network in models.baselines.items():
        begun = time.perf_counter()
        image = baseline(network, case.source, target)
        yield (name.upper(), "", False), image, 1e3 * (time.perf_counter() - begun)
    for preset, corrected in (("compact", True), ("compact", False), ("paper", True)):
        simulator = (models.corrected if corrected else models.simulators).get(preset)
        if simulator is None:
            continue
        times: dict[str, float] = {}
        handles = _stopwatch(simulator, times)
        stages = simulator.stages(case.source, target)
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


def _scores(case: Case) -> dict[Method, Row]:
    found: dict[Method, Row] = {}
    for method, estimate, ms in _estimates(case):
        found[method] = {"ms": ms}
        for name, target in (("noisy", case.target.sample), ("mean", case.target.mean)):
            own = scores(estimate, target, case.source.camera)
            found[method] |= {f"{name}_db": own["psnr_db"], f"{name}_ssim": own["ssim"]}
    return found


def _rows(scored: list[tuple[Case, dict[Method, Row]]], camera: str, mix: str) -> Iterator[Row]:
    for group, belongs in GROUPS.items():
        chosen = [(case, found) for case, found in scored if belongs(case)]
        if not chosen or (mix != "all" and not group.startswith(("aperture opens", "opens"))):
            continue
        subjects = [case.group for case, _ in chosen]
        frames = {m: pd.DataFrame([found[m] for _, found in chosen]) for m in chosen[0][1]}
        for method, own in frames.items():
            name, preset, corrected = method
            row: Row = {"part": "pairs", "camera": camera, "mix": mix, "group": group}
            row |= {"method": name, "preset": preset, "body_correction": corrected}
            row |= {"pairs": len(chosen), "source_groups": len(set(subjects))}
            row |= {str(k): mean for k, mean in own.drop(columns="ms").mean().items()}
            # Gains are over the exposure alone, and over the stage before.
            others = {"over_exp": ("EXP", preset or "compact", corrected or not preset)}
            if before := {"NS": "EXP", "Full": "NS"}.get(name):
                others["over_before"] = (before, preset, corrected)
            for over, other in others.items():
                for field in ("noisy_db", "mean_db"):
                    gains = (own[field] - frames[other][field]).to_numpy()
                    row[f"{over}_{field}"] = float(gains.mean())
                    row[f"{over}_{field}_error"] = _standard_error(gains, subjects)
            yield row | {"milliseconds": own["ms"].astype(float).median()}


def _standard_error(values: np.ndarray, subjects: list[str]) -> float | None:
    """Standard error of the mean, the pairs of a source group taken as one draw."""
    names, index = np.unique(subjects, return_inverse=True)
    if len(names) < 2:
        return None
    sums = np.bincount(index, values - values.mean())
    return float(math.sqrt(len(names) / (len(names) - 1) * (sums**2).sum()) / len(values))


# -- report ---------------------------------------------------------------------------------------

_COUNTS = "camera = {camera} | mix = {mix} | pairs = {pairs} | source groups = {source_groups}"
_PAPER = """noisy = {noisy_db:.2f} / {noisy_ssim:.3f} | mean = {mean_db:.2f} / {mean_ssim:.3f} |
ms = {milliseconds:.1f}"""
_MARGINS = """share = {share:.0%} |
over EXP [dB] = {over_exp_noisy_db:+.2f} ± {over_exp_noisy_db_error:.2f} |
over NS [dB] = {over_before_noisy_db:+.2f} ± {over_before_noisy_db_error:.2f} |
contribution [dB] = {contribution:+.2f}"""


def tables(rows: list[Row]) -> dict[str, str]:
    for row in rows:
        row["name"], row["label"] = _NAMES[row["camera"]], row["method"]
        if row["preset"]:
            plain = ", w = 1, b = 0" * (not row["body_correction"])
            row["label"] += f" `{row['preset']}`" + plain
    paper = [r for r in rows if (r["mix"], r["group"]) == ("all", "all")]
    whole = {r["camera"]: r["pairs"] for r in paper}
    counts = [
        row
        for row in rows
        if row["method"] == "ceiling"
        and row["group"] == ("all" if row["mix"] == "all" else "aperture opens")
    ]
    full = []
    for row in (r for r in rows if r["mix"] == "all" and r["group"] in (*PARTITION, "all")):
        if row["label"] == "Full `compact`":
            share = row["pairs"] / whole[row["camera"]]
            full.append(row | {"share": share, "contribution": share * row["over_exp_noisy_db"]})
    found = {
        "counts": table(counts, _COUNTS),
        "paper": pivot(paper, "PSNR [dB] / SSIM = {label:md}", "{name}", _PAPER),
        "margin": pivot(full, "pairs = {group}", "{name}", _MARGINS),
    }
    for camera in CAMERAS:
        own = [
            r for r in rows if r["camera"] == camera and (r["body_correction"] or not r["preset"])
        ]
        line, values = "mix: pairs = {mix}: {group} ({pairs})", "{noisy_db:.2f} / {mean_db:.2f}"
        found[f"groups-{camera}"] = pivot(own, line, "{label:md}", values)
    return found
