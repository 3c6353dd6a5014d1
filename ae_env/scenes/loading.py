"""`load_scenes`: from a name, a path or a list to scenes; and the networks that prepare them."""

from __future__ import annotations

import inspect
import logging
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import torch

from ae_env.grid import ExposureGrid
from ae_env.scenes.bundled import HARD, KINDS, Size, Split, bundled_scenes
from ae_env.scenes.folder import FolderOptions, folder_scenes, sequence_scenes
from ae_env.scenes.polyhaven import mixed_scenes, polyhaven_scenes, split_assets
from ae_env.scenes.recorded import RecordedOptions, recorded_scenes
from ae_env.scenes.scene import Crop, Resize, Scene, SceneRequest
from ae_env.utils.user_code import load_attribute
from simulator.camera import CameraProfile
from simulator.camera_simulator import CameraSimulator
from simulator.networks.aperture_module import DEAD_ZONE
from simulator.networks.network_cache import NetworkCache
from simulator.utils.checks import did_you_mean
from simulator.utils.files import sibling

logger = logging.getLogger(__name__)

#: Names of the scenes that come with the package.
BUNDLED: dict[str, Size] = {
    "bundled": "normal",
    "bundled:small": "small",
    "bundled:large": "large",
}
#: Those of one kind, or of the hard part.
BUNDLED_PARTS = {f"bundled:{kind}": kind for kind in (*KINDS, HARD)}
#: Views into Poly Haven's panoramas, alone and with as many procedural scenes.
REAL = ("polyhaven", "mixed")
#: All scenes that have a name.
NAMED = (*BUNDLED, *BUNDLED_PARTS, *REAL)
#: Ways to name scenes, see `load_scenes`.
SceneSpec = str | Path | Sequence[Scene] | Mapping[str, Any] | RecordedOptions
_ATTRIBUTE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")


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
    """The scenes that `spec` names, of one split, all at one resolution.

    Args:
        spec: What to load:

            - ``"bundled"``; ``"bundled:small"``: the first two source groups of each kind;
              ``"bundled:large"``: four times the training groups, the same test groups;
              ``"bundled:snow"``: those of one kind; ``"bundled:hard"``: the hard part;
            - ``"polyhaven"``: views into real panoramas (`ae_env.scenes.polyhaven`); ``"mixed"``:
              such views and the procedural scenes of ``"bundled:large"``, as many of each;
            - a file, folder or glob of raws (any that LibRaw reads) or of ``.hdr`` / ``.exr`` maps;
            - ``"pkg.mod:attr"``: a list of scenes or a callable that returns one. The callable is
              given those of ``split``, ``camera`` and ``resolution`` that it has parameters for;
            - a list of `Scene`;
            - a mapping ``{"path": file, folder or glob, ...}`` with any fields of `FolderOptions`;
            - a mapping ``{"sequence": folder or glob, ...}`` likewise: the raws of each folder are
              the frames of one scene over time (`ae_env.scenes.folder`);
            - ``"recorded:FOLDER"`` or a mapping ``{"recorded": folder, ...}``: grids whose every
              state is a real capture (`ae_env.scenes.recorded_files` has the layouts), with the
              ``iso``, ``exposure_time`` and ``f_number`` of files that do not state theirs.

        split: ``"train"``, ``"test"`` or ``"all"``. Source groups never straddle splits. A folder
            of fewer than 15 groups is all test. Lists and attributes are used as they are: whoever
            made them has split them.
        camera: In whose colours bundled scenes and radiance maps are made. A raw brings its own
            camera.
        resolution: Packed pixels a side; None keeps each scene's own size.
        crop: ``"box"`` averages the central square down; ``"native"`` cuts out its middle.
        resize: Called with each scene at its finest resolution, `resolution` and `crop`; see
            `SceneNetworks.resized` for another than the default.
        grid: States of recorded grids; by default all that their captures have.

    Returns:
        At least one scene, in a stable order, with unique ids.

    Raises:
        ValueError: If `spec` names nothing known or no scene of `split`, if a file cannot be read,
            or if a scene is smaller than `resolution`.
    """
    if split not in get_args(Split):
        raise ValueError(f"`split` (={split!r}) must be one of {list(get_args(Split))}")
    if not isinstance(camera, CameraProfile):
        hint = "; `simulator.get_camera` gives one by name"
        raise ValueError(f"`camera` (={camera!r}) must be a CameraProfile{hint}")
    request = SceneRequest(split, camera, resolution, crop, resize)
    scenes: Sequence[Scene]
    recorded = RecordedOptions.of(spec)
    if recorded is not None:
        scenes = recorded_scenes(recorded, request, grid or recorded.grid)
    elif isinstance(spec, Mapping):
        load = sequence_scenes if is_sequence(spec) else folder_scenes
        path, options = _options(spec)
        scenes = load(path, request, options)
    elif isinstance(spec, Path):
        scenes = folder_scenes(spec, request)
    elif isinstance(spec, str):
        scenes = _by_name(spec, split, request)
    elif isinstance(spec, Sequence):
        scenes = [request.sized(scene) for scene in _checked(spec, "scenes")]
    else:
        raise ValueError(
            f"`scenes` (={spec!r}) must be a name, a path, a mapping or a list of Scene"
        )
    if not scenes:
        raise ValueError(f"`scenes` (={spec!r}) must hold at least one scene of split {split!r}")
    seen: set[str] = set()
    for scene in scenes:
        if scene.scene_id in seen:
            raise ValueError(f"`scene_id` (={scene.scene_id!r}) must be unique, but occurs twice")
        seen.add(scene.scene_id)
    return list(scenes)


def scenes_on_demand(
    spec: object, split: Split, camera: CameraProfile, resolution: int | None, crop: Crop
) -> Sequence[Scene] | None:
    """As `load_scenes`, but scenes that must be drawn are when they are needed; None for others.

    Those are the bundled ones, if not found in the cache.
    """
    if split == "all" or not isinstance(spec, str) or spec not in (*BUNDLED, *BUNDLED_PARTS):
        return None
    return _by_name(spec, split, SceneRequest(split, camera, resolution, crop))


def is_sequence(spec: object) -> bool:
    """Whether `spec` asks for scenes whose frames are raws of their own."""
    return isinstance(spec, Mapping) and "sequence" in spec


def has_frames(spec: object) -> bool:
    """Whether the scenes of `spec` may be frames that follow each other."""
    return is_sequence(spec) or RecordedOptions.of(spec) is not None


def _by_name(spec: str, split: Split, request: SceneRequest) -> Sequence[Scene]:
    camera, resolution = request.camera, request.resolution
    if spec in BUNDLED or spec in BUNDLED_PARTS:
        size, part = BUNDLED.get(spec, "normal"), BUNDLED_PARTS.get(spec)
        if request.resize is Scene.resized:
            return bundled_scenes(split, camera, resolution, request.crop, size=size, part=part)
        finest = bundled_scenes(split, camera, None, size=size, part=part)
        return [request.sized(scene) for scene in finest]
    if spec == "polyhaven":
        return polyhaven_scenes(request)
    if spec == "mixed":
        maps = len(split_assets("mixed", split))  # raises before anything is drawn
        bundled = _by_name("bundled:large", split, request)
        procedural = [scene for scene in bundled if scene.kind != "photograph"]
        return mixed_scenes(request, procedural, maps)
    if not os.path.exists(os.path.expanduser(spec)):  # unlike Path's, false for odd names
        ours = spec.partition(":")[0] in NAMED
        if _ATTRIBUTE.fullmatch(spec) and not ours:
            found: Any = load_attribute(spec, f"`scenes` (={spec!r})")
            if callable(found):
                known = {"split": split, "camera": camera, "resolution": resolution}
                names = inspect.signature(found).parameters
                found = found(**{name: given for name, given in known.items() if name in names})
            return [request.sized(scene) for scene in _checked(found, spec)]
        hint = did_you_mean(spec, NAMED, cutoff=0.7)
        if hint or ours:
            raise ValueError(
                f"`scenes` (={spec!r}) must be one of {[*NAMED]}, an existing file, folder or "
                f"glob, or 'pkg.mod:attr'{hint}"
            )
    return folder_scenes(spec, request)


def _options(spec: Mapping[str, Any]) -> tuple[str | Path, FolderOptions]:
    where = "sequence" if is_sequence(spec) else "path"
    known = [field.name for field in fields(FolderOptions)]
    if not isinstance(spec.get(where), str | Path):
        raise ValueError(
            f"`scenes` (={dict(spec)!r}) must have a 'path' or a 'sequence'; the other fields are "
            f"{known}"
        )
    for name in spec:
        if name != where and name not in known:
            hint = did_you_mean(name, known)
            raise ValueError(f"`scenes` field {name!r} must be one of {[where, *known]}{hint}")
    if spec[where] in NAMED:
        raise ValueError(
            f"`scenes` (={dict(spec)!r}): {where!r} must be a file, folder or glob; give the name "
            f"{spec[where]!r} itself for those scenes"
        )
    return spec[where], FolderOptions(**{k: v for k, v in spec.items() if k != where})


def _checked(spec: Any, name: str) -> Sequence[Scene]:
    if isinstance(spec, str | bytes) or not isinstance(spec, Sequence):
        raise ValueError(
            f"`scenes` (={name!r}) must give a list of Scene, not {type(spec).__name__}"
        )
    for i, scene in enumerate(spec):
        if not isinstance(scene, Scene):
            raise ValueError(f"{name}[{i}] (={type(scene).__name__}) must be a Scene")
    return spec


# -- networks: noise and defocus of scenes, estimated once, before any episode --------------------

#: The weights that come with the package.
DEFAULT_SIMULATOR = "compact"
#: Raised when the estimation of defocus maps changes.
MAP_VERSION = 2
#: Pixels around a crop that the networks see, too: at least their field of view.
_MARGIN = 112


def check_weights(name: str) -> None:
    """Raises a `ValueError` unless `name` is that of weights or the path of some; reads none."""
    if not isinstance(name, str) or not name:
        raise ValueError(f"`simulator` (={name!r}) must be None, or the name or path of weights")
    if name == DEFAULT_SIMULATOR or sibling(name, ".safetensors").is_file():
        return
    from simulator.networks.weights import list_pretrained

    known = sorted({DEFAULT_SIMULATOR, *list_pretrained()})
    if name not in known:
        if name.endswith(".safetensors"):
            raise ValueError(f"`simulator` (={name!r}): there is no such file")
        raise ValueError(
            f"`simulator` (={name!r}) must be None, one of {known} or the path of a .safetensors "
            f"file{did_you_mean(name, known)}"
        )


class SceneNetworks:
    """Trained networks, loaded when a scene first needs them.

    Args:
        name: Name or path of the weights.
        cache: Whether to use the cache folder for their results.
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

        shape = scene.light.shape
        denoised = self._cached("denoised", scene, make, shape=shape, everywhere=True)
        noise = self._simulator.noise
        return replace(scene, denoised=denoised, residual=None if noise is None else noise.residual)

    def resized(self, scene: Scene, resolution: int | None, crop: Crop = "box") -> Scene:
        """As `Scene.resized`, with `Scene.defocus_map` estimated before any pixels are averaged.

        Averaging hides small blur, so the map is estimated at the finest resolution.

        Args:
            scene: At its finest resolution; a map that it has already stays.
            resolution: See `Scene.resized`.
            crop: See `Scene.resized`.
        """
        small = scene.resized(resolution, crop)
        if small.defocus_map is not None:
            return small

        def make() -> torch.Tensor:
            logger.info("estimating the defocus of scene %s", scene.scene_id)
            return self._small_map(scene, resolution, crop)

        numbers = {"map": [MAP_VERSION, DEAD_ZONE], "resolution": resolution, "crop": crop}
        found = self._cached("defocus_maps", scene, make, shape=small.light.shape[1:], **numbers)
        return replace(small, defocus_map=found)

    def _small_map(self, scene: Scene, resolution: int | None, crop: Crop) -> torch.Tensor:
        shorter = min(scene.light.shape[1:])
        factor = 1 if resolution is None or crop == "native" else shorter // resolution
        used = None if resolution is None else factor * resolution
        if used is not None and used + 2 * _MARGIN < shorter:
            scene = scene.resized(used + 2 * _MARGIN, "native")
        # Denoises where there is noise; at tolerance 0, as scorers ask for all of the blur.
        prepared = self._simulator.prepare(scene.prepared, tolerance=0.0)
        fine = replace(scene, defocus_map=self._simulator.estimate_defocus(prepared))
        found = fine.resized(used, "native").resized(resolution, crop).defocus_map
        assert found is not None
        return found

    def _cached(
        self,
        kind: str,
        scene: Scene,
        make: Callable[[], torch.Tensor],
        *,
        shape: Sequence[int],
        **numbers: Any,
    ) -> torch.Tensor:
        """The result of `make` for `scene`, from the cache where its inputs were the same."""
        modules = [m for m in (self._simulator.noise, self._simulator.aperture) if m is not None]
        inputs = {"light": scene.light, "denoised": scene.denoised}
        nlf = [scene.nlf.shot, scene.nlf.read]
        return self._results.result(kind, modules, inputs, make, shape=shape, nlf=nlf, **numbers)


def without_noise(scene: Scene) -> Scene:
    """The scene with its denoised light in place of its light, where it has one."""
    if scene.denoised is None:
        return scene
    return replace(scene, light=scene.denoised, nlf=scene.nlf.zero(), denoised=None)
