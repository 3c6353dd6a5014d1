"""Real places: views into panoramas of Poly Haven, under light of a known level.

The assets are listed in ``configs/scenes/polyhaven.yaml``: public 1k maps (CC0) by name, with their
kind and split. Each is looked for in the folder of real files and in the user's cache, where
`download` puts it; nothing of it comes with the package.

A map is linear but relative. How much light there is is drawn by its kind (`ILLUMINANCE`,
log-uniform), for each view anew, as the illuminance of a surface that is turned to where it gets
the most. The incident light is what a meter with a dome then reads where the map was taken, turned
against the view (`simulator.radiance.incident_light`).
"""

import logging
import math
import zlib
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from ae_env.scenes.bundled import add_layout, cached_scenes
from ae_env.scenes.scene import Crop, Scene, SceneRequest
from ae_env.utils.user_files import find_preset
from simulator.camera import CameraProfile
from simulator.radiance.incident_light import FLAT_LUX, receptor_reading
from simulator.radiance.maps import native_size, perspective
from simulator.radiance.reading import read_radiance
from simulator.utils.cache import cache_dir, cache_key
from simulator.utils.checks import check_integer, import_extra
from simulator.utils.config_file import Configuration, load_yaml
from simulator.utils.files import data_folder

logger = logging.getLogger(__name__)

#: Illuminance by kind [lux], where it is most: the range that a view's is drawn from.
ILLUMINANCE = {
    "night": (0.5, 20.0),
    "twilight": (10.0, 500.0),
    "indoor": (50.0, 1_000.0),
    "studio": (200.0, 3_000.0),
    "backlit": (50.0, 1_000.0),
    "tunnel": (20.0, 500.0),
    "forest": (500.0, 10_000.0),
    "overcast": (2_000.0, 20_000.0),
    "low_sun": (5_000.0, 30_000.0),
    "sun": (30_000.0, 100_000.0),
}
#: Kinds that count as hard.
_HARD = ("night", "backlit", "tunnel")
#: Views of one map, unless others are asked for.
VIEWS = 8
#: Fields of view [degrees]: the widths of a full frame behind lenses of 24, 35 and 50 mm.
_FIELDS_OF_VIEW = (73.7, 54.4, 39.6)
#: Standard deviation and largest size of the pitch, up and down [degrees].
_PITCH, _LARGEST_PITCH = 12.0, 30.0
#: Where the maps come from, and the folder of the cache that they go to.
URL, _FOLDER = "https://dl.polyhaven.org/file/ph-assets/HDRIs/hdr/1k/", "polyhaven"
#: Seconds in which a server must answer; further attempts at a file that arrives broken.
_TIMEOUT, _RETRIES = 30.0, 2
#: Largest file of a map whose published copy is not known to the byte.
_LARGEST = 4_000_000
#: A map with as many pixels at its very maximum was cut there; with this share at 0, below.
_CUT_PIXELS, _CUT_SHARE = 40, 1e-3
#: Latitudes that a surface is turned to, to find where it gets the most light [degrees].
_TURNED = (-30.0, 0.0, 30.0, 60.0, 90.0)
#: Side of the cells that light is summed over [pixels of a map].
_CELL = 4
#: Raised when the views change.
_VERSION = 7


class Asset(Configuration):
    """A panorama, whose file has a public name, a length and a hash."""

    name: str = Field(pattern=r"[a-z0-9_]+")
    kind: Literal[tuple(ILLUMINANCE)]  # type: ignore[valid-type]
    split: Literal["train", "validation", "test"]
    group: str | None = None  # source group: the place; by default the asset itself
    file: str | None = None  # where it lies in a folder of real files
    made: Literal["published", "converted"] = "published"  # whether the file is the published one
    bytes: int = Field(gt=0)
    sha256: str = Field(pattern=r"[0-9a-f]{64}")

    @property
    def place(self) -> str:
        """Source group."""
        return self.group or self.name

    @property
    def converted(self) -> bool:
        """Whether `bytes` and `sha256` are of a converted copy, not of the published file."""
        return self.made == "converted"

    @property
    def file_name(self) -> str:
        """Name of the file where it is published."""
        return f"{self.name}_1k.hdr"

    @property
    def given(self) -> Path | None:
        """The file in the folder of real files; None where it is not there."""
        data, own = data_folder(), self.file or f"hdri_pool/{self.name}.hdr"
        return None if data is None else self._first_of(data / own, data / _FOLDER / self.file_name)

    @property
    def path(self) -> Path | None:
        """The file, in the folder of real files or in the cache; None where it is in neither."""
        return self.given or self._first_of(cache_dir() / _FOLDER / self.file_name)

    def _first_of(self, *paths: Path) -> Path | None:
        there = (path for path in paths if path.is_file())
        return next((p for p in there if self.converted or p.stat().st_size == self.bytes), None)


class _AssetList(Configuration):
    assets: tuple[Asset, ...]


@cache
def list_assets() -> tuple[Asset, ...]:
    """Every asset, in the order of the list."""
    return load_yaml(find_preset("polyhaven", "scenes"), _AssetList).assets


def split_assets(name: str, split: str, places: int | None = None) -> list[Asset]:
    """The assets of a split; errors call the scenes `name`.

    Of `places` places only, drawn by lot, if that is given: of 10 are those of 5. A
    `FileNotFoundError` names the command that fetches maps that are missing.
    """
    assets = [a for a in list_assets() if split in ("all", a.split)]
    if places is not None:
        known = sorted({asset.place for asset in assets})
        check_integer("places", places, 1, len(known), more=f" of scenes {name!r}")
        drawn = {known[i] for i in np.random.default_rng(0).permutation(len(known))[:places]}
        assets = [asset for asset in assets if asset.place in drawn]
    missing = [asset.name for asset in assets if asset.path is None]
    if missing:
        raise FileNotFoundError(
            f"`scenes` (={name!r}): {len(missing)} of {len(assets)} maps are missing "
            f"({', '.join(missing[:3])}{' ...' if len(missing) > 3 else ''}), "
            "`ae-env scenes download` fetches them; or set AE_ENV_DATA to a folder that has them"
        )
    return assets


def polyhaven_scenes(
    request: SceneRequest, *, views: int = VIEWS, assets: list[Asset] | None = None
) -> Sequence[Scene]:
    """Views into the panoramas of a split, `views` of each map, one map after the other.

    `assets` are by default all of the split.
    """
    assets = split_assets("polyhaven", request.split) if assets is None else assets
    camera, plain = request.camera, request.resize is Scene.resized
    resolution = request.resolution if plain else None
    crop: Crop = request.crop if plain else "box"
    key = {"polyhaven": [a.sha256 for a in assets], "version": _VERSION, "views": views}
    key |= {"seed": 0, "camera": camera.name, "colour_matrix": camera.colour_matrix}
    key |= {"resolution": resolution, "crop": crop, "wanted": request.resolution}
    # Kinds and levels of light may be edited without the files.
    key |= {"kinds": [[a.kind, *ILLUMINANCE[a.kind]] for a in assets]}
    size = native_size(request.resolution)

    def make() -> Iterator[Scene]:
        logger.info("cutting %d views from each of %d panoramas", views, len(assets))
        for asset in assets:
            for scene in asset_views(asset, camera, size=size, views=views):
                yield add_layout(scene).resized(resolution, crop)

    side = size if resolution is None else resolution
    scenes = cached_scenes(cache_key("scenes", key), make, camera, side)
    return scenes if plain else [request.sized(scene) for scene in scenes]


def dome_lux(panorama: np.ndarray, azimuth: float, pitch: float) -> float:
    """Illuminance as a meter with a dome reads it in a panorama of luminances; see `Scene`."""
    return FLAT_LUX * receptor_reading(panorama, azimuth, pitch)


def asset_views(
    asset: Asset,
    camera: CameraProfile,
    *,
    size: int,
    views: int = VIEWS,
    read: Callable[[np.ndarray, float, float], float] = dome_lux,
) -> Iterator[Scene]:
    """The views of one map, of `size` packed pixels a side; see `polyhaven_scenes`.

    `read` is the light meter: the illuminance in a panorama where it points, by azimuth and pitch.

    The light is sampled at the pitch of the photosites, 2 x `size` a side. Where a map has fewer
    pixels in a view, it is smooth at that pitch; averaged to half of them or less it is not.
    """
    assert asset.path is not None  # as `split_assets` makes sure
    panorama = read_radiance(asset.path)
    # Light is summed over cells of a few pixels.
    height, width = (n // _CELL for n in panorama.shape[1:])
    cells = panorama[:, : height * _CELL, : width * _CELL]
    seen = cells.reshape(3, height, _CELL, width, _CELL).mean(axis=(2, 4))
    rng = np.random.default_rng([zlib.crc32(asset.name.encode()), 0])
    low, high = np.log(ILLUMINANCE[asset.kind])
    turned = [(a, p) for p in _TURNED for a in range(0, 360, 30)]
    most = max(receptor_reading(seen, *direction, dome=False) for direction in turned)
    cut = "".join(f"; {where} in the map" for where in cut_values(panorama))
    for index in range(views):
        azimuth = rng.uniform(-180.0, 180.0)
        pitch = float(np.clip(_PITCH * rng.standard_normal(), -_LARGEST_PITCH, _LARGEST_PITCH))
        angle = float(rng.choice(_FIELDS_OF_VIEW))
        lux = math.exp(rng.uniform(low, high))
        light = read(seen, azimuth + 180.0, -pitch)
        yield Scene.from_radiance(
            perspective(panorama, azimuth, 2 * size, angle, pitch) * np.float32(math.pi / light),
            camera,
            scene_id=f"{asset.name}-{index:02d}",
            group=asset.place,
            illuminance=lux * light / most,
            kind=asset.kind,
            hard=asset.kind in _HARD,
            sampled=True,
            source=f"Poly Haven {asset.name} (CC0), {azimuth:.0f} degrees, {angle:.0f} wide{cut}",
        )


def cut_values(panorama: np.ndarray) -> list[str]:
    """What a panorama (3, H, W) does not show: ``"highlights are cut"``, ``"shadows are cut"``."""
    brightest = panorama.max(axis=0)
    highlights = (brightest == brightest.max()).sum() >= _CUT_PIXELS
    shadows = (brightest <= 0.0).mean() >= _CUT_SHARE
    cut = {"highlights are cut": highlights, "shadows are cut": shadows}
    return [name for name, is_cut in cut.items() if is_cut]


def download(*, url: str = URL, progress: Callable[[int, int, str], None] | None) -> list[Path]:
    """Fetches the maps that are missing or damaged into the cache, and returns their files.

    A file is put in place when it is complete and its hash is the list's. No more is read than the
    list says, 110 MB in all. Of a map whose copy was `converted`, only the size is limited. The
    environment's proxy (``HTTPS_PROXY``) is used.

    Args:
        url: Folder that serves ``NAME_1k.hdr``.
        progress: Called with the bytes that are there, all bytes, and the name of the next map.

    Raises:
        ImportError: If the extra ``hdr`` is not installed.
        ValueError: If `url` is no address.
        ConnectionError: If a map cannot be fetched, or is not the one of the list.
    """
    pooch = import_extra("pooch", "hdr", "downloading scenes")
    if not url.startswith(("http://", "https://")):
        raise ValueError(f"`url` (={url!r}) must begin with http:// or https://")
    pooch.get_logger().setLevel("ERROR")
    assets = list_assets()
    folder = cache_dir() / _FOLDER
    store = pooch.create(
        path=folder,
        base_url=url if url.endswith("/") else f"{url}/",
        registry={a.file_name: None if a.converted else f"sha256:{a.sha256}" for a in assets},
        retry_if_failed=_RETRIES,
    )
    total = sum(asset.bytes for asset in assets)
    done, fetched = 0, []
    for asset in assets:
        if progress is not None:
            progress(done, total, asset.name)
        cached = folder / asset.file_name
        whole = cached.is_file() and (
            asset.converted or pooch.file_hash(str(cached)) == asset.sha256
        )
        if asset.given is None and not whole:
            fetch = partial(_fetch, size=_LARGEST if asset.converted else asset.bytes)
            try:
                fetched.append(Path(store.fetch(asset.file_name, downloader=fetch)))
            except (OSError, ValueError) as error:
                raise ConnectionError(
                    f"{store.get_url(asset.file_name)} cannot be fetched: "
                    f"{' '.join(str(error).split())}; run the command again, what is there stays"
                ) from error
        done += asset.bytes
    if progress is not None:
        progress(done, total, "")
    return fetched


def _fetch(url: str, file: str, _: Any, *, size: int) -> None:
    """Downloads to `file` what has `size` bytes, and no more of anything longer."""
    import requests

    with requests.get(url, stream=True, timeout=_TIMEOUT) as answer, open(file, "wb") as stream:
        answer.raise_for_status()
        for piece in answer.iter_content(2**16):
            stream.write(piece)
            if stream.tell() > size:
                raise ValueError(f"it may have {size} bytes, but is longer")


def mixed_scenes(
    request: SceneRequest, procedural: Sequence[Scene], assets: list[Asset]
) -> list[Scene]:
    """`procedural` scenes and as many views of the maps of the same split.

    Where the scenes are no multiple of the maps, some of these have a view less.
    """
    views = math.ceil(len(procedural) / len(assets))
    real = polyhaven_scenes(request, views=views, assets=assets)
    by_view = sorted(range(len(real)), key=lambda i: (i % views, i // views))
    return [*procedural, *(real[i] for i in sorted(by_view[: len(procedural)]))]
