"""From a name, a path or a list to scenes: `load_scenes`, and the scenes of an environment.

What `scenes=` may be:

- ``"bundled"``; ``"bundled:small"``: the first two source groups of each kind;
  ``"bundled:large"``: four times the training groups, the same test groups;
  ``"bundled:snow"``: those of one kind; ``"bundled:hard"``: the hard part;
- ``"polyhaven"``: views into real panoramas (`ae_env.scenes.polyhaven`);
  ``"polyhaven:unknown"``: the same as if nobody had metered their light; ``"mixed"``:
  such views and the procedural scenes of ``"bundled:large"``, as many of each; ``"mixed:10"``:
  views of 10 of the places only;
- any of these, or a file of light without noise, with ``"?codes"`` or ``"?tags"`` behind it:
  codes are drawn into every scene (`ae_env.scenes.ladder`); ``"?codes=7"`` draws others,
  ``"?codes=7,8"`` each scene twice;
- a file, folder or glob of raws (any that LibRaw reads) or of ``.hdr`` / ``.exr`` maps;
- ``"pkg.mod:attr"``: a list of scenes or a callable that returns one. The callable is
  given those of ``split``, ``camera`` and ``resolution`` that it has parameters for;
- a list of `Scene`;
- a mapping ``{"path": file, folder or glob, ...}`` with any fields of `FolderOptions`;
- a mapping ``{"sequence": folder or glob, ...}`` likewise: the raws of each folder are
  the frames of one scene over time (`ae_env.scenes.folder`);
- ``"recorded:FOLDER"`` or a mapping ``{"recorded": folder, ...}``: grids whose every
  state is a real capture (`ae_env.scenes.recorded` has the layouts), with the
  ``iso``, ``exposure_time`` and ``f_number`` of files that do not state theirs.
"""

import inspect
import logging
import os
import re
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from ae_env.grid import ExposureGrid
from ae_env.scenes.bundled import HARD, KINDS, Size, bundled_scenes
from ae_env.scenes.folder import FolderOptions, folder_scenes, sequence_scenes
from ae_env.scenes.ladder import KINDS as LADDERS
from ae_env.scenes.ladder import check_size, with_ladder
from ae_env.scenes.recorded import RecordedOptions, recorded_scenes
from ae_env.scenes.scene import Crop, Resize, Scene, SceneRequest, SceneSet, Split
from ae_env.utils.user_files import UserCodeError, load_attribute
from simulator.camera import CameraProfile
from simulator.camera_simulator import CameraSimulator
from simulator.networks.aperture_module import DEAD_ZONE
from simulator.networks.network_cache import NetworkCache
from simulator.networks.noise_module import SIZES
from simulator.noise.generator import noise_generator
from simulator.radiance.light import mean_anchor
from simulator.raw.image import RawImage
from simulator.reference.reference_camera import ReferenceCamera
from simulator.settings import CameraSettings
from simulator.utils.cache import LruCache
from simulator.utils.checks import check_key, check_type, check_word, did_you_mean
from simulator.utils.files import sibling

logger = logging.getLogger(__name__)

#: Names of the scenes that come with the package.
BUNDLED: dict[str, Size] = {"bundled": "normal", "bundled:small": "small", "bundled:large": "large"}
#: Those of one kind, or of the hard part.
BUNDLED_PARTS = {f"bundled:{kind}": kind for kind in (*KINDS, HARD)}
#: Views into Poly Haven's panoramas, alone and with as many procedural scenes.
VIEWS_OF_UNKNOWN_LIGHT = "polyhaven:unknown"
REAL = ("polyhaven", VIEWS_OF_UNKNOWN_LIGHT, "mixed")
#: All scenes that have a name.
NAMED = (*BUNDLED, *BUNDLED_PARTS, *REAL)
#: Ways to name scenes, see `load_scenes`.
SceneSpec = str | Path | Sequence[Scene] | Mapping[str, Any] | RecordedOptions
_LADDER = re.compile(rf"(.+)\?({'|'.join(LADDERS)})(?:=(.*))?", re.DOTALL)
_ATTRIBUTE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")
#: The weights that come with the package.
DEFAULT_SIMULATOR = "compact"
#: Raised when the estimation of defocus maps changes.
MAP_VERSION = 2
#: Pixels around a crop that the networks see, too: at least their field of view.
_MARGIN = 112
#: Range of the ISO of a source raw, drawn log-uniformly, and its f-number.
ISO_RANGE, F_NUMBER = (100.0, 6400.0), 8.0
#: Exposure of a source raw relative to the meter's [EV], uniform.
EV_RANGE = (-1.0, 1.0)
#: Scenes by all that decides them; the bound is on the memory of their light [byte].
_LOADED: LruCache[SceneSet] = LruCache(2**30)


def load_scenes(
    spec: SceneSpec,
    split: Split = "train",
    *,
    camera: CameraProfile,
    resolution: int | None = 64,
    crop: Crop = "box",
    resize: Resize = Scene.resized,
    grid: ExposureGrid | None = None,
) -> list[Scene]:
    """The scenes that `spec` names, of one split, in a stable order, with unique ids.

    A `ValueError` if `spec` names nothing known or no scene of `split`, if a file cannot be read,
    or if a scene is smaller than `resolution`.

    Args:
        spec: What to load; the head of this module lists it.
        split: ``"train"``, ``"test"``, ``"all"``, or of "polyhaven" ``"validation"``. Source groups
            never straddle splits. A folder of fewer than 15 groups is all test. Lists and
            attributes are used as they are: whoever made them has split them.
        camera: In whose colours scenes are made. A raw has its own camera.
        resolution: Packed pixels a side; None keeps each scene's own size.
        crop: ``"box"`` averages the central square down; ``"native"`` cuts out its middle.
        resize: Called with each scene at its finest resolution, `resolution` and `crop`.
        grid: States of recorded grids; by default all that their captures have.
    """
    if isinstance(spec, str) and (drawn := _LADDER.fullmatch(spec)):
        seeds = (drawn[3] or "0").split(",")
        if not all(re.fullmatch(r"\d{1,18}", seed) for seed in seeds) or len({*seeds}) < len(seeds):
            rule = "must be a whole number >= 0, or several that differ, with commas and no spaces"
            raise ValueError(f"`scenes?{drawn[2]}` (={drawn[3]!r}) {rule}")
        if resolution is not None:  # before any scene is drawn
            check_size(resolution)
        size: dict[str, Any] = {"resolution": resolution, "crop": crop, "resize": resize}
        plain = load_scenes(drawn[1], split, camera=camera, grid=grid, **size)
        found = [[with_ladder(scene, drawn[2], int(seed)) for scene in plain] for seed in seeds]
        return [
            scene if seed == seeds[0] else replace(scene, scene_id=f"{scene.scene_id} {seed}")
            for seed, scenes in zip(seeds, found, strict=True)
            for scene in scenes
        ]
    check_word("split", split, get_args(Split))
    if split == "validation" and isinstance(spec, str | Path | Mapping) and spec not in REAL[:2]:
        raise ValueError(
            f"`split` (={split!r}) needs `scenes='polyhaven'`: no others have places for it"
        )
    check_type("camera", camera, CameraProfile, more="; `simulator.get_camera` gives one by name")
    request = SceneRequest(split, camera, resolution, crop, resize)
    scenes: Sequence[Scene]
    recorded = RecordedOptions.of(spec)
    if recorded is not None:
        scenes = recorded_scenes(recorded, request, grid or recorded.grid)
    elif isinstance(spec, Mapping):
        path, options = _options(spec)
        scenes = (sequence_scenes if "sequence" in spec else folder_scenes)(path, request, options)
    elif isinstance(spec, Path):
        scenes = folder_scenes(spec, request)
    elif isinstance(spec, str):
        scenes = _by_name(spec, request)
    else:
        scenes = _sized_list(spec, spec, "scenes", request)
    if not scenes:
        raise ValueError(f"`scenes` (={spec!r}) must hold at least one scene of split {split!r}")
    name, count = Counter(scene.scene_id for scene in scenes).most_common(1)[0]
    if count > 1:
        raise ValueError(f"`scene_id` (={name!r}) must be unique, but occurs {count} times")
    return list(scenes)


def _by_name(spec: str, request: SceneRequest) -> Sequence[Scene]:
    if spec in BUNDLED or spec in BUNDLED_PARTS:
        return _bundled(spec, request)
    # Not above: what reads their list takes long to import.
    from ae_env.scenes.polyhaven import mixed_scenes, polyhaven_scenes, split_assets

    if spec == "polyhaven":
        return polyhaven_scenes(request)
    if spec == VIEWS_OF_UNKNOWN_LIGHT:
        return [replace(view, illuminance=None) for view in polyhaven_scenes(request)]
    if mixed := re.fullmatch(r"mixed(?::(\d+))?", spec):
        places = None if mixed[1] is None else int(mixed[1])
        assets = split_assets(spec, request.split, places)  # raises before anything is drawn
        bundled = _bundled("bundled:large", request)
        procedural = [scene for scene in bundled if scene.kind != "photograph"]
        return mixed_scenes(request, procedural, assets)
    if not os.path.exists(os.path.expanduser(spec)):  # unlike Path's, false for odd names
        ours = spec.partition(":")[0] in NAMED
        if _ATTRIBUTE.fullmatch(spec) and not ours:
            found: Any = load_attribute(spec, f"`scenes` (={spec!r})")
            if callable(found):
                try:
                    names = inspect.signature(found).parameters
                    known = [n for n in ("split", "camera", "resolution") if n in names]
                    found = found(**{name: getattr(request, name) for name in known})
                except Exception as error:  # the user's function may raise anything
                    rule = f"raised {type(error).__name__}: {error}"
                    raise UserCodeError(f"`scenes` (={spec!r}) {rule}") from error
            return _sized_list(found, spec, spec, request)
        hint = did_you_mean(spec, NAMED, cutoff=0.7)
        if hint or ours:
            rule = "an existing file, folder or glob, or 'pkg.mod:attr'"
            raise ValueError(f"`scenes` (={spec!r}) must be one of {[*NAMED]}, {rule}{hint}")
    return folder_scenes(spec, request)


def _bundled(name: str, request: SceneRequest) -> Sequence[Scene]:
    size, part = BUNDLED.get(name, "normal"), BUNDLED_PARTS.get(name)
    if request.resize is Scene.resized:
        return bundled_scenes(request, size=size, part=part)
    finest = replace(request, resolution=None, crop="box")
    return [request.sized(scene) for scene in bundled_scenes(finest, size=size, part=part)]


def _options(spec: Mapping[str, Any]) -> tuple[str | Path, FolderOptions]:
    where = "sequence" if "sequence" in spec else "path"
    known = tuple(field.name for field in fields(FolderOptions))
    if not isinstance(spec.get(where), str | Path):
        rule = f"must have a 'path' or a 'sequence'; the other fields are {known}"
        raise ValueError(f"`scenes` (={dict(spec)!r}) {rule}")
    for name in spec:
        check_key("scenes", name, (where, *known))
    return spec[where], FolderOptions(**{k: v for k, v in spec.items() if k != where})


def _sized_list(found: Any, spec: object, name: str, request: SceneRequest) -> list[Scene]:
    if isinstance(found, str | bytes) or not isinstance(found, Sequence):
        raise ValueError(
            f"`scenes` (={spec!r}) must give a list of Scene, not {type(found).__name__}; else it "
            "is a name, a path or a mapping"
        )
    for i, scene in enumerate(found):
        check_type(f"{name}[{i}]", scene, Scene)
    return [request.sized(scene) for scene in found]


def environment_scenes(
    spec: SceneSpec,
    split: Split,
    *,
    camera: CameraProfile,
    resolution: int | None,
    crop: Crop,
    grid: ExposureGrid | None,
    from_raw: bool,
    finds_defocus: bool,
    simulator: str | None,
    noise: bool | str,
) -> SceneSet:
    """The scenes of `load_scenes`, with what networks find in them, for an environment.

    Those with a name, and recorded ones whose files have not changed, stay in memory for the next
    environment with the same arguments. Bundled ones are drawn when they are needed.

    Args:
        spec, split, camera, resolution, crop, grid: See `load_scenes`.
        from_raw: Whether a scene without noise is known through one raw of it only.
        finds_defocus: Whether a defocus map is estimated where a scene has none.
        simulator: Weights of the networks; None for none, so that noise stays.
        noise: False denoises the light of scenes.
    """
    needs_networks = finds_defocus or from_raw
    recorded = RecordedOptions.of(spec)
    facts = (split, camera, resolution, crop, from_raw)
    known_by = (finds_defocus, simulator, noise) if needs_networks else ()
    key: tuple[Any, ...] | None = None
    if needs_networks and simulator not in (None, *SIZES):
        pass  # a user's weights may have other content next time
    elif recorded is not None:
        times = tuple((file, file.path.stat().st_mtime_ns) for file in recorded.files)
        key = (*facts, *known_by, grid, times)
    elif isinstance(spec, str) and _LADDER.sub(r"\1", spec) in NAMED:
        key = (*facts, *known_by, spec)
    known = None if key is None else _LOADED.get(key)
    if known is not None:
        return known
    is_bundled = isinstance(spec, str) and (spec in BUNDLED or spec in BUNDLED_PARTS)
    if is_bundled and not needs_networks and split != "all":  # without noise, in known light
        scenes = SceneSet.of(_bundled(str(spec), SceneRequest(split, camera, resolution, crop)))
    else:
        networks = None if simulator is None else SceneNetworks(simulator)
        resize = networks.resized if networks is not None and finds_defocus else Scene.resized
        size: dict[str, Any] = {"resolution": resolution, "crop": crop, "resize": resize}
        found = load_scenes(recorded or spec, split, camera=camera, grid=grid, **size)
        if recorded is None and any(scene.recorded is not None for scene in found):
            raise ValueError(
                "`scenes` must name the folder of recorded scenes ('recorded:FOLDER') to show "
                "their captures: those of a list would be simulated"
            )
        if from_raw:
            found = [simulate_source_raw(s) if s.noise_free else s for s in found]
        scenes = SceneSet(_prepare(scene, networks, finds_defocus, noise) for scene in found)
    if key is not None:
        held = len(scenes) * scenes[0].light.nbytes
        captures = [] if recorded is None else [scene.recorded for scene in scenes]
        _LOADED.put(key, scenes, held + sum(t.nbytes for t in captures if t is not None))
    return scenes


def _prepare(
    scene: Scene, networks: "SceneNetworks | None", finds_defocus: bool, noise: bool | str
) -> Scene:
    if not finds_defocus and scene.defocus_map is not None:
        scene = replace(scene, defocus_map=None)
    if networks is not None:
        scene = networks.denoised(scene)
    if not noise and scene.denoised is not None:
        scene = replace(scene, light=scene.denoised, nlf=scene.nlf.zero(), denoised=None)
    try:
        _ = scene.ev100  # a cached property, which every score asks for
    except ValueError as error:
        raise ValueError(f"scene {scene.scene_id!r}: {error}") from error
    return scene


def simulate_source_raw(
    scene: Scene,
    *,
    seed: int = 0,
    iso: float | None = None,
    ev: float | None = None,
    iso_range: tuple[float, float] = ISO_RANGE,
) -> Scene:
    """`scene`, without noise, as one simulated raw of it tells; its illuminance stays known.

    The reference camera takes the raw as an average meter would have it, at an ISO drawn between
    100 and 6400: noise, white highlights and all. Captures are simulated from it by the neural
    simulator, as in the paper. A `ValueError` if the scene carries noise, or is too dark to meter.

    Args:
        seed: Of the ISO, the exposure and the noise, which also depend on the scene's name.
        iso, iso_range: ISO of the raw; drawn by default from the range, log-uniformly.
        ev: Its exposure relative to a mean of green, clipped at white, of 0.12 [EV]; drawn if None.
    """
    if not scene.noise_free:
        raise ValueError(f"`scene` (={scene.scene_id!r}) must be free of noise")
    number = zlib.crc32(scene.scene_id.encode())
    rng = np.random.default_rng([number, seed])
    drawn_iso, drawn_ev = np.exp(rng.uniform(*np.log(iso_range))), rng.uniform(*EV_RANGE)
    iso, ev = float(drawn_iso if iso is None else iso), float(drawn_ev if ev is None else ev)
    try:
        ratio = mean_anchor(scene.light[1:3]) * 2.0**ev
    except ValueError as error:
        dark = "is too dark for a meter: its green is 0 nearly everywhere"
        raise ValueError(f"`scene` (={scene.scene_id!r}) {dark}") from error
    unit = CameraSettings(iso, 1.0, F_NUMBER)
    exposure = scene.reference.log2_exposure + np.log2(ratio)
    settings = replace(unit, exposure_time=float(2.0 ** (exposure - unit.log2_exposure)))
    k, camera = scene.box_factor, scene.camera
    light = (scene.light * ratio).repeat_interleave(k, -2).repeat_interleave(k, -1)
    taken = ReferenceCamera(camera, box_factor=k).record(
        light, settings.iso, noise_generator(seed, number, iso, ev), settings.exposure_time
    )
    raw = RawImage(taken, settings, camera, white_balance=scene.white_balance, box_factor=k)
    known = Scene.from_raw(raw, scene_id=scene.scene_id)
    return replace(
        scene,
        light=known.light,
        reference=settings,
        nlf=known.nlf,
        saturated=known.saturated,
        defocus_map=None,  # of another f-number
        source=f"{scene.source}; photographed at {settings}",
    )


# -- networks: noise and defocus of scenes, estimated once, before any episode --------------------


def check_weights(name: str) -> None:
    """Raises a `ValueError` unless `name` is that of weights or the path of some; reads none."""
    is_text = isinstance(name, str)
    if is_text and name and (name == DEFAULT_SIMULATOR or sibling(name, ".safetensors").is_file()):
        return
    from simulator.networks.weights import list_pretrained

    known = sorted({DEFAULT_SIMULATOR, *list_pretrained()})
    if not is_text or name not in known:
        raise ValueError(
            f"`simulator` (={name!r}) must be None, one of {known} or the path of a .safetensors "
            f"file that exists{did_you_mean(name, known)}"
        )


class SceneNetworks:
    """Trained networks of a name or path, loaded when a scene first needs them.

    Unless `cache` is false, their results are looked up in the cache folder.
    """

    def __init__(self, name: str, *, cache: bool = True) -> None:
        self.name = name
        # On disk only: in memory are the scenes themselves.
        self._results = NetworkCache("disk" if cache else None, max_bytes=0)

    @cached_property
    def _simulator(self) -> CameraSimulator:
        return CameraSimulator.from_pretrained(self.name, device="cpu", cache=None)

    def denoised(self, scene: Scene) -> Scene:
        """The scene with `Scene.denoised`; a noise-free one as it is."""
        if scene.noise_free or scene.denoised is not None:
            return scene

        def make() -> torch.Tensor:  # at tolerance 0, so that it serves every tolerance
            return self._simulator.denoise(replace(scene.prepared, tolerance=0.0))

        denoised = self._cached("denoised", scene, make, shape=scene.light.shape, everywhere=True)
        noise = self._simulator.noise
        return replace(scene, denoised=denoised, residual=None if noise is None else noise.residual)

    def resized(self, scene: Scene, resolution: int | None, crop: Crop = "box") -> Scene:
        """As `Scene.resized`, with `Scene.defocus_map` estimated at the scene's finest resolution.

        Averaging hides small blur. A map that it has already stays.
        """
        small = scene.resized(resolution, crop)
        if small.defocus_map is not None:
            return small

        def make() -> torch.Tensor:
            logger.info("estimating the defocus of scene %s", scene.scene_id)
            fine, shorter, used = scene, min(scene.light.shape[1:]), resolution
            if resolution is not None and crop == "box":
                used = shorter // resolution * resolution
            if used is not None and used + 2 * _MARGIN < shorter:
                fine = scene.resized(used + 2 * _MARGIN, "native")
            # Denoises where there is noise; at tolerance 0, as scorers ask for all of the blur.
            prepared = self._simulator.prepare(fine.prepared, tolerance=0.0)
            fine = replace(fine, defocus_map=self._simulator.estimate_defocus(prepared))
            found = fine.resized(used, "native").resized(resolution, crop).defocus_map
            assert found is not None
            return found

        numbers = {"map": [MAP_VERSION, DEAD_ZONE], "resolution": resolution, "crop": crop}
        shape = small.light.shape[1:]
        return replace(
            small, defocus_map=self._cached("defocus_maps", scene, make, shape=shape, **numbers)
        )

    def _cached(
        self, kind: str, scene: Scene, make: Callable[[], torch.Tensor], **numbers: Any
    ) -> torch.Tensor:
        """The result of `make` for `scene`, from the cache where its inputs were the same."""
        modules = [m for m in (self._simulator.noise, self._simulator.aperture) if m is not None]
        inputs = {"light": scene.light, "denoised": scene.denoised}
        nlf = [scene.nlf.shot, scene.nlf.read]
        return self._results.result(kind, modules, inputs, make, nlf=nlf, **numbers)
