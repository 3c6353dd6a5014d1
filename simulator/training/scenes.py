"""Scenes for the reference camera, and pictures of real detail, that train and test the networks.

All of it is light at the pitch of the photosites: some is drawn there; photographs, radiance maps
and raws of a folder of real files (see docs/networks.md) are cut out at it and never enlarged. The
same place, subject or photographer's series is in one split only (`detail_split`).
"""

import itertools
import json
import logging
import math
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tifffile
import torch
from PIL import Image, ImageDraw, ImageFont

from simulator.camera import CameraProfile
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.radiance import procedural
from simulator.radiance.depth import F_NUMBER, FOCAL_LENGTH, draw_depth, lens_and_depth
from simulator.radiance.light import camera_light, mean_anchor, reference_settings, temperature_tint
from simulator.radiance.maps import AZIMUTHS, EV100_RANGE, assumed_ev100, hash_fraction
from simulator.radiance.photographs import PHOTOGRAPHS, read_photograph, unprocess
from simulator.radiance.reading import RADIANCE_SUFFIXES, read_radiance
from simulator.raw.read import read_raw
from simulator.reference.reference_camera import DRAPED, MOSAIC, ReferenceScene, packed_pitch
from simulator.reference.sequences import ILLUMINANCE
from simulator.reference.thin_lens import Lens
from simulator.settings import incident_ev100
from simulator.training.crops import DetailPicture
from simulator.utils.checks import check_integer, check_word
from simulator.utils.files import open_picture, printable, read_table, refuse_bomb

logger = logging.getLogger(__name__)

Split = Literal["train", "validation", "test"]

#: Index of the first procedural group of each split.
FIRST_INDEX = {"train": 0, "validation": 100_000, "test": 200_000}
#: Groups whose split was fixed before the hash decided; all others follow `detail_split`.
_FIXED: dict[Split, tuple[str, ...]] = {
    "train": (
        *("bridge", "dawn", "forest", "lobby"),
        *("colour_checker", "pantone_strip", "gopro_courtyard"),
    ),
    "validation": ("StillLife", "city"),
    "test": ("Desk", "apartment", "lab", "park", "sunset", "venice", "warehouse", "camera_box"),
}
#: Tables of source groups, each with the column that names them.
_GROUPS = {"MANIFEST_POOL.csv": "group", "hdri_more/MANIFEST.csv": "place"}
#: Folders of the radiance maps that networks are trained and tested on, and of further ones.
_MAP_FOLDERS, FURTHER_MAPS = ("hdri_pool", "hdri_cc0", "openexr_bsd"), ("hdri_more",)
#: Shares of the source groups: training, validation; the rest tests.
_TRAIN, _VALIDATION = 0.62, 0.70
#: Raws of known subjects: beginning of the file name by group.
_RAWS = {
    "colour_checker": ("CRW_0101", "CRW_0104", "CRW_0105"),
    "pantone_strip": ("CRW_0112", "CRW_0113"),
    "camera_box": ("CRW_0117", "CRW_0118", "CRW_0119"),
    "gopro_courtyard": ("GOPR0024", "GOPR9231"),
}
#: Brightest light of a picture, in its medians: lamps beyond it would be all that a mean shows.
_BRIGHTEST = 64.0
#: Photosites a side of drawn pictures, and how many of each kind there are in a split.
_SIZE = 640
_DRAWN = {"train": 60, "validation": 8, "test": 8}
#: Most procedural groups of a split, the gap between the first indices of two.
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
#: Fewest packed pixels a side of a picture, unless smaller scenes are asked for.
LEAST_VIEW = 128
#: Photographs (by file) with a blur of their own, by depth of field or motion.
_BLURRED = {
    *("buddiesofbudgie_budgie-branch", "buddiesofbudgie_fragrant-chamomile"),
    *("buddiesofbudgie_kitten-on-lawn", "buddiesofbudgie_motherboard-circuits"),
    *("buddiesofbudgie_noche-bogota", "buddiesofbudgie_oakland-zoo-otters"),
    *("buddiesofbudgie_solaris-grapes", "buddiesofbudgie_the-spices-of-life"),
    *("elementary_Jonas_Nilsson_Lee", "elementary_Pablo_Garcia_Saldana"),
    *("elementary_photo-1452953008873-ae5837174535", "elementary_victor-svistunov-233897-KB"),
    *("getsolus_Twigonometry", "nextcloud_Frog", "nextcloud_Gorilla", "nextcloud_Vineyard"),
    "solus-project_HermiteCrab2560x1600",
}
#: See `_edge_ratio`: that of edges averaged over square pixels is 0.4.
_SHARP = 0.36
#: Largest circle of confusion of the photographs with depth at f/11 [packed pixels].
_PHOTOGRAPH_BLUR = 6.0


# -- pictures -------------------------------------------------------------------------------------


def detail_split(group: str) -> Split:
    """The split of a source group, by a stable hash of its name."""
    for split, names in _FIXED.items():
        if group in names:
            return split
    drawn = hash_fraction(group)
    return "train" if drawn < _TRAIN else "validation" if drawn < _VALIDATION else "test"


def detail_pictures(
    split: Split, *, data: Path | None, drawn: int | None = None, seed: int = 0
) -> list[DetailPicture]:
    """The pictures of a split: of the folder of real files `data`, if given, and drawn ones.

    Of each kind (dead leaves, charts, smooth pictures) `drawn` are drawn; 60 to train on, else 8.
    """
    check_word("split", split, tuple(FIRST_INDEX))
    pictures: list[DetailPicture] = []
    if data is None:
        logger.warning("no folder of real files (AE_ENV_DATA): training on drawn pictures only")
    else:
        for path, group in radiance_files(data, split):
            light = read_radiance(path)
            light = light / max(float(np.median(light[1])), 1e-6 * float(light.max()))
            clipped = torch.from_numpy(np.minimum(light, _BRIGHTEST))
            pictures.append(DetailPicture(printable(path.stem), group, "radiance", clipped))
        pictures += photograph_pictures(data, split)
        pictures += recorded_mosaics(data, split)
        for path, group in _files(data, "intel_tau_small", (".png",), split):
            import cv2

            with open_picture(path, ["PNG"], bits=16):
                frame = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
                if frame is None:
                    raise ValueError("its pixels end too early")
            light = np.ascontiguousarray(frame[:, :, ::-1].transpose(2, 0, 1), np.float32)
            linear = torch.from_numpy(light / 65535.0)
            pictures.append(DetailPicture(printable(path.stem), group, "linear", linear))
    return [*pictures, *_drawings(split, _DRAWN[split] if drawn is None else drawn, seed)]


def radiance_files(
    data: Path, split: Split, folders: Sequence[str] = _MAP_FOLDERS
) -> Iterator[tuple[Path, str]]:
    """Radiance maps of a split, each with its source group."""
    for folder in folders:
        yield from _files(data, folder, RADIANCE_SUFFIXES, split)


def photograph_pictures(data: Path, split: Split) -> Iterator[DetailPicture]:
    """Photographs of a split, unprocessed to linear light, 1.0 at the photograph's white."""
    for path, group in _files(data, "photo_pool", (".jpg", ".png"), split):
        rng = np.random.default_rng(zlib.crc32(printable(path.stem).encode()))
        with open_picture(path) as picture:
            light = unprocess(np.asarray(picture.convert("RGB")), rng)
        yield DetailPicture(printable(path.stem), group, "photograph", torch.from_numpy(light))


def recorded_mosaics(data: Path, split: Split) -> Iterator[DetailPicture]:
    """Raws of real sensors at low ISO, of a split."""
    for path, group in _files(data, "canon_crw_cc0", (".CRW",), split):
        raw = read_raw(path)
        yield DetailPicture(printable(path.stem), group, "mosaic", raw.data, raw.noise)
    description = data / "gopro_raw" / "meta.json"
    if not description.is_file():
        return
    described = json.loads(description.read_text(encoding="utf-8"))
    for path, group in _files(data, "gopro_raw", (".png",), split):
        meta = described[path.name]
        with open_picture(path) as picture:
            mosaic = np.asarray(picture).astype(np.float32)
        planes = np.stack([mosaic[i::2, j::2] for i in (0, 1) for j in (0, 1)])
        black = np.array(meta["black"], np.float32)[:, None, None]
        light = torch.from_numpy((planes - black) / (meta["white"] - black))
        slope, offset = (float(v) for v in meta["dng_tags"]["NoiseProfile"].strip("()").split(","))
        noise = NoiseLevelFunction((slope,) * 4, (offset,) * 4)
        yield DetailPicture(path.name, group, "mosaic", light, noise)


def _files(
    data: Path, folder: str, suffixes: tuple[str, ...], split: Split
) -> Iterator[tuple[Path, str]]:
    """Files of a split in a folder of `data`, each with its source group."""
    files = sorted(p for p in (data / folder).glob("*") if p.suffix in suffixes)
    if not files:
        logger.warning("no %s files in %s: they are left out", " or ".join(suffixes), data / folder)
    for path in files:
        group = _groups(data).get(path.name, printable(path.stem))
        group = next((g for g, names in _RAWS.items() if path.name.startswith(names)), group)
        if detail_split(group) == split:
            yield path, group


@cache
def _groups(data: Path) -> dict[str, str]:
    """Source group by file name, where a table of the files states it."""
    found: dict[str, str] = {}
    for name, column in _GROUPS.items():
        if (data / name).is_file():
            rows = read_table(data / name)
            pairs = zip(rows.file, rows[column], strict=True)
            found |= {Path(file).name: group for file, group in pairs if group}
    return found


# -- drawn pictures -------------------------------------------------------------------------------


def _drawings(split: Split, number: int, seed: int) -> Iterator[DetailPicture]:
    first = FIRST_INDEX[split]
    for kind, make in (("leaves", _leaves), ("chart", _chart), ("smooth", _smooth)):
        for index in range(number):
            name = f"{kind}-{seed}-{first + index:06d}"
            rng = np.random.default_rng([zlib.crc32(kind.encode()), seed, first, index])
            yield DetailPicture(name, name, kind, torch.from_numpy(make(rng)))


def _leaves(rng: np.random.Generator) -> np.ndarray:
    """Dead leaves down to less than a photosite: the sharpest edges that can be."""
    style = procedural.LeafStyle(
        smallest=float(np.exp(rng.uniform(np.log(0.7), np.log(4.0)))),
        contrast=float(rng.uniform(0.3, 1.1)),
        chroma=float(rng.uniform(0.1, 0.6)),
        texture=float(rng.uniform(0.0, 0.5)),
        palette=int(rng.integers(3, 30)),
    )
    return procedural.dead_leaves(rng, _SIZE, style)


def _chart(rng: np.random.Generator) -> np.ndarray:
    """Text, gratings, zone plates and checks in two colours."""
    levels = np.exp2(rng.uniform(-5.0, 0.0, (2, 1))) * rng.uniform(0.6, 1.0, (2, 3))
    paper, ink = levels[:, :, None]
    row, column = np.mgrid[:_SIZE, :_SIZE].astype(np.float32)
    kind = int(rng.integers(4))
    if kind == 0:
        mask = _text(rng)
    elif kind == 1:
        angle, period = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(2.0), np.log(40.0)))
        wave = np.sin((row * np.sin(angle) + column * np.cos(angle)) * 2 * np.pi / period)
        mask = (wave > 0).astype(np.float32) if rng.random() < 0.5 else 0.5 + 0.5 * wave
    elif kind == 2:
        centre = rng.uniform(-0.2, 1.2, 2) * _SIZE
        radius = np.hypot(row - centre[0], column - centre[1])
        mask = 0.5 + 0.5 * np.cos(np.pi * radius**2 / _SIZE * rng.uniform(0.3, 1.0))
    else:
        side = int(rng.integers(1, 48))
        mask = ((row // side + column // side) % 2).astype(np.float32)
    light = paper[..., None] * (1.0 - mask) + ink[..., None] * mask
    return np.ascontiguousarray(light, np.float32)


def _text(rng: np.random.Generator) -> np.ndarray:
    page = Image.new("L", (_SIZE, _SIZE))
    pen, top = ImageDraw.Draw(page), 0
    while top < _SIZE:
        size = int(rng.integers(7, 40))
        letters = "".join(chr(c) for c in rng.integers(33, 127, 90))
        words = letters.replace("~", " ").replace("|", " ")
        pen.text((int(rng.integers(-20, 5)), top), words, 255, ImageFont.load_default(size))
        top += size + int(rng.integers(1, 8))
    return np.asarray(page, np.float32) / 255.0


def _smooth(rng: np.random.Generator) -> np.ndarray:
    """Shading without detail: walls, skies, flat fields."""
    tint = np.exp2(rng.uniform(-0.8, 0.8, 3))[:, None, None]
    if rng.random() < 0.3:
        return np.ascontiguousarray(np.broadcast_to(tint, (3, _SIZE, _SIZE)), np.float32)
    shape = procedural.fractal_noise(rng, _SIZE, float(rng.uniform(1.8, 3.0)))
    return np.asarray(tint * np.exp(rng.uniform(0.02, 0.8) * shape), np.float32)


# -- scenes of the reference camera ---------------------------------------------------------------


def reference_scenes(
    split: Split,
    camera: CameraProfile,
    *,
    number: int = 48,
    size: int = 256,
    data: Path | None = None,
    seed: int = 0,
) -> list[ReferenceScene]:
    """The scenes of `split`: procedural ones, photographs, and views into radiance maps.

    Of the procedural groups three quarters have depth (`simulator.radiance.depth`), a third of
    these with everything in focus; the rest are the bundled kinds, in turn. Nothing else has depth.

    Args:
        split: ``"train"``, ``"validation"`` or ``"test"``.
        camera: Camera in whose colours light is stated, and in whose pixels blur is.
        number: Procedural groups, one scene each; the first are the same whatever `number` is.
        size: Height and width [packed pixels], half as many as photosites; pictures that are
            smaller keep their size, and are left out below 128 and below `size`.
        data: Folder of real files (see docs/networks.md).
        seed: Of the procedural groups; part of their names.
    """
    check_word("split", split, tuple(FIRST_INDEX))
    check_integer("number", number, 0, MOST_GROUPS)
    check_integer("size", size, 16, more=" packed pixels")
    check_integer("seed", seed, 0)
    scenes = [_procedural(camera, FIRST_INDEX[split], i, size, seed) for i in range(number)]
    scenes += _bundled_photographs(split, camera, size)
    if data is not None:
        scenes += _real_pictures(Path(data), split, camera, size)
    return scenes


def _procedural(
    camera: CameraProfile, first: int, position: int, size: int, seed: int
) -> ReferenceScene:
    block, within = divmod(position, _FLAT_EVERY)
    rng = np.random.default_rng([zlib.crc32(b"reference"), seed, first + position])
    depth, lens = None, Lens()
    if within == _FLAT_EVERY - 1:
        kind = list(procedural.KINDS)[block % len(procedural.KINDS)]
        drawing = procedural.draw(kind, rng, 2 * size, lens=False)
    else:
        kind, focus = "depth", FOCUS_CYCLE[(block * (_FLAT_EVERY - 1) + within) % len(FOCUS_CYCLE)]
        drawn = draw_depth(rng, 2 * size, focus)
        drawing = drawn.drawing
        distance, depths = lens_and_depth(drawn.blur, drawn.far, packed_pitch(camera))
        depth, lens = torch.from_numpy(depths), Lens(FOCAL_LENGTH, distance)
    name = f"reference-{seed}-{first + position:06d}-{kind}"
    return _scene(
        drawing.light,
        camera,
        lux=drawing.illuminance,
        illuminant=drawing.illuminant,
        scene_id=name,
        group=name,
        kind=kind,
        source="procedural, ae-env (MIT)",
        depth=depth,
        lens=lens,
    )


def _scene(
    rgb: np.ndarray,
    camera: CameraProfile,
    *,
    scene_id: str,
    source: str,
    lux: float | None = None,
    illuminant: tuple[float, float, float] = (1.0, 1.0, 1.0),
    **fields: Any,
) -> ReferenceScene:
    """A scene of one pixel to a photosite under `lux`, moved into `ILLUMINANCE`.

    Light is relative to the reference settings: under less of it they expose longer, and `light`
    stays as it is. Where its scale is unknown (`lux` is None) its mean is set to a usual exposure.
    """
    stated = lux
    if lux is None:
        lux = assumed_illuminance(scene_id)
        source += f"; light of unknown scale, {lux:g} lux assumed"
    light, reference, white_balance = camera_light(
        rgb, camera, illuminance=stated, ev100=incident_ev100(lux), illuminant=illuminant
    )
    within = min(max(lux, ILLUMINANCE[0]), ILLUMINANCE[1])
    if within != lux:
        reference = reference_settings(-reference.log2_exposure + math.log2(within / lux))
    return ReferenceScene(
        scene_id=scene_id,
        light=light[[0, 1, 3]],
        reference=reference,
        illuminance=within,
        white_balance=white_balance,
        source=source,
        **fields,
    )


# -- pictures without depth -----------------------------------------------------------------------


def _bundled_photographs(
    split: Split, camera: CameraProfile, size: int
) -> Iterator[ReferenceScene]:
    """scikit-image's photographs, of which nobody knows what was in focus."""
    for photograph in PHOTOGRAPHS:
        validates = photograph.name == VALIDATION_PHOTOGRAPH
        if split != ("validation" if validates else photograph.split):
            continue
        rng = np.random.default_rng(zlib.crc32(photograph.name.encode()))
        yield from _cut_out(
            unprocess(read_photograph(photograph.file), rng),
            camera,
            size,
            lux=procedural.draw_lux(rng, *photograph.illuminance),
            illuminant=temperature_tint(rng.uniform(*photograph.tint)),
            scene_id=photograph.name,
            group=photograph.name,
            kind="photograph",
            source=f"scikit-image {photograph.file}: {photograph.credit}",
            in_focus=False,
        )


def _real_pictures(
    data: Path, split: Split, camera: CameraProfile, size: int
) -> Iterator[ReferenceScene]:
    """Radiance maps and photographs of a folder of real files."""
    if not data.is_dir():
        raise FileNotFoundError(f"`data` (={str(data)!r}) must be an existing folder")
    for path, group in radiance_files(data, split):
        yield from map_scenes(path, group, camera, size)
    about: dict[str, Any]
    for photograph in photograph_pictures(data, split):
        name, view = photograph.name, _sharpened(photograph.light.numpy())
        about = {"group": photograph.group, "kind": "photograph", "source": f"photo_pool {name}"}
        about["in_focus"] = name not in _BLURRED
        yield from _cut_out(view, camera, size, scene_id=name, **about)


def map_scenes(
    path: Path, group: str, camera: CameraProfile, size: int
) -> Iterator[ReferenceScene]:
    """Views into a radiance map, see `reference_scenes`: four square cuts of a panorama's horizon.

    A perspective view has its edges enlarged; this band of 45 degrees is stretched by up to 1.41.
    """
    about: Any = {"group": group, "kind": "radiance", "source": printable(path.name)}
    name, image = printable(path.stem), read_radiance(path)
    height, width = image.shape[1:]
    if abs(width / height - 2.0) > 0.01:  # no panorama
        yield from _cut_out(_sharpened(image), camera, size, scene_id=name, **about)
        return
    side = width // 8 * 2
    top = (height - side) // 2
    for azimuth in AZIMUTHS:
        left = round((azimuth / 360.0 + 0.5) * width) - side // 2
        view = image[:, top : top + side, np.arange(left, left + side) % width]
        yield from _cut_out(view, camera, size, scene_id=f"{name}-{azimuth:03.0f}", **about)


def _sharpened(light: np.ndarray) -> np.ndarray:
    """`light`, or its means over 2 x 2 pixels where it is softer than edges that pixels average."""
    if _edge_ratio(light[1]) >= _SHARP:
        return light
    height, width = (n // 2 for n in light.shape[1:])
    tiles = light[:, : 2 * height, : 2 * width].reshape(3, height, 2, width, 2)
    return np.asarray(tiles.mean(axis=(2, 4)))


def _edge_ratio(values: np.ndarray) -> float:
    """Mean square difference of the logarithm of neighbours, relative to that of second neighbours.

    An edge that falls anywhere in a square pixel gives (2/3) / (5/3) = 0.4; soft pictures tend to
    1/4, white noise to 1.
    """
    logs = np.log(values + 0.02 * np.median(values) + 1e-9)
    near, far = (np.square(logs[:, n:] - logs[:, :-n]).mean() for n in (1, 2))
    return float(near / max(far, 1e-12))


def _cut_out(
    view: np.ndarray, camera: CameraProfile, size: int, *, scene_id: str, **fields: Any
) -> Iterator[ReferenceScene]:
    """The middle of a picture, at most 2 x `size` photosites a side; nothing of a coarse one."""
    side = min(2 * size, *(n // 2 * 2 for n in view.shape[1:]))
    if side < 2 * min(size, LEAST_VIEW):
        logger.info("%s: too coarse (%d photosites a side), left out", scene_id, side)
        return
    yield _scene(_middle(view, side), camera, scene_id=scene_id, **fields)


def _middle(image: Any, side: int) -> Any:
    """The square in the middle of `image`, (C, H, W) of numpy or torch."""
    top, left = ((n - side) // 2 for n in image.shape[1:])
    return image[:, top : top + side, left : left + side]


def mosaic_scenes(split: Split, data: Path, *, size: int = 256) -> Iterator[ReferenceScene]:
    """The middle of real raws at low ISO: flat art and far views, in focus throughout.

    For the aperture: their noise is small, but it is there, so they are no truth to denoise. They
    cannot be defocused, as each plane has but a quarter of the photosites.
    """
    for picture in recorded_mosaics(data, split):
        light = _middle(picture.light, min(size, *picture.light.shape[1:])).clamp(min=0.0)
        lux = assumed_illuminance(picture.name)
        yield ReferenceScene(
            scene_id=picture.name,
            group=picture.group,
            kind=MOSAIC,
            light=light * mean_anchor(light[1:3]),
            reference=reference_settings(incident_ev100(lux)),
            illuminance=lux,
            source=f"raw {picture.name}; light of unknown scale, {lux:g} lux assumed",
            sampled=True,
        )


def assumed_illuminance(name: str) -> float:
    """Light [lux] of a picture of unknown scale: log-uniform in `ILLUMINANCE` by a name's hash."""
    low, high = EV100_RANGE
    fraction = (assumed_ev100(name) - low) / (high - low)
    darkest, brightest = ILLUMINANCE
    return float(f"{darkest * (brightest / darkest) ** fraction:.4g}")


def draped_scenes(
    scenes: Iterable[ReferenceScene], camera: CameraProfile, *, copies: int = 2, seed: int = 0
) -> Iterator[ReferenceScene]:
    """Scenes without depth laid over procedural depth, `copies` of each, in its source group.

    A network that learns the map of defocus from dead leaves alone, which have texture everywhere,
    takes smooth surfaces for blurred. Real pictures that are in focus, laid over depth, show what
    defocus does to such surfaces. Passed over are scenes with depth, those with a blur of their
    own, and those that are not at the pitch of the photosites.
    """
    flat = (s for s in scenes if s.depth is None and s.in_focus and s.pitch > 1)
    pairs = ((scene, copy) for scene in flat for copy in range(copies))
    for (scene, copy), focus in zip(pairs, itertools.cycle(FOCUS_CYCLE), strict=False):
        rng = np.random.default_rng([zlib.crc32(scene.scene_id.encode()), seed, copy])
        height, width = scene.light.shape[1:]
        drawn = draw_depth(rng, max(height, width), focus)
        blur = drawn.blur[:height, :width]
        distance, depth = lens_and_depth(blur, drawn.far, packed_pitch(camera))
        name, lens = f"{scene.scene_id}-draped-{copy}", Lens(FOCAL_LENGTH, distance)
        yield replace(scene, scene_id=name, kind=DRAPED, depth=torch.from_numpy(depth), lens=lens)


# -- photographs with depth -----------------------------------------------------------------------


def depth_photographs(camera: CameraProfile, *, data: Path | None = None) -> list[ReferenceScene]:
    """Photographs with measured depth, for testing only, each with two settings of the focus.

    A pixel counts as a photosite. The lens is focused on the front (95 % of the picture are
    farther) or on the median depth, and its focal length chosen such that the circle of confusion
    at f/11 reaches 6 packed pixels (at the 2 % and 98 % quantiles of inverse depth, whichever is
    the larger). One is inside scikit-image's wheel, the other in ``depth_cones`` of `data`.
    """
    image = read_photograph("motorcycle_left.png")
    measured = resources.files("skimage.data").joinpath("motorcycle_disp.npz")
    with measured.open("rb") as stream, np.load(stream) as arrays:
        disparity = fill_from_nearest(arrays["arr_0"])
    # Calibration as scikit-image states it: z = baseline * focal length / (disparity + offset).
    inverse = (disparity + 31.086) * (1.0 / (0.193001 * 994.978))
    source = "scikit-image stereo_motorcycle (Middlebury 2014); 500 lux assumed"
    scenes = list(_focused("motorcycle", image, inverse, camera, source))
    folder = None if data is None else Path(data) / "depth_cones"
    if folder is not None and folder.is_dir():
        image = _read_tiff(folder / "left_rgb.tif").astype(np.uint8)
        disparity = _read_tiff(folder / "Cones_LEFT_GT.tif")
        disparity = fill_from_nearest(np.where(disparity > 0, disparity, np.nan))  # 0 is "no data"
        # The 2003 sets come without calibration: that of Middlebury's 2006 sets (focal length 3740
        # pixels at full size, baseline 0.16 m) is assumed, at a quarter of the size.
        inverse = disparity * (1.0 / (0.16 * 3740.0 / 4.0))
        source = "Middlebury 2003 Cones; calibration of the 2006 set and 500 lux assumed"
        scenes += _focused("cones", image, inverse, camera, source)
    return scenes


def _read_tiff(path: Path) -> np.ndarray:
    """Pixels of a TIFF of floating-point numbers, whose colours Pillow does not read."""
    with tifffile.TiffFile(path) as file:
        page: Any = file.pages.first
        if claim := refuse_bomb(page.imagelength, page.imagewidth, path.stat().st_size):
            raise ValueError(f"picture {str(path)!r} cannot be read: it {claim}")
        return np.asarray(page.asarray())


def _focused(
    group: str, image: np.ndarray, inverse: np.ndarray, camera: CameraProfile, source: str
) -> Iterator[ReferenceScene]:
    """A photograph of known `inverse` depth (H, W) [1/m], focused on its front and its middle."""
    height, width = (n // 2 * 2 for n in inverse.shape)
    rng = np.random.default_rng(zlib.crc32(group.encode()))
    light, inverse = unprocess(image, rng)[:, :height, :width], inverse[:height, :width]
    far, middle, front, near = np.quantile(inverse, [0.02, 0.5, 0.95, 0.98])
    depth = torch.from_numpy((1.0 / inverse).astype(np.float32))
    about: dict[str, Any] = {"group": group, "kind": "depth_photograph", "source": source}
    for name, focus in (("front", front), ("middle", middle)):
        spread = max(near - focus, focus - far)
        # c = f^2 (F - D) / (N (1 - f F)), solved for the focal length f at the largest |F - D|.
        area = _PHOTOGRAPH_BLUR * packed_pitch(camera) * F_NUMBER / spread
        focal_length = 0.5 * (math.sqrt((area * focus) ** 2 + 4.0 * area) - area * focus)
        lens = Lens(float(focal_length), float(1.0 / focus))
        scene_id = f"{group}-{name}"
        yield _scene(light, camera, lux=500.0, scene_id=scene_id, **about, depth=depth, lens=lens)


def fill_from_nearest(values: np.ndarray) -> np.ndarray:
    """`values` (H, W) with every value that is not finite replaced by the nearest finite one.

    >>> fill_from_nearest(np.array([[1.0, np.nan, np.nan, 4.0]])).tolist()
    [[1.0, 1.0, 4.0, 4.0]]
    """
    missing = ~np.isfinite(values)
    from scipy.ndimage import distance_transform_edt  # not above: it takes long

    indices = distance_transform_edt(missing, return_distances=False, return_indices=True)
    return np.asarray(values[tuple(indices)])
