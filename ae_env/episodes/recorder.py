"""What the cameras of n episodes record.

All that a frame depends on but for its noise is worked out when a state is first asked for and kept
(`simulator.capture.batch`); photographing a batch then is one call of a fused kernel
(`simulator.capture.kernels`), on as many threads as torch may use.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from ae_env.episodes.state import Episodes
from ae_env.grid import ExposureGrid
from ae_env.options import EnvOptions
from ae_env.scenes.scene import Scene
from ae_env.scorers.score_table import in_episode, prepare_scene
from simulator.camera import CameraProfile
from simulator.capture.batch import Buffers, LightCache, Plans, in_bands, remaining_in_bands
from simulator.capture.exposure import LIGHT_LIMIT, Exposure
from simulator.capture.kernels import exposure_table, record_frames
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.record import noise_balance
from simulator.noise.generator import noise_keys
from simulator.optics.blur_kernels import Blur, blur_many
from simulator.optics.shapes import disc_kernel
from simulator.utils.cache import LruCache
from simulator.utils.jit import addresses
from simulator.utils.threads import in_shares

#: Memory for what is known of scenes, and what of it a scene takes, about [byte].
_PREPARED_SCENES_BYTES, _PREPARED_BYTES = 2**28, 2**16
#: Discs wider than this are cheaper in the Fourier domain than as a sum [pixel].
_WIDE_PX = 40.0


class Recorder:
    """Photographs episodes.

    Args:
        options: The environment's arguments.
        grid: Exposure states.
        camera: The body.
        scenes: What is photographed; the first slots are theirs, then there is one per place.
        episodes: Who photographs it.
        keep: Whether the defocused light of every f-number is kept while an episode lasts.
    """

    def __init__(
        self,
        options: EnvOptions,
        grid: ExposureGrid,
        camera: CameraProfile,
        scenes: Sequence[Scene],
        episodes: Episodes,
        *,
        keep: bool,
    ) -> None:
        self.options, self.grid, self.camera, self.scenes = options, grid, camera, scenes
        self.episodes, self.keep = episodes, keep
        size, places = options.resolution, len(episodes.slot)
        self._samples = size * size
        self._prepared_scenes: LruCache[PreparedScene] = LruCache(
            _PREPARED_SCENES_BYTES
        )  # at rest, by scene
        self._plans = Plans(len(scenes) + places, len(grid))
        self._buffers = Buffers((4, size, size))
        self._kept = [LightCache(self._buffers, keep) for _ in range(places)]
        # Row of the plans whose blurred light each place has.
        self._shown = np.full(places, -1)

    def end(self, places: np.ndarray) -> None:
        """Lets the memory that the episodes at `places` used be used again."""
        own = self.episodes.slot[places] >= len(self.scenes)  # the others keep nothing of theirs
        for place in places[own].tolist():
            self._plans.forget(len(self.scenes) + place)
            self._kept[place].end()
            self._shown[place] = -1

    # -- plans ----------------------------------------------------------------------------------

    def prepare(self, places: np.ndarray, gains: np.ndarray) -> None:
        """Plans the next frames, and makes their light; to be called before `record`.

        Args:
            places: (B,) of the episodes, in their current states.
            gains: (B,) light of each exposure relative to the scene's own.
        """
        rows = self._rows(places)
        stale = self._plans.gain[rows] != gains
        if stale.any():
            self._plan(places[stale], rows[stale], gains[stale])
        todo = self._plans.blurs[rows] & (self._shown[places] != rows)
        if todo.any():
            self._blur(places[todo], rows[todo])

    def _rows(self, places: np.ndarray) -> np.ndarray:
        """(B,) rows of the plans."""
        return self.episodes.slot[places] * len(self.grid) + self.episodes.state[places]

    def _plan(self, places: np.ndarray, rows: np.ndarray, gains: np.ndarray) -> None:
        """Works out `rows` (K,) of the plans, for the next frames of `places` in light `gains`."""
        plans, noisy, exposures = self._plans, self.options.noise is not False, []
        for place, row, gain in zip(places.tolist(), rows.tolist(), gains.tolist(), strict=True):
            prepared = self._prepared(place)
            if gain != prepared.gain:
                prepared = replace(prepared, gain=gain)
            exposure = prepared.exposure(self.grid[row % len(self.grid)])
            blurs = exposure.defocus_px or exposure.motion_px or exposure.opened_to is not None
            plans.blurs[row], plans.exposure[row] = blurs, exposure if blurs else None
            if not blurs:
                plans.light[row] = prepared.source_light(exposure).contiguous()
            plans.excess[row] = _excess_noise(prepared, exposure) if noisy else 0.0
            plans.modules[row] = _modules(exposure, noisy)
            exposures.append(exposure)
        plans.table[rows] = exposure_table(exposures)
        plans.gain[rows] = gains  # last: what is interrupted stays unknown
        self._shown[places] = -1

    def _prepared(self, place: int) -> PreparedScene:
        """What the camera sees of the scene in its own light."""
        kept, episodes = self._kept[place], self.episodes
        if kept.prepared is not None:
            return kept.prepared
        scene = int(episodes.scene[place])
        prepared = self._prepared_scenes.get(scene)
        if prepared is None:
            prepared = prepare_scene(self.scenes[scene], self.camera)
            prepared = replace(prepared, tolerance=self.options.tolerance)
            if (
                prepared.aperture_blur is None
            ):  # that keeps too much light to stay longer than an episode
                self._prepared_scenes.put(scene, prepared, _PREPARED_BYTES)
        if episodes.slot[place] != scene:
            speed, defocus = float(episodes.speed[place]), float(episodes.defocus[place])
            kept.prepared = prepared = in_episode(prepared, speed=speed, defocus=defocus)
        return prepared

    def _blur(self, places: np.ndarray, rows: np.ndarray) -> None:
        """Makes the light of `rows`, on as many threads as torch may use."""
        planned = list(zip(places.tolist(), rows.tolist(), strict=True))
        try:
            opened = [p for p in planned if self._plans.exposure[p[1]].opened_to is not None]
            _in_shares(self._open, opened)
            begun = [self._begin_blur(*pair) for pair in planned]
            blurs = [blur for blur in begun if blur is not None]
            blur_many(_without_wide_discs(blurs), limit=LIGHT_LIMIT)
            _in_shares(self._balance, opened)
        except BaseException:  # what the episodes keep is not all made
            self.end(places)
            raise
        self._shown[places] = rows

    def _open(self, place: int, row: int) -> None:
        """Opens the aperture, which keeps its result."""
        self._prepared(place).source_light(self._plans.exposure[row])

    def _begin_blur(self, place: int, row: int) -> Blur | None:
        exposure = self._plans.exposure[row]
        self._prepared(place)  # it may have been let go of since this was planned
        self._plans.light[row], blur = self._kept[place].blurred(exposure)
        remaining = exposure.remaining
        if remaining is not None:
            remaining = remaining.float().contiguous()
        self._plans.remaining[row] = remaining
        return blur

    def _balance(self, place: int, row: int) -> None:
        """The noise that the source brings where pixels must tell."""
        if np.isnan(self._plans.excess[row]):
            balance = noise_balance(self._plans.light[row], self._plans.exposure[row])
            self._plans.excess[row] = balance.relative_excess
        if not self.keep:  # an opening keeps the light of each f-number
            self._kept[place].prepared = None

    # -- frames ---------------------------------------------------------------------------------

    def record(
        self,
        places: np.ndarray,
        *,
        row_gain: np.ndarray | None = None,
        codes: np.ndarray | None = None,
        numbers: np.ndarray | None = None,
        signals: np.ndarray | None = None,
    ) -> dict[str, np.ndarray]:
        """Photographs episodes that are prepared, and fills every output that is given.

        Args:
            places: (B,) of the episodes.
            row_gain: (B, R) light of each row relative to the gain that was prepared for; None
                where all rows have the same. `excess_noise` is that of this gain.
            codes: (B, 4, R, R) uint8, as observed.
            numbers: (B, 4, R, R) uint16, digital numbers.
            signals: (B, 4, R, R) float32, on the scale where white is 1.

        Returns:
            Columns of `info`, and ``noise_key`` (B,) uint64.
        """
        rows, plans = self._rows(places), self._plans
        seeds, frames = self.episodes.noise_seed[places], self.episodes.frame[places]
        keys = noise_keys(seeds, frames.astype(np.float64))
        flat = (len(rows), 4, self._samples)
        light, remaining = plans.light[rows], None
        if plans.blurs[rows].any():  # else all of the source's variance remains
            remaining = plans.remaining[rows]
        if row_gain is not None:
            light, remaining = self._in_bands(rows, row_gain)
        counts = record_frames(
            addresses(light),
            self._samples,
            plans.table[rows],
            self.camera,
            keys=None if self.options.noise is False else keys,
            noise="exact" if self.options.noise == "exact" else "bank",
            remaining=None if remaining is None else addresses(remaining),
            codes=None if codes is None else codes.reshape(flat),
            numbers=None if numbers is None else numbers.reshape(flat),
            signals=None if signals is None else signals.reshape(flat),
        )
        return {
            "clipped_high": counts[:, 1] / (4 * self._samples),
            "clipped_low": counts[:, 0] / (4 * self._samples),
            "excess_noise": plans.excess[rows],
            "modules": plans.modules[rows],
            "noise_key": keys,
        }

    def _in_bands(
        self, rows: np.ndarray, row_gain: np.ndarray
    ) -> tuple[list[torch.Tensor], list[torch.Tensor | None]]:
        """Light and remaining variance (`Plans`) of frames whose rows have light of their own."""
        plans, size = self._plans, self.options.resolution
        light, remaining = list(plans.light[rows]), list(plans.remaining[rows])
        noisy = plans.table[rows, 3:].reshape(len(rows), -1).max(axis=1) > 0.0  # of the source
        for i in np.flatnonzero(row_gain.max(axis=1) > row_gain.min(axis=1)).tolist():
            light[i] = in_bands(light[i], row_gain[i])
            if noisy[i]:
                remaining[i] = remaining_in_bands(remaining[i], row_gain[i], size)
        return light, remaining


def _without_wide_discs(blurs: list[Blur]) -> list[Blur]:
    """What is left of `blurs` once the discs that are wide are done."""
    wide = [b for b in blurs if b.defocused is not None and b.diameter_px > _WIDE_PX]
    if not wide:
        return blurs

    def run(first: int, last: int) -> None:
        for blur in wide[first:last]:
            _wide_disc(blur)

    in_shares(run, len(wide))
    left = [b for b in blurs if b.defocused is None or b.diameter_px <= _WIDE_PX]
    moved = [b for b in wide if b.moved is not None]
    return left + [Blur(b.defocused, extent_px=b.extent_px, moved=b.moved) for b in moved]  # type: ignore[arg-type]


def _wide_disc(blur: Blur) -> None:
    """`simulator.optics.blur.disc_blur` by numpy, whose transforms are safe in a forked process."""
    assert blur.defocused is not None
    weights = disc_kernel(blur.diameter_px)
    radius = len(weights) // 2
    light = np.clip(blur.light.numpy(), -LIGHT_LIMIT, LIGHT_LIMIT).astype(np.float64)
    padded = np.pad(light, ((0, 0), (radius, radius), (radius, radius)), mode="edge")
    size = padded.shape[-2:]
    spectrum = np.fft.rfft2(padded) * np.fft.rfft2(weights, s=size)
    blurred = np.fft.irfft2(spectrum, s=size)
    blur.defocused.numpy()[...] = blurred[:, 2 * radius :, 2 * radius :]


def _in_shares(task: Callable[[int, int], None], planned: Sequence[tuple[int, int]]) -> None:
    def run(first: int, last: int) -> None:
        for place, row in planned[first:last]:
            task(place, row)

    in_shares(run, len(planned))


def _excess_noise(prepared: PreparedScene, exposure: Exposure) -> float:
    """Mean variance that the source brings beyond the target's; NaN where pixels must tell."""
    if exposure.source.is_zero:
        return 0.0
    source, target = exposure.source_noise, exposure.target
    pairs = zip((*source.shot, *source.read), (*target.shot, *target.read), strict=True)
    if all(brought <= wanted for brought, wanted in pairs):
        return 0.0
    if exposure.remaining is not None:
        return math.nan
    return prepared.statistics.relative_excess(exposure.ratio, source, target)


def _modules(exposure: Exposure, noise: bool) -> str:
    names = ["exposure"]
    names += ["noise_reduction"] * exposure.denoised
    names += ["aperture"] * (exposure.opened_to is not None)
    names += ["defocus"] * (exposure.defocus_px > 0) + ["motion_blur"] * (exposure.motion_px > 0)
    return "+".join(names + ["noise"] * noise)
