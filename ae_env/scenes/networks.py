"""What the trained networks find out about scenes, once, before any episode."""

from __future__ import annotations

import difflib
import hashlib
import logging
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import safetensors
import safetensors.torch
import torch

from ae_env.cache import cache_dir, cache_key
from ae_env.scenes.scene import Crop, Scene
from simulator.camera_simulator import CameraSimulator
from simulator.files import sibling, write_atomically
from simulator.modules.aperture import DEAD_ZONE

logger = logging.getLogger(__name__)

#: The weights that come with the package.
DEFAULT_SIMULATOR = "compact"
#: Bumped when the way that defocus maps are found changes.
MAP_VERSION = 1
#: Pixels around a crop that the networks see, too: at least as far as they look.
_MARGIN = 112


def check_weights(name: str) -> None:
    """Raises a `ValueError` unless `name` is that of weights or the path of some; reads none."""
    if not isinstance(name, str) or not name:
        raise ValueError(f"`simulator` (={name!r}) must be None, or the name or path of weights")
    if name == DEFAULT_SIMULATOR or sibling(name, ".safetensors").is_file():
        return
    from simulator.weights import list_pretrained

    known = sorted({DEFAULT_SIMULATOR, *list_pretrained()})
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(
            f"`simulator` (={name!r}) must be None, one of {known} or the path of a .safetensors "
            f"file{hint}"
        )


class SceneNetworks:
    """Trained networks, loaded when a scene first needs them.

    Args:
        name: Name or path of the weights.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    @cached_property
    def _simulator(self) -> CameraSimulator:
        return CameraSimulator.from_pretrained(self.name, device="cpu")

    def denoised(self, scene: Scene) -> Scene:
        """The scene with `Scene.denoised`; a noise-free one as it is."""
        if scene.noise_free or scene.denoised is not None:
            return scene
        return replace(scene, denoised=self._simulator.denoise(scene.latent))

    def resized(self, scene: Scene, resolution: int | None, crop: Crop = "box") -> Scene:
        """As `Scene.resized`, with `Scene.defocus_map` estimated before any pixels are averaged.

        Averaging hides small blur: the map is found at the finest resolution there is. It is kept
        in the cache folder, as that takes seconds per million pixels.

        Args:
            scene: At its finest resolution; its own map is kept if it has one.
            resolution: See `Scene.resized`.
            crop: See `Scene.resized`.
        """
        small = scene.resized(resolution, crop)
        if small.defocus_map is not None:
            return small
        path = self._cache_path(scene, resolution, crop)
        found = _read_map(path, small)
        if found is None:
            logger.info("finding what is out of focus in scene %s", scene.scene_id)
            found = self._small_map(scene, resolution, crop)
            try:
                write_atomically(path, safetensors.torch.save({"defocus_map": found}))
            except OSError as error:  # a full or read-only disk must not stop the run
                logger.warning("the defocus map could not be cached in %s: %s", path, error)
        return replace(small, defocus_map=found)

    def _small_map(self, scene: Scene, resolution: int | None, crop: Crop) -> torch.Tensor:
        shorter = min(scene.light.shape[1:])
        factor = 1 if resolution is None or crop == "native" else shorter // resolution
        used = None if resolution is None else factor * resolution
        if used is not None and used + 2 * _MARGIN < shorter:
            scene = scene.resized(used + 2 * _MARGIN, "native")
        latent = self._simulator.prepare(scene.latent)  # denoises where there is noise
        fine = replace(scene, defocus_map=self._simulator.estimate_defocus(latent))
        found = fine.resized(used, "native").resized(resolution, crop).defocus_map
        assert found is not None
        return found

    def _cache_path(self, scene: Scene, resolution: int | None, crop: Crop) -> Path:
        key = {
            "version": [MAP_VERSION, DEAD_ZONE],
            "weights": self._fingerprint,
            "light": _digest([scene.light]),
            "nlf": [scene.nlf.shot, scene.nlf.read],
            "resolution": resolution,
            "crop": crop,
        }
        return cache_dir() / "defocus_maps" / f"{cache_key(key)}.safetensors"

    @cached_property
    def _fingerprint(self) -> str:
        modules = self._simulator.noise, self._simulator.aperture
        return _digest([v for m in modules if m is not None for v in m.state_dict().values()])


def _digest(tensors: list[torch.Tensor]) -> str:
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


def _read_map(path: Path, scene: Scene) -> torch.Tensor | None:
    """The map in `path`; None if there is no such file or it is damaged."""
    try:
        found = safetensors.torch.load(path.read_bytes())["defocus_map"]
    except FileNotFoundError:
        return None
    except (OSError, safetensors.SafetensorError, KeyError) as error:
        logger.warning("cached defocus map %s is damaged (%s) and is made again", path, error)
        return None
    return found if found.shape == scene.light.shape[1:] else None


def without_noise(scene: Scene) -> Scene:
    """The scene with its denoised light for light, where it has one."""
    if scene.denoised is None:
        return scene
    return replace(scene, light=scene.denoised, nlf=scene.nlf.zero(), denoised=None)
