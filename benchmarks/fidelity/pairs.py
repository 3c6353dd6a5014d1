"""The paper's table: every method on pairs of captures that no training saw.

An estimate is what a method makes of the source before the output's noise is added; it is compared
with the noisy target, as the paper does, and with the target's noise-free mean.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from torch import Tensor

from benchmarks.fidelity.models import baseline, load_models, scores
from benchmarks.harness import Row, pivot, table
from simulator import CameraSettings, RawImage, exposure_ratio, get_camera
from simulator.noise.noise_level_function import noise_variance
from simulator.reference.reference_camera import BodyError, ReferenceCamera, ReferenceCapture
from simulator.reference.sequences import Pair, any_pairs
from simulator.reference.sequences import Sequence as CaptureSequence
from simulator.training.crops import draw_sequences
from simulator.training.scenes import reference_scenes
from simulator.utils.files import data_folder

#: Camera and the seed of its body: the one trained on, and one that no training saw.
CAMERAS = {"nikon_z6": 1, "canon_70d": 7}
_NAMES = {"nikon_z6": "Nikon Z6, trained body", "canon_70d": "Canon 70D, unseen"}
#: Pairs of a camera: any two captures of a sequence, as the paper's; procedural groups of the test
#: split, largest size of its scenes and of crops of them [packed pixel]; and those of a quick run.
FULL, QUICK = (300, 64, 256, 128), (6, 6, 128, 64)
#: Defocus that can be seen [packed pixel].
VISIBLE_BLUR = 1.5
#: PSNR and SSIM that the paper publishes (table 1), on its own photographs.
PUBLISHED = {
    "nikon_z6": "PC 18.78 / 0.542, DL 34.34 / 0.879, EXP 35.31 / 0.903, NS 35.36 / 0.911, "
    "Full 36.10 / 0.923",
    "canon_70d": "PC 18.96 / 0.413, DL 24.86 / 0.429, EXP 33.53 / 0.831, NS 33.49 / 0.837, "
    "Full 34.28 / 0.846",
}


@dataclass(frozen=True, eq=False)
class Case:
    """One pair, photographed; `blur` is the source's largest circle of confusion [pixel]."""

    group: str
    has_depth: bool
    source: RawImage
    target: ReferenceCapture
    blur: float

    @property
    def opens(self) -> bool:
        """Whether the aperture opens."""
        return self.source.settings.aperture_stop > self.target.settings.aperture_stop

    @property
    def cleaner(self) -> bool:
        """Whether the target has less noise than the source brings, averaged over the crop."""
        return needs_cleaning(self.source, self.target.settings, self.target.mean)


def needs_cleaning(source: RawImage, target: CameraSettings, mean: Tensor) -> bool:
    """Whether light `mean` has less noise at `target` than what the source brings, on average."""
    camera, ratio = source.camera, exposure_ratio(source.settings, target)
    exposed, wanted = source.noise.exposed(ratio), camera.nlf(target.iso)
    return bool(noise_variance(mean, wanted).mean() < noise_variance(mean, exposed).mean())


#: All pairs, and groups of which every pair is in exactly one: where the average margin comes from.
GROUPS: dict[str, Callable[[Case], bool]] = {
    "all": lambda c: True,
    "opens, blur >= 1.5 px": lambda c: c.opens and c.blur >= VISIBLE_BLUR,
    "opens, blur < 1.5 px": lambda c: c.opens and c.blur < VISIBLE_BLUR and c.has_depth,
    "opens, no depth known": lambda c: c.opens and not c.has_depth,
    "does not open, cleaner target": lambda c: not c.opens and c.cleaner,
    "does not open, noisier target": lambda c: not c.opens and not c.cleaner,
}


def measure(camera: str, seed: int, quick: bool) -> list[Row]:
    count, groups, size, crop = QUICK if quick else FULL
    number, profile = list(CAMERAS).index(camera), get_camera(camera)
    reference = ReferenceCamera(profile, body=BodyError.draw(profile, CAMERAS[camera]))
    scenes = reference_scenes("test", profile, number=groups, size=size, data=data_folder())
    sequences = draw_sequences(scenes, profile, seed)
    pairs = any_pairs(sequences)
    if count < len(pairs):
        rng = np.random.default_rng([seed, number, 0])
        pairs = [pairs[i] for i in sorted(rng.choice(len(pairs), count, replace=False))]
    cases = _photographed(pairs, sequences, reference, crop, seed)
    return list(_rows([(case, _scores(case)) for case in cases], camera))


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


#: Name, preset, and whether w and b are those of the trained body.
Method = tuple[str, str, bool]


def _estimates(case: Case) -> Iterator[tuple[Method, Tensor]]:
    """Every method's estimate of the target, and the ceiling."""
    models, target = load_models(), case.target.settings
    for name, network in models.baselines.items():
        yield (name.upper(), "", False), baseline(network, case.source, target)
    for preset, corrected in (("compact", True), ("compact", False), ("paper", True)):
        simulator = (models.corrected if corrected else models.simulators).get(preset)
        if simulator is not None:
            stages = simulator.stages(case.source, target)
            images = {"EXP": stages.exposed, "NS": stages.denoised, "Full": stages.opened}
            for name, image in images.items():
                yield (name, preset, corrected), image
    yield ("ceiling", "", False), case.target.mean


def _scores(case: Case) -> dict[Method, Row]:
    found: dict[Method, Row] = {}
    for method, estimate in _estimates(case):
        found[method] = {}
        for name, target in (("noisy", case.target.sample), ("mean", case.target.mean)):
            own = scores(estimate, target, case.source.camera)
            found[method] |= {f"{name}_db": own["psnr_db"], f"{name}_ssim": own["ssim"]}
    return found


def _rows(scored: list[tuple[Case, dict[Method, Row]]], camera: str) -> Iterator[Row]:
    for group, belongs in GROUPS.items():
        chosen = [(case, found) for case, found in scored if belongs(case)]
        if not chosen:
            continue
        subjects = [case.group for case, _ in chosen]
        frames = {m: pd.DataFrame([found[m] for _, found in chosen]) for m in chosen[0][1]}
        for method, own in frames.items():
            name, preset, corrected = method
            row: Row = {"part": "pairs", "camera": camera, "group": group}
            row |= {"method": name, "preset": preset, "body_correction": corrected}
            row |= {"pairs": len(chosen), "source_groups": len(set(subjects))}
            row |= {str(k): mean for k, mean in own.mean().items()}
            # Gains are over the exposure alone, and over the stage before.
            others = {"over_exp": ("EXP", preset or "compact", corrected or not preset)}
            if before := {"NS": "EXP", "Full": "NS"}.get(name):
                others["over_before"] = (before, preset, corrected)
            for over, other in others.items():
                for field in ("noisy_db", "mean_db"):
                    gains = (own[field] - frames[other][field]).to_numpy()
                    row[f"{over}_{field}"] = float(gains.mean())
                    row[f"{over}_{field}_error"] = _standard_error(gains, subjects)
            yield row


def _standard_error(values: np.ndarray, subjects: list[str]) -> float | None:
    """Standard error of the mean, the pairs of a source group taken as one draw."""
    sums = pd.Series(values - values.mean()).groupby(subjects).sum()
    return float(len(sums) * sums.var()) ** 0.5 / len(values) if len(sums) > 1 else None


_COUNTS = "camera = {camera} | pairs = {pairs} | source groups = {source_groups}"
_PAPER = "noisy = {noisy_db:.2f} / {noisy_ssim:.3f} | mean = {mean_db:.2f} / {mean_ssim:.3f}"
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
    paper = [r for r in rows if r["group"] == "all"]
    whole = {r["camera"]: r["pairs"] for r in paper}
    full = []
    for row in (r for r in rows if r["label"] == "Full `compact`"):
        share = row["pairs"] / whole[row["camera"]]
        full.append(row | {"share": share, "contribution": share * row["over_exp_noisy_db"]})
    return {
        "counts": table((row for row in paper if row["method"] == "ceiling"), _COUNTS),
        "paper": pivot(paper, "PSNR [dB] / SSIM = {label:md}", "{name}", _PAPER),
        "margin": pivot(full, "pairs = {group}", "{name}", _MARGINS),
    }
