"""Scenes that are known through one photograph only, as a camera knows them.

The reference camera photographs a scene once, as an average meter would have it, at an ISO drawn
between 100 and 6400. That raw takes the scene's place: noise, white highlights and all. What is
simulated from it is the neural simulator's estimate, as in the paper.
"""

from __future__ import annotations

import zlib
from dataclasses import replace

import numpy as np

from ae_env.scenes.scene import Scene
from simulator.noise.generator import noise_generator
from simulator.radiance.light import mean_anchor
from simulator.raw.image import RawImage
from simulator.reference.camera import ReferenceCamera
from simulator.settings import CameraSettings
from simulator.utils.checks import check_number

#: Range of the ISO of the photograph, drawn log-uniformly, and its f-number.
ISO_RANGE, F_NUMBER = (100.0, 6400.0), 8.0
#: Exposure of the photograph relative to the meter's [EV], uniform.
EV_RANGE = (-1.0, 1.0)


def photographed(
    scene: Scene,
    *,
    seed: int = 0,
    iso: float | None = None,
    ev: float | None = None,
    iso_range: tuple[float, float] = ISO_RANGE,
) -> Scene:
    """`scene` as one raw of it tells; its illuminance stays known, as from an incident-light meter.

    Args:
        scene: Without noise.
        seed: Of the ISO, the exposure and the noise, which also depend on the scene's name.
        iso: ISO of the photograph; drawn by default.
        ev: Its exposure relative to a mean of green, clipped at white, of 0.12 [EV]; drawn by
            default.
        iso_range: What the ISO is drawn from, log-uniformly.

    Raises:
        ValueError: If the scene carries noise, as a raw does: it is a photograph already; if it
            is black nearly everywhere, so that no meter can expose it; or for settings out of
            range.
    """
    low, high = (check_number(f"iso_range[{i}]", iso_range[i], 1.0, 1e7) for i in (0, 1))
    if low > high:
        raise ValueError(f"`iso_range` (={iso_range!r}) must be ascending")
    if iso is not None:
        check_number("iso", iso, 1.0, 1e7)
    if ev is not None:
        check_number("ev", ev, -20.0, 20.0)
    if not scene.noise_free:
        raise ValueError(f"`scene` (={scene.scene_id!r}) must be free of noise to be photographed")
    rng = np.random.default_rng([zlib.crc32(scene.scene_id.encode()), seed])
    drawn_iso, drawn_ev = np.exp(rng.uniform(*np.log((low, high)))), rng.uniform(*EV_RANGE)
    iso, ev = float(drawn_iso if iso is None else iso), float(drawn_ev if ev is None else ev)
    try:
        ratio = mean_anchor(scene.light[1:3]) * 2.0**ev
    except ValueError as error:
        raise ValueError(
            f"`scene` (={scene.scene_id!r}) is too dark for the meter of `photographed`: its green "
            "is 0 nearly everywhere"
        ) from error
    unit = CameraSettings(iso, 1.0, F_NUMBER)
    exposure = scene.reference.log2_exposure + np.log2(ratio)
    settings = replace(unit, exposure_time=float(2.0 ** (exposure - unit.log2_exposure)))
    k = scene.box_factor
    light = (scene.light * ratio).repeat_interleave(k, -2).repeat_interleave(k, -1)
    noise = noise_generator(seed, zlib.crc32(scene.scene_id.encode()), iso, ev)
    taken = ReferenceCamera(scene.camera, box_factor=k).record(light, iso, noise)
    raw = RawImage(taken, settings, scene.camera, white_balance=scene.white_balance, box_factor=k)
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
