"""What the trained networks find out about scenes, once, before any episode."""

from __future__ import annotations

import difflib
import logging
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch

from ae_env.scenes.scene import Crop, Scene
from simulator.camera_simulator import CameraSimulator
from simulator.files import sibling
from simulator.modules.aperture import DEAD_ZONE
from simulator.network_cache import NetworkCache

logger = logging.getLogger(__name__)

#: The weights that come with the package.
DEFAULT_SIMULATOR = "compact"
#: Bumped when the way that defocus maps are found changes.
MAP_VERSION = 2
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
        cache: Whether what they find is kept in the cache folder, and looked for there.
    """

    def __init__(self, name: str, *, cache: bool = True) -> None:
        self.name = name
        # In memory are the scenes themselves.
        self._results = NetworkCache("disk" if cache else None, max_bytes=0)

    @cached_property
    def _simulator(self) -> CameraSimulator:
        return CameraSimulator.from_pretrained(self.name, device="cpu", cache=None)

    def denoised(self, scene: Scene) -> Scene:
        """The scene with `Scene.denoised`; a noise-free one as it is."""
        if scene.noise_free or scene.denoised is not None:
            return scene

        def make() -> torch.Tensor:  # leaving nothing out: it serves every tolerance
            return self._simulator.denoise(replace(scene.latent, tolerance=0.0))

        return replace(
            scene,
            denoised=self._kept("denoised", scene, make, everywhere=True),
        )

    def resized(self, scene: Scene, resolution: int | None, crop: Crop = "box") -> Scene:
        """As `Scene.resized`, with `Scene.defocus_map` estimated before any pixels are averaged.

        Averaging hides small blur: the map is found at the finest resolution there is.

        Args:
            scene: At its finest resolution; its own map is kept if it has one.
            resolution: See `Scene.resized`.
            crop: See `Scene.resized`.
        """
        small = scene.resized(resolution, crop)
        if small.defocus_map is not None:
            return small

        def make() -> torch.Tensor:
            logger.info("finding what is out of focus in scene %s", scene.scene_id)
            return self._small_map(scene, resolution, crop)

        numbers = {"map": [MAP_VERSION, DEAD_ZONE], "resolution": resolution, "crop": crop}
        return replace(small, defocus_map=self._kept("defocus_maps", scene, make, **numbers))

    def _small_map(self, scene: Scene, resolution: int | None, crop: Crop) -> torch.Tensor:
        shorter = min(scene.light.shape[1:])
        factor = 1 if resolution is None or crop == "native" else shorter // resolution
        used = None if resolution is None else factor * resolution
        if used is not None and used + 2 * _MARGIN < shorter:
            scene = scene.resized(used + 2 * _MARGIN, "native")
        # Denoises where there is noise; leaves nothing out, as scorers ask for the blur of it all.
        latent = self._simulator.prepare(scene.latent, tolerance=0.0)
        fine = replace(scene, defocus_map=self._simulator.estimate_defocus(latent))
        found = fine.resized(used, "native").resized(resolution, crop).defocus_map
        assert found is not None
        return found

    def _kept(
        self, kind: str, scene: Scene, make: Callable[[], torch.Tensor], **numbers: Any
    ) -> torch.Tensor:
        """What `make` finds out about `scene`, or found when everything was the same."""
        modules = [m for m in (self._simulator.noise, self._simulator.aperture) if m is not None]
        inputs = {"light": scene.light, "denoised": scene.denoised}
        nlf = [scene.nlf.shot, scene.nlf.read]
        return self._results.result(kind, modules, inputs, make, nlf=nlf, **numbers)


def without_noise(scene: Scene) -> Scene:
    """The scene with its denoised light for light, where it has one."""
    if scene.denoised is None:
        return scene
    return replace(scene, light=scene.denoised, nlf=scene.nlf.zero(), denoised=None)
