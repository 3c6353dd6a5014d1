"""Descriptions of captures for scorers: of any captures, and of every state of a scene."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from ae_env.scenes.scene import Scene
from ae_env.scorers.protocol import Captures, PixelBlur, layout_blur, stacked
from simulator.camera import CameraProfile
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.optics.motion import ALONG_ROWS, Movement
from simulator.settings import CameraSettings, exposure_ratio
from simulator.utils.cache import LruCache

#: Memory that the captures of a state take, about [byte].
_STATE_BYTES = 1000


def describe_captures(
    scenes: Sequence[Scene],
    settings: Sequence[CameraSettings],
    camera: CameraProfile,
    *,
    speed: np.ndarray,
    defocus: np.ndarray,
    movements: Sequence[Movement] | None = None,
    gain: np.ndarray,
    row_gain: np.ndarray | None = None,
    light: torch.Tensor | None = None,
    source_noise: Sequence[NoiseLevelFunction] | None = None,
    noisy: bool = True,
) -> Captures:
    """`Captures` of one state each of `scenes`, all (B,) long.

    Args:
        scenes: Scene of each capture.
        settings: Settings of each capture.
        camera: The body.
        speed: (B,) image speed [frame heights per second].
        defocus: (B,) blur diameter at f/4 [pixel of a 64-pixel frame].
        movements: Directions of the motion and subjects' own, B long; None for along the rows.
        gain: (B,) light relative to the scenes' own.
        row_gain: (B, H) light of each row relative to that; None where all rows have the same.
        light: (B, 4, H, W) the scenes' `Scene.clean_light` where it is at hand already.
        source_noise: See `Captures`.
        noisy: See `Captures`.
    """
    height = scenes[0].light.shape[-2]
    times = np.array([s.exposure_time for s in settings])
    aperture_blurs = np.array([4.0 / s.effective_f_number for s in settings])
    discs = defocus * aperture_blurs * height / 64.0
    blur = np.hypot(speed * times * height, discs)
    own = [c.own_blur(s.effective_f_number) for c, s in zip(scenes, settings, strict=True)]
    blur = np.hypot(blur, own)  # exactly `blur` where they are 0
    moves = [ALONG_ROWS] * len(scenes) if movements is None else movements
    pixel_blur = _pixel_blur(scenes, moves, blur, speed=speed, times=times, discs=discs, own=own)
    nlfs = {iso: camera.nlf(iso) for iso in {s.iso for s in settings}}
    ratios = [exposure_ratio(c.reference, s) for c, s in zip(scenes, settings, strict=True)]
    return Captures(
        settings=settings,
        scene_ids=[c.scene_id for c in scenes],
        scene_light=torch.stack([c.clean_light for c in scenes]) if light is None else light,
        ratio=torch.from_numpy(np.array(ratios) * gain),
        nlf=[nlfs[s.iso] for s in settings],
        proper_ev=torch.from_numpy(np.array([c.ev100 for c in scenes]) + np.log2(gain)),
        blur_px=torch.from_numpy(blur) if pixel_blur is None else pixel_blur.rms_px,
        white_balance=torch.tensor([c.white_balance for c in scenes]),
        colour_matrices=[c.camera.colour_matrix for c in scenes],
        row_gain=None if row_gain is None else torch.from_numpy(row_gain),
        source_noise=source_noise,
        noisy=noisy,
        pixel_blur=pixel_blur,
    )


def _pixel_blur(
    scenes: Sequence[Scene],
    moves: Sequence[Movement],
    blur: np.ndarray,
    *,
    speed: np.ndarray,
    times: np.ndarray,
    discs: np.ndarray,
    own: Sequence[float],
) -> PixelBlur | None:
    """How many pixels have which blur; None where all pixels of each capture have `blur`."""
    parts: list[PixelBlur | None] = []
    if discs.any() or any(move.subject_speed for move in moves):
        numbers = np.stack([times, discs, own], axis=1)[:, :, None]  # (B, 3, 1)
        parts = [
            layout_blur(scene, move, speed=v, times=t, discs=d, own=o)
            for scene, move, v, (t, d, o) in zip(
                scenes, moves, speed.tolist(), numbers, strict=True
            )
        ]
    return stacked(parts, blur)


@dataclass(frozen=True)
class _AtRest:
    """Captures of a scene at rest in its own light, and the numbers that blur depends on."""

    scene: weakref.ref[Scene]
    captures: Captures
    times: np.ndarray
    aperture_blurs: np.ndarray

    @cached_property
    def blurs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Times, aperture blurs and own blur where states differ in them, and which each has."""
        own = self.captures.blur_px.numpy()
        numbers = np.stack([self.times, self.aperture_blurs, own], axis=1)
        few, alike = np.unique(numbers, axis=0, return_inverse=True)
        times, aperture_blurs, own = few.T.copy()
        return times, aperture_blurs, own, alike.reshape(-1)


class SceneCaptures:
    """Describes captures of a scene, and caches what depends neither on blur nor on its light.

    Args:
        camera: The body.
        max_bytes: Memory of its cache.
        copies: Whether scorers get a copy of the light.
    """

    def __init__(self, camera: CameraProfile, max_bytes: int, *, copies: bool) -> None:
        self.camera, self.copies = camera, copies
        self._at_rest: LruCache[_AtRest] = LruCache(max_bytes)

    def describe(
        self,
        scene: Scene,
        states: Sequence[CameraSettings],
        *,
        speed: float = 0.0,
        defocus: float = 0.0,
        movement: Movement = ALONG_ROWS,
        gain: float | np.ndarray = 1.0,
        row_gain: np.ndarray | None = None,
        source_noise: Sequence[NoiseLevelFunction] | None = None,
        noisy: bool = True,
    ) -> Captures:
        """Captures of consecutive states of a grid.

        Args:
            scene: The scene.
            states: S states that follow each other in the grid.
            speed: Image speed [frame heights per second].
            defocus: Blur diameter at f/4 [pixel of a 64-pixel frame].
            movement: Directions of the image's motion, and the subject's own.
            gain: Light relative to the scene's own, one or (S,).
            row_gain: (S, H), see `describe_captures`.
            source_noise: See `Captures`.
            noisy: See `Captures`.
        """
        known = self._known(scene, states)
        blur, alike = self.blur(scene, states, speed=speed, defocus=defocus, movement=movement)
        pixel_blur: PixelBlur | None = None
        if isinstance(blur, PixelBlur):
            pixel_blur = PixelBlur(blur.levels[alike], blur.shares[alike])
            blur_px = blur.rms_px[alike]
        else:
            blur_px = blur[alike]
        light: dict[str, Any] = {}
        if isinstance(gain, np.ndarray) or gain != 1.0:
            light["ratio"] = torch.from_numpy(known.captures.ratio.numpy() * gain)
            light["proper_ev"] = torch.from_numpy(known.captures.proper_ev.numpy() + np.log2(gain))
        return replace(
            known.captures,
            scene_light=self._light(scene, len(states)),
            blur_px=blur_px,
            row_gain=None if row_gain is None else torch.from_numpy(row_gain),
            source_noise=source_noise,
            noisy=noisy,
            pixel_blur=pixel_blur,
            **light,
        )

    def blur(
        self,
        scene: Scene,
        states: Sequence[CameraSettings],
        *,
        speed: float = 0.0,
        defocus: float = 0.0,
        movement: Movement = ALONG_ROWS,
    ) -> tuple[torch.Tensor | PixelBlur, torch.Tensor]:
        """The extents of blur that there are, of few states: the ISO blurs nothing.

        Returns:
            (K,) extents in pixels, or those of the pixels where they differ; and (S,) int64, which
            of the K each of `states` has. The arguments are those of `describe`.
        """
        times, aperture_blurs, own, alike = self._known(scene, states).blurs
        height = scene.light.shape[-2]
        discs = defocus * aperture_blurs * height / 64.0
        found: torch.Tensor | PixelBlur | None = layout_blur(
            scene, movement, speed=speed, times=times, discs=discs, own=own
        )
        if found is None:
            found = torch.from_numpy(np.hypot(np.hypot(speed * times * height, discs), own))
        return found, torch.from_numpy(alike)

    def _known(self, scene: Scene, states: Sequence[CameraSettings]) -> _AtRest:
        key = (id(scene), states[0], len(states))
        known = self._at_rest.get(key)
        if known is None or known.scene() is not scene:  # an id may be given out again
            known = self._described(scene, states)
            self._at_rest.put(key, known, _STATE_BYTES * len(states))
        return known

    def _described(self, scene: Scene, states: Sequence[CameraSettings]) -> _AtRest:
        nothing = np.zeros(len(states))
        captures = describe_captures(
            [scene] * len(states),
            states,
            self.camera,
            speed=nothing,
            defocus=nothing,
            gain=np.ones(len(states)),
            light=torch.empty(0),  # keeps no scene alive
        )
        return _AtRest(
            weakref.ref(scene),
            captures,
            np.array([s.exposure_time for s in states]),
            np.array([4.0 / s.effective_f_number for s in states]),
        )

    def _light(self, scene: Scene, count: int) -> torch.Tensor:
        light = scene.clean_light.clone() if self.copies else scene.clean_light
        return light.expand(count, -1, -1, -1)
