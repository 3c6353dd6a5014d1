"""What the cameras of n episodes record.

All that a frame depends on but for its noise is worked out when a state is first asked for and kept
(`ae_env.episode.Shot`, `Episode.blurred_light`); photographing a batch then is one call of a fused
kernel (`simulator.kernels`), on as many threads as torch may use.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ae_env.episode import Buffers, Episode, Shot, Shots
from ae_env.grid import ExposureGrid
from ae_env.options import EnvOptions
from ae_env.scenes.scene import Scene
from ae_env.score_table import in_episode, scene_latent
from simulator.blur_kernels import Blur, blur_many
from simulator.blur_shapes import disc_kernel
from simulator.cache import LruCache
from simulator.camera import CameraProfile
from simulator.capture import noise_balance
from simulator.exposure import LATENT_LIMIT, Exposure
from simulator.kernels import exposure_table, record_frames
from simulator.latent import Latent
from simulator.noise import noise_generator
from simulator.noise_bank import noise_keys
from simulator.pointers import addresses
from simulator.threads import in_shares

#: Memory for what is known of scenes, and what of it a scene and a plan take, about [byte].
_LATENTS_BYTES, _LATENT_BYTES, _SHOT_BYTES = 2**28, 2**16, 2000
#: Discs wider than this are cheaper in the Fourier domain than as a sum [pixel].
_WIDE_PX = 40.0


class Recorder:
    """Photographs n episodes.

    Args:
        options: The environment's arguments.
        grid: Exposure states.
        camera: The body.
        scenes: What is photographed.
        num_envs: Number of episodes side by side.
        keep: Whether the defocused light of every f-number is kept while an episode lasts.
        shares: Whether episodes of a scene at rest have the same light, and so share their plans.
    """

    def __init__(
        self,
        options: EnvOptions,
        grid: ExposureGrid,
        camera: CameraProfile,
        scenes: Sequence[Scene],
        num_envs: int,
        *,
        keep: bool,
        shares: bool,
    ) -> None:
        self.options, self.grid, self.camera, self.scenes = options, grid, camera, scenes
        self.keep, self.shares = keep, shares
        size = options.resolution
        self._samples = size * size
        self._buffers = Buffers((4, size, size))
        # At rest, by scene: its latent and its plans.
        self._latents: LruCache[tuple[Latent, Shots]] = LruCache(_LATENTS_BYTES)
        # Whose light is in `_lights`; None until that is made.
        self._shots: list[Shot | None] = [None] * num_envs
        self._lights: list[torch.Tensor] = [torch.empty(0)] * num_envs
        self._remaining: list[torch.Tensor | None] = [None] * num_envs
        self._tables = np.zeros((num_envs, 5, 4), np.float32)
        self._excess = np.zeros(num_envs)
        self._modules = np.full(num_envs, "", object)

    def __getstate__(self) -> dict[str, Any]:
        """Without what the next frame of every episode makes again."""
        return self.__dict__ | {
            "_shots": [None] * len(self._shots),
            "_latents": LruCache(_LATENTS_BYTES),
            "_buffers": Buffers(self._buffers.shape),
        }

    # -- plans ----------------------------------------------------------------------------------

    def prepare(self, index: int, episode: Episode, gain: float) -> bool:
        """Plans the next frame of episode `index`; whether `blur` must be called before `record`.

        Args:
            index: Place of the episode.
            episode: It, in its current state.
            gain: Light of the exposure relative to the scene's own.
        """
        if episode.latent is None:
            self._begin(episode)
        known = episode.shots.get(episode.state)
        if known is None or known[0] != gain:
            known = episode.shots[episode.state] = (gain, self._shot(episode, gain))
        shot = known[1]
        if shot is self._shots[index]:
            return False
        self._shots[index] = None
        self._tables[index] = shot.table
        self._modules[index] = shot.modules
        if shot.light is None:
            return True
        self._lights[index], self._remaining[index] = shot.light, None
        self._excess[index] = shot.excess_noise
        self._shots[index] = shot
        return False

    def blur(self, planned: Sequence[tuple[int, Episode]]) -> None:
        """Makes the light of the frames that were planned, on as many threads as torch may use.

        Args:
            planned: Places of the episodes, and they.
        """
        try:
            opened = [p for p in planned if _planned(p[1]).exposure.opened_to is not None]
            _in_shares(self._open, opened)
            begun = [self._begin_blur(*pair) for pair in planned]
            blurs = [blur for blur in begun if blur is not None]
            blur_many(_without_wide_discs(blurs), limit=LATENT_LIMIT)
            _in_shares(self._balance, opened)
        except BaseException:  # what the episodes keep is not all made
            for index, episode in planned:
                self.end(index, episode)
            raise
        for index, episode in planned:
            self._shots[index] = _planned(episode)

    def _open(self, index: int, episode: Episode) -> None:
        """Opens the aperture, which keeps its result."""
        assert episode.latent is not None
        episode.latent.source_light(_planned(episode).exposure)

    def _begin_blur(self, index: int, episode: Episode) -> Blur | None:
        shot = _planned(episode)
        self._lights[index], blur = episode.blurred_light(shot.exposure, self._buffers, self.keep)
        remaining = shot.exposure.remaining
        if remaining is not None:
            remaining = remaining.float().contiguous()
        self._remaining[index] = remaining
        if shot.excess_noise is not None:
            self._excess[index] = shot.excess_noise
        return blur

    def _balance(self, index: int, episode: Episode) -> None:
        """The noise that the source brings where pixels must tell."""
        shot = _planned(episode)
        if shot.excess_noise is None:
            balance = noise_balance(self._lights[index], shot.exposure)
            self._excess[index] = balance.relative_excess
        if not self.keep:  # an opening keeps the light of each f-number
            episode.latent = None

    def end(self, index: int, episode: Episode) -> None:
        """Lets the memory that `episode`, at place `index`, used be used again."""
        self._shots[index] = None
        episode.end(self._buffers)

    def _begin(self, episode: Episode) -> None:
        """Finds the episode's latent, and the plans that it shares with others of the scene."""
        known = self._latents.get(episode.scene)
        if known is None:
            latent = scene_latent(self.scenes[episode.scene], self.camera)
            known = (replace(latent, tolerance=self.options.tolerance), {})
            if latent.opening is None:  # that keeps too much light to stay longer than an episode
                size = _LATENT_BYTES + _SHOT_BYTES * len(self.grid)
                self._latents.put(episode.scene, known, size)
        latent, shots = known
        if episode.speed or episode.defocus:
            latent = in_episode(latent, speed=episode.speed, defocus=episode.defocus)
        elif latent.opening is None and self.shares:
            episode.shots = shots
        episode.latent = latent

    def _shot(self, episode: Episode, gain: float) -> Shot:
        latent = episode.latent
        assert latent is not None
        if gain != latent.gain:
            latent = replace(latent, gain=gain)
        exposure = latent.exposure(self.grid[episode.state])
        noisy = self.options.noise is not False
        excess = _excess_noise(latent, exposure) if noisy else 0.0
        light = None
        if not (exposure.defocus_px or exposure.motion_px or exposure.opened_to is not None):
            light = latent.source_light(exposure).contiguous()
        return Shot(
            exposure=exposure,
            table=exposure_table([exposure])[0],
            excess_noise=excess,
            modules=_modules(exposure, noisy),
            light=light,
        )

    # -- frames ---------------------------------------------------------------------------------

    def record(
        self,
        indices: Sequence[int],
        episodes: Sequence[Episode],
        *,
        codes: np.ndarray | None = None,
        numbers: np.ndarray | None = None,
        signals: np.ndarray | None = None,
    ) -> dict[str, np.ndarray]:
        """Photographs episodes that are prepared, and fills every output that is given.

        Args:
            indices: Places of the episodes.
            episodes: They.
            codes: (B, 4, R, R) uint8, as observed.
            numbers: (B, 4, R, R) uint16, digital numbers.
            signals: (B, 4, R, R) float32, on the scale where white is 1.

        Returns:
            Columns of `info`, and ``noise_key`` (B,) uint64.
        """
        rows = np.asarray(indices)
        keys = noise_keys(
            np.array([e.noise_seed for e in episodes]), np.array([e.frame for e in episodes], float)
        )
        exact = self.options.noise == "exact"
        flat = (len(rows), 4, self._samples)
        counts = record_frames(
            addresses([self._lights[i] for i in indices]),
            self._samples,
            self._tables[rows],
            self.camera,
            keys=None if self.options.noise is False else keys,
            normals=self._normals(episodes) if exact else None,
            remaining=addresses([self._remaining[i] for i in indices]),
            codes=None if codes is None else codes.reshape(flat),
            numbers=None if numbers is None else numbers.reshape(flat),
            signals=None if signals is None else signals.reshape(flat),
        )
        return {
            "clipped_high": counts[:, 1] / (4 * self._samples),
            "clipped_low": counts[:, 0] / (4 * self._samples),
            "excess_noise": self._excess[rows],
            "modules": self._modules[rows],
            "noise_key": keys,
        }

    def _normals(self, episodes: Sequence[Episode]) -> np.ndarray:
        """(B, 4 R R) float32, each row from its own generator."""
        normals = torch.empty(len(episodes), 4 * self._samples)

        def draw(first: int, last: int) -> None:
            for row, episode in zip(normals[first:last], episodes[first:last], strict=True):
                row.normal_(generator=noise_generator(episode.noise_seed, episode.frame))

        in_shares(draw, len(episodes))
        return normals.numpy()


def _planned(episode: Episode) -> Shot:
    return episode.shots[episode.state][1]


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
    """`simulator.blur.disc_blur` by numpy, whose transforms are safe in a forked process."""
    assert blur.defocused is not None
    weights = disc_kernel(blur.diameter_px)
    radius = len(weights) // 2
    light = np.clip(blur.light.numpy(), -LATENT_LIMIT, LATENT_LIMIT).astype(np.float64)
    padded = np.pad(light, ((0, 0), (radius, radius), (radius, radius)), mode="edge")
    size = padded.shape[-2:]
    spectrum = np.fft.rfft2(padded) * np.fft.rfft2(weights, s=size)
    blurred = np.fft.irfft2(spectrum, s=size)
    blur.defocused.numpy()[...] = blurred[:, 2 * radius :, 2 * radius :]


def _in_shares(
    task: Callable[[int, Episode], None], planned: Sequence[tuple[int, Episode]]
) -> None:
    def run(first: int, last: int) -> None:
        for index, episode in planned[first:last]:
            task(index, episode)

    in_shares(run, len(planned))


def _excess_noise(latent: Latent, exposure: Exposure) -> float | None:
    """Mean variance that the source brings beyond the target's; None where pixels must tell."""
    if exposure.source.is_zero:
        return 0.0
    source, target = exposure.source_noise, exposure.target
    pairs = zip((*source.shot, *source.read), (*target.shot, *target.read), strict=True)
    if all(brought <= wanted for brought, wanted in pairs):
        return 0.0
    if exposure.remaining is not None:
        return None
    return latent.statistics.relative_excess(exposure.ratio, source, target)


def _modules(exposure: Exposure, noise: bool) -> str:
    names = ["exposure"]
    names += ["noise_reduction"] * exposure.denoised
    names += ["aperture"] * (exposure.opened_to is not None)
    names += ["defocus"] * (exposure.defocus_px > 0) + ["motion_blur"] * (exposure.motion_px > 0)
    return "+".join(names + ["noise"] * noise)
