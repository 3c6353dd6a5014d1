"""Latitude of a detector: over which exposures, ISO speeds and blurs it finds what is there.

The simulator takes every picture again: darker and brighter at ISO 100, at the same exposure with
more gain, and with more motion blur. What the detector finds in the picture itself is the truth.
"""

import glob
import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from PIL import ImageOps
from scipy.stats import binomtest

from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.ladder import tag_dictionary, zxing
from ae_env.scenes.load import SceneNetworks
from ae_env.scorers.learnt import Classifier
from ae_env.scorers.terms import developed
from ae_env.utils.user_files import UserCodeError, load_from_file, split_file_name
from simulator import CameraProfile
from simulator.raw.develop import develop_inverse
from simulator.settings import CameraSettings
from simulator.utils.checks import import_extra
from simulator.utils.files import RAW_SUFFIXES, open_picture

logger = logging.getLogger(__name__)

#: From a picture (H, W, 3) uint8 sRGB to what is in it: a truth value, a label, or a list of them.
Detector = Callable[[np.ndarray], Any]
#: What is varied, in its unit: EV; ISO; length of the blur [% of the picture's height].
AXES: dict[str, tuple[float, ...]] = {
    "EV": tuple(range(-8, 9)),
    "ISO": tuple(100.0 * 2.0**i for i in range(11)),
    "blur": (0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4),
}
#: Share of successes that counts as working.
LEVEL, _BLUR = 0.9, "up to a blur of {:.2f} %"
#: Settings at which pictures were taken, as far as noise goes; and their file names.
_REFERENCE = CameraSettings(100.0, 1 / 64, 8.0)
_ENDINGS = (".jpg", ".jpeg", ".png", ".webp", ".bmp")


@dataclass(frozen=True)
class Latitude:
    """What `measure_latitude` found."""

    #: ``axis``, ``value``, ``noise``, ``share``, ``low``, ``high`` (Wilson's 95 %), ``trials``.
    rows: pd.DataFrame
    left_out: int  # pictures in which the detector finds nothing to begin with

    def curve(self, axis: str, *, noise: bool = True) -> pd.DataFrame:
        """Rows of an axis in order."""
        return self.rows[(self.rows.axis == axis) & (self.rows.noise == noise)]

    def ends(self, axis: str) -> dict[str, tuple[float, str]]:
        """The ``low`` and the ``high`` value where the share falls below `LEVEL`, and its cause.

        That is noise where it works without. It is empty where the axis ends first. Without any
        entry the level is not reached. Crossings are interpolated between the values tried.
        """
        share, x = self.curve(axis).share.to_numpy(), self.curve(axis).value.to_numpy()
        best = int(np.argmax(share)) if axis == "EV" else 0
        if share[best] < LEVEL:
            return {}
        found = {}
        for name, step in (("low", -1), ("high", 1)) if axis == "EV" else (("high", 1),):
            at, cause = best, ""
            while 0 <= at + step < len(x) and share[at + step] >= LEVEL:
                at += step
            value = float(x[at])
            if 0 <= (out := at + step) < len(x):
                value += float(x[out] - x[at]) * (share[at] - LEVEL) / (share[at] - share[out])
                clean = self.curve(axis, noise=False).share.to_numpy()[out]
                cause = "blur" if axis == "blur" else "noise" if clean >= LEVEL else "clipping"
            found[name] = value, cause
        return found

    def lines(self) -> list[str]:
        """What it found, in words."""
        found: dict[str, str] = {}
        for axis, text in (("EV", "{:+.1f} EV"), ("ISO", "up to ISO {:.0f}"), ("blur", _BLUR)):
            for name, (value, cause) in self.ends(axis).items():
                found[axis + name] = f"{text.format(value)} ({cause or 'the end of the axis'})"
        low, high = (self.ends("EV").get(name, (0.0,))[0] for name in ("low", "high"))
        said = [f"{LEVEL:.0%} of successes over {high - low:.1f} stops"]
        if "EVlow" in found:
            said[0] += f": {found.pop('EVlow')} to {found.pop('EVhigh')}"
        if self.left_out:
            said.append(f"{self.left_out} pictures left out: the detector finds nothing in them")
        return [*said, *found.values()]

    def plot(self, path: Path) -> None:
        """Draws the shares with their intervals, and dotted without noise."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(9, 2.8), dpi=90, layout="constrained")
        units = ("exposure [EV]", "ISO, in stops", "blur [% of the height], in stops")
        for axes, axis, unit in zip(figure.subplots(1, 3, sharey=True), AXES, units, strict=True):
            own, clean = self.curve(axis), self.curve(axis, noise=False)
            x = own.value if axis == "EV" else np.arange(len(own))
            if axis != "EV":
                axes.set_xticks(x, [f"{value:g}" for value in own.value], rotation=45)
            axes.fill_between(x, own.low, own.high, alpha=0.25)
            axes.plot(x, own.share, marker=".", label="with noise")
            axes.plot(x, clean.share, ":", label="without noise")
            axes.axhline(LEVEL, color="0.7", linewidth=0.8)
            axes.set(xlabel=unit, ylim=(-0.03, 1.03))
        figure.axes[0].set(ylabel="share of successes, 95 %")
        figure.axes[0].legend(fontsize=7)
        figure.savefig(path)


def load_detector(name: str) -> Detector:
    """``"codes"`` (all that zxing-cpp reads), ``"tags"``, ``.onnx`` or ``my_file.py:Name``."""
    if name == "codes":
        module = zxing()
        return lambda picture: [code.text for code in module.read_barcodes(picture)]
    if name == "tags":
        aruco = import_extra("cv2", "cv", "the detector tags").aruco
        search = aruco.ArucoDetector(tag_dictionary()).detectMarkers
        return lambda picture: () if (ids := search(picture)[1]) is None else ids.ravel().tolist()
    if name.lower().endswith(".onnx"):
        classifier = Classifier(name)
        return lambda picture: classifier.labels(_planes(picture))[0]
    rule = f"`detector` (={name!r})"
    file = split_file_name(name)
    if file is None:
        raise ValueError(f"{rule} must be 'codes', 'tags', 'model.onnx' or 'my_file.py:Name'")
    try:
        found = load_from_file(*file, rule, example="MyDetector")
    except ValueError as error:
        raise ValueError(f"{error}; built in are 'codes' and 'tags'") from error
    made = found() if isinstance(found, type) else found
    if not callable(made):
        raise ValueError(f"{rule} must be callable, got {type(made).__name__}")
    return made


def picture_scenes(what: str, camera: CameraProfile, size: int) -> list[Scene]:
    """Scenes of a file, folder or glob of pictures, or else of raws and radiance maps.

    Pictures are averaged until their longer side has at most `size` pixels; their white is the
    sensor's. Of raws the central square counts, and the networks take the noise out. Those that
    cannot be read are left out; a `ValueError` if none is left.
    """
    path = Path(what).expanduser()
    files = sorted(path.iterdir()) if path.is_dir() else [Path(f) for f in sorted(glob.glob(what))]
    of_kind = ([f for f in files if f.suffix.lower() in k] for k in (_ENDINGS, RAW_SUFFIXES))
    found, faults, given = list[Scene](), list[str](), next(filter(None, of_kind), [path])
    for file in given:
        try:
            found += _scenes_of(file, camera, size)
        except ValueError as error:
            faults.append(str(error).replace("`scenes`", "`pictures`"))
    if not found:
        rule = f"`pictures` (={what!r}) must have one that can be read: "
        raise ValueError(rule * (given != [path]) + faults[0])
    if faults:
        count = f"{len(faults)} of {len(given)} pictures are left out"
        logger.warning(f"{count}, as they cannot be read, such as: {faults[0]}")
    return found


def _scenes_of(file: Path, camera: CameraProfile, size: int) -> list[Scene]:
    if file.suffix.lower() not in _ENDINGS:
        scenes = load_scenes(str(file), "all", camera=camera, resolution=size)
        return [SceneNetworks("compact").denoised(scene) for scene in scenes]
    with open_picture(file) as opened:
        picture = ImageOps.exif_transpose(opened).convert("RGB")
    picture = picture.reduce(math.ceil(max(picture.size) / size))
    light = develop_inverse(_planes(np.asarray(picture)))[0]
    plain = replace(camera, colour_matrix=None)
    return [Scene.from_array(light, _REFERENCE, plain, scene_id=file.name)]


def _planes(picture: np.ndarray) -> torch.Tensor:
    """(1, 3, H, W) in [0, 1] of a picture (H, W, 3) uint8."""
    return torch.from_numpy(picture.copy()).permute(2, 0, 1)[None].float() / 255.0


def measure_latitude(
    detector: Detector,
    scenes: Sequence[Scene],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Latitude:
    """How often `detector` finds in every condition what it finds in each of the `scenes`.

    A trial is one thing in one picture. A `ValueError` if it finds nothing in any of them; a
    `UserCodeError` if it raises.
    """
    successes: dict[tuple[str, float, bool], list[bool]] = {}
    left_out = 0
    for number, scene in enumerate(scenes):
        wanted = _found(detector, next(_frames(scene, "EV", (0.0,), noise=False)))
        left_out += not wanted
        for (axis, values), noise in product(AXES.items() if wanted else (), (True, False)):
            frames = _frames(scene, axis, values, noise=noise)
            for value, frame in zip(values, frames, strict=True):
                found = _found(detector, frame)
                known = successes.setdefault((axis, value, noise), [])
                known += [one in found for one in wanted]
        progress(number + 1, len(scenes))
    if not successes:
        raise ValueError("`detector` must find something in at least one of the pictures")
    rows = []
    for (axis, value, noise), own in successes.items():
        low, high = binomtest(sum(own), len(own)).proportion_ci(method="wilson")
        row = {"axis": axis, "value": value, "noise": noise, "share": sum(own) / len(own)}
        rows.append(row | {"low": low, "high": high, "trials": len(own)})
    return Latitude(pd.DataFrame(rows), left_out)


def _frames(
    scene: Scene, axis: str, values: Sequence[float], *, noise: bool
) -> Iterator[np.ndarray]:
    """Pictures (H, W, 3) uint8 at each of the values."""
    prepared, balance = scene.prepared, torch.tensor([scene.white_balance])
    for value in values:
        base = CameraSettings(value if axis == "ISO" else 100.0, 1.0, 8.0)
        seconds = 2.0 ** (scene.reference.log2_exposure - base.log2_exposure)
        speed = value / 100.0 / seconds if axis == "blur" else 0.0
        shown = prepared.changed(image_speed=speed, tolerance=0.0).expose(
            [replace(base, exposure_time=seconds)],
            noise="exact" if noise else None,
            gain=np.array([2.0**value if axis == "EV" else 1.0]),
        )
        picture = developed(shown.clamp_(0.0, 1.0), balance, [scene.camera.colour_matrix])[0]
        codes = picture.mul(255.0).round().to(torch.uint8)
        yield np.ascontiguousarray(codes.permute(1, 2, 0).numpy())


def _found(detector: Detector, picture: np.ndarray) -> set[Any]:
    """What the detector finds in a picture."""
    try:
        result = detector(picture)
        if isinstance(result, list | tuple | set | frozenset | np.ndarray):
            return set(np.asarray(result).ravel().tolist() if len(result) else ())
        return set() if result is None or result is False else {result}
    except Exception as error:
        raise UserCodeError(f"the detector raised {type(error).__name__}: {error}") from error
