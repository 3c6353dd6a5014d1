"""Scenes for the reference camera, on which the simulator is trained, validated and tested.

The split by source group is fixed: procedural groups by their index, photographs and radiance maps
by name. A group has all its views in one split, and the scenes of a split stay when `number` grows.
"""

from __future__ import annotations

import logging
import math
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np
import tifffile
import torch
from PIL import Image
from scipy.ndimage import distance_transform_edt

from ae_env.scenes.depth import F_NUMBER, FOCAL_LENGTH, draw_depth, lens_and_depth
from ae_env.scenes.photographs import PHOTOGRAPHS, photograph_scenes, unprocess
from ae_env.scenes.procedural import draw, list_kinds
from ae_env.scenes.radiance import (
    AZIMUTHS,
    EV100_RANGE,
    RADIANCE_SUFFIXES,
    assumed_ev100,
    perspective,
    read_radiance,
)
from ae_env.scenes.scene import Scene, reference_settings
from ae_env.utils.checks import check_integer, check_word
from simulator.camera import CameraProfile
from simulator.optics.thin_lens import Lens
from simulator.reference.reference_camera import DRAPED, ReferenceScene
from simulator.settings import incident_ev100

logger = logging.getLogger(__name__)

Split = Literal["train", "validation", "test"]

#: Index of the first procedural group of each split; no split may have more groups than the gap.
FIRST_INDEX = {"train": 0, "validation": 100_000, "test": 200_000}
MOST_GROUPS = 100_000
#: Every fourth procedural group has no depth: one of the bundled kinds, for noise and exposure.
_FLAT_EVERY = 4
#: Focus of the groups with depth, in turn: a third of them have everything in focus.
FOCUS_CYCLE = (
    *("everything", "front", "back"),
    *("everything", "middle", "front"),
    *("everything", "back", "middle"),
)
#: The photograph of the bundled training split that validates.
VALIDATION_PHOTOGRAPH = "coffee"
#: Radiance maps by file stem: 4 train, 2 validate, 7 test.
RADIANCE_MAPS: dict[str, tuple[str, ...]] = {
    "train": ("bridge", "dawn", "forest", "lobby"),
    "validation": ("StillLife", "city"),
    "test": ("Desk", "apartment", "lab", "park", "sunset", "venice", "warehouse"),
}
#: Field of view of the panoramas' views [degrees]; 256 pixels of it are native at 1024 wide.
FIELD_OF_VIEW = 90.0
#: Packed pixels a side of photographs and of views into radiance maps, at most.
LARGEST_VIEW = 256
#: Illuminance of reference scenes [lux] (paper, section 4.1); brighter scenes are put at the end.
ILLUMINANCE = (1.0, 20_000.0)
#: Largest circle of confusion of the photographs with depth at f/11 [packed pixels].
_PHOTOGRAPH_BLUR = 6.0


def reference_scenes(
    split: Split,
    camera: CameraProfile,
    *,
    number: int = 48,
    size: int = 256,
    radiance: Path | None = None,
    seed: int = 0,
) -> list[ReferenceScene]:
    """The scenes of `split`: procedural ones, photographs, and views into radiance maps.

    Of the procedural groups three quarters have depth (`ae_env.scenes.depth`), a third of these
    with everything in focus; the rest are the bundled kinds, in turn. Nothing else has depth.

    Args:
        split: ``"train"``, ``"validation"`` or ``"test"``.
        camera: Camera in whose colours light is stated, and in whose pixels blur is.
        number: Procedural groups, one scene each, at most `MOST_GROUPS`; the first are the same
            whatever `number` is.
        size: Height and width [packed pixels]; photographs and views have at most 256.
        radiance: Folder under which the maps of `RADIANCE_MAPS` lie; those missing are left out,
            which is logged. None leaves all out.
        seed: Seed of the procedural groups; part of their names.

    Raises:
        ValueError: If an argument is invalid.
    """
    check_word("split", split, tuple(FIRST_INDEX))
    check_integer("number", number, 0, MOST_GROUPS)
    check_integer("size", size, 16, more=" packed pixels")
    check_integer("seed", seed, 0)
    scenes = [_procedural(camera, FIRST_INDEX[split], i, size, seed) for i in range(number)]
    for photograph in PHOTOGRAPHS:
        validates = photograph.name == VALIDATION_PHOTOGRAPH
        if split == ("validation" if validates else photograph.split):
            for scene in photograph_scenes(photograph, camera):
                scenes.append(_from_scene(scene.resized(min(size, LARGEST_VIEW), "native")))
    if radiance is not None:
        for path in _maps(Path(radiance), RADIANCE_MAPS[split]):
            scenes += _radiance_views(path, camera, min(size, LARGEST_VIEW))
    if split != "test":
        return scenes
    return [sharpened(s) if s.depth is None and s.kind != "photograph" else s for s in scenes]


def sharpened(scene: ReferenceScene) -> ReferenceScene:
    """A scene without depth at half its size, box-averaged: sharp to the pixel.

    Radiance maps and the bundled kinds are softer than a lens in focus. Wherever defocus matters,
    in the test split and in `draped_scenes`, "in focus" must mean sharp; elsewhere all pixels are
    used.
    """
    height, width = (n // 2 * 2 for n in scene.light.shape[1:])
    tiles = scene.light[:, :height, :width].reshape(4, height // 2, 2, width // 2, 2)
    return replace(scene, light=tiles.mean(dim=(2, 4)))


def _procedural(
    camera: CameraProfile, first: int, position: int, size: int, seed: int
) -> ReferenceScene:
    """The scene at `position` of the split that begins at index `first`."""
    block, within = divmod(position, _FLAT_EVERY)
    flat = within == _FLAT_EVERY - 1
    kinds = list_kinds()
    kind = kinds[block % len(kinds)] if flat else "depth"
    rng = np.random.default_rng([zlib.crc32(b"reference"), seed, first + position])
    depth, lens = None, Lens()
    if flat:
        drawing = draw(kind, rng, 2 * size)  # halved below: as sharp as the scenes with depth
    else:
        focus = FOCUS_CYCLE[(block * (_FLAT_EVERY - 1) + within) % len(FOCUS_CYCLE)]
        drawn = draw_depth(rng, size, focus)
        drawing = drawn.drawing
        distance, depths = lens_and_depth(drawn.blur, drawn.far, packed_pitch(camera))
        depth, lens = torch.from_numpy(depths), Lens(FOCAL_LENGTH, distance)
    name = f"reference-{seed}-{first + position:06d}-{kind}"
    scene = Scene.from_radiance(
        drawing.light,
        camera,
        scene_id=name,
        group=name,
        illuminance=drawing.illuminance,
        illuminant=drawing.illuminant,
        kind=kind,
        source="procedural, ae-env (MIT)",
    )
    return _from_scene(scene.resized(size, "box"), depth, lens)


def _from_scene(
    scene: Scene,
    depth: torch.Tensor | None = None,
    lens: Lens | None = None,
    illuminance: float | None = None,
) -> ReferenceScene:
    """`scene` for the reference camera, its light moved into the range of `ILLUMINANCE`.

    Light is relative to the reference settings: under less of it they expose longer, and `light`
    stays as it is.
    """
    known = scene.illuminance if illuminance is None else illuminance
    reference = scene.reference
    if known is not None:
        lux = min(max(known, ILLUMINANCE[0]), ILLUMINANCE[1])
        if lux != known:
            shift = math.log2(lux / known)
            reference = reference_settings(-reference.log2_exposure + shift)
        known = lux
    return ReferenceScene(
        scene_id=scene.scene_id,
        group=scene.group,
        kind=scene.kind,
        light=scene.light,
        reference=reference,
        depth=depth,
        lens=Lens() if lens is None else lens,
        illuminance=known,
        white_balance=scene.white_balance,
        source=scene.source,
    )


def packed_pitch(camera: CameraProfile) -> float:
    """Distance between packed pixels of `camera` [m], twice the sensor's.

    Raises:
        ValueError: If the camera does not know it.
    """
    if camera.pixel_pitch_um is None:
        raise ValueError(
            f"`pixel_pitch_um` (=None) of camera {camera.name!r} must be known where there is depth"
        )
    return 2e-6 * camera.pixel_pitch_um


# -- pictures draped over depth -------------------------------------------------------------------


def draped_scenes(
    scenes: Iterable[ReferenceScene], camera: CameraProfile, *, copies: int = 2, seed: int = 0
) -> Iterator[ReferenceScene]:
    """Scenes without depth laid over procedural depth, `copies` of each, in its source group.

    Dead leaves have texture everywhere; real pictures also have smooth surfaces with sharp edges,
    and a network that learns the map of defocus from leaves alone takes the smooth ones for
    blurred. A picture that is in focus throughout, laid over depth, shows what defocus does to such
    surfaces. Photographs are left out, because they have an unknown defocus already.

    Args:
        scenes: Scenes to drape; those with depth, and photographs, are passed over.
        camera: Camera in whose pixels blur is stated.
        copies: Depths per scene; every third has everything in focus.
        seed: Seed of the depths.
    """
    number = 0
    for given in scenes:
        if given.depth is not None or given.kind == "photograph":
            continue
        scene = sharpened(given)
        for copy in range(copies):
            focus = FOCUS_CYCLE[number % len(FOCUS_CYCLE)]
            number += 1
            rng = np.random.default_rng([zlib.crc32(scene.scene_id.encode()), seed, copy])
            height, width = scene.light.shape[1:]
            drawn = draw_depth(rng, max(height, width), focus)
            blur = drawn.blur[:height, :width]
            distance, depth = lens_and_depth(blur, drawn.far, packed_pitch(camera))
            yield replace(
                scene,
                scene_id=f"{scene.scene_id}-draped-{copy}",
                kind=DRAPED,
                depth=torch.from_numpy(depth),
                lens=Lens(FOCAL_LENGTH, distance),
            )


# -- radiance maps --------------------------------------------------------------------------------


def assumed_illuminance(name: str) -> float:
    """Light [lux] assumed for a view into a radiance map, in `ILLUMINANCE`, by a hash of its name.

    A radiance map is relative: nothing in it says how bright the place was. The assumption is
    log-uniform, and drawn for each view, so that a few maps cover the range.

    >>> assumed_illuminance("lab-090") == assumed_illuminance("lab-090")
    True
    """
    low, high = EV100_RANGE
    fraction = (assumed_ev100(name) - low) / (high - low)
    darkest, brightest = ILLUMINANCE
    return float(f"{darkest * (brightest / darkest) ** fraction:.4g}")


def _maps(folder: Path, stems: tuple[str, ...]) -> Iterator[Path]:
    if not folder.is_dir():
        raise FileNotFoundError(f"`radiance` (={str(folder)!r}) must be an existing folder")
    files = {p.stem: p for p in sorted(folder.rglob("*")) if p.suffix in RADIANCE_SUFFIXES}
    for stem in stems:
        if stem in files:
            yield files[stem]
        else:
            logger.warning("no radiance map %r under %s: its scenes are left out", stem, folder)


def _radiance_views(path: Path, camera: CameraProfile, size: int) -> Iterator[ReferenceScene]:
    """Four views of a panorama, or the middle of a picture, all in focus, all in one group."""
    image = read_radiance(path)
    height, width = image.shape[1:]
    if abs(width / height - 2.0) <= 0.01:
        views = {
            f"{path.stem}-{a:03.0f}": perspective(image, a, LARGEST_VIEW, FIELD_OF_VIEW)
            for a in AZIMUTHS
        }
    else:
        views = {path.stem: image}
    for name, view in views.items():
        lux = assumed_illuminance(name)
        scene = Scene.from_radiance(
            view,
            camera,
            scene_id=name,
            group=path.stem,
            ev100=incident_ev100(lux),
            kind="radiance",
            source=f"{path.name}; light of unknown scale, {lux:g} lux assumed",
        )
        native = scene.resized(LARGEST_VIEW, "box").resized(size, "native")
        yield _from_scene(native, illuminance=lux)


# -- photographs with depth -----------------------------------------------------------------------


@dataclass(frozen=True)
class _DepthPhotograph:
    """A photograph and its ground-truth disparity [pixels], not finite where unknown."""

    name: str
    image: np.ndarray
    disparity: np.ndarray
    dioptres_per_pixel: float
    offset: float
    illuminance: float
    source: str


def depth_photographs(camera: CameraProfile, *, data: Path | None = None) -> list[ReferenceScene]:
    """Photographs with measured depth, for testing only, each with two settings of the focus.

    Pixels are box-averaged 2 x 2, depth takes the lower median of the four: a mean of two depths
    would put an edge where nothing is. Where no disparity was measured it is that of the nearest
    pixel that has one. The lens is focused on the front (95 % of the picture are farther) or on
    the median depth, and its focal length chosen such that the circle of confusion at f/11 reaches
    6 packed pixels (at the 2 % and 98 % quantiles of inverse depth, whichever is the larger).

    Args:
        camera: Camera in whose colours light is stated, and in whose pixels blur is.
        data: Folder that holds ``depth_cones``; without it only ``stereo_motorcycle``, which is
            inside scikit-image's wheel.
    """
    photographs = [_motorcycle()]
    folder = None if data is None else Path(data) / "depth_cones"
    if folder is not None and folder.is_dir():
        photographs.append(_cones(folder))
    return [scene for photograph in photographs for scene in _focused(photograph, camera)]


def _motorcycle() -> _DepthPhotograph:
    folder = resources.files("skimage.data")
    with folder.joinpath("motorcycle_left.png").open("rb") as stream, Image.open(stream) as picture:
        image = np.asarray(picture)
    with folder.joinpath("motorcycle_disp.npz").open("rb") as stream, np.load(stream) as arrays:
        disparity = arrays["arr_0"]
    # Calibration as scikit-image states it: z = baseline * focal length / (disparity + offset).
    return _DepthPhotograph(
        name="motorcycle",
        image=image,
        disparity=disparity,
        dioptres_per_pixel=1.0 / (0.193001 * 994.978),
        offset=31.086,
        illuminance=500.0,
        source="scikit-image stereo_motorcycle (Middlebury 2014); 500 lux assumed",
    )


def _cones(folder: Path) -> _DepthPhotograph:
    image = tifffile.imread(folder / "left_rgb.tif").astype(np.uint8)
    disparity = tifffile.imread(folder / "Cones_LEFT_GT.tif")
    # 0 is "no data". The 2003 sets come without calibration: that of Middlebury's 2006 sets (focal
    # length 3740 pixels at full size, baseline 0.16 m) is assumed, at a quarter of the size.
    return _DepthPhotograph(
        name="cones",
        image=image,
        disparity=np.where(disparity > 0, disparity, np.nan),
        dioptres_per_pixel=1.0 / (0.16 * 3740.0 / 4.0),
        offset=0.0,
        illuminance=500.0,
        source="Middlebury 2003 Cones; calibration of the 2006 set and 500 lux assumed",
    )


def _focused(photograph: _DepthPhotograph, camera: CameraProfile) -> Iterator[ReferenceScene]:
    rng = np.random.default_rng(zlib.crc32(photograph.name.encode()))
    light = _tiles(unprocess(photograph.image, rng)).mean(axis=-1)
    filled = fill_from_nearest(photograph.disparity)
    disparity = np.sort(_tiles(filled), axis=-1)[..., 1]  # the lower median of four
    inverse = (disparity + photograph.offset) * photograph.dioptres_per_pixel
    far, middle, front, near = np.quantile(inverse, [0.02, 0.5, 0.95, 0.98])
    scene = Scene.from_radiance(
        light.astype(np.float32),
        camera,
        scene_id=photograph.name,
        group=photograph.name,
        illuminance=photograph.illuminance,
        kind="depth_photograph",
        source=photograph.source,
    )
    depth = torch.from_numpy((1.0 / inverse).astype(np.float32))
    for name, focus in (("front", front), ("middle", middle)):
        spread = max(near - focus, focus - far)
        # c = f^2 (F - D) / (N (1 - f F)), solved for the focal length f at the largest |F - D|.
        area = _PHOTOGRAPH_BLUR * packed_pitch(camera) * F_NUMBER / spread
        focal_length = 0.5 * (math.sqrt((area * focus) ** 2 + 4.0 * area) - area * focus)
        lens = Lens(float(focal_length), float(1.0 / focus))
        yield replace(_from_scene(scene, depth, lens), scene_id=f"{photograph.name}-{name}")


def fill_from_nearest(values: np.ndarray) -> np.ndarray:
    """`values` (H, W) with every value that is not finite replaced by the nearest finite one.

    >>> fill_from_nearest(np.array([[1.0, np.nan, np.nan, 4.0]])).tolist()
    [[1.0, 1.0, 4.0, 4.0]]
    """
    known = np.isfinite(values)
    if known.all():
        return values
    if not known.any():
        raise ValueError("`values` must have a finite value")
    indices = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(values[tuple(indices)])


def _tiles(values: np.ndarray) -> np.ndarray:
    """(..., H, W) as (..., H // 2, W // 2, 4), the pixels of each 2 x 2 tile."""
    height, width = (n // 2 for n in values.shape[-2:])
    tiles = values[..., : 2 * height, : 2 * width].reshape(*values.shape[:-2], height, 2, width, 2)
    return np.moveaxis(tiles, -3, -2).reshape(*values.shape[:-2], height, width, 4)
