"""What the simulator photographs: raws, latents and scenes, as light on a device."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import torch

from simulator.latent import HasLatent, Latent
from simulator.raw_image import RawImage

#: What is known of a scene's depth: it is far or in focus throughout, or not known.
Depth = Literal["far", "unknown"]


def check_depth(depth: str) -> None:
    """Raises a `ValueError` unless `depth` says what is known of the scene's."""
    if depth not in get_args(Depth):
        raise ValueError(f"`depth` (={depth!r}) must be one of {list(get_args(Depth))}")


def latent_of(source: RawImage | Latent | HasLatent, device: torch.device) -> Latent:
    """The light of `source` as it was recorded, or a latent as it is, on `device`.

    Raises:
        ValueError: If `source` is neither a raw nor a latent nor a scene.
    """
    if isinstance(source, RawImage):
        return _recorded(source, device)
    if isinstance(source, Latent):
        if source.light.device == device:
            return source
        given = {name: getattr(source, name) for name in ("light", "denoised", "saturated")}
        moved = {name: part.to(device) for name, part in given.items() if part is not None}
        return replace(source, **moved)
    if hasattr(source, "latent"):
        return latent_of(source.latent, device)
    raise ValueError(f"`source` (={type(source).__name__}) must be a RawImage, a Latent or a scene")


def _recorded(raw: RawImage, device: torch.device) -> Latent:
    saturated, camera = raw.saturated, raw.camera
    if raw.nlf is not None and not camera.nlf_by_iso:
        camera = camera.with_nlf(raw.settings.iso, raw.nlf)
    return Latent(
        light=raw.data.to(device),
        reference=raw.settings,
        camera=camera,
        nlf=raw.noise,
        saturated=saturated.to(device) if saturated.count_nonzero() else None,
        white_balance=raw.white_balance,
        box_factor=raw.box_factor,
    )
